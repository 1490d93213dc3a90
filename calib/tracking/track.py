"""A followed target: its place with covariance, the picture it is known by, and how motion carries both.

A motion of the rover carries the target over and adds the motion's own covariance (`moved_track`). Begun by
`calib.tracking.start`, seen again by `calib.tracking.look`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from calib.errors import CalibError
from calib.handoff.by_image import Eye
from calib.pictures.patch_verdict import MatchSettings
from calib.rigid import FloatArray, Rigid, carried_covariance, rigid_rates

State = Literal["tracked", "lost"]

SIZES = MatchSettings(half_px=12, near_px=6.0, roughness=0.04, relief=0.1, worst_ratio=0.7, least_lead=0.03)
"""Smaller patches than a single match takes: seen flat from 10 m, 41 px of ground are 0.8 m long and no
plane, and what lies off the plane pulls the place along as the view steepens. Roughness and relief make nine
in ten and more of the range errors lie within two of the told sigmas. A second place may fit a little better
than elsewhere: the other eye and the prediction must confirm the best."""


@dataclass(frozen=True)
class TrackSettings:
    """Thresholds of the tracking, with the reasons for their values.

    Attributes
    ----------
    sigmas
        Half width of the search window in standard deviations of the prediction.
    least_px, most_px
        Bounds of the window's half side.
    model_px
        One sigma of what the cameras' models are wrong by between two eyes and two pairs.
    worst_chi2
        Of the innovation, four pixel coordinates against the prior: 1 in 1000 good looks with both eyes is
        above 18.5.
    renew_grown, renew_shrunk
        The key picture is renewed when the target's surface is seen this much larger or smaller...
    renew_shape
        ...or foreshortened this much otherwise: seen flat, a step nearer shows much that it did not.
    renew_below
        Or when the correlation falls below this: what is seen now is no longer what the key picture shows.
        One eye that sees so little of it does not find a lost target again.
    worst_drift_m
        One sigma of the drift from the picked place; beyond it the target counts as lost.
    """

    sigmas: float = 3.5
    least_px: float = 4.0
    most_px: float = 120.0
    model_px: float = 0.12
    worst_chi2: float = 18.5
    renew_grown: float = 1.8
    renew_shrunk: float = 0.3
    renew_shape: float = 1.5
    renew_below: float = 0.8
    worst_drift_m: float = 0.03


@dataclass(frozen=True, eq=False)
class Key:
    """The picture that templates are cut from, its camera in the rover frame, the target's place in it.

    Attributes
    ----------
    drift_m2
        (3, 3) covariance, along the surface, of the place followed from the place picked: what the keys
        before handed on.
    """

    eye: Eye
    pixel_px: FloatArray
    normal: FloatArray
    drift_m2: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Track:
    """A followed target. Immutable: every step gives a new one.

    Attributes
    ----------
    state
        ``tracked``: the last look found it. ``lost``: it did not.
    position_m, covariance_m2
        (3,) and (3, 3) of the place that is followed, in the rover frame of the last motion.
    key
        The key picture.
    standby
        The key that the last look with both eyes would have given: what is looked for where a look by the
        key loses the target, since the light has changed or another side shows. None after a renewal.
    misses
        Looks since it was last found.
    motion_covariance
        (6, 6) of the rover's motion since then, as `moved_track` takes it; it is part of ``covariance_m2``.
    """

    state: State
    position_m: FloatArray
    covariance_m2: FloatArray
    key: Key
    standby: Key | None = None
    misses: int = 0
    motion_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def target_covariance_m2(self) -> FloatArray:
        """(3, 3) of the target that was picked: of the followed place, and of its drift from the picked one.

        What pixels and motions tell; an error that all cameras of the mast file share is not in it, and one
        that two eyes do not share is averaged by looks from one place as if it were noise.
        """
        return self.covariance_m2 + self.key.drift_m2


def moved_track(track: Track, now_from_then: Rigid, covariance: FloatArray) -> Track:
    """Carry a track over a motion of the rover.

    Parameters
    ----------
    now_from_then
        The rover frame of before in the one of now.
    covariance
        (6, 6) of that motion: small rotation (radians), then translation (metres), both in the frame of now:
        true = (1 + rotation) believed + translation.

    Raises
    ------
    CalibError
        If the covariance is not (6, 6), finite and without negative variances.
    """
    spread = np.asarray(covariance, dtype=np.float64)
    if spread.shape != (6, 6) or not np.isfinite(spread).all() or (np.diag(spread) < 0).any():
        raise CalibError(
            "a motion's covariance is 6 rows of 6 finite numbers: rotation in rad², then translation in m²"
        )
    position = now_from_then.points(track.position_m)
    rate, turned = motion_rate(position), now_from_then.rotation
    return replace(
        track,
        position_m=position,
        covariance_m2=turned @ track.covariance_m2 @ turned.T + rate @ spread @ rate.T,
        key=carried(track.key, now_from_then),
        standby=track.standby and carried(track.standby, now_from_then),
        motion_covariance=carried_covariance(track.motion_covariance, now_from_then) + spread,
    )


def motion_rate(position_m: FloatArray) -> FloatArray:
    """Return d position / d motion (3, 6): how a small rotation, then a translation, move a point."""
    return np.asarray(rigid_rates(np.eye(3)[None], position_m[None], np.zeros(3))[0])


def carried(key: Key, motion: Rigid) -> Key:
    """The key in another frame."""
    return Key(
        replace(key.eye, camera=key.eye.camera.moved(motion)),
        key.pixel_px,
        motion.vectors(key.normal),
        motion.rotation @ key.drift_m2 @ motion.rotation.T,
    )
