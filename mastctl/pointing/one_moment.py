"""Whether pictures of several eyes serve one measurement: of one moment, or of a thing that stands still."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.rigid import FloatArray
from mastctl.devices.joint_history import HeadReading
from mastctl.pointing.looking import Eyes, View
from mastctl.pointing.results import PointingError
from mastctl.pointing.settings import PointingSettings


def check_one_moment(
    eyes: Eyes,
    settings: PointingSettings,
    view: View,
    pixel_px: FloatArray,
    others: Sequence[View],
    resting: HeadReading,
) -> dict[str, Any]:
    """Check that the thing at a pixel moves by less than half a pixel between the exposures of several eyes.

    Where these were not at one moment, its speed is measured in a further picture of the first eye, in the
    picture itself: the mast and the target count alike. That the head reports no motion is checked before
    (`Eyes.new`).

    Returns
    -------
    detail
        For the record: ``dt_s`` by other eye, and ``image_speed_px_per_s``, ``moved_px`` where measured.

    Raises
    ------
    PointingError
        ``target_moving`` if it moves too far, or is not found where it was.
    DriverError
        If the further picture does not come.
    """
    detail = apart(view, others)
    moments_s = (0.0, *detail["dt_s"].values())
    spread_s = max(moments_s) - min(moments_s)
    if spread_s <= settings.same_moment_s:
        return detail
    camera = view.frame.camera
    later = eyes.new((camera,), view.frame.exposure_began_s, resting)[camera]
    between_s = later.frame.exposure_began_s - view.frame.exposure_began_s
    try:
        seen = eyes.again(view, pixel_px, later)
    except PointingError as error:
        raise PointingError(
            "target_moving",
            f"the eyes were exposed {1e3 * spread_s:.1f} ms apart, and {1e3 * between_s:.1f} ms later "
            f"{camera} does not see the target where it was: {error}",
        ) from None
    speed = float(np.linalg.norm(seen.pixel_px - pixel_px)) / between_s
    moved_px = speed * spread_s
    detail.update(image_speed_px_per_s=round(speed, 3), moved_px=round(moved_px, 4))
    if moved_px >= settings.between_eyes_px:
        raise PointingError(
            "target_moving",
            f"the target moves at {speed:.1f} px/s in {camera}, {moved_px:.2f} px between exposures "
            f"{1e3 * spread_s:.1f} ms apart; less than {settings.between_eyes_px:g} px serves a measurement",
        )
    return detail


def apart(view: View, others: Sequence[View]) -> dict[str, Any]:
    """Return ``dt_s`` for the record: how much later than the first eye each other one began to expose."""
    begun_s = view.frame.exposure_began_s
    return {"dt_s": {o.frame.camera: round(o.frame.exposure_began_s - begun_s, 6) for o in others}}
