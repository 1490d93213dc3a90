"""Which messages are made of what the daemon publishes, and what a file begins with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from calib.geometry.rig import Rig
from mastctl.answers import HeadTold
from mastctl.as_json import as_json
from mastctl.devices.frames import StampedFrame
from mastctl.frame_facts import FrameFacts
from mastctl.recorder import messages
from mastctl.recorder.writer import Attached, RecordFile

SAME_RAD = 1e-6
REST_S = 10.0
"""A head at rest is recorded this often, so that an idle daemon writes next to nothing."""

FACTS = tuple(one.name for one in fields(FrameFacts))


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
        self._joints: HeadTold | None = None
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
        time_ns = file.clocks.ns(time_s)
        for name, camera in self.mast.rig.cameras.items():
            calibration, record = messages.calibration(name, camera, self.mast.file.digest, time_ns)
            file.add_json(f"/camera/{name}/cahvor", "cahvor", record, time_s)
            if calibration is not None:
                file.add_message(f"/camera/{name}/calibration", calibration, time_s)

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
            if before is None or not self._rests(before, one.value):
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
            file.add_json("/recorder", "recorder", record, time_s)

    def _rests(self, before: HeadTold, now: HeadTold) -> bool:
        """Whether the head has not moved since a reading that needs no repetition yet."""
        still = not (now["moving"] or before["moving"])
        still = still and abs(before["pan_rad"] - now["pan_rad"]) < SAME_RAD
        still = still and abs(before["tilt_rad"] - now["tilt_rad"]) < SAME_RAD
        return still and now["measured_s"] - self._joints_written_s < REST_S

    def _write_joints(self, file: RecordFile, reading: HeadTold) -> None:
        time_s = self._joints_written_s = reading["measured_s"]
        file.add_json("/joints", "joints", reading, time_s)
        true_rad = reading["true_pan_rad"], reading["true_tilt_rad"]
        tree = messages.transforms(self.mast.rig, *true_rad, file.clocks.ns(time_s))
        file.add_message("/tf", tree, time_s)

    def _write_frame(self, file: RecordFile, frame: StampedFrame) -> None:
        if self._frames.get(frame.camera) == frame.frame_id:
            return
        self._frames[frame.camera] = frame.frame_id
        time_s = frame.mid_exposure_s
        facts = {name: as_json(getattr(frame, name)) for name in FACTS} | {"colour": frame.image.ndim == 3}
        file.add_json(f"/camera/{frame.camera}/frame", "frame", facts, time_s)
        image = messages.picture(frame, file.clocks.ns(time_s))
        file.add_message(f"/camera/{frame.camera}/image", image, time_s)

    def _write_json(self, file: RecordFile, one: Entry) -> None:
        record = {"device": one.key, "faults": one.value} if one.topic == "fault" else one.value
        file.add_json(f"/{one.topic}", one.topic, record, one.time_s)

    def _write_outcome(self, file: RecordFile, one: Entry) -> None:
        """Write the result of an operation that ended: its target and its residuals."""
        for number, pointing in enumerate(one.value["pointings"], start=1):
            if pointing["residual_px"] is not None:
                record = {"operation": one.key, "pointing": number, **pointing}
                file.add_json("/residual", "residual", record, one.time_s)
        if position_m := one.value["position_m"]:
            target = {"operation": one.key, "position_m": position_m, "range_m": one.value["range_m"]}
            file.add_json("/target", "target", target, one.time_s)
            scene = messages.target_scene(position_m, file.clocks.ns(one.time_s))
            file.add_message("/target/scene", scene, one.time_s)
