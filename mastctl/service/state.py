"""What the service knows at one moment: a frozen snapshot, made anew each time, never edited.

The API reads it, and whatever else shows the state later reads the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from drivers.interfaces import Reading
from mastctl.as_json import as_json, picked
from mastctl.devices.frames import StampedFrame
from mastctl.devices.limits import Limits
from mastctl.operations.records import Motion
from mastctl.safety.latch import Held
from mastctl.state.faults import StandingFault
from mastctl.tracking.status import TrackStatus

AS_THEY_ARE = (
    "hardware", "moving", "limits", "mast", "former_mast", "version", "now_s", "stop_socket",
)  # fmt: skip
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
    estop
        The emergency stop that is latched, None if none is.
    stop_socket
        Path of the Unix socket for stops alone.
    control
        Who steers, as `mastctl.commands.lease.Control.told` tells it; None for nobody.
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
    faults: tuple[StandingFault, ...]
    estop: Held | None = None
    stop_socket: str | None = None
    control: Mapping[str, Any] | None = None

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
        if self.estop is not None:
            return "stopped"
        if self.motion.operation is not None:
            return "pointing"
        if self.moving:
            return "moving"
        return "stopped" if self.motion.stopped else "idle"

    def told(self, head: str) -> dict[str, Any]:
        """Return the snapshot as ``GET /status`` tells it: JSON, ages instead of times."""
        reading, motion, track = self.reading, self.motion, self.track
        return {
            "state": self.word(head),
            "simulated": self.hardware == "simulated",
            "joints": None
            if reading is None
            else picked(reading, "pan_rad", "tilt_rad")
            | {"measured_s": reading.time_s, "age_s": self._age_s(reading.time_s)},
            "operation": motion.operation,
            "target": as_json(motion.target),
            "last_residual": as_json(motion.residual),
            "pose": None if track.pose is None else track.pose.told(self.now_s),
            "track": picked(track, "state", "reason", "id"),
            "control": self.control,
            "estop": None if self.estop is None else asdict(self.estop),
            "cameras": {
                name: picked(frame, "frame_id", "sequence", "exposure_s")
                | {"age_s": None if frame is None else self._age_s(frame.mid_exposure_s)}
                for name, frame in self.frames.items()
            },
            "faults": [
                picked(fault, "device", "code", "message", "until") | {"for_s": self._age_s(fault.since_s)}
                for fault in self.faults
            ],
            "uptime_s": self.now_s - self.started_s,
            **picked(self, *AS_THEY_ARE),
        }

    def _age_s(self, time_s: float) -> float:
        return max(0.0, self.now_s - time_s)
