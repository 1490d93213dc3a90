"""Follow the same targets with this project's tracker, OpenCV's and opencv-contrib's, in one run, one thread.

    .venv/bin/python -m tools.against_others.trackers --work SEQUENCES [--contrib ENVIRONMENT] [--targets 12]

Renders the sequences of `tracker_sequences` into --work (half a minute each, once), runs every method of
`tracker_methods` on them, and a tracker of opencv-contrib (--kind, CSRT by default) in the
environment of --contrib, which is made with pip if the folder is not there; without --contrib its rows stay
empty. Each row says, over both eyes:

- kept: runs in which the last picture's target was found and no found pixel was off by more than 5 px;
- lost: runs that ended with the target said to be lost; wrong: runs with a pixel off by more than 5 px that
  was given as found; missed: steps said to be lost, of all;
- median: distance from the true pixel over all steps of all runs, those said lost counted as infinite;
- rms: the same distance over the steps of kept runs; drift: rms at their last step, in
  pixels and as millimetres at the target, since a pixel of the last picture may be much less of the target
  than one of the first, where the target was chosen;
- to ours: this row's rms over ours, in the runs that both kept;
- ms: processor time of a step for both eyes, median and 95th percentile, and the median over that of plain
  matchTemplate.
"""
# ruff: noqa: E402  the number of threads is set before numpy is imported

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import json
import subprocess
import sys
import venv
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from calib.geometry.cahvor import CameraModel
from mastctl.cli.output import at_least
from tools.against_others.tracker_methods import HALF_PX, METHODS, Tracked
from tools.against_others.tracker_sequences import SETTINGS, STEPS, WORLDS, Sequence, loaded, rigs, sequences
from tools.command import end

REPOSITORY = Path(__file__).resolve().parents[2]
WRONG_PX = 5.0
WANTED_MS, WANTED_DRIFT_PX, WANTED_RATIO = 10.0, 0.2, 2.0
CONTRIB = "opencv-contrib-python-headless>=4.10,<5"


@dataclass(frozen=True)
class TrackerRow:
    """One method on the sequences of one world and setting; None where nothing was kept or run."""

    world: str
    setting: str
    method: str
    runs: int
    kept: int
    lost: int
    wrong: int
    missed: float
    median_px: float | None
    rms_px: float | None
    drift_px: float | None
    drift_mm: float | None
    to_ours: float | None
    milliseconds: float | None
    milliseconds_p95: float | None
    to_match_template: float | None


@dataclass(frozen=True, eq=False)
class JudgedTracks:
    """Errors (n, 20, 2) px of all runs, not-a-number where said lost; milliseconds (n, 20); metres of a pixel
    at the last target (n,)."""

    error_px: np.ndarray
    milliseconds: np.ndarray
    pixel_m: np.ndarray

    @property
    def wrong(self) -> np.ndarray:
        """(n,) whether a pixel given as found was off."""
        return np.asarray((np.nan_to_num(self.error_px) > WRONG_PX).any(axis=(1, 2)))

    @property
    def lost(self) -> np.ndarray:
        """(n,) whether an eye had no pixel at the last step."""
        return np.asarray(np.isnan(self.error_px[:, -1]).any(axis=1))

    @property
    def kept(self) -> np.ndarray:
        """(n,) neither of the two."""
        return ~self.wrong & ~self.lost


def judged(runs: list[Tracked], truth_px: np.ndarray, pixel_m: np.ndarray) -> JudgedTracks:
    """Hold the found pixels of all runs against the truth (n, 20, 2, 2)."""
    found = np.array([one[0] for one in runs])
    return JudgedTracks(
        np.linalg.norm(found - truth_px, axis=-1), np.array([one[1] for one in runs]), pixel_m
    )


def row(
    world: str, setting: str, method: str, mine: JudgedTracks, ours: JudgedTracks, plain: JudgedTracks
) -> TrackerRow:
    """Sum up a method's runs."""
    kept, both = mine.kept, mine.kept & ours.kept
    errors = mine.error_px[kept]
    spent, reference = percentile(mine.milliseconds, 50), percentile(plain.milliseconds, 50)
    median = float(np.median(np.where(np.isnan(mine.error_px), np.inf, mine.error_px)))
    last_m = rms(errors[:, -1] * mine.pixel_m[kept, None])
    return TrackerRow(
        world, setting, method, len(kept), int(kept.sum()), int(mine.lost.sum()), int(mine.wrong.sum()),
        float(np.isnan(mine.error_px).any(axis=2).mean()),
        median if np.isfinite(median) else None, rms(errors), rms(errors[:, -1]),
        None if last_m is None else 1e3 * last_m,
        rms(mine.error_px[both]) / (rms(ours.error_px[both]) or np.nan) if both.any() else None,
        spent, percentile(mine.milliseconds, 95),
        spent / reference if spent and reference else None,
    )  # fmt: skip


def percentile(values: np.ndarray, percent: float) -> float | None:
    """Percentile of what is not not-a-number."""
    return float(np.nanpercentile(values, percent)) if np.isfinite(values).any() else None


def focal_px(camera: CameraModel) -> float:
    """Pixels a radian in the middle of the picture, across."""
    return camera.focal_px[0]


def rms(values: np.ndarray) -> float | None:
    """Root mean square of what is not not-a-number."""
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else None


def contrib_python(folder: Path) -> Path:
    """Return the interpreter of the environment with opencv-contrib, made if need be."""
    python = folder / "bin" / "python"
    if not python.exists():
        print(f"making {folder} with {CONTRIB}", file=sys.stderr)
        venv.create(folder, with_pip=True)
        if subprocess.run([python, "-m", "pip", "install", "-q", "numpy", CONTRIB]).returncode:
            raise SystemExit(f"{CONTRIB} cannot be installed into {folder}; remove it and try again")
    return python


def contrib_tracked(python: Path, kind: str, files: list[Path]) -> list[Tracked]:
    """Let a tracker of opencv-contrib follow the targets of stored sequences."""
    worker = Path(__file__).with_name("contrib_tracker.py")
    command = [str(python), str(worker), kind, str(2 * HALF_PX + 1), *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": ""})
    if done.returncode:
        raise SystemExit(f"the tracker of opencv-contrib ended: {done.stderr.strip()[-300:]}")
    tracked = []
    for line in done.stdout.splitlines():
        answer = json.loads(line)
        nowhere = [np.nan, np.nan]
        pixels = [[nowhere if eye is None else eye for eye in step] for step in answer["pixels"]]
        tracked.append((np.array(pixels, dtype=np.float64), np.array(answer["milliseconds"])))
    return tracked


def compare(
    world: str, setting: str, files: list[Path], configs: Path, contrib: tuple[Path, str] | None
) -> list[TrackerRow]:
    """Run every method on the sequences of one world and setting."""
    believed = rigs(configs)[1]
    found: dict[str, list[Tracked]] = {name: [] for name in METHODS}
    truth, pixel_m = [], []
    for file in files:
        sequence: Sequence = loaded(file, believed)
        truth.append(sequence.truth_px[1:])
        pixel_m.append(sequence.ranges_m[-1] / focal_px(sequence.cameras[0][0]))
        for name, method in METHODS.items():
            found[name].append(method(sequence))
    if contrib is not None:
        found[f"{contrib[1]} (opencv-contrib)"] = contrib_tracked(*contrib, files)
    results = {name: judged(runs, np.array(truth), np.array(pixel_m)) for name, runs in found.items()}
    return [
        row(world, setting, name, one, results["ours"], results["matchTemplate"])
        for name, one in results.items()
    ]


def verdicts(rows: list[TrackerRow]) -> list[dict[str, object]]:
    """Hold ours against what is wanted, for every world and setting."""
    answers: list[dict[str, object]] = []
    for mine in (one for one in rows if one.method == "ours"):
        same = [o for o in rows if (o.world, o.setting) == (mine.world, mine.setting) and o is not mine]
        where = f"{mine.world} {mine.setting}"
        answers.append(_answer(where, "ms, both eyes", mine.milliseconds, WANTED_MS, most=True))
        answers.append(_answer(where, "drift, px", mine.drift_px, WANTED_DRIFT_PX, most=True))
        for label, others in (
            ("best other, plain", [o for o in same if "assisted" not in o.method]),
            ("best other, told the truth", [o for o in same if "assisted" in o.method]),
        ):
            # Who keeps fewer than half of ours is no rival: its few kept runs are the easy ones.
            rivals = [o for o in others if o.to_ours is not None and 2 * o.kept >= mine.kept]
            best = min(rivals, key=lambda o: o.to_ours or np.inf, default=None)
            told = f"{label}: {best.method if best else 'all lose most targets'}, rms over ours"
            answers.append(_answer(where, told, best.to_ours if best else None, WANTED_RATIO, most=False))
    return answers


def _answer(where: str, what: str, value: float | None, wanted: float, most: bool) -> dict[str, object]:
    met = None if value is None else (value <= wanted if most else value >= wanted)
    return {"where": where, "what": what, "value": value, "wanted": wanted, "at_most": most, "met": met}


def print_table(rows: list[TrackerRow]) -> None:
    """Print rows, a block each world and setting."""
    for number, one in enumerate(rows):
        if number == 0 or (one.world, one.setting) != (rows[number - 1].world, rows[number - 1].setting):
            step = f"{STEPS} steps of {SETTINGS[one.setting]:.1%}"
            print(f"\n{one.world} {one.setting}, {one.runs} targets, {step}")
            heads = "kept lost wrong missed  median     rms   drift      mm  to ours     ms    p95 ratio"
            print(f"{'method':28} {heads}")
        cells = [
            f"{value:7.3f}" if value is not None else "      -"
            for value in (one.median_px, one.rms_px, one.drift_px, one.drift_mm)
        ]
        ratio = "      -" if one.to_ours is None else f"{one.to_ours:7.2f}"
        times = (one.milliseconds, one.milliseconds_p95, one.to_match_template)
        spent = " ".join(f"{value or np.nan:6.2f}" for value in times)
        counts = f"{one.kept:4d} {one.lost:4d} {one.wrong:5d} {one.missed:6.0%}"
        print(f"{one.method:28} {counts} {' '.join(cells)}  {ratio} {spent}")


def main() -> int:
    """Compare and print; exit code 1 if something wanted is not met."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="folder of the sequences, 33 MB each")
    parser.add_argument(
        "--targets", type=at_least(1), default=12, help="targets a world and setting (default 12)"
    )
    parser.add_argument("--seed", type=at_least(0), default=1, help="of the first (default 1)")
    parser.add_argument("--worlds", nargs="+", choices=WORLDS, default=list(WORLDS))
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--contrib", type=Path, help="environment with opencv-contrib, made if not there")
    parser.add_argument("--kind", default="CSRT", help="its tracker (default CSRT)")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    contrib = (contrib_python(arguments.contrib), arguments.kind) if arguments.contrib else None
    configs = REPOSITORY / "configs"
    seeds = range(arguments.seed, arguments.seed + arguments.targets)
    rows: list[TrackerRow] = []
    for world in arguments.worlds:
        for setting in arguments.settings:
            files = [file for _, file in sequences(arguments.work, world, setting, seeds, *rigs(configs))]
            rows += compare(world, setting, files, configs, contrib)
    answers = verdicts(rows)
    if arguments.json:
        print(json.dumps({"rows": [asdict(one) for one in rows], "verdicts": answers}, indent=1))
    else:
        print_table(rows)
        print()
        for one in answers:
            value = "-" if one["value"] is None else f"{one['value']:.3g}"
            bound = f"{'at most' if one['at_most'] else 'at least'} {one['wanted']:g}"
            met = {True: "met", False: "NOT MET", None: "no comparison"}[one["met"]]  # type: ignore[index]
            print(f"{one['where']}: {one['what']} {value}, {bound}: {met}")
    return 0 if all(one["met"] is not False for one in answers) else 1


if __name__ == "__main__":
    end(main)
