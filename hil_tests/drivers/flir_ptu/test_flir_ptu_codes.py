"""A PTU's replies as the manuals and programs that talk to real units have them: understood, and simulated.

Each row is typed from its source, not taken from the driver or the simulator.
"""

from __future__ import annotations

import pytest

from drivers.flir_ptu import protocol
from drivers.flir_ptu.axis import BAUDS
from drivers.flir_ptu.protocol import answer_of, number_of
from drivers.flir_ptu.unit import supply_of
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.wire import ptu
from drivers.sim.wire.ptu import SimulatedPtu

D46_MANUAL = "PTU-D46 User's Manual 2.14.0"
D300_MANUAL = "PTU-D300 User's Manual 2.18.0"
MIRO = "Miro, PanTiltOpcodes.h: the texts of a Pan-Tilt Controller v1.09"
E_SERIES = "remarks of a public driver that was written on an E series unit"

REPLIES = [
    (D46_MANUAL, "PP * Current Pan position is 1000", "PP", protocol.POSITION["pan"], 1000),
    (D46_MANUAL, "PR * 185.1428 seconds arc per Pan position", "PR", protocol.RESOLUTION["pan"], 185.1428),
    (D300_MANUAL, "PR * 92.5714 seconds arc per position", "PR", protocol.RESOLUTION["pan"], 92.5714),
    (D300_MANUAL, "PN * Minimum Pan position is -3090", "PN", protocol.LOWEST["pan"], -3090),
    (D300_MANUAL, "PA * Pan acceleration is 2000 positions/sec^2", "PA", protocol.ACCELERATION["pan"], 2000),
    (MIRO, "TP * Current Tilt position is -5", "TP", protocol.POSITION["tilt"], -5),
    (MIRO, "TS * Target Tilt speed is 1000", "TS", protocol.SPEED["tilt"], 1000),
    (E_SERIES, "* 23.142857 seconds arc per position", "PR", protocol.RESOLUTION["pan"], 23.142857),
    (E_SERIES, "* Desired Pan speed is 2000 positions/sec", "PS", protocol.SPEED["pan"], 2000),
    (E_SERIES, "* Pan acceleration is 1000 positions/sec/sec", "PA", protocol.ACCELERATION["pan"], 1000),
]  # fmt: skip

REFUSALS = [
    (D300_MANUAL, "PP3200", "! Maximum allowable Pan position is 3090"),
]


@pytest.mark.parametrize(("source", "line", "command", "query", "number"), REPLIES)
def test_a_reply_of_a_real_unit_gives_its_number(
    source: str, line: str, command: str, query: protocol.Query, number: float
) -> None:
    answer = answer_of(line.encode(), command)
    assert query.letters == command
    assert answer is not None and answer.good, source
    assert number_of(answer.text, query.terms, verbose=True) == number, source


@pytest.mark.parametrize(("source", "command", "reply"), REFUSALS)
def test_a_refusal_of_a_real_unit_is_one_here_and_in_the_simulator(
    source: str, command: str, reply: str
) -> None:
    answer = answer_of(f"{command} {reply}".encode(), command)
    assert answer is not None and not answer.good and answer.text == reply[2:], source
    assert reply in simulated_reply(command)


def test_both_have_the_baud_rates_that_the_manuals_name() -> None:
    # D300 manual 2.19, 4.7: 9600 by default, 38,400 in the example; no list of all was found
    assert {9600, 38_400} <= set(BAUDS) and set(BAUDS) == set(ptu.BAUD_RATES)


def test_a_supply_as_the_manuals_give_it_is_understood() -> None:
    found = supply_of("Input 30 VDC @ 86 degF")
    assert found is not None and (found.volts, found.hottest_c) == (30.0, pytest.approx(30.0))


def simulated_reply(command: str) -> str:
    """What a simulated D46 sends for a command."""
    plain = AxisSettings(1e-4, 0.0, -3.0, 3.0, 1.0, 4.0)
    unit = SimulatedPtu("d46_17", WireAxis(plain, number=0), WireAxis(plain, number=1))
    replies = unit.receive(f"{command}\r".encode(), 0.0)
    return b"".join(one.data for one in replies).decode().replace("\r", " ").strip().replace("  ", " ")
