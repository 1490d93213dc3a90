"""The simulated pan/tilt unit against the manuals' own examples, byte by byte, on a clock turned by hand."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.clock import ManualClock
from drivers.errors import BadOptions
from drivers.faults import PAN_TILT, FaultPanel
from drivers.sim.axis import AxisSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.ptu import SimulatedPtu
from drivers.sim.wire.ptu_axis import MODELS

AXIS = AxisSettings(
    count_rad=1e-5,
    backlash_rad=0.0,
    low_rad=-3.0,
    high_rad=3.0,
    speed_rad_per_s=1.0,
    acceleration_rad_per_s2=1.0,
)
POLL_S = 0.005


class Unit:
    """A unit that is asked without a line."""

    def __init__(self, model: str = "d46_17", **options: object) -> None:
        self.clock = ManualClock()
        self.panel = FaultPanel(self.clock.now_s, ())
        self.pan = WireAxis(AXIS, self.panel, number=0)
        self.tilt = WireAxis(AXIS, self.panel, number=1)
        self.device = SimulatedPtu(model, self.pan, self.tilt, **options)  # type: ignore[arg-type]

    def raw(self, data: bytes, wait_s: float = 0.0) -> bytes:
        """What is sent for bytes, at once and within a time."""
        sent = [reply.data for reply in self.device.receive(data, self.clock.now_s())]
        step_s = max(POLL_S, wait_s / 1000)
        for _ in range(round(wait_s / step_s)):
            self.clock.advance(step_s)
            sent += [reply.data for reply in self.device.poll(self.clock.now_s())]
        return b"".join(sent)

    def ask(self, command: str, wait_s: float = 0.0) -> str:
        """The answer without echo and framing."""
        sent = self.raw(command.encode() + b" ", wait_s).decode()
        return sent.removeprefix(command + " ").strip()

    def pass_s(self, duration_s: float) -> str:
        """What it sends meanwhile by itself."""
        return self.raw(b"", duration_s).decode()


@pytest.fixture
def unit() -> Unit:
    return Unit()


@pytest.mark.parametrize(
    ("command", "answer"),
    [  # the manuals' examples (D46 2.14.0, D300 2.18.0) and what drivers of real units look for
        ("PR", "* 185.1428 seconds arc per Pan position"),
        ("TR", "* 185.1428 seconds arc per Tilt position"),
        ("PP", "* Current Pan position is 0"),
        ("TP", "* Current Tilt position is 0"),
        ("PO", "* Target Pan position is 0"),
        ("PN", "* Minimum Pan position is -3090"),
        ("PX", "* Maximum Pan position is 3090"),
        ("TN", "* Minimum Tilt position is -907"),
        ("TX", "* Maximum Tilt position is 604"),
        ("PP3200", "! Maximum allowable Pan position is 3090"),
        ("pp4000", "! Maximum allowable Pan position is 3090"),
        ("tp-1900", "! Minimum allowable Tilt position is -907"),
        ("PS", "* Target Pan speed is 1000 positions/sec"),
        ("PS3300", "! Pan speed cannot exceed 2902 positions/sec"),
        ("PU", "* Maximum Pan speed is 2902 positions/sec"),
        ("PL", "* Minimum Pan speed is 31 positions/sec"),
        ("PL20", "! Motor speed cannot be less than 31 pos/sec"),
        ("PA", "* Pan acceleration is 2000 positions/sec^2"),
        ("PB", "* Current Pan base speed is 57 positions/sec"),
        ("L", "* Limit bounds are ENABLED (soft limits enabled)"),
        ("E", "* Echoing ON"),
        ("F", "* ASCII verbose mode"),
        ("PH", "* Pan in REGULAR hold power mode"),
        ("TM", "* Tilt in REGULAR move power mode"),
        ("O", "* Input 24 VDC @ 95 degF"),
        ("U", "* Unit ID is 0"),
        (
            "V",
            "* Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved",
        ),
        ("XYZ", "! Illegal Command Entered"),
        ("PP1.5", "! Illegal Command Entered"),
        ("B0,0,100,100", "! Illegal Command Entered"),
    ],
)
def test_answers_are_those_of_the_manuals(unit: Unit, command: str, answer: str) -> None:
    assert unit.ask(command) == answer


def test_echo_framing_and_delimiters(unit: Unit) -> None:
    assert unit.raw(b"PP ") == b"PP * Current Pan position is 0\r\n"
    assert unit.raw(b"pp\r") == b"pp\r* Current Pan position is 0\r\n"
    assert unit.raw(b"ED ") == b"ED *\r\n", "this command is still echoed"
    assert unit.raw(b"F") + unit.raw(b"T") + unit.raw(b" ") == b"*\r\n", "in pieces"
    assert unit.raw(b"PP TP \r PR ") == b"* 0\r\n* 0\r\n* 185.1428\r\n"


def test_an_e_series_unit_frames_with_line_feeds() -> None:
    unit = Unit("d48e")
    assert unit.raw(b"PR ") == b"\n* 23.142857 seconds arc per position\r\n"
    assert unit.raw(b"FT PP ") == b"\n*\r\n\n* 0\r\n"
    assert unit.raw(b"XX ") == b"\n! Illegal Command Entered\r\n"
    assert unit.device.banner and not Unit().device.banner


def test_a_move_takes_the_time_that_speed_and_acceleration_say(unit: Unit) -> None:
    assert unit.ask("PP1000") == "*"
    assert unit.ask("PO") == "* Target Pan position is 1000"
    unit.pass_s(0.5)  # 2000/s² for half a second is 1000/s after 250 positions
    assert unit.ask("PP") == "* Current Pan position is 250"
    assert unit.ask("PD") == "* Current Pan speed is 1000 positions/sec"
    unit.pass_s(0.5)
    assert unit.ask("PP") == "* Current Pan position is 750"
    unit.pass_s(0.5)
    assert unit.ask("PP") == "* Current Pan position is 1000"
    # 1296/7 arc seconds a position, counted to the left while the mast's pan grows to the right.
    assert unit.pan.mechanical_rad(2.0) == pytest.approx(-1000 * math.radians(1296 / 7 / 3600))


def test_offset_speed_on_the_fly_and_halt(unit: Unit) -> None:
    unit.ask("TP-500", 3.0)
    assert unit.ask("TO800") == "*" and unit.ask("TO") == "* Target Tilt position is 300"
    unit.pass_s(0.3)
    assert unit.ask("TS500") == "*"
    unit.pass_s(0.3)
    assert unit.ask("TD") == "* Current Tilt speed is 500 positions/sec"
    assert unit.ask("HT") == "*"
    unit.pass_s(1.0)
    rest = unit.ask("TP")
    unit.pass_s(1.0)
    assert unit.ask("TP") == rest != "* Current Tilt position is 300"
    assert unit.ask("TO") == rest.replace("Current", "Target")


def test_await_holds_the_answer_and_what_comes_after_it(unit: Unit) -> None:
    assert unit.ask("PP1000") == "*"
    assert unit.raw(b"A PP ") == b"A "
    assert unit.pass_s(1.4) == ""
    assert unit.pass_s(0.2) == "*\r\nPP * Current Pan position is 1000\r\n"


def test_slaved_moves_start_together(unit: Unit) -> None:
    for command in ("S", "PP500", "TP100"):
        assert unit.ask(command) == "*"
    unit.pass_s(2.0)
    assert unit.ask("PP") == "* Current Pan position is 0"
    assert unit.ask("A", 3.0) == "*"
    assert unit.ask("PP") == "* Current Pan position is 500"
    assert unit.ask("TP") == "* Current Tilt position is 100"
    assert unit.ask("I") == "*"


def test_a_reset_sweeps_the_range_and_tells_each_limit_before_its_answer(unit: Unit) -> None:
    seen: list[float] = []
    assert unit.raw(b"R ") == b"R "
    sent = ""
    for _ in range(300):
        sent += unit.pass_s(0.1)
        seen.append(unit.pan.angle_rad(unit.clock.now_s()))
    assert sent == "!T!T!P!P*\r\n"
    limit_rad = 3090 * math.radians(1296 / 7 / 3600)
    assert min(seen) < -0.95 * limit_rad and max(seen) > 0.95 * limit_rad
    assert unit.ask("PP") == "* Current Pan position is 0"


def test_a_step_mode_comes_into_force_with_a_reset_of_its_axis(unit: Unit) -> None:
    assert unit.ask("WP") == "* Pan in HALF step mode"
    assert unit.ask("WPE") == "*" and unit.ask("WP") == "* Pan in EIGHTH step mode"
    assert unit.ask("PR") == "* 185.1428 seconds arc per Pan position"
    assert unit.ask("RP", 30.0) == "!P!P*"
    assert unit.ask("PR") == "* 46.2857 seconds arc per Pan position"
    assert unit.ask("PX") == "* Maximum Pan position is 12360"
    assert unit.ask("PU") == "* Maximum Pan speed is 11608 positions/sec"
    for query in ("S", "A", "B"):  # a quarter of the step: four times as many for the same turn
        pan, tilt = (float(unit.ask(axis + query).split()[-2]) for axis in "PT")
        assert pan == 4 * tilt, query
    assert unit.ask("TR") == "* 185.1428 seconds arc per Tilt position", "the other axis is as it was"
    unit.ask("PP1000", 3.0)
    assert unit.pan.angle_rad(unit.clock.now_s()) == pytest.approx(-1000 * math.radians(1296 / 28 / 3600))


def test_a_unit_that_starts_in_another_step_mode_turns_as_fast() -> None:
    half, eighth = Unit(step_mode="H"), Unit(step_mode="E")
    for query in ("PS", "PA", "PB", "PU"):
        slow, fine = (float(one.ask(query).split()[-2]) for one in (half, eighth))
        assert fine == 4 * slow, query


def test_an_e46_does_not_know_its_gears_before_a_reset() -> None:
    unit = Unit("e46_70")
    assert unit.ask("PR") == "* 185.142857 seconds arc per position"
    assert unit.ask("R", 60.0) == "!T!T!P!P\n*"
    assert unit.ask("PR") == "* 46.285714 seconds arc per position"


def test_limits_factory_user_and_none(unit: Unit) -> None:
    for command in ("PNU-100", "PXU200", "LU"):
        assert unit.ask(command) == "*"
    assert unit.ask("PP201") == "! Maximum allowable Pan position is 200"
    assert unit.ask("PXU-101").startswith("! ")
    assert unit.ask("PXU4000") == "! Maximum allowable Pan position is 3090"
    assert unit.ask("LE") == "*" and unit.ask("PP201") == "*"
    assert unit.ask("LD") == "*"
    assert unit.ask("L") == "* Limit bounds are DISABLED (hard limits only: use care)"
    assert unit.ask("PP4000") == "*"
    assert unit.pass_s(10.0) == "!P", "the switch stops it, a little beyond the factory limit"
    assert 3090 < int(unit.ask("PP").split()[-1]) < 3200


def test_pure_velocity_runs_to_the_limit_and_tells_it(unit: Unit) -> None:
    assert unit.ask("CV") == "*"
    assert unit.ask("PP10").startswith("! ")
    assert unit.ask("PS-1000") == "*"
    unit.pass_s(1.0)
    assert unit.ask("PD") == "* Current Pan speed is -1000 positions/sec"
    assert unit.pass_s(5.0) == "!P"
    assert unit.ask("PP") == "* Current Pan position is -3090"
    assert unit.ask("CI") == "*" and unit.ask("PS") == "* Target Pan speed is 1000 positions/sec"


def test_a_limit_that_is_hit_is_told_before_the_next_answer(unit: Unit) -> None:
    unit.ask("LD")
    unit.ask("TP700")
    sent = unit.pass_s(3.0) + unit.raw(b"TP ").decode()
    assert sent == "!TTP * Current Tilt position is 624\r\n"


def test_a_new_acceleration_takes_the_unit_seconds(unit: Unit) -> None:
    assert unit.raw(b"PA4000 ", 1.0) == b"PA4000 ", "echoed, not answered"
    assert unit.pass_s(1.0) == "*\r\n"
    assert unit.ask("PA") == "* Pan acceleration is 4000 positions/sec^2"


def test_saving_wears_the_memory_and_comes_back(unit: Unit) -> None:
    unit.ask("PS500")
    unit.ask("DS")
    unit.ask("PS700")
    assert unit.ask("DR") == "*" and unit.ask("PS") == "* Target Pan speed is 500 positions/sec"
    assert unit.ask("DF") == "*" and unit.ask("PS") == "* Target Pan speed is 1000 positions/sec"
    assert unit.device.eeprom_writes == 1


def test_the_baud_rate_changes_after_the_answer(unit: Unit) -> None:
    assert unit.ask("@(19200,0,F)") == "*" and unit.device.baud == 9600
    unit.pass_s(0.1)
    assert unit.device.baud == 19200
    assert unit.ask("@(12345,0,F)") == "! Illegal Command Entered"


def test_position_and_speed_in_one_command_of_the_e_series() -> None:
    unit = Unit("d48e")
    assert unit.ask("B1000,-200,4000,3000") == "*"
    unit.pass_s(3.0)
    assert unit.ask("PP") == "* Current Pan position is 1000"
    assert unit.ask("TP") == "* Current Tilt position is -200"
    assert unit.ask("TS") == "* Target Tilt speed is 3000 positions/sec"
    assert unit.ask("B1000,-20000,4000,3000") == "! Minimum allowable Tilt position is -14000"


def test_faults_show_in_positions_volts_and_degrees(unit: Unit) -> None:
    unit.panel.set(PAN_TILT, "stuck", axis=0)
    unit.ask("PP500")
    unit.ask("TP100", 3.0)
    assert unit.ask("PP") == "* Current Pan position is 0"
    assert unit.ask("TP") == "* Current Tilt position is 100"
    unit.panel.clear()
    unit.pass_s(3.0)
    assert unit.ask("PP") == "* Current Pan position is 500"
    unit.panel.set(PAN_TILT, "voltage_dip", factor=0.5)
    unit.panel.set(PAN_TILT, "temperature_ramp", rate_c_per_s=10)
    unit.pass_s(1.0)
    assert unit.ask("O") == "* Input 12 VDC @ 113 degF"  # 35 °C and 10 more


def test_resolutions_are_the_known_ones() -> None:
    told = {name: model.half_step_arcsec for name, model in MODELS.items()}
    assert told["d46_17"] == pytest.approx(185.1428, abs=1e-4)
    assert told["d46_70"] / 4 == pytest.approx(11.57, abs=0.005), "eighth steps, marketed as 0.003°"
    assert told["d48e"] / 4 * 27067 / 3600 == pytest.approx(174.0, abs=0.01), "counts of a real unit's range"


def test_what_does_not_exist_is_refused() -> None:
    with pytest.raises(BadOptions, match=r"no pan/tilt unit 'd46'; did you mean 'd4"):
        Unit("d46")
    with pytest.raises(BadOptions, match=r"step mode 'X'"):
        Unit(step_mode="X")
    with pytest.raises(BadOptions, match="baud rate 1234"):
        Unit(baud=1234)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=40), max_size=8))
def test_any_bytes_are_answered_and_never_break_it(chunks: list[bytes]) -> None:
    unit = Unit()
    for chunk in chunks:
        unit.raw(chunk, 0.02)
    unit.raw(b" H ", 60.0)  # whatever was ordered, even a reset, is over by then
    unit.raw(b" FV ED ", 0.1)
    assert unit.raw(b"PR ") in (
        b"* 185.1428 seconds arc per Pan position\r\n",
        b"* 46.2857 seconds arc per Pan position\r\n",
    )
