"""The covariance that a mast file carries, and a rig moved along it.

A calibration leaves ``fit.parameters`` and ``fit.covariance`` in the mast file
(docs/how-to/calibrate.md). The parameters are ``mast.KEY.x``, ``joints.pan.c1``
(`calib.geometry.rig`) and ``cameras.NAME.C.x``, as `calib.geometry.parameters` orders a camera's step.

How pixels, and the clicks of a point, depend on these parameters and on the joints (``JOINT_NAMES``) is in
closed form, by the derivatives of the camera (`calib.geometry.parameters`) and of the mast
(`calib.geometry.rig`).

Whether two clicks mean one point follows: two rays have four coordinates and a point three. What is left
over, how far the rays pass each other, is one number that is zero but for noise; its square over the variance
that clicks and rig give it is chi-square with one degree of freedom. Along the epipolar line nothing can be
tested: there every pixel is a point at another range.

A target is clicked in a pair of cameras at one attitude of the head, ranged by it, and brought to a wanted
pixel by the closed form. Errors of the rig's parameters move the ranged place p, and the direction in which
the head then points. With the picture of the landing as truth the residual e is, to first order,

    e = -(d pixel / d rig + d pixel / d p . d p / d rig),    d p / d rig = -d p / d clicks . d clicks / d rig,

so that errors which ranging and pointing share cancel (`landing_rates`). A single camera is given the range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibError, NoStereoPoint
from calib.geometry.cahvor import CameraModel
from calib.geometry.mode import Mode, in_mode, sensor_mode_after
from calib.geometry.parameters import parameter_names, predict, stepped
from calib.geometry.pointing import solve
from calib.geometry.rig import (
    JOINTS_NAMES,
    MAST_NAMES,
    UNKNOWN,
    Approach,
    Rig,
    gimbal,
    joint_numbers_of,
    joint_twists,
    joints_of,
    mast_of,
    numbers_of,
)
from calib.geometry.rigid import FloatArray, ReadOnlyArrays, crossed_rows, frozen_array
from calib.geometry.stereo import Triangulation, triangulate

ROUNDING = 1e-4
"""Of one: what a stored correlation may be off by, as where a file was written with few digits."""

_MAST = tuple(f"mast.{name}" for name in MAST_NAMES)


@dataclass(frozen=True, eq=False)
class RigCovariance(ReadOnlyArrays):
    """How sure a rig's parameters are: ``names`` (p,) and ``covariance`` (p, p), in the names' units.

    ValueError if that is not (p, p), finite, and without negative variances.
    """

    names: tuple[str, ...]
    covariance: FloatArray

    def __post_init__(self) -> None:
        size = len(self.names)
        object.__setattr__(self, "covariance", frozen_array(self.covariance, (size, size)))
        if (np.diag(self.covariance) < 0.0).any():
            raise ValueError("a covariance with a negative variance is none")

    def of(self, cameras: Sequence[str]) -> RigCovariance:
        """Return the part of the mast, of the joints and of some cameras."""
        wanted = tuple(f"cameras.{name}." for name in cameras)
        kept = [i for i, name in enumerate(self.names) if name.startswith(("mast.", "joints.", *wanted))]
        return RigCovariance(tuple(self.names[i] for i in kept), self.covariance[np.ix_(kept, kept)])

    def among(self, names: Sequence[str]) -> FloatArray:
        """Return the covariance (k, k) of other names in their order; names not here are exact."""
        at = {name: i for i, name in enumerate(self.names)}
        theirs = [i for i, name in enumerate(names) if name in at]
        mine = [at[names[i]] for i in theirs]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(theirs, theirs)] = self.covariance[np.ix_(mine, mine)]
        return covariance


def stored_covariance(rig: Rig) -> RigCovariance | None:
    """Return the covariance of a rig's mast file, or None if it has none.

    Raises CalibError if ``fit.parameters`` and ``fit.covariance`` do not fit each other or the rig.
    """
    if "covariance" not in rig.fit or "parameters" not in rig.fit:
        return None
    known = {
        *_MAST,
        *JOINTS_NAMES,
        *(f"cameras.{n}.{p}" for n, c in rig.cameras.items() for p in parameter_names(c.model.kind)),
    }
    names = rig.fit["parameters"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CalibError("fit.parameters of the mast file is not a list of names")
    if strange := [name for name in names if name not in known]:
        raise CalibError(f"fit.parameters of the mast file names {strange[0]!r}, which the rig does not have")
    try:
        stored = RigCovariance(tuple(names), rig.fit["covariance"])
    except (TypeError, ValueError):
        raise CalibError(
            f"fit.covariance of the mast file is not {len(names)} rows of {len(names)} numbers with a "
            "positive diagonal, as many as fit.parameters names"
        ) from None
    scale = np.sqrt(np.diag(stored.covariance))
    scale[scale == 0.0] = 1.0
    scaled = stored.covariance / np.outer(scale, scale)
    least = np.linalg.eigvalsh(scaled).min(initial=0.0)
    if least < -ROUNDING or np.abs(scaled - scaled.T).max(initial=0.0) > ROUNDING:
        raise CalibError(
            "fit.covariance of the mast file is none: it is not symmetric, or some direction has a negative "
            "variance"
        )
    return stored


def moved_rig(rig: Rig, names: Sequence[str], step: FloatArray) -> Rig:
    """Return the rig with the named parameters moved by ``step`` (p,), in the names' units."""
    at = dict(zip(names, step.tolist(), strict=True))
    numbers = numbers_of(rig.mast) + np.array([at.get(name, 0.0) for name in _MAST])
    joints = rig.joints
    if any(at.get(name, 0.0) for name in JOINTS_NAMES):
        joints = joints_of(joint_numbers_of(joints) + np.array([at.get(name, 0.0) for name in JOINTS_NAMES]))
    cameras = dict(rig.cameras)
    for name, camera in rig.cameras.items():
        mine = [f"cameras.{name}.{part}" for part in parameter_names(camera.model.kind)]
        if any(at.get(part, 0.0) for part in mine):
            model = stepped(camera.model, np.array([at.get(part, 0.0) for part in mine]))
            cameras[name] = replace(camera, model=model)
    return replace(rig, mast=mast_of(numbers), joints=joints, cameras=cameras)


JOINT_NAMES = ("pan_rad", "tilt_rad")

_HEAD_NAMES = (*_MAST, *JOINT_NAMES, *JOINTS_NAMES)
"""What moves a head."""


def camera_rates(model: CameraModel, points_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixels (n, 2) of points (n, 3), in the frame that a camera is in, and what they depend on.

    First the camera's step (2, s, n), then a motion (2, 6, n) of all points: a turn about the origin of that
    frame, and a shift.
    """
    seen = predict(model, points_m)
    by_point = seen.d_points.transpose(1, 2, 0)
    by_motion = np.concatenate([crossed_rows(points_m.T, by_point), by_point], axis=1)
    return seen.pixels_px, seen.d_step.transpose(1, 2, 0), by_motion


class PixelRates(NamedTuple):
    """Pixels (n, 2) of points (n, 3), d pixel / d parameter (n, 2, p) and d pixel / d point (n, 2, 3)."""

    pixels_px: FloatArray
    to_rig: FloatArray
    to_points: FloatArray


def pixel_rates(
    rig: Rig,
    names: Sequence[str],
    camera: str,
    pan_rad: float,
    tilt_rad: float,
    points_m: FloatArray,
    approach: Approach = UNKNOWN,
) -> PixelRates:
    """Return pixels of rover-frame points (n, 3) and how they depend on named parameters and the points.

    ``names`` (p,) are ``mast.KEY.x``, ``joints.pan.c1`` (the readings fixed), ``cameras.NAME.C.x``,
    ``pan_rad`` and ``tilt_rad``; what is not among them is fixed. The angles are true ones; from which side
    the axes came there says how the backlash matters.
    """
    mounted = rig.cameras[camera]
    at = {name: i for i, name in enumerate(names)}
    out = np.zeros((2, len(names), len(points_m)))
    if mounted.on == "rover":
        pixels_px, by_step, by_motion = camera_rates(mounted.model, points_m)
        to_points = by_motion[:, 3:].transpose(2, 0, 1)
    else:
        head = gimbal(numbers_of(rig.mast), pan_rad, tilt_rad)
        in_head = (points_m - head.translation_m) @ head.rotation
        pixels_px, by_step, by_motion = camera_rates(mounted.model, in_head)
        to_points = by_motion[:, 3:].transpose(2, 0, 1) @ head.rotation.T
        twists = head.twists
        if any(name in at for name in JOINTS_NAMES):
            read_rad = rig.joints.read_rad((pan_rad, tilt_rad), approach)
            twists = np.concatenate([twists, joint_twists(head, rig.joints, read_rad, approach)[:-2]])
        free = [i for i, name in enumerate(_HEAD_NAMES) if name in at]
        # The head carries the camera: points move the other way before it.
        out[:, [at[_HEAD_NAMES[i]] for i in free]] = -head.in_head(twists[free]) @ by_motion
    mine = [f"cameras.{camera}.{part}" for part in parameter_names(mounted.model.kind)]
    known = [i for i, name in enumerate(mine) if name in at]
    out[:, [at[mine[i]] for i in known]] = by_step[:, known]
    return PixelRates(pixels_px, out.transpose(2, 0, 1), to_points)


def click_rates(
    rig: Rig,
    names: Sequence[str],
    cameras: Sequence[str],
    pan_rad: float,
    tilt_rad: float,
    position_m: FloatArray,
    approach: Approach = UNKNOWN,
) -> FloatArray:
    """Return (2k, p): how far the clicks of a point in k cameras seem shifted as parameters change.

    A model that moves its pixel of a point by something puts a click's ray where a click moved the other way
    would. That is exact where the rays meet; where they pass each other it leaves out a part as small as
    their gap beside the baseline.
    """
    point = position_m[None]
    return -np.concatenate(
        [pixel_rates(rig, names, camera, pan_rad, tilt_rad, point, approach).to_rig[0] for camera in cameras]
    )


def click_covariance(
    rig: Rig,
    cameras: Sequence[str],
    pan_rad: float,
    tilt_rad: float,
    position_m: FloatArray,
    *,
    sigma_px: float,
    sigma_rad: float = 0.0,
    calibration: RigCovariance | None = None,
    model_px: float | None = None,
) -> FloatArray:
    """Return the covariance (2k, 2k), px², of a point's clicks in k cameras and of all that is off with them.

    ``position_m`` (3,) is the point, rover frame; ``sigma_px`` that of each pixel coordinate of a click,
    ``sigma_rad`` of each joint reading. The rig is exact without a ``calibration``. ``model_px`` is what
    camera models are wrong by beside that; those of which the calibration says nothing then by ``RIG_PX``.
    """
    total = sigma_px * sigma_px * np.eye(2 * len(cameras))
    known = calibration.of(cameras) if calibration else RigCovariance((), np.zeros((0, 0)))
    names, size = (*known.names, *JOINT_NAMES), len(known.names)
    rates = click_rates(rig, names, cameras, pan_rad, tilt_rad, position_m)
    by_rig, turned = rates[:, :size], rates[:, size:]
    total += by_rig @ known.covariance @ by_rig.T + sigma_rad * sigma_rad * (turned @ turned.T)
    if model_px is not None:
        unknown = _unknown(cameras, calibration)
        total += np.diag(np.repeat([RIG_PX**2 if name in unknown else model_px**2 for name in cameras], 2))
    return np.asarray(total)


def _unknown(cameras: Sequence[str], calibration: RigCovariance | None) -> list[str]:
    """Cameras of whose errors a rig's covariance says nothing: all if there is none."""
    names = calibration.names if calibration else ()
    return [one for one in cameras if not any(name.startswith(f"cameras.{one}.") for name in names)]


def place_rates(
    rig: Rig,
    names: Sequence[str],
    cameras: Sequence[str],
    pan_rad: float,
    tilt_rad: float,
    position_m: FloatArray,
    approach: Approach = UNKNOWN,
) -> tuple[FloatArray, FloatArray]:
    """Return how a point (3,) that a stereo pair shows, or one camera that is given the range, would move:
    with its clicks in k cameras (3, 2k), and with parameters (3, p).

    Raises CalibError if a camera does not see the point.
    """
    point = position_m[None]
    seen = [pixel_rates(rig, names, camera, pan_rad, tilt_rad, point, approach) for camera in cameras]
    for camera, one in zip(cameras, seen, strict=True):
        if not (np.isfinite(one.pixels_px).all() and np.isfinite(one.to_rig).all()):
            raise CalibError(f"camera {camera} does not see the target at {position_m.round(3).tolist()} m")
    models = [rig.camera_in_rover(camera, pan_rad, tilt_rad) for camera in cameras]
    if len(cameras) == 1:
        along = models[0].ray(seen[0].pixels_px[0]).directions
        to_clicks = np.linalg.inv(np.vstack([seen[0].to_points[0], along]))[:, :2]
    else:
        left_px, right_px = (one.pixels_px[0] for one in seen)
        to_clicks = triangulate(models[0], models[1], left_px, right_px).rates_m_per_px
    return to_clicks, -to_clicks @ np.concatenate([one.to_rig[0] for one in seen])


def landing_rates(
    rig: Rig,
    names: Sequence[str],
    cameras: Sequence[str],
    pan_rad: float,
    tilt_rad: float,
    target_m: FloatArray,
    approaches: tuple[Approach, Approach] = (UNKNOWN, UNKNOWN),
) -> tuple[FloatArray, FloatArray]:
    """Return how a target's landing in the middle of the first camera's image depends on what may be off:
    pixels for errors of the named parameters (2, p), and pixels a radian (2, 4) for pan and tilt at the
    click, and at the landing.

    ``names`` (p,) are parameters of the rig that may be off (`pixel_rates`), ``cameras`` those of the head in
    which the target (3,), rover frame, is clicked at true angles: a pair, left one first, or one camera that
    is given the range. ``approaches`` say from where the axes came to the click, and to the landing. Raises
    CalibError if a camera does not see the target, or it cannot be pointed at.
    """
    every, size = (*names, *JOINT_NAMES), len(names)
    _, place_by_rig = place_rates(rig, every, cameras, pan_rad, tilt_rad, target_m, approaches[0])
    camera, model = cameras[0], rig.cameras[cameras[0]].model
    at = solve(rig.mast, model, target_m, from_pan_rad=pan_rad, from_tilt_rad=tilt_rad)[0]
    landed = pixel_rates(rig, every, camera, at.pan_rad, at.tilt_rad, target_m[None], approaches[1])
    by_place, by_rig = landed.to_points[0], landed.to_rig[0]
    if not np.isfinite(by_rig).all():
        raise CalibError(f"camera {camera} does not see the target where it should land")
    clicking = by_place @ place_by_rig
    to_readings = np.hstack([clicking[:, size:], by_rig[:, size:]])
    return -(by_rig[:, :size] + clicking[:, :size]), -to_readings


MOST_SIGMAS = 3.2905
"""Two clicks are of no point beyond it: a normal error is, either side, with the chance `Level.STATED`."""

RIG_PX = 1.0
"""One sigma, each pixel coordinate, of the assumed error of a camera whose errors the rig does not state: the
residuals of the paper's mast calibration are 0.85 to 1.13 px rms."""


@dataclass(frozen=True)
class RayGap:
    """How far two rays pass each other: the length of their common normal, with one sigma.

    ``across_px`` is the same in the right picture: how far its pixel is off the left one's epipolar line.
    """

    gap_m: float
    sigma_m: float
    across_px: float
    across_sigma_px: float

    @property
    def sigmas(self) -> float:
        """The gap in standard deviations; infinite if it has none."""
        return self.gap_m / self.sigma_m if self.sigma_m > 0.0 else math.inf if self.gap_m > 0.0 else 0.0


def ray_gap(seen: Triangulation, clicks_px2: FloatArray) -> RayGap:
    """Return the gap of a triangulation with its sigma; ``clicks_px2`` (4, 4) is the clicks' covariance."""
    rates = seen.gap_m_per_px
    sigma_m = math.sqrt(max(float(rates @ clicks_px2 @ rates), 0.0))
    per_right_px = float(np.linalg.norm(rates[2:]))
    return RayGap(seen.ray_gap_m, sigma_m, seen.ray_gap_m / per_right_px, sigma_m / per_right_px)


def refuse_two_points(gap: RayGap, pair: tuple[str, str], by: str) -> None:
    """Refuse two clicks whose rays pass each other farther than their noise explains.

    ``pair`` are the cameras' names, left first; ``by`` is the subject of "... explain 0.3 px at most".
    Raises NoStereoPoint ``not_one_point``.
    """
    if gap.sigmas <= MOST_SIGMAS:
        return
    raise NoStereoPoint(
        "not_one_point",
        f"the two pixels do not mean one point: their rays pass each other at {1e3 * gap.gap_m:.3g} mm, "
        f"{gap.sigmas:.1f} sigma. The pixel of {pair[1]} is {gap.across_px:.1f} px off the epipolar line of "
        f"that of {pair[0]}, where {by} explain {MOST_SIGMAS * gap.across_sigma_px:.1f} px at most",
    )


def clicked_point(
    rig: Rig,
    pair: tuple[str, str],
    pan_rad: float,
    tilt_rad: float,
    left_px: ArrayLike,
    right_px: ArrayLike,
    *,
    sigma_px: float = 0.2,
    sigma_rad: float = 0.0,
    calibration: RigCovariance | None = None,
) -> tuple[Triangulation, RayGap]:
    """Return the point that two clicks (2,) in a pair's pictures mean, rover frame, and the gap of its rays.

    ``sigma_px`` is that of each pixel coordinate of a click, ``sigma_rad`` of each joint reading. A camera of
    which the rig's covariance says nothing is assumed to be wrong by ``RIG_PX``. Raises NoStereoPoint as
    `calib.geometry.stereo.triangulate`, and ``not_one_point``.
    """
    for name, pixel in zip(pair, (left_px, right_px), strict=True):
        if np.shape(pixel) != (2,):
            raise NoStereoPoint(
                "bad_pixel", f"a pixel of {name} of shape {np.shape(pixel)} where (2,) is expected"
            )
    left, right = (rig.camera_in_rover(name, pan_rad, tilt_rad) for name in pair)
    seen = triangulate(left, right, left_px, right_px, sigma_px)
    for name, model in zip(pair, (left, right), strict=True):
        if not model.project(seen.position_m)[1]:
            raise NoStereoPoint(
                "not_one_point",
                f"the two pixels do not mean one point: their rays pass each other at "
                f"{1e3 * seen.ray_gap_m:.3g} mm, where {name} sees nothing{model.why_no_ray}",
            )
    allowed = click_covariance(
        rig, pair, pan_rad, tilt_rad, seen.position_m,
        sigma_px=sigma_px, sigma_rad=sigma_rad, calibration=calibration, model_px=0.0,
    )  # fmt: skip
    gap = ray_gap(seen, allowed)
    by = f"clicks good to {sigma_px:g} px and " + ("the mast file's covariance" if calibration else "the rig")
    if calibration and (unknown := _unknown(pair, calibration)):
        by += f", which knows nothing of {' and '.join(unknown)},"
    refuse_two_points(gap, pair, by)
    return seen, gap


def rig_in_mode(rig: Rig, camera: str, mode: Mode) -> Rig:
    """Return a rig one of whose cameras is in another mode, with its covariance and the sensor's mode.

    Of ``fit`` the covariance stays. Other figures there are of the calibrated picture and go. Raises BadMode
    as `in_mode`, and CalibError if the covariance does not fit the rig.
    """
    before = rig.cameras[camera]
    model, rates = in_mode(before.model, mode)
    fit: dict[str, object] = {}
    if (known := stored_covariance(rig)) is not None:
        names = [f"cameras.{camera}.{name}" for name in parameter_names(model.kind)]
        whole = np.eye(len(known.names))
        at = {name: i for i, name in enumerate(known.names)}
        has = [i for i, name in enumerate(names) if name in at]
        place = [at[names[i]] for i in has]
        whole[np.ix_(place, place)] = rates[np.ix_(has, has)]
        covariance = whole @ known.covariance @ whole.T
        fit = {"parameters": list(known.names), "covariance": covariance.tolist()}
    sensor = None if before.sensor_mode is None else sensor_mode_after(before.sensor_mode, mode)
    after = replace(before, model=model, sensor_mode=sensor)
    return replace(rig, cameras={**rig.cameras, camera: after}, fit=fit)
