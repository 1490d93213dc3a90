"""What the counts of a head leave of a commanded angle, for the record of a pointing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from calib.camera.cahvor import CameraModel
from drivers.errors import DriverError
from drivers.interfaces import AxisReport


def counts_told(head: object, tilt_rad: float, model: CameraModel | None) -> dict[str, Any]:
    """Return goal, measured count and what is left between command and measurement, for each axis.

    A head that fails to tell has ``counts_missing`` instead, which says why: nothing fails by it.

    Parameters
    ----------
    head
        Anything; what has no ``report`` (see `drivers.interfaces.Reporting`) knows no counts: empty.
    tilt_rad
        Where the head looks: a pan turns the picture of a head that looks up less.
    model
        The aiming camera, for the pixels; None for joint angles alone.
    """
    report = getattr(head, "report", None)
    try:
        axes: dict[str, AxisReport] = dict(report()) if report is not None else {}
    except DriverError as error:
        return {"counts_missing": str(error)}
    told: dict[str, Any] = {}
    for name, axis in axes.items():
        told[name] = {
            "goal_counts": axis.goal_counts,
            "measured_counts": axis.measured_counts,
            "came_from": axis.side,
        }
        if axis.count_rad is not None:
            told[name]["count_rad"] = axis.count_rad
        if axis.left_rad is None:
            continue
        told[name]["left_rad"] = round(axis.left_rad, 7)
        if model is not None:
            # Yakimovsky and Cunningham (1978): the focal lengths of columns and rows
            focal_px = float(np.linalg.norm(np.cross(model.A, model.H if name == "pan" else model.V)))
            share = math.cos(tilt_rad) if name == "pan" else 1.0
            left_px = axis.left_px(focal_px)
            told[name]["left_px"] = None if left_px is None else round(share * left_px, 3)
    return {"counts": told} if told else {}
