"""What is a Feetech head's own: its lease, its EEPROM, echo, byte order, faults, and the bench.

Everything runs on a clock that is turned. What every head has to do is in test_head_contract.py.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import (
    DriverError,
    HardwareFault,
    LineLost,
    NoReply,
    WatchdogTripped,
    WrongDevice,
)
from drivers.faults import FaultPanel
from drivers.feetech import servos as workshop
from drivers.feetech.head import FeetechHead, FeetechServo, halt, open_head
from drivers.feetech.servos import FeetechLink
from drivers.servo_bus.bench import ServoBench
from drivers.servo_bus.exchange import BusLink
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.wire.feetech_bus import FeetechBus
from drivers.sim.wire.feetech_servo import SimulatedFeetechServo
from drivers.sim.wire.line import MemoryLine
from drivers.simulation_clock import SimulationClock
from hil_tests.drivers.turned import START_S, HangingHost, Turned
from mastctl.cli.main import main
from mastctl.safety import state_folder

PLAIN = AxisSettings(math.tau / 4096, 0.0, -3.0, 3.0, 1.0, 4.0)


class Bench(Turned):
    """Two servos on a line in memory."""

    def __init__(self, model: str = "sts3215", echoes: bool = False, unit: int = 1, **settings: int) -> None:
        self.clock = SimulationClock(start_s=START_S)
        now_s = self.clock.now_s()
        self.panel = FaultPanel(self.clock.now_s, ())
        self.axes = [WireAxis(PLAIN, self.panel, number=n, time_s=now_s) for n in (0, 1)]
        self.servos = [
            SimulatedFeetechServo(
                model, n, axis, settings=settings if n == 1 else None, speed_unit_counts=unit, time_s=now_s
            )
            for n, axis in enumerate(self.axes, start=1)
        ]
        self.model = model
        self.line = MemoryLine(FeetechBus(self.servos, echoes=echoes), self.clock, self.panel)
        self.host = HangingHost(self.line.open, self.clock)

    def open(self, **changes: Any) -> FeetechHead:
        return open_head(self.options(**changes), self.clock, self.host)

    def options(self, **changes: Any) -> dict[str, Any]:
        pan = {"id": 1, "model": self.model.upper(), "limits_rad": [-1.0, 1.0]}
        tilt = {"id": 2, "model": self.model.upper(), "limits_rad": [-0.6, 0.4]}
        head = {"speed_rad_per_s": 1.2, "acceleration_rad_per_s2": 20.0, "reply_timeout_s": 0.1}
        return {"port": self.line.path, "pan": pan, "tilt": tilt, **head, **changes}

    def pan_rad(self) -> float:
        return self.axes[0].angle_rad(self.now_s())


@contextmanager
def bench(*how: Any, **more: Any) -> Iterator[Bench]:
    it = Bench(*how, **more)
    with it.clock.at_work(), it.line:
        yield it


@contextmanager
def opened(
    *how: Any, options: dict[str, Any] | None = None, **more: Any
) -> Iterator[tuple[Bench, FeetechHead]]:
    with bench(*how, **more) as it:
        head = it.open(**(options or {}))
        try:
            yield it, head
        finally:
            head.close()


def stall(it: Bench, seconds: float) -> None:
    """Keep the head from writing, as in a process that hangs."""
    with it.host.hanging():
        it.clock.sleep(seconds)


def test_a_head_whose_host_hangs_stands_when_its_lease_ends() -> None:
    with opened(options={"lease_s": 0.2}) as (it, head):
        head.move(0.9, 0.3)
        it.clock.sleep(0.3)
        began_s = it.now_s()
        ended = it.beside(lambda: stall(it, 2.0))
        it.clock.sleep(0.5)
        rested = it.pan_rad()
        assert it.axes[0].velocity_rad_per_s(it.now_s()) == 0.0
        stood_s = it.axes[0].motion.stood_since_s - began_s
        assert stood_s < 0.02 + 0.2 + 1.2 / 20 + 0.02, "last poll, lease, braking, rounding"
        assert rested < 0.85, "short of the goal"
        ended.wait()
        assert any("lease" in word for word in head.read().faults)
        it.clock.sleep(0.3)
        assert it.pan_rad() == pytest.approx(rested, abs=0.004), "it does not go on by itself"
        with pytest.raises(WatchdogTripped, match="stop lets the head move again"):
            head.move(0.0, 0.0)
        head.stop()
        head.move(0.0, 0.0)
        assert it.settled(head).pan_rad == pytest.approx(0.0, abs=0.004)


def test_without_a_lease_a_move_goes_on_until_halt_ends_it() -> None:
    with opened(options={"lease_s": 0}) as (it, head):
        head.move(0.9, 0.3)
        stall(it, 1.5)
        assert it.pan_rad() == pytest.approx(0.9, abs=0.002)
    with bench() as it:
        it.servos[0].memory["torque_enable"] = 1
        it.servos[0].write(41, bytes((100, 0x8C, 0x0A, 0, 0, 0x20, 3)), it.now_s())
        it.clock.sleep(0.3)
        told = halt(it.options(), it.clock, it.line.open)
        assert told == [
            "pan (servo 1) was commanded to stand where it is, and holds",
            "tilt (servo 2) has its torque off",
        ]
        rested = it.pan_rad()
        it.clock.sleep(0.5)
        assert it.pan_rad() == rested and 0.05 < rested < 0.9


@pytest.mark.parametrize("away", [False, True], ids=["there", "away"])
def test_torque_goes_off_only_when_the_axis_stands(away: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    with bench() as it:
        options = it.options(lease_s=0, acceleration_rad_per_s2=2.0)
        options["pan"]["at_close"] = "torque_off"
        head, plain, speeds = open_head(options, it.clock, it.line.open), FeetechServo.set, []

        def set_(servo: FeetechServo, name: str, value: int) -> None:
            if (name, value) == ("torque_enable", 0):
                speeds.append(it.axes[0].velocity_rad_per_s(it.now_s()))
            plain(servo, name, value)

        monkeypatch.setattr(FeetechServo, "set", set_)
        head.move(0.9, 0.3)
        it.until(lambda: it.axes[0].velocity_rad_per_s(it.now_s()) > 0.8, "motion")
        if away:
            it.line.hang_up()
            it.until(lambda: isinstance(failed(head), LineLost), "the line to be given up")
            it.line.come_back()
        head.close()
        assert not it.servos[0].memory["torque_enable"] and speeds == [0.0]
        assert it.servos[1].memory["torque_enable"] == 1


def test_permanent_settings_are_written_once_and_locked_again() -> None:
    with bench(return_delay=250) as it:
        it.open().close()
        first = [servo.eeprom_writes.copy() for servo in it.servos]
        assert first == [["return_delay", "min_angle", "max_angle"], ["min_angle", "max_angle"]]
        it.open().close()
        assert [servo.eeprom_writes for servo in it.servos] == first, "what is right is not written again"
        assert [servo.memory["lock"] for servo in it.servos] == [1, 1]
        assert [servo.memory["torque_limit"] for servo in it.servos] == [1000, 1000]
        it.servos[0].set_power(False, it.now_s())
        it.servos[0].set_power(True, it.now_s())
        assert it.servos[0].memory["return_delay"] == 0, "it was saved"


def test_closing_in_a_set_up_leaves_the_eeprom_locked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with opened(options={"lease_s": 0, "torque_off_at_start": True}) as (it, head):
        it.line.hang_up()
        it.until(lambda: isinstance(failed(head), LineLost), "the line to be given up")
        memory, plain, unlocked = it.servos[1].memory, FeetechServo.set, it.gate()
        memory["return_delay"] = 250  # somebody else has set it

        def set_late(servo: FeetechServo, name: str, value: int) -> None:
            if name == "return_delay" and not unlocked.is_open:
                unlocked.set()
                it.clock.sleep(0.005)  # the closing overtakes it
            plain(servo, name, value)

        monkeypatch.setattr(FeetechServo, "set", set_late)
        locks: list[tuple[int, int]] = []
        true_close = FeetechLink.close

        def close(link: FeetechLink) -> None:
            locks.append((memory["lock"], memory["torque_enable"]))
            true_close(link)

        monkeypatch.setattr(FeetechLink, "close", close)
        it.line.come_back()
        unlocked.wait()
        head.close()
        assert set(locks) == {(1, 1)}


def test_an_offset_in_the_eeprom_is_reported_and_never_written(caplog: pytest.LogCaptureFixture) -> None:
    with opened(offset=0x800 | 100) as (it, head):
        assert "an offset of -100 counts in its EEPROM; it is left as it is" in caplog.text
        assert head.read().pan_rad == pytest.approx(100 * math.tau / 4096)
        it.servos[0].memory["offset"] = 50
        it.line.hang_up()
        it.until(lambda: failed(head), "an error")
        it.line.come_back()
        it.until(lambda: isinstance(failed(head), WrongDevice), "the change to be told")
        assert "had the offset -100 in its EEPROM and has 50 now" in str(failed(head))
        assert "offset" not in it.servos[0].eeprom_writes


def failed(head: FeetechHead) -> DriverError | None:
    try:
        head.read()
    except DriverError as error:
        return error
    return None


def test_a_series_takes_a_servo_that_is_not_in_the_table() -> None:
    with bench() as it:
        it.servos[0].memory["model"] = it.servos[1].memory["model"] = 4242
        head = it.open(pan={"id": 1, "model": "STS", "limits_rad": [-1, 1]},
                       tilt={"id": 2, "model": "SMS", "limits_rad": [-0.5, 0.4]})  # fmt: skip
        head.move(0.2, 0.1)
        assert it.settled(head).pan_rad == pytest.approx(0.2, abs=0.002)
        head.close()


def test_an_adapter_that_echoes_is_found_out_and_costs_nothing() -> None:
    with opened(echoes=True) as (it, head):
        head.move(0.3, 0.1)
        assert it.settled(head).pan_rad == pytest.approx(0.3, abs=0.004)
        began_s = it.now_s()
        head.read()
        assert it.now_s() - began_s < 0.006, "no silence between one question and the next"


def test_a_servo_with_another_unit_of_speed_is_stopped_and_told() -> None:
    with opened(unit=50, options={"lease_s": 0.2, "speed_rad_per_s": 0.2}) as (it, head):
        head.move(0.9, 0.0)
        it.until(lambda: head.read().faults, "a fault")
        with pytest.raises(HardwareFault, match="set speed_unit_counts: 50"):
            head.move(0.0, 0.0)
        it.clock.sleep(0.5)
        assert it.pan_rad() < 0.5


def test_a_servo_that_unloads_itself_is_reported_and_moves_again() -> None:
    with opened() as (it, head):
        it.panel.set("pan_tilt", "temperature_ramp", rate_c_per_s=100.0, axis=0)
        it.until(lambda: head.read().faults, "a fault")
        (words,) = head.read().faults
        assert words.startswith("pan (servo 1) reports overheating") and words.endswith("its torque is off")
        with pytest.raises(HardwareFault, match="overheating"):
            head.move(0.1, 0.1)
        it.panel.clear()
        it.until(lambda: not head.read().faults, "its recovery")
        head.move(0.1, 0.1)
        assert it.settled(head).pan_rad == pytest.approx(0.1, abs=0.002)


# The bench


@pytest.fixture
def cli(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Bench]:
    with bench() as it:
        monkeypatch.setattr(state_folder, "SYSTEM", tmp_path / "no_such")
        monkeypatch.setattr(state_folder, "_home", lambda: tmp_path)
        monkeypatch.setattr(
            BusLink.__init__, "__kwdefaults__", {"clock": it.clock, "open_line": it.line.open}
        )
        monkeypatch.setattr(ServoBench.scan, "__defaults__", (it.clock, it.line.open))
        yield it


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, Any, str]:
    code = main(["rig", "servo", *words, "--family", "feetech", "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else None, err


def test_scan_and_info_read_feetech_servos_and_move_none(
    cli: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.servos[0].memory["offset"] = 0x800 | 7
    code, told, _ = run(capsys, "scan", cli.line.path)
    assert code == 0
    assert [(s["id"], s["baud"], s["model"], s["firmware"]) for s in told["servos"]] == [
        (n, 1_000_000, "STS3215", "3.10") for n in (1, 2)
    ]
    code, told, _ = run(capsys, "info", cli.line.path, "1")
    assert (code, told["model"]) == (0, "STS3215")
    assert told["registers"]["present_position"] == 2048 + 7
    assert told["registers"]["offset"] == -7 and "never writes it" in told["meanings"]["offset"]
    assert cli.pan_rad() == 0.0 and cli.servos[0].eeprom_writes == []


def test_no_question_raises_the_torque_above_the_servos_own_bound() -> None:
    with bench() as it:
        for servo in it.servos:
            servo.memory.update(max_torque=300, torque_limit=300, torque_enable=1)
        halt(it.options(), it.clock, it.line.open)
        assert all(280 < servo.memory["torque_limit"] <= 300 for servo in it.servos)


@pytest.mark.parametrize("mishap", [None, KeyboardInterrupt], ids=["the id is lost", "ctrl-c"])
def test_a_change_of_id_that_fails_leaves_the_eeprom_locked(
    mishap: type[BaseException] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*told: object) -> None:
        if mishap is not None:
            raise mishap

    with bench() as it:
        link = FeetechLink(it.line.path, 1_000_000, 0.05, clock=it.clock, open_line=it.line.open)
        monkeypatch.setattr(FeetechLink, "write_unanswered", lost)
        told = "the servo is left with the id 1 or 7 at 1000000 baud: 'mastctl rig servo scan memory"
        with pytest.raises(WrongDevice if mishap else NoReply, match=told):
            workshop.set_id(link, 1, 7)
        link.close()
        assert it.servos[0].memory["lock"] == 1


def test_set_id_works_on_feetech_servos(cli: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    code, told, _ = run(capsys, "set-id", cli.line.path, "1", "2")
    assert code == 1 and "id 2 is taken" in told["error"]["message"]
    code, told, err = run(capsys, "set-id", cli.line.path, "1", "7", "--new-baud", "500000")
    assert (code, told) == (0, {"id": 7, "old_id": 1, "baud": 500_000}), err
    assert (cli.servos[0].servo_id, cli.servos[0].baud, cli.servos[0].memory["lock"]) == (7, 500_000, 1)
