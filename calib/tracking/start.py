"""Begin to follow a target that was clicked in one eye of a pair."""

from __future__ import annotations

import numpy as np

from calib.camera.stereo import triangulate
from calib.errors import CalibError
from calib.handoff.by_image import Eye
from calib.mast.ray_gap import ray_gap, refuse_two_points
from calib.pictures.distinct import indistinct
from calib.pictures.epipolar import find_partner
from calib.pictures.patch_match import match_patch
from calib.rigid import FloatArray
from calib.tracking.track import SIZES, Key, Track

MIDDLE_SEARCH_PX = 4.0
"""How far the range of a patch's middle may put it from where the whole patch puts it, at the start."""

EYES_PX = 0.4
"""One sigma, each pixel coordinate, of what two eyes' models may be wrong by where a track is begun: what is
found 2 px off the epipolar line is another thing, or the mast file is off."""


def start_track(left: Eye, right: Eye, left_px: FloatArray, sigma_px: float = 0.2) -> Track:
    """Begin a track from a click in the left picture of a pair.

    Parameters
    ----------
    left, right
        Pictures of one moment with their cameras in the rover frame.
    left_px
        (2,) the target.
    sigma_px
        Of the click; it says how well the place of what was meant is known.

    Raises
    ------
    CalibError
        With the reason, if the target cannot be followed: sky, plain surface, an edge, repeated pattern,
        hidden from the other eye, outside the picture.
    """
    pixel = np.asarray(left_px, dtype=np.float64)
    if pixel.shape != (2,) or not np.isfinite(pixel).all():
        raise CalibError(f"target pixel {pixel.tolist()} is not two finite numbers")
    width, height = left.camera.size_px
    if not (0 <= pixel[0] <= width - 1 and 0 <= pixel[1] <= height - 1):
        raise CalibError(
            f"the target pixel ({pixel[0]:.1f}, {pixel[1]:.1f}) is outside the picture of {width} x {height}"
        )
    found = find_partner(left.image, left.camera, pixel, right.image, right.camera)
    if found.match.verdict != "good" or found.plane is None:
        raise CalibError(f"the target cannot be followed: {found.match.reason}")
    # The patch that tells the surface reaches beyond it on a rock: the range is that of its middle.
    middle = match_patch(
        left.image, left.camera, pixel, found.plane, right.image, right.camera, MIDDLE_SEARCH_PX, SIZES
    )
    reason = middle.reason or indistinct(left.image, left.camera, pixel, found.plane, SIZES)
    if reason:
        raise CalibError(f"the target cannot be followed: {reason}")
    noise = max(sigma_px, float(middle.sigma_px.max()))
    seen = triangulate(left.camera, right.camera, pixel, middle.pixel_px, noise)
    gap = ray_gap(seen, (noise**2 + EYES_PX**2) * np.eye(4))
    by = f"a match good to {noise:.2g} px and cameras good to {EYES_PX:g} px"
    try:
        refuse_two_points(gap, ("the left eye", "the right eye"), by)
    except CalibError as error:
        raise CalibError(f"the target cannot be followed: {error}") from None
    key = Key(left, pixel, found.plane.normal)
    return Track("tracked", seen.position_m, seen.covariance_m2, key)
