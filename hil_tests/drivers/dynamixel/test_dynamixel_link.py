"""Each defect of the SDK (facts of the servo layer, section 1), shown to the driver by scripted servos.

On a turned clock, but where pyserial or the kernel has its part: baud rates, the lock of a port, a pulled
plug, sockets and RFC 2217, low-level errors, and waiting that costs no processor time.
"""

from __future__ import annotations

import socket
import termios
from collections.abc import Callable, Sequence

import pytest

from drivers.dynamixel.link import Link
from drivers.dynamixel.models import MODELS
from drivers.dynamixel.registers import ControlItem
from drivers.errors import BadOptions, BadReply, LineLost, NoReply, Refused
from drivers.serial_line import SerialLine
from drivers.servo_bus.bus import Bus
from drivers.servo_bus.port import Part
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.dynamixel_bus import Instruction
from hil_tests.drivers.dynamixel.scripted_servos import BAUD_RATE, number, says, scripted
from hil_tests.drivers.turned import turned
from hil_tests.waiting import NET_S

X = MODELS["XM430-W350"].registers
POSITION, TORQUE = X["present_position"], X["torque_enable"]
PATIENT_S = NET_S  # where an answer comes
SHORT_S = 0.03  # where none comes
BOTH = [Part(1, 132, 4), Part(2, 132, 4)]


def always(*replies: Reply) -> Callable[[Instruction, int], Sequence[Reply]]:
    """The same answer to everything."""
    return lambda instruction, count: replies


def asked(link: Link, servo_id: int, register: ControlItem) -> int:
    """A register's value by one question, proven by nothing."""
    data = link.read(servo_id, register.address, register.size, register.name)
    return register.decode(data)


def test_an_error_without_data_is_an_error_and_no_value() -> None:  # defect 7
    with scripted(always(says(1, error=5))) as (line, _):
        link = line.link(PATIENT_S)
        for register in (TORQUE, POSITION):
            with pytest.raises(Refused, match="wrong length") as caught:
                asked(link, 1, register)
            assert caught.value.detail == {
                "port": line.path, "baud": BAUD_RATE, "servo_id": 1, "register": register.name,
                "instruction": "read", "error": 5,
            }  # fmt: skip


def test_a_missing_servo_is_named_and_the_other_is_read() -> None:  # defect 5
    with scripted(always(says(2, number(77)))) as (line, _):
        answer = line.link(SHORT_S).group_read(BOTH)
    assert isinstance(answer.missing[1], NoReply)
    assert answer.missing[1].detail["servo_id"] == 1
    assert list(answer.missing) == [1]
    assert answer.statuses[2].data == number(77)


def test_a_servo_that_says_two_things_has_said_none() -> None:
    with scripted(always(says(1, number(77)), says(1, number(78)), says(2, number(9)))) as (line, _):
        assert not line.link(SHORT_S).group_read(BOTH).statuses


def test_group_reads_keep_the_error_byte() -> None:  # defect 6
    with scripted(always(says(1, number(1), error=0x80), says(2, error=7))) as (line, _):
        answer = line.link(PATIENT_S).group_read(BOTH)
    assert answer.statuses[1].alert
    assert isinstance(answer.missing[2], Refused)


def test_a_late_reply_is_not_taken_for_the_next_answer() -> None:  # defect 10
    def answer(instruction: Instruction, count: int) -> list[Reply]:
        """The first comes when the second question would be out, before the second answer."""
        late, value = [(SHORT_S + 0.004, 555), (0.01, 2048)][count]
        return [says(1, number(value), delay_s=late)]

    with scripted(answer) as (line, _):
        link = line.link(SHORT_S)
        with pytest.raises(NoReply):
            asked(link, 1, X["present_velocity"])
        assert asked(link, 1, POSITION) == 2048


def test_what_came_unasked_is_dropped_before_a_question() -> None:
    extra = says(1, number(555))

    def answer(instruction: Instruction, count: int) -> list[Reply]:
        return [says(1, number(count)), *([extra] if count == 0 else [])]

    with scripted(answer) as (line, _):
        link = line.link(PATIENT_S)
        assert asked(link, 1, POSITION) == 0
        line.clock.sleep(0.01)  # the other one is there now
        assert asked(link, 1, POSITION) == 1


def test_replies_of_others_and_of_other_lengths_are_stepped_over() -> None:
    with scripted(always(says(2, number(1)), says(1, b"\x01"), says(1, number(9)))) as (line, _):
        link = line.link(PATIENT_S)
        assert asked(link, 1, POSITION) == 9


def test_a_line_that_is_never_quiet_says_so() -> None:
    with scripted(always()) as (line, servos):
        servos.poll = lambda time_s: [Reply(b"x")]  # type: ignore[method-assign]
        link = line.link(SHORT_S)
        line.clock.sleep(0.01)
        began_s = line.now_s()
        with pytest.raises(BadReply, match=r"never quiet: \d+ bytes in 0\.3 s"):
            asked(link, 1, POSITION)
        assert line.now_s() - began_s == pytest.approx(0.3, abs=0.011)


def test_the_port_cannot_be_opened_twice() -> None:  # defect 12
    with scripted(always(), real=True) as (line, _):
        link = line.link()
        with pytest.raises(LineLost, match="held by another program"):
            line.link()
        link.close()
        line.link().close()


def test_a_port_that_is_not_there_and_a_url_that_cannot_be(tmp_path: object) -> None:
    with pytest.raises(LineLost, match="no such file"):
        Link(f"{tmp_path}/none", BAUD_RATE)
    with pytest.raises(BadOptions, match="expected a serial device or socket"):
        Link("foo://x", BAUD_RATE)


def test_a_call_whose_turn_does_not_come_is_never_made() -> None:
    with turned() as it:
        bus = Bus("test", lambda: it.now_s() + 60.0, it.clock)
        bus.start()
        begun, free = it.gate(), it.gate()
        made: list[int] = []

        def hang() -> None:
            begun.set()
            free.wait()

        hanging = it.beside(lambda: bus.call("hang", hang, 2 * PATIENT_S))
        begun.wait()
        began_s = it.now_s()
        with pytest.raises(NoReply, match="its turn did not come"):
            bus.call("late", lambda: made.append(1), 0.05)
        assert it.now_s() == pytest.approx(began_s + 0.05, abs=1e-9)
        free.set()
        hanging.wait()
        bus.call("after", lambda: None, PATIENT_S)
        bus.close(lambda: None, PATIENT_S)
        with pytest.raises(NoReply, match="closed"):
            bus.call("too late", lambda: made.append(2), PATIENT_S)
        assert made == []


def test_a_call_that_hangs_is_reported_and_closing_leaves_its_thread(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with turned() as it:
        bus = Bus("test", lambda: it.now_s() + 60.0, it.clock)
        bus.start()
        free = it.gate()
        with pytest.raises(NoReply, match=r"hang on test did not end within 0\.5 s: it is still under way"):
            bus.call("hang", free.wait, 0.5)
        began_s = it.now_s()
        bus.close(lambda: None, 2.0)
        assert it.now_s() == pytest.approx(began_s + 2.0, abs=1e-9)
        assert "the bus thread hangs and is left behind" in caplog.text
        free.set()


def test_what_goes_wrong_in_the_owner_threads_round_does_not_end_it() -> None:
    with turned() as it:
        rounds: list[float] = []

        def between() -> float:
            rounds.append(it.now_s())
            if len(rounds) == 1:
                raise RuntimeError("a defect")
            return it.now_s() + 60.0

        bus = Bus("test", between, it.clock)
        bus.start()
        assert bus.call("ask", lambda: 7, PATIENT_S) == 7
        it.clock.sleep(1.0)
        bus.close(lambda: None, PATIENT_S)
        assert [time_s - rounds[0] for time_s in rounds] == pytest.approx([0.0, 0.1])


def test_a_low_level_error_of_any_kind_becomes_a_lost_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with scripted(always(), real=True) as (line, _):
        port = SerialLine(line.path, BAUD_RATE)
        for error in (
            termios.error(5, "Input/output error"),
            OSError(5, "Input/output error"),
            TypeError("'NoneType' object cannot be interpreted"),
            IndexError("list index out of range"),
        ):

            def fail(*_: object, error: Exception = error) -> int:
                raise error

            with monkeypatch.context() as patch:
                patch.setattr("drivers.serial_line.os.write", fail)
                with pytest.raises(LineLost, match=f"{port.port} failed in writing"):
                    port.write(b"x")
        port.close()
        port.close()


def test_a_host_that_is_away_costs_half_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    patience_s: list[float] = []

    def nobody_answers(address: object, timeout: float) -> socket.socket:
        patience_s.append(timeout)
        raise TimeoutError("timed out")

    monkeypatch.setattr("drivers.serial_line.socket.create_connection", nobody_answers)
    monkeypatch.delenv("INVOCATION_ID", raising=False)
    with pytest.raises(LineLost, match=r"10\.0\.0\.1:4000 cannot be opened: timed out$"):
        Link("socket://10.0.0.1:4000", BAUD_RATE)
    assert patience_s == [0.5]
    monkeypatch.setenv("INVOCATION_ID", "5f0c")  # as systemd sets it for a unit's processes
    with pytest.raises(LineLost, match=r"timed out; .* the unit has to allow its address \(IPAddressAllow\)"):
        Link("socket://10.0.0.1:4000", BAUD_RATE)
