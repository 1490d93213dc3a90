"""What if: the pointings and hand-offs of a recording, evaluated again with another mast file.

A pointing's record holds the pixels in which the pair saw the target, with the joint angles then; the angles
that were commanded, and those that were reached; and the pixel in which the target was seen then. With
another mast file, position and commanded angles come out differently; where the target would have been seen
at those follows from where it was seen, since the way between the two angles is short and the same mast
file's. What the servos left of the command is taken as it was. With the recording's own mast file the
recorded residual comes out again.

The reported sigma is that of another run's residual: of the matches, of the range from the pair's matches,
and of what the servos leave, as scattered over the recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
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
from mastctl.recorder.recorded import Recording
from mastctl.report import pages, pictures
from mastctl.report.pages import Table, x_y
from mastctl.report.pictures import Figure

STEP_PX = 0.01
STEP_RAD = 1e-6
LEAST_PX = 0.02
"""No match is known better than this, whatever it says."""


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
    def residual_px(self) -> FloatArray:
        """(2,) as it was measured."""
        return self.target_px - self.aim_px

    @property
    def left_rad(self) -> FloatArray:
        """(2,) what the servos left of the command."""
        return np.subtract(self.measured_rad, self.commanded_rad)


@dataclass(frozen=True, eq=False)
class WouldBe:
    """A pointing with another mast file.

    ``commanded_rad`` and ``range_m`` as it would have had them; ``would_be_px`` and ``sigma_px``: the
    residual that would have been left, and one sigma of it. None, and a sentence in ``error``, without one.
    """

    operation: str
    pointing: int
    frame_id: str
    recorded_px: FloatArray
    recorded_commanded_rad: tuple[float, float]
    commanded_rad: tuple[float, float] | None = None
    range_m: float | None = None
    would_be_px: FloatArray | None = None
    sigma_px: FloatArray | None = None
    error: str = ""


@dataclass(frozen=True, eq=False)
class HandedAgain:
    """A hand-off to one camera: found less predicted pixel, as recorded and with another mast file."""

    time: str
    camera: str
    recorded_px: FloatArray
    would_be_px: FloatArray | None
    sigma_px: FloatArray
    error: str = ""


def seen_in(
    operations: Mapping[str, Mapping[str, Any]], frames: Mapping[str, Any]
) -> tuple[list[SeenAgain], dict[str, str]]:
    """Return the pointings of a recording that can be worked out again, and why the others cannot.

    ``operations`` are records by id, ``frames`` facts of recorded frames by id.
    """
    found: list[SeenAgain] = []
    others: dict[str, str] = {}
    for name, record in operations.items():
        if "pixel" not in (record.get("request") or {}):
            if set(record.get("request") or {}) & {"position_m", "pan_rad"}:
                others[name] = "it had no image in which anything could be measured"
            continue
        try:
            found += _pointings(name, record, frames)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            others[name] = f"its record does not hold enough ({type(error).__name__}: {error})"
            continue
        if not any(one.operation == name for one in found):
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
    pair_ids = steps["frames", 1]["frame_ids"] if results else []
    rest = steps["rest", 1] if results else {}
    found: list[SeenAgain] = []
    for number, result in enumerate(results, start=1):
        if result.get("target_px") is None:
            continue
        aim_camera = str(result["camera"])
        if number == 1:
            pair = clicked, _camera_of(pair_ids[1])
            pixels = [steps["target", 1]["pixel_px"], steps["stereo", 1]["pixel_px"]]
            sigmas = [steps["target", 1]["sigma_px"], steps["stereo", 1]["sigma_px"]]
            pair_facts, otherwise = frames.get(pair_ids[0]), (rest["pan_rad"], rest["tilt_rad"])
        else:
            before, pair_step = steps["measure", number - 1], steps["eyes", number - 1]
            if len(pair_step["confirmed_by"]) != 1:
                continue  # another pair gave the range; the record of the first pointing says enough
            pair = aim_camera, str(pair_step["confirmed_by"][0])
            pixels = [before["pixel_px"], pair_step[pair[1]]["pixel_px"]]
            sigmas = [before["sigma_px"], before["sigma_px"]]
            last = results[number - 2]
            pair_facts = frames.get(steps["look", number - 1]["frame_ids"][0])
            otherwise = last["measured_pan_rad"], last["measured_tilt_rad"]
        where, pair_approach = _joints(pair_facts, otherwise)
        facts = frames.get(result["frame_id"])
        found.append(
            SeenAgain(
                operation=name,
                pointing=number,
                pair=pair,
                pair_px=np.array(pixels, dtype=float),
                pair_sigma_px=np.maximum(np.array(sigmas, dtype=float), LEAST_PX),
                pair_rad=where,
                aim_camera=aim_camera,
                aim_px=np.array(result["aim_px"], dtype=float),
                commanded_rad=(float(result["commanded_pan_rad"]), float(result["commanded_tilt_rad"])),
                measured_rad=(float(result["measured_pan_rad"]), float(result["measured_tilt_rad"])),
                target_px=np.array(result["target_px"], dtype=float),
                target_sigma_px=np.maximum(np.array(result["residual_sigma_px"], dtype=float), LEAST_PX),
                frame_id=str(result["frame_id"]),
                pair_approach=pair_approach,
                measured_approach=_joints(facts, (0.0, 0.0))[1],
            )
        )
    return found


def pointings_with(rig: Rig, seen: Sequence[SeenAgain]) -> list[WouldBe]:
    """Return each pointing as it would have been with another mast file."""
    servo_rad = _servo_scatter(seen)
    return [_would_be(rig, one, servo_rad) for one in seen]


def _would_be(rig: Rig, seen: SeenAgain, servo_rad: FloatArray) -> WouldBe:
    """One pointing with another mast file."""
    one = WouldBe(seen.operation, seen.pointing, seen.frame_id, seen.residual_px, seen.commanded_rad)
    missing = [name for name in (*seen.pair, seen.aim_camera) if name not in rig.cameras]
    if missing:
        return replace(one, error=f"the mast file has no camera {missing[0]}")
    try:
        commanded, range_m, residual = _residual(rig, seen, seen.pair_px, seen.left_rad)
        sigma = _sigma(rig, seen, residual, servo_rad)
    except CalibError as error:
        return replace(one, error=" ".join(str(error).split()))
    return replace(one, commanded_rad=commanded, range_m=range_m, would_be_px=residual, sigma_px=sigma)


def _residual(
    rig: Rig, seen: SeenAgain, pair_px: FloatArray, left_rad: FloatArray
) -> tuple[tuple[float, float], float, FloatArray]:
    """Commanded angles, range and residual of a pointing with a mast file, of the pair's pixels (2, 2) and
    what the servos leave (2,). Raises CalibError.
    """
    joints, came = rig.joints, seen.measured_approach
    at = joints.true_rad(seen.pair_rad, seen.pair_approach)
    one, other = (rig.camera_in_rover(name, *at) for name in seen.pair)
    target = triangulate(one, other, pair_px[0], pair_px[1]).position_m
    aim = rig.cameras[seen.aim_camera].model
    solutions = solve(rig.mast, aim, target, seen.aim_px)
    pan, tilt = seen.commanded_rad
    chosen = min(solutions, key=lambda s: max(abs(s.pan_rad - pan), abs(s.tilt_rad - tilt)))
    ray = rig.camera_in_rover(seen.aim_camera, *joints.true_rad(seen.measured_rad, came)).ray(seen.target_px)
    range_m = float(np.linalg.norm(target - ray.origins_m))
    position_m = ray.origins_m + range_m * ray.directions
    commanded = joints.read_rad((chosen.pan_rad, chosen.tilt_rad), came)
    reached = commanded[0] + float(left_rad[0]), commanded[1] + float(left_rad[1])
    camera = rig.camera_in_rover(seen.aim_camera, *joints.true_rad(reached, came))
    pixel, _ = camera.project(position_m)
    return commanded, range_m, np.asarray(pixel - seen.aim_px, dtype=float)


def _sigma(rig: Rig, seen: SeenAgain, residual_px: FloatArray, servo_rad: FloatArray) -> FloatArray:
    """(2,) one sigma of another run's residual, by what each measured number moves it."""
    measured = np.concatenate([seen.pair_px.ravel(), seen.left_rad])
    # What the servos leave differs in this run and in the other one.
    sigmas = np.concatenate([seen.pair_sigma_px.ravel(), np.sqrt(2.0) * servo_rad])
    variance = np.square(seen.target_sigma_px)
    for at, (sigma, step) in enumerate(zip(sigmas, [STEP_PX] * 4 + [STEP_RAD] * 2, strict=True)):
        changed = measured.copy()
        changed[at] += step
        _, _, moved_px = _residual(rig, seen, changed[:4].reshape(2, 2), changed[4:])
        variance = variance + np.square((moved_px - residual_px) / step * sigma)
    return np.sqrt(variance)


def _servo_scatter(seen: Sequence[SeenAgain]) -> FloatArray:
    """(2,) rms of what the servos left of their commands, radians."""
    left = np.array([one.left_rad for one in seen]).reshape(-1, 2)
    return np.sqrt(np.mean(np.square(left), axis=0)) if len(left) else np.zeros(2)


def handoffs_with(rig: Rig, handoffs: Sequence[MatchedHandoff]) -> list[HandedAgain]:
    """Return each hand-off that was found, as it would have been predicted with another mast file."""
    rows: list[HandedAgain] = []
    for one in handoffs:
        for camera, landed in one.found.items():
            assert landed.found_px is not None and landed.found_covariance_px2 is not None
            sigma = np.sqrt(np.diag(landed.found_covariance_px2 + landed.geometric_covariance_px2))
            row = HandedAgain(one.time, camera, landed.found_px - landed.geometric_px, None, sigma)
            try:
                again = hand_off(
                    rig, one.pair, [camera], one.joints, *one.clicks_px,
                    to_joints=one.to_joints, sigma_px=one.sigma_px,
                ).pixels[camera]  # fmt: skip
            except (CalibError, KeyError) as error:
                rows.append(replace(row, error=" ".join(str(error).split()) or "no such camera"))
                continue
            assert again is not None
            rows.append(replace(row, would_be_px=landed.found_px - again.pixel_px))
    return rows


def rms(rows: Sequence[FloatArray]) -> tuple[float, float] | None:
    """Return the root mean square of columns, None of nothing."""
    if not rows:
        return None
    x, y = np.sqrt(np.mean(np.square(np.array(rows)), axis=0))
    return float(x), float(y)


def _camera_of(frame_id: str) -> str:
    """The camera in a frame's id: the part before its count, mast file and run."""
    return frame_id.rsplit("-", 3)[0]


def _joints(facts: Any, otherwise: tuple[float, float]) -> tuple[tuple[float, float], Approach]:
    """Joint angles of a recorded frame as read, or those of the step before it, and from which side."""
    if facts is None:
        return (float(otherwise[0]), float(otherwise[1])), UNKNOWN
    approach = float(facts.get("pan_approach", 0.0)), float(facts.get("tilt_approach", 0.0))
    return (float(facts["pan_rad"]), float(facts["tilt_rad"])), approach


@dataclass(frozen=True, eq=False)
class WhatIf:
    """A recording, the other mast file, and what came out."""

    recording: Recording
    mast: StoredRig
    pointings: Sequence[WouldBe]
    handoffs: Sequence[HandedAgain]
    others: Mapping[str, str]

    def as_json(self) -> dict[str, Any]:
        """Return everything for programs."""
        name, stored = self.recording.first_mast
        return {
            "recording": str(self.recording.path),
            "recorded_mast": {"name": name.name, "digest": stored.digest},
            "mast": {"name": self.mast.path.name, "digest": self.mast.digest},
            "rms_px": {
                key: {"recorded": rms(was), "would_be": rms(would)} for key, was, would in self.columns()
            },
            "pointings": as_json(self.pointings),
            "handoffs": as_json(self.handoffs),
            "not_worked_out": dict(self.others),
        }

    def columns(self) -> list[tuple[str, list[FloatArray], list[FloatArray]]]:
        """Return, for first and later pointings and for each camera handed to: its name, residuals as they
        were recorded, and as they would have been.
        """
        rows: list[tuple[str, WouldBe | HandedAgain]] = [
            ("first pointing" if one.pointing == 1 else "second pointing", one) for one in self.pointings
        ]
        found: dict[str, tuple[list[FloatArray], list[FloatArray]]] = {}
        for key, row in [*rows, *((f"hand-off to {one.camera}", one) for one in self.handoffs)]:
            if row.would_be_px is not None:
                was, would = found.setdefault(key, ([], []))
                was.append(row.recorded_px)
                would.append(row.would_be_px)
        return [(key, *both) for key, both in sorted(found.items())]


def summary_table(what_if: WhatIf) -> Table:
    """Return the rms before and after, a row a kind."""
    headings = ("what", "number", "recorded rms x, y (px)", "would be rms x, y (px)")
    rows = [
        [key, str(len(was)), x_y(rms(was), 3), x_y(rms(would), 3)] for key, was, would in what_if.columns()
    ]
    return Table(headings, rows)


def pointing_table(what_if: WhatIf) -> Table:
    """Return each pointing."""
    rows = [
        [
            one.operation, str(one.pointing), x_y(one.recorded_px, 3), x_y(one.would_be_px, 3) or one.error,
            x_y(one.sigma_px, 3),
        ]
        for one in what_if.pointings
    ]  # fmt: skip
    return Table(("operation", "pointing", "recorded (px)", "would be (px)", "sigma (px)"), rows)


def handoff_table(what_if: WhatIf) -> Table:
    """Return each hand-off."""
    headings = ("hand-off", "to", "recorded x, y (px)", "would be x, y (px)", "sigma x, y (px)")
    rows = [
        [one.time, one.camera, x_y(one.recorded_px), x_y(one.would_be_px) or one.error, x_y(one.sigma_px)]
        for one in what_if.handoffs
    ]
    return Table(headings, rows)


def other_lines(what_if: WhatIf) -> list[str]:
    """Return why some operations were not worked out."""
    return [f"operation {name} is not worked out: {why}" for name, why in what_if.others.items()]


def write_what_if(what_if: WhatIf, folder: Path) -> Path:
    """Write the page ``what_if.html`` into a folder, which is made if need be; return it. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    name, stored = what_if.recording.first_mast
    summary = what_if.recording.summary()
    hardware = what_if.recording.facts.get("hardware", "unknown")
    facts = [
        (
            "recording",
            f"{what_if.recording.path.name}, {summary['seconds']:.0f} s, {summary['frames']} images",
        ),
        ("recorded with", f"{name.name} ({stored.digest[:12]})"),
        ("what if", f"{what_if.mast.path.name} ({what_if.mast.digest[:12]})"),
    ]
    html = pages.page(
        "what_if.html",
        title=f"What if: {what_if.mast.path.name}",
        badge=pages.Badge(hardware.upper(), hardware),
        facts=facts,
        summary=summary_table(what_if),
        pointings=pointing_table(what_if),
        handoffs=handoff_table(what_if),
        plot=_plot(what_if) if what_if.columns() and pictures.can_plot() else None,
        answered=bool(what_if.columns()),
        others=other_lines(what_if),
    )
    page = folder / "what_if.html"
    page.write_text(html, encoding="utf-8", errors="backslashreplace")
    return page


def _plot(what_if: WhatIf) -> Figure:
    """Residuals as recorded and as they would have been, an arrow from the one to the other."""
    columns = what_if.columns()
    figure = pictures.new_plot(min(4.2 * len(columns), 13.0), 4.0)
    axes = figure.subplots(1, len(columns), squeeze=False)[0]
    for axis, (key, was, would) in zip(axes, columns, strict=True):
        before, after = np.array(was), np.array(would)
        for one, other in zip(before, after, strict=True):
            axis.annotate("", other, one, arrowprops={"arrowstyle": "-", "color": "0.7", "lw": 0.8})
        axis.plot(*before.T, "x", color=pictures.RUST, ms=6, label="recorded")
        axis.plot(*after.T, "o", color=pictures.BLUE, ms=5, mfc="none", label="would be")
        most = 1.15 * max(0.1, float(np.abs(np.concatenate([before, after])).max()))
        axis.axhline(0.0, color="0.6", lw=0.6)
        axis.axvline(0.0, color="0.6", lw=0.6)
        axis.set(title=key, xlabel="x, px", ylabel="y, px (down)", xlim=(-most, most), ylim=(most, -most))
        axis.set_aspect("equal")
        axis.legend(fontsize=8, loc="upper right")
    return pictures.plot(figure, "residuals as recorded and as they would have been")
