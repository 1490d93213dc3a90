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

from drivers.clock import SystemClock
from drivers.errors import (
    BadOptions,
    DriverError,
    HardwareFault,
    LineLost,
    NoReply,
    WatchdogTripped,
    WrongDevice,
)
from drivers.faults import FaultPanel
from drivers.feetech import workshop
from drivers.feetech.head import FeetechHead, halt, open_head
from drivers.feetech.link import FeetechLink, open_link
from drivers.feetech.servo import FeetechServo
from drivers.feetech.settings import feetech_settings
from drivers.servo_bus.rest import Rest
from drivers.sim.axis import AxisSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.feetech_bus import FeetechBus
from drivers.sim.wire.feetech_servo import SimulatedFeetechServo
from drivers.sim.wire.line import PtyLine
from drivers.sim.wire.memory_line import MemoryLine
from drivers.simulation_clock import SimulationClock
from hil_tests.drivers.turned import START_S, Turned
from hil_tests.waiting import NET_S
from mastctl.cli.main import main
from mastctl.safety import heads

PLAIN = AxisSettings(math.tau / 4096, 0.0, -3.0, 3.0, 1.0, 4.0)
EVERYTHING_SET = {"return_delay": 0, "min_angle": 1400, "max_angle": 2700}


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

    def open(self, **changes: Any) -> FeetechHead:
        return open_head(self.options(**changes), self.clock, self.line.open)

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


def stall(it: Bench, head: FeetechHead, seconds: float) -> None:
    """Keep the bus thread busy with nothing, as a host that hangs."""
    it.beside(lambda: head._bus.call("stall", lambda: it.clock.sleep(seconds), NET_S)).wait()


def test_a_head_whose_host_hangs_stands_when_its_lease_is_over_and_stays_so() -> None:
    with opened(options={"lease_s": 0.2}) as (it, head):
        head.move(0.9, 0.3)
        it.clock.sleep(0.3)
        began_s = it.now_s()
        ended = it.beside(lambda: stall(it, head, 2.0))
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


def test_without_a_lease_a_move_goes_on_when_the_host_hangs_and_halt_ends_it() -> None:
    with opened(options={"lease_s": 0}) as (it, head):
        head.move(0.9, 0.3)
        stall(it, head, 1.5)
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


def test_without_a_lease_a_stop_is_confirmed_over_a_line_that_has_just_come_back() -> None:
    with opened(options={"lease_s": 0, "acceleration_rad_per_s2": 2.0}) as (it, head):  # brakes for 0.6 s
        head.move(0.9, 0.3)
        it.until(lambda: it.axes[0].velocity_rad_per_s(it.now_s()) > 0.8, "motion")
        it.line.hang_up()
        it.until(lambda: failed(head) and head._session is None, "the line to be given up")
        head._absence.again_s = it.now_s() + NET_S  # not before somebody asks for it
        it.line.come_back()
        head.stop()
        it.until(lambda: it.axes[0].velocity_rad_per_s(it.now_s()) == 0, "rest")
        assert it.pan_rad() < 0.8
        assert it.until(lambda: not failed(head), "an answer")
        assert head.read().faults == ()


@pytest.mark.parametrize("ending", ["stop", "close"])
@pytest.mark.parametrize("away", [False, True], ids=["", "over a line that comes back"])
def test_torque_goes_off_only_when_the_axis_stands(
    ending: str, away: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench() as it:
        options = it.options(lease_s=0, acceleration_rad_per_s2=2.0)
        options["pan"]["at_stop"] = options["pan"]["at_close"] = "torque_off"
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
            it.until(lambda: failed(head) and head._session is None, "the line to be given up")
            it.line.come_back()
        getattr(head, ending)()
        it.until(lambda: not it.servos[0].memory["torque_enable"], "torque off")
        assert speeds == [0.0]
        assert it.servos[1].memory["torque_enable"] == 1
        head.close()


def test_an_axis_that_does_not_come_to_rest_keeps_its_torque_at_the_end(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench() as it:
        options = it.options()
        options["pan"]["at_close"] = "torque_off"
        head = open_head(options, it.clock, it.line.open)
        monkeypatch.setattr(Rest, "take", lambda *_: False)
        head.close()
        assert it.servos[0].memory["torque_enable"] == 1
        assert "pan (servo 1) did not come to rest after a stop" in caplog.text


def test_permanent_settings_are_written_once_with_the_lock_open_for_them_alone() -> None:
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


def test_a_line_that_is_lost_after_the_last_stop_is_let_go_of(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with bench() as it:
        head, plain, closed = it.open(), FeetechServo.release, []

        def release(servo: FeetechServo, limp: bool) -> None:
            it.line.hang_up()
            plain(servo, limp)

        monkeypatch.setattr(FeetechServo, "release", release)
        true_close = FeetechLink.close
        monkeypatch.setattr(FeetechLink, "close", lambda link: (closed.append(link), true_close(link)))
        head.close()
        assert len(closed) == 1
        assert "pan (servo 1) is not left as it should be at the end" in caplog.text
        assert "tilt (servo 2) is not left as it should be at the end" in caplog.text


def test_closing_that_breaks_off_a_set_up_leaves_the_eeprom_locked_and_the_axis_holding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with opened(options={"lease_s": 0, "torque_off_at_start": True}) as (it, head):
        it.line.hang_up()
        it.until(lambda: failed(head) and head._session is None, "the line to be given up")
        memory, plain, unlocked = it.servos[1].memory, FeetechServo.set, it.gate()
        memory["return_delay"] = 250  # somebody else has set it

        def set_late(servo: FeetechServo, name: str, value: int) -> None:
            if name == "return_delay" and not unlocked.is_open:
                unlocked.set()
                it.until(head._bus.urgent, "the closing")
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


def test_an_offset_in_the_eeprom_is_told_and_never_written(caplog: pytest.LogCaptureFixture) -> None:
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


@pytest.mark.parametrize(
    ("fitted", "configured", "words"),
    [
        ("sts3250", "STS3215", "is a STS3250, the configuration says STS3215"),
        ("scs0009", "STS3215", "is a SCS0009, the configuration says STS3215"),
    ],
)
def test_another_servo_is_refused_by_its_name(fitted: str, configured: str, words: str) -> None:
    with bench(fitted) as it, pytest.raises(WrongDevice, match=words):
        it.open(pan={"id": 1, "model": configured, "limits_rad": [-1, 1]},
                tilt={"id": 2, "model": configured, "limits_rad": [-0.5, 0.4]})  # fmt: skip


def test_a_series_takes_a_servo_that_is_not_in_the_table() -> None:
    with bench() as it:
        it.servos[0].memory["model"] = it.servos[1].memory["model"] = 4242
        head = it.open(pan={"id": 1, "model": "STS", "limits_rad": [-1, 1]},
                       tilt={"id": 2, "model": "SMS", "limits_rad": [-0.5, 0.4]})  # fmt: skip
        head.move(0.2, 0.1)
        assert it.settled(head).pan_rad == pytest.approx(0.2, abs=0.002)
        head.close()


@pytest.mark.parametrize("model", ["sts3215", "scs0009"])
def test_an_adapter_that_echoes_is_found_out_and_costs_nothing(model: str) -> None:
    with opened(model, echoes=True) as (it, head):
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


def test_a_servo_that_unloads_itself_is_told_in_words_and_moves_again_when_it_is_well() -> None:
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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lease_s": 0.6}, "lease_s"),
        ({"baud": 57_600}, "too long for poll_hz 50"),
        ({"acceleration_rad_per_s2": 1.0}, "so that no lease_s stops the head"),
        ({"pan": {"id": 1, "model": "STS3251", "limits_rad": [-1, 1]}}, "did you mean 'STS3250'"),
        ({"pan": {"id": 1, "model": "SCS0009", "limits_rad": [-1, 1]}}, "are of two series"),
        ({"pan": {"id": 1, "model": "STS", "limits_rad": [-4, 1]}}, "does not cross the seam"),
        ({"watchdog_s": 0.3}, "there is no such option"),
    ],
)
def test_options_that_cannot_be_are_refused_in_words(change: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions, match="options") as caught:
        feetech_settings({**Bench().options(), **change})
    assert words in str(caught.value)


# The bench


@pytest.fixture
def cli(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Bench]:
    with bench() as it:
        monkeypatch.setattr(heads, "SYSTEM", tmp_path / "no_such")
        monkeypatch.setattr(heads, "_home", lambda: tmp_path)
        asked = {"questions": None, "clock": it.clock, "open_line": it.line.open}
        monkeypatch.setattr(open_link, "__kwdefaults__", asked)
        monkeypatch.setattr(workshop.scan, "__defaults__", (it.clock, it.line.open))
        yield it


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, Any, str]:
    code = main(["servo", *words, "--family", "feetech", "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else None, err


def test_scan_and_info_find_and_read_feetech_servos_and_move_none(
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
    assert told["registers"]["offset"] == -7 and "never writes it" in told["words"]["offset"]
    assert cli.pan_rad() == 0.0 and cli.servos[0].eeprom_writes == []


def test_no_question_raises_the_torque_above_the_servos_own_bound() -> None:
    with bench() as it:
        for servo in it.servos:
            servo.memory.update(max_torque=300, torque_limit=300, torque_enable=1)
        halt(it.options(), it.clock, it.line.open)
        assert all(280 < servo.memory["torque_limit"] <= 300 for servo in it.servos)


def test_halt_does_not_take_a_servo_for_stopped_that_missed_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with bench() as it:
        servo = it.servos[0]
        servo.memory.update(torque_enable=1, goal_position=2700)
        monkeypatch.setattr(FeetechServo, "send", lambda self, goal: None)  # lost on the line
        with pytest.raises(NoReply, match="did not take the command to stand, its goal is 2700"):
            halt(it.options(), it.clock, it.line.open)


@pytest.mark.parametrize("mishap", [None, KeyboardInterrupt], ids=["the id is lost", "ctrl-c"])
def test_a_change_of_id_that_fails_leaves_the_eeprom_locked(
    mishap: type[BaseException] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*told: object) -> None:
        if mishap is not None:
            raise mishap

    with bench() as it:
        link = open_link(it.line.path, 1_000_000, 0.05, clock=it.clock, open_line=it.line.open)
        monkeypatch.setattr(FeetechLink, "write_unanswered", lost)
        told = "the servo is left with the id 1 or 7 at 1000000 baud: 'mastctl servo scan memory --family f"
        with pytest.raises(WrongDevice if mishap else NoReply, match=told):
            workshop.set_id(link, 1, 7)
        link.close()
        assert it.servos[0].memory["lock"] == 1


@pytest.mark.parametrize("amplitude_rad", [0.05, 0.3])
@pytest.mark.parametrize(("model", "unit"), [("sts3215", 1), ("sts3215", 50), ("scs0009", 50)])
def test_a_trial_finds_the_unit_of_speed_and_comes_back(model: str, unit: int, amplitude_rad: float) -> None:
    with bench(model, unit=unit) as it:
        link = open_link(it.line.path, 1_000_000, 0.05, clock=it.clock, open_line=it.line.open)
        trial = workshop.try_out(link, 1, amplitude_rad, 50.0)
        link.close()
        assert trial.speed_unit_counts == unit
        assert [step.left_counts for step in trial.steps] == [0, 0, 0]
        assert it.pan_rad() == 0.0


def test_a_trial_of_few_counts_does_not_guess_the_unit_of_speed() -> None:
    with bench("scs0009", unit=50) as it:
        link = open_link(it.line.path, 1_000_000, 0.05, clock=it.clock, open_line=it.line.open)
        trial = workshop.try_out(link, 1, 0.02, 50.0)
        link.close()
        assert (trial.speed_unit_counts, [step.left_counts for step in trial.steps]) == (None, [0, 0, 0])


def test_halt_does_not_take_one_unit_of_speed_for_rest() -> None:
    with bench(unit=50) as it:
        servo, axis = it.servos[0], it.axes[0]
        servo.write(41, bytes((2,)), it.now_s())  # 200 counts/s2: it brakes for half a second
        servo.write(46, bytes((2, 0)), it.now_s())  # 100 counts/s
        servo.write(40, bytes((1,)), it.now_s())
        servo.write(42, (2700).to_bytes(2, "little"), it.now_s())
        it.clock.sleep(1.0)
        assert axis.velocity_rad_per_s(it.now_s()) == pytest.approx(100 * math.tau / 4096)
        options = it.options()
        options["pan"] |= {"speed_unit_counts": 50}
        halt(options, it.clock, it.line.open)
        assert axis.velocity_rad_per_s(it.now_s()) == 0.0


def test_a_trial_that_a_fault_ends_stops_the_servo_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench() as it:
        it.servos[0].memory["torque_enable"] = 1
        link = open_link(it.line.path, 1_000_000, 0.05, clock=it.clock, open_line=it.line.open)
        look, looks = link.look, []

        def faulty(servo_id: int, model: Any) -> Any:
            looks.append(look(servo_id, model))
            if len(looks) == 8:
                it.servos[0].raise_error(2)
            return looks[-1]

        monkeypatch.setattr(link, "look", faulty)
        with pytest.raises(HardwareFault, match="the trial is ended"):
            workshop.try_out(link, 1, 0.3, 50.0)
        link.close()
        ended_rad = it.pan_rad()
        it.clock.sleep(2.0)
        assert abs(it.pan_rad() - ended_rad) < 0.03 and it.pan_rad() < 0.15, "0.3 rad was its goal"


def test_set_id_that_is_broken_off_before_the_rate_says_so(
    cli: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cli.servos[1].memory["torque_enable"] = 0
    plain = FeetechLink.write_unanswered

    def lost(link: FeetechLink, servo_id: int, register: Any, value: int, model: Any) -> None:
        if register.name == "baud":
            raise LineLost("the adapter was pulled")
        plain(link, servo_id, register, value, model)

    monkeypatch.setattr(FeetechLink, "write_unanswered", lost)
    code, told, _ = run(capsys, "set-id", cli.line.path, "2", "5", "--new-baud", "115200")
    assert code == 1 and cli.servos[1].memory["lock"] == 1
    assert told["error"]["message"] == (
        "the adapter was pulled; the servo is left with the id 5 at 1000000 or 115200 baud: "
        "'mastctl servo scan memory --family feetech --baud 1000000 115200' shows which, and "
        "'mastctl servo set-id memory --family feetech 5 5 --baud 1000000 --new-baud 115200' "
        "gives the id 5 its rate"
    )


def test_set_id_and_test_work_on_feetech_servos(cli: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    code, told, _ = run(capsys, "set-id", cli.line.path, "1", "2")
    assert code == 1 and "id 2 is taken" in told["error"]["message"]
    code, told, err = run(capsys, "set-id", cli.line.path, "1", "7", "--new-baud", "500000")
    assert (code, told) == (0, {"id": 7, "old_id": 1, "baud": 500_000}), err
    assert (cli.servos[0].servo_id, cli.servos[0].baud, cli.servos[0].memory["lock"]) == (7, 500_000, 1)
    before = dict(cli.servos[1].memory)
    code, told, err = run(capsys, "test", cli.line.path, "2", "--degrees", "3")
    assert code == 0, err
    assert told["speed_unit_counts"] == 1
    assert all(abs(step["left_counts"]) <= 1 for step in told["steps"])
    kept = ("torque_enable", "acceleration", "goal_speed", "torque_limit")
    assert {name: cli.servos[1].memory[name] for name in kept} == {name: before[name] for name in kept}


# The maker's SDK, unchanged


def test_the_makers_sdk_reads_and_drives_the_simulated_servos(monkeypatch: pytest.MonkeyPatch) -> None:
    sdk = pytest.importorskip("scservo_sdk", reason="feetech-servo-sdk is not installed")
    monkeypatch.setattr("scservo_sdk.port_handler.LATENCY_TIMER", 20_000)  # a busy machine answers late
    clock = SystemClock()
    axes = [WireAxis(PLAIN, number=n, time_s=clock.now_s()) for n in (0, 1)]
    servos = [
        SimulatedFeetechServo("sts3215", n, axis, time_s=clock.now_s())
        for n, axis in enumerate(axes, start=1)
    ]
    with PtyLine(FeetechBus(servos), clock) as line:
        port, packets = sdk.PortHandler(line.path), sdk.PacketHandler(0)
        assert port.openPort() and port.setBaudRate(1_000_000)
        try:
            assert packets.ping(port, 1) == (777, sdk.COMM_SUCCESS, 0)
            for address, value in ((40, 1), (41, 254)):
                assert packets.write1ByteTxRx(port, 2, address, value) == (sdk.COMM_SUCCESS, 0)
            group = sdk.GroupSyncWrite(port, packets, 42, 6)
            assert group.addParam(2, [0x34, 8, 0, 0, 0x00, 8])
            assert group.txPacket() == sdk.COMM_SUCCESS
            it = Turned()
            it.clock = clock
            it.until(lambda: packets.read2ByteTxRx(port, 2, 56)[0] == 0x834, "the goal")
            both = sdk.GroupSyncRead(port, packets, 56, 8)
            assert both.addParam(1) and both.addParam(2)
            assert both.txRxPacket() == sdk.COMM_SUCCESS
            assert [both.getData(n, 56, 2) for n in (1, 2)] == [2048, 0x834]
        finally:
            port.closePort()
