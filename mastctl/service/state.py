"""What the daemon knows as answers, events and recordings have it: JSON, ages instead of times."""

from __future__ import annotations

from typing import Any

from mastctl.answers import CameraTold, FaultTold, HeadTold, MeasuredJoints, StandingTold, StateTold
from mastctl.as_json import as_json
from mastctl.control.machine import Standing, StandingFault
from mastctl.control.publisher import Topic
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading


def standing_answer(now: Standing, now_s: float) -> StandingTold:
    """Return what the daemon is doing."""
    return {
        "state": now.state,
        "reason": now.reason,
        "state_for_s": max(0.0, now_s - now.since_s),
        "estop": as_json(now.latched[0]) if now.latched else None,
        "estops": as_json(now.latched),
        "operation": now.operation,
        "target": as_json(now.target),
        "last_residual": as_json(now.residual),
    }


def state_answer(now: Standing, now_s: float) -> StateTold:
    """Return what the daemon is doing, with its track and whether the head moves."""
    return {**standing_answer(now, now_s), "track": now.track, "moving": bool(now.head_moves)}


def camera_answer(frame: StampedFrame | None, now_s: float) -> CameraTold:
    """Return the facts of a camera's newest frame."""
    if frame is None:
        return {"frame_id": None, "sequence": None, "exposure_s": None, "age_s": None}
    return {
        "frame_id": frame.frame_id,
        "sequence": frame.sequence,
        "exposure_s": frame.exposure_s,
        "age_s": max(0.0, now_s - frame.mid_exposure_s),
    }


def joints_answer(reading: HeadReading, now_s: float) -> MeasuredJoints:
    """Return a reading of the head."""
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


def head_answer(reading: HeadReading, now_s: float) -> HeadTold:
    """Return a reading of the head, with whether it moves."""
    return {**joints_answer(reading, now_s), "moving": reading.moving}


def fault_answer(fault: StandingFault, now_s: float) -> FaultTold:
    """Return what is wrong with a device."""
    return {
        "device": fault.device,
        "code": fault.code,
        "message": fault.message,
        "until": fault.until,
        "for_s": max(0.0, now_s - fault.since_s),
    }


def event_value(topic: Topic, value: Any, now_s: float) -> Any:
    """Return a published value as events and recordings have it: the answers that the routes give.

    Track and lease, which need the service, are those of `mastctl.service.service.Service.event_value`.
    """
    match topic:
        case "state":
            return state_answer(value, now_s)
        case "joints":
            return head_answer(value, now_s)
        case "fault":
            return [fault_answer(one, now_s) for one in value]
        case "frame":
            return as_json(value) | {"age_s": max(0.0, now_s - value.mid_exposure_s)}
        case "operation":
            return value.as_json()
        case "command":  # without the key, by which others would get the answer, and a lease with it
            return {name: one for name, one in value.items() if name != "key"}
        case _:
            return value
