"""Chosen attitudes of a bench against a grid of them and random ones: predicted pointing error by pictures.

Three placements of a board, the same for all three ways, and as many pictures at each. Chosen attitudes
come from the information matrix as the driving command takes them; the grid puts the board's middle at even
places of the picture; random ones put it anywhere in it. The error is what the information of all pictures
leaves of a first pointing over the workspace, rms px an axis: its rms over the benches, and the least and the
largest of them. Corners alone, nothing is rendered.

    .venv/bin/python -m tools.campaigns.bench_poses --rig configs/sim/rocky8.yaml --cases 10 --seed 1
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.errors import CalibError, Unreachable
from calib.files.mast_file import load_rig
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.solutions import choose
from calib.plan.knowledge import BenchShot, ExpectedPointing, Knowledge, Workspace, pointing
from calib.plan.placements import Placement
from calib.plan.poses import Sought, expected_px, next_shot, seen
from calib.targets.boards import Charuco
from mastctl.bench.looks import FEWEST_LOOKS
from tools.command import end, options

A2 = Charuco(10, 7, 0.055, 0.042)
PAIR = ("navcam_left", "navcam_right")
PLACEMENTS = (
    Placement(1.0, -35.0, -15.0, (20.0, 0.0)),
    Placement(1.6, 0.0, -25.0, (0.0, -25.0)),
    Placement(2.6, 40.0, -5.0, (-25.0, 0.0)),
)
EACH = (2, 3, 4, 6, 8, 12, 16)
"""Pictures at each placement."""
SIGMA_PX = 0.05
PAN_RAD, TILT_RAD = (-2.6, 2.6), (-1.2, 0.5)

CHOICES_S: list[float] = []
"""Processor time of each choice."""

Way = Callable[
    [Knowledge, Sought, str, int, ExpectedPointing, np.random.Generator, Sequence[BenchShot]], list[BenchShot]
]


def main() -> int:
    """Print the table."""
    parser = options(__doc__, 10, "benches", tasks=False)
    parser.add_argument("--rig", type=Path, required=True, metavar="MAST.yaml", help="the true rig")
    parser.add_argument("--two-sided", action="store_true", help="a head that comes from either side")
    args = parser.parse_args()
    rig = load_rig(args.rig).rig
    rig = replace(rig, cameras={name: rig.cameras[name] for name in PAIR}, stereo={"navcam": PAIR}, fit={})
    found: dict[str, list[list[float]]] = {name: [] for name in WAYS}
    for bench in range(args.cases):
        rng = np.random.default_rng([args.seed, bench])
        for name, curve in one_bench(rig, rng, one_sided=not args.two_sided).items():
            found[name].append(curve)
        print(f"bench {bench + 1} of {args.cases}", file=sys.stderr)
    curves = {name: np.array(mine) for name, mine in found.items()}
    root = {name: np.sqrt(np.mean(mine**2, axis=0)) for name, mine in curves.items()}
    print("pictures a camera        " + "".join(f"{3 * k:8d}" for k in EACH))
    for name, mine in curves.items():
        for what, values in (("rms", root[name]), ("least", mine.min(axis=0)), ("most", mine.max(axis=0))):
            print(f"{name:8s} {what:15s} " + "".join(f"{value:8.3f}" for value in values))
    for name in ("grid", "random"):
        print(f"{name}: pictures that it needs for the rms of the chosen, in times of theirs: "
              + needed(root["chosen"], root[name]))  # fmt: skip
        twice = [EACH.index(2 * k) for k in EACH if 2 * k in EACH]
        once = [k for k, each in enumerate(EACH) if 2 * each in EACH]
        wins = (curves["chosen"][:, once] <= curves[name][:, twice]).sum(axis=0)
        print(f"{name}: benches of {args.cases} in which it leaves no less with twice the pictures: "
              + ", ".join(f"{n} at {3 * EACH[k]}" for n, k in zip(wins, once, strict=True)))  # fmt: skip
    print(f"the choice of a pose took {1e3 * np.mean(CHOICES_S):.0f} ms of processor time on average, "
          f"{1e3 * max(CHOICES_S):.0f} at most")  # fmt: skip
    return 0


def one_bench(rig: Rig, rng: np.random.Generator, one_sided: bool) -> dict[str, list[float]]:
    """Return the predicted error by pictures of each way, on one bench."""
    head = rig.mast.rover_from_head(0.0, 0.0)
    boards = {}
    for k, placement in enumerate(PLACEMENTS):
        moved = replace(
            placement,
            bearing_deg=placement.bearing_deg + rng.normal(0, 4),
            height_deg=placement.height_deg + rng.normal(0, 3),
            turned_deg=(
                placement.turned_deg[0] + rng.normal(0, 4),
                placement.turned_deg[1] + rng.normal(0, 4),
            ),
        )
        boards[f"p{k}"] = moved.rover_from_board(head)
    known = Knowledge(rig, boards, joint_sigma_rad=5.6e-5 / math.sqrt(12.0))
    aim = pointing(known, Workspace(PAIR, (-1.0, 1.0), (-0.8, 0.2), one_sided=one_sided))
    sought = Sought(A2.in_board_m(A2.ids), SIGMA_PX, 8, PAN_RAD, TILT_RAD, one_sided)
    curves: dict[str, list[float]] = {}
    for name, way in WAYS.items():
        curves[name] = []
        for each in EACH:
            shots: list[BenchShot] = []
            for placement in boards:
                shots += way(known, sought, placement, each, aim, rng, shots)
            curves[name].append(expected_px(known, shots, aim))
    return curves


def chosen(
    known: Knowledge,
    sought: Sought,
    placement: str,
    count: int,
    aim: ExpectedPointing,
    rng: np.random.Generator,
    shots: Sequence[BenchShot],
) -> list[BenchShot]:
    """Return attitudes that tell most together, as the driving command chooses them."""
    mine: list[BenchShot] = []
    for taken in range(count):
        ahead = max(min(count, FEWEST_LOOKS) - taken, 1)
        began = time.process_time()
        choice = next_shot(known, sought, [*shots, *mine], placement, aim, (), ahead)
        CHOICES_S.append(time.process_time() - began)
        if choice is not None:
            mine.append(choice.shot)
    return mine


def grid(
    known: Knowledge,
    sought: Sought,
    placement: str,
    count: int,
    aim: ExpectedPointing,
    rng: np.random.Generator,
    shots: Sequence[BenchShot],
) -> list[BenchShot]:
    """Return attitudes that put the board's middle at even places of the first camera's picture."""
    columns = math.ceil(math.sqrt(count * 4 / 3))
    rows = math.ceil(count / columns)
    places = [
        (0.15 + 0.7 * (i + 0.5) / columns, 0.15 + 0.7 * (j + 0.5) / rows)
        for j in range(rows)
        for i in range(columns)
    ]
    taken = [places[k] for k in np.linspace(0, len(places) - 1, count).round().astype(int)]
    return [shot for place in taken for shot in _at(known, sought, placement, place, rng)]


def anywhere(
    known: Knowledge,
    sought: Sought,
    placement: str,
    count: int,
    aim: ExpectedPointing,
    rng: np.random.Generator,
    shots: Sequence[BenchShot],
) -> list[BenchShot]:
    """Return attitudes that put the board's middle anywhere in the picture."""
    mine: list[BenchShot] = []
    for _ in range(50 * count):
        if len(mine) < count:
            mine += _at(known, sought, placement, (rng.uniform(), rng.uniform()), rng)
    return mine


WAYS: dict[str, Way] = {"chosen": chosen, "grid": grid, "random": anywhere}


def _at(
    known: Knowledge, sought: Sought, placement: str, place: tuple[float, float], rng: np.random.Generator
) -> list[BenchShot]:
    """The shot with the board's middle at a place of the picture, if it can be taken."""
    model = known.rig.cameras[PAIR[0]].model
    width, height = model.size_px
    middle = known.boards[placement].translation_m
    try:
        found = solve(known.rig.mast, model, middle, (place[0] * width, place[1] * height))
        angles = choose(found, sought.pan_limits_rad, sought.tilt_limits_rad)
    except (Unreachable, CalibError):
        return []
    sides = (0, 0) if sought.one_sided else tuple(int(side) for side in rng.choice([-1, 1], 2))
    read = known.rig.joints.read_rad((angles.pan_rad, angles.tilt_rad))
    shot = seen(known, sought, BenchShot(placement, *read, (), *sides))
    return [] if shot is None else [shot]


def needed(chosen_px: np.ndarray, other_px: np.ndarray) -> str:
    """Return how many times the pictures another way needs, at each number of the chosen ones."""
    counts = 3.0 * np.array(EACH)
    out = []
    for count, wanted in zip(counts, chosen_px, strict=True):
        if other_px.min() > wanted:
            out.append(f"> {counts[-1] / count:.1f}")
            continue
        at = np.exp(np.interp(-np.log(wanted), -np.log(np.minimum.accumulate(other_px)), np.log(counts)))
        out.append(f"{at / count:.1f}")
    return ", ".join(out)


if __name__ == "__main__":
    end(main)
