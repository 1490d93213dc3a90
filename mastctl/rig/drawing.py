"""A configuration and a drawing (mast file) of what is plugged in, as plain data. No I/O."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from calib.files.mast_file import MAST_SCHEMA
from drivers.flir_ptu.workshop import AxisFacts
from mastctl.config import CONFIG_SCHEMA
from mastctl.rig.plugged import FAMILIES, PluggedCamera, PluggedHead

ARCSEC_RAD = math.radians(1 / 3600)
FORWARD_M, DOWN_M = 0.04, 0.02
"""Of the cameras from the meeting point of the axes."""
MARGIN_RAD = 0.1
"""Between the limits that a head's driver holds and the soft ones."""
APPROACH_RAD = 0.02
PTU_SIGNS = {"pan": -1, "tilt": 1}
"""A unit counts pan to the left and tilt upwards, the mast to the right and upwards."""
FASTEST_POLL_HZ, USUAL_BAUD, USUAL_MODEL = 50.0, 1_000_000, "XL330-M288-T"


@dataclass(frozen=True)
class RigAnswers:
    """What nobody can ask a rig itself.

    Attributes
    ----------
    height_m
        Of the axes over the ground.
    baseline_m
        Between two cameras.
    view_deg
        Across the picture.
    pan_deg, tilt_deg
        Ends of what the head may reach.
    pan_id, tilt_id
        Which servo turns which axis.
    date
        Of the drawing.
    """

    height_m: float = 1.0
    baseline_m: float = 0.1
    view_deg: float = 60.0
    pan_deg: tuple[float, float] = (-85.0, 85.0)
    tilt_deg: tuple[float, float] = (-40.0, 30.0)
    pan_id: int = 1
    tilt_id: int = 2
    date: datetime = field(default_factory=lambda: datetime.now(UTC))


def camera_names(count: int) -> list[str]:
    """Return the names of a rig's cameras: a pair, or one."""
    return ["cam_left", "cam_right"] if count > 1 else ["cam"][:count]


def configuration(
    head: PluggedHead | None, cameras: list[PluggedCamera], answers: RigAnswers, port: str
) -> dict[str, Any]:
    """Return the configuration; without a head, that of two XL330 which are still to be plugged in.

    ``port`` is what the head's line is called.
    """
    ends = {"pan": _radians(answers.pan_deg), "tilt": _radians(answers.tilt_deg)}
    if head is not None and head.unit is not None:
        ends = {axis: _within(ends[axis], getattr(head.unit, axis), PTU_SIGNS[axis]) for axis in ends}
        driver, options, speed = "flir_ptu", _ptu(head.unit_baud, ends), 0.5
    else:
        driver = FAMILIES[0].driver if head is None or head.family is None else head.family.driver
        options, speed = _servos(head, answers, ends), 0.8
    names = camera_names(len(cameras))
    return {
        "schema": CONFIG_SCHEMA,
        "mast_file": "mast.yaml",
        "listen": {"host": "127.0.0.1", "port": 8420},
        "pan_tilt": {"driver": driver, "options": {"port": port, **options}},
        "cameras": {
            name: {"driver": camera.driver, "options": dict(camera.options)}
            for name, camera in zip(names, cameras, strict=False)
        },
        "limits": {
            **{f"{axis}_rad": _soft(of_axis) for axis, of_axis in ends.items()},
            "speed_rad_per_s": speed,
        },
    }


def _radians(ends_deg: tuple[float, float]) -> tuple[float, float]:
    return round(math.radians(ends_deg[0]), 3), round(math.radians(ends_deg[1]), 3)


def _soft(ends: tuple[float, float]) -> list[float]:
    """Soft limits of an axis within what its driver holds."""
    return [round(ends[0] + MARGIN_RAD, 3), round(ends[1] - MARGIN_RAD, 3)]


def soft_limits(answers: RigAnswers) -> tuple[list[float], list[float]]:
    """Return the soft limits of pan and tilt by the answers alone, radians."""
    return _soft(_radians(answers.pan_deg)), _soft(_radians(answers.tilt_deg))


def _within(ends: tuple[float, float], axis: AxisFacts, sign: int) -> tuple[float, float]:
    """Limits that a unit has too, where it tells them."""
    count_rad = sign * axis.resolution_arcsec * ARCSEC_RAD
    reach = sorted(count_rad * end for end in (axis.lowest, axis.highest) if end is not None)
    if len(reach) < 2:
        return ends
    return max(ends[0], math.ceil(1e3 * reach[0]) / 1e3), min(ends[1], math.floor(1e3 * reach[1]) / 1e3)


def _ptu(baud: int, ends: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    axes = {axis: {"sign": PTU_SIGNS[axis], "limits_rad": list(ends[axis])} for axis in ends}
    return {"baud": baud, **axes}


def _servos(
    head: PluggedHead | None, answers: RigAnswers, ends: Mapping[str, tuple[float, float]]
) -> dict[str, Any]:
    family = head.family if head is not None and head.family is not None else FAMILIES[0]
    servos = {one.servo_id: one for one in head.servos} if head is not None else {}
    baud = max((one.baud for one in servos.values()), default=USUAL_BAUD)
    poll_hz = min(FASTEST_POLL_HZ, math.floor(baud / (10 * family.poll_bytes)))
    axes = {}
    for axis, number in (("pan", answers.pan_id), ("tilt", answers.tilt_id)):
        like = servos.get(number) or next(iter(servos.values()), None)
        name = USUAL_MODEL if like is None else like.model
        backlash_rad = None if like is None else family.models[name].backlash_rad
        axes[axis] = {
            "id": number,
            "model": name,
            "limits_rad": list(ends[axis]),
            "approach": "positive" if axis == "pan" else "gravity",
            "approach_rad": max(APPROACH_RAD, round(1.5 * (backlash_rad or 0.0), 3)),
        }
    slow = {} if poll_hz == FASTEST_POLL_HZ else {"poll_hz": float(poll_hz)}
    return {"baud": baud, **slow, **axes}


def drawing(name: str, cameras: list[PluggedCamera], answers: RigAnswers) -> dict[str, Any]:
    """Return the mast file: axes that meet over the rover's origin, and cameras that look ahead."""
    names = camera_names(len(cameras))
    half_m = answers.baseline_m / 2
    sides_m = [-half_m, half_m] if len(names) == 2 else [0.0]
    drawn = {
        camera: _camera(plugged.options["size_px"], y_m, answers.view_deg)
        for camera, plugged, y_m in zip(names, cameras, sides_m, strict=False)
    }
    return {
        "schema": MAST_SCHEMA,
        "name": name,
        "mast": {"translation_m": [0.0, 0.0, -answers.height_m], "rotation_rad": [0.0, 0.0, 0.0]},
        "cameras": drawn,
        **({"stereo": {"cam": names}} if len(names) == 2 else {}),
        "provenance": {
            "kind": "drawn by mastctl rig new, not calibrated",
            "date": answers.date.isoformat(timespec="seconds"),
        },
    }


def _camera(size_px: list[int], y_m: float, view_deg: float) -> dict[str, Any]:
    """One camera that looks ahead along x of the head."""
    width, height = size_px
    focal_px = round(width / 2 / math.tan(math.radians(view_deg) / 2), 1)
    return {
        "on": "head",
        "size_px": [width, height],
        "model": "CAHVOR",
        "C": [FORWARD_M, y_m, DOWN_M],
        "A": [1.0, 0.0, 0.0],
        "H": [(width - 1) / 2, focal_px, 0.0],
        "V": [(height - 1) / 2, 0.0, focal_px],
        "O": [1.0, 0.0, 0.0],
        "R": [0.0, 0.0, 0.0],
    }
