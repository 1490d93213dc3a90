"""Which messages are made of what the daemon publishes, and what a file begins with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, get_args, get_type_hints

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from typing_extensions import TypedDict

from calib.files.mast_file import model_keys
from calib.files.twin import TwinError, nearest_opencv, twin_error
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig, RigCamera
from calib.geometry.rigid import Rigid, quaternion_of
from mastctl.answers import Count, Event, FaultAnswer, HeadAnswer, Json, Pointing
from mastctl.as_json import as_json
from mastctl.devices.frames import StampedFrame
from mastctl.frame_facts import FrameFacts
from mastctl.recorder.writer import Attached, RecordFile

SAME_RAD = 1e-6
REST_S = 10.0
"""A head at rest is recorded this often, so that an idle daemon writes next to nothing."""

FACTS = tuple(one.name for one in fields(FrameFacts))


class RecordedCamera(TypedDict):
    """A camera in its frame as a mast file has it, and how far the nearest plumb_bob camera is, pixels."""

    camera: str
    on: str
    mast_digest: str
    model: Json
    plumb_bob: Json


class RecordedTarget(TypedDict):
    """A target in the rover frame."""

    operation: str
    position_m: list[float]
    range_m: float | None


class ResidualRecord(Pointing):
    """A pointing that measured a residual."""

    operation: str
    pointing: Count


class FaultRecord(TypedDict):
    """All that is wrong with one device."""

    device: str
    faults: list[FaultAnswer]


class DroppedRecord(TypedDict):
    """How many values were not written so far, by topic."""

    dropped: dict[str, Count]
    reason: str


RECORDS: Mapping[str, Any] = {
    get_args(hints["topic"])[0]: hints["value"] for hints in map(get_type_hints, get_args(Event))
} | {"fault": FaultRecord}
"""The type of each topic's record."""


@dataclass(frozen=True)
class Entry:
    """A published value as events have it, and when it came; of the topic ``frame`` a `StampedFrame`."""

    topic: str
    key: str
    value: Any
    time_s: float


@dataclass(frozen=True)
class AttachedMast:
    """A mast file in use: its rig, and its bytes for the recording."""

    rig: Rig
    file: Attached


class Entries:
    """Writes what was published into a file, and remembers what the next file begins with."""

    STICKY = frozenset({"state", "fault", "track", "mast", "lease"})
    """Every file begins with the newest value of each key of these topics."""

    def __init__(self, mast: AttachedMast) -> None:
        self.mast = mast
        self._newest: dict[tuple[str, str], Entry] = {}
        self._joints: HeadAnswer | None = None
        self._joints_written_s = float("-inf")
        self._written_dropped = 0
        self._frames: dict[str, str] = {}
        self._ended = ""

    def use_mast(self, mast: AttachedMast) -> bool:
        """Use a mast file from now on; return whether it is another one."""
        changed = mast.file.digest != self.mast.file.digest
        self.mast = mast
        return changed

    def begin(self, file: RecordFile, time_s: float) -> None:
        """Write what was known before the file was: cameras, joints, the newest of the sticky topics."""
        self._frames.clear()
        self._joints_written_s = float("-inf")
        self.write_cameras(file, time_s)
        if self._joints is not None:
            self._write_joints(file, self._joints)
        for one in list(self._newest.values()):
            self._write_json(file, one)

    def write_cameras(self, file: RecordFile, time_s: float) -> None:
        """Write every camera's calibration."""
        time_ns = file.ns(time_s)
        for name, camera in self.mast.rig.cameras.items():
            message, record = calibration(name, camera, self.mast.file.digest, time_ns)
            file.add_json(f"/camera/{name}/cahvor", record, time_s, RecordedCamera)
            if message is not None:
                file.add_message(f"/camera/{name}/calibration", message, time_s)

    def remember(self, one: Entry) -> None:
        """Keep what a later file begins with."""
        if one.topic == "joints":
            self._joints = one.value
        elif one.topic == "fault" and not one.value:
            self._newest.pop((one.topic, one.key), None)
        elif one.topic in self.STICKY:
            self._newest[one.topic, one.key] = one

    def write(self, file: RecordFile, one: Entry) -> None:
        """Write one value. Raises OSError."""
        before = self._joints
        self.remember(one)
        if one.topic == "joints":
            if before is None or self._moved(before, one.value):
                self._write_joints(file, one.value)
        elif one.topic == "frame":
            self._write_frame(file, one.value)
        else:
            self._write_json(file, one)
        if one.topic == "operation" and one.value["ended_s"] is not None and one.key != self._ended:
            self._ended = one.key
            self._write_outcome(file, one)

    def write_dropped(self, file: RecordFile, dropped: Mapping[str, int], time_s: float) -> None:
        """Write how much was not written, if it is more than before."""
        count = sum(dropped.values())
        if count > self._written_dropped:
            self._written_dropped = count
            record = {"dropped": dict(dropped), "reason": "the disk was slower than the data"}
            file.add_json("/recorder", record, time_s, DroppedRecord)

    def _moved(self, before: HeadAnswer, now: HeadAnswer) -> bool:
        """Whether the head has moved since a reading, or that one is old enough to be repeated."""
        by_rad = abs(before["pan_rad"] - now["pan_rad"]), abs(before["tilt_rad"] - now["tilt_rad"])
        still = not (now["moving"] or before["moving"]) and max(by_rad) < SAME_RAD
        return not still or now["measured_s"] - self._joints_written_s >= REST_S

    def _write_joints(self, file: RecordFile, reading: HeadAnswer) -> None:
        time_s = self._joints_written_s = reading["measured_s"]
        file.add_json("/joints", reading, time_s, HeadAnswer)
        true_rad = reading["true_pan_rad"], reading["true_tilt_rad"]
        tree = transforms(self.mast.rig, *true_rad, file.ns(time_s))
        file.add_message("/tf", tree, time_s)

    def _write_frame(self, file: RecordFile, frame: StampedFrame) -> None:
        if self._frames.get(frame.camera) == frame.frame_id:
            return
        self._frames[frame.camera] = frame.frame_id
        time_s = frame.mid_exposure_s
        facts = {name: as_json(getattr(frame, name)) for name in FACTS} | {"colour": frame.image.ndim == 3}
        file.add_json(f"/camera/{frame.camera}/frame", facts, time_s, FrameFacts)
        image = picture(frame, file.ns(time_s))
        file.add_message(f"/camera/{frame.camera}/image", image, time_s)

    def _write_json(self, file: RecordFile, one: Entry) -> None:
        record = {"device": one.key, "faults": one.value} if one.topic == "fault" else one.value
        file.add_json(f"/{one.topic}", record, one.time_s, RECORDS.get(one.topic))

    def _write_outcome(self, file: RecordFile, one: Entry) -> None:
        """Write the result of an operation that ended: its target and its residuals."""
        for number, pointing in enumerate(one.value["pointings"], start=1):
            if pointing["residual_px"] is not None:
                record = {"operation": one.key, "pointing": number, **pointing}
                file.add_json("/residual", record, one.time_s, ResidualRecord)
        if position_m := one.value["position_m"]:
            target = {"operation": one.key, "position_m": position_m, "range_m": one.value["range_m"]}
            file.add_json("/target", target, one.time_s, RecordedTarget)
            scene = target_scene(position_m, file.ns(one.time_s))
            file.add_message("/target/scene", scene, one.time_s)


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
    model, message = camera.model, None
    try:
        if np.linalg.det([model.H, model.V, model.A]) < 0.0:
            raise ValueError("the image is mirrored, and no plumb_bob camera is")
        near, error_px = _nearest(model)
        distance: Json = as_json({"rms_px": error_px.rms_px, "worst_px": error_px.worst_px})
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
    except ValueError as error:
        distance = {"none": str(error)}
    return message, {
        "camera": name, "model": as_json(model_keys(model)), "plumb_bob": distance, "on": camera.on,
        "mast_digest": digest,
    }  # fmt: skip


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


def _stamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 1_000_000_000, nanos=time_ns % 1_000_000_000)
