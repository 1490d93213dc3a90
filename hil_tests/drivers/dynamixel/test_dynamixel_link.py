"""Each defect of the SDK (facts of the servo layer, section 1), shown to the driver by scripted servos.

On a turned clock, but where pyserial or the kernel has its part: baud rates, the lock of a port, a pulled
plug, sockets and RFC 2217, low-level errors, and waiting that costs no processor time.
"""

from __future__ import annotations

import re
import socket
import termios
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace

import pytest
import serial
import serial.rfc2217

from drivers.clock import SystemClock
from drivers.dynamixel.link import Link
from drivers.dynamixel.models import MODELS
from drivers.dynamixel.packets import Part
from drivers.dynamixel.registers import Register
from drivers.errors import BadOptions, BadReply, LineLost, NoReply, Refused
from drivers.serial_line import SerialLine
from drivers.servo_bus.bus import Bus
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.dynamixel_packets import Instruction, fast_status_packets
from drivers.sim.wire.line import TcpLine
from hil_tests.drivers.dynamixel.scripted_servos import BAUD_RATE, ScriptedServos, number, says, scripted
from hil_tests.drivers.turned import turned
from hil_tests.waiting import NET_S

X = MODELS["XM430-W350"].registers
POSITION, TORQUE = X["present_position"], X["torque_enable"]
PING, READ, WRITE, REBOOT, SYNC_READ, SYNC_WRITE, BULK_READ, BULK_WRITE = 1, 2, 3, 8, 0x82, 0x83, 0x92, 0x93
FAST_SYNC_READ = 0x8A
PATIENT_S = NET_S  # where an answer comes
SHORT_S = 0.03  # where none comes
BOTH = [Part(1, 132, 4), Part(2, 132, 4)]


def always(*replies: Reply) -> Callable[[Instruction, int], Sequence[Reply]]:
    """The same answer to everything."""
    return lambda instruction, count: replies


def asked(link: Link, servo_id: int, register: Register) -> int:
    """A register's value by one question, proven by nothing."""
    data = link.exchange.read(servo_id, register.address, register.size, register.name)
    return register.decode(data)


def test_values_are_signed() -> None:  # defect 15
    with scripted(always(says(1, number(-5)))) as (line, _):
        assert asked(line.link(PATIENT_S), 1, POSITION) == -5


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


def test_group_reads_keep_the_error_byte() -> None:  # defect 6
    with scripted(always(says(1, number(1), error=0x80), says(2, error=7))) as (line, _):
        answer = line.link(PATIENT_S).group_read(BOTH)
    assert answer.statuses[1].alert
    assert isinstance(answer.missing[2], Refused)


@pytest.mark.parametrize("value", [-131073, -1, 0])
def test_what_is_sent_is_stuffed(value: int) -> None:  # defect 8
    # -131073 is FF FF FD FF: sent as it is, its first three bytes would begin a packet
    with scripted(lambda i, n: [says(i.packet_id)]) as (line, servos):
        line.link(PATIENT_S).write(1, X["goal_position"], value)
    assert servos.heard[0].parameters == number(116, 2) + number(value)
    assert servos.bytes_heard[4:].find(b"\xff\xff\xfd\xff") < 0


def test_stuffed_answers_are_read_right() -> None:
    # a register that itself holds a packet's head
    with scripted(always(says(1, b"\xff\xff\xfd\xff"), says(2, b"\x00\xff\xff\xfd"))) as (line, _):
        answer = line.link(PATIENT_S).group_read(BOTH)
    assert POSITION.decode(answer.statuses[1].data) == -131073
    assert answer.statuses[2].data == b"\x00\xff\xff\xfd"


def test_a_late_reply_is_not_taken_for_the_next_answer() -> None:  # defect 10
    def answer(instruction: Instruction, count: int) -> list[Reply]:
        return [says(1, number(555), delay_s=1.5 * SHORT_S) if count == 0 else says(1, number(2048))]

    with scripted(answer) as (line, _):
        link = line.link(SHORT_S)
        with pytest.raises(NoReply):
            asked(link, 1, X["present_velocity"])
        link.quiet(4 * SHORT_S)
        link._port.reply_timeout_s = PATIENT_S
        assert asked(link, 1, POSITION) == 2048


def test_after_a_timeout_the_line_is_listened_to_before_the_next_question() -> None:  # defect 10
    with scripted(always()) as (line, _):
        link = line.link(SHORT_S)
        with pytest.raises(NoReply):
            asked(link, 1, POSITION)
        assert link._port.suspect
        link._port.send(b"", 0)
        assert not link._port.suspect


def test_what_came_unasked_is_dropped_before_a_question() -> None:
    extra = says(1, number(555))

    def answer(instruction: Instruction, count: int) -> list[Reply]:
        return [says(1, number(count)), *([extra] if count == 0 else [])]

    with scripted(answer) as (line, _):
        link = line.link(PATIENT_S)
        assert asked(link, 1, POSITION) == 0
        assert link._port._buffer or link._port._fetch(PATIENT_S)  # the stray one is there now
        assert asked(link, 1, POSITION) == 1


def test_replies_of_others_and_of_other_lengths_are_stepped_over() -> None:
    with scripted(always(says(2, number(1)), says(1, b"\x01"), says(1, number(9)))) as (line, _):
        link = line.link(PATIENT_S)
        assert asked(link, 1, POSITION) == 9
        assert link._port.suspect  # whose replies they were may say more


def test_noise_and_a_broken_packet_before_the_answer_cost_nothing() -> None:
    broken = bytearray(says(1, number(4)).data)
    broken[-1] ^= 1
    noise = Reply(b"\x00\xff\xff\xfd\x00\x01\xff\x00\x55" + bytes(broken))
    with scripted(always(noise, says(1, number(9)))) as (line, _):
        assert asked(line.link(PATIENT_S), 1, POSITION) == 9


def test_a_line_that_is_never_quiet_says_so() -> None:
    with scripted(always()) as (line, servos):
        servos.poll = lambda time_s: [Reply(b"x")]  # type: ignore[method-assign]
        link = line.link(SHORT_S)
        line.clock.sleep(0.01)
        began_s = line.now_s()
        with pytest.raises(BadReply, match=r"never quiet: \d+ bytes in 0\.3 s"):
            asked(link, 1, POSITION)
        assert line.now_s() - began_s == pytest.approx(0.3, abs=0.011)


def test_a_pulled_plug_is_a_lost_line_and_nothing_stays_busy() -> None:  # defects 1 and 13
    with scripted(lambda i, n: [says(i.packet_id, number(3))], real=True) as (line, _):
        link = line.link(PATIENT_S)
        assert asked(link, 1, POSITION) == 3
        line.line.hang_up()
        for act in (
            lambda: asked(link, 1, POSITION),
            lambda: link.write(1, TORQUE, 0),
            lambda: link.group_read(BOTH),
            lambda: link.group_write([Part(1, 64, 1, b"\0"), Part(2, 64, 1, b"\0")]),
            lambda: link.ping(1),
        ):
            with pytest.raises(LineLost) as caught:
                act()
            assert caught.value.detail["port"] == line.path
            assert caught.value.detail["servo_id"] == 1
        link.close()
        line.line.come_back()
        again = line.link(PATIENT_S)
        assert asked(again, 1, POSITION) == 3


def test_the_port_cannot_be_opened_twice() -> None:  # defect 12
    with scripted(always(), real=True) as (line, _):
        link = line.link()
        with pytest.raises(LineLost, match="held by another program"):
            line.link()
        link.close()
        line.link().close()


@pytest.mark.parametrize("baud", [4_500_000, 10_500_000, 12_345])
def test_any_baud_rate_is_tried(baud: int) -> None:  # defect 16
    with scripted(always(says(1, number(8))), real=True) as (line, _):
        assert asked(line.link(PATIENT_S, baud), 1, POSITION) == 8


def test_a_port_that_is_not_there_and_a_url_that_cannot_be(tmp_path: object) -> None:
    with pytest.raises(LineLost, match="no such file"):
        Link(f"{tmp_path}/none", BAUD_RATE)
    with pytest.raises(BadOptions, match="protocol 'foo' not known"):
        Link("foo://x", BAUD_RATE)


def test_over_a_socket() -> None:  # defect 17
    servos = ScriptedServos(lambda i, n: [says(i.packet_id, number(42))])
    with TcpLine(servos, SystemClock()) as line:
        link = Link(f"socket://127.0.0.1:{line.port}", BAUD_RATE, PATIENT_S)
        assert asked(link, 1, POSITION) == 42
        line.hang_up()
        with pytest.raises(LineLost):
            for _ in range(3):  # the first bytes into a dead connection may still seem to leave
                asked(link, 1, POSITION)
        link.close()


class NoModemLines(serial.Serial):  # type: ignore[misc]
    """A pseudo terminal as pyserial's server wants a port: with modem lines."""

    cts = dsr = ri = cd = True

    def _update_rts_state(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass


class SerialServer:
    """pyserial's RFC 2217 server between one connection and a line."""

    def __init__(self, path: str) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"rfc2217://127.0.0.1:{self.listener.getsockname()[1]}"
        self._path = path
        threading.Thread(target=self._serve, daemon=True).start()

    def write(self, data: bytes) -> None:
        self._connection.sendall(data)

    def _serve(self) -> None:
        self._connection, _ = self.listener.accept()
        port = NoModemLines(self._path, BAUD_RATE, timeout=0.01)
        manager = serial.rfc2217.PortManager(port, self)
        self._connection.settimeout(0.005)
        while True:
            try:
                data = self._connection.recv(1024)
                if not data:
                    break
                port.write(b"".join(manager.filter(data)))
            except TimeoutError:
                pass
            self.write(b"".join(manager.escape(port.read(port.in_waiting))))
        port.close()


def test_over_rfc2217() -> None:
    with scripted(always(says(1, number(-7)), says(2, b"\xff\xff\xfd\xff")), real=True) as (line, _):
        server = SerialServer(line.path)
        link = Link(server.url, BAUD_RATE, PATIENT_S)
        assert asked(link, 1, POSITION) == -7
        answer = link.group_read(BOTH)
        assert answer.statuses[2].data == b"\xff\xff\xfd\xff"
        link.close()
        server.listener.close()


def test_a_host_that_is_not_there_is_a_lost_line() -> None:
    with socket.socket() as taken:  # bound but not listening: refused at once
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(LineLost, match="cannot be opened"):
            Link(f"socket://127.0.0.1:{taken.getsockname()[1]}", BAUD_RATE)


def test_the_clock_on_the_wall_means_nothing(monkeypatch: pytest.MonkeyPatch) -> None:  # defect 4
    def steps_back() -> float:
        raise AssertionError("the driver asked for the time of day")

    with scripted(always(says(1, number(1))), real=True) as (line, _):
        link = line.link(PATIENT_S)
        monkeypatch.setattr(time, "time", steps_back)
        assert asked(link, 1, POSITION) == 1


def test_waiting_costs_no_processor_time() -> None:  # defect 2
    with scripted(always(), real=True) as (line, _):
        link = line.link(0.5)
        before_s = time.thread_time()
        with pytest.raises(NoReply):
            asked(link, 1, POSITION)
        assert time.thread_time() - before_s < 0.1  # the SDK spins: 0.5 s


def test_group_reads_are_sync_for_equal_blocks_and_bulk_for_others() -> None:
    answer = always(says(1, number(1)), says(2, number(2)))
    with scripted(answer) as (line, servos):
        link = line.link(PATIENT_S)
        link.group_read(BOTH)
        link.group_read([Part(1, 132, 4), Part(2, 580, 4)])
        link.group_write([Part(1, 116, 4, number(-1)), Part(2, 116, 4, number(7))])
        link.group_write([Part(1, 116, 4, number(-1)), Part(2, 564, 4, number(7))])
        link.group_read(BOTH)
    codes = [i.code for i in servos.heard]
    assert codes == [SYNC_READ, BULK_READ, SYNC_WRITE, BULK_WRITE, SYNC_READ]
    assert servos.heard[0].parameters == bytes((132, 0, 4, 0, 1, 2))
    assert servos.heard[1].parameters == bytes((1, 132, 0, 4, 0, 2, 0x44, 0x02, 4, 0))
    assert servos.heard[2].parameters == bytes((116, 0, 4, 0, 1)) + number(-1) + bytes((2,)) + number(7)
    assert servos.heard[3].parameters == (
        bytes((1, 116, 0, 4, 0)) + number(-1) + bytes((2, 0x34, 0x02, 4, 0)) + number(7)
    )


def test_a_fast_group_read_checks_every_block() -> None:
    whole = b"".join(fast_status_packets([(0, 1, number(-3)), (0x80, 2, b"\xff\xff\xfd\x07")], 16))

    def answer(instruction: Instruction, count: int) -> list[Reply]:
        spoilt = bytearray(whole)
        if count == 1:
            spoilt[12] ^= 1
        return [Reply(bytes(spoilt))]

    with scripted(answer) as (line, _):
        link = line.link(PATIENT_S)
        good = link.group_read(BOTH, fast=True)
        assert POSITION.decode(good.statuses[1].data) == -3
        assert good.statuses[2].data == b"\xff\xff\xfd\x07"  # not stuffed in a fast answer
        assert good.statuses[2].alert
        link._port.reply_timeout_s = SHORT_S
        assert not link.group_read(BOTH, fast=True).statuses


def test_behind_a_block_of_another_servo_nothing_counts_and_the_line_is_listened_to() -> None:
    blocks = b"".join(fast_status_packets([(0, 1, number(-3)), (0, 7, number(5))], 16))
    with scripted(lambda *_: [Reply(blocks)]) as (line, _):
        link = line.link(PATIENT_S)
        assert [*link.group_read(BOTH, fast=True).statuses] == [1]
        assert link._port.suspect  # whoever spoke for servo 2 may go on


def test_calls_of_many_threads_queue_instead_of_failing() -> None:  # defect 11
    with scripted(lambda i, n: [says(i.packet_id, number(i.packet_id), delay_s=0.001)]) as (line, _):
        link = line.link(PATIENT_S)
        bus = Bus(line.path, lambda: line.now_s() + 60.0, line.clock)
        bus.start()
        got: list[tuple[int, int]] = []

        def ask(servo_id: int) -> None:
            for _ in range(30):
                got.append((servo_id, bus.call("read", lambda: asked(link, servo_id, POSITION), 30.0)))

        for ended in [line.beside(partial(ask, servo_id)) for servo_id in range(1, 6)]:
            ended.wait()
        bus.close(link.close, PATIENT_S)
    assert len(got) == 150
    assert all(asked == answered for asked, answered in got)
    assert len({asked for asked, _ in got[:10]}) == 5, "none waits for all calls of another"


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


def test_a_call_that_hangs_is_told_as_under_way_and_closing_leaves_its_thread_behind(
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


def test_on_the_machines_clock_calls_are_served_and_the_thread_ends() -> None:
    bus = Bus("test", lambda: time.monotonic() + 60.0)
    bus.start()
    assert bus.call("ask", lambda: 7, NET_S) == 7
    with pytest.raises(NoReply, match=r"did not end within 0\.01 s"):
        bus.call("hang", lambda: time.sleep(0.1), 0.01)
    bus.close(lambda: None, NET_S)
    assert not bus._thread.is_alive()


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
            with monkeypatch.context() as patch:
                patch.setattr("drivers.serial_line.os.read", fail)
                patch.setattr(port, "_poll", SimpleNamespace(poll=lambda wait_ms: [0]))
                with pytest.raises(LineLost, match=f"{port.port} failed in reading"):
                    port.read(0.0)
        port.close()
        port.close()


@pytest.mark.parametrize(
    "url", ["socket://127.0.0.1", "rfc2217://127.0.0.1", "socket://:4000", "socket://a:x"]
)
def test_a_url_without_host_or_port_is_no_lost_line(url: str) -> None:
    with pytest.raises(BadOptions, match=re.escape(url)):
        SerialLine(url, BAUD_RATE)


def test_a_host_whose_name_nobody_knows_is_told_in_words() -> None:
    with pytest.raises(LineLost, match=r"cannot be opened: .*(not known|resolution)"):
        SerialLine("socket://no-such-host.invalid:4000", BAUD_RATE)


def test_letting_go_of_a_socket_does_not_wait() -> None:
    with TcpLine(ScriptedServos(always()), SystemClock()) as line:
        port = SerialLine(f"socket://127.0.0.1:{line.port}", BAUD_RATE)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(time, "sleep", lambda wait_s: pytest.fail("pyserial waits 0.3 s"))
            port.close()


def test_what_a_full_buffer_does_not_take_is_left_to_pyserial(monkeypatch: pytest.MonkeyPatch) -> None:
    with scripted(always(), real=True) as (line, _):
        port = SerialLine(line.path, BAUD_RATE)
        for taken, rest in ((0, b"abc"), (1, b"bc"), (3, None)):
            left: list[bytes] = []
            with monkeypatch.context() as patch:
                patch.setattr("drivers.serial_line._written", lambda where, data, taken=taken: taken)
                patch.setattr(port, "_serial", SimpleNamespace(write=left.append))
                port.write(b"abc")
            assert left == ([] if rest is None else [rest])
        port.close()


def test_a_host_that_is_away_costs_half_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    patience_s: list[float] = []

    def nobody_answers(address: object, timeout: float) -> socket.socket:
        patience_s.append(timeout)
        raise TimeoutError("timed out")

    monkeypatch.setattr("drivers.serial_line.socket.create_connection", nobody_answers)
    with pytest.raises(LineLost, match=r"10\.0\.0\.1:4000 cannot be opened: timed out"):
        Link("socket://10.0.0.1:4000", BAUD_RATE)
    assert patience_s == [0.5]
