"""What a person does to servos on the bench: find them, read all they say, give them an id.

For one thread and a line that no daemon holds. Nothing here moves a servo.
"""

from __future__ import annotations

from contextlib import suppress

from drivers.dynamixel.link import Link, Pinged
from drivers.dynamixel.models import (
    BAUD_RATES,
    MODELS,
    MODELS_BY_NUMBER,
    POLL_BYTES,
    ServoModel,
    hardware_error_names,
    register_meaning,
)
from drivers.dynamixel.servo import ServoTable, identified
from drivers.errors import NoReply, Refused, WrongDevice
from drivers.servo_bus.bench import (
    FoundServo,
    ServoBench,
    ServoFacts,
    changing,
    check_change,
)
from drivers.servo_bus.exchange import again


def _present(link: Link) -> tuple[list[FoundServo], int]:
    link.find_echo()
    pings, noise = link.ping_all()
    return [_found(link, ping) for ping in pings], noise


def _found(link: Link, ping: Pinged) -> FoundServo:
    model = MODELS_BY_NUMBER.get(ping.model_number)
    errors: list[str] = []
    if ping.alert and model is not None:
        errors = hardware_error_names(table_of(link, ping.servo_id, model).get("hardware_error"))
    name = model.name if model else f"model number {ping.model_number}"
    return FoundServo(link.baud, ping.servo_id, ping.model_number, name, ping.firmware, tuple(errors))


def facts(link: Link, servo_id: int) -> ServoFacts:
    """Read every register of a servo. Raises WrongDevice for a model that the driver does not know."""
    pinged = identified(link, servo_id, f"servo {servo_id}")
    model, firmware = _known(pinged), pinged.firmware
    table = table_of(link, servo_id, model)
    values: dict[str, int] = {}
    for name in model.registers:
        with suppress(Refused):  # this model has none
            values[name] = table.get(name)
    meanings = {name: register_meaning(model, name, value) for name, value in values.items()}
    return ServoFacts(servo_id, model.name, firmware, values, {n: m for n, m in meanings.items() if m})


def identify(link: Link, servo_id: int) -> tuple[ServoModel, int]:
    """Return a servo's model and firmware. Raises as `facts`; WrongDevice for one that is not driven."""
    pinged = identified(link, servo_id, f"servo {servo_id}")
    return _known(pinged), pinged.firmware


def _known(pinged: Pinged) -> ServoModel:
    """The model of a servo. Raises WrongDevice."""
    model = MODELS_BY_NUMBER.get(pinged.model_number)
    if model is None:
        message = f"servo {pinged.servo_id}: the driver does not know the model number {pinged.model_number}"
        raise WrongDevice(message)
    return model


def table_of(link: Link, servo_id: int, model: ServoModel) -> ServoTable:
    """Return a servo's control table."""
    return ServoTable(link, servo_id, model.registers, f"servo {servo_id}")


def set_id(link: Link, old: int, new: int, new_baud: int | None = None, *, torque_off: bool = False) -> None:
    """Give a servo another id, and another baud rate if wanted; see that it took them.

    A change that is broken off says what the servo is left with. Connect that one servo alone if two may have
    the same id: they would both take the new one. Raises BadOptions for ids or a baud rate that cannot be;
    WrongDevice if the new id is taken, or the servo did not take it, or torque is on (the servo locks its id
    then) and ``torque_off`` is not given; NoReply, BadReply, Refused, LineLost.
    """
    codes = {rate: code for code, rate in BAUD_RATES.items()}
    check_change(link, old, new, new_baud, codes)
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
    with changing(link, "dynamixel", old, new, new_baud):
        if old != new:
            _change(link, old, model, "id", new)
            _confirm(link, new, model, f"servo {old} did not take the id {new}")
        if new_baud not in (None, link.baud):
            _change(link, new, model, "baud", codes[new_baud])
            link.clock.sleep(0.05)  # the servo changes its rate after its answer
            link.set_baud(new_baud)
            _confirm(link, new, model, f"servo {new} does not answer at {new_baud} baud")


def _change(link: Link, servo_id: int, model: ServoModel, register: str, value: int) -> None:
    """Write an id or a rate; the answer may come under the new one and so be missed."""
    try:
        link.write(servo_id, model.registers[register], value)
    except NoReply:
        link.quiet(0.05)


def _confirm(link: Link, servo_id: int, model: ServoModel, otherwise: str) -> None:
    try:
        found = again(link, lambda: link.ping(servo_id))
    except NoReply:
        raise WrongDevice(otherwise) from None
    if found.model_number != model.number:
        raise WrongDevice(f"{otherwise}: model number {found.model_number} answers")


BENCH = ServoBench(
    "dynamixel", Link, _present, facts, set_id,
    (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000, 6_000_000, 10_500_000, 9600),
    (1_000_000, 57_600, 115_200, 2_000_000, 3_000_000, 4_000_000),
    MODELS, "XL330-M288-T", POLL_BYTES,
)  # fmt: skip
