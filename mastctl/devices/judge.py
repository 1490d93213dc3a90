"""The limits, and the judge of moves: which may go out, with limits, keep-outs and sun of this moment.

Where a head that moves may be is computed, not guessed. It is within the rectangle of the move that was let
through last, which is free; and near its reading: as far off as it needs to brake from the fastest speed that
it was sent with, and as it goes while the command travels. What both allow is where the next move begins.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from calib.geometry.rig import AxisJoint, Rig
from calib.geometry.rigid import FloatArray, rot_x, rot_y
from drivers.clock import Clock
from drivers.errors import BadOptions
from drivers.interfaces import AxisMotion, PanTilt, Reading
from mastctl.answers import SunAnswer
from mastctl.as_json import as_json
from mastctl.control.machine import StandingFault
from mastctl.devices.keep_out import Box, KeepOuts, Pair, Span
from mastctl.devices.thread import REST_S
from mastctl.errors import BadRequest

log = logging.getLogger(__name__)

TRAVEL_S = 0.1  # from a reading to the moment when the next command acts on the axes
ASSUMED_RAD_PER_S2 = 0.4  # of a head that does not say how it brakes: the least that a driver can be set to
PARTS = 16  # in which a goal ahead is tried
ROUNDED = 1.01  # a servo rounds its acceleration up to its own unit

SUN = "sun"
ROWS = 16  # over a cone's height: a row is an eighth of the half angle high
LEAST_ROW_RAD = 0.004
OVERLAP_RAD = 1e-6  # of rows: boxes are open, and two that only touch would leave a crack between them
LEAST_CONE_RAD, WIDEST_CONE_RAD = 0.001, 1.5


class OutsideLimits(BadRequest):
    """A joint angle or speed that must not be commanded.

    ``detail`` says for programs ``what``: ``pan``, ``tilt`` or ``speed``; and the requested ``value`` and the
    ``bound`` that it breaks, in ``unit``; NaN where there is no such number.
    """

    def __init__(self, what: str, value: float, bound: float, unit: str, message: str) -> None:
        self.detail = {"what": what, "value": value, "bound": bound, "unit": unit}
        super().__init__("outside_limits", message)


@dataclass(frozen=True)
class Limits:
    """Soft limits, (lowest, highest) of each axis, and the fastest joint speed; the bounds are allowed.

    A pan that turns more than a turn has its cable's winding bounded by them: angles whole turns apart are
    different ones. ``margin_rad`` is around every keep-out: no goal lies in it, and no move but that of a
    head which is in it already. The axes speed up and brake with no more than ``acceleration_rad_per_s2``;
    None: whatever they do. ``keep_out`` is where the head must not be. The configuration checks the numbers.
    """

    pan_rad: tuple[float, float]
    tilt_rad: tuple[float, float]
    speed_rad_per_s: float
    margin_rad: float = 0.0
    acceleration_rad_per_s2: float | None = None
    keep_out: tuple[Box, ...] = ()

    def check(self, pan_rad: float, tilt_rad: float) -> None:
        """Pass joint angles that may be commanded. Raises OutsideLimits."""
        for axis, value, bounds in (("pan", pan_rad, self.pan_rad), ("tilt", tilt_rad, self.tilt_rad)):
            if not math.isfinite(value):
                raise OutsideLimits(axis, value, math.nan, "rad", f"{axis} {value} rad is not a finite angle")
            low, high = bounds
            if value < low or value > high:
                bound = low if value < low else high
                shown_value, shown_bound = _apart(value, bound)
                unwound = value - math.copysign(math.tau, value)
                hint = f"; {unwound:.6g} rad points the same way" if low <= unwound <= high else ""
                raise OutsideLimits(
                    axis, value, bound, "rad",
                    f"{axis} {shown_value} rad is beyond the soft limit {shown_bound} rad{hint}",
                )  # fmt: skip

    def speed(self, requested_rad_per_s: float | None) -> float:
        """Return the speed to command: the requested one up to the cap, the cap by default.

        Raises OutsideLimits if it is not finite and above 0: some servos treat 0 as "as fast as possible".
        """
        if requested_rad_per_s is None:
            return self.speed_rad_per_s
        if not (math.isfinite(requested_rad_per_s) and requested_rad_per_s > 0.0):
            raise OutsideLimits(
                "speed", requested_rad_per_s, 0.0, "rad/s",
                f"speed {requested_rad_per_s} rad/s is not a finite number above 0 rad/s",
            )  # fmt: skip
        return min(requested_rad_per_s, self.speed_rad_per_s)


def _apart(value: float, bound: float) -> tuple[str, str]:
    """Write two different numbers briefly, but so that they differ."""
    brief = f"{value:.6g}", f"{bound:.6g}"
    return brief if brief[0] != brief[1] else (repr(value), repr(bound))


Frame = Literal["rover", "site"]


@dataclass(frozen=True)
class SunDirection:
    """Where the sun is, and how wide a cone around it no camera may look into.

    ``direction`` is the unit vector towards it in ``frame``: x forward (north), y right (east), z down; that
    of the ``site`` turns with the rover's pose. After ``until_s``, seconds of CLOCK_MONOTONIC, it holds no
    longer; None: until another is stated.
    """

    direction: tuple[float, float, float]
    frame: Frame
    half_angle_rad: float
    until_s: float | None = None

    def holds(self, now_s: float) -> bool:
        """Return whether it is still true at a moment."""
        return self.until_s is None or now_s <= self.until_s


def direction_of(azimuth_rad: float, elevation_rad: float) -> tuple[float, float, float]:
    """Return a unit vector: azimuth from x over y, elevation above the xy plane, z down."""
    level = math.cos(elevation_rad)
    return level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), -math.sin(elevation_rad)


def sun_boxes(rig: Rig, in_rover: FloatArray, half_angle_rad: float, tilt_rad: Pair) -> tuple[Box, ...]:
    """Return boxes of true angles that together hold every pose in which a head camera looks into the cone.

    ``in_rover`` is (3,), the unit vector towards the sun in the rover frame; ``tilt_rad`` the range of true
    tilt that is wanted. Body cameras do not turn and are left aside.
    """
    sun = rig.mast.rover_from_mast.rotation.T @ in_rover
    axes = {tuple(camera.model.A.tolist()) for camera in rig.cameras.values() if camera.on == "head"}
    step = max(2.0 * half_angle_rad / ROWS, LEAST_ROW_RAD)
    rows = max(1, math.ceil((tilt_rad[1] - tilt_rad[0]) / step))
    step = (tilt_rad[1] - tilt_rad[0]) / rows
    found = []
    for number in range(rows):
        middle = tilt_rad[0] + (number + 0.5) * step
        turned = rot_x(rig.mast.axis_twist_rad) @ rot_y(middle)
        pans = [
            pan
            for axis in axes
            for pan in _pans(turned @ np.array(axis), sun, half_angle_rad + 0.5 * step + OVERLAP_RAD)
        ]
        row = middle - 0.5 * step - OVERLAP_RAD, middle + 0.5 * step + OVERLAP_RAD
        found += [Box(SUN, pan, row) for pan in _joined(pans)]
    return tuple(found)


def _pans(axis: FloatArray, sun: FloatArray, angle_rad: float) -> Iterator[Pair]:
    """The interval of pan at which an axis is within an angle of the sun, both in the mast frame."""
    level = math.hypot(axis[0], axis[1]) * math.hypot(sun[0], sun[1])
    wanted = math.cos(min(angle_rad, math.pi)) - float(axis[2] * sun[2])
    if wanted > level:
        return
    middle = math.atan2(sun[1], sun[0]) - math.atan2(axis[1], axis[0])
    half = math.pi + OVERLAP_RAD if wanted <= -level else math.acos(wanted / level)
    middle = math.remainder(middle, math.tau)
    yield middle - half, middle + half


def _joined(pans: list[Pair]) -> list[Pair]:
    """Overlapping intervals as one, those that touch round the circle too."""
    joined: list[Pair] = []
    for low, high in sorted(pans):
        if joined and low <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], high)
        else:
            joined.append((low, high))
    return joined


@dataclass(frozen=True)
class _SentMove:
    """The move that was let through last."""

    within: Span | None  # None: where it began was not known
    goal: Pair
    speed_rad_per_s: float
    at_s: float


class KeepOutJudge:
    """Limits, keep-outs and the sun; safe from any thread.

    ``head`` may state how its ``axes`` move; ``device`` is its name. The sun's directions end by the
    ``clock``, and without a ``rig``, the mast file's content, none is kept out.

    Raises BadOptions if the head states that it speeds up faster than the limits allow.
    """

    def __init__(
        self,
        limits: Limits,
        head: PanTilt,
        clock: Clock,
        device: str,
        rig: Rig | None,
        sun: SunDirection | None,
    ) -> None:
        self.limits = limits
        self._clock = clock
        self.axes: Mapping[str, AxisMotion] = head.info.motion
        _check_acceleration(limits.acceleration_rad_per_s2, self.axes, device)
        self._braking_rad_per_s2 = min(
            (axis.acceleration_rad_per_s2 for axis in self.axes.values()),
            default=limits.acceleration_rad_per_s2 or ASSUMED_RAD_PER_S2,
        )
        still = AxisMotion(ASSUMED_RAD_PER_S2)
        pan, tilt = (self.axes.get(axis, still).beyond_goal_rad for axis in ("pan", "tilt"))
        self._beyond = pan, tilt
        self._rig = rig  # this and the next two: replaced, never edited
        self._sun = sun
        self._rover_from_site = np.eye(3)
        self._made: tuple[tuple[object, ...], KeepOuts] | None = None  # of which rig, sun and rover
        self._sent: _SentMove | None = None
        self._inside_s: Mapping[str, float] = {}  # where the head stands and should not, and since when

    @property
    def counts_rad(self) -> Mapping[str, float]:
        """One count of ``pan`` and of ``tilt``, as far as the head states it."""
        return {axis: one.count_rad for axis, one in self.axes.items() if one.count_rad}

    def turns_to(self, goal: Pair) -> tuple[int, int]:
        """Return from which side pan and tilt come to a reading by themselves: 1, -1, 0 for either."""
        pan, tilt = (
            self.axes[axis].turn_to(to) if axis in self.axes else 0
            for axis, to in zip(("pan", "tilt"), goal, strict=True)
        )
        return pan, tilt

    def braking_rad(self, speed_rad_per_s: float) -> float:
        """Return how far an axis goes while it brakes from a speed."""
        return speed_rad_per_s**2 / (2.0 * self._braking_rad_per_s2)

    def use_rig(self, rig: Rig) -> None:
        """Judge the sun by another mast file's cameras."""
        self._rig = rig
        self._now()  # made here, so that no move and no stop behind it waits for that

    def use_sun(self, sun: SunDirection | None) -> None:
        """Keep another direction out, or none."""
        self._sun = sun
        self._now()

    def rover_stands(self, rover_from_site: FloatArray) -> None:
        """Turn a sun of the site frame with the rover, (3, 3)."""
        self._rover_from_site = rover_from_site
        self._now()

    def check_goal(self, pan_rad: float, tilt_rad: float) -> None:
        """Pass joint angles that may be a goal. Raises OutsideLimits, KeptOut."""
        self.limits.check(pan_rad, tilt_rad)
        self._now().check_goal((pan_rad, tilt_rad))

    def check_from(self, start: Pair, goal: Pair) -> None:
        """Pass a goal to which a head that rests at ``start`` may be sent.

        Raises OutsideLimits; KeptOut, which names the nearest free goal.
        """
        self.limits.check(*goal)
        self._now().check_move(Span.around(start), goal, True)

    def free_span(self, place: Pair) -> Span | None:
        """Return a free rectangle within the limits about a place, moved into them; None if kept out."""
        limits = self.limits
        on = _into(place[0], limits.pan_rad), _into(place[1], limits.tilt_rad)
        return self._now().free_span(on, Span(limits.pan_rad, limits.tilt_rad))

    def check_move(self, goal: Pair, read: Callable[[], Reading]) -> Span | None:
        """Pass a move to a goal within the limits that may go out now; return where it begins, for `sent`.

        ``read`` measures the head, if anything is kept out. Raises KeptOut if the head might pass that.
        """
        keep_outs = self._now()
        if not keep_outs.boxes:
            return None
        start, rests = self._start(read())
        keep_outs.check_move(start, goal, rests)
        return start

    def sent(self, start: Span | None, goal: Pair, speed_rad_per_s: float) -> None:
        """Remember a move that goes out."""
        before = self._sent
        if before is not None and start is not None and start.corners[0] != start.corners[1]:
            speed_rad_per_s = max(speed_rad_per_s, before.speed_rad_per_s)  # it may still be that fast
        within = None if start is None else Span.around(*start.corners, *self._round(goal).corners)
        self._sent = _SentMove(within, goal, speed_rad_per_s, self._clock.now_s())

    def nearest(self, reading: Reading, goal: Pair, stay: Pair | None = None) -> Pair:
        """Return how far towards a goal a head under way may be sent: each axis goes as far as it may.

        An axis at a bound goes to ``stay`` (where it was sent before; by default where it was read) while the
        other goes on. Where not a step is free, the answer is where the head was read.
        """
        limits = self.limits
        at = reading.pan_rad, reading.tilt_rad
        goal = _into(goal[0], limits.pan_rad), _into(goal[1], limits.tilt_rad)
        keep_outs = self._now()
        if not keep_outs.boxes:
            return goal
        start, rests = self._start(reading)

        def part(way: Callable[[float], Pair]) -> Pair | None:
            places = (way(n / PARTS) for n in range(PARTS, 0, -1))
            return next((place for place in places if keep_outs.allows(start, place, rests)), None)

        kept = stay or at
        (pan, tilt), (to_pan, to_tilt) = at, goal
        ways = (
            part(lambda share: (pan + share * (to_pan - pan), tilt + share * (to_tilt - tilt))),
            part(lambda share: (pan + share * (to_pan - pan), kept[1])),
            part(lambda share: (kept[0], tilt + share * (to_tilt - tilt))),
        )
        found = [one for one in ways if one is not None]
        return max(found, key=lambda one: abs(one[0] - pan) + abs(one[1] - tilt), default=at)

    def faults(self, reading: Reading | None) -> tuple[StandingFault, ...]:
        """Return what is wrong with the head's place, and a sun that is known no longer."""
        found = []
        sun = self._sun
        if sun is not None and sun.until_s is not None and not sun.holds(self._clock.now_s()):
            message = "the stated direction of the sun has expired, and nothing keeps the cameras off it"
            until = "another direction is stated, or none"
            found.append(StandingFault(SUN, "sun_not_known", message, sun.until_s, until))
        if reading is None:
            return tuple(found)
        holding = self._now().holding(Span.around((reading.pan_rad, reading.tilt_rad)))
        before_s = self._inside_s
        self._inside_s = {box.name: before_s.get(box.name, reading.time_s) for box in holding}
        for name, since_s in self._inside_s.items():
            code, message = "sun_in_view", "a head camera looks into the cone around the sun"
            until = "the head is moved out of it, or another direction of the sun is stated"
            if name != SUN:
                code, message = "in_keep_out", f"the head stands in the keep-out {name}"
                until = "it is moved out, the shortest way along one axis"
            found.append(StandingFault(name, code, message, since_s, until))
        return tuple(found)

    def in_the_way(self, reading: Reading | None) -> str | None:
        """Return the name of a keep-out that the head under way may enter, since it came later; else None.

        A head that is in it and goes out is let go.
        """
        keep_outs, sent = self._now(), self._sent
        if sent is None or reading is None:
            return None
        start, rests = self._start(reading)
        if rests:
            return None
        inside = {box.name for box in keep_outs.holding(Span.around((reading.pan_rad, reading.tilt_rad)))}
        ends_in = keep_outs.holding(self._round(sent.goal))
        passes = (box for box in keep_outs.holding(start) if box.name not in inside)
        return next((box.name for box in (*ends_in, *passes)), None)

    def sun_as_json(self) -> SunAnswer:
        """Return the sun as ``GET /limits/sun`` has it."""
        sun, now_s = self._sun, self._clock.now_s()
        if sun is None:
            return {"sun": None, "boxes": []}
        boxes = self._sun_boxes(self._rig, sun, self._rover_from_site) if sun.holds(now_s) else []
        stated: Any = as_json(sun)
        until_s = stated.pop("until_s")
        left_s = None if until_s is None else max(0.0, until_s - now_s)
        return {"sun": stated | {"left_s": left_s, "active": sun.holds(now_s)}, "boxes": as_json(boxes)}

    def _start(self, reading: Reading) -> tuple[Span, bool]:
        """Where the next move begins, and whether the head rests there."""
        at = Span.around((reading.pan_rad, reading.tilt_rad))
        sent = self._sent
        rests = not reading.moving and (sent is None or self._clock.now_s() - sent.at_s > REST_S)
        if rests:
            return at, True
        speed = self.limits.speed_rad_per_s if sent is None else sent.speed_rad_per_s
        far = self.braking_rad(speed) + speed * TRAVEL_S
        near = at.grown(far, far)
        if sent is None:
            return near, False
        start = (near if sent.within is None else near.overlap(sent.within)) or near
        return Span.around(*start.corners, *at.corners, sent.goal), False

    def _round(self, goal: Pair) -> Span:
        return Span.around(goal).grown(self._beyond[0], self._beyond[1])

    def _now(self) -> KeepOuts:
        """What is kept out at this moment; made anew when mast file, sun or rover have changed."""
        sun = self._sun if self._sun is not None and self._sun.holds(self._clock.now_s()) else None
        of = self._rig, sun, self._rover_from_site
        made = self._made
        if made is None or any(one is not other for one, other in zip(made[0], of, strict=True)):
            limits = self.limits
            # A copy of each box for every turn that the pan reaches, and for where a hand may have pushed it.
            reach = limits.pan_rad[0] - np.pi, limits.pan_rad[1] + np.pi
            boxes = (*limits.keep_out, *self._sun_boxes(*of))
            copies = tuple(copy for box in boxes for copy in box.within(reach))
            kept_out = KeepOuts(copies, limits.margin_rad, self._beyond, limits.pan_rad, limits.tilt_rad)
            made = self._made = of, kept_out
        return made[1]

    def _sun_boxes(self, rig: Rig | None, sun: SunDirection | None, rover_from_site: FloatArray) -> list[Box]:
        """The sun's cone as boxes of what the head reads there."""
        if sun is None or rig is None:
            return []
        direction = np.array(sun.direction)
        in_rover = direction if sun.frame == "rover" else rover_from_site @ direction
        slack = self.limits.margin_rad + self._beyond[1]
        low, high = self.limits.tilt_rad[0] - slack, self.limits.tilt_rad[1] + slack
        pan, tilt = rig.joints.pan, rig.joints.tilt
        true_tilts = tilt.true_rad(low, 1.0), tilt.true_rad(high, -1.0)
        return [
            Box(box.name, _as_read(pan, box.pan_rad), _as_read(tilt, box.tilt_rad))
            for box in sun_boxes(rig, in_rover, sun.half_angle_rad, true_tilts)
        ]


def _into(value: float, limits: Pair) -> float:
    return min(max(value, limits[0]), limits[1])


def _as_read(joint: AxisJoint, true_rad: Pair) -> Pair:
    """What an axis may read within an interval of true angles, from whichever side it came."""
    return joint.read_rad(true_rad[0], -1.0), joint.read_rad(true_rad[1], 1.0)


def _check_acceleration(most: float | None, stated: Mapping[str, AxisMotion], device: str) -> None:
    """Pass a head that speeds up no faster than the limits allow. Raises BadOptions."""
    if most is None:
        return
    for name, axis in stated.items():
        if axis.acceleration_rad_per_s2 > ROUNDED * most:
            raise BadOptions(
                f"limits.acceleration_rad_per_s2 is {most:g}, and {name} speeds up with "
                f"{axis.acceleration_rad_per_s2:.4g} rad/s2; set acceleration_rad_per_s2 of its driver "
                f"(pan_tilt.options, or simulation.head) to {most:g} or less",
                device=device,
            )
