"""What is a VISCA head's own: frames, refusals, late and damaged replies, and the way over UDP.

What every head has to do is in test_head_contract.py. The frames are those of the package visca-over-ip
0.5.2, but for the stop, whose speeds are 0 there.
"""

from __future__ import annotations

import math
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

from drivers.clock import SystemClock
from drivers.errors import (
    BadOptions,
    BadReply,
    DriverError,
    LineLost,
    NoReply,
    OutOfRange,
    Refused,
    WrongDevice,
)
from drivers.faults import FaultPanel
from drivers.sim.heads import AxisSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.memory_line import MemoryLine
from drivers.sim.wire.visca import SimulatedVisca
from drivers.simulation_clock import SimulationClock
from drivers.visca import protocol
from drivers.visca.head import ViscaHead, halt, open_head
from drivers.visca.options import options_from
from hil_tests.drivers.turned import START_S, Turned
from hil_tests.waiting import until

COUNT_RAD = math.radians(0.075)
GO, STOP, ASK = "81 01 06 02 05 07 0f 0e 0d 04 00 04 0d 02 ff", "81 01 06 01 01 01 03 03 ff", "81 09 06 12 ff"
PLACE = bytes.fromhex("90 50 0f 0e 0d 04 00 04 0d 02 ff")
PLAIN = AxisSettings(COUNT_RAD, 0.0, -3.0, 3.0, 1.2, 10.0)


class Bench(Turned):
    """A head on a line in memory, at 9600 baud."""

    def __init__(self, **device: Any) -> None:
        self.clock = SimulationClock(start_s=START_S)
        self.panel = FaultPanel(self.clock.now_s, ())
        self.axes = [WireAxis(PLAIN, self.panel, number=n, time_s=self.clock.now_s()) for n in (0, 1)]
        self.device = SimulatedVisca(*self.axes, count_rad=COUNT_RAD, fastest_rad_per_s=1.2, **device)
        self.line = MemoryLine(self.device, self.clock, self.panel)

    def options(self, **changes: Any) -> dict[str, Any]:
        own = {"count_rad": COUNT_RAD, "fastest_rad_per_s": 1.2}
        axes = {"pan": {"limits_rad": [-1.0, 1.0], **own}, "tilt": {"limits_rad": [-0.6, 0.4], **own}}
        return {"port": self.line.path, "speed_rad_per_s": 1.0, **axes, **changes}


@contextmanager
def opened(options: dict[str, Any] | None = None, **device: Any) -> Iterator[tuple[Bench, ViscaHead]]:
    it = Bench(**device)
    with it.clock.at_work(), it.line:
        head = open_head(it.options(**(options or {})), it.clock, it.line.open)
        try:
            yield it, head
        finally:
            head.close()


def test_frames_are_those_of_another_program() -> None:
    assert protocol.go_command(1, (5, 7), (-300, 1234)).hex(" ") == GO
    assert protocol.stop_command(1).hex(" ") == STOP
    assert protocol.place_inquiry(1).hex(" ") == ASK
    assert protocol.kind_of(PLACE, 1) is protocol.Kind.PLACE
    assert protocol.places_of(PLACE) == (-300, 1234)
    for address, first in ((2, 0xA0), (7, 0xF0)):
        assert protocol.kind_of(bytes((first,)) + PLACE[1:], address) is protocol.Kind.PLACE
        assert protocol.kind_of(PLACE, address) is protocol.Kind.OTHER


@pytest.mark.parametrize("at", range(2, 10))
def test_a_digit_that_is_none_is_no_position(at: int) -> None:
    broken = bytearray(PLACE)
    broken[at] |= 0x20
    assert protocol.kind_of(bytes(broken), 1) is protocol.Kind.OTHER


def test_a_move_is_no_faster_than_asked_and_a_speed_that_no_code_has_is_refused() -> None:
    with opened() as (it, head):
        head.move(0.5, 0.0, 0.11)
        fastest = 0.0
        while head.read().moving:
            fastest = max(fastest, abs(it.axes[0].velocity_rad_per_s(it.now_s())))
        assert 0.05 < fastest <= 0.11, "code 2 of 24 is 0.1 rad/s"
        with pytest.raises(OutOfRange, match="slowest code"):
            head.move(0.0, 0.0, 0.01)


def test_how_far_from_its_goal_an_axis_is_held_is_told() -> None:
    with opened() as (it, head):
        head.move(-0.3, 0.0)
        it.until(lambda: not head.read().moving, "the place")
        it.panel.set("pan_tilt", "stuck")
        head.move(0.3, 0.0)
        it.until(lambda: head.read().faults, "words")
        counts = 2 * round(0.3 / COUNT_RAD)
        assert head.read().faults == (
            f"pan stands still {counts * COUNT_RAD:.4f} rad from its goal: something holds it",
        )


def test_the_heads_own_words_are_told_and_nothing_moves() -> None:
    with opened(limits=((-100, 100), (-100, 100))) as (it, head):
        with pytest.raises(Refused, match="the head refuses: not executable now"):
            head.move(0.5, 0.0)
        it.clock.sleep(0.5)
        assert it.axes[0].angle_rad(it.now_s()) == 0.0


def test_after_a_lost_reply_it_listens_until_no_late_one_can_come() -> None:
    with opened() as (it, head):
        it.panel.set("pan_tilt", "late", replies=1, delay_s=0.4)
        lost_s = it.now_s()
        with pytest.raises(NoReply, match="no position within"):
            head.read()
        with pytest.raises(NoReply, match="late replies are waited out"):
            head.read()

        def answers() -> bool:
            with suppress(DriverError):
                return bool(head.read())
            return False

        it.until(answers, "an answer")
        assert it.now_s() - lost_s > 0.7


def test_a_stop_takes_no_late_answer_to_the_move_before_it_for_its_own() -> None:
    with opened() as (it, head):
        plain, lost = it.device._drive, iter(range(3))

        def drive(body: bytes, time_s: float) -> Any:  # the line loses two stops of the move, and the next
            return [] if next(lost, None) is not None else plain(body, time_s)

        it.device._drive = drive  # type: ignore[method-assign]
        it.panel.set("pan_tilt", "late", replies=1, delay_s=0.15)
        with pytest.raises(NoReply, match="no acknowledgement within"):
            head.move(0.9, 0.0, 0.2)
        head.stop()
        assert it.axes[0].velocity_rad_per_s(it.now_s()) == 0.0
        assert 0.0 < it.axes[0].angle_rad(it.now_s()) < 0.5


def test_a_stop_is_sent_again_when_its_answer_is_lost_and_tries_a_line_that_is_away_at_once() -> None:
    with opened() as (it, head):
        head.move(0.9, 0.0, 0.2)
        it.panel.set("pan_tilt", "mute", replies=1)
        head.stop()
        assert it.axes[0].velocity_rad_per_s(it.now_s()) == 0.0
        head.move(0.9, 0.0, 0.2)
        it.line.hang_up()
        for _ in range(8):  # each failed try waits longer before the next one
            it.clock.sleep(2.0)
            with pytest.raises(LineLost):
                head.read()
        it.line.come_back()
        head.stop()
        assert it.axes[0].velocity_rad_per_s(it.now_s()) == 0.0


def test_a_head_that_does_not_obey_a_stop_is_told() -> None:
    with opened() as (it, head):
        head.move(0.9, 0.0, 0.1)
        it.device._drive = lambda body, time_s: [(0x41,), (0x51,)]  # type: ignore[method-assign]
        with pytest.raises(NoReply, match="got the command to stop, and still moves"):
            head.stop()


def test_a_digit_that_the_line_changed_is_seen_by_the_second_answer() -> None:
    with opened() as (it, head):
        plain, changed = it.device._answer, []

        def answer(body: bytes, time_s: float) -> Any:
            found = plain(body, time_s)
            if body == b"\x09\x06\x12" and not changed:
                changed.append(True)
                found = [(0x50, 0, 1, *found[0][3:])]
            return found

        it.device._answer = answer  # type: ignore[method-assign]
        with pytest.raises(BadReply, match="pan says 256 and then 0 counts"):
            head.read()


def test_a_head_outside_its_limits_is_refused_and_halt_stops_one_under_way() -> None:
    away = {"pan": {"limits_rad": [0.5, 1.0], "count_rad": COUNT_RAD, "fastest_rad_per_s": 1.2}}
    words = r"pan stands at 0\.0000 rad, outside its limits 0\.5000 to 1\.0000 rad: correct zero_rad"
    with pytest.raises(WrongDevice, match=words), opened(away):
        pass
    it = Bench()
    with it.clock.at_work(), it.line:
        it.device.receive(protocol.go_command(1, (24, 20), (600, 0)), it.now_s())
        it.clock.sleep(0.2)
        assert halt(it.options(), it.clock, it.line.open) == ["pan and tilt stopped, confirmed"]
        it.clock.sleep(0.5)
        assert 0.05 < it.axes[0].angle_rad(it.now_s()) < 0.6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"port": "http://x"}, "udp://HOST"),
        ({"address": 8}, "a whole number from 1 to 7"),
        ({"pan": {"limits_rad": [-1, 1]}}, "options.pan.count_rad is missing"),
        ({"pan": {"limits_rad": [-6, 6], "count_rad": 1e-4, "fastest_rad_per_s": 1}}, "32767 counts"),
    ],
)
def test_options_that_cannot_be_are_refused_in_words(change: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions) as caught:
        options_from({**Bench().options(), **change})
    assert words in str(caught.value)


class UdpHead:
    """A simulated head behind UDP, whose answers can be repeated with an old number."""

    def __init__(self) -> None:
        self.clock = SystemClock()
        self.axes = [WireAxis(PLAIN, number=n, time_s=self.clock.now_s()) for n in (0, 1)]
        self.device = SimulatedVisca(*self.axes, count_rad=COUNT_RAD, fastest_rad_per_s=1.2)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.stale = b""
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    @property
    def port(self) -> str:
        return f"udp://127.0.0.1:{self.socket.getsockname()[1]}"

    def _serve(self) -> None:
        while True:
            data, host = self.socket.recvfrom(256)
            if not data:
                return
            if self.stale:
                self.socket.sendto(self.stale, host)
            if data[:2] in (b"\x01\x00", b"\x01\x10"):
                for reply in self.device.receive(data[8:], self.clock.now_s()):
                    head = b"\x01\x11" + len(reply.data).to_bytes(2, "big") + data[4:8]
                    self.socket.sendto(head + reply.data, host)

    def close(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
            end.sendto(b"", self.socket.getsockname())
        self.thread.join()
        self.socket.close()


def test_over_udp_an_answer_with_another_number_is_dropped_and_nothing_is_waited_out() -> None:
    it = UdpHead()
    try:
        head = open_head({**Bench().options(), "port": it.port, "reply_timeout_s": 0.2})
        it.stale = b"\x01\x11\x00\x0b\x00\x00\x00\x01" + PLACE  # an old answer, just before each new one
        assert head.read().pan_rad == 0.0
        head.move(0.3, 0.1)

        def stands() -> bool:
            with suppress(NoReply):
                return not head.read().moving
            return False

        until(stands, "rest")
        assert head.read().pan_rad == pytest.approx(0.3, abs=COUNT_RAD)
        head.close()
    finally:
        it.close()
