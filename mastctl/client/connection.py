"""Questions to a daemon over HTTP; every failure is a `ClientError`.

Questions, their number, and the meaning of an answer stand once, in `DaemonConnection`, which waits for
nothing itself. Of the two that send, `DaemonHttp` has the calling thread wait, and `AsyncDaemonHttp` asyncio.
"""

from __future__ import annotations

import asyncio
import json
import os
import secrets
import socket
import ssl
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast
from urllib.parse import unquote, urlsplit

if TYPE_CHECKING:
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
        Further facts from the daemon, or None.
    exit_code
        The exit code of a command: 2 for bad input, 1 for a failure.
    """

    def __init__(
        self, code: str, message: str, detail: Mapping[str, Any] | None = None, exit_code: int = 1
    ) -> None:
        self.code = code
        self.detail = detail
        self.exit_code = exit_code
        super().__init__(message)


def trusted() -> ssl.SSLContext:
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


class DaemonConnection(ABC):
    """A connection to one daemon by either transport; parameters and errors as of `mastctl.client.Client`.

    Attributes
    ----------
    lease_id
        Goes with whatever is asked; None for no lease.
    """

    def __init__(self, url: str, timeout_s: float, name: str | None = None, token: str | None = None) -> None:
        self.url = url
        self._token = token or os.environ.get("MASTCTL_TOKEN")
        if self._token and not (self._token.isascii() and self._token.isprintable()):
            raise ClientError("bad_token", "the token has characters that no token has", exit_code=2)
        self.timeout_s = timeout_s
        self.name = plain_name(name or program_name())
        self.lease_id: str | None = None

    def beside(self, timeout_s: float) -> DaemonHttp:
        """Return another connection of the same program, under the same lease, for a thread of its own."""
        other = DaemonHttp(self.url, timeout_s, self.name, self._token)
        other.lease_id = self.lease_id
        return other

    async def json(self, kind: type[T], method: str, path: str, **options: Any) -> T:
        """Ask, and return the answer, a JSON object of a kind."""
        answer = await self.ask(method, path, **options)
        try:
            document = answer.json()
        except ValueError:
            document = None
        if not isinstance(document, dict):
            raise self.bad_answer("the answer is not a JSON object")
        return cast(T, document)

    async def command(
        self,
        kind: type[T],
        method: str,
        path: str,
        body: Mapping[str, Any] | None = None,
        *,
        key: str | None = None,
        deadline_s: float | None = None,
        **options: Any,
    ) -> T:
        """Have something done once, and return the answer.

        Where the connection breaks it is asked again with the same key, by which the daemon gives the first
        one's answer and does nothing twice.
        """
        headers = _headers_of(key, deadline_s)
        if body is not None:
            options["json"] = body
        for pause_s in AGAIN_S:
            try:
                return await self.json(kind, method, path, headers=headers, **options)
            except Broken:
                await self.pause(pause_s)
        return await self.json(kind, method, path, headers=headers, **options)

    async def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Ask, and return a good answer; everything else is a ClientError."""
        if self.lease_id is not None:
            options["headers"] = {"Mastctl-Lease": self.lease_id, **(options.get("headers") or {})}
        answer = await self.send(method, PREFIX + path, **options)
        if answer.is_success:
            return answer
        raise self._refused(answer)

    async def send(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Ask for a path of the whole address, and return the answer whatever it is."""
        with self._failures(f"the daemon at {self.url} took the request but did not answer"):
            return await self._request(method, path, options)

    async def heard(
        self, path: str, query: Mapping[str, Any] | None = None, silent_s: float | None = None
    ) -> AsyncGenerator[dict[str, Any] | None]:
        """Yield a stream's messages, and None for each sign of life, until the daemon ends.

        ``timeout`` is raised if it is silent for ``silent_s`` seconds, those of each request by default.
        """
        with self._failures(f"the daemon at {self.url} fell silent"):
            answer = await self._opened(PREFIX + path, query, silent_s or self.timeout_s)
            try:
                if not answer.is_success:
                    await self._read(answer)
                    raise self._refused(answer)
                async for line in self._lines(answer):
                    if line.startswith((":", "data:")):
                        yield self._event(line)
            finally:
                await self._closed(answer)

    def bad_answer(self, reason: str) -> ClientError:
        """Return the error of an answer that no daemon of this program gives."""
        return ClientError("bad_answer", f"the program at {self.url} is no mastctl daemon: {reason}")

    def _refused(self, answer: httpx.Response) -> ClientError:
        """What an answer says that is not a good one."""
        try:
            told = answer.json()["error"]
            code, message, detail = str(told["code"]), str(told["message"]), told.get("detail")
        except (ValueError, LookupError, TypeError, AttributeError):
            return self.bad_answer(f"it says {answer.status_code}, not in the way of this program")
        exit_code = 2 if answer.status_code in _BAD_INPUT else 1
        return ClientError(code, message, detail if isinstance(detail, dict) else None, exit_code)

    def _event(self, line: str) -> dict[str, Any] | None:
        """What a line of a stream tells, None for a sign of life."""
        if line.startswith(":"):
            return None
        try:
            return dict(json.loads(line.removeprefix("data:")))
        except (ValueError, TypeError):
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
            words = f"no daemon answers at {self.url}; 'mastctl run' starts one"
            raise ClientError("no_daemon", words) from None
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

    def _made(self, kind: Callable[..., T], transport: Callable[..., object]) -> T:
        """Make the client of httpx. Raises ClientError ``bad_url``."""
        import httpx

        path = self.socket_path
        base = "http://localhost" if path is not None else self.url.rstrip("/")
        try:
            parts = urlsplit(base)
            if parts.scheme not in ("http", "https") or not parts.hostname or (parts.port or 1) < 1:
                raise ValueError
            # No proxy of the environment: the daemon is on this machine, or reached by a tunnel to it.
            return kind(
                base_url=base,
                timeout=self.timeout_s,
                headers=self.shown,
                trust_env=False,
                transport=None if path is None else transport(uds=path),
                verify=trusted() if parts.scheme == "https" else False,
            )
        except (ValueError, httpx.InvalidURL):
            raise ClientError(
                "bad_url",
                f"'{self.url}' is no address of a daemon; http://127.0.0.1:8420 or unix:/path is expected",
                exit_code=2,
            ) from None

    # What waits

    @abstractmethod
    async def _request(self, method: str, path: str, options: Mapping[str, Any]) -> httpx.Response: ...

    @abstractmethod
    async def _opened(
        self, path: str, query: Mapping[str, Any] | None, silent_s: float
    ) -> httpx.Response: ...

    @abstractmethod
    async def _read(self, answer: httpx.Response) -> None: ...

    @abstractmethod
    def _lines(self, answer: httpx.Response) -> AsyncIterator[str]: ...

    @abstractmethod
    async def _closed(self, answer: httpx.Response) -> None: ...

    @abstractmethod
    async def pause(self, seconds: float) -> None:
        """Wait for some seconds."""

    @abstractmethod
    async def away(self, work: Callable[[], T]) -> T:
        """Return what a function returns that waits for a thread."""

    @abstractmethod
    async def close(self) -> None:
        """Let go of the connection."""


class DaemonHttp(DaemonConnection):
    """A connection whose questions the calling thread waits for: its coroutines are `finished` at once."""

    def __init__(self, url: str, timeout_s: float, name: str | None = None, token: str | None = None) -> None:
        super().__init__(url, timeout_s, name, token)
        import httpx  # slow to load: it brings rich and click along where they are installed

        self._http = self._made(httpx.Client, httpx.HTTPTransport)

    async def _request(self, method: str, path: str, options: Mapping[str, Any]) -> httpx.Response:
        return self._http.request(method, path, **options)

    async def _opened(self, path: str, query: Mapping[str, Any] | None, silent_s: float) -> httpx.Response:
        request = self._http.build_request("GET", path, params=query, timeout=silent_s)
        return self._http.send(request, stream=True)

    async def _read(self, answer: httpx.Response) -> None:
        answer.read()

    async def _lines(self, answer: httpx.Response) -> AsyncIterator[str]:
        for line in answer.iter_lines():
            yield line

    async def _closed(self, answer: httpx.Response) -> None:
        answer.close()

    async def pause(self, seconds: float) -> None:
        time.sleep(seconds)

    async def away(self, work: Callable[[], T]) -> T:
        return work()

    async def close(self) -> None:
        self._http.close()


class AsyncDaemonHttp(DaemonConnection):
    """A connection whose questions are waited for by asyncio."""

    def __init__(self, url: str, timeout_s: float, name: str | None = None, token: str | None = None) -> None:
        super().__init__(url, timeout_s, name, token)
        import httpx

        self._http = self._made(httpx.AsyncClient, httpx.AsyncHTTPTransport)

    async def _request(self, method: str, path: str, options: Mapping[str, Any]) -> httpx.Response:
        return await self._http.request(method, path, **options)

    async def _opened(self, path: str, query: Mapping[str, Any] | None, silent_s: float) -> httpx.Response:
        request = self._http.build_request("GET", path, params=query, timeout=silent_s)
        return await self._http.send(request, stream=True)

    async def _read(self, answer: httpx.Response) -> None:
        await answer.aread()

    def _lines(self, answer: httpx.Response) -> AsyncIterator[str]:
        return answer.aiter_lines()

    async def _closed(self, answer: httpx.Response) -> None:
        await answer.aclose()

    async def pause(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def away(self, work: Callable[[], T]) -> T:
        return await asyncio.to_thread(work)

    async def close(self) -> None:
        await self._http.aclose()


def finished(work: Awaitable[T]) -> T:
    """Return what a coroutine returns that has the calling thread wait wherever it waits, as those of a
    `DaemonHttp` do.
    """
    steps: Generator[Any, Any, T] = work.__await__()
    try:
        steps.send(None)
    except StopIteration as end:
        return cast(T, end.value)
    steps.close()
    raise RuntimeError("a question that this thread should have waited for waits for an event loop")


def iterated(stream: AsyncGenerator[T]) -> Iterator[T]:
    """Yield what such an asynchronous generator yields."""
    try:
        while True:
            try:
                value = finished(anext(stream))
            except StopAsyncIteration:
                return
            yield value
    finally:
        finished(stream.aclose())


def _headers_of(key: str | None, deadline_s: float | None) -> dict[str, str]:
    """The headers of a command: its key, a new one by default, and its deadline."""
    headers = {"Idempotency-Key": key or secrets.token_hex(16)}
    if deadline_s is not None:
        headers["Deadline-S"] = repr(float(deadline_s))
    return headers


def program_name() -> str:
    """Return the name of this process where none is given: ``program@host:pid``."""
    program = Path(sys.argv[0] if sys.argv else "")
    name = program.parent.name if program.stem == "__main__" else program.stem
    return f"{name or 'python'}@{socket.gethostname()}:{os.getpid()}"


def plain_name(name: str) -> str:
    """Return a name as a header can carry it."""
    return "".join(sign if sign.isascii() and sign.isprintable() else "?" for sign in name).strip() or "?"
