"""Hand-offs with known errors: plain CAHVOR arithmetic and SciPy's rotations, no code under test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.handoff import Joints
from calib.geometry.rig import Rig, RigCamera
from calib.matching.handoff import Landed, MatchedHandoff

Vectors = Mapping[str, np.ndarray]
HAZCAMS = ("hazcam_left", "hazcam_right")
NAVCAMS = ("navcam_left", "navcam_right")


def plain_rig(rig: Rig) -> Rig:
    """The rig with CAHVOR Hazcams (its own are CAHVORE): a formula of one line."""
    cameras = dict(rig.cameras)
    for name in HAZCAMS:
        own = cameras[name].model
        letters = {letter: getattr(own, letter) for letter in "CAHVO"}
        model = CameraModel("CAHVOR", own.size_px, **letters, R=np.array([0.0, 0.02, 0.01]))
        cameras[name] = RigCamera("rover", model)
    return replace(rig, cameras=cameras)


def vectors(rig: Rig, name: str, pan_rad: float = 0.0, tilt_rad: float = 0.0) -> dict[str, np.ndarray]:
    """C, A, H, V, O, R of a camera in the rover frame, the head turned by SciPy's rotations."""
    held = rig.cameras[name]
    own = {letter: np.array(getattr(held.model, letter)) for letter in "CAHVOR"}
    if held.on == "rover":
        return own
    mast = rig.mast
    fixed = Rotation.from_euler("XYZ", mast.rotation_rad)
    head = fixed * Rotation.from_euler("z", pan_rad) * Rotation.from_euler("y", tilt_rad)
    assert mast.axis_offset_m == mast.axis_twist_rad == 0.0
    return moved(own, head, np.asarray(mast.translation_m), np.zeros(3))


def moved(own: Vectors, turn: Rotation, shift_m: np.ndarray, about_m: np.ndarray) -> dict[str, np.ndarray]:
    """The camera turned about a point, then shifted."""
    out = {letter: turn.apply(own[letter]) for letter in "AHVO"}
    return out | {"C": turn.apply(own["C"] - about_m) + about_m + shift_m, "R": own["R"]}


def pixel(camera: Vectors, point_m: np.ndarray) -> np.ndarray:
    """Gennery's CAHVOR, as the paper's equation (5) and reference [11] have it."""
    d = point_m - camera["C"]
    zeta = d @ camera["O"]
    across = d - zeta * camera["O"]
    tau = across @ across / zeta**2
    seen = d + (camera["R"] @ np.array([1.0, tau, tau**2])) * across
    return np.array([camera["H"] @ seen, camera["V"] @ seen]) / (camera["A"] @ seen)


def targets(rng: np.random.Generator, count: int, ranges_m: tuple[float, float] = (1.5, 4.0)) -> np.ndarray:
    """Points on rough ground ahead of the rover (count, 3)."""
    far = rng.uniform(*ranges_m, count)
    aside = rng.uniform(-0.35, 0.35, count)
    return np.column_stack([far * np.cos(aside), far * np.sin(aside), rng.uniform(-0.25, 0.05, count)])


def hand_offs(
    true: Mapping[str, Vectors],
    rig: Rig,
    points_m: np.ndarray,
    rng: np.random.Generator,
    *,
    click_px: float = 0.2,
    match_px: float = 0.4,
    digest: str = "d" * 64,
) -> list[MatchedHandoff]:
    """Hand-offs from Navcams that are as in ``rig`` to Hazcams that are as in ``true``; noise as stated."""
    made = []
    for index, point in enumerate(points_m):
        pan, tilt = float(np.arctan2(point[1], point[0])), -0.6
        clicks = np.array([pixel(vectors(rig, name, pan, tilt), point) for name in NAVCAMS])
        clicks = clicks + rng.normal(0.0, click_px, (2, 2))
        landed = {
            name: Landed(
                np.zeros(2), np.eye(2), "accepted", "",
                pixel(true[name], point) + rng.normal(0.0, np.hypot(match_px, 0.1), 2), 0.01 * np.eye(2),
            )
            for name in HAZCAMS
        }  # fmt: skip
        made.append(
            MatchedHandoff(
                "2026-01-01T00:00:00Z", digest, NAVCAMS, Joints(pan, tilt), clicks, click_px,
                Joints(pan, tilt), landed, f"hand-off {index}",
            )
        )  # fmt: skip
    return made


def moved_hazcams(rig: Rig, turn: Rotation, shift_m: ArrayLike) -> dict[str, dict[str, np.ndarray]]:
    """The rig's Hazcams turned about the middle between them, then shifted."""
    own = {name: vectors(rig, name) for name in HAZCAMS}
    middle = np.mean([own[name]["C"] for name in HAZCAMS], axis=0)
    return {name: moved(own[name], turn, np.asarray(shift_m), middle) for name in HAZCAMS}


def with_found(one: MatchedHandoff, camera: str, off_px: Sequence[float]) -> MatchedHandoff:
    """The hand-off with one found pixel moved."""
    was = one.landed[camera]
    assert was.found_px is not None
    return replace(one, landed={**one.landed, camera: replace(was, found_px=was.found_px + np.array(off_px))})
