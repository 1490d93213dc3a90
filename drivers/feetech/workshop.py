"""What a person does to Feetech servos on the bench: find them, read them, give them an id, try one out.

For one thread and a line that no daemon holds. Nothing here moves a servo but `try_out`, which turns it a
little, slowly, weakly, and leaves it as it was.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from drivers.clock import Clock
from drivers.errors import DriverError, HardwareFault, NoReply, WrongDevice
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
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.bench import (
    LONGEST_STEP_S,
    FoundServo,
    Scan,
    ServoFacts,
    Trial,
    TrialStep,
    changing,
    check_change,
    check_trial,
    restored,
    scanned,
    watched_step,
)
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.exchange import ATTEMPTS, again
from drivers.servo_bus.rest import Rest, rests

TRIAL_SPEED_RAD_PER_S, TRIAL_ACCELERATION_RAD_PER_S2 = 0.2, 1.0
CHANGED = ("acceleration", "goal_time", "goal_speed", "torque_limit")
PROBE_SPEED, PROBE_S, PROBE_COUNTS = 3, 1.0, 6
"""What a servo is told to find out the unit of its speed: 3 counts a second, or 150; more than 6 are many."""


def scan(
    port: str,
    bauds: Sequence[int],
    reply_timeout_s: float,
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> Scan:
    """Ask at every baud rate who is there, as `scanned`; the rest as of `FeetechLink`."""
    opened = partial(open_link, port, reply_timeout_s=reply_timeout_s, clock=clock, open_line=open_line)
    return scanned(bauds, opened, _there)


def _there(link: FeetechLink) -> tuple[list[FoundServo], int]:
    ids, noise = link.ping_all()
    found = []
    for servo_id in ids:
        with suppress(NoReply):
            found.append(_found(link, servo_id))
    return found, noise


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

    A change that is broken off says what the servo is left with.

    Raises
    ------
    BadOptions
        For ids or a baud rate that cannot be.
    WrongDevice
        If the new id is taken, or torque is on and ``torque_off`` is not given.
    NoReply, BadReply, LineLost
        If it cannot be reached, before or afterwards.
    """
    check_change(link, old, new, new_baud, BAUD_RATES)
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
    with changing(link, "feetech", old, new_baud) as change:
        try:
            if old != new:
                change.ids = [old, new]
                link.write_unanswered(old, registers["id"], new, model)
                if change.new_baud is not None:
                    link.ping(new)  # before its rate changes
                    change.ids = [new]
            if change.new_baud is not None:
                change.bauds.append(change.new_baud)
                link.write_unanswered(new, registers["baud"], BAUD_RATES.index(change.new_baud), model)
                link.set_baud(change.new_baud)
            link.write(new, registers["lock"], LOCKED, model)
        except BaseException:  # it has the one id or the other, and its EEPROM stays unlocked under neither
            for servo_id in {new, old}:
                with suppress(DriverError):
                    link.write(servo_id, registers["lock"], LOCKED, model)
            raise
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
    set_ = partial(_set, link, servo_id, model)
    found = [] if values["torque_enable"] else [("torque_enable", 0)]
    found += [(name, values[name]) for name in CHANGED if name in values]
    with restored(f"servo {servo_id}", set_, found):
        if not model.is_scs:
            weak = round(values["max_torque"] * torque_percent / 100)
            set_("torque_limit", weak)
            unit = max(1, round(TRIAL_ACCELERATION_RAD_PER_S2 / model.acceleration_unit_rad_per_s2))
            set_("acceleration", unit)
        for name, value in (("goal_time", 0), ("goal_speed", PROBE_SPEED), ("goal_position", start)):
            set_(name, value)
        set_("torque_enable", 1)
        try:
            speed_unit = _speed_unit(link, servo_id, model, start + reach)
            speed = PROBE_SPEED
            if speed_unit is not None:
                model = replace(model, speed_unit_counts=speed_unit)
                speed = max(1, round(TRIAL_SPEED_RAD_PER_S / model.velocity_unit_rad_per_s))
            set_("goal_speed", speed)
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
    check_trial(name, values, (values["min_angle_limit"], values["max_angle_limit"]), reach)


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
    rests(lambda: again(link, lambda: link.look(servo_id, model)), link.clock, LONGEST_STEP_S, Rest())
    after = link.proven(servo_id, position, model)
    if abs(after - before) > PROBE_COUNTS:
        return 50
    return 1 if abs(goal - before) > PROBE_COUNTS + 2 else None


def _step(
    link: FeetechLink, servo_id: int, model: FeetechModel, goal: int, fence: tuple[int, int]
) -> TrialStep:
    """Watch one short move to its end."""
    name = f"servo {servo_id}"

    def look() -> ServoSample:
        sample = again(link, lambda: link.look(servo_id, model))
        if sample.alert:
            words = status_words(sample.values["status"])
            raise HardwareFault(f"{name} reports {words}; the trial is ended")
        return sample

    began_s = link.clock.now_s()
    again(link, lambda: link.write(servo_id, model.registers["goal_position"], goal, model))
    return watched_step(name, look, link.clock, began_s, goal, fence, model.current_unit_A)
