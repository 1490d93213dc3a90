"""What the service knows at one moment: a frozen snapshot, made anew each time, never edited.

The API reads it, and whatever else shows the state later reads the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.interfaces import AxisMotion
from mastctl.answers import (
    CalibrationTold,
    CameraTold,
    ControlTold,
    FaultTold,
    MastTold,
    MeasuredJoints,
    SentinelTold,
    StandingTold,
    Status,
)
from mastctl.as_json import as_json
from mastctl.control.standing import Standing, StandingFault
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.limits import Limits
from mastctl.motion.track import TrackStatus


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
    axes
        How the head's axes move, where it says so.
    reading
        The last good reading of the head, None before the first.
    frames
        Each configured camera's newest frame.
    standing
        What the daemon is doing.
    track
        The track, and the rover's pose.
    stop_socket
        Path of the Unix socket for stops alone.
    calibration
        Whether the mast file still holds (`mastctl.watch.verdict.mast_verdict`).
    sentinel
        What its looks say (`mastctl.watch.sentinel.findings`); None where they were not read yet.
    control
        Who steers, as `mastctl.control.lease.WhoSteers.told` tells it; None for nobody.
    """

    now_s: float
    started_s: float
    version: str
    hardware: str
    mast: MastTold
    former_mast: MastTold | None
    limits: Limits
    axes: Mapping[str, AxisMotion]
    reading: HeadReading | None
    frames: Mapping[str, StampedFrame | None]
    standing: Standing
    track: TrackStatus
    faults: tuple[StandingFault, ...]
    stop_socket: str | None = None
    calibration: CalibrationTold | None = None
    sentinel: SentinelTold | None = None
    control: ControlTold | None = None

    @property
    def moving(self) -> bool:
        """Whether the head was under way when it was last read."""
        return self.reading is not None and self.reading.moving

    def told(self) -> Status:
        """Return the snapshot as ``GET /status`` tells it: JSON, ages instead of times."""
        reading, track = self.reading, self.track
        return {
            **standing_told(self.standing, self.now_s),
            "simulated": self.hardware == "simulated",
            "joints": None if reading is None else joints_told(reading, self.now_s),
            "pose": None if track.pose is None else track.pose.told(self.now_s),
            "track": {"state": track.state, "reason": track.reason, "id": track.id},
            "control": self.control,
            "calibration": self.calibration,
            "sentinel": self.sentinel,
            "axes": {
                name: {"count_rad": axis.count_rad, "one_sided": axis.rising_below_rad is not None}
                for name, axis in self.axes.items()
            },
            "cameras": {name: frame_told(frame, self.now_s) for name, frame in self.frames.items()},
            "faults": [fault_told(fault, self.now_s) for fault in self.faults],
            "uptime_s": self.now_s - self.started_s,
            "hardware": self.hardware,
            "moving": self.moving,
            "limits": as_json(self.limits),
            "mast": self.mast,
            "former_mast": self.former_mast,
            "version": self.version,
            "now_s": self.now_s,
            "stop_socket": self.stop_socket,
        }


def standing_told(now: Standing, now_s: float) -> StandingTold:
    """Return what the daemon is doing as ``GET /status`` tells it."""
    return {
        "state": now.word,
        "reason": now.reason,
        "state_for_s": max(0.0, now_s - now.since_s),
        "estop": as_json(now.latched[0]) if now.latched else None,
        "estops": as_json(now.latched),
        "operation": now.operation,
        "target": as_json(now.target),
        "last_residual": as_json(now.residual),
    }


def frame_told(frame: StampedFrame | None, now_s: float) -> CameraTold:
    """Return a camera's newest frame as ``GET /status`` tells it."""
    if frame is None:
        return {"frame_id": None, "sequence": None, "exposure_s": None, "age_s": None}
    return {
        "frame_id": frame.frame_id,
        "sequence": frame.sequence,
        "exposure_s": frame.exposure_s,
        "age_s": max(0.0, now_s - frame.mid_exposure_s),
    }


def joints_told(reading: HeadReading, now_s: float) -> MeasuredJoints:
    """Return a reading of the head as ``GET /status`` tells it."""
    return {
        "pan_rad": reading.pan_rad,
        "tilt_rad": reading.tilt_rad,
        "true_pan_rad": reading.true_rad[0],
        "true_tilt_rad": reading.true_rad[1],
        "pan_approach": reading.approach[0],
        "tilt_approach": reading.approach[1],
        "measured_s": reading.time_s,
        "age_s": max(0.0, now_s - reading.time_s),
    }


def fault_told(fault: StandingFault, now_s: float) -> FaultTold:
    """Return what is wrong with a device as ``GET /status`` tells it."""
    return {
        "device": fault.device,
        "code": fault.code,
        "message": fault.message,
        "until": fault.until,
        "for_s": max(0.0, now_s - fault.since_s),
    }
