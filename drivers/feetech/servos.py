"""Feetech's servos: their memory, packets, transactions on a line, and what is done with them on the bench.

Sources: the maker's memory tables of STS/SMS servos, its protocol manual and the addresses in its SDK. The
maker states no backlash. A count of speed is one count a second in the maker's SDK of 2020, and 50 in that of
2025: it depends on the firmware and has to be configured (``speed_unit_counts``).

A packet is ``FF FF``, id, length, instruction or status, data, and an inverted sum. The sum has eight bits:
one wrong byte is always seen, several pass once in 256. Nothing is stuffed. A reply has no sequence number
and does not say what was requested. What proves a sample is:

- **Length.** Each question reads another number of bytes, `STARTS` of them in turn; another length is no
  answer.
- **Token.** Just before it, each question writes a number into the torque limit of both servos, up
  to `TOKENS` steps of 0.1 % below what is configured, and reads it back within the answer. Together that is
  the number of a question out of `STARTS * TOKENS`: a reply is distinguished from any up to 271 questions
  late.

An SCS has no such register, and 0.3 degrees a count: it is not driven.

What is read for one register is read twice around a silence, by two lengths, and has to agree.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

from drivers.errors import BadOptions, BadReply, DriverError, LineLost, NoReply, WrongDevice
from drivers.faults import nearest
from drivers.servo_bus.bench import FoundServo, ServoFacts, changing, check_change
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.exchange import ATTEMPTS, BusLink, again
from drivers.servo_bus.port import QUIET_S, PacketFormat, Part, Register, StatusPacket, at_header
from drivers.servo_bus.settings import CountedModel

BAUD_RATES = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""By their code: the maker's SMS_STS.h (2021, 2025) and memory tables, address 6.

lerobot's table (57,600, 38,400, 19,200 for the codes 5 to 7) contradicts the maker's.
"""

# ERRBIT_VOLTAGE, ANGLE, OVERHEAT, OVERELE, OVERLOAD of the maker's scservo_sdk (protocol_packet_handler.py).
STATUS_FAULTS = MappingProxyType(
    {
        0x01: "input voltage out of its limits",
        0x02: "angle sensor fault",
        0x04: "overheating",
        0x08: "overcurrent",
        0x20: "overload",
    }
)
POSITION_MODE = 0
COUNT_RAD = math.tau / 4096
UNLOCKED, LOCKED = 0, 1


@dataclass(frozen=True)
class Item(Register):
    """One entry of a memory table.

    ``sign_bit`` says minus, and the rest is the size of the number; None for a number of zero or more.
    """

    sign_bit: int | None = None

    def decode(self, data: bytes) -> int:
        """Return its value, as `Register`."""
        word = int.from_bytes(data, "little")
        if self.sign_bit is None:
            return word
        size = word & ((1 << self.sign_bit) - 1)
        return -size if word >> self.sign_bit & 1 else size

    def encode(self, value: int) -> bytes:
        """Return its bytes, as `Register`."""
        if value < 0 and self.sign_bit is not None:
            value = -value | 1 << self.sign_bit
        return value.to_bytes(self.size, "little")


REGISTERS: Mapping[str, Item] = MappingProxyType(
    {
        item.name: item
        for item in (
            Item("firmware_major", 0), Item("firmware_minor", 1), Item("model_number", 3, 2),
            Item("id", 5), Item("baud", 6), Item("return_delay", 7), Item("response_level", 8),
            Item("min_angle_limit", 9, 2), Item("max_angle_limit", 11, 2),
            Item("temperature_limit", 13), Item("max_voltage_limit", 14), Item("min_voltage_limit", 15),
            Item("max_torque", 16, 2), Item("unload_condition", 19), Item("protective_current", 28, 2),
            Item("offset", 31, 2, 11), Item("operating_mode", 33), Item("protective_torque", 34),
            Item("protective_time", 35), Item("overload_torque", 36),
            Item("torque_enable", 40), Item("acceleration", 41), Item("goal_position", 42, 2),
            Item("goal_time", 44, 2), Item("goal_speed", 46, 2), Item("torque_limit", 48, 2),
            Item("lock", 55), Item("present_position", 56, 2, 15), Item("present_velocity", 58, 2, 15),
            Item("present_load", 60, 2, 10), Item("present_voltage", 62), Item("present_temperature", 63),
            Item("status", 65), Item("moving", 66), Item("present_current", 69, 2, 15),
        )
    }
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FeetechModel(CountedModel):
    """One kind of servo, as of `CountedModel`.

    ``speed_unit_counts``: counts a second of one unit of its speed, 1, or 50 in some firmware.
    """

    registers: Mapping[str, Item]
    speed_unit_counts: int = 1

    def with_speed_unit(self, counts: int) -> FeetechModel:
        """Return it with another unit of speed."""
        return replace(self, speed_unit_counts=counts, velocity_unit_rad_per_s=counts * self.count_rad)


def _model(name: str, number: int | None) -> FeetechModel:
    return FeetechModel(
        name=name,
        number=number,
        registers=REGISTERS,
        low_count=0,
        high_count=4095,
        centre_count=2048,
        count_rad=COUNT_RAD,
        velocity_unit_rad_per_s=COUNT_RAD,
        acceleration_unit_rad_per_s2=100 * COUNT_RAD,
        current_unit_A=0.0065,
    )


# Model numbers: lerobot's MODEL_NUMBER_TABLE; the maker publishes none.
MODELS: Mapping[str, FeetechModel] = MappingProxyType(
    {
        model.name: model
        for model in (
            _model("STS3215", 777), _model("STS3250", 2825), _model("SM8512BL", 11272),
            _model("STS", None), _model("SMS", None),
        )
    }
)  # fmt: skip
"""By name; a series, such as ``STS``, takes any servo of it: 4096 counts a turn."""

MODELS_BY_NUMBER = {model.number: model for model in MODELS.values() if model.number is not None}


def model_named(name: str) -> FeetechModel:
    """Return the model that a configuration names. Raises BadOptions, with the nearest known name."""
    found = MODELS.get(str(name).upper())
    if found is None:
        raise BadOptions(
            f"there is no Feetech servo {name!r}{nearest(str(name).upper(), MODELS)}; one that is not in the "
            "table is named by its series: STS or SMS"
        )
    return found


def status_faults(error: int) -> list[str]:
    """Return the faults in a status; none for a servo that is well."""
    faults = [fault for bit, fault in STATUS_FAULTS.items() if error & bit]
    unknown = error & ~sum(STATUS_FAULTS)
    return faults + ([f"unknown status bits 0x{unknown:02x}"] if unknown else [])


HEADER = b"\xff\xff"
BROADCAST_ID, HIGHEST_ID = 254, 252
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
STATUS_BYTES = 6  # of a reply without data
LONGEST_PACKET = 250


def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of an instruction."""
    body = bytes((servo_id, len(parameters) + 2, instruction)) + parameters
    return HEADER + body + bytes((~sum(body) & 0xFF,))


def sync_read_packet(address: int, length: int, servo_ids: tuple[int, ...]) -> bytes:
    """Return a read of the same bytes of several servos, which answer in this order."""
    return instruction_packet(BROADCAST_ID, SYNC_READ, bytes((address, length, *servo_ids)))


def group_write_packet(parts: Sequence[Part]) -> bytes:
    """Return a write of the same registers of several servos; none answers it."""
    body = b"".join(bytes((part.servo_id,)) + part.data for part in parts)
    return instruction_packet(BROADCAST_ID, SYNC_WRITE, bytes((parts[0].address, parts[0].length)) + body)


def take_status(buffer: bytearray, *, at_end: bool = False) -> StatusPacket | None:
    """Take the first whole packet whose sum fits out of a buffer; None when there is none yet.

    With ``at_end`` no more bytes will come: a header whose packet is not whole was noise.
    """
    while True:
        if not at_header(buffer, HEADER):
            return None
        if len(buffer) >= STATUS_BYTES or (len(buffer) >= 3 and buffer[2] > HIGHEST_ID + 1):
            end = 4 + buffer[3]
            if buffer[2] <= HIGHEST_ID + 1 and STATUS_BYTES <= end <= LONGEST_PACKET:
                if len(buffer) < end and not at_end:
                    return None
                whole = bytes(buffer[:end])
                if len(whole) == end and whole[-1] == ~sum(whole[2:-1]) & 0xFF:
                    del buffer[:end]
                    # its error byte says how the servo is, and refuses nothing
                    return StatusPacket(whole[2], whole[4], whole[5:-1], 0, whole[4] != 0)
        elif not at_end:
            return None
        del buffer[:1]


FORMAT = PacketFormat(
    take_status,
    instruction_packet,
    1,
    group_write_packet,
    STATUS_BYTES,
    {PING: "ping", READ: "read", WRITE: "write"},
    {},
    instruction_packet(BROADCAST_ID, SYNC_WRITE, bytes((40, 0))),
)


STARTS, TOKENS = 17, 16
FIRST_START, END = 24, 71  # of what is read, up to torque_enable
AGREEING_TRIES = 5
POLL_BYTES = 24 + 2 * (6 + 47)  # a write and a read of both servos, and two replies of the longest question


class FeetechLink(BusLink):
    """One open line and its transactions, as of `BusLink`."""

    packets = FORMAT
    finds_echo = True

    @cached_property
    def questions(self) -> Iterator[int]:
        """The numbers of this line's questions, unless it is given the head's."""
        return itertools.count()

    def ping(self, servo_id: int) -> int:
        """Return the status of a servo that is there. Raises NoReply, BadReply, LineLost."""
        return self.request(servo_id, PING, b"", 0).error

    def ping_all(self) -> tuple[list[int], int]:
        """Return the ids that answer a ping to all, and how many bytes came that were no reply: two servos
        spoke at once. Raises LineLost, BadReply.
        """
        port = self.port
        port.send(instruction_packet(BROADCAST_ID, PING), 0)
        port.deadline_s = self.clock.now_s() + port.reply_timeout_s + 253 * (0.0005 + 6 * port.byte_s)
        found, before = [], port.received_bytes
        while (status := port.receive()) is not None:
            found.append(status.servo_id)
        port.suspect = False
        noise = port.received_bytes - before - 6 * (len(found) + port.echoes)
        return sorted(set(found)), max(0, noise)

    def proven(self, servo_id: int, register: Register) -> int:
        """Return a register's value, said twice around a silence by replies of two lengths.

        Raises BadReply if the answers contradict one another again and again; NoReply, LineLost.
        """
        size, before = register.size, None
        for more in range(AGREEING_TRIES):
            data = self.read(servo_id, register.address, size + more % 2, register.name)[:size]
            if data == before:
                return register.decode(data)
            before = data
            self.quiet(QUIET_S)
        raise BadReply(
            f"servo {servo_id} on {self.name} contradicts itself about {register.name}",
            detail=self.where(servo_id, "read", register.name),
        )

    def block(self, servo_id: int, address: int, length: int) -> bytes:
        """Return bytes of one servo's memory, read one time after a silence. Raises as `proven`."""
        self.quiet(QUIET_S)
        return self.read(servo_id, address, length, "memory")

    def write_at_once(self, parts: Sequence[Part], copies: int = 1) -> None:
        """Write as `BusLink.write_at_once`; before the next question the line has to be quiet."""
        self.port.suspect = True
        super().write_at_once(parts, copies)

    def samples(self, servos: Mapping[int, int]) -> dict[int, ServoSample]:
        """Return what servos say about their motion now, by id.

        Raises NoReply, BadReply, LineLost if one is silent, or an answer is not of this question.

        ``servos`` has of each id its full torque limit, 0.1 %.
        """
        number = next(self.questions)
        start, token = FIRST_START + number % STARTS, number % TOKENS
        limits = {one: limit - token for one, limit in servos.items()}
        tokens = [Part(one, 48, 2, limit.to_bytes(2, "little")) for one, limit in limits.items()]
        length, ids = END - start, tuple(servos)
        question = group_write_packet(tokens) + sync_read_packet(start, length, ids)
        try:
            sent_s = self.port.send(question, len(ids) * (STATUS_BYTES + length))
            taken = self._replies(ids, length)
        except LineLost as error:
            raise self.placed(error, ids, "sync read") from error
        received_s = self.clock.now_s()
        found = {}
        for one, status in taken.items():
            values = _values(start, status.data)
            if values["torque_limit"] != limits[one]:
                self.note_unexpected(status)
                raise BadReply(
                    f"servo {one} on {self.name}: a reply to another question (late, or repeated): it holds "
                    f"the torque limit {values['torque_limit']} where {limits[one]} was written with the "
                    "question",
                    detail=self.where(one, "sync read", "torque_limit"),
                )
            values["torque_limit"] = servos[one]
            found[one] = ServoSample(values, status.alert, sent_s, received_s)
        return found

    def _replies(self, ids: Sequence[int], length: int) -> dict[int, StatusPacket]:
        """The replies to a sync read, in the order requested, one of each servo. Raises NoReply, LineLost."""
        taken: dict[int, StatusPacket] = {}
        for one in ids:
            while True:
                status = self.port.receive()
                if status is None:
                    raise self.silence(one, "sync read", f"{length} bytes")
                if status.servo_id == one and len(status.data) == length:
                    taken[one] = status
                    break
                self.note_unexpected(status)
                if (
                    status.servo_id in ids
                    and len(status.data) == length
                    and status != taken.get(status.servo_id)
                ):
                    raise BadReply(
                        f"servo {status.servo_id} on {self.name} answers out of turn",
                        detail=self.where(status.servo_id, "sync read", ""),
                    )
        return taken


def _values(start: int, data: bytes) -> dict[str, int]:
    """The registers in a block by name, and what `AxisCourse` reads beside them."""
    values = {}
    for register in REGISTERS.values():
        at = register.address - start
        if register.address >= 40 and at + register.size <= len(data):
            values[register.name] = register.decode(data[at : at + register.size])
    values["moving_status"] = 2 * values["moving"]  # a profile is under way
    values["profile_acceleration"] = values["acceleration"]
    values["profile_velocity"] = values["goal_speed"]
    return values


def present(link: FeetechLink) -> tuple[list[FoundServo], int]:
    """Return the servos that answer on a line, as `drivers.servo_bus.bench.ServoBench`."""
    ids, noise = link.ping_all()
    found = []
    for servo_id in ids:
        try:
            found.append(_found(link, servo_id))
        except WrongDevice:
            found.append(FoundServo(link.baud, servo_id, 0, "SCS", "", ()))
        except NoReply:
            continue
    return found, noise


def _found(link: FeetechLink, servo_id: int) -> FoundServo:
    model, number, firmware = identify(link, servo_id)
    faults = status_faults(again(link, lambda: link.ping(servo_id)))
    return FoundServo(link.baud, servo_id, number, model.name, firmware, tuple(faults))


def identify(link: FeetechLink, servo_id: int) -> tuple[FeetechModel, int, str]:
    """Return a servo's model, the number in its memory, and its firmware.

    Raises WrongDevice for an SCS, whose memory states the other byte order; NoReply, BadReply, LineLost.
    """
    before = b""
    for _ in range(ATTEMPTS + 1):
        data = again(link, lambda: link.block(servo_id, 0, 5))
        if data == before:
            break
        before = data
    if data[2] == 1:
        raise WrongDevice(f"servo {servo_id} on {link.name} is an SCS, which mastctl does not drive")
    number = data[3] | data[4] << 8
    return MODELS_BY_NUMBER.get(number, MODELS["STS"]), number, f"{data[0]}.{data[1]}"


def facts(link: FeetechLink, servo_id: int) -> ServoFacts:
    """Read every register of a servo that the table knows. Raises NoReply, BadReply, LineLost."""
    model, number, firmware = identify(link, servo_id)
    data = again(link, lambda: link.block(servo_id, 0, END))
    values = {r.name: r.decode(data[r.address : r.address + r.size]) for r in REGISTERS.values()}
    name = model.name if model.number else f"{model.name} (number {number}, not in the table)"
    return ServoFacts(servo_id, name, firmware, values, _meanings(model, values))


def _meanings(model: FeetechModel, values: Mapping[str, int]) -> dict[str, str]:
    """What numbers mean."""
    found = {
        name: f"{math.degrees((values[name] - model.centre_count) * model.count_rad):.3f} deg from its middle"
        for name in ("min_angle_limit", "max_angle_limit", "goal_position", "present_position")
    }
    for name in ("max_voltage_limit", "min_voltage_limit", "present_voltage"):
        found[name] = f"{values[name] / 10:.1f} V"
    for name in ("max_torque", "torque_limit", "present_load"):
        found[name] = f"{values[name] / 10:.1f} %"
    found["baud"] = f"{BAUD_RATES[values['baud']]} baud" if values["baud"] < len(BAUD_RATES) else "unknown"
    found["status"] = " and ".join(status_faults(values["status"])) or "well"
    found["torque_enable"] = "on" if values["torque_enable"] else "off"
    found["lock"] = "EEPROM locked" if values["lock"] else "EEPROM unlocked"
    turn = f"{math.degrees(values['offset'] * model.count_rad):.3f} deg"
    found["offset"] = f"{turn}, part of every position; mastctl never writes it"
    return found


def set_id(
    link: FeetechLink, old: int, new: int, new_baud: int | None = None, *, torque_off: bool = False
) -> None:
    """Give a servo another id, and another baud rate if wanted; see that it took them.

    A change that is broken off says what the servo is left with. Raises BadOptions for ids or a baud rate
    that cannot be; WrongDevice if the new id is taken, or torque is on and ``torque_off`` is not given;
    NoReply, BadReply, LineLost if it cannot be reached, before or afterwards.
    """
    check_change(link, old, new, new_baud, BAUD_RATES)
    identify(link, old)
    if old != new:
        with suppress(NoReply):
            link.ping(new)
            raise WrongDevice(f"id {new} is taken by another servo; choose another")
        link.quiet(0.05)
    registers = REGISTERS
    if link.proven(old, registers["torque_enable"]):
        if not torque_off:
            raise WrongDevice(
                f"the torque of servo {old} is on: support what hangs on it and give --torque-off"
            )
        link.write(old, registers["torque_enable"], 0)
    link.write(old, registers["lock"], UNLOCKED)
    with changing(link, "feetech", old, new, new_baud):
        try:
            if old != new:
                link.write_unanswered(old, registers["id"], new)
            if new_baud not in (None, link.baud):
                link.ping(new)  # before its rate changes
                link.write_unanswered(new, registers["baud"], BAUD_RATES.index(new_baud))
                link.set_baud(new_baud)
            link.write(new, registers["lock"], LOCKED)
        except BaseException:  # it has the one id or the other, and its EEPROM stays unlocked under neither
            for servo_id in {new, old}:
                with suppress(DriverError):
                    link.write(servo_id, registers["lock"], LOCKED)
            raise
        link.ping(new)
