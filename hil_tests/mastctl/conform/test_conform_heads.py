"""Every test of a head finds the driver that breaks its promise."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError, NoReply
from drivers.interfaces import Reading
from drivers.simulation_clock import SimulationClock
from hil_tests.mastctl.conform.conform_world import HERE, accepted, open_head
from mastctl.conform.device_checks import SubjectLost
from mastctl.testing.drivers import test_head as suite
from mastctl.testing.drivers.test_head import HeadTrial

LIMITS = ((-2.0, 2.0), (-2.0, 2.0))
BOX = ((-0.4, 0.4), (-0.3, 0.3))
Test = Callable[[HeadTrial], None]
TESTS = {one for name, one in vars(suite).items() if name.startswith("test_")}


class Right:
    """A right head, to be broken."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.right = clock, open_head(clock=clock)
        self.goal = (0.0, 0.0)

    def read(self) -> Reading:
        return self.right.read()

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        self.right.move(pan_rad, tilt_rad, speed_rad_per_s)
        self.goal = (pan_rad, tilt_rad)

    def stop(self) -> None:
        self.right.stop()

    def close(self) -> None:
        self.right.close()


def reads(edit: Callable[[Right, Reading], Any]) -> type[Right]:
    """A head whose readings are edited."""

    class Reads(Right):
        def read(self) -> Any:
            return edit(self, super().read())

    return Reads


def moves(edit: Callable[[Right, float, float, float | None], Any]) -> type[Right]:
    """A head that carries out other moves; ``edit`` returns what is sent, or None for nothing."""

    class Moves(Right):
        def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
            sent = edit(self, pan_rad, tilt_rad, speed_rad_per_s)
            if sent is not None:
                super().move(*sent)

    return Moves


def waits(head: Right, pan: float, tilt: float, speed: float | None) -> None:
    """A move that comes back when the head is there."""
    Right.move(head, pan, tilt, speed)
    while head.right.read().moving:
        head.clock.sleep(0.005)


def clipped(head: Right, pan: float, tilt: float, speed: float | None) -> Any:
    return max(-2.0, min(2.0, pan)), max(-2.0, min(2.0, tilt)), speed


def numbers_only(head: Right, pan: float, tilt: float, speed: float | None) -> Any:
    """Takes what is no number for nothing to do."""
    return (pan, tilt, speed) if all(map(math.isfinite, (pan, tilt, speed or 1.0))) else None


class Queues(Right):
    """Goes to its old goal first."""

    waiting: Any = None

    def read(self) -> Reading:
        reading = super().read()
        if self.waiting is not None and not reading.moving:
            super().move(*self.waiting)
            self.waiting = None
            return super().read()
        return replace(reading, moving=reading.moving or self.waiting is not None)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        if super().read().moving:
            self.waiting = (pan_rad, tilt_rad, speed_rad_per_s)
        else:
            super().move(pan_rad, tilt_rad, speed_rad_per_s)


class RunsOn(Right):
    def stop(self) -> None: ...


class Creeps(Right):
    def stop(self) -> None:
        super().stop()
        while self.right.read().moving:
            self.clock.sleep(0.002)
        reading = self.right.read()
        self.right.move(reading.pan_rad + 0.2, reading.tilt_rad, 0.1)

    def read(self) -> Reading:
        return replace(super().read(), moving=False)


class StopWaits(Right):
    """A stop waits for the lock that a move holds until it is acknowledged."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.lock = threading.Lock()

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        with self.lock:
            super().move(pan_rad, tilt_rad, speed_rad_per_s)
            self.clock.sleep(0.8)

    def stop(self) -> None:
        with self.lock:
            super().stop()


class OneAtATime(Right):
    """Refuses a call beside another."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.busy = threading.Lock()

    def read(self) -> Reading:
        if not self.busy.acquire(blocking=False):
            raise DriverError("the port is busy")
        try:
            self.clock.sleep(0.01)
            return super().read()
        finally:
            self.busy.release()


class Slow(Right):
    def read(self) -> Reading:
        self.clock.sleep(0.6)
        return super().read()


class ClosesOnce(Right):
    closed = False

    def close(self) -> None:
        if self.closed:
            raise NoReply("it is closed already")
        self.closed = True
        super().close()


class StaysOpen(Right):
    def close(self) -> None:
        self.right.stop()


BROKEN: list[tuple[str, Test, type[Right]]] = [
    ("degrees", suite.test_reading, reads(lambda head, r: replace(r, tilt_rad=r.tilt_rad + 90.0))),
    ("an old stamp", suite.test_reading, reads(lambda head, r: replace(r, time_s=r.time_s - 0.5))),
    ("another clock", suite.test_reading, reads(lambda head, r: replace(r, time_s=time.time()))),
    ("one fault as a text", suite.test_reading, reads(lambda head, r: replace(r, faults="hot"))),
    ("a fault", suite.test_reading, reads(lambda head, r: replace(r, faults=["pan is hot"]))),
    ("no reading", suite.test_reading, reads(lambda head, r: None)),
    ("a move that waits", suite.test_move, moves(waits)),
    ("beside the goal", suite.test_move, moves(lambda head, p, t, s: (p + 0.02, t, s))),
    ("the commanded angle", suite.test_under_way,
     reads(lambda head, r: replace(r, pan_rad=head.goal[0], tilt_rad=head.goal[1], moving=False))),
    ("never moving", suite.test_under_way, reads(lambda head, r: replace(r, moving=False))),
    ("one stamp for many", suite.test_under_way,
     reads(lambda head, r: replace(r, time_s=math.floor(r.time_s / 0.004) * 0.004))),
    ("goals in a queue", suite.test_new_goal, Queues),
    ("a stop that does nothing", suite.test_stop, RunsOn),
    ("a creep after the stop", suite.test_stop, Creeps),
    ("a stop that waits for a move", suite.test_stop_beside, StopWaits),
    ("one call at a time", suite.test_threads, OneAtATime),
    ("full speed", suite.test_speed, moves(lambda head, p, t, s: (p, t, 1.5))),
    ("goals bent to the limits", suite.test_limits, moves(clipped)),
    ("goals of no number taken", suite.test_not_a_number, moves(numbers_only)),
    ("slow answers", suite.test_deadlines, Slow),
    ("close once only", suite.test_close, ClosesOnce),
    ("open for ever", suite.test_close, StaysOpen),
]  # fmt: skip


def tried(test: Test, kind: Callable[[Clock], Any], **known: Any) -> None:
    """Run a test on a head, on a turned clock unless threads have to meet."""
    clock = SystemClock() if kind in (StopWaits, OneAtATime) else SimulationClock(start_s=1000.0)
    test(HeadTrial(kind(clock), BOX, 0.8, limits_rad=LIMITS, clock=clock, **known))


@pytest.mark.parametrize(("test", "kind"), [one[1:] for one in BROKEN], ids=[one[0] for one in BROKEN])
def test_a_broken_head_is_found_by_the_test_meant_for_it(test: Test, kind: type[Right]) -> None:
    with pytest.raises((AssertionError, DriverError)) as failed:
        tried(test, kind)
    assert "\n" not in str(failed.value)


def test_a_move_that_a_busy_machine_delays_is_no_fault_of_the_driver() -> None:
    delayed = iter([False, False, False, True, False])  # the first three ways are too short to tell
    tried(suite.test_move, moves(lambda head, p, t, s: waits(head, p, t, s) if next(delayed) else (p, t, s)))


def test_a_right_head_is_closed_and_opened_again() -> None:
    """The other tests are passed by every head of test_head_contract."""
    clocks: list[Clock] = []

    def first(clock: Clock) -> Right:
        clocks.append(clock)
        return Right(clock)

    tried(suite.test_close, first, open_again=lambda: Right(clocks[0]))


def test_there_is_a_broken_head_for_every_test() -> None:
    assert {test for _, test, _ in BROKEN} == TESTS


def test_a_head_that_hangs_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    go = threading.Event()
    monkeypatch.setattr("mastctl.conform.device_checks.call.__defaults__", (0.2,))

    class Hangs(Right):
        def read(self) -> Reading:
            go.wait(30)
            return super().read()

    with pytest.raises(SubjectLost, match="has not come back"):
        tried(suite.test_reading, Hangs)
    go.set()


UNREADABLE = """
class Head:
    def read(self):
        raise RuntimeError("no")
    def move(self, *goal):
        open("moved", "w").close()
    def stop(self): ...
    def close(self): ...
"""


def test_a_head_that_reads_nothing_true_at_the_start_is_never_moved(tmp_path: Path) -> None:
    (tmp_path / "unreadable.py").write_text(UNREADABLE)
    done = accepted(tmp_path, "--head", "unreadable:Head", "--motion")
    assert done.returncode == 1 and "RuntimeError (no) where a DriverError is expected" in done.stdout
    assert "its present pose is not known" in done.stdout and " passed" not in done.stdout
    assert not (tmp_path / "moved").exists()


def test_the_suite_takes_a_driver_by_its_name_and_refuses_wrong_use(tmp_path: Path) -> None:
    words = ("--head", f"{HERE}:open_head", "--options", '{"low_rad": -1.0, "high_rad": 1.0}')
    ends = ("--limits", "-1", "1", "-1", "1", "-k", "limits", "--speed", "2")
    done = accepted(tmp_path, *words, "--motion", *ends)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout
    done = accepted(tmp_path, *words, *ends)
    assert "1 skipped" in done.stdout and "moved only with --motion" in done.stdout
    for wrong, message, code in (
        ((*words, "--limits", "1", "-1", "-1", "1"), "the lower angle first is expected", 4),
        (("--motion",), "--head DRIVER, --camera DRIVER or --rig FILE is expected", 4),
        (("--head", "no.such:thing", "--motion"), "no.such", 1),
    ):
        done = accepted(tmp_path, *wrong)
        assert done.returncode == code and message in done.stdout + done.stderr, done.stdout + done.stderr
