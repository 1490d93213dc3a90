"""Jog: the head turns while heartbeats come, and stops by itself in every case in which they do not."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from drivers.faults import FaultPanel
from drivers.interfaces import Reading
from drivers.sim.heads import PRESETS
from drivers.sim.pan_tilt import SimulatedPanTilt
from drivers.simulation_clock import SimulationClock
from mastctl.control.operations import Operation, OperationRunner
from mastctl.devices.devices import Devices
from mastctl.devices.judge import Limits
from mastctl.devices.keep_out import Box
from mastctl.errors import NotNow
from mastctl.motion.jog import AHEAD_S, PATIENCE_S, TICK_S, JogBeat, Jogs

DECK = Box("deck", (-0.5, 0.5), (-1.2, -0.8))
LIMITS = Limits((-1.0, 1.0), (-1.2, 0.6), 1.0, margin_rad=0.02, keep_out=(DECK,))
RATE = 0.3
HEAD = PRESETS["dynamixel_x"]
BRAKING_RAD = RATE**2 / 2 / HEAD.pan.acceleration_rad_per_s2
AHEAD_RAD = RATE * AHEAD_S + BRAKING_RAD
COUNT_RAD = HEAD.pan.count_rad


def beat_of(pan: float, tilt: float, sequence: int = 1, name: str | None = None) -> JogBeat:
    """A heartbeat; by default one that begins a jog."""
    return JogBeat(pan_rad_per_s=pan, tilt_rad_per_s=tilt, sequence=sequence, id=name)


@dataclass
class Watched:
    """A head whose goals are written down beside where it was when they came."""

    head: SimulatedPanTilt
    moves: list[tuple[Reading, tuple[float, float]]] = field(default_factory=list)
    stops: int = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.head, name)

    def read(self) -> Reading:
        return self.head.read()

    @property
    def info(self) -> Any:
        return self.head.info

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        self.moves.append((self.head.read(), (pan_rad, tilt_rad)))
        self.head.move(pan_rad, tilt_rad, speed_rad_per_s)

    def stop(self) -> None:
        self.stops += 1
        self.head.stop()

    def close(self) -> None:
        self.head.close()


@dataclass
class Rig:
    clock: SimulationClock
    panel: FaultPanel
    head: Watched
    devices: Devices
    operations: OperationRunner
    jogs: Jogs
    name: str | None = None
    sent: int = 0

    def beat(self, pan: float, tilt: float) -> Any:
        """The next heartbeat of the jog, or the first; its answer."""
        self.sent += 1
        answer = self.jogs.beat(beat_of(pan, tilt, self.sent, self.name))
        self.name = answer["id"]
        return answer

    def pass_by(self, duration_s: float) -> None:
        self.clock.sleep(duration_s)

    def beats(self, pan: float, tilt: float, for_s: float) -> Any:
        """Heartbeats, one a tick; the last answer."""
        answer: Any = {}
        for _ in range(round(for_s / TICK_S)):
            answer = self.beat(pan, tilt)
            self.pass_by(TICK_S)
        return answer

    def place(self, pan: float, tilt: float) -> None:
        self.head.head.move(pan, tilt)
        self.pass_by(5.0)
        self.head.moves.clear()

    def joints(self) -> tuple[float, float]:
        reading = self.devices.read()
        return reading.pan_rad, reading.tilt_rad

    def ended(self, name: str) -> Operation:
        for _ in range(300):
            if self.operations.get(name).state not in ("queued", "running"):
                return self.operations.get(name)
            self.pass_by(0.01)
        raise AssertionError(f"{name} still runs")


@pytest.fixture
def rig() -> Iterator[Rig]:
    clock = SimulationClock(math.inf)
    panel = FaultPanel(clock.now_s, ())
    with clock.at_work():
        head = Watched(SimulatedPanTilt(HEAD, clock, panel))
        devices = Devices(head, {}, LIMITS, "0" * 64, clock)  # type: ignore[arg-type]
        operations = OperationRunner(devices, clock)
    made = Rig(clock, panel, head, devices, operations, Jogs(operations, devices, clock))
    made.pass_by(0.1)
    yield made
    made.pass_by(1.0)  # a jog that nobody ended ends by itself; the close would wait for it while time stands
    operations.close()
    devices.close()


def test_the_head_turns_at_the_rate_while_heartbeats_come(rig: Rig) -> None:
    rig.beats(RATE, 0.0, 2.0)
    pan, tilt = rig.joints()
    assert pan == pytest.approx(2.0 * RATE, abs=RATE * 0.25)
    assert abs(tilt) <= COUNT_RAD


def test_no_goal_lies_further_ahead_than_a_look_and_the_braking(rig: Rig) -> None:
    rig.beats(RATE, -RATE / 2, 1.5)
    rig.beats(-RATE, RATE, 1.0)
    assert len(rig.head.moves) > 15
    for reading, (pan, tilt) in rig.head.moves:
        assert max(abs(pan - reading.pan_rad), abs(tilt - reading.tilt_rad)) <= AHEAD_RAD + RATE * TICK_S


def test_without_a_heartbeat_for_half_a_second_the_head_stops_and_says_why(rig: Rig) -> None:
    name = rig.beats(RATE, 0.0, 0.5)["id"]
    before = rig.joints()[0]
    rig.pass_by(PATIENCE_S + 2 * TICK_S)
    record = rig.ended(name)
    assert record.state == "done" and rig.head.stops == 1
    assert record.result["ended_because"].startswith("no heartbeat came for 0.")
    rig.pass_by(1.0)
    assert rig.joints()[0] - before <= RATE * (PATIENCE_S + TICK_S) + AHEAD_RAD
    assert not rig.devices.read().moving


def test_rates_of_zero_end_it_at_once(rig: Rig) -> None:
    name = rig.beats(RATE, 0.0, 0.5)["id"]
    assert rig.beat(0.0, 0.0)["taken"]
    rig.pass_by(0.02)
    assert rig.ended(name).result["ended_because"] == "its client let go"
    assert rig.jogs.beat(beat_of(0.0, 0.0)) == {"id": None, "taken": False, "held": {}}


def test_a_heartbeat_of_a_jog_that_has_ended_moves_nothing(rig: Rig) -> None:
    name = rig.beats(RATE, 0.0, 0.3)["id"]
    rig.pass_by(1.0)
    moves = len(rig.head.moves)
    with pytest.raises(NotNow, match="does not run any more") as refused:
        rig.beat(RATE, 0.0)
    assert refused.value.code == "jog_ended"
    assert name not in (None, rig.operations.running)
    with pytest.raises(NotNow, match="1 begins a jog") as refused:
        rig.jogs.beat(beat_of(RATE, 0.0, 9))  # its client never learned the id
    assert refused.value.code == "jog_ended"
    rig.pass_by(0.5)
    assert len(rig.head.moves) == moves


def test_heartbeats_out_of_order_are_not_taken_and_keep_nothing_going(rig: Rig) -> None:
    name = rig.jogs.beat(beat_of(RATE, 0.0))["id"]
    rig.pass_by(0.2)
    assert rig.jogs.beat(beat_of(-RATE, 0.0, 7, name))["taken"]
    for number in (6, 7, 5):
        rig.pass_by(0.1)
        assert not rig.jogs.beat(beat_of(RATE, 0.0, number, name))["taken"]
    rig.pass_by(0.35)
    assert rig.operations.get(name).state == "done"
    assert rig.head.moves[-1][1][0] < 0.0, "the newest one counted"


def test_a_second_client_is_refused_while_the_first_jogs(rig: Rig) -> None:
    name = rig.jogs.beat(beat_of(RATE, 0.0))["id"]
    with pytest.raises(NotNow, match="is running") as refused:
        rig.jogs.beat(beat_of(-RATE, 0.0))
    assert refused.value.code == "busy"
    with pytest.raises(NotNow) as refused:
        rig.jogs.beat(beat_of(-RATE, 0.0, 9, "000009-beef"))
    assert refused.value.code == "jog_ended"
    rig.pass_by(0.2)
    assert rig.jogs.beat(beat_of(RATE, 0.0, 2, name))["taken"]


def test_a_jog_during_a_pointing_and_a_pointing_during_a_jog_are_refused(rig: Rig) -> None:
    go = threading.Event()
    pointing = rig.operations.start({}, lambda record, cancelled: go.wait(60.0)).id
    with pytest.raises(NotNow, match="is running") as refused:
        rig.jogs.beat(beat_of(RATE, 0.0))
    assert refused.value.code == "busy"
    go.set()
    rig.ended(pointing)
    rig.jogs.beat(beat_of(RATE, 0.0))
    with pytest.raises(NotNow, match="is running"):
        rig.operations.start({}, lambda record, cancelled: None)


def test_a_stop_is_the_last_word(rig: Rig) -> None:
    name = rig.beats(RATE, 0.0, 0.5)["id"]
    with rig.clock.at_work():
        assert rig.operations.stop() == name
    assert rig.ended(name).state == "stopped"
    moves = len(rig.head.moves)
    with pytest.raises(NotNow, match="does not run any more"):
        rig.beat(RATE, 0.0)
    rig.pass_by(0.5)
    assert len(rig.head.moves) == moves and not rig.devices.read().moving


def test_a_head_that_reports_a_fault_is_stopped(rig: Rig) -> None:
    name = rig.beats(RATE, 0.0, 0.3)["id"]
    rig.panel.set("pan_tilt", "voltage_dip", factor=0.5)
    rig.pass_by(0.3)
    record = rig.ended(name)
    assert record.state == "failed" and record.error is not None and record.error["code"] == "head_fault"
    assert rig.head.stops >= 1


def test_a_daemon_that_was_held_up_goes_on_with_no_heartbeat_that_waited(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, held = rig.devices.read, [PATIENCE_S + 0.3]

    def read() -> Reading:
        if held and rig.head.moves:
            rig.clock.sleep(held.pop())
            rig.beat(RATE, 0.0)  # it lay in the socket meanwhile
        return plain()

    monkeypatch.setattr(rig.devices, "read", read)
    name = rig.beat(RATE, 0.0)["id"]
    rig.pass_by(1.5)
    assert rig.ended(name).result["ended_because"].startswith("the daemon was held up for 0.")


def test_an_axis_at_its_limit_stands_while_the_other_goes_on(rig: Rig) -> None:
    rig.place(0.9, 0.0)
    answer = rig.beats(RATE, RATE, 1.0)
    pan, tilt = rig.joints()
    assert pan == pytest.approx(1.0, abs=COUNT_RAD) and tilt > 0.2
    assert answer["held"] == {"pan": "pan is held at 1 rad by a limit or a keep-out"}


def test_the_head_slides_along_a_keep_out_and_never_nearer_than_its_margin(rig: Rig) -> None:
    rig.place(-0.3, -0.7)
    lowest = 0.0
    for _ in range(20):
        answer = rig.beats(RATE, -RATE, 0.1)
        lowest = min(lowest, rig.joints()[1])
    assert rig.joints()[0] > 0.2 and "tilt" in answer["held"], "pan goes on over the deck"
    assert rig.joints()[1] < -0.75
    assert lowest >= -0.8 + 0.02 - COUNT_RAD


def test_faster_than_the_limit_is_the_limit_in_the_same_direction(rig: Rig) -> None:
    rig.place(-0.9, 0.0)
    rig.beat(4.0, 2.0)
    rig.pass_by(0.05)
    reading, (pan, tilt) = rig.head.moves[0]
    reach = [AHEAD_S * rate + rate**2 / 2 / 4.0 for rate in (1.0, 0.5)]
    assert pan - reading.pan_rad == pytest.approx(reach[0], abs=0.01)
    assert tilt - reading.tilt_rad == pytest.approx(reach[1], abs=0.01)


def test_a_jog_begins_before_or_after_what_needs_a_head_that_rests(rig: Rig) -> None:
    changing = threading.Lock()
    jogs = Jogs(rig.operations, rig.devices, rig.clock, undisturbed=lambda: changing)
    begun = threading.Event()

    def begin() -> None:
        jogs.beat(beat_of(RATE, 0.0))
        begun.set()

    with changing:
        client = threading.Thread(target=begin, daemon=True)
        client.start()
        assert not begun.wait(0.2)
        assert rig.operations.running is None
    assert begun.wait(60.0)
    assert rig.operations.running is not None
