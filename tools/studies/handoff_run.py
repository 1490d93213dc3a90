"""The paper's hand-off experiment (section V) through the HTTP interface of a running daemon.

For each target, a textured pixel of ground at the distance: look at it with the source pair, take the
destination pair's pictures at the same joint angles, and hand the target over: geometrically, and by image.
On a simulated rover the error is against the truth; on a real one the refined pixel takes its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.files.mast_file import parse_rig
from calib.geometry.covariance import stored_covariance
from calib.geometry.handoff import Joints, PredictedPixel, hand_off
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.handoff import MatchedHandoff, RefinedPixel, matched_handoff, refine_handoff
from calib.matching.warp import PosedImage, grey
from mastctl.client import Client, ClientError, Snapshot
from mastctl.experiment.pointing import ClickTruth
from mastctl.experiment.targets import VIEWS_PER_TARGET, Target, TargetViews
from mastctl.motion.search import JOINT_SIGMA_RAD

STEPS: tuple[tuple[str, str, float], ...] = (("pancam", "navcam", 6.0), ("navcam", "hazcam", 2.0))
"""The paper's hand-offs: from, to, distance in metres."""

PAN_RANGE_RAD = {"pancam": 1.0, "navcam": 0.35}
"""How far to either side targets lie: the body's cameras do not turn with the head."""


@dataclass(frozen=True, eq=False)
class Handed:
    """One target in one destination camera.

    ``true_px`` is where the target really is, None where that is not known.
    """

    camera: str
    geometric: PredictedPixel
    refined: RefinedPixel
    true_px: tuple[float, float] | None

    @property
    def geometric_error_px(self) -> tuple[float, float] | None:
        """Geometric less true; less refined where the truth is not known; None where neither is."""
        return self._error(self.geometric.pixel_px)

    @property
    def refined_error_px(self) -> tuple[float, float] | None:
        """Refined less true; None where the refinement was not accepted or the truth is not known."""
        return None if self.true_px is None else self._error(self.refined.pixel_px)

    def _error(self, pixel_px: FloatArray) -> tuple[float, float] | None:
        off = pixel_px - (self.refined.pixel_px if self.true_px is None else np.array(self.true_px))
        return (float(off[0]), float(off[1])) if np.isfinite(off).all() else None


@dataclass(frozen=True, eq=False)
class HandoffRecord:
    """One target of one step: what each destination camera saw, or why it failed."""

    step: str
    index: int
    handed: tuple[Handed, ...] = ()
    error: str = ""
    matched: MatchedHandoff | None = None


def run_handoff_experiment(
    client: Client,
    *,
    targets: int,
    seed: int = 1,
    click_px: float = 0.2,
    truth: ClickTruth | None = None,
    on_target: Callable[[HandoffRecord], None] | None = None,
    first: int = 0,
    chosen: Sequence[str] | None = None,
) -> list[HandoffRecord]:
    """Run the paper's two hand-offs and return a record for each target.

    Each target has its own draw, from number ``first`` on; ``click_px`` is the sigma of the noise that is
    added to both clicks, each axis. Only a simulation knows the ``truth``: where a clicked point really is in
    another frame. ``chosen`` are the pairs whose steps are run, all when left out.

    Raises
    ------
    ClientError
        If the daemon cannot be reached, or serves no two pairs of the paper's steps.
    """
    status = client.status()
    rig = parse_rig(client.mast_file(), "the daemon's mast file").rig
    wanted = [step for step in STEPS if chosen is None or step[0] in chosen]
    steps = [step for step in wanted if all(_served(rig, status, pair) for pair in step[:2])]
    if not steps:
        raise ClientError(
            "no_handoff",
            "the daemon serves neither pancam and navcam nor navcam and hazcam pairs to hand over between",
        )
    records: list[HandoffRecord] = []
    for source, to, distance_m in steps:
        pan_rad = PAN_RANGE_RAD[source]
        limits = status["limits"]
        run = _HandoffRun(client, rig, (source, to), distance_m, click_px, truth)
        for index in range(first, first + targets):
            rng = np.random.default_rng([seed, round(1000 * distance_m), index])
            views = TargetViews(client, rig, rig.stereo[source], limits, rng, pan_rad)
            records.append(run.one_target(index, views, rng))
            if on_target is not None:
                on_target(records[-1])
    return records


def _served(rig: Rig, status: Mapping[str, Any], pair: str) -> bool:
    return pair in rig.stereo and all(camera in status["cameras"] for camera in rig.stereo[pair])


@dataclass(frozen=True, eq=False)
class _HandoffRun:
    """One step of the running experiment."""

    client: Client
    rig: Rig
    pairs: tuple[str, str]
    distance_m: float
    click_px: float
    truth: ClickTruth | None

    def one_target(self, index: int, views: TargetViews, rng: np.random.Generator) -> HandoffRecord:
        """Find one target, hand it over, and return the record of it."""
        reason = f"no textured target found at {self.distance_m:g} m in {VIEWS_PER_TARGET} views"
        for _ in range(VIEWS_PER_TARGET):
            try:
                target = views.find_target(self.distance_m)
                if target is not None:
                    shots = {name: self.client.snapshot(name) for name in self.rig.stereo[self.pairs[1]]}
                    return self._hand_over(target, shots, index, rng)
            except (ClientError, CalibError) as error:
                reason = f"{getattr(error, 'code', 'error')}: {error}"
                if getattr(error, "code", "") != "not_seen":
                    break
        return HandoffRecord(self._step, index, error=reason)

    @property
    def _step(self) -> str:
        return " to ".join(self.pairs)

    def _hand_over(
        self, target: Target, shots: Mapping[str, Snapshot], index: int, rng: np.random.Generator
    ) -> HandoffRecord:
        """Hand a target over; raises NoHandoff where no destination camera sees it."""
        source, to = (self.rig.stereo[pair] for pair in self.pairs)
        exact = np.array([(target.x_px, target.y_px), target.right_px])
        clicks = exact + rng.normal(0.0, self.click_px, (2, 2))
        at = Joints(*target.shot.true_rad, JOINT_SIGMA_RAD)
        to_joints = Joints(*next(iter(shots.values())).true_rad, JOINT_SIGMA_RAD)
        sigma_px = max(self.click_px, 0.05)
        done = hand_off(
            self.rig, source, to, at, *clicks,
            to_joints=to_joints, sigma_px=sigma_px, calibration=stored_covariance(self.rig),
        )  # fmt: skip
        cameras = (self._camera(target.shot), self._camera(target.right))
        refined = refine_handoff(
            done, cameras, clicks, {name: self._camera(one) for name, one in shots.items()}
        )
        handed = [
            Handed(name, predicted, refined[name], self._true(target, shots[name]))
            for name, predicted in done.pixels.items()
            if predicted is not None
        ]
        matched = matched_handoff(
            target.shot.mast_digest, source, at, clicks, sigma_px, to_joints, done, refined
        )
        return HandoffRecord(self._step, index, tuple(handed), matched=matched)

    def _camera(self, shot: Snapshot) -> PosedImage:
        return PosedImage(grey(shot.image), self.rig.camera_in_rover(shot.camera, *shot.true_rad))

    def _true(self, target: Target, shot: Snapshot) -> tuple[float, float] | None:
        """Where the target is, that the clicks miss by their noise."""
        if self.truth is None:
            return None
        exact = (target.x_px, target.y_px)
        return self.truth(target.shot.frame_id, exact, shot.frame_id, (0.0, 0.0))
