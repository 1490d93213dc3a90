"""What the service knows at one moment: a frozen snapshot, made anew each time, never edited.

The API reads it, and whatever else shows the state later reads the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from drivers.interfaces import Reading
from mastctl.devices.frames import StampedFrame
from mastctl.devices.limits import Limits
from mastctl.devices.thread import Fault
from mastctl.operations.records import Motion
from mastctl.tracking.status import TrackStatus

StateWord = Literal["idle", "moving", "pointing", "stopping", "stopped", "fault"]


@dataclass(frozen=True)
class State:
    """One moment; times are seconds of CLOCK_MONOTONIC.

    Attributes
    ----------
    now_s, started_s
        When it was taken, and when the service started.
    hardware
        ``real``, ``simulated``, ``replayed`` or ``mixed``.
    mast, former_mast
        File, name and digest of the mast file in use and of the one before it.
    reading
        The last good reading of the head, None before the first.
    frames
        Each configured camera's newest frame.
    track
        The track, and the rover's pose.
    """

    now_s: float
    started_s: float
    version: str
    hardware: str
    mast: Mapping[str, Any]
    former_mast: Mapping[str, Any] | None
    limits: Limits
    reading: Reading | None
    frames: Mapping[str, StampedFrame | None]
    motion: Motion
    track: TrackStatus
    faults: tuple[Fault, ...]

    @property
    def moving(self) -> bool:
        """Whether the head was under way when it was last read."""
        return self.reading is not None and self.reading.moving

    def word(self, head: str) -> StateWord:
        """Return the state in one word; ``head`` is the name under which the head's faults stand."""
        if self.reading is None or any(fault.device == head for fault in self.faults):
            return "fault"
        if self.motion.stopping:
            return "stopping"
        if self.motion.operation is not None:
            return "pointing"
        if self.moving:
            return "moving"
        return "stopped" if self.motion.stopped else "idle"

    def told(self, head: str) -> dict[str, Any]:
        """Return the snapshot as ``GET /status`` tells it: JSON, ages instead of times."""
        reading, motion = self.reading, self.motion
        return {
            "state": self.word(head),
            "simulated": self.hardware == "simulated",
            "hardware": self.hardware,
            "joints": None
            if reading is None
            else {
                "pan_rad": reading.pan_rad,
                "tilt_rad": reading.tilt_rad,
                "measured_s": reading.time_s,
                "age_s": max(0.0, self.now_s - reading.time_s),
            },
            "moving": self.moving,
            "limits": {
                "pan_rad": list(self.limits.pan_rad),
                "tilt_rad": list(self.limits.tilt_rad),
                "speed_rad_per_s": self.limits.speed_rad_per_s,
            },
            "operation": motion.operation,
            "target": None if motion.target is None else dict(motion.target),
            "last_residual": None
            if motion.residual is None
            else {
                "residual_px": list(motion.residual.residual_px),
                "residual_sigma_px": list(motion.residual.residual_sigma_px),
                "operation": motion.residual.operation,
            },
            "pose": None if self.track.pose is None else self.track.pose.told(self.now_s),
            "track": {"state": self.track.state, "reason": self.track.reason, "id": self.track.id},
            "control": None,
            "cameras": {name: self._camera_told(frame) for name, frame in self.frames.items()},
            "mast": dict(self.mast),
            "former_mast": None if self.former_mast is None else dict(self.former_mast),
            "faults": [
                {
                    "device": fault.device,
                    "code": fault.code,
                    "message": fault.message,
                    "until": fault.until,
                    "for_s": max(0.0, self.now_s - fault.since_s),
                }
                for fault in self.faults
            ],
            "version": self.version,
            "uptime_s": self.now_s - self.started_s,
            "now_s": self.now_s,
        }

    def _camera_told(self, frame: StampedFrame | None) -> dict[str, Any]:
        if frame is None:
            return {"frame_id": None, "sequence": None, "age_s": None, "exposure_s": None}
        return {
            "frame_id": frame.frame_id,
            "sequence": frame.sequence,
            "age_s": max(0.0, self.now_s - frame.mid_exposure_s),
            "exposure_s": frame.exposure_s,
        }
