"""A pan/tilt head of two servos on one bus (`drivers.interfaces.PanTilt`), whatever their family.

One thread owns the bus: it reads both servos at least ``poll_hz`` times a second, sends what is left of a
move, and comes back after the line was lost. Nothing here moves the head but `move`.
"""

from __future__ import annotations

import logging
import threading
from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from typing import Any, ClassVar, Self, TypeVar

from drivers.absent import LAST_STOP_S, Absence, stop_at_last
from drivers.approach import check_goal
from drivers.clock import Clock, SystemClock, deadlines_on
from drivers.errors import DriverError, LineLost, NoReply, OutOfRange
from drivers.interfaces import AxisMotion, AxisReport, HeadInfo, PanTilt, Reading
from drivers.options import read_options
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.bus import Bus
from drivers.servo_bus.exchange import BusLink
from drivers.servo_bus.pair import ServoPair, SessionWatch
from drivers.servo_bus.port import Overtaken
from drivers.servo_bus.session import LEFT_WITHIN_S, GivenUp, ServoSession, confirmed, leave, stop_error
from drivers.servo_bus.settings import HeadSettings

log = logging.getLogger(__name__)
T = TypeVar("T")

CALL_TIMEOUT_S = 0.8  # the service waits 1 s
CLOSE_TIMEOUT_S = 3.0  # the service gives no more
AXES = ("pan", "tilt")
SETTLES_WITHIN_COUNTS = 3


class BusHead(PanTilt):
    """The head; every method may be called from any thread. A family of servos says what it is made of.

    The ``clock`` stamps the readings; deadlines run on it too if it runs, else on the machine's.
    ``memory_type`` is of what outlasts a line of the head; each `ServoPair` is given it. Raises LineLost,
    NoReply, WrongDevice, HardwareFault, Refused.
    """

    settings_type: ClassVar[type[HeadSettings]]
    link_type: ClassVar[type[BusLink]]
    pair_type: ClassVar[type[Any]]
    memory_type: ClassVar[type[Any]]

    def __init__(
        self, settings: HeadSettings, clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> None:
        self.settings = settings
        self._stamps = clock or SystemClock()
        self._clock = deadlines_on(self._stamps)
        self._open_line = open_line
        self._memory = self.memory_type()
        self._absence = Absence()
        self._closed = False
        self._state = threading.Lock()
        self._bus = Bus(settings.port, self._round, self._clock)
        self._session: ServoSession | None = self._connect()
        self._motions = [axis.motion for axis in self._session.pair.axes]
        self._bus.start()

    @classmethod
    def from_options(
        cls, options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> Self:
        """Open the head that a configuration's options describe.

        Raises BadOptions for options that cannot be; LineLost, NoReply, BadReply, WrongDevice, HardwareFault,
        Refused if the servos cannot be reached or do not fit; the line is closed again.
        """
        return cls(read_options(cls.settings_type, options), clock, open_line)

    @classmethod
    def halt_alone(
        cls, options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> list[str]:
        """Command each axis that holds to stand, as `ServoPair.halt`; its torque stays as it is.

        Raises BadOptions, LineLost, NoReply.
        """
        settings = read_options(cls.settings_type, options)
        with closing(cls._opened(settings, cls.memory_type(), clock, open_line)) as pair:
            return pair.halt()

    @classmethod
    def _opened(
        cls,
        head: HeadSettings,
        memory: Any,
        clock: Clock | None,
        open_line: OpenLine,
        urgent: Callable[[], bool] = lambda: False,
    ) -> ServoPair:
        """Open the line to both servos; nothing is set. Raises LineLost, BadReply."""
        patience_s = head.reply_timeout_s
        link = cls.link_type(head.port, head.baud, patience_s, urgent, clock=clock, open_line=open_line)
        pair: ServoPair = cls.pair_type(link, head, memory)
        return pair

    # What the service calls

    def read(self) -> Reading:
        """Return what both servos measure now.

        Raises LineLost, NoReply, BadReply, WrongDevice, HardwareFault if they cannot be read, at once while
        the line is known to be lost.
        """
        return self._call("read", ServoSession.read)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start both axes together towards the angles, rounded to the nearest count, and return.

        Raises OutOfRange for an angle outside the limits, or a speed that is no positive number or slower
        than a servo can be set to (0.024 rad/s of an X or MX, 0.001 of a P; its 0 means as fast as it can);
        nothing moves. Speeds between are rounded down; HardwareFault, WatchdogTripped while a servo reports a
        hardware error, or the watchdog has stopped the head; LineLost, NoReply, BadReply if the servos do not
        confirm the goals.
        """
        axes = (self.settings.pan, self.settings.tilt)
        check_goal((pan_rad, tilt_rad), [axis.limits_rad for axis in axes], speed_rad_per_s)
        speed = self.settings.speed_rad_per_s if speed_rad_per_s is None else speed_rad_per_s
        slowest = max(axis.model.velocity_unit_rad_per_s for axis in axes)
        if speed < slowest:
            raise OutOfRange(
                f"speed {speed:g} rad/s is less than the {slowest:.4f} rad/s that the servos know"
            )
        capped = min(speed, self.settings.speed_rad_per_s)
        self._call("move", lambda session: session.move((pan_rad, tilt_rad), capped), moves=True)

    def stop(self) -> None:
        """Brake both axes; each then holds.

        Each is commanded to brake by itself before any request, and what else was under way on the line is
        broken off for it; a move that waits for its turn is not begun. After the watchdog has stopped the
        head this is the deliberate act that arms it anew.

        Raises LineLost, NoReply, BadReply if a servo did not confirm. The driver then keeps silent until its
        watchdog has stopped it, a further stop included: both were commanded to brake when the line was given
        up, and every packet more would feed the watchdog of one that did not hear it. With ``watchdog_s: 0``
        nothing can be fed: a stop tries a line that is away at once.
        """
        away = None if self.settings.silence_s else self._stop_away
        self._call("stop", ServoSession.stop, first=True, away=away)

    def close(self) -> None:
        """Stop, leave each servo as its ``at_close`` says, and let go of the line; never raises.

        Without a watchdog or lease, a line that is away is tried as `stop_at_last` does. A second call
        returns when the first has ended.
        """
        with self._state:
            self._closed = True
        self._bus.close(self._close_now, CLOSE_TIMEOUT_S)

    def report(self) -> dict[str, AxisReport]:
        """Return where each axis was sent and where it stood when it was last read; queries no servo."""
        reports = {axis: motion.report() for axis, motion in zip(AXES, self._motions, strict=True)}
        return {axis: report for axis, report in reports.items() if report is not None}

    @property
    def info(self) -> HeadInfo:
        """How each axis moves: its profile, as the servo rounds it, and its approach."""
        motion = {}
        for name, axis in zip(AXES, (self.settings.pan, self.settings.tilt), strict=True):
            counts = axis.acceleration_counts(self.settings.acceleration_rad_per_s2)
            motion[name] = AxisMotion(
                counts * axis.model.acceleration_unit_rad_per_s2,
                axis.approach_rad,
                axis.rising_below_rad,
                axis.model.count_rad,
            )
        return HeadInfo(motion=motion, settles_within_counts=SETTLES_WITHIN_COUNTS)

    # In the thread that owns the bus

    def _call(
        self,
        what: str,
        function: Callable[[ServoSession], T],
        *,
        first: bool = False,
        moves: bool = False,
        away: Callable[[], T] | None = None,
    ) -> T:
        """Have something done in the bus thread, or ``away`` while the line is; None: it is left alone."""
        with self._state:
            if self._closed:
                raise NoReply(f"the head on {self.settings.port} is closed; {what} was not sent")
        if away is None:
            self._absence.check()
        return self._bus.call(
            what, lambda: self._within(function, away), CALL_TIMEOUT_S, first=first, moves=moves
        )

    def _within(self, function: Callable[[ServoSession], T], away: Callable[[], T] | None = None) -> T:
        """Do something with the servos, which may end in giving the line up; ``away`` as of `_call`."""
        if away is not None and self._session is None:
            return away()
        self._absence.check()
        session = self._session
        assert session is not None
        try:
            return function(session)
        except GivenUp as given_up:
            self._give_up(session, given_up.error)
            raise given_up.error from None

    def _round(self) -> float:
        """What the thread does between calls; returns when it wants to be called again."""
        now_s = self._clock.now_s()
        if self._session is None:
            if now_s >= self._absence.again_s:
                self._come_back()
        elif now_s >= self._session.poll_due_s:
            self._within(ServoSession.update)
        return self._absence.again_s if self._session is None else self._session.poll_due_s

    def _open(self) -> ServoPair:
        """Open the line again; raises as `_opened`."""
        return self._opened(self.settings, self._memory, self._clock, self._open_line, self._bus.urgent)

    @abstractmethod
    def _watch(self, pair: Any) -> SessionWatch:
        """Return the watch over both servos, which are ready."""

    def _connect(self) -> ServoSession:
        """Open the line, make both servos ready, and read them once."""
        head = self.settings
        pair = self._open()
        try:
            pair.make_ready(goes_on=not head.silence_s)
            session = ServoSession(pair, self._watch(pair), head, self._stamps)
            session.poll_once()
        except BaseException as error:  # whatever it was goes on to the caller; the line is not left open
            pair.close()
            raise (error.error if isinstance(error, GivenUp) else error) from None
        log.info("%s: %s", head.port, "; ".join(f"{axis.servo.name} is ready" for axis in pair.axes))
        return session

    def _come_back(self) -> None:
        """Try to open the line and set the servos up again."""
        try:
            session = self._connect()
        except DriverError as error:
            if str(error) != str(self._absence.error):
                log.warning("%s: still away: %s", self.settings.port, error)
            self._absence.note(error, self._clock.now_s())
            return
        self._session, self._motions = session, [axis.motion for axis in session.pair.axes]
        self._absence.end()
        log.warning("%s is back: limits and modes checked, the head stands still", self.settings.port)

    def _give_up(self, session: ServoSession, error: DriverError) -> None:
        """Have both axes brake, close the line, and try again when the watchdogs must have stopped them."""
        with suppress(LineLost):
            session.pair.brake()
        session.pair.close()
        now_s = self._clock.now_s()
        self._session = None
        self._absence.note(error, now_s, self.settings.silence_s)
        log.warning("%s; trying again in %.1f s", error, self._absence.again_s - now_s)

    def _stop_away(self, left_until_s: float | None = None) -> None:
        """Command both axes to stand over a line that is away, opened for that alone.

        To make them ready takes longer than a stop may; that comes next. With ``left_until_s``, as of
        `leave`, both axes are left. Raises `Overtaken` where closing is to end.
        """
        if self._bus.urgent():  # to open a network's line takes half a second
            raise Overtaken
        try:
            pair = self._open()
        except DriverError as error:
            self._absence.note(error, self._clock.now_s())
            raise
        try:
            failed = confirmed(pair.axes, lambda axis: axis.servo.stood(), self._clock)
            if left_until_s is not None:
                leave(pair, failed, left_until_s)
        finally:
            pair.close()
        if failed:
            raise stop_error(pair, failed)
        self._absence.again_s = self._clock.now_s()

    def _close_now(self) -> None:
        session, self._session = self._session, None
        away_s = LAST_STOP_S if session is None else 0.0  # for the line to come back
        until_s = self._clock.now_s() + away_s + LEFT_WITHIN_S
        try:
            failed = session is None or session.end(until_s)
            if failed and not self.settings.silence_s:
                stop_at_last(lambda: self._stop_away(until_s), self._clock, self.settings.port)
        except Overtaken:
            message = (
                "closing was broken off when its time was over: an axis may still move, or keep its torque"
            )
            log.warning("%s: %s; 'mastctl stop --without-daemon' stops the head", self.settings.port, message)
