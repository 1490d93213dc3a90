"""Questions to a daemon over HTTP; whatever goes wrong is a `ClientError`."""

from __future__ import annotations

import json
import os
import secrets
import socket
import ssl
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote, urlsplit

import httpx

T = TypeVar("T")

PREFIX = "/api/v1"
OWN_CERTIFICATE = "MASTCTL_CERTIFICATE"
"""Names the file of a daemon's own certificate, for a program that this daemon starts itself."""
AGAIN_S = (0.1, 0.5)  # pauses before a command goes out again on a new connection
_BAD_INPUT = frozenset({400, 404, 413, 415, 422})


class ClientError(Exception):
    """The daemon refused, failed, or did not answer.

    Attributes
    ----------
    code
        The daemon's word, or the client's own: ``no_daemon``, ``bad_url``, ``timeout``, ``bad_answer``.
    detail
        What else the daemon told, or None.
    exit_code
        What a command ends with: 2 for bad input, 1 for a failure.
    """

    def __init__(
        self, code: str, message: str, detail: Mapping[str, Any] | None = None, exit_code: int = 1
    ) -> None:
        self.code = code
        self.detail = detail
        self.exit_code = exit_code
        super().__init__(message)


def _trusted() -> ssl.SSLContext:
    """Whose certificates are taken: those of the machine, and of ``$MASTCTL_CA_FILE``. Raises ClientError."""
    own = os.environ.get(OWN_CERTIFICATE)
    if own:
        return _pinned(own)
    context = ssl.create_default_context()
    ca_file = os.environ.get("MASTCTL_CA_FILE")
    if ca_file:
        try:
            context.load_verify_locations(ca_file)
        except (OSError, ssl.SSLError) as error:
            words = f"MASTCTL_CA_FILE: {ca_file}: no certificates can be read ({error})"
            raise ClientError("bad_url", words, exit_code=2) from None
    return context


def _pinned(certificate: str) -> ssl.SSLContext:
    """Take one certificate and no other, whatever names it has. Raises ClientError."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    end = "-----END CERTIFICATE-----"
    try:
        first, found, _ = Path(certificate).read_text(encoding="ascii", errors="replace").partition(end)
        context.load_verify_locations(cadata=first + found)
    except (OSError, ssl.SSLError) as error:
        words = f"{OWN_CERTIFICATE}: {certificate}: no certificate can be read ({error})"
        raise ClientError("bad_url", words, exit_code=2) from None
    return context


class Broken(ClientError):
    """The connection broke: whether the daemon got the request is not known."""


class Connection:
    """A connection to one daemon, by whichever transport; parameters and errors as `Client` has them."""

    def __init__(self, url: str, timeout_s: float, name: str | None = None, token: str | None = None) -> None:
        self.url = url
        self._token = token or os.environ.get("MASTCTL_TOKEN")
        if self._token and not (self._token.isascii() and self._token.isprintable()):
            raise ClientError("bad_token", "the token has signs that no token has", exit_code=2)
        self.timeout_s = timeout_s
        self.name = plain_name(name or program_name())
        self.lease_id: str | None = None  # goes with whatever is asked

    def beside(self, timeout_s: float) -> DaemonHttp:
        """Return another connection of the same program, under the same lease."""
        other = DaemonHttp(self.url, timeout_s, self.name, self._token)
        other.lease_id = self.lease_id
        return other

    @property
    def _socket(self) -> str | None:
        """Path of the daemon's Unix socket, if it has one."""
        if not self.url.startswith("unix:"):
            return None
        return unquote(self.url.removeprefix("unix:").removeprefix("//"))

    def _made(self, kind: Callable[..., T], transport: object) -> T:
        """Make the client of httpx. Raises ClientError ``bad_url``."""
        base = "http://localhost" if self._socket is not None else self.url.rstrip("/")
        shown = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        try:
            parts = urlsplit(base)
            if parts.scheme not in ("http", "https") or not parts.hostname or (parts.port or 1) < 1:
                raise ValueError
            # No proxy of the environment: the daemon is on this machine, or reached by a tunnel to it.
            return kind(
                base_url=base,
                timeout=self.timeout_s,
                headers={"Mastctl-Client": self.name, **shown},
                trust_env=False,
                transport=transport,
                verify=_trusted() if parts.scheme == "https" else False,
            )
        except (ValueError, httpx.InvalidURL):
            raise ClientError(
                "bad_url",
                f"'{self.url}' is no address of a daemon; http://127.0.0.1:8420 or unix:/path is expected",
                exit_code=2,
            ) from None

    def refused(self, answer: httpx.Response) -> ClientError:
        """Return what an answer says that is not a good one."""
        try:
            told = answer.json()["error"]
            code, message, detail = str(told["code"]), str(told["message"]), told.get("detail")
        except (ValueError, LookupError, TypeError, AttributeError):
            return self.bad_answer(f"it says {answer.status_code}, not in the way of this program")
        exit_code = 2 if answer.status_code in _BAD_INPUT else 1
        return ClientError(code, message, detail if isinstance(detail, dict) else None, exit_code)

    def bad_answer(self, reason: str) -> ClientError:
        """Return the error of an answer that no daemon of this program gives."""
        return ClientError("bad_answer", f"what answers at {self.url} is no mastctl daemon: {reason}")

    @contextmanager
    def _failures(self, silent: str) -> Iterator[None]:
        """What a connection may meet, as ClientError."""
        try:
            yield
        except ValueError as error:  # numbers that JSON does not have
            raise ClientError("bad_request", f"the request cannot be sent: {error}", exit_code=2) from None
        except (httpx.ConnectError, httpx.ConnectTimeout):
            words = f"no daemon answers at {self.url}; 'mastctl run' starts one"
            raise ClientError("no_daemon", words) from None
        except httpx.TimeoutException:
            raise ClientError("timeout", silent) from None
        except httpx.HTTPError as error:
            raise Broken("no_daemon", f"the connection to {self.url} broke: {error}") from None

    def _document(self, answer: httpx.Response) -> dict[str, Any]:
        """Return what an answer holds, which must be a JSON object."""
        try:
            document = answer.json()
        except ValueError:
            document = None
        if not isinstance(document, dict):
            raise self.bad_answer("the answer is not a JSON object")
        return document

    def _leased(self, options: dict[str, Any]) -> dict[str, Any]:
        """Return a request's options with the lease in its headers."""
        if self.lease_id is None:
            return options
        return options | {"headers": {"Mastctl-Lease": self.lease_id, **(options.get("headers") or {})}}

    def _event(self, line: str) -> dict[str, Any] | None:
        """Return what a line of a stream tells, None for a sign of life."""
        if line.startswith(":"):
            return None
        try:
            return dict(json.loads(line.removeprefix("data:")))
        except (ValueError, TypeError):
            raise self.bad_answer("an event of the stream is not JSON") from None


class DaemonHttp(Connection):
    """A connection whose questions are waited for; parameters and errors as `Client` has them."""

    def __init__(self, url: str, timeout_s: float, name: str | None = None, token: str | None = None) -> None:
        super().__init__(url, timeout_s, name, token)
        transport = None if self._socket is None else httpx.HTTPTransport(uds=self._socket)
        self._http = self._made(httpx.Client, transport)

    def json(self, method: str, path: str, **options: Any) -> dict[str, Any]:
        """Ask, and return the answer, which must be a JSON object."""
        return self._document(self.ask(method, path, **options))

    def command(
        self,
        method: str,
        path: str,
        body: Mapping[str, Any] | None = None,
        *,
        key: str | None = None,
        deadline_s: float | None = None,
        **options: Any,
    ) -> dict[str, Any]:
        """Have something done once, and return the answer.

        Where the connection breaks it is asked again with the same key, by which the daemon gives the first
        one's answer and does nothing twice.
        """
        headers = _headers_of(key, deadline_s)
        if body is not None:
            options["json"] = body
        for pause_s in AGAIN_S:
            try:
                return self.json(method, path, headers=headers, **options)
            except Broken:
                time.sleep(pause_s)
        return self.json(method, path, headers=headers, **options)

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Ask, and return a good answer; everything else is a ClientError."""
        answer = self.send(method, PREFIX + path, **self._leased(options))
        if answer.is_success:
            return answer
        raise self.refused(answer)

    def send(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Ask for a path of the whole address, and return the answer whatever it is."""
        with self._failures(f"the daemon at {self.url} took the request but did not answer"):
            return self._http.request(method, path, **options)

    def heard(
        self, path: str, query: Mapping[str, Any] | None = None, silent_s: float | None = None
    ) -> Iterator[dict[str, Any] | None]:
        """Yield what a stream of the daemon tells, and None for each sign of life, until the daemon ends.

        ``timeout`` is raised if it is silent for ``silent_s`` seconds, those of each request by default.
        """
        with (
            self._failures(f"the daemon at {self.url} fell silent"),
            self._http.stream(
                "GET", PREFIX + path, params=query, timeout=silent_s or self.timeout_s
            ) as answer,
        ):
            if not answer.is_success:
                answer.read()
                raise self.refused(answer)
            for line in answer.iter_lines():
                if line.startswith((":", "data:")):
                    yield self._event(line)

    def events(self, path: str, query: Mapping[str, Any] | None = None) -> Iterator[dict[str, Any]]:
        """Yield what a stream of the daemon tells, until the daemon ends."""
        yield from (event for event in self.heard(path, query) if event is not None)

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()


def _headers_of(key: str | None, deadline_s: float | None) -> dict[str, str]:
    """The headers of a command: its key, a new one by default, and its deadline."""
    headers = {"Idempotency-Key": key or secrets.token_hex(16)}
    if deadline_s is not None:
        headers["Deadline-S"] = repr(float(deadline_s))
    return headers


def program_name() -> str:
    """Return what this process calls itself where it is told nothing else: ``program@host:pid``."""
    program = Path(sys.argv[0] if sys.argv else "")
    name = program.parent.name if program.stem == "__main__" else program.stem
    return f"{name or 'python'}@{socket.gethostname()}:{os.getpid()}"


def plain_name(name: str) -> str:
    """Return a name as a header can carry it."""
    return "".join(sign if sign.isascii() and sign.isprintable() else "?" for sign in name).strip() or "?"
