"""A picture of a daemon's camera, with its facts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from drivers.interfaces import Image


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A picture and its facts, as `mastctl.devices.frames.StampedFrame`; ``data`` is the file as it came."""

    image: Image
    data: bytes
    frame_id: str
    camera: str
    sequence: int
    mid_exposure_s: float
    exposure_s: float
    pan_rad: float
    tilt_rad: float
    moving: bool
    mast_digest: str

    @property
    def facts(self) -> dict[str, Any]:
        """Everything but the picture, as JSON."""
        height, width = self.image.shape[:2]
        return {
            "frame_id": self.frame_id,
            "camera": self.camera,
            "sequence": self.sequence,
            "size_px": [width, height],
            "mid_exposure_s": self.mid_exposure_s,
            "exposure_s": self.exposure_s,
            "pan_rad": self.pan_rad,
            "tilt_rad": self.tilt_rad,
            "moving": self.moving,
            "mast_digest": self.mast_digest,
        }


def read_snapshot(data: bytes, told: Mapping[str, str]) -> Snapshot:
    """Return a picture from a file's bytes and the headers that came with it.

    Raises
    ------
    ValueError
        If the picture cannot be decoded or a fact is missing or wrong.
    """
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("the picture cannot be decoded")
    try:
        return Snapshot(
            image=np.asarray(image, dtype=np.uint8),
            data=data,
            frame_id=told["X-Mastctl-Frame-Id"],
            camera=told["X-Mastctl-Camera"],
            sequence=int(told["X-Mastctl-Sequence"]),
            mid_exposure_s=float(told["X-Mastctl-Mid-Exposure-S"]),
            exposure_s=float(told["X-Mastctl-Exposure-S"]),
            pan_rad=float(told["X-Mastctl-Pan-Rad"]),
            tilt_rad=float(told["X-Mastctl-Tilt-Rad"]),
            moving=told["X-Mastctl-Moving"] == "true",
            mast_digest=told["X-Mastctl-Mast-Digest"],
        )
    except (KeyError, ValueError) as reason:
        raise ValueError(f"the picture's facts are wrong: {reason}") from None
