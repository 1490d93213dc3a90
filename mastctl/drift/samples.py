"""What pointings and hand-offs measured of the mast file, and how far off each may be.

A sample is a target whose position a pair of cameras gave, and the pixel at which a camera then showed it.
``off_px`` is where the image shows the target, less where position, mast file and *measured* joint angles put
it. A servo that stops a count short is a matter of the servo, not of the calibration.

    source      a sample is              its sigma                                what it shows
    pointing    the measured residual    matches, counts, the mast file's own     turns of cameras on the head
    hand-off    each camera's match      the same, and relief between the views   those of body cameras too
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import TypeAdapter

from calib.errors import CalibError
from calib.files.mast_file import StoredRig
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import JOINT_NAMES, click_rates, pixel_rates
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, tangents
from calib.geometry.stereo import triangulate
from calib.matching.handoff import MODEL_PX, MatchedHandoff
from drivers.interfaces import COARSE_COUNT_RAD
from mastctl.answers import MeasuredPointing
from mastctl.control.operations import Operation

DISAGREE = "eyes_disagree"
HANDOFF = "hand-off"
"""In place of an operation's id."""

CLICK_SIGMA_PX = 0.1
"""One sigma of a match in each camera of a pair that pointed."""
UNMODELLED_PX = 0.1
"""What no camera model describes and no match knows of, one sigma: another at each place of an image."""

sample_of = TypeAdapter(MeasuredPointing).validate_python
"""Returns the sample of a line of the journal; raises ValueError for anything else."""


def pointing_sample(operation: Operation, mast: StoredRig, time_s: float) -> MeasuredPointing | None:
    """Return what a pointing that has ended measured; None if it was none, or measured nothing.

    One that failed because another camera did not confirm the measurement counts too: a bumped camera does
    that. Of two pointings at one target the first counts; the second starts from the first one's result.
    """
    pixel = operation.request.get("pixel")
    confirmed = operation.state == "done"
    if not isinstance(pixel, Mapping) or not (confirmed or (operation.error or {}).get("code") == DISAGREE):
        return None
    source, rig = str(pixel.get("camera")), mast.rig
    partners = [a if source == b else b for a, b in rig.stereo.values() if source in (a, b)]
    steps = {step["name"]: step["detail"] for step in reversed(operation.steps)}  # the first of each name
    try:
        rest, seen, settled, found = (steps[name] for name in ("rest", "triangulate", "settle", "measure"))
        found = steps.get("repeat", found)
        to_rad = [settled["true_pan_rad"], settled["true_tilt_rad"]]
        view = rig.camera_in_rover(found["camera"], *to_rad)
        predicted = view.project(seen["position_m"])[0].tolist()
        counts = settled.get("count_rad", {})
        return sample_of(
            {
                "time_s": time_s,
                "operation": operation.id,
                "confirmed": confirmed,
                "mast_digest": mast.digest,
                "source": source,
                "partner": partners[0],
                "camera": found["camera"],
                "from_rad": [rest["true_pan_rad"], rest["true_tilt_rad"]],
                "to_rad": to_rad,
                "position_m": seen["position_m"],
                "range_m": math.dist(seen["position_m"], view.C.tolist()),
                "residual_px": found["residual_px"],
                "off_px": [a - b for a, b in zip(found["pixel_px"], predicted, strict=True)],
                "match_sigma_px": found["sigma_px"],
                "count_rad": [counts.get(axis, COARSE_COUNT_RAD) for axis in ("pan", "tilt")],
            }
        )
    except (LookupError, TypeError, ValueError):  # it did not come so far, or could not measure a number
        return None


def handoff_samples(handoff: MatchedHandoff, mast: StoredRig, time_s: float) -> list[MeasuredPointing]:
    """Return one sample of each camera in which a hand-off found its target; none of another mast file."""
    rig, found = mast.rig, handoff.found
    if handoff.mast_digest != mast.digest:
        return []
    joints, to_joints = handoff.joints, handoff.to_joints
    samples = []
    try:
        pair = [rig.camera_in_rover(name, joints.pan_rad, joints.tilt_rad) for name in handoff.pair]
        position_m = triangulate(pair[0], pair[1], *handoff.clicks_px).position_m
        for camera, landed in found.items():
            assert landed.found_px is not None and landed.found_covariance_px2 is not None
            view = rig.camera_in_rover(camera, to_joints.pan_rad, to_joints.tilt_rad)
            off_px = (landed.found_px - view.project(position_m)[0]).tolist()
            sigma_px = np.sqrt(np.diag(landed.found_covariance_px2) + MODEL_PX**2)
            sample = {
                "time_s": time_s,
                "operation": HANDOFF,
                "confirmed": True,
                "mast_digest": mast.digest,
                "source": handoff.pair[0],
                "partner": handoff.pair[1],
                "camera": camera,
                "from_rad": [joints.pan_rad, joints.tilt_rad],
                "to_rad": [to_joints.pan_rad, to_joints.tilt_rad],
                "position_m": position_m.tolist(),
                "range_m": float(np.linalg.norm(position_m - view.C)),
                "residual_px": off_px,
                "off_px": off_px,
                "match_sigma_px": sigma_px.tolist(),
                "count_rad": 2 * [joints.sigma_rad * math.sqrt(12.0)],
                # cameras that share their clicks are samples by themselves if these vary so many times more
                "click_sigma_px": handoff.sigma_px * math.sqrt(len(found)),
            }
            samples.append(sample_of(sample))
    except (CalibError, LookupError, ValueError):  # the mast file lacks a camera, or the rays do not meet
        return []
    return samples


def expected(
    rig: Rig, parameters: Sequence[str], cameras: Sequence[str], one: MeasuredPointing
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what a sample's ``off_px`` depends on.

    First (2, 2) its noise, px²: what differs from sample to sample, matches and counts. Then (2, p) its rates
    by each of the ``parameters``, names as `calib.geometry.covariance` has them. Last (2, 3 c) px/rad by a
    turn of each of the ``cameras`` about x, y and z of the frame that it is mounted on. Raises CalibError if
    the rig lacks a camera of it, or cannot have seen the target so.
    """
    pair, involved = (one["source"], one["partner"]), {one["source"], one["partner"], one["camera"]}
    if missing := involved - set(rig.cameras):
        raise CalibError(f"the mast file has no camera {min(missing)}")
    known = set(parameters)
    free = [
        f"cameras.{name}.{part}"
        for name in involved
        for part in parameter_names(rig.cameras[name].model.kind)
    ]
    names = (*parameters, *(name for name in free if name not in known), *JOINT_NAMES)
    point = np.array(one["position_m"])
    (from_pan, from_tilt), (to_pan, to_tilt) = one["from_rad"], one["to_rad"]
    views = [rig.camera_in_rover(name, from_pan, from_tilt).project_jacobian(point)[1] for name in pair]
    if not np.isfinite(views).all():
        raise CalibError("the pair cannot have seen the target of the sample")
    position_rates = np.linalg.pinv(np.concatenate(views))  # (3, 4) m/px of the pair's clicks
    by_click = rig.camera_in_rover(one["camera"], to_pan, to_tilt).project_jacobian(point)[1] @ position_rates
    before = by_click @ click_rates(rig, names, pair, from_pan, from_tilt, point)
    after = pixel_rates(rig, names, one["camera"], to_pan, to_tilt, point[None]).to_rig[0]
    joints = np.concatenate([before[:, -2:], after[:, -2:]], axis=1)
    sigma_rad = np.array(2 * one["count_rad"]) / math.sqrt(12.0)
    noise = (
        np.diag(np.square(one["match_sigma_px"]) + UNMODELLED_PX**2)
        + one.get("click_sigma_px", CLICK_SIGMA_PX) ** 2 * by_click @ by_click.T
        + (joints * sigma_rad) @ (joints * sigma_rad).T
    )
    rates = before + after
    if not (np.isfinite(rates).all() and np.isfinite(noise).all()):
        raise CalibError("the target of the sample is nowhere that its cameras see")
    at = {name: i for i, name in enumerate(names)}
    turned = np.zeros((2, 3 * len(cameras)))
    for number, camera in enumerate(cameras):
        if camera in involved:
            model = rig.cameras[camera].model
            mine = [at[f"cameras.{camera}.{part}"] for part in parameter_names(model.kind)]
            turned[:, 3 * number : 3 * number + 3] = rates[:, mine] @ _turn_rates(model)
    return noise, rates[:, : len(parameters)], turned


def _turn_rates(model: CameraModel) -> FloatArray:
    """(p, 3) of a camera's parameters to a turn about its own place, by the axes of the model's frame."""
    rates = np.zeros((len(parameter_names(model.kind)), 3))
    for letter in dict.fromkeys(model.letters):
        if letter in "CRED":
            continue
        x, y, z = getattr(model, letter)
        follows = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # of turn x letter
        if letter in "AO":
            follows = tangents(getattr(model, letter)) @ follows
        rates[parameter_part(model.kind, letter)] = follows
    return rates
