"""What a person does to servos on the bench: find them, read all they say, give them an id.

For one thread and a line that no daemon holds. Nothing here moves a servo; `trial` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from drivers.clock import Clock
from drivers.dynamixel.link import Link, Pinged
from drivers.dynamixel.models import BAUD_RATES, MODELS_BY_NUMBER, Model, hardware_error_words
from drivers.dynamixel.register_words import register_words
from drivers.dynamixel.servo_table import ServoTable, again, identified
from drivers.errors import BadOptions, NoReply, Refused, WrongDevice
from drivers.serial_line import OpenLine, SerialLine

HIGHEST_ID = 252


@dataclass(frozen=True)
class FoundServo:
    """A servo that answered a scan."""

    baud: int
    servo_id: int
    model_number: int
    model: str
    firmware: int
    hardware_errors: tuple[str, ...]


@dataclass(frozen=True)
class Scan:
    """What a scan found; ``garbled`` are the baud rates at which bytes came that were no reply."""

    found: tuple[FoundServo, ...]
    bauds: tuple[int, ...]
    garbled: tuple[int, ...]


def scan(
    port: str,
    bauds: Sequence[int],
    reply_timeout_s: float,
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> Scan:
    """Ask at every baud rate who is there; ``clock`` and ``open_line`` are those of `Link`.

    Raises
    ------
    LineLost, BadOptions
        If the line cannot be opened at all, or the adapter cannot do a rate.
    """
    found: list[FoundServo] = []
    garbled: list[int] = []
    for baud in bauds:
        link = Link(port, baud, reply_timeout_s, clock=clock, open_line=open_line)
        try:
            pings, noise = link.ping_all()
            if noise:
                garbled.append(baud)
            found += [_found(link, ping) for ping in pings]
        finally:
            link.close()
    return Scan(tuple(found), tuple(bauds), tuple(garbled))


def _found(link: Link, ping: Pinged) -> FoundServo:
    model = MODELS_BY_NUMBER.get(ping.model_number)
    words: list[str] = []
    if ping.alert and model is not None:
        words = hardware_error_words(table_of(link, ping.servo_id, model).get("hardware_error"))
    name = model.name if model else "unknown"
    return FoundServo(link.baud, ping.servo_id, ping.model_number, name, ping.firmware, tuple(words))


@dataclass(frozen=True)
class ServoFacts:
    """Everything a servo says: its registers as they stand, and in words where a number needs them."""

    servo_id: int
    model: str
    firmware: int
    values: dict[str, int]
    words: dict[str, str]


def facts(link: Link, servo_id: int) -> ServoFacts:
    """Read every register of a servo that the table knows.

    Raises
    ------
    WrongDevice
        If its model is not in the table.
    NoReply, BadReply, Refused, LineLost
        If it cannot be read.
    """
    model, firmware = identify(link, servo_id)
    table = table_of(link, servo_id, model)
    values: dict[str, int] = {}
    for name in model.registers:
        with suppress(Refused):  # this model has none
            values[name] = table.get(name)
    words = {name: register_words(model, name, value) for name, value in values.items()}
    return ServoFacts(servo_id, model.name, firmware, values, {n: w for n, w in words.items() if w})


def identify(link: Link, servo_id: int) -> tuple[Model, int]:
    """Return a servo's model and firmware. Raises as `facts`."""
    pinged = identified(link, servo_id, f"servo {servo_id}")
    model = MODELS_BY_NUMBER.get(pinged.model_number)
    if model is None:
        raise WrongDevice(
            f"servo {servo_id} has the model number {pinged.model_number}, which is not in the table"
        )
    return model, pinged.firmware


def table_of(link: Link, servo_id: int, model: Model) -> ServoTable:
    """Return a servo's control table."""
    return ServoTable(link, servo_id, model.registers, f"servo {servo_id}")


def set_id(link: Link, old: int, new: int, new_baud: int | None = None, *, torque_off: bool = False) -> None:
    """Give a servo another id, and another baud rate if asked; see that it took them.

    Connect that one servo alone if two may have the same id: they would both take the new one.

    Raises
    ------
    BadOptions
        For ids or a baud rate that cannot be.
    WrongDevice
        If the new id is taken, or the servo did not take it, or torque is on (the servo locks its id then)
        and ``torque_off`` is not given.
    NoReply, BadReply, Refused, LineLost
        If it cannot be reached.
    """
    for name, value in (("old", old), ("new", new)):
        if not 0 <= value <= HIGHEST_ID:
            raise BadOptions(f"the {name} id {value} cannot be; an id is 0 to {HIGHEST_ID}")
    codes = {rate: code for code, rate in BAUD_RATES.items()}
    if new_baud is not None and new_baud not in codes:
        raise BadOptions(f"{new_baud} baud cannot be; there is {', '.join(str(rate) for rate in codes)}")
    if old == new and new_baud in (None, link.baud):
        raise BadOptions(f"servo {old} already has this id and baud rate; there is nothing to do")
    model, _ = identify(link, old)
    if old != new:
        try:
            taken = link.ping(new)
        except NoReply:
            link.quiet(0.05)
        else:
            other = MODELS_BY_NUMBER.get(taken.model_number)
            raise WrongDevice(f"id {new} is taken by a {other.name if other else 'servo'}; choose another")
    table = table_of(link, old, model)
    if table.get("torque_enable"):
        if not torque_off:
            raise WrongDevice(
                f"the torque of servo {old} is on, which locks its id: support what hangs on it and give "
                "--torque-off"
            )
        table.set("torque_enable", 0)
    if old != new:
        _change(link, old, model, "id", new)
        _confirm(link, new, model, f"servo {old} did not take the id {new}")
    if new_baud is not None and new_baud != link.baud:
        _change(link, new, model, "baud", codes[new_baud])
        link.clock.sleep(0.05)  # the servo changes its rate after its answer
        link.set_baud(new_baud)
        _confirm(link, new, model, f"servo {new} does not answer at {new_baud} baud")


def _change(link: Link, servo_id: int, model: Model, register: str, value: int) -> None:
    """Write an id or a rate; the answer may come under the new one and so be missed."""
    try:
        link.write(servo_id, model.registers[register], value)
    except NoReply:
        link.quiet(0.05)


def _confirm(link: Link, servo_id: int, model: Model, otherwise: str) -> None:
    try:
        found = again(link, lambda: link.ping(servo_id))
    except NoReply:
        raise WrongDevice(otherwise) from None
    if found.model_number != model.number:
        raise WrongDevice(f"{otherwise}: model number {found.model_number} answers")
