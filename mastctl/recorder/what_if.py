"""What if: the pointings and hand-offs of a recording, evaluated again with another mast file.

A pointing's record holds the pixels in which the pair saw the target, with the joint angles then; the angles
that were commanded, and those that were reached; and the pixel in which the target was seen then. With
another mast file, position and commanded angles come out differently; where the target would have been seen
at those follows from where it was seen, since the path between the two angles is short and the same mast
file's. The servos' error is that of the record. With the recording's own mast file the recorded residual
comes out again.

The reported sigma is that of another run's residual: of the matches, of the range from the pair's matches,
and of the servos' error, as scattered over the recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.files.mast_file import StoredRig
from calib.geometry.handoff import hand_off
from calib.geometry.pointing import solve
from calib.geometry.rig import UNKNOWN, Approach, Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.matching.handoff import MatchedHandoff
from mastctl.as_json import as_json
from mastctl.drift.handoffs import handoff_of
from mastctl.recorder.recorded import Recording

STEP_PX = 0.01
STEP_RAD = 1e-6
LEAST_PX = 0.02
"""No match is known better than this, whatever it says."""

NO_PAIR = "it pointed with one camera, and no pair saw the target"
BY_DIRECTION = "it pointed in the direction of a panorama's pixel, and compared no images"
WITHOUT_TARGET = {
    "panorama": "it took a panorama, in which no target was chosen",
    "position_m": "it pointed at a position, and no image shows which pixel that is",
    "pan_rad": "it turned the head to angles, without a target",
}
"""Why the operation of a request with this key has nothing to evaluate."""


@dataclass(frozen=True, eq=False)
class SeenAgain:
    """What a recorded pointing measured: all that is needed to work it out again.

    ``pair_px``, (2, 2): pixels of the target in the ``pair`` at (pan, tilt) ``pair_rad``. The target was
    wanted at ``aim_px``; (pan, tilt) was commanded and reached as the head reads it, from the side
    ``measured_approach``; the new image showed the target at ``target_px``.
    """

    operation: str
    pointing: int
    pair: tuple[str, str]
    pair_px: FloatArray
    pair_sigma_px: FloatArray
    pair_rad: tuple[float, float]
    aim_camera: str
    aim_px: FloatArray
    commanded_rad: tuple[float, float]
    measured_rad: tuple[float, float]
    target_px: FloatArray
    target_sigma_px: FloatArray
    frame_id: str
    pair_approach: Approach = UNKNOWN
    measured_approach: Approach = UNKNOWN

    @property
    def servo_rad(self) -> FloatArray:
        """(2,) the servos' error: reached less commanded."""
        return np.subtract(self.measured_rad, self.commanded_rad)


def what_if(recording: Recording, mast: StoredRig) -> dict[str, Any]:
    """Return what another mast file would have made of a recording, as JSON.

    ``pointings`` and ``handoffs`` have each residual as recorded and as it would have been (None, and a
    sentence in ``error``, without one), ``rms_px`` both of first and later pointings and of each camera
    handed to, ``not_worked_out`` the reasons by operation. Raises BadRecording without a mast file, BadFile
    for a hand-off that is none.
    """
    name, stored = recording.first_mast
    seen, others = seen_in(recording.operations, {key: one.facts for key, one in recording.frames.items()})
    handoffs = [handoff_of(recording.path, at, one) for at, one in enumerate(recording.handoffs, start=1)]
    pointings, handed = pointings_with(mast.rig, seen), handoffs_with(mast.rig, handoffs)
    kinds: dict[str, list[dict[str, Any]]] = {}
    for one in pointings:
        kinds.setdefault("first pointing" if one["pointing"] == 1 else "second pointing", []).append(one)
    for one in handed:
        kinds.setdefault(f"hand-off to {one['camera']}", []).append(one)
    solved = {kind: [one for one in rows if one["would_be_px"]] for kind, rows in sorted(kinds.items())}
    return {
        "recording": str(recording.path),
        "recorded_mast": {"name": name.name, "digest": stored.digest},
        "mast": {"name": mast.path.name, "digest": mast.digest},
        "rms_px": {
            kind: {
                "number": len(rows),
                "recorded": rms([one["recorded_px"] for one in rows]),
                "would_be": rms([one["would_be_px"] for one in rows]),
            }
            for kind, rows in solved.items()
            if rows
        },
        "pointings": pointings,
        "handoffs": handed,
        "not_worked_out": others,
    }


def seen_in(
    operations: Mapping[str, Mapping[str, Any]], frames: Mapping[str, Any]
) -> tuple[list[SeenAgain], dict[str, str]]:
    """Return the pointings of a recording that can be worked out again, and why the others cannot.

    ``operations`` are records by id, ``frames`` facts of recorded frames by id.
    """
    found: list[SeenAgain] = []
    others: dict[str, str] = {}
    for name, record in operations.items():
        request = record.get("request") or {}
        if "pixel" not in request:
            reason = next((WITHOUT_TARGET[key] for key in WITHOUT_TARGET if key in request), "")
            if isinstance(request.get("panorama"), Mapping):
                reason = BY_DIRECTION
            if reason:
                others[name] = reason
            continue
        if record.get("pointings") and record.get("range_from", "stereo") not in ("", "stereo"):
            others[name] = NO_PAIR
            continue
        try:
            pointings = _pointings(name, record, frames)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            others[name] = f"its record does not hold enough ({type(error).__name__}: {error})"
            continue
        found += pointings
        if not pointings:
            message = (record.get("error") or {}).get("message", "")
            others[name] = f"it {record.get('state', 'did not end')}: {message}".rstrip(": ")
    return found, others


def _pointings(name: str, record: Mapping[str, Any], frames: Mapping[str, Any]) -> list[SeenAgain]:
    """The measured pointings of one operation."""
    clicked = str(record["request"]["pixel"]["camera"])
    results = record.get("pointings") or []
    steps: dict[tuple[str, int], Mapping[str, Any]] = {}
    for step in record.get("steps") or []:
        if step["state"] == "done":
            steps[step["name"], int(step["detail"].get("pointing", 1))] = step["detail"]
    found: list[SeenAgain] = []
    for number, result in enumerate(results, start=1):
        if result.get("target_px") is None:
            continue
        if number == 1:
            ids, rest = steps["frames", 1]["frame_ids"], steps["rest", 1]
            pair = clicked, str(ids[1]).rsplit("-", 3)[0]  # the camera, before count, mast file and run
            pixels = [steps["target", 1]["pixel_px"], steps["stereo", 1]["pixel_px"]]
            sigmas = [steps["target", 1]["sigma_px"], steps["stereo", 1]["sigma_px"]]
            pair_facts, otherwise = frames.get(ids[0]), (rest["pan_rad"], rest["tilt_rad"])
        else:
            before, pair_step = steps["measure", number - 1], steps["eyes", number - 1]
            if len(pair_step["confirmed_by"]) != 1:
                continue  # another pair gave the range; the record of the first pointing says enough
            pair = str(result["camera"]), str(pair_step["confirmed_by"][0])
            pixels = [before["pixel_px"], pair_step[pair[1]]["pixel_px"]]
            sigmas = [before["sigma_px"], before["sigma_px"]]
            last = results[number - 2]
            pair_facts = frames.get(steps["look", number - 1]["frame_ids"][0])
            otherwise = last["measured_pan_rad"], last["measured_tilt_rad"]
        where, pair_approach = _joints(pair_facts, otherwise)
        found.append(
            SeenAgain(
                operation=name,
                pointing=number,
                pair=pair,
                pair_px=np.array(pixels, dtype=float),
                pair_sigma_px=np.maximum(np.array(sigmas, dtype=float), LEAST_PX),
                pair_rad=where,
                aim_camera=str(result["camera"]),
                aim_px=np.array(result["aim_px"], dtype=float),
                commanded_rad=(float(result["commanded_pan_rad"]), float(result["commanded_tilt_rad"])),
                measured_rad=(float(result["measured_pan_rad"]), float(result["measured_tilt_rad"])),
                target_px=np.array(result["target_px"], dtype=float),
                target_sigma_px=np.maximum(np.array(result["residual_sigma_px"], dtype=float), LEAST_PX),
                frame_id=str(result["frame_id"]),
                pair_approach=pair_approach,
                measured_approach=_joints(frames.get(result["frame_id"]), (0.0, 0.0))[1],
            )
        )
    return found


def _joints(facts: Any, otherwise: tuple[float, float]) -> tuple[tuple[float, float], Approach]:
    """Joint angles of a recorded frame as read, or those of the step before it, and from which side."""
    if facts is None:
        return (float(otherwise[0]), float(otherwise[1])), UNKNOWN
    approach = float(facts.get("pan_approach", 0.0)), float(facts.get("tilt_approach", 0.0))
    return (float(facts["pan_rad"]), float(facts["tilt_rad"])), approach


def pointings_with(rig: Rig, seen: Sequence[SeenAgain]) -> list[dict[str, Any]]:
    """Return each pointing as it would have been with another mast file, as JSON."""
    servo_rad = np.sqrt(np.mean(np.square([one.servo_rad for one in seen]), axis=0)) if seen else np.zeros(2)
    found = []
    for one in seen:
        row: dict[str, Any] = {
            "operation": one.operation,
            "pointing": one.pointing,
            "frame_id": one.frame_id,
            "recorded_px": one.target_px - one.aim_px,
            "would_be_px": None,
            "sigma_px": None,
            "error": "",
        }
        missing = [name for name in (*one.pair, one.aim_camera) if name not in rig.cameras]
        try:
            if missing:
                raise CalibError(f"the mast file has no camera {missing[0]}")
            residual = _residual(rig, one, one.pair_px, one.servo_rad)
            row |= {"would_be_px": residual, "sigma_px": _sigma(rig, one, residual, servo_rad)}
        except CalibError as error:
            row["error"] = " ".join(str(error).split())
        found.append(as_json(row))
    return found


def _residual(rig: Rig, seen: SeenAgain, pair_px: FloatArray, servo_rad: FloatArray) -> FloatArray:
    """(2,) residual of the pair's pixels (2, 2) and the servos' error (2,). Raises CalibError."""
    joints, came = rig.joints, seen.measured_approach
    at = joints.true_rad(seen.pair_rad, seen.pair_approach)
    one, other = (rig.camera_in_rover(name, *at) for name in seen.pair)
    target = triangulate(one, other, pair_px[0], pair_px[1]).position_m
    aim = rig.cameras[seen.aim_camera].model
    solutions = solve(rig.mast, aim, target, seen.aim_px)
    pan, tilt = seen.commanded_rad
    chosen = min(solutions, key=lambda s: max(abs(s.pan_rad - pan), abs(s.tilt_rad - tilt)))
    ray = rig.camera_in_rover(seen.aim_camera, *joints.true_rad(seen.measured_rad, came)).ray(seen.target_px)
    position_m = ray.origins_m + np.linalg.norm(target - ray.origins_m) * ray.directions
    commanded = joints.read_rad((chosen.pan_rad, chosen.tilt_rad), came)
    reached = commanded[0] + float(servo_rad[0]), commanded[1] + float(servo_rad[1])
    camera = rig.camera_in_rover(seen.aim_camera, *joints.true_rad(reached, came))
    pixel, _ = camera.project(position_m)
    return np.asarray(pixel - seen.aim_px, dtype=float)


def _sigma(rig: Rig, seen: SeenAgain, residual_px: FloatArray, servo_rad: FloatArray) -> FloatArray:
    """(2,) one sigma of another run's residual, by what each measured number moves it."""
    measured = np.concatenate([seen.pair_px.ravel(), seen.servo_rad])
    # The servos' error differs in this run and in the other one.
    sigmas = np.concatenate([seen.pair_sigma_px.ravel(), np.sqrt(2.0) * servo_rad])
    variance = np.square(seen.target_sigma_px)
    for at, (sigma, step) in enumerate(zip(sigmas, [STEP_PX] * 4 + [STEP_RAD] * 2, strict=True)):
        changed = measured.copy()
        changed[at] += step
        moved_px = _residual(rig, seen, changed[:4].reshape(2, 2), changed[4:])
        variance = variance + np.square((moved_px - residual_px) / step * sigma)
    return np.sqrt(variance)


def handoffs_with(rig: Rig, handoffs: Sequence[MatchedHandoff]) -> list[dict[str, Any]]:
    """Return, as JSON, each camera's found less predicted pixel as recorded and with another mast file."""
    rows = []
    for one in handoffs:
        for camera, landed in one.found.items():
            assert landed.found_px is not None and landed.found_covariance_px2 is not None
            row: dict[str, Any] = {
                "time": one.time,
                "camera": camera,
                "recorded_px": landed.found_px - landed.geometric_px,
                "would_be_px": None,
                "sigma_px": np.sqrt(np.diag(landed.found_covariance_px2 + landed.geometric_covariance_px2)),
                "error": "",
            }
            try:
                again = hand_off(
                    rig, one.pair, [camera], one.joints, *one.clicks_px,
                    to_joints=one.to_joints, sigma_px=one.sigma_px,
                ).pixels[camera]  # fmt: skip
                assert again is not None
                row["would_be_px"] = landed.found_px - again.pixel_px
            except (CalibError, KeyError) as error:
                row["error"] = " ".join(str(error).split()) or "no such camera"
            rows.append(as_json(row))
    return rows


def rms(rows: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the root mean square of each column."""
    x, y = np.sqrt(np.mean(np.square(np.array(rows)), axis=0))
    return float(x), float(y)
