"""The paper's hand-off experiment (section V) through the HTTP interface of a running daemon.

For each target: look at it with the source pair, take the destination pair's pictures at the same joint
angles, and hand the target over: geometrically, and by image. Targets are textured pixels of ground at the
distance, or points that are known exactly. On a simulated rover the error is against the truth; on a real one
the refined pixel stands in for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from calib.errors import CalibError
from calib.files.mast_file import parse_rig
from calib.geometry.covariance import RigCovariance, stored_covariance
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.handed_over import matched_handoff
from calib.matching.handoff import Eye, refine_handoff
from calib.matching.warp import grey
from mastctl.client import Client, ClientError, Snapshot
from mastctl.experiment.pointing import ClickTruth, RunTime
from mastctl.experiment.targets import VIEWS_PER_TARGET, Target, TargetViews
from mastctl.motion.pairs import JOINT_SIGMA_RAD
from tools.studies.handoff_record import (
    Handed,
    HandoffExperiment,
    HandoffRecord,
    summarise_handoffs,
)

STEPS: tuple[tuple[str, str, float], ...] = (("pancam", "navcam", 6.0), ("navcam", "hazcam", 2.0))
"""The paper's hand-offs: from, to, distance in metres."""

PAN_RANGE_RAD = {"pancam": 1.0, "navcam": 0.35}
"""How far to either side targets lie: the body's cameras do not turn with the head."""

KNOWN_SLACK = 0.2
"""Known points count as at a distance within this share of it."""


@dataclass(frozen=True, eq=False)
class KnownPoint:
    """A point (3,) of the rover frame; points of one ``group`` lie near each other."""

    kind: str
    group: int
    position_m: FloatArray


class KnownPoints(Protocol):
    """Known points, and where frames truly show them."""

    def points(self) -> Sequence[KnownPoint]:
        """All of them, group by group."""

    def seen_px(self, frame_id: str, position_m: FloatArray) -> tuple[float, float] | None:
        """Where a frame shows a point; None if it is hidden or outside."""


def run_handoff_experiment(
    client: Client,
    *,
    targets: int,
    seed: int = 1,
    click_px: float = 0.2,
    truth: ClickTruth | None = None,
    points: KnownPoints | None = None,
    on_target: Callable[[HandoffRecord], None] | None = None,
    pictures: int = 0,
    first: int = 0,
    chosen: Sequence[str] | None = None,
) -> HandoffExperiment:
    """Run the paper's two hand-offs and return the record.

    Parameters
    ----------
    client
        A client of the daemon that moves the mast.
    targets
        Targets of each step; with ``points``, no more of them than that.
    seed
        Chooses views, pixels and the noise of clicks; each target has its own draw, whatever came before it.
    click_px
        Sigma of the noise that is added to both clicks, each axis, as a person would make it.
    truth
        Where a clicked point really is in another frame; only a simulation knows.
    points
        Take these for targets instead of textured ground.
    on_target
        Called after each target, failed or not.
    pictures
        How many targets of each step keep their images for the report; with ``points``, all those of so many
        views.
    first
        The number of the first target of each step; without ``points``.
    chosen
        Only the steps from these pairs.

    Raises
    ------
    ClientError
        If the daemon cannot be reached, or serves no two pairs of the paper's steps.
    """
    clock = RunTime(client)
    status = client.status()
    rig = parse_rig(client.mast_file(), "the daemon's mast file").rig
    wanted = [step for step in STEPS if chosen is None or step[0] in chosen]
    steps = [step for step in wanted if all(_served(rig, status, pair) for pair in step[:2])]
    if not steps:
        raise ClientError(
            "no_handoff",
            "the daemon serves neither pancam and navcam nor navcam and hazcam pairs to hand over between",
        )
    calibration = stored_covariance(rig)
    records: list[HandoffRecord] = []
    for source, to, distance_m in steps:
        bench = _HandoffRun(
            client,
            rig,
            (source, to),
            distance_m,
            status["limits"],
            seed,
            click_px,
            truth,
            points,
            calibration,
            clock,
        )
        found = (
            bench.known(points, targets, pictures)
            if points
            else bench.chosen(range(first, first + targets), pictures)
        )
        for record in found:
            records.append(record)
            if on_target is not None:
                on_target(record)
    kinds = list(dict.fromkeys(record.kind for record in records))
    summaries = [
        summarise_handoffs(f"{source} to {to}", kind, camera, records)
        for source, to, _ in steps
        for kind in kinds
        for camera in rig.stereo[to]
    ]
    return HandoffExperiment(
        status, seed, click_px, tuple(records), tuple(summaries), clock.started, clock.since_s()
    )


def _served(rig: Rig, status: Mapping[str, Any], pair: str) -> bool:
    return pair in rig.stereo and all(camera in status["cameras"] for camera in rig.stereo[pair])


def _reason(error: ClientError | CalibError) -> str:
    """Why a target failed, as its record says it."""
    return f"{getattr(error, 'code', 'error')}: {error}"


class _HandoffRun:
    """One step of the running experiment."""

    def __init__(
        self,
        client: Client,
        rig: Rig,
        pairs: tuple[str, str],
        distance_m: float,
        limits: Mapping[str, Any],
        seed: int,
        click_px: float,
        truth: ClickTruth | None,
        points: KnownPoints | None,
        calibration: RigCovariance | None,
        clock: RunTime,
    ) -> None:
        self._clock = clock
        self.step = f"{pairs[0]} to {pairs[1]}"
        self._client = client
        self._rig = rig
        self._source, self._to = (rig.stereo[pair] for pair in pairs)
        self._distance_m = distance_m
        self._seed = seed
        self._click_px = click_px
        self._truth = truth
        self._points = points
        self._calibration = calibration
        self._limits = limits
        self._pan_range_rad = PAN_RANGE_RAD[pairs[0]]
        self._draw_for(0)

    def _draw_for(self, number: int) -> None:
        """Begin the draw of a target, or of a view of known points."""
        self._rng = np.random.default_rng([self._seed, round(1000 * self._distance_m), number])
        self._views = TargetViews(
            self._client, self._rig, self._source, self._limits, self._rng, self._pan_range_rad
        )

    def chosen(self, numbers: Sequence[int], pictures: int) -> Iterator[HandoffRecord]:
        """Hand over textured ground at the distance; the first few records keep their pictures."""
        for index in numbers:
            record = self._one_target(index, pictures > 0)
            pictures -= record.source_image is not None
            yield record

    def known(self, points: KnownPoints, targets: int, pictures: int) -> Iterator[HandoffRecord]:
        """Hand over known points near the distance, all that one view shows from the same pictures.

        A view that fails is one failed target: which of its points it would have shown, nobody knows.
        """
        left = self._rig.camera_in_rover(self._source[0], 0.0, 0.0)
        groups: dict[int, list[KnownPoint]] = {}
        for point in points.points():
            away_m = float(np.linalg.norm(point.position_m - left.C))
            if abs(away_m - self._distance_m) <= KNOWN_SLACK * self._distance_m:
                groups.setdefault(point.group, []).append(point)
        index = 0
        for number, group in groups.items():
            if index == targets:
                return
            self._draw_for(number)
            begun_s = self._clock.now_s()
            try:
                pair = self._views.look_at(np.mean([point.position_m for point in group], axis=0))
                if pair is None:
                    continue
                shots = {name: self._client.snapshot(name) for name in self._to}
            except ClientError as error:
                yield self._failed(index, group[0].kind, _reason(error), begun_s)
                index += 1
                continue
            pictures -= 1
            for point in group:
                if index == targets:
                    return
                target = self._known_target(points, point, pair, shots)
                if target is None:
                    continue
                try:
                    record = self._hand_over(target, shots, index, begun_s, pictures >= 0)
                except CalibError as error:
                    record = self._failed(index, point.kind, _reason(error), begun_s)
                index += 1
                begun_s = self._clock.now_s()
                yield record

    def _known_target(
        self,
        points: KnownPoints,
        point: KnownPoint,
        pair: tuple[Snapshot, Snapshot],
        shots: Mapping[str, Snapshot],
    ) -> Target | None:
        """The point as a target, if it shows in all four pictures."""
        seen = [points.seen_px(shot.frame_id, point.position_m) for shot in (*pair, *shots.values())]
        left, right = seen[:2]
        if left is None or right is None or None in seen:
            return None
        model = self._rig.camera_in_rover(self._source[0], *pair[0].true_rad)
        range_m = float(np.linalg.norm(point.position_m - model.C))
        return Target(pair[0], *left, range_m, pair[1], right, point.kind, point.position_m)

    def _one_target(self, index: int, with_pictures: bool) -> HandoffRecord:
        """Find one target, hand it over, and return the record of it."""
        begun_s = self._clock.now_s()
        self._draw_for(index)
        reason = f"no textured target found at {self._distance_m:g} m in {VIEWS_PER_TARGET} views"
        for _ in range(VIEWS_PER_TARGET):
            try:
                target = self._views.find_target(self._distance_m)
                if target is not None:
                    shots = {name: self._client.snapshot(name) for name in self._to}
                    return self._hand_over(target, shots, index, begun_s, with_pictures)
            except (ClientError, CalibError) as error:
                reason = _reason(error)
                if getattr(error, "code", "") != "not_seen":
                    break
        return self._failed(index, "ground", reason, begun_s)

    def _failed(self, index: int, kind: str, reason: str, begun_s: float) -> HandoffRecord:
        """The record of a target that was not handed over."""
        nan, seconds = (math.nan, math.nan), self._clock.since_s(begun_s)
        return HandoffRecord(
            self.step,
            index,
            self._distance_m,
            math.nan,
            "",
            nan,
            (),
            error=reason,
            seconds=seconds,
            kind=kind,
        )

    def _hand_over(
        self, target: Target, shots: Mapping[str, Snapshot], index: int, begun_s: float, with_pictures: bool
    ) -> HandoffRecord:
        """Hand a target over; raises NoHandoff where no destination camera sees it."""
        exact = np.array([(target.x_px, target.y_px), target.right_px])
        clicks = exact + self._rng.normal(0.0, self._click_px, (2, 2))
        joints = Joints(*target.shot.true_rad, JOINT_SIGMA_RAD)
        there = next(iter(shots.values()))
        to_joints = Joints(*there.true_rad, JOINT_SIGMA_RAD)
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
            seconds=self._clock.since_s(begun_s),
            source_image=target.shot.image if with_pictures else None,
            kind=target.kind,
            matched=matched_handoff(
                target.shot.mast_digest, self._source, joints, clicks, sigma_px, to_joints, done, refined
            ),
        )

    def _eye(self, shot: Snapshot) -> Eye:
        model = self._rig.camera_in_rover(shot.camera, *shot.true_rad)
        return Eye(grey(shot.image), model)

    def _true(self, target: Target, shot: Snapshot) -> tuple[float, float] | None:
        """Where the target is, that the clicks miss by their noise."""
        if target.point_m is not None and self._points is not None:
            return self._points.seen_px(shot.frame_id, target.point_m)
        if self._truth is None:
            return None
        exact = (target.x_px, target.y_px)
        return self._truth.residual_px(target.shot.frame_id, exact, shot.frame_id, (0.0, 0.0))
