"""The paper's pointing experiment (section IV, Table VI) through the HTTP interface of a running daemon.

For each distance: turn to the ground, choose a textured pixel of the left image at random, have the
daemon point at it twice, and take the residuals that the daemon measured in new images. A target that
fails is a row of its own with the reason; it never leaves the record.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import nan
from typing import Any

import numpy as np

from calib.files.mast_file import parse_rig
from calib.geometry.rig import Rig
from drivers.interfaces import Image
from mastctl.client import Client, ClientError
from mastctl.experiment.targets import VIEWS_PER_TARGET, Target, TargetViews, pointed

XY = tuple[float, float]

PAPER_TABLE_VI: Mapping[float, tuple[XY, XY]] = {
    10.0: ((0.591, 1.219), (0.527, 0.778)),
    6.0: ((0.743, 1.243), (0.596, 0.844)),
    2.0: ((1.260, 0.925), (0.672, 0.921)),
}
"""Rms pixel errors (x, y) of the paper: first and second pointing at each distance in metres."""

ENDING = ("stopped", "estopped", "leased")
"""Another client has stopped the mast or steers it: no further target moves the head."""

PAN_RANGE_RAD = 1.0
"""Targets lie this far to either side of straight ahead: the pan range of the paper's calibration (III.C)."""

ClickTruth = Callable[[str, XY, str, XY], XY | None]
"""What only a simulation knows: the true residual (x, y) in pixels of a click, None if it hit the sky.

Called with the clicked frame's id and pixel, the later frame's id, and the pixel that was aimed at in it.
"""


@dataclass(frozen=True)
class Landing:
    """One pointing of a target: the measured residual, its sigma, the true one where it is known."""

    residual_px: XY
    sigma_px: XY
    frame_id: str
    true_px: XY | None = None


@dataclass(frozen=True, eq=False)
class TargetRecord:
    """One target: what was clicked, where it landed, or why it failed; pictures where they were kept."""

    distance_m: float
    index: int
    camera: str
    frame_id: str = ""
    clicked_px: XY = (nan, nan)
    range_m: float = nan
    pan_before_rad: float = nan
    tilt_before_rad: float = nan
    landings: tuple[Landing, ...] = ()
    error: str = ""
    seconds: float = 0.0
    operation: Mapping[str, Any] = field(default_factory=dict)
    clicked_image: Image | None = None
    landed_images: tuple[Image, ...] = ()


@dataclass(frozen=True)
class DistanceSummary:
    """One row of the table. ``*_rms_px`` is None where no target landed."""

    distance_m: float
    targets: int
    failed: int
    first_rms_px: XY | None
    second_rms_px: XY | None
    true_first_rms_px: XY | None
    true_second_rms_px: XY | None
    seconds: float

    @classmethod
    def of(cls, distance_m: float, rows: Sequence[TargetRecord]) -> DistanceSummary:
        """Return the row of a distance's records; failed targets are counted, not averaged."""
        landings = [[row.landings[k] for row in rows if len(row.landings) > k] for k in range(2)]
        first, second = (rms([one.residual_px for one in each]) for each in landings)
        true_1, true_2 = (rms([one.true_px for one in each if one.true_px]) for each in landings)
        failed, seconds = sum(bool(row.error) for row in rows), sum(row.seconds for row in rows)
        return cls(distance_m, len(rows), failed, first, second, true_1, true_2, round(seconds, 2))

    def as_json(self) -> dict[str, Any]:
        """Return it for programs, beside the paper's where it has this distance."""
        known = self.true_first_rms_px is not None
        document = {key: one for key, one in vars(self).items() if known or not key.startswith("true_")}
        paper = zip(("first", "second"), PAPER_TABLE_VI.get(self.distance_m, ()), strict=False)
        return document | {f"paper_{which}_rms_px": rms_px for which, rms_px in paper}


@dataclass(frozen=True, eq=False)
class PointingExperiment:
    """What was run and what came out; ``seconds`` by the rover's clock."""

    status: Mapping[str, Any]
    seed: int
    camera: str
    aim_px: XY
    records: tuple[TargetRecord, ...]
    started: str
    seconds: float
    notes: tuple[str, ...] = ()

    @property
    def summaries(self) -> list[DistanceSummary]:
        """A row for each distance."""
        distances_m = dict.fromkeys(record.distance_m for record in self.records)
        return [
            DistanceSummary.of(one, [record for record in self.records if record.distance_m == one])
            for one in distances_m
        ]

    def as_json(self) -> dict[str, Any]:
        """Return the document that ``--json`` prints."""
        return {
            "hardware": self.status.get("hardware"),
            "camera": self.camera,
            "seed": self.seed,
            "seconds": round(self.seconds, 2),
            "distances": [row.as_json() for row in self.summaries],
            "notes": list(self.notes),
            "failures": [
                {"distance_m": r.distance_m, "target": r.index, "error": r.error}
                for r in self.records
                if r.error
            ],
        }


def rms(pairs: Sequence[XY]) -> XY | None:
    """Return the root mean square of each column about zero, or None of nothing."""
    if not pairs:
        return None
    x, y = np.sqrt(np.mean(np.square(np.array(pairs, dtype=float)), axis=0))
    return float(x), float(y)


def run_pointing_experiment(
    client: Client,
    *,
    targets: int,
    distances_m: Sequence[float] = (10.0, 6.0, 2.0),
    seed: int = 1,
    truth: ClickTruth | None = None,
    notes: Sequence[str] = (),
    on_target: Callable[[TargetRecord], None] | None = None,
    pictures: int = 0,
    first: int = 0,
) -> PointingExperiment:
    """Run the experiment and return its record.

    There are so many ``targets`` at each distance from the camera to the ground, from number ``first`` on,
    each with a draw of its own by ``seed``. ``on_target`` is called after each, failed or not. Of each
    distance ``pictures`` targets keep their images for the report; ``notes`` are for its reader. A stop by
    another client, its lease, or a fault for which a target fails ends the experiment: the record has what
    was measured before, and a note why. Raises ClientError if the daemon cannot be reached.
    """
    status = client.status()
    rig = parse_rig(client.mast_file(), "the daemon's mast file").rig
    run = _PointingRun(client, rig, head_pair(rig, set(status["cameras"])), status["limits"], seed, truth)
    started = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    records: list[TargetRecord] = []
    ended = ""
    for distance_m in distances_m:
        shown = 0
        for index in range(first, first + targets):
            place = f"target {index} at {distance_m:g} m"
            try:
                record = run.one_target(distance_m, index, shown < pictures)
            except ClientError as error:
                if error.code not in ENDING:
                    raise
                ended = f"ended before {place}: {error}"
                break
            shown += bool(record.landed_images)
            records.append(record)
            if on_target is not None:
                on_target(record)
            if record.error and (fault := run.fault()):
                ended = f"ended after {place}: {fault}"
                break
        if ended:
            break
    return PointingExperiment(
        status, seed, run.pair[0], run.aim_px, tuple(records), started,
        run.now_s() - status["now_s"], (*notes, *filter(None, [ended])),
    )  # fmt: skip


def head_pair(rig: Rig, served: set[str]) -> tuple[str, str]:
    """Return the stereo pair to point with: on the head, both cameras served; the Navcam where there is one.

    Raises ClientError ``no_stereo_pair`` if there is none.
    """
    pairs = {
        name: pair
        for name, pair in rig.stereo.items()
        if all(camera in served and rig.cameras[camera].on == "head" for camera in pair)
    }
    if not pairs:
        raise ClientError(
            "no_stereo_pair", "the daemon serves no stereo pair on the head, so nothing can be ranged"
        )
    return pairs.get("navcam") or next(iter(pairs.values()))


@dataclass(frozen=True)
class _PointingRun:
    """The running experiment; ``rig`` as the daemon believes it."""

    client: Client
    rig: Rig
    pair: tuple[str, str]
    limits: Mapping[str, Any]
    seed: int
    truth: ClickTruth | None

    @property
    def aim_px(self) -> XY:
        """The middle of the left image."""
        return self.rig.cameras[self.pair[0]].model.image_center_px

    def now_s(self) -> float:
        """Return the rover's clock."""
        return float(self.client.status()["now_s"])

    def fault(self) -> str:
        """Return the first fault of the head or the pair's cameras as a sentence; empty without one."""
        for one in self.client.status()["faults"]:
            if one["device"] not in self.rig.cameras or one["device"] in self.pair:
                return f"{one['device']} has a fault until {one['until']}: {one['message']}"
        return ""

    def one_target(self, distance_m: float, index: int, with_pictures: bool) -> TargetRecord:
        """Find one target at the distance, point at it twice, and return the record of it.

        Raises ClientError if another client ends the experiment.
        """
        begun_s = self.now_s()
        record = TargetRecord(distance_m, index, self.pair[0])
        rng = np.random.default_rng([self.seed, round(1000 * distance_m), index])
        views = TargetViews(self.client, self.rig, self.pair, self.limits, rng, PAN_RANGE_RAD)
        try:
            found = (views.find_target(distance_m) for _ in range(VIEWS_PER_TARGET))
            target = next((one for one in found if one is not None), None)
            if target is None:
                reason = f"no textured target found at {distance_m:g} m in {VIEWS_PER_TARGET} views"
                record = replace(record, error=reason)
            else:
                record = _chosen(record, target)
                pixel = (record.camera, record.frame_id, *record.clicked_px)
                record = self._landed(record, pointed(self.client, pixel=pixel, pointings=2))
                if with_pictures:
                    shots = [
                        self.client.snapshot(record.camera, frame_id=o.frame_id) for o in record.landings
                    ]
                    images = tuple(shot.image for shot in shots)
                    record = replace(record, clicked_image=target.shot.image, landed_images=images)
        except ClientError as refusal:
            if refusal.code in ENDING:
                raise
            record = replace(record, error=f"{refusal.code}: {refusal}")
        return replace(record, seconds=self.now_s() - begun_s)

    def _landed(self, record: TargetRecord, operation: Mapping[str, Any]) -> TargetRecord:
        """The record with what the daemon measured. Raises ClientError after a stop."""
        if operation["state"] in ENDING:
            raise ClientError(operation["state"], "the pointing was stopped")
        landings = []
        for one in operation["pointings"]:
            frame_id = str(one["frame_id"])
            true_px = self.truth and self.truth(record.frame_id, record.clicked_px, frame_id, self.aim_px)
            residual_px, sigma_px = tuple(one["residual_px"]), tuple(one["residual_sigma_px"])
            landings.append(Landing(residual_px, sigma_px, frame_id, true_px))
        error = ""
        if operation["state"] != "done":
            reason = operation["error"] or {"code": operation["state"], "message": "stopped"}
            error = f"{reason['code']}: {reason['message']}"
        return replace(record, landings=tuple(landings), error=error, operation=operation)


def _chosen(record: TargetRecord, target: Target) -> TargetRecord:
    shot, clicked_px = target.shot, (target.x_px, target.y_px)
    return replace(
        record, frame_id=shot.frame_id, clicked_px=clicked_px, range_m=target.range_m,
        pan_before_rad=shot.pan_rad, tilt_before_rad=shot.tilt_rad,
    )  # fmt: skip
