"""Simulated pointings and hand-offs: a true rig sees, a believed one computes; no formula of the judge's."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.files.mast_file import StoredRig, load_rig
from calib.geometry.covariance import moved_rig, stored_covariance
from calib.geometry.handoff import Joints
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.geometry.stereo import triangulate
from calib.matching.handoff import Landed, MatchedHandoff
from mastctl.answers import MeasuredPointing
from mastctl.packaged import default_config

DAY_S = 86400.0
NOON_S = 20_000 * DAY_S + DAY_S / 2
COUNT_RAD = math.radians(0.003)
MATCH_PX = 0.05
CLICK_PX, LANDED_PX = 0.2, 0.4
NAVCAMS, HAZCAMS = ("navcam_left", "navcam_right"), ("hazcam_left", "hazcam_right")


def stored_rig() -> StoredRig:
    """The packaged mast file, which has a covariance."""
    return load_rig(Path(default_config()).parent / "masts" / "rocky8_simulated.yaml")


def honest(rig: Rig, rng: np.random.Generator) -> Rig:
    """Return a true rig of which the mast file says just how far it may be off."""
    known = stored_covariance(rig)
    assert known is not None
    step = rng.multivariate_normal(np.zeros(len(known.names)), known.covariance, method="eigh")
    return moved_rig(rig, known.names, step)


def bumped(rig: Rig, camera: str, turn_rad: tuple[float, float, float]) -> Rig:
    """Return the rig with a camera turned about its own place."""
    one = rig.cameras[camera]
    place = one.model.C
    rotation = Rotation.from_rotvec(turn_rad).as_matrix()
    model = one.model.moved(Rigid(rotation, place - rotation @ place))
    return replace(rig, cameras={**rig.cameras, camera: replace(one, model=model)})


def pointing(
    believed: StoredRig,
    true: Rig,
    rng: np.random.Generator,
    time_s: float,
    camera: str = "pancam_left",
    source: tuple[str, str] = ("navcam_left", "navcam_right"),
) -> MeasuredPointing:
    """One pointing: seen by a pair from one pose, aimed at with a camera, looked at from another pose."""
    rig = believed.rig
    while True:
        target = np.array([rng.uniform(2.0, 8.0), rng.uniform(-3.0, 3.0), rng.uniform(-0.4, 0.1)])
        best = solve(rig.mast, rig.cameras[source[0]].model, target.tolist())[0]
        before = best.pan_rad + rng.uniform(-0.2, 0.2), best.tilt_rad + rng.uniform(-0.1, 0.1)
        read = _read(before)
        clicks = [true.camera_in_rover(name, *before).project(target)[0] for name in source]
        clicks = [click + rng.normal(0.0, MATCH_PX, 2) for click in clicks]
        views = [rig.camera_in_rover(name, *read) for name in source]
        if not all(view.holds(click) for view, click in zip(views, clicks, strict=True)):
            continue
        point = triangulate(*views, *clicks, MATCH_PX)  # type: ignore[arg-type, call-arg]
        aimed = solve(rig.mast, rig.cameras[camera].model, point.position_m.tolist())[0]
        after = aimed.pan_rad + rng.uniform(-1e-3, 1e-3), aimed.tilt_rad + rng.uniform(-1e-3, 1e-3)
        found = true.camera_in_rover(camera, *after).project(target)[0] + rng.normal(0.0, MATCH_PX, 2)
        off = found - rig.camera_in_rover(camera, *_read(after)).project(point.position_m)[0]
        return {
            "time_s": time_s,
            "operation": "000001-aaaa",
            "confirmed": True,
            "mast_digest": believed.digest,
            "source": source[0],
            "partner": source[1],
            "camera": camera,
            "from_rad": list(read),
            "to_rad": list(_read(after)),
            "position_m": point.position_m.tolist(),
            "range_m": aimed.range_m,
            "residual_px": (found - rig.cameras[camera].model.image_center_px).tolist(),
            "off_px": off.tolist(),
            "match_sigma_px": [MATCH_PX, MATCH_PX],
            "count_rad": [COUNT_RAD, COUNT_RAD],
        }


def _read(angles: tuple[float, float]) -> tuple[float, float]:
    """What an encoder shows of angles."""
    pan, tilt = (round(angle / COUNT_RAD) * COUNT_RAD for angle in angles)
    return pan, tilt


def handed_over(believed: StoredRig, true: Rig, rng: np.random.Generator) -> MatchedHandoff:
    """A target on rough ground that goes from the Navcams to the Hazcams, and is found in both."""
    rig, far_m, aside = believed.rig, rng.uniform(1.5, 4.0), rng.uniform(-0.35, 0.35)
    point = np.array([far_m * np.cos(aside), far_m * np.sin(aside), rng.uniform(-0.25, 0.05)])
    at = math.atan2(point[1], point[0]), -0.6
    clicks = np.array([true.camera_in_rover(name, *at).project(point)[0] for name in NAVCAMS])
    clicks = clicks + rng.normal(0.0, CLICK_PX, (2, 2))
    seen = triangulate(*(rig.camera_in_rover(name, *at) for name in NAVCAMS), *clicks)  # type: ignore[arg-type, call-arg]
    landed = {}
    for name in HAZCAMS:
        expected = rig.camera_in_rover(name, *at).project(seen.position_m)[0]
        found = true.camera_in_rover(name, *at).project(point)[0] + rng.normal(0.0, LANDED_PX, 2)
        landed[name] = Landed(expected, 0.04 * np.eye(2), "accepted", "", found, 0.01 * np.eye(2))
    joints = Joints(*at, COUNT_RAD)
    time = "2026-01-01T00:00:00Z"
    return MatchedHandoff(time, believed.digest, NAVCAMS, joints, clicks, CLICK_PX, joints, landed)
