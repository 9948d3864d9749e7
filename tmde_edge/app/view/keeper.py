"""Keeps the service's page open: a port that is taken, or an address that is not there yet, costs the page, not the service."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from tmde_edge.adapters.can_ports.retry import BackOff
from tmde_edge.app.view.hub import Hub
from tmde_edge.app.view.server import ViewServer
from tmde_edge.errors import DeviceError

_log = logging.getLogger(__name__)


class PageKeeper:
    """start() tries to listen and goes on trying; `faults` says while nobody can look. close() ends page and streams."""

    def __init__(self, hub: Hub, listen: Callable[[], ViewServer], back_off: BackOff | None = None) -> None:
        """`listen` binds the page's address and raises DeviceError where that cannot be done."""
        self.hub, self._listen, self._back_off = hub, listen, back_off or BackOff(1.0, 10.0)
        self._server: ViewServer | None = None
        self._failed = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="view-keeper", daemon=True)

    @property
    def faults(self) -> tuple[str, ...]:
        """("view_lost",) while the page cannot be served."""
        return ("view_lost",) if self._failed or (self.hub.closing and not self._stopping.is_set()) else ()

    def start(self) -> None:
        """Opens the page, or begins to wait until that can be done."""
        self.hub.start()
        if not self._open():
            self._thread.start()

    def close(self) -> None:
        """Ends the page."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        if self._server is not None:
            self._server.close()
        else:
            self.hub.close()

    def _keep(self) -> None:
        while not self._stopping.wait(self._back_off.pause_s()):
            if self._open():
                return

    def _open(self) -> bool:
        try:
            server = self._listen()
        except DeviceError as error:
            if not self._failed:
                text = "the web page is off: %s; trying again (a service under systemd also needs view.conf: docs/view.md)"
                _log.error(text, error, extra={"fields": {"TMDE_EVENT": "view_lost"}})
            self._failed = True
            return False
        server.start()
        again = "works again; it " if self._failed else ""
        _log.log(logging.WARNING if again else logging.INFO, "the web page %sis at %s", again, server.url)
        self._server, self._failed = server, False
        return True
