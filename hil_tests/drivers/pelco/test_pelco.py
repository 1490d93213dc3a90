"""What is a Pelco head's own: frames, steps and their mean speed, a host that falls silent, odd replies.

What every head has to do is in test_head_contract.py. The Pelco-D frames are those of the package
pyptzcontroller 0.1.2; those of Pelco-P follow the command lists in manuals of Telycam and Avonic.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

from drivers.errors import BadOptions, BadReply, DriverError, NoReply, WrongDevice
from drivers.faults import FaultPanel
from drivers.pelco import protocol
from drivers.pelco.head import PelcoHead, halt, open_head
from drivers.pelco.options import UNIT_RAD, options_from
from drivers.sim.heads import AxisSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.line import PtyLine
from drivers.sim.wire.memory_line import MemoryLine
from drivers.sim.wire.pelco import SimulatedPelco
from drivers.simulation_clock import SimulationClock
from hil_tests.drivers.turned import START_S, Turned
from hil_tests.waiting import until
from tools.campaigns.servo_rigs import RIGS

FASTEST_RAD_PER_S, STEP_RAD = 1.2, 0.05
PLAIN = AxisSettings(UNIT_RAD, 0.0, -3.0, 3.0, FASTEST_RAD_PER_S, 10.0)
P_ASKS = {1: "a0 00 00 51 00 00 af 5e", 3: "a0 02 00 51 00 00 af 5c"}


class Bench(Turned):
    """A head on a line in memory, at 9600 baud."""

    def __init__(self, **device: Any) -> None:
        self.clock = SimulationClock(start_s=START_S)
        self.panel = FaultPanel(self.clock.now_s, ())
        self.axes = [WireAxis(PLAIN, self.panel, number=n, time_s=self.clock.now_s()) for n in (0, 1)]
        self.device = SimulatedPelco(*self.axes, fastest_rad_per_s=FASTEST_RAD_PER_S, **device)
        self.line = MemoryLine(self.device, self.clock, self.panel)

    def options(self, **changes: Any) -> dict[str, Any]:
        own = {"fastest_rad_per_s": FASTEST_RAD_PER_S}
        axes = {"pan": {"limits_rad": [-1.0, 1.0], **own}, "tilt": {"limits_rad": [-0.6, 0.4], **own}}
        return {"port": self.line.path, "speed_rad_per_s": 1.0, "step_rad": STEP_RAD, **axes, **changes}

    def places(self) -> list[float]:
        return [axis.angle_rad(self.now_s()) for axis in self.axes]


@contextmanager
def opened(options: dict[str, Any] | None = None, **device: Any) -> Iterator[tuple[Bench, PelcoHead]]:
    it = Bench(**device)
    with it.clock.at_work(), it.line:
        head = open_head(it.options(**(options or {})), it.clock, it.line.open)
        try:
            yield it, head
        finally:
            head.close()


def test_frames_are_those_of_another_program() -> None:
    assert protocol.frame("D", 1, protocol.SET[0], 12345).hex(" ") == "ff 01 00 4b 30 39 b5"
    assert protocol.frame("D", 7, protocol.SET[1], 35450).hex(" ") == "ff 07 00 4d 8a 7a 58"
    assert protocol.frame("D", 1, protocol.ASK[0]).hex(" ") == "ff 01 00 51 00 00 52"
    assert protocol.frame("D", 1, protocol.ASK[1]).hex(" ") == "ff 01 00 53 00 00 54"
    assert protocol.frame("D", 1, protocol.STOP).hex(" ") == "ff 01 00 00 00 00 01"
    for address, words in P_ASKS.items():
        assert protocol.frame("P", address, protocol.ASK[0]).hex(" ") == words


@pytest.mark.parametrize("kind", ["D", "P"])
def test_an_answer_is_found_behind_an_echo_and_a_general_response_and_only_whole(kind: str) -> None:
    answer = protocol.frame(kind, 2, protocol.TOLD[1], 0xFFA0)
    before = protocol.frame(kind, 2, protocol.ASK[1]) + bytes.fromhex("ff 02 00 4d ff")
    buffer = bytearray(before + answer[:-1])
    assert protocol.take_answer(kind, 2, buffer) is None
    buffer += answer[-1:]
    assert protocol.take_answer(kind, 2, buffer) == (protocol.TOLD[1], 0xFFA0)
    assert protocol.take_answer(kind, 3, bytearray(answer)) is None
    for place in range(len(answer)):
        broken = bytearray(answer)
        broken[place] ^= 0x15
        assert protocol.take_answer(kind, 2, broken) is None


@pytest.mark.parametrize("speed", [0.1, 0.4])
def test_the_mean_speed_is_never_more_than_asked_while_a_step_goes_at_the_heads_own(speed: float) -> None:
    with opened(acknowledges=True) as (it, head):
        began_s, fastest = it.now_s(), 0.0
        head.move(0.5, 0.0, speed)
        while head.read().moving:
            assert it.places()[0] <= speed * (it.now_s() - began_s) + UNIT_RAD
            fastest = max(fastest, it.axes[0].velocity_rad_per_s(it.now_s()))
        assert it.now_s() - began_s < 0.5 / speed * 1.1 + 0.5, "nor much slower"
        assert it.places()[0] == pytest.approx(0.5, abs=UNIT_RAD)
        assert fastest <= FASTEST_RAD_PER_S


def test_a_reading_sends_no_step_after_a_stop_that_came_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    with opened() as (it, head):
        head.move(0.5, 0.0, 0.4)
        stopped, plain = it.gate(), head._look

        def look() -> float:
            time_s = plain()
            if not stopped.is_open:
                stopped.set()
                ends.append(it.beside(head.stop))
                it.until(lambda: head._stops, "the stop")
            return time_s

        ends: list[Any] = []
        monkeypatch.setattr(head, "_look", look)
        it.clock.sleep(0.1)
        head.read()
        ends[0].wait()
        assert it.places()[0] == 0.0


@pytest.mark.parametrize("kind", ["D", "P"])
def test_a_head_that_nobody_reads_any_more_stands_after_one_step(kind: str) -> None:
    with opened({"protocol": kind}, protocol=kind) as (it, head):
        head.move(0.9, -0.5, 1.0)
        it.until(lambda: head.read().pan_rad > 0.3, "motion")
        left = it.places()
        it.clock.sleep(5.0)
        for before, after in zip(left, it.places(), strict=True):
            assert abs(after - before) <= STEP_RAD + UNIT_RAD
        assert 0.3 < it.places()[0] < 0.9


def test_goals_across_position_0_take_the_short_way_and_a_sign_turns_them() -> None:
    pan = {"limits_rad": [-1.0, 1.0], "fastest_rad_per_s": 1.2, "sign": -1, "zero_rad": 0.2}
    with opened({"pan": pan}) as (it, head):
        assert head.read().pan_rad == pytest.approx(0.2, abs=UNIT_RAD)
        for goal in (0.7, -0.4):
            head.move(goal, 0.0)
            assert it.settled(head).pan_rad == pytest.approx(goal, abs=UNIT_RAD)
            assert it.places()[0] == pytest.approx(0.2 - goal, abs=UNIT_RAD)


def test_after_a_lost_reply_it_listens_and_then_two_answers_have_to_fit() -> None:
    with opened() as (it, head):
        head.read()
        it.panel.set("pan_tilt", "late", replies=1, delay_s=0.4)
        lost_s = it.now_s()
        with pytest.raises(NoReply, match="no tilt position within"):
            head.read()
        with pytest.raises(NoReply, match="late replies are waited out"):
            head.read()
        asked = []
        plain = it.device._carry_out

        def counted(one: bytes, time_s: float) -> list[bytes]:
            asked.append(one[3])
            return plain(one, time_s)

        it.device._carry_out = counted  # type: ignore[method-assign]

        def answers() -> bool:
            with suppress(DriverError):
                return bool(head.read())
            return False

        it.until(answers, "an answer")
        assert it.now_s() - lost_s > 0.7
        assert sorted(asked) == [0x51, 0x51, 0x53, 0x53]


def test_answers_that_always_change_places_are_never_taken_for_one_another() -> None:
    with opened() as (it, head):
        it.panel.set("pan_tilt", "swapped", replies=math.inf, probability=1.0)
        until_s, goal = it.now_s() + 8.0, 0.3
        while it.now_s() < until_s:
            before = it.places()
            with suppress(DriverError):
                reading = head.read()
                told = (reading.pan_rad, reading.tilt_rad)
                for one, angle, other in zip(before, told, it.places(), strict=True):
                    assert min(one, other) - UNIT_RAD <= angle <= max(one, other) + UNIT_RAD
                if not reading.moving:
                    head.move(goal, goal)
                    goal = -goal


def test_a_place_that_an_axis_cannot_have_reached_is_asked_for_again() -> None:
    with opened() as (it, head):
        head.read()
        plain, told = it.device._carry_out, [4000]

        def lying(one: bytes, time_s: float) -> list[bytes]:
            if one[3] == 0x51 and told:
                return [it.device._framed(1, 0, 0x59, *divmod(told.pop(), 256))]
            return plain(one, time_s)

        it.device._carry_out = lying  # type: ignore[method-assign]
        with pytest.raises(BadReply, match="pan says 4000 and then 0 counts: one of them is wrong"):
            head.read()
        it.clock.sleep(0.8)
        told.append(36000)
        with pytest.raises(BadReply, match="asked for pan it answered with 0x59 and 36000, where"):
            head.read()


def test_a_stop_holds_a_head_that_jogs_on_and_tells_of_one_that_obeys_nothing() -> None:
    with opened() as (it, head):
        plain = it.device._jog
        it.device._jog = lambda *_: None  # type: ignore[method-assign,assignment]
        plain(0x02, b"\x08\x00", it.now_s())  # another keyboard on the line
        it.clock.sleep(0.2)
        head.stop()
        assert it.axes[0].velocity_rad_per_s(it.now_s()) == 0.0
        plain(0x02, b"\x08\x00", it.now_s())
        it.device._carry_out = _only_answers(it.device._carry_out)  # type: ignore[method-assign]
        with pytest.raises(NoReply, match="got the command to stop, and still moves"):
            head.stop()
        it.axes[0].halt(it.now_s())


def _only_answers(plain: Any) -> Any:
    """A head that says where it is and does nothing else."""
    return lambda one, time_s: plain(one, time_s) if one[3] in protocol.ASK else []


def test_a_head_outside_its_limits_is_refused_and_halt_stops_one_that_jogs() -> None:
    away = {"pan": {"limits_rad": [0.5, 1.0], "fastest_rad_per_s": 1.2}}
    words = r"pan stands at 0\.0000 rad, outside its limits 0\.5000 to 1\.0000 rad: correct zero_rad, sign"
    with pytest.raises(WrongDevice, match=words), opened(away):
        pass
    it = Bench()
    with it.clock.at_work(), it.line:
        it.device.receive(bytes.fromhex("ff 01 00 02 20 00 23"), it.now_s())  # a manual's: right
        it.clock.sleep(0.2)
        assert halt(it.options(), it.clock, it.line.open) == ["pan and tilt stopped, confirmed"]
        held = it.places()
        it.clock.sleep(0.5)
        assert it.places() == held
        assert 0.05 < held[0] < 0.6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"port": "udp://x"}, "socket://HOST:PORT"),
        ({"protocol": "C"}, "D or P"),
        ({"address": 0}, "a whole number from 1 to 254"),
        ({"pan": {"limits_rad": [-1, 1]}}, "options.pan.fastest_rad_per_s is missing"),
        ({"pan": {"limits_rad": [-3.14, 3.14], "fastest_rad_per_s": 1}}, "more than 359 degrees"),
        ({"pan": {"limits_rad": [-1, 1], "fastest_rad_per_s": 1, "count_rad": 0.1}}, "no such option"),
    ],
)
def test_options_that_cannot_be_are_refused_in_words(change: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions) as caught:
        options_from({**Bench().options(), **change})
    assert words in str(caught.value)


def test_coarse_steps_are_reported_and_count_as_arrived() -> None:
    pan = {"limits_rad": [-1.0, 1.0], "fastest_rad_per_s": 1.2, "resolution_rad": 0.001}
    with opened({"pan": pan}) as (_, head):
        motion = head.axis_motion()
        assert (motion["pan"].count_rad, motion["tilt"].count_rad) == (0.001, math.radians(0.01))


HOST = """
import json, sys, time
from contextlib import suppress
from drivers.errors import DriverError
from drivers.pelco.head import open_head
head = open_head(json.loads(sys.argv[1]))
head.move(0.9, -0.5, 0.5)
while True:
    with suppress(DriverError):
        head.read()
    time.sleep(0.02)
"""


@pytest.mark.long(2, "kills a process that drives a head over a pseudo terminal, by real time")
def test_the_head_of_a_killed_host_stands_after_one_step() -> None:
    with RIGS["pelco_pty"]() as rig:
        rig.head.close()
        assert isinstance(rig.line, PtyLine)
        own = {"fastest_rad_per_s": 1.2}
        options = {
            "port": rig.line.path,
            "pan": {"limits_rad": [-1.0, 1.0], **own},
            "tilt": {"limits_rad": [-0.6, 0.4], **own},
        }
        command = [sys.executable, "-c", HOST, json.dumps(options)]
        with subprocess.Popen(command) as host:
            until(lambda: rig.true_rad(rig.clock.now_s())[0] > 0.2, "motion")
            os.kill(host.pid, signal.SIGKILL)
        killed_s = rig.clock.now_s()
        before = rig.true_rad(killed_s)
        until(lambda: rig.true_rad(t := rig.clock.now_s()) == rig.true_rad(t - 0.5), "rest")
        after = rig.true_rad(rig.clock.now_s())
        assert max(abs(b - a) for a, b in zip(before, after, strict=True)) <= STEP_RAD + UNIT_RAD
