"""The paper's hand-off experiment (section V) through the HTTP interface of a running daemon.

For each target: look at ground at the distance with the source pair, choose a textured pixel, take the
destination pair's pictures at the same joint angles, and hand the target over: geometrically, and by image.
On a simulated rover the error is against the truth; on a real one the refined pixel stands in for it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.handoff import Joints, Predicted, hand_off
from calib.handoff_bias import HandoffBias, handoff_bias
from calib.handoff_refined import Eye, RefinedPixel, refine_handoff
from calib.mast import Rig
from calib.matched_handoff import MatchedHandoff, matched_handoff
from calib.rig_covariance import RigCovariance, stored_covariance
from calib.store import parse_rig
from calib.warp import grey
from drivers.interfaces import Image
from mastctl.client import Client, ClientError, Snapshot
from mastctl.experiment.pointing import Truth
from mastctl.experiment.targets import Target
from mastctl.experiment.views import VIEWS_PER_TARGET, Views

PAPER_WORST_PX: Mapping[str, float] = {"pancam to navcam": 2.5, "navcam to hazcam": 4.0}
"""The paper's worst geometric hand-off, Pancam to Navcam at 6 m and Navcam to Hazcam at 2 m."""

STEPS: tuple[tuple[str, str, float], ...] = (("pancam", "navcam", 6.0), ("navcam", "hazcam", 2.0))
"""The paper's hand-offs: from, to, distance in metres."""

PAN_RANGE_RAD = {"pancam": 1.0, "navcam": 0.35}
"""How far to either side targets lie: the body's cameras do not turn with the head."""

JOINT_SIGMA_RAD = 3e-5
"""What a joint reading is taken to be wrong by: half a step of a stepped pan/tilt unit."""


@dataclass(frozen=True, eq=False)
class Handed:
    """One target in one destination camera.

    ``geometric`` and ``refined`` are what the hand-off says; ``true_px`` where the target really is, None
    where nobody knows.
    """

    camera: str
    geometric: Predicted
    refined: RefinedPixel
    true_px: tuple[float, float] | None
    image: Image | None = None

    @property
    def geometric_error_px(self) -> tuple[float, float] | None:
        """Geometric less true; less refined where the truth is not known; None where neither is."""
        return self._error(self.geometric.pixel_px)

    @property
    def refined_error_px(self) -> tuple[float, float] | None:
        """Refined less true; None where the refinement was not accepted or the truth is not known."""
        return None if self.true_px is None else self._error(self.refined.pixel_px)

    def _error(self, pixel_px: np.ndarray) -> tuple[float, float] | None:
        reference = self.refined.pixel_px if self.true_px is None else np.array(self.true_px)
        off = pixel_px - reference
        return (float(off[0]), float(off[1])) if np.isfinite(off).all() else None


@dataclass(frozen=True, eq=False)
class HandoffRecord:
    """One target of one step: what each destination camera saw, or why it failed."""

    step: str
    index: int
    distance_m: float
    range_m: float
    frame_id: str
    clicked_px: tuple[float, float]
    handed: tuple[Handed, ...]
    error: str = ""
    seconds: float = 0.0
    source_image: Image | None = None
    matched: MatchedHandoff | None = None


@dataclass(frozen=True)
class HandoffSummary:
    """One row of the table: one step, one camera. Numbers are None where there is nothing to average."""

    step: str
    camera: str
    targets: int
    failed: int
    geometric_rms_px: tuple[float, float] | None
    geometric_bias_px: tuple[float, float] | None
    geometric_worst_px: float | None
    accepted: int
    refined_rms_px: float | None
    refined_worst_px: float | None
    verdicts: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class HandoffExperiment:
    """What was run and what came out."""

    status: Mapping[str, Any]
    seed: int
    click_px: float
    records: tuple[HandoffRecord, ...]
    summaries: tuple[HandoffSummary, ...]
    started: str
    seconds: float

    @property
    def bias(self) -> tuple[HandoffBias, ...]:
        """The mean offset of what was found from what was predicted, by camera."""
        return handoff_bias([r.matched for r in self.records if r.matched is not None])

    def as_json(self) -> dict[str, Any]:
        """Return the whole record for programs."""
        return {
            "hardware": self.status.get("hardware"),
            "seed": self.seed,
            "click_px": self.click_px,
            "seconds": round(self.seconds, 2),
            "handoffs": [
                {
                    "handoff": row.step,
                    "camera": row.camera,
                    "targets": row.targets,
                    "failed": row.failed,
                    "geometric_rms_px": row.geometric_rms_px,
                    "geometric_bias_px": row.geometric_bias_px,
                    "geometric_worst_px": row.geometric_worst_px,
                    "accepted": row.accepted,
                    "refined_rms_px": row.refined_rms_px,
                    "refined_worst_px": row.refined_worst_px,
                    "verdicts": dict(row.verdicts),
                    "paper_worst_px": PAPER_WORST_PX.get(row.step),
                }
                for row in self.summaries
            ],
            "bias": [
                {
                    "camera": one.camera,
                    "source": one.source,
                    "offset_px": one.offset_px.tolist(),
                    "sigmas": one.sigmas,
                    "sentence": one.sentence,
                }
                for one in self.bias
            ],
            "failures": [
                {"handoff": r.step, "target": r.index, "error": r.error} for r in self.records if r.error
            ],
        }


def run_handoff_experiment(
    client: Client,
    *,
    targets: int,
    seed: int = 1,
    click_px: float = 0.2,
    truth: Truth | None = None,
    on_target: Callable[[HandoffRecord], None] | None = None,
    pictures: int = 0,
) -> HandoffExperiment:
    """Run the paper's two hand-offs and return the record.

    Parameters
    ----------
    client
        A client of the daemon that moves the mast.
    targets
        Targets of each step.
    seed
        Chooses views, pixels and the noise of clicks.
    click_px
        Sigma of the noise that is added to both clicks, each axis, as a person would make it.
    truth
        Where a clicked point really is in another frame; only a simulation knows.
    on_target
        Called after each target, failed or not.
    pictures
        How many targets of each step keep their images for the report.

    Raises
    ------
    ClientError
        If the daemon cannot be reached, or serves no two pairs of the paper's steps.
    """
    started, begun_s = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), time.monotonic()
    status = client.status()
    rig = parse_rig(client.mast_file(), "the daemon's mast file").rig
    steps = [step for step in STEPS if all(_served(rig, status, pair) for pair in step[:2])]
    if not steps:
        raise ClientError(
            "no_handoff",
            "the daemon serves neither pancam and navcam nor navcam and hazcam pairs to hand over between",
        )
    calibration = stored_covariance(rig)
    rng = np.random.default_rng(seed)
    records: list[HandoffRecord] = []
    for source, to, distance_m in steps:
        bench = _Bench(
            client, rig, (source, to), distance_m, status["limits"], rng, click_px, truth, calibration
        )
        for index in range(targets):
            kept = sum(r.source_image is not None for r in records if r.step == bench.step)
            record = bench.one_target(index, kept < pictures)
            records.append(record)
            if on_target is not None:
                on_target(record)
    summaries = [
        summarise(f"{source} to {to}", camera, records)
        for source, to, _ in steps
        for camera in rig.stereo[to]
    ]
    return HandoffExperiment(
        status, seed, click_px, tuple(records), tuple(summaries), started, time.monotonic() - begun_s
    )


def summarise(step: str, camera: str, records: Sequence[HandoffRecord]) -> HandoffSummary:
    """Return the table's row of one camera of one step."""
    mine = [r for r in records if r.step == step]
    seen = [h for r in mine for h in r.handed if h.camera == camera]
    geometric = np.array([e for h in seen if (e := h.geometric_error_px) is not None]).reshape(-1, 2)
    refined = np.array([e for h in seen if (e := h.refined_error_px) is not None]).reshape(-1, 2)
    verdicts: dict[str, int] = {}
    for one in seen:
        verdicts[one.refined.verdict] = verdicts.get(one.refined.verdict, 0) + 1
    return HandoffSummary(
        step,
        camera,
        len(mine),
        sum(bool(r.error) for r in mine),
        _pair(np.sqrt(np.mean(geometric**2, axis=0))) if len(geometric) else None,
        _pair(geometric.mean(axis=0)) if len(geometric) else None,
        float(np.linalg.norm(geometric, axis=1).max()) if len(geometric) else None,
        verdicts.get("accepted", 0),
        float(np.sqrt(np.mean(np.sum(refined**2, axis=1)))) if len(refined) else None,
        float(np.linalg.norm(refined, axis=1).max()) if len(refined) else None,
        verdicts,
    )


def _pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _served(rig: Rig, status: Mapping[str, Any], pair: str) -> bool:
    return pair in rig.stereo and all(camera in status["cameras"] for camera in rig.stereo[pair])


class _Bench:
    """One step of the running experiment."""

    def __init__(
        self,
        client: Client,
        rig: Rig,
        pairs: tuple[str, str],
        distance_m: float,
        limits: Mapping[str, Any],
        rng: np.random.Generator,
        click_px: float,
        truth: Truth | None,
        calibration: RigCovariance | None,
    ) -> None:
        self.step = f"{pairs[0]} to {pairs[1]}"
        self._client = client
        self._rig = rig
        self._source, self._to = (rig.stereo[pair] for pair in pairs)
        self._distance_m = distance_m
        self._rng = rng
        self._click_px = click_px
        self._truth = truth
        self._calibration = calibration
        self._views = Views(client, rig, self._source, limits, rng, PAN_RANGE_RAD[pairs[0]])

    def one_target(self, index: int, with_pictures: bool) -> HandoffRecord:
        """Find one target, hand it over, and return the record of it."""
        begun_s = time.monotonic()
        reason = f"no textured target found at {self._distance_m:g} m in {VIEWS_PER_TARGET} views"
        for _ in range(VIEWS_PER_TARGET):
            try:
                target = self._views.find_target(self._distance_m)
                if target is not None:
                    return self._hand_over(target, index, begun_s, with_pictures)
            except (ClientError, CalibError) as error:
                reason = f"{getattr(error, 'code', 'error')}: {error}"
                if getattr(error, "code", "") != "not_seen":
                    break
        nan = (math.nan, math.nan)
        seconds = time.monotonic() - begun_s
        return HandoffRecord(
            self.step, index, self._distance_m, math.nan, "", nan, (), error=reason, seconds=seconds
        )

    def _hand_over(self, target: Target, index: int, begun_s: float, with_pictures: bool) -> HandoffRecord:
        """Hand a target over; raises NoHandoff where no destination camera sees it."""
        shots = {name: self._client.snapshot(name) for name in self._to}
        exact = np.array([(target.x_px, target.y_px), target.right_px])
        clicks = exact + self._rng.normal(0.0, self._click_px, (2, 2))
        joints = Joints(target.shot.pan_rad, target.shot.tilt_rad, JOINT_SIGMA_RAD)
        there = next(iter(shots.values()))
        to_joints = Joints(there.pan_rad, there.tilt_rad, JOINT_SIGMA_RAD)
        sigma_px = max(self._click_px, 0.05)
        done = hand_off(
            self._rig,
            self._source,
            self._to,
            joints,
            clicks[0],
            clicks[1],
            to_joints=to_joints,
            sigma_px=sigma_px,
            calibration=self._calibration,
        )
        refined = refine_handoff(
            done,
            (self._eye(target.shot), self._eye(target.right)),
            clicks,
            {name: self._eye(shot) for name, shot in shots.items()},
        )
        handed = []
        for name, predicted in done.pixels.items():
            if predicted is None:
                continue
            true = self._true(target, shots[name])
            image = shots[name].image if with_pictures else None
            handed.append(Handed(name, predicted, refined[name], true, image))
        return HandoffRecord(
            self.step,
            index,
            self._distance_m,
            target.range_m,
            target.shot.frame_id,
            (float(clicks[0, 0]), float(clicks[0, 1])),
            tuple(handed),
            seconds=time.monotonic() - begun_s,
            source_image=target.shot.image if with_pictures else None,
            matched=matched_handoff(
                target.shot.mast_digest, self._source, joints, clicks, sigma_px, to_joints, done, refined
            ),
        )

    def _eye(self, shot: Snapshot) -> Eye:
        model = self._rig.camera_in_rover(shot.camera, shot.pan_rad, shot.tilt_rad)
        return Eye(grey(shot.image), model)

    def _true(self, target: Target, shot: Snapshot) -> tuple[float, float] | None:
        """Where the target is, that the clicks miss by their noise."""
        if self._truth is None:
            return None
        exact = (target.x_px, target.y_px)
        return self._truth.residual_px(target.shot.frame_id, exact, shot.frame_id, (0.0, 0.0))
