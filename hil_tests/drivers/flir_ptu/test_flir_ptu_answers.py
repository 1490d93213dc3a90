"""Every answer of a PTU is of its question: damaged facts, late answers, two axes asked by turns."""

from __future__ import annotations

import math
from collections import deque
from contextlib import suppress
from typing import cast

import pytest

from drivers.errors import DriverError, NoReply
from drivers.flir_ptu.head import FlirPtu
from drivers.interfaces import Reading
from hil_tests.drivers.flir_ptu.scripted_ptu import Bench, ScriptedPtu

PAN_STEP_RAD, TILT_STEP_RAD = (math.radians(arcsec / 3600) for arcsec in (185.142857, 46.285714))


def answered(opened: Bench, head: FlirPtu) -> Reading:
    """Read until the unit is there again."""

    def reading() -> Reading | None:
        with suppress(DriverError):
            return head.read()
        return None

    return cast(Reading, opened.until(reading, "the unit is back"))


class Damaged(ScriptedPtu):
    """A unit of whose answers to some commands the first is damaged on the line."""

    def __init__(self, **damaged: bytes) -> None:
        super().__init__()
        self.damaged = damaged

    def usual(self, command: str) -> bytes | None:
        return self.damaged.pop(command, None) or super().usual(command)


def test_a_version_damaged_at_the_start_does_not_lock_the_unit_out(opened: Bench) -> None:
    garbled = b"* Pan-Tilt Controller v2.13.0(D46/E), (C)2004-2006 Dir%cted Perception, Inc."
    line = opened.line(Damaged(V=garbled))
    head = opened.head(line)
    assert "Directed Perception" in head.version
    line.hang_up()
    with pytest.raises(DriverError):
        head.read()
    line.come_back()
    assert answered(opened, head).faults == ()


@pytest.mark.parametrize("which", [0, 2])
def test_a_resolution_with_a_damaged_digit_does_not_scale_the_angles(opened: Bench, which: int) -> None:
    unit = ScriptedPtu()
    told = iter(
        [b"* 185.142857 seconds arc per Pan position"] * which
        + [b"* 135.142857 seconds arc per Pan position"]
    )
    usual = unit.usual
    unit.answers["PR"] = lambda command: next(told, None) or usual(command)
    unit.positions["P"] = 100
    head, _ = opened(unit)
    assert head.read().pan_rad == pytest.approx(100 * PAN_STEP_RAD)


class Behind(ScriptedPtu):
    """A unit whose answers about an axis's position come some such questions late."""

    lag = 0

    def __init__(self) -> None:
        super().__init__()
        self._held: dict[str, deque[bytes | None]] = {"PP": deque(), "TP": deque()}

    def reply(self, written: str) -> bytes | None:
        reply = super().reply(written)
        if written.upper() not in ("PP", "TP") or not self.lag:
            return reply
        self.positions = {axis: position + 1 for axis, position in self.positions.items()}
        held = self._held[written.upper()]
        held.append(reply)
        return held.popleft() if len(held) > self.lag else None


@pytest.mark.parametrize("lag", [1, 2, 3, 4])
def test_positions_of_some_questions_ago_are_no_reading(opened: Bench, lag: int) -> None:
    unit = Behind()
    head, _ = opened(unit)
    unit.lag = lag
    for _ in range(8):
        with pytest.raises(DriverError):
            head.read()


@pytest.mark.parametrize(("moves", "answer_s"), [(("pan", "tilt"), 0.03), (("pan",), 0.1), (("tilt",), 0.25)])
def test_both_angles_are_of_the_moment_of_the_reading(
    opened: Bench, moves: tuple[str, ...], answer_s: float
) -> None:
    clock, unit = opened.clock, ScriptedPtu()
    rates = {"P": 300.0 * ("pan" in moves), "T": -700.0 * ("tilt" in moves)}  # positions a second

    def told(command: str) -> bytes:
        axis = command[0]
        position = round(rates[axis] * clock.now_s())
        clock.sleep(answer_s)
        return f"* Current {'Pan' if axis == 'P' else 'Tilt'} position is {position}".encode()

    head, _ = opened(unit)
    clock.sleep(1.0)
    unit.answers = {"PP": told, "TP": told}
    for _ in range(2):  # the second one knows the axis that rests
        reading = head.read()
        pan_rad = rates["P"] * reading.time_s * PAN_STEP_RAD
        tilt_rad = rates["T"] * reading.time_s * TILT_STEP_RAD
        # The driver does not know when within the question's time on the wire the unit has looked: 4 ms.
        assert reading.pan_rad == pytest.approx(pan_rad, abs=(300 * 0.005 + 1) * PAN_STEP_RAD)
        assert reading.tilt_rad == pytest.approx(tilt_rad, abs=(700 * 0.005 + 1) * TILT_STEP_RAD)


def test_a_stopped_head_rests_only_after_its_settling_time(opened: Bench) -> None:
    head, _ = opened(settle_s=0.5)
    head.read()
    opened.clock.sleep(60.0)
    assert not head.read().moving
    head.stop()
    opened.clock.sleep(0.4)
    assert head.read().moving
    opened.clock.sleep(0.2)
    assert not head.read().moving


def test_only_silent_calls_in_a_row_make_the_line_be_opened_anew(
    opened: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.flir_ptu.head.SILENT_CALLS", 2)
    unit = ScriptedPtu()
    head, _ = opened(unit)
    unit.heard.clear()

    def silent_call() -> None:
        unit.answers["TP"] = lambda command: None
        with pytest.raises(NoReply):
            head.read()
        del unit.answers["TP"]

    for _ in range(3):
        silent_call()
        head.read()
    assert "V" not in unit.heard, "the unit is checked only after the line was opened anew"
    silent_call()
    silent_call()
    answered(opened, head)
    assert "V" in unit.heard
