"""The paper's approach (Fig. 1, Table I) on the simulated rover: a target picked at 10 m, followed to 1 m.

    .venv/bin/python -m tools.studies.approach --cases 5 --out approaches

Each run follows a rock from Pancam to Navcam to Hazcam, a minute a run. It prints the errors of the tracked
stops beside the paper's Table I; ``--out`` gets the record of all stops and their pictures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.files.mast_file import load_rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import target_approach_budget
from drivers.interfaces import Image
from mastctl.cli import output
from mastctl.cli.output import check_folder
from mastctl.packaged import config_folder
from mastctl.report import pictures, plots
from mastctl.report.pages import write_csv, write_json
from mastctl.report.tables import Table
from tools.command import end, options, run_cases
from tools.studies.approach_run import ApproachRun, ApproachTask, Stop, one_approach

PAPER_CM = {"stereo": 9.7, "untracked": 22.2, "tracked": 1.5}
"""Table I as printed, Pancam: stereo at 10 m, the approach without and with ideal tracking; 3 sigma."""

BINS_M = ((6.0, math.inf), (2.0, 6.0), (0.0, 2.0))
STOPS_CSV = (
    "seed", "stop", "range_m", "pair", "state", "along_m", "right_m", "below_m",
    "sigma_along_m", "sigma_right_m", "sigma_below_m", "pixel_error_px", "renewed",
    "untracked_along_m", "untracked_right_m", "untracked_below_m", "reason",
)  # fmt: skip
SCALE = 2
AXES = ("along", "right", "below")


def silently_wrong(stop: Stop) -> bool:
    """Tell whether a stop says tracked and is off by over 3 cm, 1 % of the range and five of its sigmas."""
    far = float(np.linalg.norm(stop.error_m)) > max(0.03, 0.01 * stop.range_m)
    return stop.state == "tracked" and far and bool((np.abs(stop.error_m) > 5 * stop.sigma_m).any())


def handoffs(run: ApproachRun) -> int:
    """How often another pair took over and found the target."""
    seen = [stop.pair for stop in run.stops if stop.state == "tracked"]
    return sum(a != b for a, b in pairwise(seen))


def losses(run: ApproachRun) -> tuple[int, int]:
    """How often the target was lost, and how often found again."""
    states = ["tracked", *(stop.state for stop in run.stops)]
    pairs = list(pairwise(states))
    return pairs.count(("tracked", "lost")), pairs.count(("lost", "tracked"))


def summary(runs: Sequence[ApproachRun]) -> dict[str, float]:
    """Numbers over all runs: kept, lost, silently wrong, poses doubted, hand-offs, and errors, metres rms.

    ``final`` is of the last stop of the runs that kept the target, ``untracked`` of the same stops without
    looking, ``start`` of the first stereo, ``from_6_m`` and so on of the tracked stops of a range.
    """
    kept = [run for run in runs if run.kept]
    began = [run for run in runs if run.stops]
    lost = [losses(run) for run in began]
    found: dict[str, float] = {
        "runs": len(runs),
        "kept": len(kept),
        "silently_wrong": sum(any(map(silently_wrong, run.stops)) for run in runs),
        "stops": sum(len(run.stops) for run in began),
        "poses_doubted": sum(bool(stop.pose_doubt) for run in began for stop in run.stops),
        "handoffs": sum(map(handoffs, began)),
        "losses": sum(one for one, _ in lost),
        "recoveries": sum(again for _, again in lost),
    }
    found |= _errors("start", [run.start_m for run in began])
    found |= _errors("untracked", [run.stops[-1].untracked_m for run in kept])
    found |= _errors("final", [run.final_error_m for run in kept])
    for low, high in BINS_M:
        stops = [s for run in began for s in run.stops if low <= s.range_m < high and s.state == "tracked"]
        found[f"stops_from_{low:g}_m"] = len(stops)
        found |= _errors(f"from_{low:g}_m", [stop.error_m for stop in stops])
    return found


def _errors(name: str, errors_m: Sequence[FloatArray]) -> dict[str, float]:
    """Rms of the components and of the length of errors (3,), metres."""
    table = np.array(errors_m).reshape(-1, 3)
    rms = np.sqrt(np.mean(table**2, axis=0)) if len(table) else np.full(3, math.nan)
    parts = {f"{name}_{axis}_rms_m": float(one) for axis, one in zip(AXES, rms, strict=True)}
    return parts | {f"{name}_position_rms_m": float(np.sqrt(np.sum(rms**2)))}


def approach_table(runs: Sequence[ApproachRun]) -> Table:
    """Return Table I's three columns, by its equations, as printed, and as measured."""
    found = summary(runs)
    theory = next(row for row in target_approach_budget() if row.name == "pancam")
    rows = [
        ["stereo at the start", f"{theory.stereo_cm:.1f}", f"{PAPER_CM['stereo']}", *_cm(found, "start")],
        [
            "at 1 m, not tracked",
            f"{theory.untracked_cm:.1f}",
            f"{PAPER_CM['untracked']}",
            *_cm(found, "untracked"),
        ],
        ["at 1 m, tracked", f"{theory.tracked_cm:.2f}", f"{PAPER_CM['tracked']}", *_cm(found, "final")],
    ]
    for low, high in BINS_M:
        far = f"{low:g} to {high:g} m" if math.isfinite(high) else f"beyond {low:g} m"
        words = f"tracked, {far} ({found[f'stops_from_{low:g}_m']} stops)"
        rows.append([words, "", "", *_cm(found, f"from_{low:g}_m")])
    return Table(("3 rms, cm", "eqs. (1)-(4)", "paper", "range", "right", "below", "3-D"), rows)


def _cm(found: dict[str, float], name: str) -> list[str]:
    """Three times the rms errors, centimetres."""
    numbers = [found[f"{name}_{axis}_rms_m"] for axis in (*AXES, "position")]
    return ["-" if math.isnan(one) else f"{300 * one:.2f}" for one in numbers]


def counted(runs: Sequence[ApproachRun]) -> str:
    """Say in one line how the runs went."""
    found = summary(runs)
    return (
        f"kept {found['kept']} of {found['runs']}, silently wrong {found['silently_wrong']}, "
        f"hand-offs {found['handoffs']}, losses {found['losses']}, found again {found['recoveries']}, "
        f"honest poses doubted {found['poses_doubted']} of {found['stops']} (1 in 1000 is chance)"
    )


def write_record(runs: Sequence[ApproachRun], folder: Path) -> None:
    """Write stops.csv, record.json and error.png into ``folder`` (made if need be).

    Raises
    ------
    OSError
        If the folder or a file in it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = [_csv_row(run.seed, index, stop) for run in runs for index, stop in enumerate(run.stops)]
    write_csv(folder / "stops.csv", STOPS_CSV, rows)
    document = {
        "summary": {key: None if math.isnan(value) else value for key, value in summary(runs).items()},
        "runs": [
            {"seed": one.seed, "kept": one.kept, "error": one.error, "seconds": round(one.seconds, 1)}
            for one in runs
        ],
    }
    write_json(folder / "record.json", document)
    stops = [stop for run in runs for stop in run.stops]
    if stops and plots.installed():
        (folder / "error.png").write_bytes(plots.as_png(_errors_by_range(runs, stops)))


def _csv_row(seed: int, index: int, stop: Stop) -> list[Any]:
    """One stop as a row of stops.csv."""
    start = [seed, index, stop.range_m, stop.pair, stop.state, *stop.error_m, *stop.sigma_m]
    return [*start, stop.pixel_error_px, int(stop.renewed), *stop.untracked_m, stop.reason]


def write_strip(run: ApproachRun, folder: Path) -> None:
    """Write a run's pictures as strip_SEED.png into ``folder``; nothing for a run that did not begin.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    if run.stops:
        (folder / f"strip_{run.seed}.png").write_bytes(pictures.encoded(strip(run), "png"))


def strip(run: ApproachRun) -> Image:
    """Return a run as one picture: a column a stop; the key picture, the left eye, the right eye."""
    columns = []
    for stop in run.stops:
        colour = (80, 200, 80) if stop.state == "tracked" else (60, 60, 230)
        tiles = []
        for row, patch in enumerate(stop.patches):
            side = patch.shape[0] * SCALE
            large = cv2.resize(patch, (side, side), interpolation=cv2.INTER_NEAREST)
            tile = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)
            tone = (200, 160, 60) if row == 0 else colour
            cv2.drawMarker(tile, (side // 2, side // 2), tone, cv2.MARKER_CROSS, 12, 1)
            cv2.rectangle(tile, (0, 0), (side - 1, side - 1), tone, 1)
            tiles.append(tile)
        head = np.full((16, tiles[0].shape[1], 3), 255, np.uint8)
        words = f"{stop.pair} {stop.range_m:.2f} m"
        cv2.putText(head, words, (2, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
        columns.append(np.vstack([head, *tiles]))
    return np.asarray(np.hstack(columns), dtype=np.uint8)


def _errors_by_range(runs: Sequence[ApproachRun], stops: Sequence[Stop]) -> Any:
    """The errors over the range, with the track's own sigma."""
    figure = plots.new(9.0, 9.0)
    tracked = [stop for stop in stops if stop.state == "tracked"]
    for k, axis in enumerate(figure.subplots(3, 1, sharex=True)):
        for run in runs:
            kept = [s for s in run.stops if s.state == "tracked"]
            axis.plot(
                [s.range_m for s in kept],
                [100 * s.error_m[k] for s in kept],
                color=plots.BLUE,
                lw=0.7,
                alpha=0.6,
            )
        if tracked:
            ranges, bounds = np.array(sorted((s.range_m, 300 * s.sigma_m[k]) for s in tracked)).T
            axis.fill_between(
                ranges, -bounds, bounds, color=plots.RUST, alpha=0.15, lw=0, label="3 sigma, told"
            )
        axis.set_ylabel(f"{('along the line of sight', 'to its right', 'below it')[k]}, cm")
        axis.grid(alpha=0.25)
        axis.set_xscale("log")
    axis.invert_xaxis()
    axis.set_xticks([10, 6, 4, 2, 1.2], ["10", "6", "4", "2", "1.2"])
    axis.set_xlabel("range, m")
    figure.axes[0].legend(loc="upper right")
    return figure


def main(words: Sequence[str] | None = None) -> int:
    """Run the approaches; 1 if no target at all was kept."""
    parser = options(__doc__, 5, "approaches", as_json=True)
    parser.add_argument(
        "--mast", type=Path, metavar="MAST.yaml",
        help="the mast file that is believed (default: the packaged one, from a simulated survey)",
    )  # fmt: skip
    parser.add_argument(
        "--on", choices=("rocks", "ground"), default="rocks",
        help="what targets lie on (default rocks; ground: wherever there is texture)",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, metavar="DIR",
        help="folder for stops.csv, record.json, a strip of pictures a run, and error.png",
    )  # fmt: skip
    args = parser.parse_args(words)
    check_folder(args.out, "--out")
    true = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
    believed = load_rig(args.mast or config_folder() / "masts" / "rocky8_simulated.yaml").rig
    if lacking := [pair for pair in true.stereo if pair not in believed.stereo]:
        raise output.WrongUse(f"--mast {args.mast} has no stereo pair '{lacking[0]}'")
    runs: dict[int, ApproachRun] = {}

    def done(one: ApproachRun) -> None:
        runs[one.seed] = one
        if args.out is not None and not args.task:  # after every run: what is interrupted leaves its record
            write_record([runs[seed] for seed in sorted(runs)], args.out)
            write_strip(one, args.out)

    tasks = [ApproachTask(true, believed, args.seed + index, args.on) for index in range(args.cases)]
    found = run_cases(
        args, "approaches", one_approach, tasks, lambda task: f"on {task.on}, seed {task.seed}",
        found=_how, done=done,
    )  # fmt: skip
    if args.json:
        output.print_json(summary(found))
    else:
        notes = [counted(found)]
        notes += ["3 times the rms, along the line of sight, to its right and below it, in the rover frame"]
        notes += [f"record: {args.out}"] if args.out is not None else []
        title = f"Approach from 10 m to 1 m, targets on {args.on}, simulated rover"
        output.print_table(title, *approach_table(found), notes)
    return 0 if any(one.kept for one in found) else 1


def _how(one: ApproachRun) -> str:
    """How a run went, in words."""
    return one.error or ("kept" if one.kept else f"lost: {one.stops[-1].reason}" if one.stops else "lost")


if __name__ == "__main__":
    end(main)
