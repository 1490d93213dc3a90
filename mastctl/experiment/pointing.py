"""The paper's pointing experiment (section IV, Table VI) through the HTTP interface of a running daemon.

For each distance: turn to the ground, choose a textured pixel of the left image at random, have the
daemon point at it twice, and take the residuals that the daemon measured in new images. A target that
fails is a row of its own with the reason; it never leaves the record.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.files.mast_file import parse_rig
from calib.geometry.rig import Rig
from drivers.interfaces import Image
from mastctl.client import Client, ClientError
from mastctl.experiment.targets import VIEWS_PER_TARGET, Target, TargetViews, pointed

# Rms pixel errors (x, y) of the paper's Table VI: first and second pointing at each distance in metres.
PAPER_TABLE_VI: Mapping[float, tuple[tuple[float, float], tuple[float, float]]] = {
    10.0: ((0.591, 1.219), (0.527, 0.778)),
    6.0: ((0.743, 1.243), (0.596, 0.844)),
    2.0: ((1.260, 0.925), (0.672, 0.921)),
}


@dataclass(frozen=True)
class Landing:
    """One pointing of a target: the measured residual, its sigma, the true one where it is known."""

    residual_px: tuple[float, float]
    sigma_px: tuple[float, float]
    frame_id: str
    true_px: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class TargetRecord:
    """One target: what was clicked, where it landed, or why it failed; pictures where they were kept."""

    distance_m: float
    index: int
    camera: str
    frame_id: str
    clicked_px: tuple[float, float]
    range_m: float
    pan_before_rad: float
    tilt_before_rad: float
    landings: tuple[Landing, ...]
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
    first_rms_px: tuple[float, float] | None
    second_rms_px: tuple[float, float] | None
    true_first_rms_px: tuple[float, float] | None
    true_second_rms_px: tuple[float, float] | None
    worst_first_px: float | None
    seconds: float


@dataclass(frozen=True, eq=False)
class PointingExperiment:
    """What was run and what came out."""

    url: str
    status: Mapping[str, Any]
    seed: int
    camera: str
    aim_px: tuple[float, float]
    records: tuple[TargetRecord, ...]
    summaries: tuple[DistanceSummary, ...]
    started: str
    seconds: float
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the document that ``--json`` prints."""
        return {
            "url": self.url,
            "hardware": self.status.get("hardware"),
            "camera": self.camera,
            "seed": self.seed,
            "seconds": round(self.seconds, 2),
            "distances": [_row_as_json(row) for row in self.summaries],
            "notes": list(self.notes),
            "failures": [
                {"distance_m": r.distance_m, "target": r.index, "error": r.error}
                for r in self.records
                if r.error
            ],
        }


def _row_as_json(row: DistanceSummary) -> dict[str, Any]:
    """One distance for programs."""
    document = {
        key: value
        for key, value in vars(row).items()
        if row.true_first_rms_px is not None or not key.startswith("true_")
    } | {"seconds": round(row.seconds, 2)}
    paper = PAPER_TABLE_VI.get(row.distance_m)
    if paper is not None:
        document["paper_first_rms_px"], document["paper_second_rms_px"] = paper
    return document


def summarise_distance(distance_m: float, rows: Sequence[TargetRecord], seconds: float) -> DistanceSummary:
    """Return the table's row for the records of one distance; failed targets are counted, not averaged."""
    first, second = ([row.landings[k] for row in rows if len(row.landings) > k] for k in range(2))
    true = [[one.true_px for one in landings if one.true_px is not None] for landings in (first, second)]
    return DistanceSummary(
        distance_m,
        len(rows),
        sum(bool(row.error) for row in rows),
        rms([one.residual_px for one in first]),
        rms([one.residual_px for one in second]),
        rms(true[0]),
        rms(true[1]),
        max((math.hypot(*one.residual_px) for one in first), default=None),
        seconds,
    )


def rms(pairs: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """Return the root mean square of each column about zero, or None of nothing."""
    if not pairs:
        return None
    x, y = np.sqrt(np.mean(np.square(np.array(pairs, dtype=float)), axis=0))
    return float(x), float(y)


ENDING = ("stopped", "estopped", "leased")
"""Another client has stopped the mast or steers it: no further target moves the head."""

# Targets lie this far to either side of straight ahead: the pan range of the paper's calibration (III.C).
PAN_RANGE_RAD = 1.0


ClickTruth = Callable[[str, tuple[float, float], str, tuple[float, float]], tuple[float, float] | None]
"""What only a simulation knows: the true residual (x, y) in pixels of a click, None if it hit the sky.

Called with the clicked frame's id and pixel, the later frame's id, and the pixel that was aimed at in it.
"""


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
    another client, or its lease, ends the experiment: the record has what was measured before. Raises
    ClientError if the daemon cannot be reached or refuses for another reason than the target itself.
    """
    status = client.status()
    begun_s, started, url = status["now_s"], time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), client.url
    if _on_demand(client):  # the record of such a run is to be the same every time
        started, url = f"{begun_s:.3f} s of the simulated rover's own time", "a simulated rover"
    rig = parse_rig(client.mast_file(), "the daemon's mast file").rig
    pair = head_pair(rig, set(status["cameras"]))
    aim_px = rig.cameras[pair[0]].model.image_center_px
    run = _PointingRun(client, rig, pair, status["limits"], seed, truth)
    records: list[TargetRecord] = []
    summaries = []
    ended = ""
    for distance_m in distances_m:
        if ended:
            break
        distance_begun_s = _now_s(client)
        rows: list[TargetRecord] = []
        for index in range(first, first + targets):
            wanted = sum(bool(row.landed_images) for row in rows) < pictures
            try:
                record = run.one_target(distance_m, index, wanted)
            except ClientError as error:
                if error.code not in ENDING:
                    raise
                ended = f"ended before target {index} at {distance_m:g} m: {error}"
                break
            rows.append(record)
            if on_target is not None:
                on_target(record)
        records += rows
        summaries.append(summarise_distance(distance_m, rows, _now_s(client) - distance_begun_s))
    return PointingExperiment(
        url, status, seed, pair[0], aim_px, tuple(records), tuple(summaries), started,
        _now_s(client) - begun_s, (*notes, ended) if ended else tuple(notes),
    )  # fmt: skip


def _now_s(client: Client) -> float:
    return float(client.status()["now_s"])


def _on_demand(client: Client) -> bool:
    """Whether the daemon is a simulated rover whose time passes only on demand (``speed: max``)."""
    try:
        return bool(client.simulation_time()["speed"] == "max")
    except ClientError:  # anything else than this program's own simulated rover
        return False


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

    def one_target(self, distance_m: float, index: int, with_pictures: bool) -> TargetRecord:
        """Find one target at the distance, point at it twice, and return the record of it."""
        begun_s = _now_s(self.client)
        rng = np.random.default_rng([self.seed, round(1000 * distance_m), index])
        views = TargetViews(self.client, self.rig, self.pair, self.limits, rng, PAN_RANGE_RAD)
        reason = f"no textured target found at {distance_m:g} m in {VIEWS_PER_TARGET} views"
        target = None
        try:
            for _ in range(VIEWS_PER_TARGET):
                target = target or views.find_target(distance_m)
        except ClientError as error:
            if error.code in ENDING:
                raise
            reason = f"searching a target: {error}"
        if target is not None:
            return self._point_at(target, distance_m, index, begun_s, with_pictures)
        nan = math.nan
        return TargetRecord(
            distance_m, index, self.pair[0], "", (nan, nan), nan, nan, nan, (), reason,
            _now_s(self.client) - begun_s,
        )  # fmt: skip

    def _point_at(
        self, target: Target, distance_m: float, index: int, begun_s: float, with_pictures: bool
    ) -> TargetRecord:
        """Request two pointings and record what the daemon measured."""
        error, operation = "", None
        try:
            pixel = (target.shot.camera, target.shot.frame_id, target.x_px, target.y_px)
            operation = pointed(self.client, pixel=pixel, pointings=2)
            if operation["state"] != "done":
                if operation["state"] in ENDING:
                    raise ClientError(operation["state"], "the pointing was stopped")
                reason = operation["error"] or {"code": operation["state"], "message": "stopped"}
                error = f"{reason['code']}: {reason['message']}"
        except ClientError as refusal:
            if refusal.code in ENDING:
                raise
            error = f"{refusal.code}: {refusal}"
        entries = operation["pointings"] if operation is not None else []
        landings = tuple(self._landing(target, entry) for entry in entries)
        images = [one.frame_id for one in landings] if with_pictures else []
        return TargetRecord(
            distance_m=distance_m,
            index=index,
            camera=target.shot.camera,
            frame_id=target.shot.frame_id,
            clicked_px=(target.x_px, target.y_px),
            range_m=target.range_m,
            pan_before_rad=target.shot.pan_rad,
            tilt_before_rad=target.shot.tilt_rad,
            landings=landings,
            error=error,
            seconds=_now_s(self.client) - begun_s,
            operation=operation or {},
            clicked_image=target.shot.image if with_pictures else None,
            landed_images=tuple(
                self.client.snapshot(target.shot.camera, frame_id=one).image for one in images
            ),
        )

    def _landing(self, target: Target, entry: Mapping[str, Any]) -> Landing:
        """One entry of the operation's ``pointings``, with the true residual where it is known."""
        aim_px = self.rig.cameras[self.pair[0]].model.image_center_px
        frame_id, clicked_px = str(entry["frame_id"]), (target.x_px, target.y_px)
        true_px = self.truth and self.truth(target.shot.frame_id, clicked_px, frame_id, aim_px)
        return Landing(tuple(entry["residual_px"]), tuple(entry["residual_sigma_px"]), frame_id, true_px)
