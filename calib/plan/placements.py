"""Where a board should be put next: places, described for a person, and the most informative of them.

A camera on the body is tied to the head by boards that both see. It does not move: however many pictures are
taken, each placement shows it the board once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from calib.adjust.solver import covariance_of
from calib.errors import CalibError, Unreachable
from calib.geometry.covariance import pixel_rates
from calib.geometry.rigid import FloatArray, Rigid
from calib.plan.knowledge import BenchShot, ExpectedPointing, Knowledge, without_board
from calib.plan.poses import Sought, readings, seen, shown

RANGES_M = (0.8, 1.2, 1.8, 2.6)
BEARINGS_DEG = (-50.0, -25.0, 0.0, 25.0, 50.0)
HEIGHTS_DEG = (-25.0, -8.0, 8.0)
TURNS_DEG = ((0.0, 0.0), (30.0, 0.0), (-30.0, 0.0), (0.0, 30.0), (0.0, -30.0))

PATTERN = ((0.5, 0.5), (0.2, 0.25), (0.8, 0.75), (0.8, 0.25), (0.2, 0.75))
"""Where in the picture the middle of a board is assumed to be, shot by shot."""


@dataclass(frozen=True)
class Placement:
    """A place for a board, as it is requested."""

    range_m: float  # from the head's axes to the board's middle
    bearing_deg: float  # to the right of pan zero
    height_deg: float  # above the height of the axes
    turned_deg: tuple[float, float] = (0.0, 0.0)
    """By how much its face is turned away from the head: to the head's right, and upwards."""

    def __str__(self) -> str:
        """The placement as one says it to a person."""
        side = _side(self.bearing_deg, "left", "right", "straight ahead")
        level = _side(self.height_deg, "below", "above", "")
        where = f"{side}, {level} the head's height" if level else f"{side} at the head's height"
        right, up = self.turned_deg
        sides = (("to the right", "to the left"), ("upwards", "downwards"))
        turned = [
            f"turned {abs(angle):.0f} degrees {names[int(angle <= 0)]}"
            for angle, names in zip((right, up), sides, strict=True)
            if abs(angle) >= 5
        ]
        return f"{where}, {self.range_m:.1f} m away, {' and '.join(turned) or 'facing the head'}"

    def rover_from_board(self, head_in_rover: Rigid) -> Rigid:
        """Return the pose (board: x right, y down, z into it) there, by the head's at zero angles."""
        bearing, height = math.radians(self.bearing_deg), math.radians(self.height_deg)
        sight = np.array(
            [math.cos(height) * math.cos(bearing), math.cos(height) * math.sin(bearing), -math.sin(height)]
        )
        # The normal of a board whose face is turned to the right points, away from the head, to the left of
        # the line of sight.
        yaw = bearing - math.radians(self.turned_deg[0])
        pitch = height - math.radians(self.turned_deg[1])
        into = np.array([math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), -math.sin(pitch)])
        right = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
        rotation = np.column_stack([right, np.cross(into, right), into])
        return head_in_rover @ Rigid(rotation, self.range_m * sight)


@dataclass(frozen=True)
class Advice:
    """A placement, and the rms per axis of pointing that a few shots of it would lead to, pixels."""

    placement: Placement
    expected_px: float


def _side(angle_deg: float, negative: str, positive: str, none: str) -> str:
    if abs(angle_deg) < 3.0:
        return none
    return f"{abs(angle_deg):.0f} degrees {negative if angle_deg < 0 else positive}"


def first_placement(known: Knowledge, sought: Sought) -> Placement:
    """Return where the first board should be put: ahead, near, with space about it, turned a bit."""
    bearing_deg, height_deg = _inside(0.0, sought.pan_limits_rad), _inside(0.0, sought.tilt_limits_rad)
    return Placement(_near_m(known, sought), bearing_deg, height_deg, (20.0, 0.0))


def _near_m(known: Knowledge, sought: Sought) -> float:
    """The smallest range at which the board fills no more than about half of the narrowest picture."""
    size = np.ptp(sought.in_board_m[:, :2], axis=0)
    need = [
        max(size[0] * np.linalg.norm(c.model.H) / c.model.size_px[0],
            size[1] * np.linalg.norm(c.model.V) / c.model.size_px[1]) / 0.55
        for c in known.rig.cameras.values() if c.on == "head"
    ]  # fmt: skip
    return float(round(max(0.5, *need), 1))


def _inside(bearing_deg: float, limits_rad: tuple[float, float]) -> float:
    low, high = (math.degrees(limit) for limit in limits_rad)
    return min(max(bearing_deg, low + 10.0), high - 10.0) if high - low > 20.0 else (low + high) / 2


def placements(known: Knowledge, sought: Sought) -> Iterator[Placement]:
    """Yield places that the head's cameras can see, at ranges where the board is informative."""
    near_m = _near_m(known, sought)
    width_m = float(np.ptp(sought.in_board_m[:, 0]))
    # 0.2: of the picture's width that a board should fill at least: farther away it shows little.
    far_m = min(
        width_m * float(np.linalg.norm(c.model.H)) / (0.2 * c.model.size_px[0])
        for c in known.rig.cameras.values() if c.on == "head"
    )  # fmt: skip
    ranges = [r for r in RANGES_M if near_m * 0.95 <= r <= max(far_m, near_m)] or [near_m]
    return _places(sought, ranges, HEIGHTS_DEG)


def _places(sought: Sought, ranges_m: Sequence[float], heights_deg: Sequence[float]) -> Iterator[Placement]:
    """Yield places at these ranges and heights in directions that are within the head's limits."""
    pan, tilt = np.degrees(sought.pan_limits_rad), np.degrees(sought.tilt_limits_rad)
    for range_m, bearing, height, turned in product(ranges_m, BEARINGS_DEG, heights_deg, TURNS_DEG):
        if pan[0] <= bearing <= pan[1] and tilt[0] <= height <= tilt[1]:
            yield Placement(range_m, bearing, height, turned)


def advise(
    known: Knowledge,
    sought: Sought,
    shots: Sequence[BenchShot],
    aim: ExpectedPointing,
    most: int = 90,
) -> Advice | None:
    """Return the placement of which a few shots are most informative, or None if none can be seen.

    ``most`` placements are tried, drawn by chance.
    """
    every = list(placements(known, sought))
    rng = np.random.default_rng(0)
    if len(every) > most:
        every = [every[k] for k in sorted(rng.choice(len(every), most, replace=False))]
    return _best(known, sought, shots, every, aim.rms_px)


def _best(
    known: Knowledge,
    sought: Sought,
    shots: Collection[BenchShot],
    tried: Iterable[Placement],
    left_px: Callable[[FloatArray], float],
) -> Advice | None:
    """The placement that leaves least by ``left_px`` of a covariance; None if none can be seen."""
    base = known.information(shots)
    found = [(one, information_of(known, sought, one)) for one in tried]
    advice = [Advice(one, left_px(covariance_of(base + added))) for one, added in found if added is not None]
    return min(advice, key=lambda one: one.expected_px, default=None)


def information_of(known: Knowledge, sought: Sought, placement: Placement) -> FloatArray | None:
    """Return the information of a pattern of shots of a board at a place; None of too few."""
    head = known.rig.mast.rover_from_head(0.0, 0.0)
    supposed = replace(known, boards={"": placement.rover_from_board(head)})
    camera = next(c for c in known.rig.cameras.values() if c.on == "head")
    width, height = camera.model.size_px
    added, middle = [], supposed.boards[""].translation_m
    for k, (x, y) in enumerate(PATTERN):
        try:
            pan, tilt = readings(known.rig, sought, camera.model, middle, (x * width, y * height))
        except (Unreachable, CalibError, ValueError):
            continue
        side = 0 if sought.one_sided else 1 if k % 2 else -1
        shot = seen(supposed, sought, BenchShot("", pan, tilt, (), side, side))
        if shot is not None:
            added.append(supposed.of_shot(shot))
    if len(added) < 3:
        return None
    return without_board(np.sum(added, axis=0))


BODY_HEIGHTS_DEG = (-60.0, -50.0, -40.0, -30.0, -15.0)
"""Body cameras mostly look down, at what is near."""


GRID = 5
"""Where a body camera's pixels are judged: so far away, in so many rows and columns."""

FEWEST = 2
"""Placements that a body camera has to see: of one, focal length and distance trade for each other."""


def body_cameras(known: Knowledge) -> tuple[str, ...]:
    """Return the names of the cameras on the body."""
    return tuple(name for name, camera in known.rig.cameras.items() if camera.on == "rover")


def body_px(known: Knowledge, covariance: FloatArray, camera: str) -> float:
    """Return what a body camera's pixels of points 2 m away are off by, rms per axis.

    ``covariance`` is that of ``known.names``.
    """
    model = known.rig.cameras[camera].model
    x, y = np.meshgrid(*((np.arange(GRID) + 0.5) / GRID * size for size in model.size_px))
    rays = model.ray(np.stack([x.ravel(), y.ravel()], axis=-1))
    points = rays.origins_m[rays.valid] + 2.0 * rays.directions[rays.valid]
    rates = pixel_rates(known.rig, known.names, camera, 0.0, 0.0, points).to_rig
    rates = rates[np.isfinite(rates).all(axis=(1, 2))]
    return float(np.sqrt(np.mean(np.einsum("nip,pq,niq->ni", rates, covariance, rates))))


def advise_for_body(
    known: Knowledge, sought: Sought, shots: Collection[BenchShot], cameras: Collection[str]
) -> Advice | None:
    """Return the most informative placement for some body cameras, or None if none shows them a board that
    the head can see. ``expected_px`` is the error of their pixels afterwards."""
    head = known.rig.mast.rover_from_head(0.0, 0.0)
    # 0.3: how far below a body camera the middle of a board is assumed to fit over the ground.
    lowest_m = max(known.rig.cameras[name].model.C[2] for name in body_cameras(known)) + 0.3
    by_count: dict[int, list[Placement]] = {}
    for placement in _places(sought, RANGES_M, BODY_HEIGHTS_DEG):
        pose = placement.rover_from_board(head)
        if pose.translation_m[2] <= lowest_m:
            supposed, shot = replace(known, boards={"": pose}), BenchShot("", 0.0, 0.0, ())
            see = [shown(supposed, sought, shot, name).sum() >= sought.least for name in cameras]
            by_count.setdefault(sum(see), []).append(placement)

    def left_px(covariance: FloatArray) -> float:
        return float(np.mean([body_px(known, covariance, name) for name in cameras]))

    # The more of the cameras see the board the better.
    for count in sorted(by_count.keys() - {0}, reverse=True):
        if advice := _best(known, sought, shots, by_count[count], left_px):
            return advice
    return None
