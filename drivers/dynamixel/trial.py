"""A servo tried out on the bench: turned a little, slowly, weakly, watched all the time, left as it was."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

from drivers.dynamixel.link import Link
from drivers.dynamixel.models import OPERATING_MODES, Block, Model, hardware_error_words
from drivers.dynamixel.servo_table import ServoTable, again
from drivers.dynamixel.workshop import facts, identify, table_of
from drivers.errors import DriverError, HardwareFault, OutOfRange, WrongDevice

POSITION_MODE = 3
SPEED_RAD_PER_S = 0.2
ACCELERATION_RAD_PER_S2 = 1.0
WATCHDOG = 15  # times 20 ms
WATCHDOG_TRIPPED = 255
POLL_S = 0.02
WARM_MARGIN_C = 10  # below the servo's own limit


@dataclass(frozen=True)
class TrialStep:
    """One short move of a trial: where it should have gone, where it went, and how hard it was."""

    goal_counts: int
    measured_counts: int
    seconds: float
    most_current_A: float | None
    voltage_V: float
    temperature_C: int

    @property
    def left_counts(self) -> int:
        """Measured minus goal."""
        return self.measured_counts - self.goal_counts


@dataclass(frozen=True)
class Trial:
    """A trial's steps, and the servo's model."""

    servo_id: int
    model: str
    count_rad: float
    start_counts: int
    steps: tuple[TrialStep, ...] = field(default=())


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
    with _restored(table, values):
        _make_weak_and_slow(table, model, values, torque_percent)
        table.set("torque_enable", 1)
        if firmware >= model.watchdog_firmware:
            table.set("bus_watchdog", WATCHDOG)
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
    table: ServoTable, model: Model, values: Mapping[str, int], torque_percent: float
) -> None:
    """Make where the servo stands its goal, and bound its drive, speed and acceleration."""
    if values["bus_watchdog"]:  # it refuses goals
        table.clear_watchdog(values["present_position"])
    table.set("goal_position", values["present_position"])
    acceleration = max(1, round(ACCELERATION_RAD_PER_S2 / model.acceleration_unit_rad_per_s2))
    table.set("profile_acceleration", acceleration)
    table.set("profile_velocity", max(1, round(SPEED_RAD_PER_S / model.velocity_unit_rad_per_s)))
    table.set("goal_pwm", round(values["pwm_limit"] * torque_percent / 100))


def _check_fit(servo_id: int, model: Model, values: Mapping[str, int], reach: int) -> None:
    """Refuse what a trial would make worse."""
    if values["operating_mode"] != POSITION_MODE:
        mode = OPERATING_MODES.get(values["operating_mode"], "an unknown")
        raise WrongDevice(f"servo {servo_id} is in {mode} mode; the trial needs position mode (3)")
    if values["hardware_error"]:
        words = ", ".join(hardware_error_words(values["hardware_error"]))
        raise HardwareFault(f"servo {servo_id} reports {words}; find the cause, then switch it off and on")
    if values["present_temperature"] > values["temperature_limit"] - WARM_MARGIN_C:
        raise HardwareFault(
            f"servo {servo_id} is at {values['present_temperature']} C, near its limit of "
            f"{values['temperature_limit']} C; let it cool"
        )
    voltage, low, high = (
        values[f"{name}"] for name in ("present_voltage", "min_voltage_limit", "max_voltage_limit")
    )
    if not low <= voltage <= high:
        raise HardwareFault(
            f"servo {servo_id} gets {voltage / 10:.1f} V, expected {low / 10:.1f} to {high / 10:.1f} V"
        )
    start = values["present_position"]
    least, most = values["min_position_limit"], values["max_position_limit"]
    if not least + reach <= start <= most - reach:
        raise OutOfRange(
            f"servo {servo_id} stands at {start} counts; a move of {reach} counts to each side leaves its "
            f"position limits {least} to {most}"
        )


@contextmanager
def _restored(table: ServoTable, values: Mapping[str, int]) -> Iterator[None]:
    """Leave the servo as it was found: torque first, then all the rest, whatever of it fails."""
    wrong: BaseException | None = None
    try:
        yield
    except BaseException as error:  # goes on to the caller when the servo is as it was
        wrong = error
    wanted = [] if values["torque_enable"] else [("torque_enable", 0)]
    wanted += [("bus_watchdog", 0)]  # one that trips would refuse goal_pwm
    wanted += [(name, values[name]) for name in ("profile_acceleration", "profile_velocity", "goal_pwm")]
    if values["bus_watchdog"] != WATCHDOG_TRIPPED:
        wanted += [("bus_watchdog", values["bus_watchdog"])]
    left: dict[str, DriverError] = {}
    while wanted:
        name, value = wanted[0]
        try:
            table.set(name, value)
        except DriverError as error:
            left[name] = error
        except KeyboardInterrupt as error:  # Ctrl-C again: it is tried once more, and the rest too
            wrong = wrong or error
            continue
        del wanted[0]
    if left:
        names = " and ".join(left)
        limp = "its torque may be on; " if "torque_enable" in left else ""
        words = f"{table.name} is not left as it was found in {names}: {limp}{next(iter(left.values()))}"
        raise WrongDevice(
            words if wrong is None else f"{str(wrong) or 'interrupted'}; and {words}"
        ) from wrong
    if wrong is not None:
        raise wrong


def _step(link: Link, table: ServoTable, model: Model, goal: int, fence: tuple[int, int]) -> TrialStep:
    """Watch one short move to its end."""
    block = Block(model.registers, "goal_velocity", "present_temperature")
    began_s = link.clock.now_s()
    most = 0
    still = 0
    while True:
        # what is late shows by its counter; to wait for it would trip the watchdog
        (status,) = again(link, lambda: table.block(block), late_s=0.0).statuses.values()
        if status.alert:
            raise HardwareFault(f"{table.name} reports a hardware error; the trial is ended")
        values = block.decode(status.data)
        most = max(most, abs(values["present_current"]))
        if not fence[0] <= values["present_position"] <= fence[1]:
            raise OutOfRange(
                f"{table.name} left the fence of the trial at {values['present_position']} counts "
                f"(allowed {fence[0]} to {fence[1]}); it is stopped"
            )
        still = still + 1 if abs(values["present_velocity"]) <= 1 and not values["moving_status"] & 2 else 0
        elapsed_s = link.clock.now_s() - began_s
        if (still >= 5 and elapsed_s > 0.2) or elapsed_s > 10.0:
            break
        link.clock.sleep(POLL_S)
    left = abs(values["present_position"] - goal)
    if left > max(abs(fence[1] - fence[0]) / 16, 4):
        raise HardwareFault(
            f"{table.name} stands {left} counts from its goal: blocked, or too weak with this bound "
            "of its drive; it is stopped"
        )
    current = None if model.current_unit_A is None else most * model.current_unit_A
    voltage, temperature = values["present_voltage"] / 10, values["present_temperature"]
    return TrialStep(goal, values["present_position"], elapsed_s, current, voltage, temperature)
