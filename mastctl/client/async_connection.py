"""Questions to a daemon over HTTP that others need not wait for: `mastctl.client.connection` for asyncio."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from typing import Any

import httpx

from mastctl.client.connection import AGAIN_S, PREFIX, Broken, Connection, _headers_of


class AsyncDaemonHttp(Connection):
    """A connection for asyncio; parameters and errors as `AsyncClient` has them."""

    def __init__(self, url: str, timeout_s: float, name: str | None = None, token: str | None = None) -> None:
        super().__init__(url, timeout_s, name, token)
        transport = None if self._socket is None else httpx.AsyncHTTPTransport(uds=self._socket)
        self._http = self._made(httpx.AsyncClient, transport)

    async def json(self, method: str, path: str, **options: Any) -> dict[str, Any]:
        """Ask, and return the answer, which must be a JSON object."""
        return self._document(await self.ask(method, path, **options))

    async def command(
        self,
        method: str,
        path: str,
        body: Mapping[str, Any] | None = None,
        *,
        key: str | None = None,
        deadline_s: float | None = None,
        **options: Any,
    ) -> dict[str, Any]:
        """Have something done once, and return the answer; as `DaemonHttp.command`."""
        headers = _headers_of(key, deadline_s)
        if body is not None:
            options["json"] = body
        for pause_s in AGAIN_S:
            try:
                return await self.json(method, path, headers=headers, **options)
            except Broken:
                await asyncio.sleep(pause_s)
        return await self.json(method, path, headers=headers, **options)

    async def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Ask, and return a good answer; everything else is a ClientError."""
        with self._failures(f"the daemon at {self.url} took the request but did not answer"):
            answer = await self._http.request(method, PREFIX + path, **self._leased(options))
        if answer.is_success:
            return answer
        raise self.refused(answer)

    async def heard(
        self, path: str, query: Mapping[str, Any] | None = None, silent_s: float | None = None
    ) -> AsyncIterator[dict[str, Any] | None]:
        """Yield what a stream of the daemon tells; as `DaemonHttp.heard`."""
        with self._failures(f"the daemon at {self.url} fell silent"):
            async with self._http.stream(
                "GET", PREFIX + path, params=query, timeout=silent_s or self.timeout_s
            ) as answer:
                if not answer.is_success:
                    await answer.aread()
                    raise self.refused(answer)
                async for line in answer.aiter_lines():
                    if line.startswith((":", "data:")):
                        yield self._event(line)

    async def events(
        self, path: str, query: Mapping[str, Any] | None = None
    ) -> AsyncIterator[dict[str, Any]]:
        """Yield what a stream of the daemon tells, until the daemon ends."""
        async for event in self.heard(path, query):
            if event is not None:
                yield event

    async def close(self) -> None:
        """Let go of the connection."""
        await self._http.aclose()
