"""The daemon as the node knows it: one writer's threads fill it, all others read it."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from calib.files.any_camera import nearest_lens
from calib.files.twin import TwinError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from mastctl.ros2.tf_tree import TfTree
from mastctl.ros2.times import RosTime

log = logging.getLogger(__name__)

ENDS = 1000
"""Operations whose end is remembered; the daemon itself keeps some 200."""

FRAMES = 64
"""Images of a camera whose stamps still name them; the daemon itself keeps some 32."""


class KnownState:
    """The daemon as the node knows it.

    Attributes
    ----------
    rig
        By the mast file in use; None before it was read.
    lenses
        By camera, the nearest of ROS's lenses: its name, the camera with it, and how far that is.
    joints
        The daemon's last report of them.
    tree
        The frames of tf, the node's own among them.
    clock
        ROS time of the daemon's times.
    """

    def __init__(self) -> None:
        self.rig: Rig | None = None
        self.lenses: Mapping[str, tuple[str, CameraModel, TwinError]] = {}
        self.joints: dict[str, Any] | None = None
        self.tree = TfTree()
        self.clock = RosTime()
        self._frames: dict[str, deque[tuple[int, str]]] = {}
        self._ends: deque[str] = deque(maxlen=ENDS)

    def use_rig(self, rig: Rig) -> None:
        """Take the rig of a mast file, and the nearest lens of each camera that has one."""
        lenses = {}
        for name, camera in rig.cameras.items():
            try:
                lenses[name] = nearest_lens(camera.model, "ros")
            except ValueError as error:
                log.warning("no camera_info of %s: %s", name, error)
        self.lenses, self.rig = lenses, rig

    def carrier_from_optical(self, rig: Rig, camera: str) -> Rigid:
        """Return the optical frame that a camera's K and D are in, in the frame of what carries it."""
        if camera in self.lenses:
            return self.lenses[camera][1].pose
        model = rig.cameras[camera].model
        return model.pose

    @property
    def ends(self) -> int:
        """How many ends are remembered."""
        return len(self._ends)

    def expect_ends(self, operations: Iterable[str]) -> None:
        """Remember operations that have ended already."""
        self._ends.extend(operations)

    def is_new_end(self, operation: str) -> bool:
        """Return whether an operation's end was not known, and remember it."""
        if operation in self._ends:
            return False
        self._ends.append(operation)
        return True

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
