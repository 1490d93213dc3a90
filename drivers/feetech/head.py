"""A pan/tilt head of two Feetech servos (`drivers.interfaces.PanTilt`).

One thread owns the bus (`drivers.servo_bus.head`). A servo has no watchdog: its goals are sent in parts. Of a
way only as much is sent as its axis goes in ``lease_s``, and every poll sends more of it, so that both axes
stand soon after this process has died. Nothing here moves the head but `move`.

Permanent settings are written only where they differ (they wear), with the torque off and the EEPROM unlocked
for them alone. Everything written is read back. The offset in the EEPROM is reported and never written.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, WithJsonSchema, model_validator

from calib.files.records import ABSENT, problem
from drivers.clock import Clock
from drivers.errors import BadReply, DriverError, HardwareFault, NoReply, WrongDevice
from drivers.feetech.servos import (
    BAUD_RATES,
    LOCKED,
    MODELS,
    MODELS_BY_NUMBER,
    POLL_BYTES,
    POSITION_MODE,
    UNLOCKED,
    FeetechLink,
    FeetechModel,
    Questions,
    facts,
    model_named,
    open_link,
    scan,
    set_id,
    status_words,
)
from drivers.options import one_of, read_options
from drivers.registry import Driver
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.bench import ServoBench
from drivers.servo_bus.course import ServoSample, Truth
from drivers.servo_bus.exchange import ATTEMPTS, again
from drivers.servo_bus.head import BusHead
from drivers.servo_bus.pair import BRAKE_COPIES, ServoAxis, ServoPair, SessionWatch
from drivers.servo_bus.rest import come_to_rest, halt_axes
from drivers.servo_bus.session import GivenUp
from drivers.servo_bus.settings import (
    HeadSettings,
    ServoAxisSettings,
    named_model,
)

log = logging.getLogger(__name__)

USUAL_LEASE_S, SHORTEST_LEASE_S = 0.2, 0.05


class FeetechAxisSettings(ServoAxisSettings):
    """One axis."""

    model: Annotated[FeetechModel, named_model(model_named, MODELS)]
    """Which servo; one that is not in the table by its series: STS, SMS or SCS."""
    torque_percent: Annotated[float, Field(ge=2.0, le=100.0)] | None = None
    """Bound of the motor's drive; left out: as much as the servo's EEPROM allows."""
    speed_unit_counts: Literal[1, 50] = 1
    """Counts per second of one unit of its speed; 50 in some firmware."""

    @model_validator(mode="after")
    def _check_series(self) -> Self:
        if self.torque_percent is not None and self.model.is_scs:
            raise problem("torque_percent", f"a {self.model.name} has no torque limit")
        object.__setattr__(self, "model", self.model.with_speed_unit(self.speed_unit_counts))
        return self

    @property
    def torque_limit(self) -> int | None:
        """The bound in the servo's counts, 0.1 %."""
        return None if self.torque_percent is None else round(10 * self.torque_percent)


class FeetechSettings(HeadSettings):
    """A head of two servos on one bus."""

    poll_bytes: ClassVar[int] = POLL_BYTES

    pan: FeetechAxisSettings
    """The pan axis."""
    tilt: FeetechAxisSettings
    """The tilt axis."""
    baud: Annotated[int, one_of(BAUD_RATES), WithJsonSchema({"enum": [*BAUD_RATES]})] = 1_000_000
    """The line's bits per second."""
    acceleration_rad_per_s2: Annotated[float, Field(ge=0.4, le=39.0)] = 4.0
    """Of the profile inside the servos."""
    poll_hz: Annotated[float, Field(ge=10.0, le=250.0)] = 50.0
    """How often the servos are read while they move, if no client reads."""
    lease_s: Annotated[float, Field(ge=0.0, le=0.5)] = ABSENT
    """A goal is sent only so far ahead of its axis: that is what an axis goes on for, and brakes, when this
    process is gone. 0: goals are sent as they are, and nothing stops a head whose host is gone."""

    @model_validator(mode="after")
    def _check_lease(self) -> Self:
        if self.pan.model.order != self.tilt.model.order:
            raise problem("pan.model", "it is of another series than tilt.model; one on a bus is expected")
        self._set_patience("lease_s", USUAL_LEASE_S, SHORTEST_LEASE_S)
        return self

    @property
    def silence_s(self) -> float:
        """How long nothing may be sent so that both axes have come to the end of what was sent to them."""
        return self.lease_s + 2 * self.speed_rad_per_s / self.acceleration_rad_per_s2 if self.lease_s else 0.0


feetech_settings = partial(read_options, FeetechSettings)
"""Return the head that the options of ``driver: feetech`` describe. Raises BadOptions."""

LEAST_TORQUE = 20  # room below a torque limit for the tokens of the questions


class FeetechServo:
    """One configured servo on an open line.

    Parameters
    ----------
    axis
        ``pan`` or ``tilt``, for messages.
    offsets
        The offset in each servo's EEPROM as it was found first, by id; outlasts a line of the head.

    Attributes
    ----------
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

        Raises WrongDevice if the servo says that it did but holds another value; NoReply, BadReply, LineLost.
        """
        entry, model = self._registers[register], self._settings.model
        for _ in range(ATTEMPTS):
            again(self._link, lambda: self._link.write(self.servo_id, entry, value, model))
            stored = self.get(register)
            if stored == value:
                return
        raise WrongDevice(f"{self.name} holds {stored} in {register} after {value} was written to it")

    def check_identity(self) -> None:
        """See that the servo is the one configured, and that it answers every instruction.

        Raises WrongDevice for another model, and an offset that was changed since the head was opened;
        NoReply, LineLost.
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
        requested = {self.servo_id: (self._settings.model, self.torque_limit)}
        sample = self._link.samples(requested)[self.servo_id]
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
        """Return the count that may be the axis' goal where it stands, as
        `ServoAxisSettings.goal_at_place`."""
        return self._settings.goal_at_place(self.name, self.look().counts)

    def set_up(self) -> None:
        """Bring the servo's permanent settings to what the configuration says; the torque may be off then.

        Raises WrongDevice if a setting must change while torque may not be dropped, or the torque limit has
        no room.
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
        changes = ", ".join(f"{name} {value}" for name, value in different.items())
        if self.get("torque_enable"):
            if not self._head.torque_off_at_start:
                raise WrongDevice(
                    f"{self.name} must be set to {changes} with its torque off, and its torque is on: "
                    "support the axis and set torque_off_at_start: true, or switch the servo off and on"
                )
            self.dropped = True
            self.set("torque_enable", 0)
        log.info("%s: setting %s", self.name, changes)
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


class FeetechAxis(ServoAxis[FeetechServo, FeetechAxisSettings]):
    """One axis, whose way is sent in parts."""

    def __init__(
        self, servo: FeetechServo, clock: Clock, settings: FeetechAxisSettings, head: FeetechSettings
    ) -> None:
        super().__init__(servo, clock, settings, head)
        self._lease_s = head.lease_s

    def stretch(self) -> int:
        """Return how far the axis may be sent now."""
        motion = self.motion
        return motion.stretch(self._lease_s, self.acceleration_rad_per_s2) if self._lease_s else motion.goal

    def go_on(self) -> None:
        """Send the next leg of a move if the present one has ended, or more of the way. Raises LineLost."""
        motion = self.motion
        if motion.next_leg() is not None:
            motion.begin_leg()
            goal: int | None = self.stretch()
        else:
            goal = motion.more_of_the_way(self.stretch())
        if goal is not None:
            self.servo.send_leg(motion.profile or self.servo.profile, goal)
            motion.note_sent(goal)


class FeetechPair(ServoPair[FeetechLink, FeetechAxis]):
    """Pan and tilt on one open line, as `ServoPair`."""

    def __init__(self, link: FeetechLink, head: FeetechSettings, offsets: dict[int, int]) -> None:
        axes = (("pan", head.pan), ("tilt", head.tilt))
        super().__init__(
            link,
            [
                FeetechAxis(FeetechServo(link, name, axis, head, offsets), link.clock, axis, head)
                for name, axis in axes
            ],
        )

    def samples(self) -> list[ServoSample]:
        """Return what both servos say about their motion now; raises as `FeetechLink.samples`."""
        requested = {
            axis.servo.servo_id: (axis.settings.model, axis.servo.torque_limit) for axis in self.axes
        }
        found = self.link.samples(requested)
        for axis in self.axes:
            axis.servo.truth.check(found[axis.servo.servo_id])
        return [found[axis.servo.servo_id] for axis in self.axes]

    def sample(self, axis: FeetechAxis) -> ServoSample:
        """Return what one servo says about its motion now, asking it alone; raises as `samples`."""
        return axis.servo.sample()

    def send_goals(self, goals: Sequence[int], speeds: Sequence[int]) -> Sequence[int]:
        """Write profile and goal of both axes with one packet, as far as the lease allows; returns that.

        Raises LineLost, BadReply.
        """
        data, address, sent = {}, 0, []
        for axis, speed in zip(self.axes, speeds, strict=True):
            axis.motion.profile = axis.servo.profile[0], speed
            sent.append(axis.stretch())
            address, data[axis.servo.servo_id] = axis.servo.goal_bytes(axis.motion.profile, sent[-1])
            axis.motion.note_sent(sent[-1])
        self.link.group_write(address, data)
        return sent

    def brake(self) -> None:
        """Tell each axis that holds to brake, whatever the line or the other axis does. Raises LineLost."""
        data, address = {}, 0
        for axis in self.axes:
            goal = axis.halt()
            if goal is not None:
                entry = axis.settings.model.registers["goal_position"]
                address, data[axis.servo.servo_id] = (
                    entry.address,
                    entry.encode(goal, axis.settings.model.order),
                )
        if data:
            self.link.write_at_once(address, data, BRAKE_COPIES)

    def stood(self, axis: FeetechAxis) -> str:
        """Command one axis to stand, as `ServoPair.stood`. Raises DriverError."""
        servo = axis.servo
        goal = servo.stand()
        if goal is None:
            return "has its torque off"
        if (stored := servo.get("goal_position")) != goal:  # nobody answers the packet that says so
            raise NoReply(f"{servo.name} did not take the command to stand, its goal is {stored}")
        return "was commanded to stand where it is, and holds"


def open_pair(
    head: FeetechSettings,
    questions: Questions | None = None,
    offsets: dict[int, int] | None = None,
    urgent: Callable[[], bool] = lambda: False,
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> FeetechPair:
    """Open the line to both servos; nothing is set.

    ``questions`` and ``offsets`` are of the head, over all its lines; ``urgent``, ``clock`` and ``open_line``
    of `Port`. Raises LineLost, BadReply.
    """
    link = open_link(
        head.port, head.baud, head.reply_timeout_s, urgent,
        questions=questions, clock=clock, open_line=open_line,
    )  # fmt: skip
    return FeetechPair(link, head, {} if offsets is None else offsets)


def make_ready(pair: FeetechPair, head: FeetechSettings) -> None:
    """Make both servos ready, without moving them: checked, set up, holding.

    Without a lease each is commanded to stand first, whatever the other does: it may still be under way.
    Raises Overtaken if a stop came meanwhile; LineLost, NoReply, BadReply, WrongDevice, HardwareFault if the
    servos cannot be reached or do not fit.
    """
    servos = [axis.servo for axis in pair.axes]
    if not head.lease_s:
        pair.stand()
    with pair.holding_in_the_end():
        for servo in servos:
            servo.check_identity()
        for servo in servos:
            servo.check_health()
            servo.check_place()
        for servo in servos:
            servo.set_up()
        for axis in pair.axes:
            axis.take_hold()


TOO_FAST = 3.0
"""How many times the speed of its profile an axis may turn: a servo whose unit of speed is 50 counts turns 50
times as fast as one that was taken for one of 1 count."""

FAST_SPAN_S = 0.04


class FeetechWatch(SessionWatch[FeetechAxis]):
    """The watch over two servos, as `SessionWatch`; a trip is a lease that has run out under way."""

    trip_words = "the lease of a move ran out: this process was silent for too long; stop ends it"
    trip_refusal = "the lease of a move ran out; stop lets the head move again"

    def __init__(self, pair: FeetechPair, lease_s: float) -> None:
        super().__init__(pair.axes)
        self._pair = pair
        self._lease_s = lease_s
        self._too_fast: dict[str, str] = {}
        self._before: dict[str, tuple[int, float]] = {}

    def heard_again(self, silence_s: float) -> None:
        """Stop for good after a silence longer than the lease of a way that is left. Raises LineLost."""
        under_way = any(axis.motion.sent is not None for axis in self._pair.axes)
        if self._lease_s and silence_s > self._lease_s and under_way and not self.tripped:
            self.tripped = True
            log.error("the head stood at the end of its lease: this process was silent for too long")
            self._pair.brake()

    def look(self) -> None:
        """Look whether both servos are as they were left.

        Raises GivenUp if something set or restarted them that was not this driver; LineLost if the line is
        gone while an axis is braked that turns too fast.
        """
        for axis in self._pair.axes:
            sample = axis.motion.sample
            if sample is None:
                continue
            if axis.hardware_error and not sample.alert:
                log.warning("%s is well again", axis.servo.name)
                axis.hardware_error = ""
            if axis.motion.holds and not sample.values["torque_enable"]:
                if not axis.hardware_error:
                    words = f"{axis.servo.name} has its torque off: it restarted, or somebody else set it"
                    raise GivenUp(BadReply(words))
                axis.motion.limp()
            if (words := axis.motion.other_goal_words()) and not axis.hardware_error:
                raise GivenUp(BadReply(f"{words}: it restarted, or somebody else set it"))
            self._see_speed(axis)

    def _see_speed(self, axis: FeetechAxis) -> None:
        """Brake an axis that turns much faster than was commanded."""
        sample, name, profile = axis.motion.sample, axis.servo.name, axis.motion.profile
        assert sample is not None
        before = self._before.get(name)
        if before is None or sample.received_s - before[1] >= FAST_SPAN_S:
            self._before[name] = sample.counts, sample.received_s
        if before is None or profile is None or sample.received_s - before[1] < FAST_SPAN_S:
            return
        unit = axis.settings.model.speed_unit_counts
        seen = abs(sample.counts - before[0]) / (sample.received_s - before[1])
        if axis.motion.holds and seen > TOO_FAST * profile[1] * unit + 8 / FAST_SPAN_S:
            self._too_fast[name] = (
                f"{name} turns at {seen:.0f} counts/s where {profile[1] * unit} were commanded: its "
                "firmware's unit of speed is another; set speed_unit_counts: 50, and open the head anew"
            )
            log.error("%s", self._too_fast[name])
            self._pair.brake()

    def note_alert(self, axis: FeetechAxis) -> None:
        """A servo reports a fault: brake both axes and say which. Raises LineLost."""
        sample = axis.motion.sample
        self._pair.brake()
        assert sample is not None
        axis.hardware_error = fault_words(axis.servo.name, sample.values["status"])
        if not sample.values["torque_enable"]:
            axis.hardware_error += "; its torque is off"
            axis.motion.limp()
        log.error("%s", axis.hardware_error)

    def own_words(self, axis: FeetechAxis) -> list[str]:
        """Return what forbids an axis to move: its servo's fault, a speed that was not commanded."""
        return [*super().own_words(axis), *filter(None, [self._too_fast.get(axis.servo.name)])]


def open_head(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> FeetechHead:
    """Open the head that the options of ``driver: feetech`` describe; see `settings.FeetechSettings`.

    Raises BadOptions for options that cannot be; LineLost, NoReply, BadReply, WrongDevice, HardwareFault if
    the servos cannot be reached or do not fit; the line is closed again.
    """
    return FeetechHead(feetech_settings(options), clock, open_line)


class FeetechHead(BusHead):
    """The head; parameters and errors as of `BusHead`."""

    settings: FeetechSettings

    def __init__(
        self, settings: FeetechSettings, clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> None:
        self._questions = Questions()
        self._offsets: dict[int, int] = {}
        super().__init__(settings, clock, open_line)

    def _open(self) -> FeetechPair:
        return open_pair(
            self.settings, self._questions, self._offsets, self._bus.urgent, self._clock, self._open_line
        )

    def _watch(self, pair: FeetechPair) -> FeetechWatch:
        make_ready(pair, self.settings)
        return FeetechWatch(pair, self.settings.lease_s)


def halt(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> list[str]:
    """Command each axis that holds to stand, as `halt_axes`; its torque stays as it is.

    ``clock`` and ``open_line`` are those of `FeetechLink`. Raises BadOptions, LineLost, NoReply.
    """
    with closing(open_pair(feetech_settings(options), clock=clock, open_line=open_line)) as pair:
        return halt_axes(pair)


BENCH = ServoBench(
    "feetech", open_link, scan, facts, set_id,
    (1_000_000, 115_200, 500_000, 250_000, 128_000, 76_800, 57_600, 38_400), (1_000_000, 115_200, 500_000),
    MODELS, "STS3215", POLL_BYTES,
)  # fmt: skip
DRIVER = Driver(
    lambda options, context: open_head(options, context.clock),
    read_options=feetech_settings, halt=halt, probe=BENCH.probe, probe_order=2, bench=BENCH,
)  # fmt: skip
