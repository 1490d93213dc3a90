"""Which messages become of what the daemon publishes, and what a file begins with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Protocol

from google.protobuf.message import Message

from calib.geometry.rig import Rig
from mastctl.as_json import as_json, picked
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.frame_facts import FrameFacts
from mastctl.recorder import messages
from mastctl.recorder.writer import Clocks

SAME_RAD = 1e-6
REST_S = 10.0
"""A head at rest is told this often, so that a daemon that does nothing writes next to nothing."""

FACTS = tuple(one.name for one in fields(FrameFacts))


class ToldLike(Protocol):
    """What was published."""

    @property
    def topic(self) -> str: ...
    @property
    def key(self) -> str: ...
    @property
    def value(self) -> Any: ...
    @property
    def time_s(self) -> float: ...


class Sink(Protocol):
    """Where messages go: a recording."""

    clocks: Clocks

    def add_json(
        self, topic: str, kind: str, told: Mapping[str, Any], time_s: float, now_s: float
    ) -> None: ...
    def add_message(self, topic: str, message: Message, time_s: float, now_s: float) -> None: ...


class Entries:
    """Writes what was published into a file, and remembers what the next file must begin with."""

    STICKY = frozenset({"state", "fault", "track", "mast", "lease"})
    """Of these the newest of each key stands at the start of every file."""

    def __init__(self, rig: Rig, digest: str) -> None:
        self._rig = rig
        self._digest = digest
        self._newest: dict[tuple[str, str], ToldLike] = {}
        self._joints: HeadReading | None = None
        self._joints_told_s = float("-inf")
        self._told_dropped = 0
        self._frames: dict[str, str] = {}
        self._ended: set[str] = set()

    def use_mast(self, rig: Rig, digest: str) -> None:
        """Stand by another mast file from now on."""
        self._rig, self._digest = rig, digest

    def begin(self, file: Sink, time_s: float, now_s: float) -> None:
        """Write what was known before the file was: cameras, frames, the newest of the sticky topics."""
        self._frames.clear()
        self._joints_told_s = float("-inf")
        self.tell_cameras(file, time_s, now_s)
        if self._joints is not None:
            self._write_joints(file, self._joints, time_s, now_s)
        for one in list(self._newest.values()):
            self._write_json(file, one, now_s)

    def tell_cameras(self, file: Sink, time_s: float, now_s: float) -> None:
        """Write every camera's calibration."""
        time_ns = file.clocks.ns(time_s)
        for name, camera in self._rig.cameras.items():
            calibration, told = messages.calibration(name, camera.model, time_ns)
            told |= {"on": camera.on, "mast_digest": self._digest}
            file.add_json(f"/camera/{name}/cahvor", "cahvor", told, time_s, now_s)
            if calibration is not None:
                file.add_message(f"/camera/{name}/calibration", calibration, time_s, now_s)

    def remember(self, one: ToldLike) -> None:
        """Keep what a later file must begin with."""
        if one.topic == "joints":
            self._joints = one.value
        elif one.topic in self.STICKY and not (one.topic == "fault" and not one.value):
            self._newest[one.topic, one.key] = one
        elif one.topic in self.STICKY:
            self._newest.pop((one.topic, one.key), None)

    def write(self, file: Sink, one: ToldLike, now_s: float) -> None:
        """Write one thing that was published. Raises OSError."""
        self.remember(one)
        if one.topic == "joints":
            self._write_joints(file, one.value, one.time_s, now_s)
        elif one.topic == "frame":
            self._write_frame(file, one.value, now_s)
        elif one.topic != "mast_file":
            self._write_json(file, one, now_s)
        if one.topic == "operation":
            self._write_outcome(file, one, now_s)

    def tell_dropped(self, file: Sink, dropped: Mapping[str, int], time_s: float, now_s: float) -> None:
        """Write how much was not written, if it is more than before."""
        count = sum(dropped.values())
        if count > self._told_dropped:
            self._told_dropped = count
            told = {"dropped": dict(dropped), "reason": "the disk was slower than what came"}
            file.add_json("/recorder", "recorder", told, time_s, now_s)

    def _write_joints(self, file: Sink, reading: HeadReading, time_s: float, now_s: float) -> None:
        before, self._joints = self._joints, reading
        still = (
            before is not None
            and not reading.moving
            and not before.moving
            and abs(before.pan_rad - reading.pan_rad) < SAME_RAD
            and abs(before.tilt_rad - reading.tilt_rad) < SAME_RAD
        )
        if still and now_s - self._joints_told_s < REST_S:
            return
        self._joints_told_s = now_s
        told = picked(reading, "pan_rad", "tilt_rad", "moving", "time_s") | {
            "true_pan_rad": reading.true_rad[0],
            "true_tilt_rad": reading.true_rad[1],
            "pan_approach": reading.approach[0],
            "tilt_approach": reading.approach[1],
        }
        file.add_json("/joints", "joints", told, reading.time_s, now_s)
        time_ns = file.clocks.ns(reading.time_s)
        tree = messages.transforms(self._rig, *reading.true_rad, time_ns)
        file.add_message("/tf", tree, reading.time_s, now_s)

    def _write_frame(self, file: Sink, frame: StampedFrame, now_s: float) -> None:
        if self._frames.get(frame.camera) == frame.frame_id:
            return
        self._frames[frame.camera] = frame.frame_id
        time_s = frame.mid_exposure_s
        facts = picked(frame, *FACTS) | {"colour": frame.image.ndim == 3}
        file.add_json(f"/camera/{frame.camera}/frame", "frame", facts, time_s, now_s)
        image = messages.picture(frame, file.clocks.ns(time_s))
        file.add_message(f"/camera/{frame.camera}/image", image, time_s, now_s)

    def _write_json(self, file: Sink, one: ToldLike, now_s: float) -> None:
        file.add_json(f"/{one.topic}", one.topic, _told(one), one.time_s, now_s)

    def _write_outcome(self, file: Sink, one: ToldLike, now_s: float) -> None:
        """What an operation that ended found: its target and its residuals, once."""
        told = _told(one)
        if told.get("ended_s") is None or one.key in self._ended:
            return
        self._ended = {one.key}
        for pointing in messages.pointings_told(told):
            file.add_json("/residual", "residual", pointing, one.time_s, now_s)
        target = messages.target_told(told)
        if target is not None:
            file.add_json("/target", "target", target, one.time_s, now_s)
            scene = messages.target_scene(target["position_m"], file.clocks.ns(one.time_s))
            file.add_message("/target/scene", scene, one.time_s, now_s)


def _told(one: ToldLike) -> dict[str, Any]:
    """A value as a JSON object; what is none stands under its topic's name."""
    value = one.value
    if one.topic == "fault":
        return {"device": one.key, "faults": as_json(value)}
    told = as_json(value)
    return told if isinstance(told, dict) else {one.topic: told}
