"""Whether a later picture repeats what was measured: what pictures older than their stamps do not.

A picture that lags behind its stamp may show a head on its last milliradians, which is less than what
`mastctl.pointing.motion_seen` must allow for play. A second picture, stamped later by ``repeat_after_s``, was
exposed by a head at rest if it lags by no more than that; so if both show the same, that is where the target
stays. What moves on its own, the target or the rover, is found out too.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.pictures.patch_verdict import PatchMatch
from mastctl.devices.joint_history import HeadReading
from mastctl.pointing.looking import Clicked, Eyes, View
from mastctl.pointing.results import PointingError, rounded
from mastctl.pointing.settings import PointingSettings

SIGMAS = 3.0


def repeated(
    eyes: Eyes,
    settings: PointingSettings,
    clicked: Clicked,
    first: View,
    seen: PatchMatch,
    settled: HeadReading,
) -> tuple[View, PatchMatch, dict[str, Any]]:
    """Find the clicked thing in a later picture of the same camera, where the first one showed it.

    Parameters
    ----------
    clicked
        What is looked for.
    first, seen
        The first picture after the move, and where that shows it.
    settled
        The head when it had come to rest.

    Returns
    -------
    later, again, proven
        The later picture, where that shows it, and for the record ``repeated_after_s``, ``apart_px`` (x, y)
        and ``fresh_to_s``: pictures older than their stamps by up to that, seconds, would not have passed. 0
        where both are the same to the last bit, as of a camera that froze or of a replay.

    Raises
    ------
    PointingError
        ``not_repeated`` if it is elsewhere by more than three sigma and what the joints read between the two
        (a head at rest may dither by some counts), or not found.
    DriverError
        If the picture does not come.
    """
    camera, begun_s = first.frame.camera, first.frame.exposure_began_s
    later = eyes.new((camera,), begun_s + settings.repeat_after_s, settled)[camera]
    after_s = later.frame.exposure_began_s - begun_s
    try:
        again = eyes.look_for(clicked, later)
    except PointingError as error:
        words = f"{after_s:.2f} s later {camera} does not see the target any more: {error}"
        raise PointingError("not_repeated", words) from None
    apart_px = again.pixel_px - seen.pixel_px
    before_px, after_px = (view.camera.project(clicked.plane.point_m)[0] for view in (first, later))
    allowed_px = SIGMAS * np.hypot(seen.sigma_px, again.sigma_px) + np.abs(after_px - before_px)
    if (np.abs(apart_px) > allowed_px).any():
        raise PointingError(
            "not_repeated",
            f"{after_s:.2f} s later {camera} shows the target {apart_px[0]:+.2f}, {apart_px[1]:+.2f} px "
            f"elsewhere, at most {allowed_px[0]:.2f}, {allowed_px[1]:.2f} px (3 sigma) is expected of a head "
            "at rest: the pictures are older than their stamps ('mastctl camera sync' measures by how much), "
            "the mast still rings, or the target or the rover moves",
        )
    another = not np.array_equal(first.image, later.image)
    proven = {
        "repeated_after_s": round(after_s, 3),
        "apart_px": rounded(apart_px),
        "fresh_to_s": round(later.frame.exposure_began_s - settled.time_s, 3) if another else 0.0,
    }
    return later, again, proven
