"""The rig, the calibration and the configuration of the closed loop, from those of the packaged rover.

The rig is the packaged rover's mast with its two Navcams and the pictures 640 px wide where they have 1024:
the same field of view, the same errors of calibration, five eighths as many pixels of residual.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from calib.files.yaml_text import parse_mapping
from hil_tests.support.closed_loop.hdmi import SIZE_PX

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
CAMERAS = ("navcam_left", "navcam_right")
HEAD = "ph42"
SAMPLES = 1
MARGIN_S = 0.8
"""How long the world may take to notice that the head has moved: until then it shows the picture before."""

_LIMITS = {"pan_rad": [-2.6, 2.6], "tilt_rad": [-1.2, 0.5], "speed_rad_per_s": 1.0}


def write_rig(folder: Path) -> None:
    """Write ``rig.yaml``, the true rig, and ``mast.yaml``, the calibration, into a folder."""
    for source, name in (("sim/rocky8.yaml", "rig.yaml"), ("masts/rocky8_simulated.yaml", "mast.yaml")):
        document = parse_mapping((CONFIGS / source).read_bytes(), source)
        small = {
            "schema": document["schema"],
            "name": f"{document['name']}_640",
            "mast": document["mast"],
            "cameras": {camera: _shrunk(document["cameras"][camera]) for camera in CAMERAS},
            "stereo": {"navcam": list(CAMERAS)},
            "provenance": {"kind": f"Navcams of {source}, pictures shrunk to 640x480"},
        }
        (folder / name).write_text(json.dumps(small))


def _shrunk(camera: dict[str, Any]) -> dict[str, Any]:
    """The same camera with fewer, larger pixels; the centre of the first one stays (0, 0)."""
    scale = SIZE_PX[0] / camera["size_px"][0]
    if [side * scale for side in camera["size_px"]] != list(SIZE_PX):
        raise ValueError(f"pictures of {camera['size_px']} do not shrink to {SIZE_PX}")
    shift = (0.5 * scale - 0.5) * np.array(camera["A"])
    rows = {row: (scale * np.array(camera[row]) + shift).tolist() for row in "HV"}
    return {**camera, **rows, "size_px": list(SIZE_PX)}


def through_devices(folder: Path, port: str, head: Any) -> Path:
    """Write the configuration of the daemon that talks to servos on ``port`` and to the capture nodes.

    ``head`` is the `HeadSettings` of the simulated head, for its reach and its backlash.
    """
    axes = {}
    for servo_id, (name, axis) in enumerate((("pan", head.pan), ("tilt", head.tilt)), 1):
        axes[name] = {
            "id": servo_id,
            "model": "PH42-020-S300",
            "limits_rad": [axis.low_rad + 0.01, axis.high_rad - 0.01],
            "approach": "positive",
            "approach_rad": axis.approach_rad,
        }
    options = {
        "port": port, "baud": 1_000_000, "speed_rad_per_s": head.pan.speed_rad_per_s,
        "acceleration_rad_per_s2": head.pan.acceleration_rad_per_s2, **axes,
        # One busy processor draws the pictures, simulates the servos and computes: answers may take longer
        # than on a line, and silence of the host does not mean that it is gone.
        "reply_timeout_s": 0.3, "watchdog_s": 0,
    }  # fmt: skip
    controls = {
        "loop_video": True,  # the HDMI cable from the output to this input
        "timestamp_source": "start_of_exposure",
        "osd_text_mode": "none",
    }
    cameras = {
        camera: {
            "driver": "v4l2",
            "options": {
                "bus": f"platform:vivid-{index:03}",
                "format": "YUYV",
                "size_px": list(SIZE_PX),
                "rate_hz": None,  # the HDMI signal's
                "margin_s": MARGIN_S,
                "controls": controls,
            },
        }
        for index, camera in enumerate(CAMERAS)
    }
    document = {
        "schema": "mastctl/config/1",
        "mast_file": "mast.yaml",
        "listen": {"host": "127.0.0.1", "port": 0},
        "pan_tilt": {"driver": "dynamixel", "options": options},
        "cameras": cameras,
        "limits": _LIMITS,
    }
    path = folder / "devices.yaml"
    path.write_text(json.dumps(document, indent=1))  # JSON is YAML
    return path
