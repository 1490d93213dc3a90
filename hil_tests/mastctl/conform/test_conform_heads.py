"""Every check of a head finds the driver that breaks its promise."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DriverError, NoReply
from drivers.interfaces import Reading
from hil_tests.mastctl.conform.conform_world import HERE, open_head
from mastctl.cli.main import main
from mastctl.conform.checks import run_checks
from mastctl.conform.devices import check_head
from mastctl.conform.head_checks import HEADS
from mastctl.conform.head_trial import HeadTrial

LIMITS = ((-2.0, 2.0), (-2.0, 2.0))
BOX = ((-0.4, 0.4), (-0.3, 0.3))
NAMES = [check.name for check in HEADS.checks]


class Right:
    """A right head, to be broken."""

    def __init__(self) -> None:
        self.right = open_head()
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
        time.sleep(0.005)


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
            time.sleep(0.002)
        reading = self.right.read()
        self.right.move(reading.pan_rad + 0.2, reading.tilt_rad, 0.1)

    def read(self) -> Reading:
        return replace(super().read(), moving=False)


class StopWaits(Right):
    """A stop waits for the lock that a move holds until it is acknowledged."""

    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        with self.lock:
            super().move(pan_rad, tilt_rad, speed_rad_per_s)
            time.sleep(0.8)

    def stop(self) -> None:
        with self.lock:
            super().stop()


class OneAtATime(Right):
    """Refuses a call beside another."""

    def __init__(self) -> None:
        super().__init__()
        self.busy = threading.Lock()

    def read(self) -> Reading:
        if not self.busy.acquire(blocking=False):
            raise DriverError("the port is busy")
        try:
            time.sleep(0.01)
            return super().read()
        finally:
            self.busy.release()


class Slow(Right):
    def read(self) -> Reading:
        time.sleep(0.6)
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


BROKEN: list[tuple[str, str, type[Right]]] = [
    ("degrees", "head.reading", reads(lambda head, r: replace(r, tilt_rad=r.tilt_rad + 90.0))),
    ("an old stamp", "head.reading", reads(lambda head, r: replace(r, time_s=r.time_s - 0.5))),
    ("another clock", "head.reading", reads(lambda head, r: replace(r, time_s=time.time()))),
    ("one fault as a text", "head.reading", reads(lambda head, r: replace(r, faults="hot"))),
    ("a fault", "head.reading", reads(lambda head, r: replace(r, faults=["pan is hot"]))),
    ("no reading", "head.reading", reads(lambda head, r: None)),
    ("a move that waits", "head.move", moves(waits)),
    ("beside the goal", "head.move", moves(lambda head, p, t, s: (p + 0.02, t, s))),
    ("the commanded angle", "head.under_way",
     reads(lambda head, r: replace(r, pan_rad=head.goal[0], tilt_rad=head.goal[1], moving=False))),
    ("never moving", "head.under_way", reads(lambda head, r: replace(r, moving=False))),
    ("one stamp for many", "head.under_way",
     reads(lambda head, r: replace(r, time_s=math.floor(r.time_s / 0.004) * 0.004))),
    ("goals in a queue", "head.new_goal", Queues),
    ("a stop that does nothing", "head.stop", RunsOn),
    ("a creep after the stop", "head.stop", Creeps),
    ("a stop that waits for a move", "head.stop_beside", StopWaits),
    ("one call at a time", "head.threads", OneAtATime),
    ("full speed", "head.speed", moves(lambda head, p, t, s: (p, t, 1.5))),
    ("goals bent to the limits", "head.limits", moves(clipped)),
    ("goals of no number taken", "head.not_a_number", moves(numbers_only)),
    ("slow answers", "head.deadlines", Slow),
    ("close once only", "head.close", ClosesOnce),
    ("open for ever", "head.close", StaysOpen),
]  # fmt: skip


def trial(head: Any, **known: Any) -> HeadTrial:
    return HeadTrial(head, BOX, 0.8, limits_rad=LIMITS, own_limits=True, **known)


@pytest.mark.parametrize(("name", "kind"), [one[1:] for one in BROKEN], ids=[one[0] for one in BROKEN])
def test_a_broken_head_is_found_by_the_check_meant_for_it(name: str, kind: type[Right]) -> None:
    checks = [check for check in HEADS.checks if check.name == name]
    (outcome,) = run_checks(checks, trial(kind()), motion=True)
    assert outcome.state == "failed" and "\n" not in outcome.message, outcome


def test_a_move_that_a_busy_machine_delays_is_no_fault_of_the_driver() -> None:
    delayed = iter([False, False, False, True, False])  # the first three ways are too short to tell
    kind = moves(lambda head, p, t, s: waits(head, p, t, s) if next(delayed) else (p, t, s))
    (outcome,) = run_checks(
        [check for check in HEADS.checks if check.name == "head.move"], trial(kind()), motion=True
    )
    assert outcome.state == "passed", outcome


def test_a_right_head_is_closed_and_opened_again() -> None:
    """The other checks are passed by every head of test_head_contract."""
    checks = [check for check in HEADS.checks if check.name == "head.close"]
    (outcome,) = run_checks(checks, trial(Right(), open_again=Right), motion=True)
    assert outcome.state == "passed", outcome


def test_there_is_a_broken_head_for_every_check() -> None:
    assert {name for _, name, _ in BROKEN} == set(NAMES)


def test_a_head_that_hangs_ends_the_checks_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    go = threading.Event()
    monkeypatch.setattr("mastctl.conform.worker.PATIENCE_S", 0.2)
    monkeypatch.setattr("mastctl.conform.worker.Worker.call.__defaults__", (0.2,))

    class Hangs(Right):
        def read(self) -> Reading:
            go.wait(30)
            return super().read()

    outcomes = run_checks(HEADS.checks, trial(Hangs()), motion=True)
    go.set()
    assert "has not come back" in outcomes[0].message
    assert [outcome.state for outcome in outcomes] == ["failed"] + ["skipped"] * (len(NAMES) - 1)


@pytest.mark.parametrize("answer", [RuntimeError("no"), NoReply("no"), None])
def test_a_head_that_reads_nothing_true_at_the_start_is_never_moved(
    answer: Exception | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sent: list[Any] = []

    class Tells(Right):
        def read(self) -> Any:
            if answer is not None:
                raise answer
            return answer

        def move(self, *goal: Any) -> None:
            sent.append(goal)

    monkeypatch.setattr("hil_tests.mastctl.conform.conform_world.open_head", lambda: Tells())
    assert main(["conform", "--driver", f"{HERE}:open_head", "--head", "--motion", "--json"]) == 1
    told = {check["name"]: check for check in json.loads(capsys.readouterr().out)["checks"]}
    assert told["head.reading"]["state"] == "failed"
    assert {check["state"] for check in told.values()} == {"failed", "skipped"}
    assert "not known from where" in told["head.move"]["message"]
    assert sent == []


def test_control_c_stops_the_head() -> None:
    head = Right()

    def interrupt(*ignored: object) -> None:
        head.right.move(1.5, 0.0, 0.5)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        check_head(trial(head), "right", HEADS.checks[:2], True, interrupt)
    assert not head.right.read().moving or head.right.read().pan_rad < 0.5


def test_the_command_checks_a_driver_by_its_name(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    options = tmp_path / "options.json"
    options.write_text('{"low_rad": -1.0, "high_rad": 1.0}')
    words = [
        "conform",
        "--driver",
        f"{HERE}:open_head",
        "--options",
        str(options),
        "--head",
        "--motion",
        "--json",
    ]
    assert main([*words, "--limits", "-1", "1", "-1", "1", "--only", "head.limits", "--speed", "2"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["kind"] == "head" and told["passed"] == 1 and told["conforms"]
    for wrong, code in (
        ([*words, "--limits", "1", "-1", "-1", "1"], "wrong_use"),
        ([word for word in words if word != "--head"], "wrong_use"),
        (["conform", "--driver", "no.such:thing", "--head", "--motion", "--json"], "bad_options"),
        (["conform", "--driver", f"{HERE}:open_head", "--options", "[1]", "--head", "--json"], "wrong_use"),
    ):
        assert main(wrong) == 2
        assert json.loads(capsys.readouterr().out)["error"]["code"] == code
