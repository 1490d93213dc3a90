"""Messages and goals of ROS as wishes: checked, turned into joint angles or points of the rover frame."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from mastctl.client import Client
from mastctl.ros2.known import FRAMES, KnownState
from mastctl.ros2.messages import stamp_ns
from mastctl.ros2.names import RosNames
from mastctl.ros2.steering import GoalOutcome, RosSteering, Wish
from mastctl.ros2.tf_tree import NoTransform
from mastctl.ros2.times import NS

log = logging.getLogger(__name__)

TF_WAIT_S = 1.0
FAR_M = 1e6


class Asked:
    """Wishes of ROS.

    Parameters
    ----------
    names
        Of joints and frames.
    known
        The daemon, as it is known now.
    steering
        Carries them out.
    refused
        Told each wish that did not become an operation.
    """

    def __init__(
        self,
        names: RosNames,
        known: KnownState,
        steering: RosSteering,
        refused: Callable[[str, GoalOutcome], None],
    ) -> None:
        self.names, self.known, self.steering = names, known, steering
        self._refused = refused

    def trajectory(self, told: Any) -> None:
        """Go to the last point of a ``trajectory_msgs/JointTrajectory``; an empty one stops the head."""
        if not told.points:
            self.steering.stop()
            return
        self.ask("joint_trajectory", lambda client: self.angles_of(told, client))

    def point_at(self, told: Any) -> None:
        """Point at a ``geometry_msgs/PointStamped`` of any frame that tf knows."""
        self.ask("point_at", lambda client: self.point_of(told))

    def point_at_pixel(self, told: Any) -> None:
        """Point at what an image shows; the only wish of a topic after which a residual is measured."""
        self.ask("point_at_pixel", lambda client: self.pixel_of(told))

    def ask(
        self,
        what: str,
        request: Callable[[Client], Mapping[str, Any]],
        on_end: Callable[[GoalOutcome], None] = lambda outcome: None,
    ) -> Wish:
        """Have something done, and return the wish; ``on_end`` is told how it ended."""

        def end(outcome: GoalOutcome) -> None:
            if outcome.operation is None:
                self._refused(what, outcome)
            on_end(outcome)

        wish = Wish(what, request, end)
        self.steering.ask(wish)
        return wish

    def angles_of(self, trajectory: Any, client: Client) -> dict[str, float]:
        """Return the joint angles of a trajectory's last point; a joint that it leaves out stays.

        Raises
        ------
        ValueError
            In a sentence, if it names other joints or has no such angles.
        """
        names = self.names
        keys = {names.pan: "pan_rad", names.tilt: "tilt_rad"}
        known = " and ".join(keys)
        given = list(trajectory.joint_names)
        if not given or len(set(given)) != len(given) or not set(given) <= set(keys):
            raise ValueError(f"the trajectory names the joints {given} where {known} are expected, once each")
        if not trajectory.points:
            raise ValueError("the trajectory has no point")
        last = list(trajectory.points[-1].positions)
        if len(last) != len(given):
            raise ValueError(f"the last point has {len(last)} positions for {len(given)} joints")
        if not all(map(math.isfinite, last)):
            raise ValueError(f"the last point's positions are {last} where finite radians are expected")
        joints = client.status()["joints"]
        if joints is None and len(given) < 2:
            raise ValueError("the head was not read yet; a trajectory of both joints is expected")
        stays = {} if joints is None else {"pan_rad": joints["pan_rad"], "tilt_rad": joints["tilt_rad"]}
        return stays | {keys[name]: float(value) for name, value in zip(given, last, strict=True)}

    def point_of(self, told: Any) -> dict[str, Any]:
        """Return the point in the rover frame, metres, of a ``PointStamped``.

        Raises
        ------
        ValueError
            In a sentence, if it is not finite or tf does not know its frame at its time.
        """
        frame, rover = told.header.frame_id.lstrip("/"), self.names.rover
        point = [float(told.point.x), float(told.point.y), float(told.point.z)]
        if not all(map(math.isfinite, point)):
            raise ValueError(f"the point is {point} where finite meters are expected")
        if not frame:
            raise ValueError("the point's header has no frame_id")
        if frame == rover:
            return {"position_m": point, "frame": "rover"}
        try:
            rover_from_frame = self.known.tree.transform(rover, frame, stamp_ns(told.header.stamp), TF_WAIT_S)
        except NoTransform as error:
            raise ValueError(str(error)) from None
        return {"position_m": rover_from_frame.points(point).tolist(), "frame": "rover"}

    def pixel_of(self, told: Any) -> dict[str, Any]:
        """Return the pixel of a named frame of a ``PointStamped``: x, y pixels, z the range, metres, or 0.

        Its frame is a camera's optical one, and its stamp that of the image.

        Raises
        ------
        ValueError
            In a sentence, if no such image was published lately, or the numbers are none.
        """
        at_ns = stamp_ns(told.header.stamp)
        x_px, y_px, range_m = float(told.point.x), float(told.point.y), float(told.point.z)
        if not (all(map(math.isfinite, (x_px, y_px, range_m))) and range_m >= 0.0):
            raise ValueError(
                f"the point is {[x_px, y_px, range_m]} where a pixel and a range (meters, or 0) are expected"
            )
        frame = told.header.frame_id.lstrip("/")
        rig = self.known.rig
        if rig is None:
            raise ValueError("the daemon's mast file cannot be read, so that its cameras are not known")
        camera = self.names.camera_of(frame, rig)
        if camera is None:
            raise ValueError(f"the frame '{frame}' is no camera's; one ends with _optical_frame")
        frame_id = self.known.frame_at(camera, at_ns)
        if frame_id is None:
            raise ValueError(
                f"none of the last {FRAMES} images of {camera} has the stamp {at_ns / NS:.9f} s; "
                "the stamp of the image that shows the point is expected"
            )
        found: dict[str, Any] = {"pixel": (camera, frame_id, x_px, y_px)}
        return found | ({"range_m": range_m} if range_m else {})

    def aim_of(self, frame: str, axis: tuple[float, float, float]) -> dict[str, Any]:
        """Return the aim of a ``PointHead``: where a camera shows what lies along an axis of its frame.

        Without a frame the daemon chooses; without an axis it is the image's centre.

        Raises
        ------
        ValueError
            In a sentence, if the frame is no head camera's optical one, or the camera does not see along it.
        """
        if not frame:
            return {}
        rig = self.known.rig
        camera = None if rig is None else self.names.camera_of(frame.lstrip("/"), rig)
        if rig is None or camera is None or rig.cameras[camera].on != "head":
            known = [] if rig is None else [
                self.names.optical(name) for name, one in rig.cameras.items() if one.on == "head"
            ]  # fmt: skip
            raise ValueError(f"pointing_frame is '{frame}' where one of {known} is expected")
        optical = self.known.carrier_from_optical(rig, camera)
        return {"aim": (camera, *_pixel_along(rig.cameras[camera].model, optical, axis))}


def _pixel_along(model: CameraModel, optical: Rigid, axis: tuple[float, float, float]) -> tuple[float, float]:
    """The pixel on which a point far along an axis of the optical frame falls."""
    if not any(axis):
        width, height = model.size_px
        return (width - 1) / 2, (height - 1) / 2
    if not all(map(math.isfinite, axis)):
        raise ValueError(f"pointing_axis is {list(axis)} where finite numbers are expected")
    along = optical.rotation @ (np.array(axis) / np.linalg.norm(axis))
    pixel, valid = model.project(model.C + FAR_M * along)
    if not valid:
        raise ValueError(f"the camera does not see along pointing_axis {list(axis)}")
    x, y = pixel.tolist()
    return x, y
