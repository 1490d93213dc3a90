"""Requests to a daemon over HTTP; every failure is a `ClientError`."""

from __future__ import annotations

import json
import os
import secrets
import socket
import ssl
import sys
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast
from urllib.parse import quote, unquote, urlsplit

if TYPE_CHECKING:
    import httpx

T = TypeVar("T")

PREFIX = "/api/v1"
AGAIN_S = (0.1, 0.5)  # pauses before a command goes out again on a new connection
POLL_AGAIN_S = (0.1, 0.5, 1.0)  # pauses of a wait in which the daemon does not answer any more
PASSING = ("no_daemon", "timeout", "closing")
LEAST_S = 1.0  # for a request, on a machine that is busy
POLL_S = 0.05  # between the requests of a wait
_BAD_INPUT = frozenset({400, 404, 413, 415, 422})


class ClientError(Exception):
    """The daemon refused, failed, or did not answer.

    ``code`` is the daemon's, or the client's own: ``no_daemon``, ``bad_url``, ``timeout``, ``bad_answer``;
    ``exit_code`` that of a command: 2 for bad input, 1 for a failure.
    """

    def __init__(
        self, code: str, message: str, detail: Mapping[str, Any] | None = None, exit_code: int = 1
    ) -> None:
        self.code = code
        self.detail = detail
        self.exit_code = exit_code
        super().__init__(message)


class Broken(ClientError):
    """The connection broke: whether the daemon got the request is not known."""


class DaemonHttp:
    """A connection to one daemon; parameters and errors as of `mastctl.client.Client`.

    ``lease_id`` goes with each request; None for no lease.
    """

    def __init__(
        self,
        url: str,
        timeout_s: float,
        name: str | None = None,
        token: str | None = None,
    ) -> None:
        self.url = url
        self._token = token or os.environ.get("MASTCTL_TOKEN")
        if self._token and not (self._token.isascii() and self._token.isprintable()):
            raise ClientError("bad_token", "the token has characters that no token has", exit_code=2)
        self.timeout_s = timeout_s
        self.name = plain_name(name or program_name())
        self.lease_id: str | None = None
        self._http = self._opened_http()

    def beside(self, timeout_s: float) -> DaemonHttp:
        """Return another connection of the same program, under the same lease, for a thread of its own."""
        other = DaemonHttp(self.url, timeout_s, self.name, self._token)
        other.lease_id = self.lease_id
        return other

    def json(self, kind: type[T], method: str, path: str, within_s: float | None = None, **options: Any) -> T:
        """Send a request, and return the answer, a JSON object of a kind.

        ``within_s`` shortens the longest time of this request, seconds.
        """
        if within_s is not None:
            options["timeout"] = min(self.timeout_s, within_s)
        answer = self.request(method, path, **options)
        try:
            document = answer.json()
        except ValueError:
            document = None
        if not isinstance(document, dict):
            raise self.bad_answer("the answer is not a JSON object")
        return cast(T, document)

    def command(
        self,
        kind: type[T],
        method: str,
        path: str,
        body: Mapping[str, Any] | None = None,
        *,
        deadline_s: float | None = None,
        **options: Any,
    ) -> T:
        """Have something done once, and return the answer.

        Where the connection breaks the request is sent again with the same key, by which the daemon gives the
        first one's answer and does nothing twice.
        """
        headers = {"Idempotency-Key": secrets.token_hex(16)}
        if deadline_s is not None:
            headers["Deadline-S"] = repr(float(deadline_s))
        if body is not None:
            options["json"] = body
        for pause_s in AGAIN_S:
            try:
                return self.json(kind, method, path, headers=headers, **options)
            except Broken:
                time.sleep(pause_s)
        return self.json(kind, method, path, headers=headers, **options)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send a request, and return a good answer; everything else is a ClientError."""
        if self.lease_id is not None:
            options["headers"] = {"Mastctl-Lease": self.lease_id, **(options.get("headers") or {})}
        with self._failures(f"the daemon at {self.url} took the request but did not answer"):
            answer = self._http.request(method, PREFIX + path, **options)
        if answer.is_success:
            return answer
        raise self._refused(answer)

    def events(self, query: Mapping[str, Any]) -> Generator[dict[str, Any], None, None]:
        """Yield the events of the daemon's stream until it ends; ``timeout`` is raised if it falls silent."""
        with self._failures(f"the daemon at {self.url} fell silent"):
            request = self._http.build_request("GET", f"{PREFIX}/events", params=query)
            with closing(self._http.send(request, stream=True)) as answer:
                if not answer.is_success:
                    answer.read()
                    raise self._refused(answer)
                for line in answer.iter_lines():
                    if line.startswith("data:"):
                        yield self._event(line)

    def bad_answer(self, reason: str) -> ClientError:
        """Return the error of an answer that no daemon of this program gives."""
        return ClientError("bad_answer", f"the program at {self.url} is no mastctl daemon: {reason}")

    def no_daemon(self) -> ClientError:
        """Return the error of an address where no program listens."""
        return ClientError("no_daemon", f"no daemon answers at {self.url}; 'mastctl run' starts one")

    def _refused(self, answer: httpx.Response) -> ClientError:
        """What an answer says that is not a good one."""
        try:
            error = answer.json()["error"]
            code, message, detail = str(error["code"]), str(error["message"]), error.get("detail")
        except (ValueError, LookupError, TypeError, AttributeError):
            return self.bad_answer(f"it says {answer.status_code}, not in the way of this program")
        exit_code = 2 if answer.status_code in _BAD_INPUT else 1
        if code in ("no_token", "wrong_token"):
            shown = "the one in MASTCTL_TOKEN is unknown to it" if self._token else "MASTCTL_TOKEN holds none"
            message = (
                f"the daemon at {self.url} requires a token, and {shown}: 'mastctl rig token new' makes one"
            )
        return ClientError(code, message, detail if isinstance(detail, dict) else None, exit_code)

    def _event(self, line: str) -> dict[str, Any]:
        try:
            return dict(json.loads(line.removeprefix("data:")))
        except (ValueError, TypeError, RecursionError):
            raise self.bad_answer("an event of the stream is not JSON") from None

    @contextmanager
    def _failures(self, silent: str) -> Iterator[None]:
        """What a connection may meet, as ClientError."""
        import httpx

        try:
            yield
        except ValueError as error:  # numbers that JSON does not have
            raise ClientError("bad_request", f"the request cannot be sent: {error}", exit_code=2) from None
        except (httpx.ConnectError, httpx.ConnectTimeout):
            raise self.no_daemon() from None
        except httpx.TimeoutException:
            raise ClientError("timeout", silent) from None
        except httpx.HTTPError as error:
            raise Broken("no_daemon", f"the connection to {self.url} broke: {error}") from None

    @property
    def shown(self) -> dict[str, str]:
        """The headers by which the daemon knows this program."""
        shown = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        return {"Mastctl-Client": self.name, **shown}

    @property
    def socket_path(self) -> str | None:
        """Path of the daemon's Unix socket, if it has one."""
        if not self.url.startswith("unix:"):
            return None
        return unquote(self.url.removeprefix("unix:").removeprefix("//"))

    def _opened_http(self) -> httpx.Client:
        """Return the client of httpx. Raises ClientError ``bad_url``."""
        import httpx  # slow to load: it brings rich and click along where they are installed

        path = self.socket_path
        base = "http://localhost" if path is not None else self.url.rstrip("/")
        try:
            parts = urlsplit(base)
            if parts.scheme not in ("http", "https") or not parts.hostname or (parts.port or 1) < 1:
                raise ValueError
            # No proxy of the environment: the daemon is on this machine, or reached by a tunnel to it.
            return httpx.Client(
                base_url=base,
                timeout=self.timeout_s,
                headers=self.shown,
                trust_env=False,
                transport=None if path is None else httpx.HTTPTransport(uds=path),
                verify=ssl.create_default_context() if parts.scheme == "https" else False,
            )
        except (ValueError, httpx.InvalidURL):
            raise ClientError(
                "bad_url",
                f"'{self.url}' is no address of a daemon; http://127.0.0.1:8420 or unix:/path is expected",
                exit_code=2,
            ) from None

    def close(self) -> None:
        """Close the connection."""
        self._http.close()


def polled(request: Callable[[float], T], timeout_s: float) -> Iterator[T]:
    """Yield a value again and again, for some seconds.

    ``request`` returns it by a request that may take so many seconds. Its ClientError passes:
    ``operation_unknown`` if the daemon is another one, ``no_daemon`` if it is gone for longer than a
    connection takes to come back.
    """
    until_s = time.monotonic() + timeout_s
    pauses: list[float] = []  # a daemon that does not answer at the beginning is reported at once
    while True:
        try:
            yield request(max(until_s - time.monotonic(), LEAST_S))
            pauses = list(POLL_AGAIN_S)
            pause_s = POLL_S
        except ClientError as error:
            if error.code not in PASSING or not pauses:
                raise
            pause_s = pauses.pop(0)
        left_s = until_s - time.monotonic()
        if left_s <= 0.0:
            return
        time.sleep(min(pause_s, left_s))


def given(**values: Any) -> dict[str, Any]:
    """Return the values as JSON has them, without those that were left out (None)."""
    return {name: _plain(value) for name, value in values.items() if value is not None}


def _plain(value: Any) -> Any:
    """Lists of tuples and arrays, however deep; a whole number stays one, it may exceed a float's range."""
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    if hasattr(value, "tolist"):  # NumPy's, which need not be installed
        return value.tolist()
    return [_plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def escaped(name: str) -> str:
    """Return a name as a part of a path."""
    return quote(name, safe="")


def program_name() -> str:
    """Return the name of this process where none is given: ``program@host:pid``."""
    program = Path(sys.argv[0] if sys.argv else "")
    name = program.parent.name if program.stem == "__main__" else program.stem
    return f"{name or 'python'}@{socket.gethostname()}:{os.getpid()}"


def plain_name(name: str) -> str:
    """Return a name as a header can carry it."""
    return "".join(sign if sign.isascii() and sign.isprintable() else "?" for sign in name).strip() or "?"
