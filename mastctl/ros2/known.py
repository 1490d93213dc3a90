"""What is known of the daemon at this moment: one writer's threads fill it, everybody else reads."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

from calib.geometry.rig import Rig
from mastctl.ros2.tf_tree import TfTree
from mastctl.ros2.times import RosTime

FRAMES = 64
"""Images of a camera whose stamps still name them; the daemon itself keeps some 32."""


class Known:
    """The daemon as the node knows it.

    Attributes
    ----------
    rig
        By the mast file in use; None before it was read.
    joints
        As the daemon told them last.
    tree
        The frames of tf, the node's own among them.
    clock
        ROS time of the daemon's times.
    """

    def __init__(self) -> None:
        self.rig: Rig | None = None
        self.joints: dict[str, Any] | None = None
        self.tree = TfTree()
        self.clock = RosTime()
        self._frames: dict[str, deque[tuple[int, str]]] = {}

    def expect_images(self, cameras: Sequence[str]) -> None:
        """Keep the stamps of some cameras' images."""
        self._frames = {name: deque(maxlen=FRAMES) for name in cameras}

    def put_image(self, camera: str, at_ns: int, frame_id: str) -> None:
        """An image was published with a stamp."""
        self._frames[camera].append((at_ns, frame_id))

    def frame_at(self, camera: str, at_ns: int) -> str | None:
        """Return the id of the frame that was published with a stamp, None for none of the last."""
        known = tuple(self._frames.get(camera, ()))
        return next((frame_id for stamped_ns, frame_id in known if stamped_ns == at_ns), None)
