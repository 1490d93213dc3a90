"""One servo made ready: its model, what is in its way, its settings checked and set, without moving it.

Permanent settings are written only where they differ (they wear) and only while torque is off (the servo
locks them). Everything written is read back, and nothing is decided by an answer that could be another
question's (`Link.proven`).
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping

from drivers.dynamixel.link import Link, Pinged
from drivers.dynamixel.models import (
    HARDWARE_ERRORS,
    MODELS_BY_NUMBER,
    NO_SECONDARY_ID,
    POSITION_MODE,
    WATCHDOG_TRIPPED,
    DynamixelAxisSettings,
    DynamixelSettings,
    hardware_error_names,
)
from drivers.dynamixel.packets import GroupAnswer
from drivers.dynamixel.registers import ControlItem, RegisterBlock
from drivers.errors import BadReply, DriverError, HardwareFault, NoReply, Refused, WrongDevice
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.exchange import ATTEMPTS, LATE_S, again
from drivers.servo_bus.pair import BusServo
from drivers.servo_bus.port import QUIET_S, Part

log = logging.getLogger(__name__)

MOST_REBOOTS, REBOOT_SPAN_S = 3, 600.0

FULL_STATUS_RETURN = 2
REVERSE_BIT, SLAVE_BIT = 0x01, 0x02
HOMING_LIMIT = 1024  # what position mode honours of an X servo's homing offset, counts
REBOOT_S = 2.0  # how long a servo may be deaf after a reboot
PROFILE = ("profile_acceleration", "profile_velocity")


def motion_blocks(settings: DynamixelAxisSettings) -> tuple[RegisterBlock, ...]:
    """Return what is read of a servo all the time, by turns: from its goals to its temperature.

    They differ in length, so that a reply to one of the last questions is none to the next.
    """
    names = ("goal_velocity", "profile_acceleration", "profile_velocity")
    return tuple(RegisterBlock(settings.model.registers, name, "present_temperature") for name in names)


class Reboots:
    """When the servos of a head were rebooted: `MOST_REBOOTS` times in `REBOOT_SPAN_S` at most.

    Counted over all lines of the head, where a servo is rebooted and nowhere else.
    """

    def __init__(self) -> None:
        self._times_s: list[float] = []

    def left(self, now_s: float) -> int:
        """Return how many may be done now."""
        self._times_s = [then_s for then_s in self._times_s if now_s - then_s < REBOOT_SPAN_S]
        return MOST_REBOOTS - len(self._times_s)

    def note(self, now_s: float) -> None:
        """Count one."""
        self._times_s.append(now_s)


def hardware_fault(name: str, error: int) -> str:
    """Return one sentence for a hardware error."""
    errors = " and ".join(hardware_error_names(error & sum(HARDWARE_ERRORS)) or [f"bits 0x{error:02x}"])
    return (
        f"{name} reports {errors} (hardware error 0x{error:02x}); it keeps saying so until it is rebooted or "
        "switched off and on, which drops its torque"
    )


def identified(link: Link, servo_id: int, name: str) -> Pinged:
    """Return what a servo says to a ping, twice in a row and around a silence; it may answer nothing else
    yet.

    Raises BadReply if it says another thing each time; NoReply, LineLost.
    """
    before = again(link, lambda: link.ping(servo_id))
    for _ in range(ATTEMPTS):
        link.quiet(QUIET_S)
        now = again(link, lambda: link.ping(servo_id))
        if now == before:
            return now
        before = now
    raise BadReply(f"{name} says another thing about itself in each answer")


class ServoTable:
    """The control table of one servo: read, set and seen to hold, requested again where a reply was lost."""

    def __init__(self, link: Link, servo_id: int, registers: Mapping[str, ControlItem], name: str) -> None:
        self.name = name
        self.servo_id = servo_id
        self._link = link
        self._registers = registers

    def get(self, register: str) -> int:
        """Return a register's value. Raises as `Link.proven`."""
        return self.get_all(register)[register]

    def get_all(self, *registers: str) -> dict[str, int]:
        """Return several registers' values by name, as `get` does one, at the cost of one."""
        entries = [self._registers[register] for register in registers]
        values = again(self._link, lambda: self._link.proven(self.servo_id, *entries))
        return dict(zip(registers, values, strict=True))

    def write(self, register: str, value: int) -> None:
        """Set a register, again where the reply was lost, which is the same. Raises as `Link.write`."""
        again(self._link, lambda: self._link.write(self.servo_id, self._registers[register], value))

    def set(self, register: str, value: int) -> None:
        """Set a register and see that it holds the value.

        Raises WrongDevice if the servo says that it did but holds another value; Refused, NoReply, BadReply,
        LineLost.
        """
        refused: Refused | None = None
        for _ in range(ATTEMPTS):
            try:
                self.write(register, value)
            except Refused as error:
                if refused is not None:
                    raise
                refused = error  # it may be that of another write
            stored = self.get(register)
            if stored == value:
                return
            self._link.quiet(LATE_S if refused is None else QUIET_S)
        raise WrongDevice(f"{self.name} holds {stored} in {register} after {value} was written to it")

    def block(self, block: RegisterBlock) -> GroupAnswer:
        """Return neighbouring registers, requested one time; raises as `Link.block`."""
        return self._link.block(Part(self.servo_id, block.address, block.length))


class Servo(ServoTable, BusServo):
    """One configured servo on an open line, as `BusServo`."""

    _link: Link
    _registers: Mapping[str, ControlItem]
    _settings: DynamixelAxisSettings
    _head: DynamixelSettings

    def __init__(
        self,
        link: Link,
        axis: str,
        settings: DynamixelAxisSettings,
        head: DynamixelSettings,
        reboots: Reboots,
    ) -> None:
        BusServo.__init__(self, link, axis, settings, head)
        ServoTable.__init__(self, link, settings.servo_id, settings.model.registers, self.name)
        self._reboots = reboots
        self._blocks = itertools.cycle(motion_blocks(settings))

    def check_identity(self) -> None:
        """As `BusServo`; also that its firmware has a bus watchdog where one is configured."""
        model = self._settings.model
        number, firmware = self._model_and_firmware()
        if number != model.number:
            other = MODELS_BY_NUMBER.get(number)
            if other is None:
                message = (
                    f"{self.name} is no {model.name}: the driver does not know the model number {number}"
                )
                raise WrongDevice(message)
            raise WrongDevice(f"{self.name} is a {other.name}, the configuration says {model.name}")
        if self._head.watchdog_s > 0 and firmware < model.watchdog_firmware:
            raise WrongDevice(
                f"{self.name} has firmware {firmware}; the bus watchdog needs "
                f"{model.watchdog_firmware} or newer: update it, or set watchdog_s: 0 and do without"
            )
        level = self._registers["status_return_level"]
        try:
            answering = self._link.proven(self.servo_id, level) == [FULL_STATUS_RETURN]
        except NoReply:
            answering = False
        if not answering:
            self._link.write_unanswered(self.servo_id, level, FULL_STATUS_RETURN)

    def _model_and_firmware(self) -> tuple[int, int]:
        """Its model and firmware, by its registers; only a servo that does not answer that is pinged.

        A ping's reply is as long as one that holds the hardware error: it is not to be under way then.
        """
        try:
            stored = self.get_all("model_number", "firmware")
        except (NoReply, Refused):
            pinged = identified(self._link, self.servo_id, self.name)
            return pinged.model_number, pinged.firmware
        return stored["model_number"], stored["firmware"]

    def stand(self) -> None:
        """Make where the servo is its goal, if it is of the model configured and its torque is on.

        Requested one time and not read back: whatever it is, another axis may wait for the same.
        """
        registers = self._registers
        requested = (registers["model_number"], registers["torque_enable"])
        if self._link.proven(self.servo_id, *requested) != [self._settings.model.number, 1]:
            return
        goal = self._settings.within_limits(self.sample_once().counts)
        self._link.write(self.servo_id, registers["goal_position"], goal)

    def stood(self) -> str:
        """Have the servo stand, unless its watchdog has stopped it; as `BusServo.stood`."""
        if self.get("bus_watchdog") == WATCHDOG_TRIPPED:
            return "was stopped by its watchdog"
        if not self.get("torque_enable"):
            return "has its torque off"
        self.stand()
        return "was commanded to stand where it is, and holds"

    def check_health(self) -> None:
        """As `BusServo`; restarts it if the configuration says so.

        A restart drops the torque, so it is not done again and again while what is wrong goes on.
        """
        error = self.get("hardware_error")
        now_s = self._link.clock.now_s()
        if error and self._settings.on_hardware_error == "reboot" and self._reboots.left(now_s):
            log.warning("%s: %s; rebooting it", self.name, ", ".join(hardware_error_names(error)))
            self._reboots.note(now_s)
            self.reboot()
            error = self.get("hardware_error")
        if error:
            raise HardwareFault(hardware_fault(self.name, error), detail={"hardware_error": error})

    def reboot(self) -> None:
        """Restart the servo and wait until it answers; torque drops. Raises NoReply, LineLost."""
        self._link.reboot(self.servo_id)
        self.truth.forget()
        until_s = self._link.clock.now_s() + REBOOT_S
        while True:
            try:
                self.get("model_number")
                return
            except (NoReply, BadReply):
                if self._link.clock.now_s() > until_s:
                    raise

    def sample_once(self) -> ServoSample:
        """Return what the servo says about its motion now, requested one time."""
        block = next(self._blocks)
        answer = self.block(block)
        status = answer.statuses[self.servo_id]
        sample = ServoSample(block.decode(status.data), status.alert, answer.sent_s, answer.received_s)
        self.truth.check(sample)
        return sample

    def set_up(self) -> None:
        """As `BusServo`; first its profile."""
        self.set_profile()  # refused, if at all, before the torque is touched
        wanted = self._wanted()
        stored = self.get_all(*wanted)
        self._change({name: value for name, value in wanted.items() if stored[name] != value})

    def _set_permanent(self, values: Mapping[str, int]) -> None:
        for name in sorted(values, key=lambda n: n != "operating_mode"):  # a new mode resets others
            self.set(name, values[name])

    def _wanted(self) -> dict[str, int]:
        """The permanent settings, by register."""
        settings, model = self._settings, self._settings.model
        stored = self.get_all("drive_mode", "secondary_id", "homing_offset")
        drive, secondary, homing = stored["drive_mode"], stored["secondary_id"], stored["homing_offset"]
        if drive & SLAVE_BIT:
            raise WrongDevice(
                f"{self.name} is the slave of a pair (drive mode {drive}); a head needs single servos"
            )
        if secondary < NO_SECONDARY_ID:
            raise WrongDevice(
                f"{self.name} also obeys writes to id {secondary} (its secondary id); set that to 255 first"
            )
        if model.low_count == 0 and abs(homing) > HOMING_LIMIT:
            raise WrongDevice(
                f"{self.name} has a homing offset of {homing} counts; position mode honours {HOMING_LIMIT} "
                "at most: set it to 0 and give the place as zero_counts"
            )
        low, high = settings.limit_counts
        wanted = {
            "operating_mode": POSITION_MODE,
            "drive_mode": drive & REVERSE_BIT,  # speeds instead of times; torque never on by a goal
            "return_delay": 0,
            "min_position_limit": low,
            "max_position_limit": high,
        }
        if settings.current_limit_A is not None and model.current_unit_A is not None:
            wanted["current_limit"] = round(settings.current_limit_A / model.current_unit_A)
        return wanted

    def _aim_at_place(self) -> bool:
        """Clear a watchdog that has tripped too: to take hold is the deliberate act of arming anew."""
        stored = self.get_all("torque_enable", "bus_watchdog")
        counts = self.check_place()
        if stored["bus_watchdog"]:  # cleared, it may go on to its old goal: void in the same moment
            self._link.write_at_once([self.part("bus_watchdog", 0), self.part("goal_position", counts)])
            self.set("bus_watchdog", 0)
        self.set("goal_position", counts)
        self._full_strength()
        self.set_profile()
        return bool(stored["torque_enable"])

    def set_profile(self) -> None:
        """Set how fast the servo turns and brakes; raises as `set`, and WrongDevice where it cannot."""
        for name, value in zip(PROFILE, self.profile, strict=True):
            try:
                self.set(name, value)
            except Refused as error:
                raise WrongDevice(
                    f"{self.name} does not take {value} as its {name}: acceleration_rad_per_s2 or "
                    f"speed_rad_per_s is more than its own limits allow ({error})"
                ) from error

    def leg(self, profile: tuple[int, int], goal: int) -> Part:
        """Return a goal with its profile, as `BusServo.leg`."""
        return self.neighbours(dict(zip((*PROFILE, "goal_position"), (*profile, goal), strict=True)))

    def send_leg(self, profile: tuple[int, int], goal: int) -> None:
        """Set a goal, with the profile that leads there in the same packet; raises as `set`."""
        self._link.group_write([self.leg(profile, goal)])
        self.set("goal_position", goal)

    def _full_strength(self) -> None:
        """Lift a bound of the motor's drive that another program has left; raises as `set`."""
        found, limit = self.get_all("goal_pwm", "pwm_limit").values()
        if found != limit:
            log.warning(
                "%s was bound to %.0f %% of its drive by another program; that is lifted",
                self.name,
                100 * found / max(limit, 1),
            )
            self.set("goal_pwm", limit)

    def release(self, limp: bool) -> None:
        """Switch the watchdog off, and the torque if it is to be ``limp``; for the end."""
        for register in ("bus_watchdog", "torque_enable")[: 1 + limp]:
            try:
                self.set(register, 0)
            except DriverError as error:
                log.warning("%s: could not set %s at the end: %s", self.name, register, error)
