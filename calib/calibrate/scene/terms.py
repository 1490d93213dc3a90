"""Views of a still scene, and what they may correct in a rig: numbers, in terms that enter together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.geometry.cahvor import SPLINED, CameraModel
from calib.geometry.rig import JOINTS_NAMES, UNKNOWN, Approach, Rig, joints_of
from calib.geometry.rig import joint_numbers_of as joint_numbers
from calib.geometry.rigid import FloatArray
from calib.matching.warp import Grey

FARTHEST_M, NEAREST_M = 1e3, 1.5
LEAST_OVERLAP = 0.02
ASIDE_RAD = 0.5
"""By how much what is near looks to be elsewhere for a camera beside or below."""

_GRID = 12


@dataclass(frozen=True, eq=False)
class SceneView:
    """One picture of the scene.

    Attributes
    ----------
    name, camera
        Of the picture, and of its camera in the rig.
    image
        (h, w) grey.
    pan_rad, tilt_rad, approach
        What the joints read, and from which side they came to rest.
    pose
        Number of the head's rest; pictures of several cameras share one.
    """

    name: str
    camera: str
    image: Grey
    pan_rad: float
    tilt_rad: float
    pose: int
    approach: Approach = UNKNOWN

    def model(self, rig: Rig) -> CameraModel:
        """Return the camera in the rover frame as a rig has it."""
        return rig.camera_in_rover(
            self.camera, *rig.joints.true_rad((self.pan_rad, self.tilt_rad), self.approach)
        )


def overlapping(models: Sequence[CameraModel]) -> dict[tuple[int, int], float]:
    """Return by which part pictures overlap, of cameras in the rover frame; for those that do at all."""
    ahead = np.array([model.A for model in models])
    half = np.array([_half_width_rad(model) for model in models])
    apart = np.arccos(np.clip(ahead @ ahead.T, -1.0, 1.0))
    found = {}
    for first, second in np.argwhere(np.triu(apart < half[:, None] + half + ASIDE_RAD, 1)).tolist():
        one, other = models[first], models[second]
        part = max(overlap(one, other), overlap(other, one))
        if part >= LEAST_OVERLAP:
            found[first, second] = part
    return found


def _half_width_rad(model: CameraModel) -> float:
    """How far a picture's corner is from A."""
    x, y = np.array(model.size_px) - 1.0
    rays = model.ray(np.array([[0.0, 0.0], [x, 0.0], [0.0, y], [x, y]]))
    seen = rays.directions[rays.valid]
    return float(np.arccos(np.clip(seen @ model.A, -1.0, 1.0)).max()) if len(seen) == 4 else np.pi


def overlap(one: CameraModel, other: CameraModel) -> float:
    """Return the part of ``one``'s picture that ``other`` sees, at the better of a near and a far range."""
    width, height = one.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    rays = one.ray(np.stack([x.ravel(), y.ravel()], axis=1))
    best = 0.0
    for range_m in (4.0, FARTHEST_M):
        pixels, valid = other.project(rays.origins_m + range_m * rays.directions)
        size = np.array(other.size_px)
        with np.errstate(invalid="ignore"):
            inside = valid & rays.valid & ((pixels >= 0) & (pixels <= size - 1)).all(axis=1)
        best = max(best, float(inside.mean()))
    return best


PRIOR = {"turn": 0.02, "scale": 0.01, "r1": 0.02, "mast": 0.005, "joints": 0.005}
"""Sigma of each kind of number beforehand: radians, part of the focal length, R1."""

LEAST_RESTS, LEAST_SPAN_RAD = 5, 1.0
"""How many readings over how wide an angle tell what an axis reads wrong in the course of a turn."""

LEAST_RESTS_TWICE, LEAST_SPAN_TWICE_RAD = 8, 2.0
"""How many over how wide an angle tell what it reads wrong twice a turn from that."""

LEAST_A_SIDE = 4
"""Rests from either side that tell an axis's backlash."""


SAME_READING_RAD = 0.01
"""Rests whose readings of a joint have no such gap between them read the same."""


@dataclass(frozen=True)
class Term:
    """Numbers of the rig that enter together: their names, what they are in words, and after which others.

    ``play_of`` is the joint, ``pan`` or ``tilt``, whose play the number is.
    """

    names: tuple[str, ...]
    words: str
    after: str = ""
    play_of: str = ""


def terms_of(rig: Rig, views: Sequence[SceneView]) -> tuple[Term, ...]:
    """Return what pictures at these angles may correct."""
    found = []
    for name in sorted({view.camera for view in views if rig.cameras[view.camera].on == "head"}):
        camera = f"cameras.{name}"
        found.append(Term(tuple(f"{camera}.turn.{axis}" for axis in "xyz"), f"{name} turned in the head"))
        found.append(Term((f"{camera}.scale",), f"{name} has another focal length"))
        if rig.cameras[name].model.kind not in ("CAHV", SPLINED):
            found.append(Term((f"{camera}.r1",), f"{name}'s lens bends otherwise"))
    found.append(Term(("mast.axis_twist_rad",), "the tilt axis leans against the pan axis"))
    rests = {view.pose: (view.pan_rad, view.tilt_rad, *view.approach) for view in views}
    pan, tilt, pan_side, tilt_side = np.array(list(rests.values())).T
    for axis, read, side in (("pan", pan, pan_side), ("tilt", tilt, tilt_side)):
        joint, many = f"joints.{axis}", int(alike(read).max()) + 1
        once, twice = (f"{axis} reads wrong {often} a turn" for often in ("once", "twice"))
        if many >= LEAST_RESTS and np.ptp(read) >= LEAST_SPAN_RAD:
            found.append(Term((f"{joint}.c1", f"{joint}.s1"), once))
        if many >= LEAST_RESTS_TWICE and np.ptp(read) >= LEAST_SPAN_TWICE_RAD:
            found.append(Term((f"{joint}.c2", f"{joint}.s2"), twice, after=once))
        if min((side > 0).sum(), (side < 0).sum()) >= LEAST_A_SIDE:
            found.append(Term((f"{joint}.backlash_rad",), f"{axis} has play", play_of=axis))
    return tuple(found)


def alike(readings_rad: FloatArray) -> NDArray[np.intp]:
    """Return the numbers (n,) of readings (n,) in order of size, from 0, those that read the same alike."""
    order = np.argsort(readings_rad)
    numbers = np.empty(len(order), dtype=np.intp)
    numbers[order] = np.cumsum(np.diff(readings_rad[order], prepend=-np.inf) > SAME_READING_RAD) - 1
    return numbers


def prior_of(name: str) -> float:
    """Return a number's sigma beforehand."""
    parts = name.split(".")
    return PRIOR[parts[2] if parts[0] == "cameras" else parts[0]]


def corrected(rig: Rig, names: Sequence[str], values: FloatArray) -> Rig:
    """Return a rig with numbers added: turns about C in the head frame, twist, joints' errors; radians."""
    cameras = dict(rig.cameras)
    numbers = joint_numbers(rig.joints)
    twist = rig.mast.axis_twist_rad
    turns: dict[str, FloatArray] = {}
    lenses: dict[str, dict[str, float]] = {}
    for name, value in zip(names, values, strict=True):
        if name == "mast.axis_twist_rad":
            twist += float(value)
        elif name in JOINTS_NAMES:
            numbers[JOINTS_NAMES.index(name)] += value
        elif ".turn." not in name:
            _, camera, number = name.split(".")
            lenses.setdefault(camera, {})[number] = float(value)
        else:
            camera, axis = name.removeprefix("cameras.").split(".turn.")
            turns.setdefault(camera, np.zeros(3))["xyz".index(axis)] = value
    for camera, turn in turns.items():
        held = cameras[camera]
        cameras[camera] = replace(held, model=held.model.turned(turn))
    for camera, numbers_of_lens in lenses.items():
        held = cameras[camera]
        cameras[camera] = replace(held, model=lensed(held.model, **numbers_of_lens))
    mast = replace(rig.mast, axis_twist_rad=twist)
    return replace(rig, cameras=cameras, mast=mast, joints=joints_of(numbers))


def lensed(model: CameraModel, scale: float = 0.0, r1: float = 0.0) -> CameraModel:
    """Return a camera of a focal length longer by a part ``scale`` of itself, R1 or k1 larger by ``r1``."""
    return model.zoomed(scale).bent(0, r1)
