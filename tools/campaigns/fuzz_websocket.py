"""Send a daemon's WebSocket what no client sends, many at a time, and see that it costs nobody anything.

    .venv/bin/python -m tools.campaigns.fuzz_websocket --minutes 10

Each attack is a connection of its own: a wrong or half handshake, noise, frames with flipped bits, frames
that promise gigabytes, texts without an end, pings whose answers nobody reads, closings of any kind, silence.
A daemon with the simulated rover must go on to answer its status and stops, log no error, and have forgotten
every attacker afterwards. Frames are made here by RFC 6455 and not by a library.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import random
import resource
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import urlsplit

from mastctl.cli.output import positive_number
from mastctl.client import Client
from tools.arguments import end
from tools.campaigns.fuzz_http import simulated_daemon

AT_ONCE = 8
FLOOD = 4000
ATTACK_S = 2.0  # of one that waits for an end
ANSWER_S = 20.0
KEY = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
VERSION = "Sec-WebSocket-Version: 13"
UPGRADE = "Upgrade: websocket\r\nConnection: Upgrade"

Attack = Callable[[random.Random, socket.socket], None]


def frame(
    opcode: int, data: bytes, *, last: bool = True, masked: bool = True, told_bytes: int | None = None
) -> bytes:
    """A frame of RFC 6455, 5.2; it may tell another length than it has."""
    size = len(data) if told_bytes is None else told_bytes
    head = bytes([opcode | (0x80 if last else 0)])
    flag = 0x80 if masked else 0
    if size < 126:
        head += bytes([flag | size])
    elif size < 65536:
        head += bytes([flag | 126]) + struct.pack("!H", size)
    else:
        head += bytes([flag | 127]) + struct.pack("!Q", size)
    return head + (b"\x00\x00\x00\x00" if masked else b"") + data


def shake(line: socket.socket, path: str = "/api/v1/events", headers: str = f"{KEY}\r\n{VERSION}") -> None:
    """Ask for a WebSocket."""
    told = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{UPGRADE}\r\n{headers}\r\n\r\n"
    line.sendall(told.encode("latin-1"))


def opened(line: socket.socket, path: str = "/api/v1/events") -> None:
    """Ask for a WebSocket, and read the answer."""
    shake(line, path)
    got = b""
    while b"\r\n\r\n" not in got:
        got += line.recv(4096) or b"\r\n\r\n"


def drain(line: socket.socket) -> None:
    """Read until the daemon closes, or for a while."""
    until_s = time.monotonic() + ATTACK_S
    while time.monotonic() < until_s and line.recv(65536):
        pass


def wrong_handshake(rng: random.Random, line: socket.socket) -> None:
    """A handshake that is none."""
    headers = [KEY, VERSION, "Content-Length: 5", "Transfer-Encoding: chunked", "Origin: http://evil.example"]
    headers += ["Sec-WebSocket-Key: short", "Sec-WebSocket-Version: 99", "Sec-WebSocket-Extensions: ;;;,"]
    headers += ["Sec-WebSocket-Protocol: \xff", "Connection: close", "X: " + "y" * rng.choice((10, 9000))]
    headers += [f"X-{number}: y" for number in range(rng.choice((0, 150)))]
    path = rng.choice(
        ("/api/v1/events", "/api/v1/events?topics=x", "/api/v1/status", "/%00", "/api/v1/events/")
    )
    shake(line, path, "\r\n".join(rng.sample(headers, rng.randrange(1, len(headers)))))
    line.sendall(rng.randbytes(rng.randrange(200)))
    drain(line)


def half_handshake(rng: random.Random, line: socket.socket) -> None:
    """A handshake that stops in the middle."""
    told = f"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\n{UPGRADE}\r\n{KEY}\r\n{VERSION}\r\n\r\n"
    line.sendall(told.encode()[: rng.randrange(len(told))])


def noise(rng: random.Random, line: socket.socket) -> None:
    """Bytes."""
    opened(line)
    line.sendall(rng.randbytes(rng.randrange(1, 3000)))
    drain(line)


def broken_frames(rng: random.Random, line: socket.socket) -> None:
    """Frames of any opcode with flipped bits."""
    opened(line)
    for _ in range(rng.randrange(1, 20)):
        data = rng.randbytes(rng.choice((0, 1, 2, 125, 126, 1000)))
        one = bytearray(frame(rng.randrange(16), data, last=rng.random() < 0.7, masked=rng.random() < 0.8))
        if rng.random() < 0.5:
            one[rng.randrange(len(one))] ^= 1 << rng.randrange(8)
        line.sendall(bytes(one))
    drain(line)


def huge(rng: random.Random, line: socket.socket) -> None:
    """A frame that promises much, and some of it."""
    opened(line)
    size = rng.choice((1025, 65536, 1 << 31, (1 << 63) - 1, (1 << 64) - 1))
    line.sendall(frame(rng.choice((1, 2)), b"", told_bytes=size))
    with contextlib.suppress(OSError):
        for _ in range(50):
            line.sendall(bytes(65536))
    drain(line)


def endless_text(rng: random.Random, line: socket.socket) -> None:
    """A text in pieces, which never ends."""
    opened(line)
    line.sendall(frame(1, b"", last=False))
    for _ in range(FLOOD):
        line.sendall(frame(0, b"", last=False))


def pings(rng: random.Random, line: socket.socket) -> None:
    """Pings as fast as they go, whose answers nobody reads."""
    opened(line)
    many = frame(rng.choice((9, 10)), bytes(125)) * 100
    for _ in range(FLOOD // 100):
        line.sendall(many)
    time.sleep(0.1 * rng.random())


def closings(rng: random.Random, line: socket.socket) -> None:
    """Closings of any kind, then more."""
    opened(line)
    code = rng.choice((0, 999, 1000, 1005, 1006, 1015, 3000, 4999, 65535))
    line.sendall(frame(8, rng.choice((b"", b"\x03", struct.pack("!H", code) + rng.randbytes(20)))))
    line.sendall(frame(9, b"more") * 20)
    drain(line)


def silence(rng: random.Random, line: socket.socket) -> None:
    """Nobody reads, nobody writes, and then the client is gone."""
    opened(line)
    time.sleep(0.2 * rng.random())


ATTACKS: tuple[Attack, ...] = (
    *(wrong_handshake, half_handshake, noise, broken_frames, huge, endless_text, pings, closings, silence),
)


def attack(url: str, seed: int) -> str:
    """Carry out one attack and return its name."""
    rng = random.Random(seed)
    one = ATTACKS[seed % len(ATTACKS)]
    parts = urlsplit(url)
    with (
        socket.create_connection((parts.hostname, parts.port or 0), timeout=ATTACK_S) as line,
        contextlib.suppress(OSError),  # the daemon had enough
    ):
        one(rng, line)
    return one.__name__


class Errors(logging.Handler):
    """What the daemon logs that is no mere warning."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.told: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.told.append(self.format(record))


def campaign(url: str, first: int, cases: int, pool: ThreadPoolExecutor) -> Counter[str]:
    """Carry out attacks, several at a time; the daemon must answer a status and a stop after them."""
    done = Counter(pool.map(lambda seed: attack(url, seed), range(first, first + cases)))
    with Client(url, timeout_s=ANSWER_S) as client:
        client.status()
        client.stop()
    return done


def held() -> tuple[float, int]:
    """Resident megabytes and open descriptors of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6, len(list(Path("/proc/self/fd").iterdir()))


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description="Send a daemon's WebSocket what no client sends.")
    parser.add_argument("--minutes", type=positive_number, default=10.0, help="how long (default 10)")
    parser.add_argument("--seed", type=int, default=1, help="of the first attack (default 1)")
    args = parser.parse_args()
    errors = Errors()
    logging.getLogger().addHandler(errors)
    counts: Counter[str] = Counter()
    with simulated_daemon() as url, ThreadPoolExecutor(AT_ONCE) as pool:
        counts += campaign(url, args.seed, 200, pool)
        before, until_s = held(), time.monotonic() + 60.0 * args.minutes
        while time.monotonic() < until_s:
            counts += campaign(url, args.seed + counts.total(), 200, pool)
        time.sleep(2.0 * ATTACK_S)
        after = held()
    told = {"attacks": dict(counts), "rss_mb": [before[0], after[0]], "descriptors": [before[1], after[1]]}
    sys.stdout.write(json.dumps(told | {"errors": errors.told[:5]}) + "\n")
    return int(bool(errors.told) or after[0] - before[0] > 20.0 or after[1] > before[1] + 8)


if __name__ == "__main__":
    end(main)
