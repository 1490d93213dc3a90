"""A slow link on this machine: a port whose connections share a rate, and whose bytes take some time.

.venv/bin/python -m tools.throttle PORT [--kb-per-s 50] [--delay-s 0.4]
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Iterator

from tools.command import end, options

PIECE = 1460  # bytes, as in a packet
QUEUE = 1 << 22  # bytes that wait for the link in each direction, as in a modem that drops nothing


class ThrottledWay:
    """One direction of a link: bytes of all connections go one after the other."""

    def __init__(self, bytes_per_s: float, delay_s: float) -> None:
        self._bytes_per_s, self._delay_s = bytes_per_s, delay_s
        self._turn = asyncio.Lock()
        self._free_s = 0.0

    async def carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Carry one connection's bytes until it ends."""
        loop = asyncio.get_running_loop()
        arrivals: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(QUEUE // PIECE)
        delivery = loop.create_task(self._deliver(arrivals, writer))
        try:
            while data := await reader.read(PIECE):
                async with self._turn:
                    self._free_s = max(loop.time(), self._free_s) + len(data) / self._bytes_per_s
                    sent_s = self._free_s
                    await asyncio.sleep(sent_s - loop.time())
                await arrivals.put((sent_s + self._delay_s, data))
            await arrivals.put((loop.time() + self._delay_s, b""))
            await delivery
        except OSError:
            pass  # one end was closed at once; so is the other
        finally:
            delivery.cancel()
            writer.close()

    @staticmethod
    async def _deliver(arrivals: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        while True:
            at_s, data = await arrivals.get()
            await asyncio.sleep(at_s - loop.time())
            if not data:
                return
            writer.write(data)


async def serve(line: socket.socket, port: int, bytes_per_s: float, delay_s: float) -> None:
    """Carry what comes to a listening socket to a port of this machine and back, until cancelled."""
    out, back = ThrottledWay(bytes_per_s, delay_s), ThrottledWay(bytes_per_s, delay_s)

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, here = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            writer.close()
            return
        with contextlib.suppress(asyncio.CancelledError):  # a task of the server's that ends so is reported
            await asyncio.gather(out.carry(reader, here), back.carry(there, writer))

    async with await asyncio.start_server(connected, sock=line, limit=PIECE) as server:
        await server.serve_forever()


@contextlib.contextmanager
def throttled(port: int, bytes_per_s: float, delay_s: float) -> Iterator[int]:
    """A port that leads to another one of this machine over a slow link, inside the block.

    ``delay_s`` is that of each direction.
    """
    line = socket.create_server(("127.0.0.1", 0))
    loop = asyncio.new_event_loop()
    serving = loop.create_task(serve(line, port, bytes_per_s, delay_s))

    def run() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            loop.run_until_complete(serving)
        left = asyncio.all_tasks(loop)
        for task in left:
            task.cancel()
        loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
        loop.close()

    thread = threading.Thread(target=run, name="throttle")
    thread.start()
    try:
        yield int(line.getsockname()[1])
    finally:
        loop.call_soon_threadsafe(serving.cancel)
        thread.join()
        line.close()


def main() -> int:
    """Serve until Ctrl-C."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("port", type=int, help="where the daemon listens")
    parser.add_argument("--kb-per-s", type=float, default=50.0, help="each way, 1000 bytes")
    parser.add_argument("--delay-s", type=float, default=0.4, help="each way")
    asked = parser.parse_args()
    with throttled(asked.port, 1e3 * asked.kb_per_s, asked.delay_s) as port:
        print(f"http://127.0.0.1:{port}", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
    return 0


if __name__ == "__main__":
    end(main)
