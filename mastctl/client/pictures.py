"""Live pictures of a daemon as they come: JPEG with its facts, at the pace of the caller."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidURI
from websockets.sync.client import ClientConnection, connect, unix_connect

from mastctl.client.connection import PREFIX, Broken, ClientError, DaemonHttp, trusted

OPENS_S = 10.0


@dataclass(frozen=True, eq=False)
class LivePicture:
    """A camera's JPEG as it came, and its ``facts``: ``camera``, ``frame_id``, ``mid_exposure_s``, ..."""

    facts: dict[str, Any]
    jpeg: bytes


class LivePictures:
    """An open line of live pictures; `live_pictures` makes one. For one thread.

    A camera sends its next picture after `wanted`: the first one too.
    """

    def __init__(self, line: ClientConnection, url: str) -> None:
        self._line = line
        self._url = url

    def wanted(self, camera: str) -> None:
        """Ask for a camera's next picture. Raises ClientError as `next`."""
        try:
            self._line.send(camera)
        except (ConnectionClosed, OSError) as error:
            raise Broken("no_daemon", f"the line of pictures of {self._url} broke: {error}") from None

    def next(self, timeout_s: float) -> LivePicture | None:
        """Return the next picture, None if there was none for so many seconds.

        Raises ClientError ``no_daemon`` if the line broke or the daemon has ended, ``bad_answer``.
        """
        try:
            message = self._line.recv(timeout=timeout_s)
        except TimeoutError:
            return None
        except (ConnectionClosed, OSError) as error:
            raise Broken("no_daemon", f"the line of pictures of {self._url} broke: {error}") from None
        try:
            if isinstance(message, str):
                raise ValueError
            length = 4 + int.from_bytes(message[:4], "little")
            return LivePicture(dict(json.loads(message[4:length])), message[length:])
        except ValueError:
            raise ClientError("bad_answer", f"the program at {self._url} sends no pictures") from None


@contextmanager
def live_pictures(daemon: DaemonHttp, cameras: Sequence[str]) -> Iterator[LivePictures]:
    """Open a line of pictures of some cameras, at their own rate.

    Raises ClientError ``no_daemon``; ``refused`` if the daemon does not send them, with its reason.
    """
    path = daemon.socket_path
    base = "http://localhost" if path is not None else daemon.url.rstrip("/")
    query = urlencode([("camera", one) for one in cameras] + [("on_request", "true"), ("every", "true")])
    address = f"ws{base.removeprefix('http')}{PREFIX}/images?{query}"
    options: dict[str, Any] = {
        "additional_headers": daemon.shown,
        "compression": None,
        "max_size": None,
        "open_timeout": OPENS_S,
    }
    try:
        if path is not None:
            line = unix_connect(path, address, **options)
        else:
            options["ssl"] = trusted() if address.startswith("wss") else None
            line = connect(address, proxy=None, **options)
    except (InvalidHandshake, InvalidURI) as error:
        raise ClientError("refused", f"the daemon at {daemon.url} sends no pictures: {_why(error)}") from None
    except (OSError, TimeoutError):
        raise daemon.no_daemon() from None
    with line:
        yield LivePictures(line, daemon.url)


def _why(error: Exception) -> str:
    """The sentence of a refusal."""
    try:
        return str(json.loads(error.response.body)["error"]["message"])  # type: ignore[attr-defined]
    except (AttributeError, ValueError, LookupError, TypeError):
        return str(error)
