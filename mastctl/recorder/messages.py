"""Images, cameras, frames and operations as messages of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from calib.files.twin import TwinError, nearest_opencv, twin_error
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig, RigCamera
from calib.geometry.rigid import Rigid, quaternion_of
from mastctl.as_json import as_json
from mastctl.devices.frames import StampedFrame
from mastctl.recorder.schemas import RecordedCamera

TARGET_M = 0.1
TARGET_COLOUR = (0.9, 0.2, 0.1, 0.8)


def picture(frame: StampedFrame, time_ns: int) -> Message:
    """Return an image: a camera's JPEG as it came, else the pixels as they are.

    Pixels are not made PNG: the chunk around them is compressed by zstd, which takes a fifth of PNG's time
    for three per cent more bytes.
    """
    image = frame.image
    if frame.jpeg:
        return CompressedImage(
            timestamp=_stamp(time_ns), frame_id=frame.camera, data=frame.jpeg, format="jpeg"
        )
    height, width = image.shape[:2]
    channels = 1 if image.ndim == 2 else 3
    return RawImage(
        timestamp=_stamp(time_ns),
        frame_id=frame.camera,
        width=width,
        height=height,
        encoding="mono8" if channels == 1 else "bgr8",
        step=width * channels,
        data=image.tobytes(),
    )


def calibration(
    name: str, camera: RigCamera, digest: str, time_ns: int
) -> tuple[Message | None, RecordedCamera]:
    """Return the nearest ``plumb_bob`` camera (None if there is none) and the camera itself, as JSON."""
    model = camera.model

    def record(near: dict[str, Any]) -> RecordedCamera:
        return {
            "camera": name, "model": _model_record(model), "plumb_bob": near, "on": camera.on,
            "mast_digest": digest,
        }  # fmt: skip

    if np.linalg.det([model.H, model.V, model.A]) < 0.0:
        return None, record({"none": "the image is mirrored, and no plumb_bob camera is"})
    try:
        near, error_px = _nearest(model)
    except ValueError as error:
        return None, record({"none": str(error)})
    width, height = model.size_px
    message = CameraCalibration(
        timestamp=_stamp(time_ns),
        frame_id=name,
        width=width,
        height=height,
        distortion_model="plumb_bob",
        D=near.distortion.tolist(),
        K=near.camera_matrix.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.hstack([near.camera_matrix, np.zeros((3, 1))]).ravel().tolist(),
    )
    return message, record(as_json({"rms_px": error_px.rms_px, "worst_px": error_px.worst_px}))


@lru_cache(maxsize=64)
def _nearest(model: CameraModel) -> tuple[CameraModel, TwinError]:
    """The fit of a camera, once for all files that begin with it, and how near it comes."""
    near = nearest_opencv(model, "OPENCV5")
    return near, twin_error(model, near)


def transforms(rig: Rig, pan_rad: float, tilt_rad: float, time_ns: int) -> Message:
    """Return the poses of mast, head and cameras at true joint angles: rover <- mast <- head <- cameras, and
    those of body cameras.
    """
    mast = rig.mast
    known: list[tuple[str, str, Rigid]] = [
        ("rover", "mast", mast.rover_from_mast),
        ("mast", "head", mast.rover_from_mast.inverse @ mast.rover_from_head(pan_rad, tilt_rad)),
    ]
    for name, camera in rig.cameras.items():
        known.append((camera.on, name, _carrier_from_optical(camera.model)))
    return FrameTransforms(transforms=[_transform(*one, time_ns) for one in known])


def _carrier_from_optical(model: CameraModel) -> Rigid:
    """The frame that the ``plumb_bob`` camera of `calibration` is in; its own axes if there is none."""
    try:
        return _nearest(model)[0].pose
    except ValueError:
        return model.pose


def _transform(parent: str, child: str, parent_from_child: Rigid, time_ns: int) -> FrameTransform:
    w, x, y, z = quaternion_of(parent_from_child.rotation)
    message = FrameTransform(timestamp=_stamp(time_ns), parent_frame_id=parent, child_frame_id=child)
    moved = parent_from_child.translation_m.tolist()
    message.translation.x, message.translation.y, message.translation.z = moved
    message.rotation.x, message.rotation.y, message.rotation.z, message.rotation.w = x, y, z, w
    return message


def target_scene(position_m: Sequence[float], time_ns: int) -> Message:
    """Return a target as viewers draw it: a ball at its position in the rover frame."""
    scene = SceneUpdate()
    entity = scene.entities.add(timestamp=_stamp(time_ns), frame_id="rover", id="target")
    ball = entity.spheres.add()
    ball.pose.position.x, ball.pose.position.y, ball.pose.position.z = position_m
    ball.pose.orientation.w = 1.0
    ball.size.x = ball.size.y = ball.size.z = TARGET_M
    ball.color.r, ball.color.g, ball.color.b, ball.color.a = TARGET_COLOUR
    return scene


def _model_record(model: CameraModel) -> dict[str, Any]:
    record: dict[str, Any] = {"model": model.kind, "size_px": list(model.size_px)}
    record |= {letter: as_json(getattr(model, letter)) for letter in model.letters if letter != "D"}
    if len(model.distortion):
        record |= {key: as_json(getattr(model, key)) for key in ("distortion", "camera_matrix", "rotation")}
    if model.kind == "CAHVORE":
        record |= {"type": int(model.cahvore_type), "linearity": float(model.linearity)}
    return record


def _stamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 1_000_000_000, nanos=time_ns % 1_000_000_000)
