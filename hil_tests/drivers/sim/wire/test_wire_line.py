"""The simulated line as a plain pyserial host sees it through a kernel; what each fault does to replies."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
import serial

from drivers.clock import ManualClock, SystemClock
from drivers.faults import PAN_TILT, FaultPanel
from drivers.sim.wire.carrier import LineFaults, Reply
from drivers.sim.wire.line import PtyLine, TcpLine
from hil_tests.left_behind import held
from hil_tests.waiting import NET_S


class Parrot:
    """Answers every line of text with the same line; after ``!`` it speaks by itself."""

    def __init__(self, baud: int = 115200) -> None:
        self.baud = baud
        self.heard = b""
        self._unasked: list[Reply] = []

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        self.heard += data
        *lines, self.heard = self.heard.split(b"\n")
        if b"!" in lines:
            self._unasked.append(Reply(b"?\n"))
        return [Reply(line + b"\n", sender=line[:1].isdigit() and int(line[:1])) for line in lines]

    def poll(self, time_s: float) -> Sequence[Reply]:
        unasked, self._unasked = self._unasked, []
        return unasked


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    before = held()
    yield
    assert held() <= before


def ask(host: serial.Serial, text: bytes, lines: int = 1) -> bytes:
    host.write(text)
    return b"".join(host.read_until(b"\n") for _ in range(lines))


def test_every_byte_value_passes_unchanged() -> None:
    every = bytes(byte for byte in range(256) if byte != 10)
    with PtyLine(Parrot(), SystemClock()) as line, serial.Serial(line.path, 115200, timeout=NET_S) as host:
        assert ask(host, every + b"\n") == every + b"\n"


def test_the_link_is_made_gone_while_hung_up_and_removed(tmp_path: Path) -> None:
    link = tmp_path / "tty"
    link.symlink_to("/dev/pts/99999")  # left by one that was killed
    with PtyLine(Parrot(), SystemClock(), link=link) as line:
        assert line.path == str(link) and link.resolve().parent == Path("/dev/pts")
        with serial.Serial(str(link), 115200, timeout=NET_S) as host:
            line.hang_up()
            assert not link.is_symlink()
            with pytest.raises(serial.SerialException):
                host.write(b"x\n")
        line.come_back()
        with serial.Serial(str(link), 115200, timeout=NET_S) as host:
            assert ask(host, b"again\n") == b"again\n"
    assert not link.is_symlink()


def test_tcp_greets_and_serves_one_host_at_a_time() -> None:
    with (
        TcpLine(Parrot(), SystemClock(), banner=b"hello\n") as line,
        socket.create_connection((line.host, line.port), NET_S) as host,
    ):
        assert host.recv(100) == b"hello\n"
        with socket.create_connection((line.host, line.port), NET_S) as other:
            assert other.recv(100) == b"", "taken"
        host.sendall(b"one\n")
        assert host.recv(100) == b"one\n"


def test_tcp_hangs_up_and_comes_back_at_the_same_port() -> None:
    with TcpLine(Parrot(), SystemClock()) as line:
        url = f"socket://127.0.0.1:{line.port}"
        with serial.serial_for_url(url, timeout=NET_S) as host:
            assert ask(host, b"one\n") == b"one\n"
            line.hang_up()
            with pytest.raises(serial.SerialException):
                host.read(1)
        with pytest.raises(serial.SerialException):
            serial.serial_for_url(url, timeout=0.1)
        line.come_back()
        with serial.serial_for_url(url, timeout=NET_S) as host:
            assert ask(host, b"two\n") == b"two\n"


class Replies:
    """Replies through the faults of a line, on a clock that stands still."""

    def __init__(self) -> None:
        self.clock = ManualClock(10.0)
        self.panel = FaultPanel(self.clock.now_s, ())
        self._faults = LineFaults(self.panel)

    def sent(self, *texts: bytes) -> list[bytes]:
        replies = [Reply(text, sender=place) for place, text in enumerate(texts, 1)]
        return [one.data for one in self._faults.apply(replies, self.clock.now_s())]


@pytest.fixture
def replies() -> Replies:
    return Replies()


def test_mute_falls_on_so_many_replies_and_is_over(replies: Replies) -> None:
    replies.panel.set(PAN_TILT, "mute", replies=3)
    assert [replies.sent(b"x") for _ in range(5)] == [[], [], [], [b"x"], [b"x"]]
    assert replies.panel.active() == ()


def test_a_fault_can_be_of_one_sender_only(replies: Replies) -> None:
    replies.panel.set(PAN_TILT, "mute", replies=2, sender=2)
    assert [replies.sent(b"one", b"two") for _ in range(3)] == [[b"one"], [b"one"], [b"one", b"two"]]


def test_corrupt_changes_one_byte(replies: Replies) -> None:
    replies.panel.set(PAN_TILT, "corrupt", replies=50, seed=3)
    for _ in range(50):
        (data,) = replies.sent(b"0123456789")
        assert len(data) == 10 and sum(a != b for a, b in zip(data, b"0123456789", strict=True)) == 1
    assert replies.sent(b"0123456789") == [b"0123456789"]


def test_swapped_replies_change_places_in_one_exchange_or_over_two(replies: Replies) -> None:
    replies.panel.set(PAN_TILT, "swapped")
    assert replies.sent(b"one", b"two", b"three") == [b"two", b"one", b"three"]
    replies.panel.set(PAN_TILT, "swapped")
    assert replies.sent(b"one") == []
    assert replies.sent(b"two") == [b"two", b"one"]
