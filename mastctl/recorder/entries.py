"""Which messages are made of what the daemon publishes, and what a file begins with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from calib.geometry.rig import Rig
from mastctl.as_json import as_json, picked
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.frame_facts import FrameFacts
from mastctl.recorder import messages
from mastctl.recorder.schemas import DroppedRecord, RecordedJoints
from mastctl.recorder.writer import RecordFile

SAME_RAD = 1e-6
REST_S = 10.0
"""A head at rest is recorded this often, so that an idle daemon writes next to nothing."""

FACTS = tuple(one.name for one in fields(FrameFacts))


@dataclass(frozen=True)
class Entry:
    """A value that was published, and when."""

    topic: str
    key: str
    value: Any
    time_s: float


class Entries:
    """Writes what was published into a file, and remembers what the next file begins with."""

    STICKY = frozenset({"state", "fault", "track", "mast", "lease"})
    """Every file begins with the newest value of each key of these topics."""

    def __init__(self, rig: Rig, digest: str) -> None:
        self._rig = rig
        self._digest = digest
        self._newest: dict[tuple[str, str], Entry] = {}
        self._joints: HeadReading | None = None
        self._joints_written_s = float("-inf")
        self._written_dropped = 0
        self._frames: dict[str, str] = {}
        self._ended: set[str] = set()

    def use_mast(self, rig: Rig, digest: str) -> None:
        """Use another mast file from now on."""
        self._rig, self._digest = rig, digest

    def begin(self, file: RecordFile, time_s: float, now_s: float) -> None:
        """Write what was known before the file was: cameras, frames, the newest of the sticky topics."""
        self._frames.clear()
        self._joints_written_s = float("-inf")
        self.write_cameras(file, time_s, now_s)
        if self._joints is not None:
            self._write_joints(file, self._joints, time_s, now_s)
        for one in list(self._newest.values()):
            self._write_json(file, one, now_s)

    def write_cameras(self, file: RecordFile, time_s: float, now_s: float) -> None:
        """Write every camera's calibration."""
        time_ns = file.clocks.ns(time_s)
        for name, camera in self._rig.cameras.items():
            calibration, record = messages.calibration(name, camera, self._digest, time_ns)
            file.add_json(f"/camera/{name}/cahvor", "cahvor", record, time_s, now_s)
            if calibration is not None:
                file.add_message(f"/camera/{name}/calibration", calibration, time_s, now_s)

    def remember(self, one: Entry) -> None:
        """Keep what a later file begins with."""
        if one.topic == "joints":
            self._joints = one.value
        elif one.topic in self.STICKY and not (one.topic == "fault" and not one.value):
            self._newest[one.topic, one.key] = one
        elif one.topic in self.STICKY:
            self._newest.pop((one.topic, one.key), None)

    def write(self, file: RecordFile, one: Entry, now_s: float) -> None:
        """Write one value. Raises OSError."""
        self.remember(one)
        if one.topic == "joints":
            self._write_joints(file, one.value, one.time_s, now_s)
        elif one.topic == "frame":
            self._write_frame(file, one.value, now_s)
        else:
            self._write_json(file, one, now_s)
        if one.topic == "operation":
            self._write_outcome(file, one, now_s)

    def write_dropped(
        self, file: RecordFile, dropped: Mapping[str, int], time_s: float, now_s: float
    ) -> None:
        """Write how much was not written, if it is more than before."""
        count = sum(dropped.values())
        if count > self._written_dropped:
            self._written_dropped = count
            record: DroppedRecord = {
                "dropped": dict(dropped), "reason": "the disk was slower than the data"
            }  # fmt: skip
            file.add_json("/recorder", "recorder", record, time_s, now_s)

    def _write_joints(self, file: RecordFile, reading: HeadReading, time_s: float, now_s: float) -> None:
        before, self._joints = self._joints, reading
        still = (
            before is not None
            and not reading.moving
            and not before.moving
            and abs(before.pan_rad - reading.pan_rad) < SAME_RAD
            and abs(before.tilt_rad - reading.tilt_rad) < SAME_RAD
        )
        if still and now_s - self._joints_written_s < REST_S:
            return
        self._joints_written_s = now_s
        record: RecordedJoints = {
            "pan_rad": reading.pan_rad,
            "tilt_rad": reading.tilt_rad,
            "moving": reading.moving,
            "time_s": reading.time_s,
            "true_pan_rad": reading.true_rad[0],
            "true_tilt_rad": reading.true_rad[1],
            "pan_approach": reading.approach[0],
            "tilt_approach": reading.approach[1],
        }
        file.add_json("/joints", "joints", record, reading.time_s, now_s)
        time_ns = file.clocks.ns(reading.time_s)
        tree = messages.transforms(self._rig, *reading.true_rad, time_ns)
        file.add_message("/tf", tree, reading.time_s, now_s)

    def _write_frame(self, file: RecordFile, frame: StampedFrame, now_s: float) -> None:
        if self._frames.get(frame.camera) == frame.frame_id:
            return
        self._frames[frame.camera] = frame.frame_id
        time_s = frame.mid_exposure_s
        facts = picked(frame, *FACTS) | {"colour": frame.image.ndim == 3}
        file.add_json(f"/camera/{frame.camera}/frame", "frame", facts, time_s, now_s)
        image = messages.picture(frame, file.clocks.ns(time_s))
        file.add_message(f"/camera/{frame.camera}/image", image, time_s, now_s)

    def _write_json(self, file: RecordFile, one: Entry, now_s: float) -> None:
        file.add_json(f"/{one.topic}", one.topic, _as_record(one), one.time_s, now_s)

    def _write_outcome(self, file: RecordFile, one: Entry, now_s: float) -> None:
        """Write what an operation that ended found: its target and its residuals, once."""
        operation = _as_record(one)
        if operation.get("ended_s") is None or one.key in self._ended:
            return
        self._ended = {one.key}
        for residual in messages.residuals(operation):
            file.add_json("/residual", "residual", residual, one.time_s, now_s)
        target = messages.target(operation)
        if target is not None:
            file.add_json("/target", "target", target, one.time_s, now_s)
            scene = messages.target_scene(target["position_m"], file.clocks.ns(one.time_s))
            file.add_message("/target/scene", scene, one.time_s, now_s)


def _as_record(one: Entry) -> dict[str, Any]:
    """A value as a JSON object; one that is none gets its topic's name as its key."""
    if one.topic == "fault":
        return {"device": one.key, "faults": as_json(one.value)}
    value = as_json(one.value)
    return value if isinstance(value, dict) else {one.topic: value}
