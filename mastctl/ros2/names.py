"""Names of joints, frames and topics: those of mastctl, as ROS takes them."""

from __future__ import annotations

import re

from calib.geometry.rig import Rig


class RosNames:
    """The names of joints and frames, each with the prefix that the user gave.

    Parameters
    ----------
    prefix
        Stands before each but the base's.
    base
        The rover's frame with the axes of ROS.
    """

    def __init__(self, prefix: str = "", base: str = "base_link") -> None:
        self.base = base
        self.pan, self.tilt = f"{prefix}pan", f"{prefix}tilt"
        self.rover, self.mast = f"{prefix}rover", f"{prefix}mast"
        self.pan_link, self.head = f"{prefix}pan_link", f"{prefix}head"
        self._prefix = prefix

    def topic(self, camera: str) -> str:
        """Return a camera's name as a topic has it: letters, digits and _, no digit first."""
        word = re.sub(r"[^A-Za-z0-9_]", "_", camera)
        return f"camera_{word}" if word[:1].isdigit() else word

    def optical(self, camera: str) -> str:
        """Return the frame of a camera: x right, y down, z ahead."""
        return f"{self._prefix}{self.topic(camera)}_optical_frame"

    def camera_of(self, frame: str, rig: Rig) -> str | None:
        """Return the camera whose optical frame this is."""
        return next((name for name in rig.cameras if self.optical(name) == frame), None)
