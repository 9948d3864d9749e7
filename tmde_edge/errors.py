"""Every error a user can meet; each class is one exit code of the contract (sysexits(3) where one fits)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class TmdeError(Exception):
    """A known error: one line that says what, where, the value and what to do. Its class gives the exit code."""

    exit_code = 70


class CheckFailedError(TmdeError):
    """A check or a comparison failed (replay differs, evaluation is worse)."""

    exit_code = 1


class UsageError(TmdeError):
    """The command line cannot be understood or asks for something that does not fit together."""

    exit_code = 2


class InputDataError(TmdeError):
    """An image, video or log cannot be read (EX_DATAERR)."""

    exit_code = 65


class InputMissingError(TmdeError):
    """An input does not exist (EX_NOINPUT)."""

    exit_code = 66


class ModelError(TmdeError):
    """A network file is missing, has another checksum or another graph contract (EX_UNAVAILABLE)."""

    exit_code = 69


class DeviceError(TmdeError):
    """A camera, bus or serial port failed (EX_IOERR)."""

    exit_code = 74


class ConfigError(TmdeError):
    """The configuration is wrong (EX_CONFIG)."""

    exit_code = 78


@contextmanager
def writing(output: object, *more: type[Exception]) -> Iterator[None]:
    """A disk that refuses, within: a UsageError that names the output. `more`: what else a library raises for it."""
    refusals: tuple[type[Exception], ...] = (OSError, *more)
    try:
        yield
    except refusals as e:
        raise UsageError(f"{output}: cannot be written ({getattr(e, 'strerror', None) or e})") from None
