"""What a person does to servos on the bench: find them, read all they say, give them an id, try one out.

For one thread and a line that no daemon holds. Nothing here moves a servo but `try_out`, which turns it a
little, slowly, weakly, watches it all the time, and leaves it as it was.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial

from drivers.clock import Clock
from drivers.dynamixel.link import Link, Pinged
from drivers.dynamixel.models import (
    BAUD_RATES,
    MODELS_BY_NUMBER,
    OPERATING_MODES,
    POSITION_MODE,
    WATCHDOG_TRIPPED,
    ServoModel,
    hardware_error_words,
    register_words,
    what_is_needed,
)
from drivers.dynamixel.registers import RegisterBlock, vendor_names, vendor_registers
from drivers.dynamixel.servo_table import ServoTable, identified
from drivers.errors import DriverError, HardwareFault, NoReply, Refused, WrongDevice
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.bench import (
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
from drivers.servo_bus.exchange import again

TRIAL_SPEED_RAD_PER_S = 0.2
TRIAL_ACCELERATION_RAD_PER_S2 = 1.0
TRIAL_WATCHDOG = 15  # times 20 ms


def scan(
    port: str,
    bauds: Sequence[int],
    reply_timeout_s: float,
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> Scan:
    """Ask at every baud rate who is there, as `scanned`; the rest as of `Link`."""
    opened = partial(Link, port, reply_timeout_s=reply_timeout_s, clock=clock, open_line=open_line)
    return scanned(bauds, opened, _there)


def _there(link: Link) -> tuple[list[FoundServo], int]:
    pings, noise = link.ping_all()
    return [_found(link, ping) for ping in pings], noise


def _found(link: Link, ping: Pinged) -> FoundServo:
    model = MODELS_BY_NUMBER.get(ping.model_number)
    words: list[str] = []
    if ping.alert and model is not None:
        words = hardware_error_words(table_of(link, ping.servo_id, model).get("hardware_error"))
    name = model.name if model else vendor_names().get(ping.model_number, "unknown")
    return FoundServo(link.baud, ping.servo_id, ping.model_number, name, ping.firmware, tuple(words))


def facts(link: Link, servo_id: int) -> ServoFacts:
    """Read every register of a servo that the driver knows; of another one, all that the SDK's table holds.

    Raises
    ------
    WrongDevice
        If neither knows its model.
    NoReply, BadReply, Refused, LineLost
        If it cannot be read.
    """
    pinged = identified(link, servo_id, f"servo {servo_id}")
    if pinged.model_number not in MODELS_BY_NUMBER and pinged.model_number in vendor_names():
        return _vendor_facts(link, pinged)
    model, firmware = _known(pinged), pinged.firmware
    table = table_of(link, servo_id, model)
    values: dict[str, int] = {}
    for name in model.registers:
        with suppress(Refused):  # this model has none
            values[name] = table.get(name)
    words = {name: register_words(model, name, value) for name, value in values.items()}
    return ServoFacts(servo_id, model.name, firmware, values, {n: w for n, w in words.items() if w})


def _vendor_facts(link: Link, pinged: Pinged) -> ServoFacts:
    """Read a servo by the SDK's table, one register after another, each after a silence.

    What changes by itself is read one time, all else until two answers agree.
    """
    values: dict[str, int] = {}
    for register in vendor_registers(pinged.model_number):
        changing = register.name.startswith(("present_", "realtime_", "moving")) or "traj" in register.name
        ask = partial(link.heard if changing else link.agreed, pinged.servo_id, register)
        with suppress(Refused):  # this firmware has none
            values[register.name] = again(link, ask)
    name = vendor_names()[pinged.model_number]
    return ServoFacts(pinged.servo_id, name, pinged.firmware, values, {})


def identify(link: Link, servo_id: int) -> tuple[ServoModel, int]:
    """Return a servo's model and firmware. Raises as `facts`; WrongDevice for one that is not driven."""
    pinged = identified(link, servo_id, f"servo {servo_id}")
    return _known(pinged), pinged.firmware


def _known(pinged: Pinged) -> ServoModel:
    """The model of a servo. Raises WrongDevice."""
    model = MODELS_BY_NUMBER.get(pinged.model_number)
    if model is None:
        words = what_is_needed(pinged.model_number)
        raise WrongDevice(f"servo {pinged.servo_id}: the driver does not know {words}")
    return model


def table_of(link: Link, servo_id: int, model: ServoModel) -> ServoTable:
    """Return a servo's control table."""
    return ServoTable(link, servo_id, model.registers, f"servo {servo_id}")


def set_id(link: Link, old: int, new: int, new_baud: int | None = None, *, torque_off: bool = False) -> None:
    """Give a servo another id, and another baud rate if asked; see that it took them.

    A change that is broken off says what the servo is left with. Connect that one servo alone if two may have
    the same id: they would both take the new one.

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
    with changing(link, "dynamixel", old, new_baud) as change:
        if old != new:
            change.ids = [old, new]
            _change(link, old, model, "id", new)
            _confirm(link, new, model, f"servo {old} did not take the id {new}")
            change.ids = [new]
        if change.new_baud is not None:
            change.bauds.append(change.new_baud)
            _change(link, new, model, "baud", codes[change.new_baud])
            link.clock.sleep(0.05)  # the servo changes its rate after its answer
            link.set_baud(change.new_baud)
            _confirm(link, new, model, f"servo {new} does not answer at {change.new_baud} baud")


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


def try_out(link: Link, servo_id: int, amplitude_rad: float, torque_percent: float) -> Trial:
    """Turn a servo a little to one side, to the other and back: slowly, weakly, watched all the time.

    Its bus watchdog is armed meanwhile; one that has tripped is cleared first. Whatever goes wrong, the
    servo is stopped where it stands; torque, profile, strength and watchdog are left as they were found, each
    of them even if another cannot be.

    Parameters
    ----------
    link
        An open line.
    servo_id
        Which servo.
    amplitude_rad
        How far to each side of where it stands.
    torque_percent
        Bound of the motor's drive (Goal PWM), percent of full.

    Raises
    ------
    WrongDevice, HardwareFault, OutOfRange
        If the servo is not fit for it: another operating mode, a hardware error, too warm, a voltage outside
        its limits, no room to its position limits. Nothing has moved then.
    NoReply, BadReply, Refused, LineLost
        If it cannot be reached.
    """
    model, firmware = identify(link, servo_id)
    values = facts(link, servo_id).values
    reach = math.ceil(amplitude_rad / model.count_rad)
    start = values["present_position"]
    _check_fit(servo_id, model, values, reach)
    table = table_of(link, servo_id, model)
    fence = start - 2 * reach, start + 2 * reach
    steps: list[TrialStep] = []
    with restored(table.name, table.set, _found_so(values)):
        _make_weak_and_slow(table, model, values, torque_percent)
        table.set("torque_enable", 1)
        if firmware >= model.watchdog_firmware:
            table.set("bus_watchdog", TRIAL_WATCHDOG)
        try:
            for goal in (start + reach, start - reach, start):
                table.write("goal_position", goal)
                steps.append(_step(link, table, model, goal, fence))
        except BaseException:
            with suppress(DriverError):  # what went wrong first is told
                table.write("goal_position", table.get("present_position"))
            raise
    return Trial(servo_id, model.name, model.count_rad, start, tuple(steps))


def _make_weak_and_slow(
    table: ServoTable, model: ServoModel, values: Mapping[str, int], torque_percent: float
) -> None:
    """Make where the servo stands its goal, and bound its drive, speed and acceleration."""
    if values["bus_watchdog"]:  # it refuses goals
        table.clear_watchdog(values["present_position"])
    table.set("goal_position", values["present_position"])
    acceleration = max(1, round(TRIAL_ACCELERATION_RAD_PER_S2 / model.acceleration_unit_rad_per_s2))
    table.set("profile_acceleration", acceleration)
    table.set("profile_velocity", max(1, round(TRIAL_SPEED_RAD_PER_S / model.velocity_unit_rad_per_s)))
    table.set("goal_pwm", round(values["pwm_limit"] * torque_percent / 100))


def _check_fit(servo_id: int, model: ServoModel, values: Mapping[str, int], reach: int) -> None:
    """Refuse what a trial would make worse."""
    if values["operating_mode"] != POSITION_MODE:
        mode = OPERATING_MODES.get(values["operating_mode"], "an unknown")
        raise WrongDevice(f"servo {servo_id} is in {mode} mode; the trial needs position mode (3)")
    if values["hardware_error"]:
        words = ", ".join(hardware_error_words(values["hardware_error"]))
        raise HardwareFault(f"servo {servo_id} reports {words}; find the cause, then switch it off and on")
    limits = values["min_position_limit"], values["max_position_limit"]
    check_trial(f"servo {servo_id}", values, limits, reach)


def _found_so(values: Mapping[str, int]) -> list[tuple[str, int]]:
    """The registers that a trial changes as they were found: torque first, then all the rest."""
    wanted = [] if values["torque_enable"] else [("torque_enable", 0)]
    wanted += [("bus_watchdog", 0)]  # one that trips would refuse goal_pwm
    wanted += [(name, values[name]) for name in ("profile_acceleration", "profile_velocity", "goal_pwm")]
    if values["bus_watchdog"] != WATCHDOG_TRIPPED:
        wanted += [("bus_watchdog", values["bus_watchdog"])]
    return wanted


def _step(link: Link, table: ServoTable, model: ServoModel, goal: int, fence: tuple[int, int]) -> TrialStep:
    """Watch one short move to its end."""
    block = RegisterBlock(model.registers, "goal_velocity", "present_temperature")

    def look() -> ServoSample:
        sent_s = link.clock.now_s()
        # what is late shows by its counter; to wait for it would trip the watchdog
        (status,) = again(link, lambda: table.block(block), late_s=0.0).statuses.values()
        if status.alert:
            raise HardwareFault(f"{table.name} reports a hardware error; the trial is ended")
        return ServoSample(block.decode(status.data), False, sent_s, link.clock.now_s())

    return watched_step(table.name, look, link.clock, link.clock.now_s(), goal, fence, model.current_unit_A)
