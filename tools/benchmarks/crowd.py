"""Crowds of clients that ask a daemon for what costs it much, in one process, until they are ended.

    python -m tools.benchmarks.crowd LOAD PORT

A crowd's clients each ask again as soon as they have been answered; at the end it prints how often that was.
`stop_under_load` measures stops beside them.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
from collections import Counter
from collections.abc import Awaitable, Callable

from tools.command import end, options
from tools.living_daemon import Asker

CAMERA = "navcam_left"
READ_BYTES = 1 << 16
EVENTS_S = 0.05  # how long a client that comes again and again listens

Client = Callable[[int], Awaitable[None]]
ANSWERED: Counter[str] = Counter()


def main() -> int:
    """Be a crowd."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("load", choices=sorted(LOADS), help="which crowd")
    parser.add_argument("port", type=int, help="the daemon's")
    args = parser.parse_args()
    count, client = LOADS[args.load](args.port)
    asyncio.run(_crowd(args.port, count, client))
    print(ANSWERED.total())
    return 0


async def _crowd(port: int, count: int, client: Client) -> None:
    """Let clients ask until this process is ended."""
    everybody = asyncio.gather(*(_again(port, client) for _ in range(count)))
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, everybody.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await everybody


async def _again(port: int, client: Client) -> None:
    while True:
        try:
            await client(port)
        except (OSError, EOFError, asyncio.IncompleteReadError):  # it was refused, or left
            await asyncio.sleep(0.01)


def _request(path: str) -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()


def _asking(path: str) -> Client:
    """A client that asks on one connection for one thing."""
    request = _request(path)

    async def ask(port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        try:
            while True:
                writer.write(request)
                head = (await reader.readuntil(b"\r\n\r\n")).lower()
                length = head.split(b"content-length:")[1].split(b"\r\n")[0]
                await reader.readexactly(int(length))
                ANSWERED[path] += 1
                if b"connection: close" in head:
                    raise EOFError
        finally:
            writer.close()

    return ask


async def _coming_again(port: int) -> None:
    """Connect to the events, read the beginning, and leave."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(_request("/api/v1/events"))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(EVENTS_S):
                while await reader.read(READ_BYTES):
                    ANSWERED["events"] += 1
    finally:
        writer.close()


async def _stalled(port: int) -> None:
    """Ask for the events and read nothing until the daemon leaves."""
    line = socket.socket()
    line.setblocking(False)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    loop = asyncio.get_running_loop()
    try:
        await loop.sock_connect(line, ("127.0.0.1", port))
        await loop.sock_sendall(line, _request("/api/v1/events"))
        await asyncio.sleep(15.0)
    finally:
        line.close()


def _snapshots(port: int) -> tuple[int, Client]:
    with Asker(port, "crowd") as asker:
        _, headers, _ = asker.ask("GET", f"/snapshot/{CAMERA}")
    frame_id = headers["x-mastctl-frame-id"]
    return 60, _asking(f"/api/v1/snapshot/{CAMERA}?format=png&frame_id={frame_id}")


LOADS: dict[str, Callable[[int], tuple[int, Client]]] = {
    "snapshots": _snapshots,
    "events": lambda port: (60, _coming_again),
    "description": lambda port: (30, _asking("/openapi.json")),
    "stalled": lambda port: (150, _stalled),
}
"""Crowds by name: how many clients, and what one does."""


if __name__ == "__main__":
    end(main)
