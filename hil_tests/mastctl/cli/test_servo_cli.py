"""`mastctl servo`: finding, reading, numbering and trying simulated servos on a turned clock."""

from __future__ import annotations

import json
import math
import re
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.dynamixel import registers, workshop
from drivers.dynamixel.link import Link
from drivers.errors import HardwareFault, OutOfRange, WrongDevice
from drivers.sim.axis import AxisSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import OVERLOAD, SimulatedServo
from drivers.sim.wire.memory_line import MemoryLine
from drivers.simulation_clock import SimulationClock
from mastctl.cli.main import main
from mastctl.safety import heads

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
    monkeypatch.setattr(heads, "SYSTEM", tmp_path / "no_such")
    monkeypatch.setattr(heads, "_home", lambda: tmp_path)  # the name of a line in memory is a true line's
    monkeypatch.setattr(Link.__init__, "__kwdefaults__", {"clock": it.clock, "open_line": it.line.open})
    monkeypatch.setattr(workshop.scan, "__defaults__", (it.clock, it.line.open))
    with it.clock.at_work(), it.line:
        yield it


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, Any, str]:
    """The exit code, what was printed (JSON where asked for), and what was told."""
    code = main(["servo", *words])
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


def test_scan_that_finds_nobody_says_what_to_look_at(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(capsys, "scan", bench.line.path, "--baud", "3000000")
    assert (code, out) == (1, "")
    assert "no servo answered" in err
    assert "is its power on" in err


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
    assert told["words"]["operating_mode"] == "position"
    assert told["words"]["baud"] == "1000000 baud"
    assert told["words"]["profile_velocity"] == "as fast as it can"
    assert told["words"]["present_voltage"] == "12.0 V"
    code, out, _ = run(capsys, "info", bench.line.path, "2", "--baud", BAUD)
    assert code == 0
    assert "PH42-020-S300" in out


def called(bench: Bench, number: int) -> None:
    """Have the first servo give another model number."""
    bench.servos[0].model = replace(bench.servos[0].model, number=number)
    bench.servos[0].table["model_number"] = number


def test_info_reads_a_servo_that_is_not_driven_by_the_sdks_table(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    called(bench, 1270)  # XW430-T333, whose table is an XM430's without the LED
    bench.servos[0].table["homing_offset"] = -12
    code, told, _ = run(capsys, "info", bench.line.path, "1", "--baud", BAUD, "--json")
    assert (code, told["model"]) == (0, "xw430_t333")
    names = {r.name for r in bench.servos[0].model.registers} - {"led"}
    assert names - told["registers"].keys() == {"startup_configuration", "backup_ready", "secondary_id"}
    assert told["registers"]["homing_offset"] == -12
    assert told["registers"]["present_position"] == 2048 - 12
    code, _, err = run(capsys, "test", bench.line.path, "1", "--baud", BAUD)
    assert code == 1
    assert "the driver does not know the xw430_t333 (model number 1270)" in err and "Needed is a row" in err


def test_a_servo_that_nobody_knows_is_told_by_its_number_and_what_is_needed(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    called(bench, 9999)
    code, _, err = run(capsys, "info", bench.line.path, "1", "--baud", BAUD)
    assert code == 1
    assert "the model number 9999" in err and "dynamixel-sdk that holds its .model table" in err


def test_set_id_changes_id_and_rate_and_checks_both(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("set-id", bench.line.path, "1", "7", "--baud", BAUD, "--json")
    code, told, _ = run(capsys, *words)
    assert (code, told) == (0, {"id": 7, "old_id": 1, "baud": 1_000_000})
    assert bench.servos[0].servo_id == 7
    code, told, _ = run(capsys, "set-id", bench.line.path, "7", "7", *words[4:], "--new-baud", "2000000")
    assert (code, told) == (0, {"id": 7, "old_id": 7, "baud": 2_000_000})
    assert bench.servos[0].baud == 2_000_000


def test_two_axes_in_one_case_keep_one_baud_rate(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.servos[:] = [
        SimulatedServo("2XL430-W250-T", n, axis, settings={"baud_rate": 3}, time_s=bench.clock.now_s())
        for n, axis in enumerate(bench.axes, start=1)
    ]
    bench.line.device = DynamixelBus(bench.servos)
    words = ("set-id", bench.line.path, "1", "1", "--baud", BAUD, "--new-baud", "2000000")
    assert run(capsys, *words)[0] == 0
    code, told, _ = run(capsys, "scan", bench.line.path, "--baud", BAUD, "2000000", "--json")
    assert code == 0
    assert [(s["id"], s["model"], s["baud"]) for s in told["servos"]] == [
        (n, "2XL430-W250", 2_000_000) for n in (1, 2)
    ]


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (("1", "2"), 1, "id 2 is taken by a PH42-020-S300"),
        (("1", "253"), 2, "an id is 0 to 252"),
        (("1", "1"), 2, "there is nothing to do"),
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


def test_set_id_that_is_broken_off_says_what_the_servo_is_left_with_and_how_to_go_on(
    bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("set-id", bench.line.path, "1", "7", "--baud", BAUD, "--new-baud", "2000000", "--json")
    plain = workshop._change

    def lost(link: Link, servo_id: int, model: Any, register: str, value: int) -> None:
        if register == "baud":
            raise KeyboardInterrupt
        plain(link, servo_id, model, register, value)

    with monkeypatch.context() as patched:
        patched.setattr(workshop, "_change", lost)
        code, told, _ = run(capsys, *words)
    assert code == 1
    assert told["error"]["message"] == (
        f"interrupted; the servo is left with the id 7 at {BAUD} or 2000000 baud: 'mastctl servo scan "
        f"{bench.line.path} --baud {BAUD} 2000000' shows which, and 'mastctl servo set-id {bench.line.path} "
        f"7 7 --baud {BAUD} --new-baud 2000000' gives the id 7 its rate"
    )
    code, told, _ = run(capsys, "set-id", bench.line.path, "7", "7", *words[4:])
    assert (code, told["id"], told["baud"]) == (0, 7, 2_000_000)


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


def test_test_turns_a_little_to_each_side_and_leaves_the_servo_as_it_was(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    before = dict(bench.servos[0].table.values)
    words = ("test", bench.line.path, "1", "--baud", BAUD, "--degrees", "3", "--json")
    code, told, err = run(capsys, *words)
    assert code == 0, err
    assert "servo 1 is to turn 3 degrees to each side" in err
    reach = math.ceil(3 / told["count_deg"])
    assert [step["goal_counts"] for step in told["steps"]] == [2048 + reach, 2048 - reach, 2048]
    assert all(abs(step["left_counts"]) <= 1 for step in told["steps"])
    assert all(0.0 <= step["most_current_A"] < 2.3 for step in told["steps"])  # an XM430 stalls at 2.3 A
    for name in ("torque_enable", "profile_velocity", "profile_acceleration", "goal_pwm", "bus_watchdog"):
        assert bench.servos[0].table[name] == before[name], name


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"operating_mode": 1}, "is in velocity mode"),
        ({"hardware_error_status": 32}, "reports overload"),
        ({"max_position_limit": 2060}, "position limits 0 to 2060"),
        ({"temperature_limit": 40}, "near its limit of 40 C"),
        ({"min_voltage_limit": 130}, "reports input voltage out of its limits"),
    ],
)
def test_test_refuses_an_unfit_servo_and_moves_nothing(
    bench: Bench, capsys: pytest.CaptureFixture[str], change: dict[str, int], error: str
) -> None:
    for name, value in change.items():
        bench.servos[0].table[name] = value
    code, _, err = run(capsys, "test", bench.line.path, "1", "--baud", BAUD)
    assert code == 1
    assert error in err
    assert bench.axes[0].angle_rad(bench.clock.now_s()) == 0.0
    assert bench.servos[0].table["torque_enable"] == 0


def quiet_link(bench: Bench) -> Link:
    return Link(bench.line.path, int(BAUD))


def deaf_to(bench: Bench, monkeypatch: pytest.MonkeyPatch, *registers: str) -> None:
    """The first servo neither does nor answers writes to some registers any more."""
    servo = bench.servos[0]
    deaf = {servo.model.by_name[name].address for name in registers}
    true_write = servo.write

    def write(address: int, data: bytes, time_s: float, **how: Any) -> None:
        if address in deaf:
            raise TimeoutError
        true_write(address, data, time_s, **how)

    true_receive = bench.line.device.receive

    def receive(data: bytes, time_s: float) -> Any:
        try:
            return true_receive(data, time_s)
        except TimeoutError:
            return ()

    monkeypatch.setattr(servo, "write", write)
    monkeypatch.setattr(bench.line.device, "receive", receive)


def test_test_restores_the_torque_first_and_all_the_rest_whatever_fails(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    servo = bench.servos[0]
    before = dict(servo.table.values)
    link = quiet_link(bench)
    true_step = workshop._step

    def step(*how: Any) -> Any:
        deaf_to(bench, monkeypatch, "bus_watchdog", "profile_acceleration")
        return true_step(*how)

    monkeypatch.setattr(workshop, "_step", step)
    with pytest.raises(WrongDevice, match="left as it was found in bus_watchdog and profile_acc"):
        workshop.try_out(link, 1, math.radians(1), 30.0)
    link.close()
    for name in ("torque_enable", "profile_velocity", "goal_pwm"):
        assert servo.table[name] == before[name], name


def test_test_says_that_the_torque_may_be_on_and_what_went_wrong_before(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = quiet_link(bench)

    def step(*how: Any) -> Any:
        deaf_to(bench, monkeypatch, "torque_enable")
        raise HardwareFault("it is blocked")

    monkeypatch.setattr(workshop, "_step", step)
    words = "^it is blocked; and servo 1 is not left as it was found in torque_enable: its torque may be on"
    with pytest.raises(WrongDevice, match=words):
        workshop.try_out(link, 1, math.radians(1), 30.0)
    link.close()
    assert bench.servos[0].table["goal_pwm"] == 885


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_test_that_is_ended_leaves_the_servo_as_it_was(
    bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    before = dict(bench.servos[0].table.values)
    true_step = workshop._step

    def step(*how: Any) -> Any:
        signal.raise_signal(number)
        return true_step(*how)

    monkeypatch.setattr(workshop, "_step", step)
    handlers = [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGHUP)]
    code, _, err = run(capsys, "test", bench.line.path, "1", "--baud", BAUD, "--degrees", "3")
    assert code == 128 + number, err
    for name in ("torque_enable", "profile_velocity", "profile_acceleration", "goal_pwm", "bus_watchdog"):
        assert bench.servos[0].table[name] == before[name], name
    assert [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGHUP)] == handlers


def test_a_test_after_one_that_was_killed_works_at_once(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    table = bench.servos[0].table
    table.values.update({"torque_enable": 1, "goal_pwm": 88, "bus_watchdog": 255, "goal_position": 2300})
    code, _, err = run(capsys, "test", bench.line.path, "1", "--baud", BAUD, "--degrees", "3", "--json")
    assert code == 0, err
    assert (table["torque_enable"], table["bus_watchdog"], table["goal_position"]) == (1, 0, 2048)


@pytest.mark.parametrize("interrupted", ["torque_enable", "goal_pwm"])
def test_a_second_ctrl_c_leaves_nothing_unrestored(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, interrupted: str
) -> None:
    servo, link = bench.servos[0], quiet_link(bench)
    before = dict(servo.table.values)
    true_write, hits = link.write, iter([True])
    restoring = False

    def write(servo_id: int, register: Any, value: int) -> None:
        if restoring and register.name == interrupted and next(hits, False):
            raise KeyboardInterrupt
        true_write(servo_id, register, value)

    def step(*how: Any) -> Any:
        nonlocal restoring
        restoring = True
        raise KeyboardInterrupt

    monkeypatch.setattr(link, "write", write)
    monkeypatch.setattr(workshop, "_step", step)
    with pytest.raises(KeyboardInterrupt):
        workshop.try_out(link, 1, math.radians(1), 30.0)
    link.close()
    for name in ("torque_enable", "profile_velocity", "profile_acceleration", "goal_pwm", "bus_watchdog"):
        assert servo.table[name] == before[name], name


def test_a_servo_that_ctrl_c_could_not_leave_as_it_was_is_told(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = quiet_link(bench)

    def step(*how: Any) -> Any:
        deaf_to(bench, monkeypatch, "torque_enable")
        raise KeyboardInterrupt

    monkeypatch.setattr(workshop, "_step", step)
    words = "^interrupted; and servo 1 is not left as it was found in torque_enable: its torque may be on"
    with pytest.raises(WrongDevice, match=words):
        workshop.try_out(link, 1, math.radians(1), 30.0)
    link.close()


@pytest.mark.parametrize("lost", ["goal_pwm", "profile_velocity", "profile_acceleration"])
def test_test_begins_only_when_it_is_certain_to_be_slow_and_weak(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, lost: str
) -> None:
    servo, link = bench.servos[0], quiet_link(bench)
    true_write, lose = link.write, iter([True])
    at_torque: dict[str, int] = {}

    def write(servo_id: int, register: Any, value: int) -> None:
        if register.name == lost and next(lose, False):
            return  # the instruction was lost, and a repeated answer to the last one taken for its own
        if register.name == "torque_enable" and value:
            at_torque.update(servo.table.values)
        true_write(servo_id, register, value)

    monkeypatch.setattr(link, "write", write)
    workshop.try_out(link, 1, math.radians(1), 30.0)
    link.close()
    slow_and_weak = {"goal_pwm": 266, "profile_velocity": 8, "profile_acceleration": 3}  # 0.2 rad/s, 1 rad/s2
    assert {name: at_torque[name] for name in slow_and_weak} == slow_and_weak


def test_test_stops_at_its_fence(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    # A servo that does not stand where it was sent: here one whose place is misread by 100 counts.
    link = Link(bench.line.path, int(BAUD))
    true_decode = registers.RegisterBlock.decode

    def misread(block: registers.RegisterBlock, data: bytes) -> dict[str, int]:
        values = true_decode(block, data)
        return {**values, "present_position": values["present_position"] + 100}

    monkeypatch.setattr(registers.RegisterBlock, "decode", misread)
    with pytest.raises(OutOfRange, match="left the fence"):
        workshop.try_out(link, 1, math.radians(3), 30.0)
    link.close()
    assert bench.servos[0].table["torque_enable"] == 0


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("test", "PORT", "1", "--degrees", "90"), "at most 20"),
        (("test", "PORT", "1", "--torque-percent", "101"), "at most 100"),
        (("info", "PORT", "one"), "whole number"),
        (("info", "foo://x", "1"), "protocol 'foo' not known"),
        (
            ("test", "PORT", "1", "--family", "pelco"),
            "no servos: 'mastctl ptz info PORT' asks it, 'mastctl c",
        ),
        (("info", "PORT", "1", "--family", "flir_ptu"), "no servos: 'mastctl ptu info PORT' asks it"),
        ((), "WHAT"),
    ],
)
def test_wrong_use_is_one_line_and_exit_2(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], error: str
) -> None:
    code, out, err = run(capsys, *words)
    assert (code, out) == (2, "")
    assert error in err
    assert err.count("\n") == 1


def test_a_port_that_is_not_there_is_told_with_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    code, told, _ = run(capsys, "info", "/dev/no-such-port", "1", "--json")
    assert code == 1
    assert told["error"]["code"] == "line_lost"
    assert told["error"]["message"] == "/dev/no-such-port cannot be opened: no such file or directory"
