"""The page over HTTP: Starlette on uvicorn, in a thread of its own with its own event loop."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import json
import secrets
import socket
import threading
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from importlib.resources import files
from urllib.parse import parse_qs

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from tmde_edge import __version__
from tmde_edge.app.view.hub import Hub
from tmde_edge.errors import DeviceError

MOST_STREAMS = 8  # pictures and numbers at once; beyond that: 503
COOKIE = "tmde_edge_view"
EVERY_ADDRESS = ("0.0.0.0", "::", "")
WRONG_TOKEN_S = 0.5
POLITE_S, JOIN_S = 0.5, 1.0  # at the end for streams to end by themselves; for the thread
QUIET_S = 5.0  # without news a stream says that it still lives
TYPES = {"index.html": "text/html", "view.css": "text/css", "view.js": "text/javascript"}
HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; form-action 'self'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}
LOGIN = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>tmde-edge</title><link rel="icon" href="data:,"><link rel="stylesheet" href="/view.css">
<main class="login"><h1>tmde-edge</h1>
<p>This page needs the token from the service's journal or its configuration (<code>view.token</code>).</p>
<form method="get" action="/"><input name="token" type="password" autocomplete="current-password" aria-label="token" autofocus>
<button>Open</button></form></main></html>"""


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach that address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _own_address() -> str:
    """This machine's address on the network that it would use, else its name. Asks the routing table; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation, RFC 5737
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


class ViewServer:
    """Binds at once (raises DeviceError), serves from start() to close()."""

    def __init__(self, hub: Hub, host: str, port: int, token: str, *, title: str, limits: dict[str, float]) -> None:
        """`token` "": none is asked for on loopback; elsewhere one is made. `limits`: TTC thresholds for the charts."""
        self._hub = hub
        self._host = host
        local = is_loopback(host)
        self.token = token or ("" if local else secrets.token_urlsafe(16))
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.create_server((host, port), family=family)
        except OSError as error:
            what = error.strerror or str(error)
            raise DeviceError(f"view {host} port {port}: cannot listen ({what}); set view.host, view.port") from None
        self.port: int = self._socket.getsockname()[1]
        self._streams = Streams(hub, title, limits)
        app: ASGIApp = Starlette(routes=self._streams.routes())
        app = Guard(app, self.token, hosts={"localhost", "127.0.0.1", "[::1]", host} if local else None)
        config = uvicorn.Config(
            app, log_config=None, log_level="warning", access_log=False, lifespan="off", ws="none", loop="asyncio", http="h11",
            timeout_graceful_shutdown=1, server_header=False, date_header=False, limit_concurrency=64, backlog=16,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="view-http", daemon=True)

    @property
    def url(self) -> str:
        """What to open in a browser."""
        host = _own_address() if self._host in EVERY_ADDRESS else self._host  # "all" is no address to open
        shown = f"[{host}]" if ":" in host else host
        return f"http://{shown}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def start(self) -> None:
        """Serves on its own thread."""
        self._thread.start()

    def close(self) -> None:
        """Ends all streams, then the server; a reader that does not read is not waited for."""
        self._hub.close()
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(POLITE_S)
        self._server.force_exit = True
        if self._thread.is_alive():
            self._thread.join(JOIN_S)
        self._socket.close()

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        loop = asyncio.get_running_loop()

        def wake() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._streams.news)

        self._hub.listen(wake)
        await self._server.serve(sockets=[self._socket])


class Guard:
    """Lets in who knows the token (or, on loopback, who names this machine), and adds the headers of a careful page."""

    def __init__(self, app: ASGIApp, token: str, hosts: set[str] | None) -> None:
        self._app, self._token, self._hosts = app, token, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        answer = await self._refusal(request)

        async def careful(message: dict[str, object]) -> None:
            if message["type"] == "http.response.start":
                old = message.get("headers", [])
                new = [(k.encode(), v.encode()) for k, v in HEADERS.items()]
                message = {**message, "headers": [*(old if isinstance(old, list) else []), *new]}
            await send(message)

        await (answer or self._app)(scope, receive, careful)  # type: ignore[arg-type]

    async def _refusal(self, request: Request) -> Response | None:
        # A foreign page that had its own name resolve to 127.0.0.1 must not read the camera.
        host = request.headers.get("host", "")
        if self._hosts is not None and host.rsplit(":", 1)[0] not in self._hosts and host not in self._hosts:
            return PlainTextResponse("this page answers only to this machine's own name\n", 403)
        if not self._token:
            return None
        given = parse_qs(request.url.query).get("token", [""])[0]
        if given and hmac.compare_digest(given.encode(), self._token.encode()):
            found = RedirectResponse(request.url.path, 303)
            found.set_cookie(COOKIE, self._token, max_age=30 * 86400, httponly=True, samesite="strict")
            return found
        if hmac.compare_digest(request.cookies.get(COOKIE, "").encode(), self._token.encode()):
            return None
        if request.url.path == "/view.css":
            return None
        if given:
            await asyncio.sleep(WRONG_TOKEN_S)
        return HTMLResponse(LOGIN, 401)


class Streams:
    """The page's files, its picture (MJPEG) and its numbers (server-sent events)."""

    def __init__(self, hub: Hub, title: str, limits: dict[str, float]) -> None:
        self._hub, self._title, self._limits = hub, title, limits
        self._open = 0
        self._waiting: set[asyncio.Event] = set()

    def routes(self) -> list[Route]:
        """What there is to ask for."""
        pages = [Route("/", self._static("index.html")), *(Route(f"/{n}", self._static(n)) for n in TYPES if n != "index.html")]
        return [*pages, Route("/video", self._video), Route("/events", self._events), Route("/picture.jpg", self._picture)]

    def news(self) -> None:
        """Something changed: on the event loop's thread."""
        for event in self._waiting:
            event.set()

    @staticmethod
    def _static(name: str) -> Callable[[Request], Awaitable[Response]]:
        text = files("tmde_edge.app.view").joinpath("static").joinpath(name).read_text(encoding="utf-8")

        async def answer(_: Request) -> Response:
            return Response(text, media_type=TYPES[name])

        return answer

    async def _picture(self, _: Request) -> Response:
        """One picture: the next one that is drawn."""
        jpeg: bytes | None = None
        async with contextlib.aclosing(self._pictures()) as pictures:
            with contextlib.suppress(asyncio.TimeoutError):
                jpeg = await asyncio.wait_for(anext(pictures, None), QUIET_S)
        return PlainTextResponse("no picture\n", 503) if jpeg is None else Response(jpeg, media_type="image/jpeg")

    async def _video(self, request: Request) -> Response:
        if self._open >= MOST_STREAMS:
            return PlainTextResponse("too many watch already\n", 503)

        async def parts() -> AsyncIterator[bytes]:
            # A browser shows a picture when its closing boundary has come: it is sent along, not with the next picture.
            yield b"--frame\r\n"
            async for jpeg in self._pictures():
                head = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                yield head.encode() + jpeg + b"\r\n--frame\r\n"

        return StreamingResponse(parts(), media_type="multipart/x-mixed-replace; boundary=frame")

    async def _events(self, request: Request) -> Response:
        if self._open >= MOST_STREAMS:
            return PlainTextResponse("too many watch already\n", 503)

        async def lines() -> AsyncIterator[str]:
            first = {"title": self._title, "version": __version__, "limits": self._limits, "history": self._hub.history()}
            yield f"event: start\ndata: {json.dumps(first)}\n\n"
            async for _ in self._news(picture=False):
                yield f"data: {json.dumps(self._hub.state, allow_nan=False)}\n\n" if self._hub.state else ": nothing yet\n\n"

        return StreamingResponse(lines(), media_type="text/event-stream")

    async def _pictures(self) -> AsyncGenerator[bytes, None]:
        """Newest pictures; a reader that is slow skips some, and news without a picture is none."""
        sent = self._hub.picture_number
        async for _ in self._news(picture=True):
            if self._hub.picture_number != sent and self._hub.jpeg is not None:
                sent = self._hub.picture_number
                yield self._hub.jpeg

    async def _news(self, picture: bool) -> AsyncIterator[None]:
        """Once for every piece of news, and now and then without."""
        event = asyncio.Event()
        self._waiting.add(event)
        self._open += 1
        self._hub.watch(picture, 1)
        try:
            while not self._hub.closing:
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(event.wait(), QUIET_S)
                event.clear()
                yield None
        finally:
            self._hub.watch(picture, -1)
            self._open -= 1
            self._waiting.discard(event)
