"""One servo made ready: who it is, what is in its way, its settings checked and set, without moving it.

Permanent settings are written only where they differ (they wear), with the torque off and the EEPROM unlocked
for them alone. Everything written is read back. The offset in the EEPROM is told and never written.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from drivers.errors import DriverError, HardwareFault, WrongDevice
from drivers.feetech.link import FeetechLink
from drivers.feetech.models import LOCKED, MODELS_BY_NUMBER, POSITION_MODE, UNLOCKED, status_words
from drivers.feetech.settings import FeetechAxisSettings, FeetechSettings
from drivers.servo_bus.course import ServoSample, Truth
from drivers.servo_bus.exchange import ATTEMPTS, again
from drivers.servo_bus.rest import come_to_rest

log = logging.getLogger(__name__)

LEAST_TORQUE = 20  # room below a torque limit for the tokens of the questions


class FeetechServo:
    """One configured servo on an open line.

    Parameters
    ----------
    link
        The open line.
    axis
        ``pan`` or ``tilt``, for messages.
    settings, head
        What the configuration says.
    offsets
        The offset in each servo's EEPROM as it was found first, by id; outlasts a line of the head.

    Attributes
    ----------
    truth
        What its samples are compared with.
    torque_limit
        As much as its motor may be driven, 0.1 %.
    """

    def __init__(
        self,
        link: FeetechLink,
        axis: str,
        settings: FeetechAxisSettings,
        head: FeetechSettings,
        offsets: dict[int, int],
    ) -> None:
        self.name = f"{axis} (servo {settings.servo_id})"
        self.servo_id = settings.servo_id
        self.torque_limit = 0
        self._link = link
        self._settings = settings
        self._head = head
        self._offsets = offsets
        self._registers = settings.model.registers
        self.truth = Truth(self.name, settings)
        self.dropped = False

    def get(self, register: str) -> int:
        """Return a register's value; a lost reply is asked for again. Raises as `FeetechLink.proven`."""
        entry, model = self._registers[register], self._settings.model
        return again(self._link, lambda: self._link.proven(self.servo_id, entry, model))

    def set(self, register: str, value: int) -> None:
        """Set a register and see that it holds the value.

        Raises
        ------
        NoReply, BadReply, LineLost
            As `FeetechLink.write` and `FeetechLink.proven`.
        WrongDevice
            If the servo says that it did but holds another value.
        """
        entry, model = self._registers[register], self._settings.model
        for _ in range(ATTEMPTS):
            again(self._link, lambda: self._link.write(self.servo_id, entry, value, model))
            held = self.get(register)
            if held == value:
                return
        raise WrongDevice(f"{self.name} holds {held} in {register} after {value} was written to it")

    def check_identity(self) -> None:
        """See that the servo is the one configured, and that it answers every instruction.

        Raises
        ------
        WrongDevice
            For another model, and an offset that was changed since the head was opened.
        NoReply, LineLost
            If it does not answer.
        """
        model = self._settings.model
        number = self.get("model_number")
        if model.number is not None and number != model.number:
            swapped = number >> 8 | (number & 0xFF) << 8
            other = MODELS_BY_NUMBER.get(number) or MODELS_BY_NUMBER.get(swapped)
            found = f"a {other.name}" if other else f"of the model number {number}, which is not in the table"
            raise WrongDevice(
                f"{self.name} is {found}, the configuration says {model.name}; a servo that is not in the "
                "table is named by its series: STS, SMS or SCS"
            )
        if self.get("response_level") != 1:
            self._unlocked({"response_level": 1}, answered=False)
        if "offset" not in self._registers:
            return
        offset = self.get("offset")
        known = self._offsets.setdefault(self.servo_id, offset)
        if offset != known:
            raise WrongDevice(f"{self.name} had the offset {known} in its EEPROM and has {offset} now")
        if offset:
            log.warning("%s has an offset of %d counts in its EEPROM; it is left as it is", self.name, offset)

    def check_health(self) -> None:
        """See that the servo reports no fault. Raises HardwareFault."""
        if error := again(self._link, lambda: self._link.ping(self.servo_id)):
            raise HardwareFault(fault_words(self.name, error), detail={"status": error})

    def sample(self) -> ServoSample:
        """Return what the servo says about its motion, asked one time; raises as `FeetechLink.samples`."""
        if not self.torque_limit:  # each question writes it: it must never rise above the servo's own
            self._bound_torque()
        asked = {self.servo_id: (self._settings.model, self.torque_limit)}
        sample = self._link.samples(asked)[self.servo_id]
        self.truth.check(sample)
        return sample

    def look(self) -> ServoSample:
        """Return the same; what was lost is asked for again."""
        return again(self._link, self.sample)

    def stand(self) -> int | None:
        """Make where the servo is its goal, if its torque is on; returns the goal. Raises as `sample`."""
        sample = self.sample()
        if not sample.values["torque_enable"]:
            return None
        low, high = self._settings.limit_counts
        goal = min(max(sample.counts, low), high)
        self.send({self.servo_id: goal})
        return goal

    def send(self, goal: Mapping[int, int]) -> None:
        """Write the goal alone, and nobody answers. Raises LineLost, BadReply."""
        entry, order = self._registers["goal_position"], self._settings.model.order
        self._link.group_write(entry.address, {one: entry.encode(g, order) for one, g in goal.items()})

    def _bound_torque(self) -> int:
        """Take the torque limit from the servo's EEPROM and the options; returns that bound, 0.1 %."""
        if "torque_limit" not in self._registers:  # SCS: its questions write nothing
            self.torque_limit = 1000
            return self.torque_limit
        most = self.get("max_torque")
        bound = min(self._settings.torque_limit or most, most)
        self.torque_limit = max(bound, LEAST_TORQUE)
        return bound

    def check_place(self) -> int:
        """Return the count that may be the axis' goal where it stands, as `ServoAxisSettings.held_counts`."""
        return self._settings.held_counts(self.name, self.look().counts)

    def set_up(self) -> None:
        """Bring the servo's permanent settings to what the configuration says; the torque may be off then.

        Raises
        ------
        WrongDevice
            If a setting must change while torque may not be dropped, or the torque limit has no room.
        """
        if "torque_limit" in self._registers and (bound := self._bound_torque()) < LEAST_TORQUE:
            raise WrongDevice(
                f"{self.name} has the torque limit {bound / 10:g} % in its EEPROM; expected "
                f"{LEAST_TORQUE / 10:g} % or more (max_torque)"
            )
        low, high = self._settings.limit_counts
        wanted = {"return_delay": 0, "min_angle_limit": low, "max_angle_limit": high}
        if "operating_mode" in self._registers:
            wanted["operating_mode"] = POSITION_MODE
        different = {name: value for name, value in wanted.items() if self.get(name) != value}
        if not different:
            return
        told = ", ".join(f"{name} {value}" for name, value in different.items())
        if self.get("torque_enable"):
            if not self._head.torque_off_at_start:
                raise WrongDevice(
                    f"{self.name} must be set to {told} with its torque off, and its torque is on: support "
                    "the axis and set torque_off_at_start: true, or switch the servo off and on"
                )
            self.dropped = True
            self.set("torque_enable", 0)
        log.info("%s: setting %s", self.name, told)
        self._unlocked(different)

    def _unlocked(self, values: Mapping[str, int], answered: bool = True) -> None:
        """Set permanent registers with the EEPROM unlocked for them alone."""
        lock, model = self._registers["lock"], self._settings.model
        if not answered:
            self._link.write_unanswered(self.servo_id, lock, UNLOCKED, model)
        else:
            self.set("lock", UNLOCKED)
        try:
            for name, value in values.items():
                if answered:
                    self.set(name, value)
                else:
                    self._link.write_unanswered(self.servo_id, self._registers[name], value, model)
        finally:
            with self._link.undisturbed():  # a stop or a closing that broke it off leaves none unlocked
                self.set("lock", LOCKED)

    @property
    def profile(self) -> tuple[int, int]:
        """Acceleration and speed of the configuration, in the servo's counts; an SCS has no acceleration."""
        settings, head = self._settings, self._head
        acceleration = min(254, settings.acceleration_counts(head.acceleration_rad_per_s2))
        speed = settings.velocity_counts(head.speed_rad_per_s)
        return (1 if settings.model.is_scs else acceleration), speed

    def goal_bytes(self, profile: tuple[int, int], goal: int) -> tuple[int, bytes]:
        """Return where a goal with its profile is written, and the bytes; a goal time of 0 means by speed."""
        model, registers = self._settings.model, self._registers
        names = ("goal_position", "goal_time", "goal_speed")
        values = (goal, 0, profile[1])
        data = b"".join(registers[n].encode(v, model.order) for n, v in zip(names, values, strict=True))
        if model.is_scs:
            return registers["goal_position"].address, data
        return registers["acceleration"].address, bytes((profile[0],)) + data

    def send_leg(self, profile: tuple[int, int], goal: int) -> None:
        """Set a goal with its profile; the next sample shows it. Raises LineLost, BadReply."""
        address, data = self.goal_bytes(profile, goal)
        self._link.group_write(address, {self.servo_id: data})

    def take_hold(self) -> int:
        """Switch torque on where the axis stands, with the profile set; returns the goal, counts.

        An old goal is void: the present position is the goal before anything can move.
        """
        counts = self.check_place()
        if "acceleration" in self._registers:
            self.set("acceleration", self.profile[0])
        self.set("goal_time", 0)
        self.set("goal_speed", self.profile[1])
        self.set("goal_position", counts)
        if not self.get("torque_enable"):
            counts = self.check_place()
            self.set("goal_position", counts)
            try:
                self.set("torque_enable", 1)
            except WrongDevice:
                raise HardwareFault(f"{self.name} does not switch its torque on") from None
        self.dropped = False
        return come_to_rest(self.look, self.set, self._settings.limit_counts, self._link.clock)

    def release(self, limp: bool) -> None:
        """Switch the torque off if it is to be ``limp``, and lift the questions' tokens; for the end."""
        try:
            if limp:
                self.set("torque_enable", 0)
            if "torque_limit" in self._registers:
                self.set("torque_limit", self.torque_limit)
        except DriverError as error:
            log.warning("%s is not left as it should be at the end: %s", self.name, error)


def fault_words(name: str, error: int) -> str:
    """Return one sentence for a status."""
    return f"{name} reports {status_words(error)} (status 0x{error:02x}); it says so as long as it lasts"
