"""A configuration and a drawing (mast file) of what is plugged in, as plain data. No I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from calib.files.mast_file import MAST_SCHEMA
from drivers.probes import ProbedCamera, ProbedHead
from drivers.registry import drivers_of
from drivers.servo_bus.bench import ServoBench, ServosOnLine
from mastctl.config import CONFIG_SCHEMA

FORWARD_M, DOWN_M = 0.04, 0.02
"""Of the cameras from the meeting point of the axes."""
MARGIN_RAD = 0.1
"""Between the limits that a head's driver holds and the soft ones."""


@dataclass(frozen=True)
class RigAnswers:
    """What a rig cannot report itself; ``height_m`` is that of the axes over the ground."""

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


def head_to_come() -> ProbedHead:
    """Return a head of two usual servos before it is plugged in."""
    benches = (driver.bench for driver in drivers_of("head").values())
    return ServosOnLine(next(bench for bench in benches if isinstance(bench, ServoBench)), "")


def configuration(
    head: ProbedHead | None, cameras: list[ProbedCamera], answers: RigAnswers, port: str
) -> dict[str, Any]:
    """Return the configuration; without a head, that of two usual servos which are still to be plugged in.

    ``port`` is what the head's line is called.
    """
    ends = {"pan": _radians(answers.pan_deg), "tilt": _radians(answers.tilt_deg)}
    head = head or head_to_come()
    options, reached = head.configured(ends, {"pan": answers.pan_id, "tilt": answers.tilt_id})
    names = camera_names(len(cameras))
    return {
        "schema": CONFIG_SCHEMA,
        "mast_file": "mast.yaml",
        "listen": {"host": "127.0.0.1", "port": 8420},
        "pan_tilt": {"driver": head.driver, "options": {"port": port, **options}},
        "cameras": {
            name: {"driver": camera.driver, "options": dict(camera.options)}
            for name, camera in zip(names, cameras, strict=False)
        },
        "limits": {
            **{f"{axis}_rad": _soft(of_axis) for axis, of_axis in reached.items()},
            "speed_rad_per_s": head.speed_rad_per_s,
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


def drawing(name: str, cameras: list[ProbedCamera], answers: RigAnswers) -> dict[str, Any]:
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
