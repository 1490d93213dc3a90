"""Ask a daemon all that its /openapi.json allows and much that it does not; attack its WebSocket.

    .venv/bin/python -m tools.campaigns.fuzz_daemon http --minutes 10
    .venv/bin/python -m tools.campaigns.fuzz_daemon websocket --minutes 10

``http``: a daemon of its own with the simulated rover is asked by schemathesis: all its checks (no 5xx;
status, kind, form and headers as described; what is wrong is refused) but one. That every body which fits the
form is accepted cannot hold: which keys go together (exactly one target), what is in reach and which ids
there are stands in no form. Left out are the two endless event streams (/events, /track/stream) and
/health/ready, whose 503 is an answer. What is asked at random latches emergency stops, takes leases and sets
faults, for which nearly all that follows would be refused: they are taken back twice a second. For a third of
the time it asks as who holds the lease, with bodies that fit the form, so that commands are carried out too.
Exit code 1 if anything was found.

``websocket``: each attack is a connection of its own: a wrong or half handshake, noise, frames with flipped
bits, frames that promise gigabytes, texts without an end, pings whose answers nobody reads, closings of any
kind, silence. A daemon with the simulated rover must go on to answer its status and stops, log no error, and
have forgotten every attacker afterwards. Frames are made here by RFC 6455 and not by a library.
"""

from __future__ import annotations

import contextlib
import json
import logging
import random
import resource
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

from mastctl.client import Client, ClientError
from mastctl.config import Listen, load_config
from mastctl.control.lease import LONGEST_S
from mastctl.daemon import RunningDaemon
from mastctl.http import PREFIX
from tools.command import end, options

LEFT_OUT = ("positive_data_acceptance",)
UNASKED = f"^{PREFIX}/(events|track/stream|health/ready)$"
UNASKED_AS_HOLDER = f"^{PREFIX}/(events|track/stream|health/ready|stop|estop|lease.*)$"
DEADLINE_S = 20.0
TAKEN_BACK_EACH_S = 0.5


@contextlib.contextmanager
def simulated_daemon() -> Iterator[str]:
    """A daemon with the simulated rover on a free port; its address."""
    config = replace(load_config(), listen=Listen(port=0))
    with RunningDaemon(config) as daemon:
        yield daemon.url


def ask(url: str, seconds: float | None, examples: int, seed: int | None = None) -> int:
    """Have schemathesis ask, as anybody and as who steers; return its exit code, its words go to stdout.

    With ``seconds`` None each route is asked ``examples`` times as anybody and as who steers, and no more.
    """
    common = ["--max-examples", str(examples), *(() if seed is None else ("--seed", str(seed)))]
    phases = "examples,fuzzing" if seconds is None else "examples,coverage,fuzzing"
    with taken_back(url):
        anybody = ["--exclude-path-regex", UNASKED, "--phases", phases]
        code = _asked(url, None if seconds is None else 2.0 / 3.0 * seconds, [*anybody, *common])
    if code != 0:
        return code
    with Client(url, name="holder") as client:
        lease = client.acquire_lease(for_s=LONGEST_S, take_over="the campaign goes on")["lease_id"]
    holder = ["--exclude-path-regex", UNASKED_AS_HOLDER, "--phases", "fuzzing", "--mode", "positive"]
    headers = ["--header", f"Mastctl-Lease: {lease}", "--header", f"Deadline-S: {DEADLINE_S:g}"]
    return _asked(url, None if seconds is None else seconds / 3.0, [*holder, *headers, *common])


def _asked(url: str, seconds: float | None, options: Sequence[str]) -> int:
    command = [
        *(str(Path(sys.executable).with_name("schemathesis")), "run", f"{url}/openapi.json", "--no-color"),
        *("--checks", "all", "--exclude-checks", ",".join(LEFT_OUT)),
        *(() if seconds is None else ("--max-time", f"{seconds:.0f}")),
        *("--request-timeout", "60", "--warnings", "off", *options),
    ]
    with tempfile.TemporaryDirectory() as folder:  # it leaves a folder where it runs
        return subprocess.run(command, cwd=folder, text=True, check=False).returncode


@contextlib.contextmanager
def taken_back(url: str) -> Iterator[None]:
    """Take back again and again, inside the block, what has commands refused."""
    over = threading.Event()

    def work() -> None:
        with Client(url, name="taken-back") as client:
            while not over.wait(TAKEN_BACK_EACH_S):
                for take_back in (
                    lambda: client.reset(reason="the campaign goes on", name="taken-back"),
                    lambda: client.use_lease(client.acquire_lease(take_over="it goes on")["lease_id"]),
                    client.release_lease,
                    client.clear_faults,
                ):
                    with contextlib.suppress(ClientError):  # nothing was latched; no simulated rover
                        take_back()

    thread = threading.Thread(target=work, name="taken back", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


# The WebSocket

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


class LoggedErrors(logging.Handler):
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
    """Ask or attack; 1 if anything was found."""
    parser = options(__doc__, seed=None, minutes=10.0, tasks=False)
    parser.add_argument("of", choices=("http", "websocket"))
    parser.add_argument("--examples", type=int, default=100000, help="http: at most for each route")
    parser.add_argument("--seed", type=int, help="http: of an earlier run; websocket: of the first attack")
    args = parser.parse_args()
    with simulated_daemon() as url:
        if args.of == "http":
            return ask(url, 60.0 * args.minutes, args.examples, args.seed)
        return attacked(url, 60.0 * args.minutes, 1 if args.seed is None else args.seed)


def attacked(url: str, seconds: float, first: int) -> int:
    """Attack for so long and print what it cost; 1 if an error was logged, or something is still held."""
    errors = LoggedErrors()
    logging.getLogger().addHandler(errors)
    counts: Counter[str] = Counter()
    with ThreadPoolExecutor(AT_ONCE) as pool:
        counts += campaign(url, first, 200, pool)
        before, until_s = held(), time.monotonic() + seconds
        while time.monotonic() < until_s:
            counts += campaign(url, first + counts.total(), 200, pool)
        time.sleep(2.0 * ATTACK_S)
        after = held()
    told = {"attacks": dict(counts), "rss_mb": [before[0], after[0]], "descriptors": [before[1], after[1]]}
    sys.stdout.write(json.dumps(told | {"errors": errors.told[:5]}) + "\n")
    return int(bool(errors.told) or after[0] - before[0] > 20.0 or after[1] > before[1] + 8)


if __name__ == "__main__":
    end(main)
