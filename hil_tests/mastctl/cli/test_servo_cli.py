"""`mastctl rig servo`: finding, reading and numbering simulated servos on a turned clock."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.servo_bus.bench import ServoBench
from drivers.servo_bus.exchange import BusLink
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import OVERLOAD, SimulatedServo
from drivers.sim.wire.line import MemoryLine
from drivers.simulation_clock import SimulationClock
from mastctl.cli.main import main
from mastctl.safety import state_folder

BAUD = "1000000"
PLAIN = AxisSettings(math.tau / 4096, 0.0, -3.0, 3.0, 1.0, 4.0)


class Bench:
    """Two servos of different models on one line."""

    def __init__(self) -> None:
        self.clock = SimulationClock(start_s=1000.0)
        now_s = self.clock.now_s()
        self.axes = [WireAxis(PLAIN, number=n, time_s=now_s) for n in (0, 1)]
        self.servos = [
            SimulatedServo(model, i + 1, axis, settings={"baud_rate": 3}, time_s=now_s)
            for i, (model, axis) in enumerate(zip(("xm430_w350", "ph42_020_s300"), self.axes, strict=True))
        ]
        self.line = MemoryLine(DynamixelBus(self.servos), self.clock)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Bench]:
    it = Bench()
    monkeypatch.setattr(state_folder, "SYSTEM", tmp_path / "no_such")
    monkeypatch.setattr(state_folder, "_home", lambda: tmp_path)  # a line in memory has a true line's name
    monkeypatch.setattr(BusLink.__init__, "__kwdefaults__", {"clock": it.clock, "open_line": it.line.open})
    monkeypatch.setattr(ServoBench.scan, "__defaults__", (it.clock, it.line.open))
    with it.clock.at_work(), it.line:
        yield it


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, Any, str]:
    """The exit code, what was printed (JSON where asked for), and what was told."""
    code = main(["rig", "servo", *words])
    out, err = capsys.readouterr()
    return code, json.loads(out) if "--json" in words else out, err


def test_scan_finds_every_servo_with_its_rate_and_moves_none(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.servos[1].raise_error(OVERLOAD)
    code, told, _ = run(capsys, "scan", bench.line.path, "--baud", "3000000", BAUD, "--json")
    assert code == 0
    assert [(s["id"], s["model"], s["baud"]) for s in told["servos"]] == [
        (1, "XM430-W350", 1_000_000),
        (2, "PH42-020-S300", 1_000_000),
    ]
    assert [s["hardware_errors"] for s in told["servos"]] == [[], ["overload"]]
    now_s = bench.clock.now_s()
    assert [axis.angle_rad(now_s) for axis in bench.axes] == [0.0, 0.0]


def test_info_tells_every_register_in_numbers_and_words(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told, _ = run(capsys, "info", bench.line.path, "1", "--baud", BAUD, "--json")
    assert code == 0
    for name, value in told["registers"].items():
        known = bench.servos[0].table.values.get(name)
        measured = name.startswith(("present_", "realtime", "moving")) or name.endswith("trajectory")
        if known is not None and not measured:
            assert value == known, name
    assert told["meanings"]["operating_mode"] == "position"
    assert told["meanings"]["baud"] == "1000000 baud"
    assert told["meanings"]["profile_velocity"] == "as fast as it can"
    assert told["meanings"]["present_voltage"] == "12.0 V"
    code, out, _ = run(capsys, "info", bench.line.path, "2", "--baud", BAUD)
    assert code == 0
    assert "PH42-020-S300" in out


def test_set_id_changes_id_and_rate_and_checks_both(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("set-id", bench.line.path, "1", "7", "--baud", BAUD, "--json")
    code, told, _ = run(capsys, *words)
    assert (code, told) == (0, {"id": 7, "old_id": 1, "baud": 1_000_000})
    assert bench.servos[0].servo_id == 7
    code, told, _ = run(capsys, "set-id", bench.line.path, "7", "7", *words[4:], "--new-baud", "2000000")
    assert (code, told) == (0, {"id": 7, "old_id": 7, "baud": 2_000_000})
    assert bench.servos[0].baud == 2_000_000


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (("1", "2"), 1, "id 2 is taken by a PH42-020-S300"),
        (("1", "3", "--new-baud", "1234"), 2, "1234 baud cannot be"),
        (("9", "3"), 1, "servo 9 .* no usable answer to ping"),
    ],
)
def test_set_id_refuses_what_cannot_be(
    bench: Bench, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], code: int, error: str
) -> None:
    got, out, err = run(capsys, "set-id", bench.line.path, *words, "--baud", BAUD)
    assert (got, out) == (code, "")
    assert re.search(error, err), err
    assert [servo.servo_id for servo in bench.servos] == [1, 2]


def test_set_id_drops_torque_only_when_told_to(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.servos[0].table["torque_enable"] = 1
    words = ("set-id", bench.line.path, "1", "5", "--baud", BAUD)
    code, _, err = run(capsys, *words)
    assert code == 1
    assert "--torque-off" in err
    assert bench.servos[0].table["torque_enable"] == 1
    code, _, err = run(capsys, *words, "--torque-off")
    assert code == 0
    assert (bench.servos[0].servo_id, bench.servos[0].table["torque_enable"]) == (5, 0)


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("info", "foo://x", "1"), "expected a serial device or socket"),
        (("info", "PORT", "1", "--family", "flir_ptu"), "--family is 'flir_ptu', expected one of dynamixel"),
    ],
)
def test_wrong_use_is_one_line_and_exit_2(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], error: str
) -> None:
    code, out, err = run(capsys, *words)
    assert (code, out) == (2, "")
    assert error in err
    assert err.count("\n") == 1
