"""The FLIR PTU driver: what it takes for an answer, and what it does with odd firmwares and bad lines.

The answers are those printed in the manuals. How the driver behaves on a unit that moves is in
test_head_contract.py.
"""

from __future__ import annotations

import itertools
import json
import math
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.clock import SystemClock
from drivers.errors import (
    BadReply,
    DriverError,
    HardwareFault,
    LineLost,
    NoReply,
    OutOfRange,
    Refused,
    WrongDevice,
)
from drivers.flir_ptu.head import FlirPtu, open_head
from drivers.flir_ptu.protocol import LineSplitter, answer_of, hits_of, number_of
from drivers.flir_ptu.workshop import home
from drivers.interfaces import Reading
from drivers.sim.wire.line import PtyLine
from hil_tests.drivers.flir_ptu.scripted_ptu import OPTIONS, Bench, ScriptedPtu
from hil_tests.waiting import NET_S
from mastctl.cli.main import main

ARCSEC = math.pi / 180 / 3600
LINE_S = 0.05  # by then what a unit sends unasked has come
PAN_STEP_RAD, TILT_STEP_RAD = 185.142857 * ARCSEC, 46.285714 * ARCSEC


# What is an answer


@pytest.mark.parametrize(
    ("line", "good", "text", "echo"),
    [
        (b"* 22", True, "22", False),
        (b"*", True, "", False),
        (b"PP * 22", True, "22", True),
        (b"pp * Current Pan position is -2500", True, "Current Pan position is -2500", True),
        (
            b"\n! Maximum allowable Pan position is 3090",
            False,
            "Maximum allowable Pan position is 3090",
            False,
        ),
        (b"!T!T!P!P*", True, "", False),
        (b"!P PP * 22", True, "22", True),
        (b"PP !T* 22", True, "22", True),
        (b"!PPP * 22", True, "22", True),
        (b"! Illegal Command Entered", False, "Illegal Command Entered", False),
    ],
)
def test_answers_of_the_manuals_are_understood(line: bytes, good: bool, text: str, echo: bool) -> None:
    answer = answer_of(line, "PP")
    assert answer is not None
    assert (answer.good, answer.text, answer.echo) == (good, text, echo)


@pytest.mark.parametrize(
    "line", [b"", b"22", b"*22", b"* 2\xb2", b"TP * 22", b"PP", b"!P", b"PPP * 22", b"\x00* 22", b"Welcome *"]
)
def test_anything_else_is_no_answer(line: bytes) -> None:
    assert answer_of(line, "PP") is None


@pytest.mark.parametrize(
    ("text", "words", "number"),
    [
        ("Current Pan position is 22", ("current", "pan", "position"), 22),
        ("Current pan position is -0", ("current", "pan", "position"), 0),
        ("185.142857 seconds arc per Pan position", ("arc", "pan", "position"), 185.142857),
        ("Pan acceleration is 2000 positions/sec^2", ("pan", "acceleration"), 2000),
        ("Current Tilt position is 22", ("current", "pan", "position"), None),
        ("Target Pan position is 22", ("current", "pan", "position"), None),
        ("Current Pan position is 2 2", ("current", "pan", "position"), None),
        ("Current Pan position is 2:2", ("current", "pan", "position"), None),
        ("Current Pan position is", ("current", "pan", "position"), None),
        ("Current Pan p0sition is 22", ("current", "pan"), None),
        ("22", ("current", "pan", "position"), None),
    ],
)
def test_a_number_counts_only_in_the_answer_to_its_question(
    text: str, words: tuple[str, ...], number: float | None
) -> None:
    assert number_of(text, words, verbose=True) == number


def test_a_terse_number_stands_alone() -> None:
    assert number_of("-22", ("any",), verbose=False) == -22
    assert number_of("is 22", ("any",), verbose=False) is None


def test_limit_hits_are_found_and_errors_are_none() -> None:
    assert hits_of(b"!T!T!P!P*") == ("tilt", "tilt", "pan", "pan")
    assert hits_of(b"!P* 22") == ("pan",)
    assert hits_of(b"!PPP * 22") == ("pan",)
    assert hits_of(b"! Pan speed cannot exceed 600 pos/sec") == ()
    assert hits_of(b"!Pan") == ()


@settings(max_examples=300)
@given(st.binary(max_size=200), st.lists(st.integers(0, 200), max_size=8))
def test_no_bytes_break_the_parser_and_pieces_do_not_matter(data: bytes, cuts: list[int]) -> None:
    whole = LineSplitter()
    lines = whole.feed(data)
    piecewise, ends = LineSplitter(), sorted({0, len(data), *(min(cut, len(data)) for cut in cuts)})
    pieces = [line for a, b in itertools.pairwise(ends) for line in piecewise.feed(data[a:b])]
    assert pieces == lines and piecewise.clear() == whole.clear()
    for line in lines:
        answer = answer_of(line, "PP")
        if answer is not None:
            number_of(answer.text, ("current",), verbose=True)
            number_of(answer.text, ("current",), verbose=False)


# Odd firmwares


@pytest.mark.parametrize(
    ("verbose", "echo", "obeys", "start", "end", "e_series"),
    [
        (True, True, True, b"", b"\r", False),
        (False, False, False, b"", b"\r", False),
        (False, True, False, b"\n", b"\r\n", False),
        (True, False, False, b"\n", b"\r\n", True),
        (False, True, True, b"\n", b"\r\n", True),
    ],
)
def test_every_way_of_answering_gives_the_same_head(
    opened: Bench, verbose: bool, echo: bool, obeys: bool, start: bytes, end: bytes, e_series: bool
) -> None:
    unit = ScriptedPtu(verbose=verbose, echo=echo, obeys=obeys, start=start, end=end, e_series=e_series)
    unit.positions = {"P": 100, "T": -40}
    head, _ = opened(unit)
    reading = head.read()
    assert reading.pan_rad == pytest.approx(100 * PAN_STEP_RAD)
    assert reading.tilt_rad == pytest.approx(-40 * TILT_STEP_RAD)
    head.move(0.5, 0.2)
    assert unit.positions == {"P": round(0.5 / PAN_STEP_RAD), "T": round(0.2 / TILT_STEP_RAD)}


def test_opening_moves_nothing_and_ends_slaved_mode(opened: Bench) -> None:
    unit = ScriptedPtu()
    unit.positions, unit.slaved = {"P": 7, "T": 8}, {"P": 500, "T": -500}
    head, _ = opened(unit)
    assert unit.positions == {"P": 7, "T": 8} and unit.slaved is None
    head.close()
    assert not {"R", "RP", "RT", "DS", "DF", "DR", "LD"} & set(unit.heard), "never reset, never saved"
    assert not [command for command in unit.heard if command.startswith("W")], "step mode left alone"


def test_goals_are_rounded_to_the_nearest_step_and_start_together(opened: Bench) -> None:
    head, unit = opened()
    for steps in (10.4, 10.6, -10.4, -10.6):
        unit.heard.clear()
        head.move(steps * PAN_STEP_RAD, -steps * TILT_STEP_RAD)
        assert unit.positions == {"P": round(steps), "T": round(-steps)}
        assert unit.heard[-4:] == ["S", f"PP{round(steps)}", f"TP{round(-steps)}", "I"]


def test_sign_and_zero_turn_steps_into_the_masts_angles(opened: Bench) -> None:
    head, unit = opened(tilt={"limits_rad": [-0.3, 0.5], "sign": -1, "zero_rad": 0.1})
    head.move(0.0, 0.4)
    assert unit.positions["T"] == -round(0.3 / TILT_STEP_RAD)
    assert head.read().tilt_rad == pytest.approx(0.4, abs=TILT_STEP_RAD / 2)


def test_limits_go_into_the_unit(opened: Bench) -> None:
    _, unit = opened()
    low, high = round(-2.5 / PAN_STEP_RAD), round(2.5 / PAN_STEP_RAD)
    at = unit.heard.index(f"PNU{low}")
    assert unit.heard[at : at + 2] == [f"PNU{low}", f"PXU{high}"] and "LU" in unit.heard


@pytest.mark.parametrize(("steps", "reachable"), [(3090, True), (3091, False)])
def test_limits_may_go_as_far_as_the_unit_itself(opened: Bench, steps: int, reachable: bool) -> None:
    for ends in ([-steps, 0], [0, steps]):
        with ExitStack() as stack:
            if not reachable:
                stack.enter_context(pytest.raises(WrongDevice, match="the unit itself goes from"))
            opened(pan={"limits_rad": [end * PAN_STEP_RAD for end in ends]})


@pytest.mark.parametrize(("told", "right"), [("185.142857", True), ("92.571428", False)])
def test_a_unit_in_another_step_mode_is_refused(opened: Bench, told: str, right: bool) -> None:
    unit = ScriptedPtu()
    unit.resolutions["P"] = told
    with ExitStack() as stack:
        if not right:
            stack.enter_context(pytest.raises(WrongDevice, match="Either its step mode was changed"))
        opened(unit, pan={**OPTIONS["pan"], "resolution_arcsec": 185.0})


@pytest.mark.parametrize("answer", [b"* 0 seconds arc per Pan position", b"! Gear ratio unknown"])
def test_a_unit_without_a_resolution_has_to_be_homed(opened: Bench, answer: bytes) -> None:
    unit = ScriptedPtu()
    unit.answers["PR"] = answer
    with pytest.raises(DriverError, match=r"home it|Gear ratio unknown"):
        opened(unit)


def test_another_resolution_after_a_reset_is_taken_over(opened: Bench) -> None:
    head, unit = opened()
    head.move(0.5, 0.2)
    opened.settled(head)
    unit.resolutions = {"P": "92.571428", "T": "46.285714"}
    unit.limits["P"] = (-6180, 6180)
    unit.positions["P"] *= 2
    unit.answers["PP"] = b"* What"
    with pytest.raises(BadReply):
        head.read()
    del unit.answers["PP"]
    assert head.read().pan_rad == pytest.approx(0.5, abs=PAN_STEP_RAD / 2)
    head.move(0.25, 0.2)
    assert unit.positions["P"] == round(0.25 / (PAN_STEP_RAD / 2))


def test_speed_is_set_in_steps_a_second_within_what_the_unit_does(opened: Bench) -> None:
    head, unit = opened(speed_rad_per_s=0.5)
    head.move(0.1, 0.1)
    assert unit.speeds == {"P": int(0.5 / PAN_STEP_RAD), "T": int(0.5 / TILT_STEP_RAD)}
    head.move(0.2, 0.2, 0.1)
    assert unit.speeds["P"] == int(0.1 / PAN_STEP_RAD)
    head.move(0.2, 0.2, 100.0)
    assert unit.speeds == {"P": 2902, "T": 2902}
    head.move(0.2, 0.2, 31 * PAN_STEP_RAD)
    assert unit.speeds == {"P": 31, "T": int(31 * PAN_STEP_RAD / TILT_STEP_RAD)}


def test_a_speed_below_the_units_slowest_is_refused(opened: Bench) -> None:
    head, unit = opened(speed_rad_per_s=0.5)
    before = list(unit.heard)
    with pytest.raises(OutOfRange, match=r"is below the 0\.02783 rad/s at which the unit's pan axis"):
        head.move(0.2, 0.2, 30.99 * PAN_STEP_RAD)
    assert unit.heard == before


@pytest.mark.parametrize(("approach", "way"), [("positive", 1), ("negative", -1)])
def test_a_goal_is_approached_from_one_side(opened: Bench, approach: str, way: int) -> None:
    axis = {"limits_rad": [-2.5, 2.5], "approach": approach, "approach_rad": 20 * PAN_STEP_RAD}
    head, unit = opened(pan=axis)
    told = head.info.motion["pan"]
    assert told.count_rad == pytest.approx(PAN_STEP_RAD) and told.turn_to(-0.3) == way
    assert head.info.motion["tilt"].turn_to(-0.3) == 0
    for goal in (0.5, -0.3, -0.31, 2.5, -2.5):
        unit.heard.clear()
        head.move(goal, 0.0)
        opened.settled(head)
        steps = [int(command[2:]) for command in unit.heard if command.startswith("PP") and command != "PP"]
        assert steps[-1] == round(goal / PAN_STEP_RAD)
        if len(steps) == 2:
            assert 0 <= (steps[1] - steps[0]) * way <= 21
        else:
            assert abs(goal) in (0.5, 2.5), "only from the right side, or with no room"


def test_an_approach_ends_at_its_goal_though_no_client_reads(opened: Bench) -> None:
    axis = {"limits_rad": [-2.5, 2.5], "approach": "positive", "approach_rad": 20 * PAN_STEP_RAD}
    head, unit = opened(pan=axis)
    head.move(-0.5, 0.0)
    opened.clock.sleep(3.0)
    assert unit.positions["P"] == round(-0.5 / PAN_STEP_RAD)


# Bad lines


def test_a_refusal_carries_the_units_own_words(opened: Bench) -> None:
    head, unit = opened()
    unit.answers["S"] = b"! Pan-tilt is not feeling well"
    before = dict(unit.positions)
    with pytest.raises(Refused, match="refuses S: Pan-tilt is not feeling well"):
        head.move(0.1, 0.1)
    assert unit.positions == before
    head.read()


@pytest.mark.parametrize("step", ["S", "PP", "TP"])
def test_a_move_that_is_not_confirmed_step_by_step_never_starts(opened: Bench, step: str) -> None:
    head, unit = opened()
    goal = {"S": "S", "PP": f"PP{round(0.5 / PAN_STEP_RAD)}", "TP": f"TP{round(0.2 / TILT_STEP_RAD)}"}[step]
    usual = unit.usual
    unit.answers[goal] = lambda command: usual(command) and None
    with pytest.raises(NoReply, match=f"did not answer {goal} within its deadline"):
        head.move(0.5, 0.2)
    assert unit.positions == {"P": 0, "T": 0} and "I" not in unit.heard[-3:]
    del unit.answers[goal]
    assert head.read().pan_rad == 0.0
    head.move(-0.5, -0.2)
    assert unit.positions == {"P": -round(0.5 / PAN_STEP_RAD), "T": -round(0.2 / TILT_STEP_RAD)}


def test_a_damaged_digit_is_asked_again(opened: Bench) -> None:
    head, unit = opened()
    head.move(0.5, 0.2)
    at = opened.settled(head)[0]
    opened.clock.sleep(0.25)
    opened.settled(head)
    lies = iter([b"* Current Pan position is 9557"])
    usual = unit.usual
    unit.answers["PP"] = lambda command: next(lies, None) or usual(command)
    assert head.read().pan_rad == at


def test_positions_that_contradict_each_other_are_refused(opened: Bench) -> None:
    head, unit = opened()
    opened.settled(head)
    opened.clock.sleep(0.25)
    opened.settled(head)
    lies = itertools.count(1000, 300)
    unit.answers["PP"] = lambda command: f"* Current Pan position is {next(lies)}".encode()
    with pytest.raises(BadReply, match="gives pan positions that contradict each other: 1000, 1300"):
        head.read()


def test_a_limit_hit_stops_the_head_until_it_is_homed(opened: Bench) -> None:
    unit = ScriptedPtu()
    line = opened.line(unit)
    head = opened.head(line)
    opened.settled(head)
    head.move(0.2, 0.0)
    unit.heard.clear()
    unit.unasked = b"!P"
    opened.clock.sleep(LINE_S)
    reading = head.read()
    assert any("pan axis ran into its limit switch" in word for word in reading.faults)
    assert "H" in unit.heard
    with pytest.raises(HardwareFault, match="lost count of its position; home it"):
        head.move(0.1, 0.1)
    assert any("limit switch" in word for word in head.read().faults), "it does not go away by itself"
    head.close()
    unit.answers["R"] = b"!T!T!P!P*"
    home(line.path, 9600, opened.clock, line.open)
    assert "R" in unit.heard
    head = opened.head(line)
    assert head.read().faults == ()
    head.move(0.1, 0.1)


def test_a_limit_hit_of_a_resting_head_is_looked_into_and_forgotten(opened: Bench) -> None:
    head, unit = opened()
    opened.rested(head)
    before = head.read()
    unit.heard.clear()
    unit.unasked = b"!P"
    opened.clock.sleep(LINE_S)
    head.read()
    reading = head.read()
    assert reading.faults == () and (reading.pan_rad, reading.tilt_rad) == (before.pan_rad, before.tilt_rad)
    assert {"V", "LU", "PP"} <= set(unit.heard), "the unit was checked from version to limits"
    assert not [c for c in unit.heard if c.startswith(("PP", "TP")) and c[2:]], "and not moved"
    head.move(0.1, 0.1)


def test_a_limit_hit_of_a_head_that_has_moved_meanwhile_stays(opened: Bench) -> None:
    head, unit = opened()
    opened.rested(head)
    unit.unasked, unit.positions = b"!T!T!P!P*\r", {"P": 400, "T": 0}
    opened.clock.sleep(LINE_S)
    head.read()
    assert any("unit may have lost count" in word for word in head.read().faults)
    with pytest.raises(HardwareFault, match="home it"):
        head.move(0.1, 0.1)


@pytest.mark.parametrize(
    ("options", "answer", "words"),
    [
        ({}, "Input 23 VDC @ 95 degF", "the supply is 23.0 V, expected 24.0 V or more"),
        ({}, "Input 30 VDC @ 167 degF", "the unit is at 75 °C, expected 60 °C at most"),
        ({}, "30.1V,90F,158F,88F", "the unit is at 70 °C"),
        ({}, "Input 24 VDC @ 140 degF", ""),  # 60 degrees Celsius: both at their bounds
    ],
)
def test_supply_and_temperature_are_watched_while_the_head_rests(
    opened: Bench, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], answer: str, words: str
) -> None:
    monkeypatch.setattr("drivers.flir_ptu.unit.SUPPLY_EVERY_S", 0.0)
    unit = ScriptedPtu()
    unit.answers["O"] = b"* Input 30 VDC @ 86 degF"
    head, _ = opened(unit, **options)
    opened.settled(head)
    assert head.read().faults == ()
    unit.answers["O"] = f"* {answer}".encode()
    faults = head.read().faults
    assert words in "; ".join(faults) and bool(faults) == bool(words)
    unit.answers["O"] = b"* Input 30 VDC @ 86 degF"
    assert head.read().faults == ()


def test_every_move_ends_with_a_measured_supply(opened: Bench) -> None:
    unit = ScriptedPtu()
    unit.answers["O"] = b"* Input 30 VDC @ 86 degF"
    head, _ = opened(unit)
    opened.settled(head)
    assert head.read().faults == ()
    unit.answers["O"] = b"* Input 23 VDC @ 95 degF"
    assert head.read().faults == ()  # measured every 5 s while it rests
    head.move(0.001, 0.001)
    opened.settled(head)
    assert "the supply is 23.0 V, expected 24.0 V or more" in head.read().faults


def test_an_e46_has_to_be_told_its_resolution(opened: Bench) -> None:
    unit = ScriptedPtu()
    unit.answers["V"] = b"* Pan-Tilt Controller v3.2.2(E46-C14/E), (C)2011 FLIR Commercial Systems, Inc."
    with pytest.raises(WrongDevice, match="an E46, which does not know its gears before it was homed"):
        opened(unit)
    right = {
        "pan": {**OPTIONS["pan"], "resolution_arcsec": 46.2857},
        "tilt": {**OPTIONS["tilt"], "resolution_arcsec": 46.2857},
    }
    with pytest.raises(WrongDevice, match=r"pan position is 185.143 .*resolution_arcsec 46.2857. Either"):
        opened(unit, **right)
    unit.resolutions["P"], unit.limits["P"] = "46.285714", (-12366, 12366)
    opened(unit, **right)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the machine's clock a reply may come seconds late."""
    monkeypatch.setattr("drivers.flir_ptu.conversation.REPLY_S", NET_S)


@pytest.mark.usefixtures("patient")
def test_homing_by_command_needs_to_be_meant(capsys: pytest.CaptureFixture[str]) -> None:
    unit = ScriptedPtu()
    with PtyLine(unit, SystemClock(), wire_time=False) as line:
        assert main(["rig", "ptu", "home", line.path]) == 2
        assert "sweeps both axes over their full range" in capsys.readouterr().err
        assert unit.heard == []
        unit.positions = {"P": 3, "T": 4}
        unit.answers["R"] = lambda command: unit.positions.update(P=0, T=0) or b"!T!T!P!P*"
        assert main(["rig", "ptu", "home", line.path, "--sweep-full-range", "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told["pan"]["position"] == 0 and told["tilt"]["resolution_arcsec"] == 46.285714
        assert main(["rig", "ptu", "info", line.path]) == 0
        assert "resolution arcsec" in capsys.readouterr().out
    assert main(["rig", "ptu", "info", line.path, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "line_lost"


def answered(opened: Bench, head: FlirPtu) -> Reading:
    """Read until the line is back."""

    def reading() -> Reading | None:
        with suppress(LineLost):
            return head.read()
        return None

    return cast(Reading, opened.until(reading, "the line is back"))


def test_a_unit_that_lost_count_while_the_line_was_down_is_not_moved(opened: Bench) -> None:
    unit = ScriptedPtu()
    line = opened.line(unit)
    head = opened.head(line)
    head.move(0.5, 0.2)
    opened.settled(head)
    line.hang_up()
    with pytest.raises(LineLost, match=r"hung up|failed in"):
        head.read()
    with pytest.raises(LineLost):
        head.move(0.1, 0.1)
    unit.positions["P"] = 0
    line.come_back()
    unit.heard.clear()
    words = "pan was at 0.5000 rad before the connection was lost and is at 0.0"
    assert answered(opened, head).faults[0].startswith(words)
    assert unit.positions == {"P": 0, "T": round(0.2 / TILT_STEP_RAD)}, "it comes back without moving"
    assert {"LU", "PN", "PR", "H"} <= set(unit.heard), "and is checked again"
    with pytest.raises(HardwareFault, match="before the connection was lost"):
        head.move(0.1, 0.1)


def test_a_power_cycle_behind_an_open_line_is_noticed(opened: Bench) -> None:
    head, unit = opened(speed_rad_per_s=0.5)
    head.move(0.5, 0.2)
    opened.settled(head)
    unit.answers["PP"] = lambda command: None  # power gone for a moment; it comes back as it was delivered
    with pytest.raises(NoReply):
        head.read()
    del unit.answers["PP"]
    unit.positions, unit.speeds = {"P": 0, "T": 0}, {"P": 1000, "T": 1000}
    unit.heard.clear()
    words = head.read().faults
    assert [word.split()[0] for word in words] == ["pan", "tilt"] and "home it" in words[0]
    assert {"LU", "H"} <= set(unit.heard) and unit.positions == {"P": 0, "T": 0}


def test_another_unit_on_the_line_is_refused(opened: Bench) -> None:
    unit = ScriptedPtu()
    line = opened.line(unit)
    head = opened.head(line)
    line.hang_up()
    unit.answers["V"] = b"* Pan-Tilt Controller v3.02(D48)"
    with pytest.raises(LineLost):
        head.read()
    line.come_back()
    with pytest.raises(WrongDevice, match="another unit answers"):
        answered(opened, head)


def tries(call: Callable[[], object]) -> Callable[[], None]:
    """The call, whatever the driver says to it."""

    def tried() -> None:
        with suppress(DriverError):
            call()

    return tried


def test_a_stop_does_not_wait_for_a_call_under_way(opened: Bench) -> None:
    head, unit = opened()
    unit.answers["PP"] = lambda command: None
    reading = opened.begun(tries(head.read))
    opened.until(lambda: "PP" in unit.heard[-1:], "a question without an answer")
    before = len(unit.heard)
    head.stop()
    opened.ended(*reading)
    assert unit.heard[before] == "H", "it went out beside the reading"
    assert unit.heard[-1] == "H", "and once more in order"


def test_stops_into_a_question_that_is_answered_stay_in_step(opened: Bench) -> None:
    stops = 3
    head, unit = opened()
    asked = opened.clock.signal()
    began: list[bool] = []

    def late(command: str) -> bytes:
        with asked:
            began.append(True)
            asked.notify_all()
        opened.clock.sleep(0.01)  # meanwhile all stops are sent
        del unit.answers["PP"]
        return b"* Current Pan position is 0"

    readings: list[Any] = []
    unit.answers["PP"] = late
    unit.heard.clear()
    threads = opened.begun(lambda: readings.append(head.read()))
    with asked:
        while not began:
            asked.wait(NET_S)
    threads += opened.begun(*[head.stop] * stops)
    opened.ended(*threads)
    assert len(readings) == 1, "and the reading is made after the stop"
    assert unit.heard[: 2 + stops] == ["TP", "PP"] + ["H"] * stops
    assert not [command for command in unit.heard if command in ("PR", "TR")], "nobody asks for the step"


def test_a_move_that_a_stop_comes_into_is_not_started(opened: Bench) -> None:
    head, unit = opened()
    stopping: list[threading.Thread] = []

    def slaved(command: str) -> bytes:
        stopping.extend(opened.begun(head.stop))
        opened.clock.sleep(0.01)  # meanwhile the stop is sent
        return b"*"

    unit.answers["S"] = slaved
    unit.heard.clear()
    with pytest.raises(DriverError, match="a stop came before PP"):
        head.move(0.5, 0.2)
    opened.ended(*stopping)
    assert "I" not in unit.heard
    assert not head.read().moving


def test_a_stop_goes_out_before_a_unit_that_is_in_doubt_is_checked(opened: Bench) -> None:
    head, unit = opened()
    opened.rested(head)
    unit.unasked = b"!P"
    opened.clock.sleep(LINE_S)
    tries(lambda: head.move(0.1, 0.1))()
    unit.heard.clear()
    head.stop()
    assert unit.heard[0] == "H"


def test_a_move_into_which_a_limit_hit_comes_is_not_started(opened: Bench) -> None:
    head, unit = opened()
    opened.rested(head)
    unit.answers["S"] = b"!P*"
    unit.heard.clear()
    with pytest.raises(BadReply, match="reported a limit hit while it stood still"):
        head.move(0.5, 0.2)
    assert "I" not in unit.heard


def test_no_second_leg_follows_a_stop_that_was_not_confirmed(opened: Bench) -> None:
    axis = {"limits_rad": [-2.5, 2.5], "approach": "positive", "approach_rad": 20 * PAN_STEP_RAD}
    head, unit = opened(pan=axis)
    head.move(-0.5, 0.0)
    began = unit.positions["P"]
    unit.answers["H"] = lambda command: None
    with pytest.raises(DriverError):
        head.stop()
    for _ in range(5):
        head.read()
    assert unit.positions["P"] == began


@pytest.mark.parametrize("unasked", [b"* Current Pan position is 22\r", b"\xff\x80"])
def test_a_stop_is_sent_though_something_came_unasked(opened: Bench, unasked: bytes) -> None:
    head, unit = opened(ScriptedPtu(capitals=True))
    head.move(0.5, 0.2)
    unit.heard.clear()
    unit.unasked = unasked
    opened.clock.sleep(LINE_S)
    head.stop()
    assert unit.heard[0] == "H"
    assert unit.heard[-1] == "H", "and confirmed"


def test_a_stop_tries_a_line_that_is_away_at_once(opened: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.absent.FIRST_WAIT_S", NET_S)
    unit = ScriptedPtu()
    line = opened.line(unit)
    head = opened.head(line)
    line.hang_up()
    with pytest.raises(LineLost):
        head.read()
    line.come_back()
    unit.heard.clear()
    head.stop()
    assert unit.heard[0] == "H"


def test_a_unit_that_is_refused_leaves_the_line_to_the_next_try(opened: Bench) -> None:
    unit = ScriptedPtu()
    unit.resolutions["P"] = "92.571428"
    line = opened.line(unit)
    options = {**OPTIONS, "port": line.path, "pan": {**OPTIONS["pan"], "resolution_arcsec": 185.0}}
    refusals = []  # kept, and with them the heads that came to nothing
    for _ in range(2):
        with pytest.raises(WrongDevice) as refused:
            open_head(options, opened.clock, line.open)
        refusals.append(refused)
    unit.resolutions["P"] = "185.142857"
    open_head(options, opened.clock, line.open).close()
