"""One servo made ready: who it is, what is in its way, its settings checked and set, without moving it.

Permanent settings are written only where they differ (they wear) and only while torque is off (the servo
locks them). Everything written is read back, and nothing is decided by an answer that could be another
question's (`Link.proven`).
"""

from __future__ import annotations

import itertools
import logging

from drivers.dynamixel.link import Link
from drivers.dynamixel.models import (
    HARDWARE_ERRORS,
    MODELS_BY_NUMBER,
    NO_SECONDARY_ID,
    POSITION_MODE,
    hardware_error_words,
    what_is_needed,
)
from drivers.dynamixel.packets import Part
from drivers.dynamixel.registers import RegisterBlock
from drivers.dynamixel.servo_table import ServoTable, identified
from drivers.dynamixel.settings import DynamixelAxisSettings, DynamixelSettings
from drivers.errors import BadReply, DriverError, HardwareFault, NoReply, Refused, WrongDevice
from drivers.servo_bus.course import ServoSample, Truth
from drivers.servo_bus.exchange import again
from drivers.servo_bus.rest import come_to_rest

log = logging.getLogger(__name__)

MOST_REBOOTS, REBOOT_SPAN_S = 3, 600.0

FULL_STATUS_RETURN = 2
REVERSE_BIT, SLAVE_BIT = 0x01, 0x02
HOMING_LIMIT = 1024  # what position mode honours of an X servo's homing offset, counts
REBOOT_S = 2.0  # how long a servo may be deaf after a reboot


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


def hardware_fault_words(name: str, error: int) -> str:
    """Return one sentence for a hardware error."""
    words = " and ".join(hardware_error_words(error & sum(HARDWARE_ERRORS)) or [f"bits 0x{error:02x}"])
    return (
        f"{name} reports {words} (hardware error 0x{error:02x}); it keeps saying so until it is rebooted or "
        "switched off and on, which drops its torque"
    )


class Servo(ServoTable):
    """One configured servo on an open line.

    Parameters
    ----------
    axis
        ``pan`` or ``tilt``, for messages.
    """

    def __init__(
        self, link: Link, axis: str, settings: DynamixelAxisSettings, head: DynamixelSettings
    ) -> None:
        name = f"{axis} (servo {settings.servo_id})"
        super().__init__(link, settings.servo_id, settings.model.registers, name)
        self._settings = settings
        self._head = head
        self.truth = Truth(name, settings)
        self.dropped = False  # its torque, by us, and not yet taken hold again
        self._blocks = itertools.cycle(motion_blocks(settings))

    def check_identity(self) -> None:
        """See that the servo is the one configured, and that it answers every instruction.

        Raises WrongDevice for another model, or a firmware without a bus watchdog where one is configured;
        NoReply, LineLost.
        """
        model = self._settings.model
        number, firmware = self._model_and_firmware()
        if number != model.number:
            other = MODELS_BY_NUMBER.get(number)
            if other is None:
                raise WrongDevice(
                    f"{self.name} is no {model.name}: the driver does not know {what_is_needed(number)}"
                )
            raise WrongDevice(f"{self.name} is a {other.name}, the configuration says {model.name}")
        if self._head.watchdog_s > 0 and firmware < model.watchdog_firmware:
            raise WrongDevice(
                f"{self.name} has firmware {firmware}; the bus watchdog needs "
                f"{model.watchdog_firmware} or newer: update it, or set watchdog_s: 0 and do without"
            )
        level = self._registers["status_return_level"]
        try:
            answering = self._link.proven(self._servo_id, level) == [FULL_STATUS_RETURN]
        except NoReply:
            answering = False
        if not answering:
            self._link.write_unanswered(self._servo_id, level, FULL_STATUS_RETURN)

    def _model_and_firmware(self) -> tuple[int, int]:
        """Who it is, by its registers; only who does not answer that is asked by a ping.

        A ping's reply is as long as one that holds the hardware error: it is not to be under way then.
        """
        try:
            stored = self.get_all("model_number", "firmware")
        except (NoReply, Refused):
            pinged = identified(self._link, self._servo_id, self.name)
            return pinged.model_number, pinged.firmware
        return stored["model_number"], stored["firmware"]

    def stand(self) -> None:
        """Make where the servo is its goal, if it is of the model configured and its torque is on.

        Asked one time and not read back: whatever it is, another axis may wait for the same. Raises NoReply,
        BadReply, Refused, LineLost.
        """
        registers = self._registers
        requested = (registers["model_number"], registers["torque_enable"])
        if self._link.proven(self._servo_id, *requested) != [self._settings.model.number, 1]:
            return
        low, high = self._settings.limit_counts
        goal = min(max(self.look_once().counts, low), high)
        self._link.write(self._servo_id, registers["goal_position"], goal)

    def check_health(self, reboots: Reboots) -> None:
        """See that the servo reports no hardware error; restart it if the configuration says so.

        A restart drops the torque, so it is not done again and again while what is wrong goes on. Raises
        HardwareFault.
        """
        error = self.get("hardware_error")
        now_s = self._link.clock.now_s()
        if error and self._settings.on_hardware_error == "reboot" and reboots.left(now_s):
            log.warning("%s: %s; rebooting it", self.name, ", ".join(hardware_error_words(error)))
            reboots.note(now_s)
            self.reboot()
            error = self.get("hardware_error")
        if error:
            raise HardwareFault(hardware_fault_words(self.name, error), detail={"hardware_error": error})

    def reboot(self) -> None:
        """Restart the servo and wait until it answers; torque drops. Raises NoReply, LineLost."""
        self._link.reboot(self._servo_id)
        self.truth.forget()
        until_s = self._link.clock.now_s() + REBOOT_S
        while True:
            try:
                self.get("model_number")
                return
            except (NoReply, BadReply):
                if self._link.clock.now_s() > until_s:
                    raise

    def look(self) -> ServoSample:
        """Return what the servo says about its motion now; what was lost is asked for again.

        Raises NoReply, BadReply, Refused, LineLost.
        """
        return again(self._link, self.look_once)

    def look_once(self) -> ServoSample:
        """Return what the servo says about its motion now, asked one time; raises as `look`."""
        block = next(self._blocks)
        answer = self.block(block)
        status = answer.statuses[self._servo_id]
        sample = ServoSample(block.decode(status.data), status.alert, answer.sent_s, answer.received_s)
        self.truth.check(sample)
        return sample

    def check_place(self) -> int:
        """Return the count that may be the axis' goal where it stands, as
        `ServoAxisSettings.goal_at_place`."""
        return self._settings.goal_at_place(self.name, self.look().counts)

    def set_up(self) -> None:
        """Bring the servo's permanent settings to what the configuration says.

        The torque may be off then: `take_hold` follows, or the pair has it hold again. Raises WrongDevice if
        a setting cannot be used, or must change while torque may not be dropped; Refused if the servo refuses
        a value.
        """
        wanted = self._wanted()
        stored = self.get_all(*wanted)
        different = {name: value for name, value in wanted.items() if stored[name] != value}
        if not different:
            return
        changes = ", ".join(f"{name} {value}" for name, value in different.items())
        torque = self.get("torque_enable")
        if torque:
            if not self._head.torque_off_at_start:
                raise WrongDevice(
                    f"{self.name} must be set to {changes}, which it takes only with torque off, but torque "
                    "is on and the axis may fall. Support it and set torque_off_at_start: true, or switch "
                    "the servo off and on"
                )
            self.dropped = True
            self.set("torque_enable", 0)
        log.info("%s: setting %s", self.name, changes)
        for name in sorted(different, key=lambda n: n != "operating_mode"):  # a new mode resets others
            self.set(name, different[name])

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

    def take_hold(self) -> int:
        """Switch torque on where the axis stands, with the profile set; returns the goal, counts.

        An old goal is void: the present position is the goal before anything can move. A watchdog that has
        tripped is cleared here, which makes this the deliberate act of arming anew.
        """
        stored = self.get_all("torque_enable", "bus_watchdog")
        torque, tripped = bool(stored["torque_enable"]), stored["bus_watchdog"] != 0
        counts = self.check_place()
        if tripped:
            self.clear_watchdog(counts)
        self.set("goal_position", counts)
        self._full_strength()
        self.set_profile()
        if not torque:
            counts = self.check_place()
            self.set("goal_position", counts)
            try:
                self.set("torque_enable", 1)
            except WrongDevice:
                raise HardwareFault(
                    f"{self.name} does not switch its torque on; it may be shut down by a hardware error"
                ) from None
        self.dropped = False
        return come_to_rest(self.look, self.set, self._settings.limit_counts, self._link.clock)

    @property
    def profile(self) -> tuple[int, int]:
        """Profile acceleration and velocity, as `set_profile` sets them."""
        settings, head = self._settings, self._head
        acceleration = settings.acceleration_counts(head.acceleration_rad_per_s2)
        return acceleration, settings.velocity_counts(head.speed_rad_per_s)

    def set_profile(self) -> None:
        """Set how fast the servo turns and brakes; raises as `set`, and WrongDevice where it cannot."""
        for name, value in zip(("profile_acceleration", "profile_velocity"), self.profile, strict=True):
            try:
                self.set(name, value)
            except Refused as error:
                raise WrongDevice(
                    f"{self.name} does not take {value} as its {name}: acceleration_rad_per_s2 or "
                    f"speed_rad_per_s is more than its own limits allow ({error})"
                ) from error

    def send_leg(self, profile: tuple[int, int], goal: int) -> None:
        """Set a goal, with the profile that leads there in the same packet; raises as `set`."""
        parts = [
            self.part(name, value)
            for name, value in zip(
                ("profile_acceleration", "profile_velocity", "goal_position"), (*profile, goal), strict=True
            )
        ]
        data = b"".join(part.data for part in parts)
        self._link.group_write([Part(parts[0].servo_id, parts[0].address, len(data), data)])
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
        for register in (
            "bus_watchdog",
            *(("torque_enable",) if limp else ()),
        ):
            try:
                self.set(register, 0)
            except DriverError as error:
                log.warning("%s: could not set %s at the end: %s", self.name, register, error)
