"""`mastctl ptz info` on simulated VISCA and Pelco heads behind pseudo terminals."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any, Literal

import pytest

from drivers.clock import SystemClock
from drivers.sim.axis import AxisSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.line import PtyLine
from drivers.sim.wire.pelco import SimulatedPelco
from drivers.sim.wire.visca import SimulatedVisca
from mastctl.cli.main import main

COUNT_RAD = math.radians(0.075)
PLAIN = AxisSettings(COUNT_RAD, 0.0, -3.0, 3.0, 1.2, 10.0)
AGO_S = 10.0


class Chain:
    """Heads on one line."""

    def __init__(self, *heads: SimulatedVisca | SimulatedPelco) -> None:
        self.heads, self.baud = heads, heads[0].baud

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        return [reply for head in self.heads for reply in head.receive(data, time_s)]

    def poll(self, time_s: float) -> Sequence[Reply]:
        return [reply for head in self.heads for reply in head.poll(time_s)]


def axes(clock: SystemClock, *angles_rad: float) -> list[WireAxis]:
    """Two axes that stand at these angles."""
    made = [WireAxis(PLAIN, number=n, time_s=clock.now_s() - AGO_S) for n in (0, 1)]
    for axis, angle_rad in zip(made, angles_rad, strict=True):
        axis.goal(clock.now_s() - AGO_S, angle_rad, 1.2, 10.0)
    return made


def asked(capsys: pytest.CaptureFixture[str], device: Any, clock: SystemClock, *words: str) -> Any:
    """What the command says of the heads on a line."""
    with PtyLine(device, clock) as line:
        code = main(["ptz", "info", line.path, *words, "--json"])
    told = json.loads(capsys.readouterr().out)
    return told["heads"] if code == 0 else told["error"]


def test_every_visca_head_of_a_line_is_shown_and_none_moves(capsys: pytest.CaptureFixture[str]) -> None:
    clock = SystemClock()
    both = [axes(clock, 0.5, -0.2), axes(clock, 0.0, 0.1)]
    heads = [
        SimulatedVisca(*pair, count_rad=COUNT_RAD, fastest_rad_per_s=1.2, address=n, baud=38_400)
        for n, pair in zip((1, 4), both, strict=True)
    ]
    told = asked(capsys, Chain(*heads), clock)
    assert [(one["address"], one["baud"], one["driver"]) for one in told] == [
        (1, 38_400, "visca"),
        (4, 38_400, "visca"),
    ]
    for one, pair in zip(told, both, strict=True):
        now_s = clock.now_s()
        seen = [round(axis.angle_rad(now_s) / COUNT_RAD) for axis in pair]
        assert [one["pan_counts"], one["tilt_counts"]] == seen
        assert not any(axis.under_way(now_s) for axis in pair)


@pytest.mark.parametrize("protocol", ["D", "P"])
def test_a_pelco_head_at_an_unusual_rate_and_address_is_found_when_they_are_named(
    protocol: Literal["D", "P"], capsys: pytest.CaptureFixture[str]
) -> None:
    clock = SystemClock()
    head = SimulatedPelco(
        *axes(clock, 0.5, -0.2), fastest_rad_per_s=1.2, protocol=protocol, address=17, baud=19_200
    )
    told = asked(capsys, head, clock, "--baud", "19200", "--address", "17")
    assert told == [
        {"driver": "pelco", "protocol": protocol, "baud": 19_200, "address": 17,
         "pan_counts": 2865, "tilt_counts": 34_854}
    ]  # fmt: skip


def test_a_line_on_which_no_head_answers_is_told_with_what_to_name(
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock = SystemClock()
    head = SimulatedPelco(*axes(clock, 0.0, 0.0), fastest_rad_per_s=1.2, address=17)
    told = asked(capsys, head, clock, "--baud", "9600", "--address", "1")
    assert told["code"] == "no_head" and "--baud and --address name others" in told["message"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["--baud", "9600", "57600"],
            "--baud is 57600, expected one of 2400, 4800, 9600, 19200, 38400, 115200",
        ),
        (["--address", "300"], "--address is 300, expected 1 to 254"),
        (["--address", "0"], "--address is 0, expected 1 to 254"),
        (["udp://127.0.0.1", "--address", "9"], "--address is 9, expected 1 to 7"),
    ],
)
def test_a_rate_or_an_address_that_no_head_has_is_refused_before_the_line_is_opened(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ptz", "info", *([] if "://" in words[0] else ["/dev/not-there"]), *words, "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert (error["code"], error["message"]) == ("bad_options", told)
