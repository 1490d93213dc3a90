"""What a person does to Feetech servos on the bench: find them, read them, give them an id, try one out.

For one thread and a line that no daemon holds. Nothing here moves a servo but `try_out`, which turns it a
little, slowly, weakly, and leaves it as it was.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace

from drivers.clock import Clock
from drivers.errors import BadOptions, DriverError, HardwareFault, NoReply, OutOfRange, WrongDevice
from drivers.feetech.link import FeetechLink, open_link
from drivers.feetech.models import (
    BAUD_RATES,
    LOCKED,
    MODELS,
    MODELS_BY_NUMBER,
    POSITION_MODE,
    UNLOCKED,
    FeetechModel,
    status_words,
)
from drivers.feetech.packets import HIGHEST_ID
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.bench import FoundServo, Scan, ServoFacts, Trial, TrialStep
from drivers.servo_bus.exchange import ATTEMPTS, again
from drivers.servo_bus.rest import STEP_RESTS_S, Rest

TRIAL_SPEED_RAD_PER_S, TRIAL_ACCELERATION_RAD_PER_S2 = 0.2, 1.0
TRIAL_POLL_S, LONGEST_STEP_S = 0.02, 10.0
WARM_MARGIN_C = 10
PROBE_SPEED, PROBE_S, PROBE_COUNTS = 3, 1.0, 6
"""What a servo is told to find out the unit of its speed: 3 counts a second, or 150; more than 6 are many."""


def scan(
    port: str,
    bauds: Sequence[int],
    reply_timeout_s: float,
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> Scan:
    """Ask at every baud rate who is there; ``clock`` and ``open_line`` are those of `FeetechLink`.

    Raises
    ------
    LineLost, BadOptions
        If the line cannot be opened at all, or the adapter cannot do a rate.
    """
    found: list[FoundServo] = []
    garbled: list[int] = []
    for baud in bauds:
        link = open_link(port, baud, reply_timeout_s, clock=clock, open_line=open_line)
        try:
            ids, noise = link.ping_all()
            if noise:
                garbled.append(baud)
            for servo_id in ids:
                with suppress(NoReply):
                    found.append(_found(link, servo_id))
        finally:
            link.close()
    return Scan(tuple(found), tuple(bauds), tuple(garbled))


def _found(link: FeetechLink, servo_id: int) -> FoundServo:
    model, number, firmware = identify(link, servo_id)
    words = status_words(again(link, lambda: link.ping(servo_id)))
    return FoundServo(
        link.baud, servo_id, number, model.name, firmware, tuple(words.split(" and ")) if words else ()
    )


def identify(link: FeetechLink, servo_id: int) -> tuple[FeetechModel, int, str]:
    """Return a servo's model, the number in its memory, and its firmware.

    One that is not in the table is taken by the byte order that its memory states. Raises NoReply, BadReply,
    LineLost.
    """
    before = b""
    for _ in range(ATTEMPTS + 1):
        data = again(link, lambda: link.block(servo_id, 0, 5))
        if data == before:
            break
        before = data
    little, big = data[3] | data[4] << 8, data[3] << 8 | data[4]
    firmware = f"{data[0]}.{data[1]}"
    for number, order in ((little, "little"), (big, "big")):
        model = MODELS_BY_NUMBER.get(number)
        if model is not None and model.order == order:
            return model, number, firmware
    return (MODELS["SCS"], big, firmware) if data[2] == 1 else (MODELS["STS"], little, firmware)


def facts(link: FeetechLink, servo_id: int) -> ServoFacts:
    """Read every register of a servo that the table knows. Raises NoReply, BadReply, LineLost."""
    model, number, firmware = identify(link, servo_id)
    registers = model.registers.values()
    end = max(register.address + register.size for register in registers)
    data = again(link, lambda: link.block(servo_id, 0, end))
    values = {r.name: r.decode(data[r.address : r.address + r.size], model.order) for r in registers}
    name = model.name if model.number else f"{model.name} (number {number}, not in the table)"
    return ServoFacts(servo_id, name, firmware, values, _words(model, values))


def _words(model: FeetechModel, values: Mapping[str, int]) -> dict[str, str]:
    """What numbers mean."""
    words = {
        name: f"{math.degrees((values[name] - model.centre_count) * model.count_rad):.3f} deg from its middle"
        for name in ("min_angle_limit", "max_angle_limit", "goal_position", "present_position")
    }
    for name in ("max_voltage_limit", "min_voltage_limit", "present_voltage"):
        words[name] = f"{values[name] / 10:.1f} V"
    for name in ("max_torque", "torque_limit", "present_load"):
        if name in values:
            words[name] = f"{values[name] / 10:.1f} %"
    words["baud"] = f"{BAUD_RATES[values['baud']]} baud" if values["baud"] < len(BAUD_RATES) else "unknown"
    words["status"] = status_words(values["status"]) or "well"
    words["torque_enable"] = "on" if values["torque_enable"] else "off"
    words["lock"] = "EEPROM locked" if values["lock"] else "EEPROM unlocked"
    if "offset" in values:
        turn = f"{math.degrees(values['offset'] * model.count_rad):.3f} deg"
        words["offset"] = f"{turn}, part of every position; mastctl never writes it"
    return words


def set_id(
    link: FeetechLink, old: int, new: int, new_baud: int | None = None, *, torque_off: bool = False
) -> None:
    """Give a servo another id, and another baud rate if asked; see that it took them.

    Raises
    ------
    BadOptions
        For ids or a baud rate that cannot be.
    WrongDevice
        If the new id is taken, or torque is on and ``torque_off`` is not given.
    NoReply, BadReply, LineLost
        If it cannot be reached, before or afterwards.
    """
    for name, value in (("old", old), ("new", new)):
        if not 0 <= value <= HIGHEST_ID:
            raise BadOptions(f"the {name} id {value} cannot be; an id is 0 to {HIGHEST_ID}")
    if new_baud is not None and new_baud not in BAUD_RATES:
        raise BadOptions(f"{new_baud} baud cannot be; there is {', '.join(map(str, BAUD_RATES))}")
    if old == new and new_baud in (None, link.baud):
        raise BadOptions(f"servo {old} already has this id and baud rate; there is nothing to do")
    model, _, _ = identify(link, old)
    if old != new:
        with suppress(NoReply):
            link.ping(new)
            raise WrongDevice(f"id {new} is taken by another servo; choose another")
        link.quiet(0.05)
    registers = model.registers
    if link.proven(old, registers["torque_enable"], model):
        if not torque_off:
            raise WrongDevice(
                f"the torque of servo {old} is on: support what hangs on it and give --torque-off"
            )
        link.write(old, registers["torque_enable"], 0, model)
    link.write(old, registers["lock"], UNLOCKED, model)
    if old != new:
        link.write_unanswered(old, registers["id"], new, model)
    if new_baud is not None and new_baud != link.baud:
        link.write_unanswered(new, registers["baud"], BAUD_RATES.index(new_baud), model)
        link.set_baud(new_baud)
    link.write(new, registers["lock"], LOCKED, model)
    link.ping(new)


def try_out(link: FeetechLink, servo_id: int, amplitude_rad: float, torque_percent: float) -> Trial:
    """Turn a servo a little to each side and back, slowly and weakly, and find its unit of speed.

    It has no watchdog: if this program dies, the step under way is its last. Whatever goes wrong, the servo
    is stopped where it stands; torque, acceleration, speed and torque limit are left as they were found.

    Raises
    ------
    WrongDevice, HardwareFault, OutOfRange
        If the servo is not fit for it. Nothing has moved then.
    NoReply, BadReply, LineLost
        If it cannot be reached.
    """
    model, _, _ = identify(link, servo_id)
    values = facts(link, servo_id).values
    reach = math.ceil(amplitude_rad / model.count_rad)
    start = values["present_position"]
    _check_fit(servo_id, values, reach)
    steps: list[TrialStep] = []
    with _restored(link, servo_id, model, values):
        if not model.is_scs:
            weak = round(values["max_torque"] * torque_percent / 100)
            _set(link, servo_id, model, "torque_limit", weak)
            unit = max(1, round(TRIAL_ACCELERATION_RAD_PER_S2 / model.acceleration_unit_rad_per_s2))
            _set(link, servo_id, model, "acceleration", unit)
        for name, value in (("goal_time", 0), ("goal_speed", PROBE_SPEED), ("goal_position", start)):
            _set(link, servo_id, model, name, value)
        _set(link, servo_id, model, "torque_enable", 1)
        try:
            speed_unit = _speed_unit(link, servo_id, model, start + reach)
            speed = PROBE_SPEED
            if speed_unit is not None:
                model = replace(model, speed_unit_counts=speed_unit)
                speed = max(1, round(TRIAL_SPEED_RAD_PER_S / model.velocity_unit_rad_per_s))
            _set(link, servo_id, model, "goal_speed", speed)
            fence = start - 2 * reach, start + 2 * reach
            for goal in (start + reach, start - reach, start):
                steps.append(_step(link, servo_id, model, goal, fence))
        except BaseException:
            with suppress(DriverError):  # what went wrong first is told
                _stand(link, servo_id, model, (start - 2 * reach, start + 2 * reach))
            raise
    return Trial(servo_id, model.name, model.count_rad, start, tuple(steps), speed_unit)


def _stand(link: FeetechLink, servo_id: int, model: FeetechModel, fence: tuple[int, int]) -> None:
    """Make where the servo is its goal, by one look: under way, no two answers are alike."""
    register = model.registers["present_position"]
    data = again(link, lambda: link.exchange.read(servo_id, register.address, register.size, register.name))
    here = min(max(register.decode(data, model.order), fence[0]), fence[1])
    again(link, lambda: link.write(servo_id, model.registers["goal_position"], here, model))


def _set(link: FeetechLink, servo_id: int, model: FeetechModel, name: str, value: int) -> None:
    """Set a register and see that it holds. Raises DriverError."""
    register = model.registers[name]
    again(link, lambda: link.write(servo_id, register, value, model))
    if (held := again(link, lambda: link.proven(servo_id, register, model))) != value:
        raise WrongDevice(f"servo {servo_id} holds {held} in {name} after {value} was written to it")


def _check_fit(servo_id: int, values: Mapping[str, int], reach: int) -> None:
    """See that a trial can do no harm."""
    name = f"servo {servo_id}"
    if values.get("operating_mode", POSITION_MODE) != POSITION_MODE:
        raise WrongDevice(f"{name} is in mode {values['operating_mode']}; a trial needs position mode, 0")
    if values["status"]:
        raise HardwareFault(f"{name} reports {status_words(values['status'])}")
    if values["present_temperature"] > values["temperature_limit"] - WARM_MARGIN_C:
        raise HardwareFault(
            f"{name} is {values['present_temperature']} C, near its limit of {values['temperature_limit']} C"
        )
    low, high, start = values["min_angle_limit"], values["max_angle_limit"], values["present_position"]
    if not low + reach <= start <= high - reach:
        raise OutOfRange(
            f"{name} stands at {start} counts; a move of {reach} counts to each side leaves its limits {low} "
            f"to {high}"
        )


@contextmanager
def _restored(
    link: FeetechLink, servo_id: int, model: FeetechModel, values: Mapping[str, int]
) -> Iterator[None]:
    """Leave the servo as it was found, torque first, whatever of it fails."""
    names = ("acceleration", "goal_time", "goal_speed", "torque_limit")
    wanted = [] if values["torque_enable"] else ["torque_enable"]
    wanted += [name for name in names if name in values]
    try:
        yield
    finally:
        left = []
        for name in wanted:
            try:
                _set(link, servo_id, model, name, values[name])
            except DriverError:
                left.append(name)
        if left:
            raise WrongDevice(f"servo {servo_id} is not left as it was found in {' and '.join(left)}")


def _speed_unit(link: FeetechLink, servo_id: int, model: FeetechModel, goal: int) -> int | None:
    """Return how many counts a second a speed of 1 is, by a move that is slow, or very slow.

    None where the way is too short to tell. How far it went is asked when it stands: under way no two answers
    are alike.
    """
    position = model.registers["present_position"]
    before = link.proven(servo_id, position, model)
    link.write(servo_id, model.registers["goal_position"], goal, model)
    link.clock.sleep(PROBE_S)
    _stand(link, servo_id, model, (min(before, goal), max(before, goal)))
    until_s, rest = link.clock.now_s() + LONGEST_STEP_S, Rest()
    while not _look(link, servo_id, model, rest)[1] and link.clock.now_s() < until_s:
        link.clock.sleep(TRIAL_POLL_S)
    after = link.proven(servo_id, position, model)
    if abs(after - before) > PROBE_COUNTS:
        return 50
    return 1 if abs(goal - before) > PROBE_COUNTS + 2 else None


def _look(
    link: FeetechLink, servo_id: int, model: FeetechModel, rest: Rest
) -> tuple[Mapping[str, int], bool]:
    """Return what a servo says about its motion, and whether it stands. Raises DriverError."""
    sent_s = link.clock.now_s()
    values = again(link, lambda: link.look(servo_id, model))
    return values, rest.take(values, sent_s, link.clock.now_s())


def _step(
    link: FeetechLink, servo_id: int, model: FeetechModel, goal: int, fence: tuple[int, int]
) -> TrialStep:
    """Watch one short move to its end."""
    began_s = link.clock.now_s()
    again(link, lambda: link.write(servo_id, model.registers["goal_position"], goal, model))
    most, rest = 0, Rest(STEP_RESTS_S)
    while True:
        values, stands = _look(link, servo_id, model, rest)
        if values["status"]:
            raise HardwareFault(
                f"servo {servo_id} reports {status_words(values['status'])}; the trial is ended"
            )
        if not fence[0] <= values["present_position"] <= fence[1]:
            raise OutOfRange(
                f"servo {servo_id} left the fence of the trial at {values['present_position']} counts "
                f"(allowed {fence[0]} to {fence[1]}); it is stopped"
            )
        most = max(most, abs(values.get("present_current", 0)))
        elapsed_s = link.clock.now_s() - began_s
        if (stands and not values["moving"]) or elapsed_s > LONGEST_STEP_S:
            break
        link.clock.sleep(TRIAL_POLL_S)
    left = abs(values["present_position"] - goal)
    if left > max(abs(fence[1] - fence[0]) / 16, 4):
        raise HardwareFault(
            f"servo {servo_id} stands {left} counts from its goal: blocked, or too weak with this bound of "
            "its drive; it is stopped"
        )
    current = None if model.current_unit_A is None else most * model.current_unit_A
    return TrialStep(
        goal, values["present_position"], elapsed_s, current,
        values["present_voltage"] / 10, values["present_temperature"],
    )  # fmt: skip
