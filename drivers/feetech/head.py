"""A pan/tilt head of two Feetech servos (`drivers.interfaces.PanTilt`).

One thread owns the bus (`drivers.servo_bus.head`). A servo has no watchdog: its goals are sent in parts. Of a
way only as much is sent as its axis goes in ``lease_s``, and every poll sends more of it, so that both axes
stand soon after this process has died. Nothing here moves the head but `move`.

Permanent settings are written only where they differ (they wear), with the torque off and the EEPROM unlocked
for them alone. Everything written is read back. The offset in the EEPROM is reported and never written.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, WithJsonSchema, model_validator

from calib.files.records import ABSENT
from drivers.clock import Clock
from drivers.errors import DriverError, HardwareFault, NoReply, WrongDevice
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
    facts,
    model_named,
    present,
    set_id,
    status_faults,
)
from drivers.options import one_of, read_options
from drivers.registry import Driver
from drivers.servo_bus.bench import ServoBench
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.exchange import ATTEMPTS, again
from drivers.servo_bus.head import BusHead
from drivers.servo_bus.pair import BusServo, ServoAxis, ServoPair, SessionWatch
from drivers.servo_bus.port import Part
from drivers.servo_bus.session import distrusted
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
    """Which servo; one that is not in the table by its series: STS or SMS."""
    torque_percent: Annotated[float, Field(ge=2.0, le=100.0)] | None = None
    """Bound of the motor's drive; left out: as much as the servo's EEPROM allows."""
    speed_unit_counts: Literal[1, 50] = 1
    """Counts per second of one unit of its speed; 50 in some firmware."""

    @model_validator(mode="after")
    def _set_speed_unit(self) -> Self:
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
        self._set_patience("lease_s", USUAL_LEASE_S, SHORTEST_LEASE_S)
        return self

    @property
    def silence_s(self) -> float:
        """How long nothing may be sent so that both axes have come to the end of what was sent to them."""
        return self.lease_s + 2 * self.speed_rad_per_s / self.acceleration_rad_per_s2 if self.lease_s else 0.0


feetech_settings = partial(read_options, FeetechSettings)
"""Return the head that the options of ``driver: feetech`` describe. Raises BadOptions."""

LEAST_TORQUE = 20  # space below a torque limit for the tokens of the questions


@dataclass(frozen=True)
class FeetechMemory:
    """What outlasts a line of the head: questions, and the offset in each EEPROM as found first, by id."""

    questions: Iterator[int] = field(default_factory=itertools.count)
    offsets: dict[int, int] = field(default_factory=dict)


class FeetechServo(BusServo):
    """One configured servo on an open line, as `BusServo`."""

    _link: FeetechLink
    _settings: FeetechAxisSettings

    def __init__(
        self,
        link: FeetechLink,
        axis: str,
        settings: FeetechAxisSettings,
        head: FeetechSettings,
        memory: FeetechMemory,
    ) -> None:
        super().__init__(link, axis, settings, head)
        self.torque_limit = 0
        self._offsets = memory.offsets

    def get(self, register: str) -> int:
        """Return a register's value; a lost reply is requested again. Raises as `FeetechLink.proven`."""
        entry = self._registers[register]
        return again(self._link, lambda: self._link.proven(self.servo_id, entry))

    def set(self, register: str, value: int) -> None:
        """Set a register and see that it holds the value.

        Raises WrongDevice if the servo says that it did but holds another value; NoReply, BadReply, LineLost.
        """
        entry = self._registers[register]
        for _ in range(ATTEMPTS):
            again(self._link, lambda: self._link.write(self.servo_id, entry, value))
            stored = self.get(register)
            if stored == value:
                return
        raise WrongDevice(f"{self.name} holds {stored} in {register} after {value} was written to it")

    def check_identity(self) -> None:
        """As `BusServo`; also that its offset is as it was when the head was opened."""
        model = self._settings.model
        number = self.get("model_number")
        if model.number is not None and number != model.number:
            other = MODELS_BY_NUMBER.get(number)
            found = f"a {other.name}" if other else f"of the model number {number}, which is not in the table"
            raise WrongDevice(
                f"{self.name} is {found}, the configuration says {model.name}; a servo that is not in the "
                "table is named by its series: STS or SMS"
            )
        if self.get("response_level") != 1:
            with self._unlocked(answers=False):
                self._link.write_unanswered(self.servo_id, self._registers["response_level"], 1)
        offset = self.get("offset")
        known = self._offsets.setdefault(self.servo_id, offset)
        if offset != known:
            raise WrongDevice(f"{self.name} had the offset {known} in its EEPROM and has {offset} now")
        if offset:
            log.warning("%s has an offset of %d counts in its EEPROM; it is left as it is", self.name, offset)

    def check_health(self) -> None:
        """As `BusServo`."""
        if error := again(self._link, lambda: self._link.ping(self.servo_id)):
            raise HardwareFault(status_fault(self.name, error), detail={"status": error})

    def sample_once(self) -> ServoSample:
        """Return what the servo says about its motion, requested one time; as `FeetechLink.samples`."""
        if not self.torque_limit:  # each question writes it: it must never rise above the servo's own
            self._bound_torque()
        sample = self._link.samples({self.servo_id: self.torque_limit})[self.servo_id]
        self.truth.check(sample)
        return sample

    def stand(self) -> int | None:
        """Make where the servo is its goal, if its torque is on; returns the goal. Raises as
        `sample_once`."""
        sample = self.sample_once()
        if not sample.values["torque_enable"]:
            return None
        goal = self._settings.within_limits(sample.counts)
        self._link.group_write([self.part("goal_position", goal)])
        return goal

    def stood(self) -> str:
        """Have the servo stand, as `BusServo.stood`."""
        goal = self.stand()
        if goal is None:
            return "has its torque off"
        if (stored := self.get("goal_position")) != goal:  # the packet that says so has no answer
            raise NoReply(f"{self.name} did not take the command to stand, its goal is {stored}")
        return "was commanded to stand where it is, and holds"

    def _bound_torque(self) -> int:
        """Take the torque limit from the servo's EEPROM and the options; returns that bound, 0.1 %."""
        most = self.get("max_torque")
        bound = min(self._settings.torque_limit or most, most)
        self.torque_limit = max(bound, LEAST_TORQUE)
        return bound

    def set_up(self) -> None:
        """As `BusServo`; also that the torque limit has room for the questions' tokens."""
        if (bound := self._bound_torque()) < LEAST_TORQUE:
            raise WrongDevice(
                f"{self.name} has the torque limit {bound / 10:g} % in its EEPROM; expected "
                f"{LEAST_TORQUE / 10:g} % or more (max_torque)"
            )
        low, high = self._settings.limit_counts
        wanted = {
            "return_delay": 0, "min_angle_limit": low, "max_angle_limit": high,
            "operating_mode": POSITION_MODE,
        }  # fmt: skip
        self._change({name: value for name, value in wanted.items() if self.get(name) != value})

    def _set_permanent(self, values: Mapping[str, int]) -> None:
        with self._unlocked():
            for name, value in values.items():
                self.set(name, value)

    @contextmanager
    def _unlocked(self, answers: bool = True) -> Iterator[None]:
        """Unlock the EEPROM within; a stop or a closing that breaks it off leaves it locked."""
        if answers:
            self.set("lock", UNLOCKED)
        else:
            self._link.write_unanswered(self.servo_id, self._registers["lock"], UNLOCKED)
        try:
            yield
        finally:
            with self._link.undisturbed():
                self.set("lock", LOCKED)

    @property
    def profile(self) -> tuple[int, int]:
        """Acceleration and speed of the configuration, in its counts."""
        acceleration, speed = super().profile
        return min(254, acceleration), speed

    def leg(self, profile: tuple[int, int], goal: int) -> Part:
        """Return a goal with its profile, as `BusServo.leg`; a goal time of 0 means by speed."""
        acceleration, speed = profile
        return self.neighbours(
            {"acceleration": acceleration, "goal_position": goal, "goal_time": 0, "goal_speed": speed}
        )

    def send_leg(self, profile: tuple[int, int], goal: int) -> None:
        """Set a goal with its profile; the next sample shows it. Raises LineLost, BadReply."""
        self._link.group_write([self.leg(profile, goal)])

    def _aim_at_place(self) -> bool:
        counts = self.check_place()
        self.set("acceleration", self.profile[0])
        self.set("goal_time", 0)
        self.set("goal_speed", self.profile[1])
        self.set("goal_position", counts)
        return bool(self.get("torque_enable"))

    def release(self, limp: bool) -> None:
        """Switch the torque off if it is to be ``limp``, and lift the questions' tokens; for the end."""
        try:
            if limp:
                self.set("torque_enable", 0)
            self.set("torque_limit", self.torque_limit)
        except DriverError as error:
            log.warning("%s is not left as it should be at the end: %s", self.name, error)


def status_fault(name: str, error: int) -> str:
    """Return one sentence for a status."""
    faults = " and ".join(status_faults(error))
    return f"{name} reports {faults} (status 0x{error:02x}); it says so as long as it lasts"


class FeetechAxis(ServoAxis):
    """One axis, whose way is sent in parts."""

    servo: FeetechServo
    settings: FeetechAxisSettings

    def __init__(
        self, servo: FeetechServo, clock: Clock, settings: FeetechAxisSettings, head: FeetechSettings
    ) -> None:
        super().__init__(servo, clock, settings, head)
        self._lease_s = head.lease_s

    def reach(self) -> int:
        """Return how far the axis may be sent now, as a goal."""
        motion = self.motion
        return motion.stretch(self._lease_s, self.acceleration_rad_per_s2) if self._lease_s else motion.goal

    def go_on(self) -> None:
        """Send the next leg of a move if the present one has ended, or more of the way. Raises LineLost."""
        motion = self.motion
        if motion.next_leg() is not None:
            motion.begin_leg()
            goal: int | None = self.reach()
        else:
            goal = motion.more_of_the_way(self.reach())
        if goal is not None:
            self.servo.send_leg(motion.profile or self.servo.profile, goal)
            motion.note_sent(goal)


class FeetechPair(ServoPair):
    """Pan and tilt on one open line, as `ServoPair`."""

    link: FeetechLink
    axes: tuple[FeetechAxis, ...]

    def __init__(self, link: FeetechLink, head: FeetechSettings, memory: FeetechMemory) -> None:
        super().__init__(link)
        link.questions = memory.questions
        self.axes = tuple(
            FeetechAxis(FeetechServo(link, name, axis, head, memory), link.clock, axis, head)
            for name, axis in (("pan", head.pan), ("tilt", head.tilt))
        )

    def samples(self) -> list[ServoSample]:
        """Return what both servos say about their motion now; raises as `FeetechLink.samples`."""
        servos = [axis.servo for axis in self.axes]
        found = self.link.samples({servo.servo_id: servo.torque_limit for servo in servos})
        for servo in servos:
            servo.truth.check(found[servo.servo_id])
        return [found[servo.servo_id] for servo in servos]


TOO_FAST = 3.0
"""How many times the speed of its profile an axis may turn: a servo whose unit of speed is 50 counts turns 50
times as fast as one that was taken for one of 1 count."""

FAST_SPAN_S = 0.04


class FeetechWatch(SessionWatch):
    """The watch over two servos, as `SessionWatch`; a trip is a lease that has run out under way."""

    trip_fault = "the lease of a move ran out: this process was silent for too long; stop ends it"
    trip_refusal = "the lease of a move ran out; stop lets the head move again"

    def __init__(self, pair: FeetechPair, lease_s: float) -> None:
        super().__init__(pair)
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

    def check(self) -> None:
        """See that both servos are as they were left.

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
                    raise distrusted(f"{axis.servo.name} has its torque off")
                axis.motion.limp()
            if (reason := axis.motion.foreign_goal()) and not axis.hardware_error:
                raise distrusted(reason)
            self._check_speed(axis)

    def _check_speed(self, axis: FeetechAxis) -> None:
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

    def note_alert(self, axis: ServoAxis) -> None:
        """A servo reports a fault: brake both axes and say which. Raises LineLost."""
        sample = axis.motion.sample
        self._pair.brake()
        assert sample is not None
        axis.hardware_error = status_fault(axis.servo.name, sample.values["status"])
        if not sample.values["torque_enable"]:
            axis.hardware_error += "; its torque is off"
            axis.motion.limp()
        log.error("%s", axis.hardware_error)

    def faults_of(self, axis: ServoAxis) -> list[str]:
        """Return what forbids an axis to move: its servo's fault, a speed that was not commanded."""
        return [*super().faults_of(axis), *filter(None, [self._too_fast.get(axis.servo.name)])]


class FeetechHead(BusHead):
    """The head; parameters and errors as of `BusHead`."""

    settings: FeetechSettings
    settings_type, link_type, pair_type = FeetechSettings, FeetechLink, FeetechPair
    memory_type = FeetechMemory

    def _watch(self, pair: FeetechPair) -> FeetechWatch:
        return FeetechWatch(pair, self.settings.lease_s)


open_head, halt = FeetechHead.from_options, FeetechHead.halt_alone
BENCH = ServoBench(
    "feetech", FeetechLink, present, facts, set_id,
    (1_000_000, 115_200, 500_000, 250_000, 128_000, 76_800, 57_600, 38_400), (1_000_000, 115_200, 500_000),
    MODELS, "STS3215", POLL_BYTES,
)  # fmt: skip
DRIVER = Driver(
    lambda options, context: open_head(options, context.clock),
    read_options=feetech_settings, halt=halt, probe=BENCH.probe, probe_order=2, bench=BENCH,
)  # fmt: skip
