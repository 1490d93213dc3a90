"""Provoke the check of which view a picture shows: false alarms, missed lies, error and time.

    .venv/bin/python -m tools.campaigns.motion [--moves 30] [--cases 1] [--seed 1] [--json]

The simulated rover's head goes from view to view; its pictures come from the true rig, the check believes the
packaged mast file. Each move is judged by both eyes of Navcam and Pancam: with the honest pictures; with
those of before the move; with those of the next view, which the joints will tell only later. Moves are
log-uniform from 1 mrad to 0.4 rad. A lie is missed if the joints truly stood, when the picture was taken,
farther from the told angles than allowed and no contradiction is told. Times are of the processor on one
thread, both eyes together, reduction of the pictures included.
"""
# ruff: noqa: E402  the number of threads is set before numpy is imported

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import statistics
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.matching.same_patches import Posed
from calib.matching.shown_view import shown_view
from drivers.clock import ManualClock
from drivers.hardware import DeviceSettings, HardwareSettings
from drivers.open_hardware import open_hardware
from mastctl.cli.output import at_least
from mastctl.packaged import config_folder
from tools.command import end, options, run_cases, show

PAIRS = {"navcam": ("navcam_left", "navcam_right"), "pancam": ("pancam_left", "pancam_right")}


@dataclass(frozen=True, eq=False)
class WalkView:
    """Pictures by camera with the joint angles that the head reads, and the true angles (pan, tilt) then."""

    pictures: dict[str, Posed]
    true_rad: tuple[float, float]


@dataclass
class Tally:
    """What one pair said of one kind of pictures."""

    verdicts: Counter[str] = field(default_factory=Counter)
    off_rad: list[float] = field(default_factory=list)
    share_of_allowed: list[float] = field(default_factory=list)
    look_ms: list[float] = field(default_factory=list)
    missed: int = 0


def taken(moves: int, seed: int, head: str) -> list[WalkView]:
    """Return ``moves`` + 2 views."""
    rng = np.random.default_rng(seed)
    names = [name for pair in PAIRS.values() for name in pair]
    folder, clock = config_folder(), ManualClock(50.0)
    rover = {"rover": str(folder / "sim" / "rocky8.yaml"), "head": head, "seed": seed, "samples": 2}
    settings = HardwareSettings(
        DeviceSettings("sim"), dict.fromkeys(names, DeviceSettings("sim")), rover, folder
    )
    views: list[WalkView] = []
    with open_hardware(settings, clock) as hardware:
        assert hardware.simulation is not None
        at = np.array([0.0, -0.4])
        while len(views) < moves + 2:
            hardware.pan_tilt.move(*(float(angle) for angle in at))
            while hardware.pan_tilt.read().moving:
                clock.advance(0.1)
            clock.advance(0.3)
            reading, begun_s = hardware.pan_tilt.read(), clock.now_s()
            clock.advance(1.0)
            pictures = {
                name: Posed(
                    hardware.cameras[name].next_frame(begun_s, 20.0).image.astype(np.float32),
                    reading.pan_rad,
                    reading.tilt_rad,
                )
                for name in names
            }
            views.append(WalkView(pictures, hardware.simulation.true_joints(begun_s)))
            way = np.exp(rng.uniform(np.log(1e-3), np.log(0.4))) * rng.choice([-1.0, 1.0], 2)
            at = np.clip(at + way * rng.uniform([0.5, 0.1], [1.0, 0.5]), [-1.2, -0.75], [1.2, -0.15])
    return views


def fresh(view: Posed, told: Posed | None = None) -> Posed:
    """The picture with nothing computed of it yet, with another one's angles if given."""
    return Posed(view.image, *(told or view).angles_rad)


def is_lie(shown: WalkView, told: Posed, allowed_rad: tuple[float, float]) -> bool:
    """Whether a view is truly another than the told one, by more than is allowed."""
    return bool((np.abs(np.subtract(shown.true_rad, told.angles_rad)) > allowed_rad).any())


@dataclass(frozen=True, eq=False)
class Walk:
    """Moves one after another, of a head and a scene drawn by a seed; the mast file that is believed."""

    rig: Rig
    moves: int
    seed: int
    head: str


Tallies = dict[str, dict[str, Tally]]


def walked(walk: Walk) -> Tallies:
    """Take the pictures of a walk and judge its moves."""
    return judged(walk.rig, taken(walk.moves, walk.seed, walk.head))


def together(walks: list[Tallies]) -> Tallies:
    """Add the tallies of walks."""
    return {
        pair: {kind: _sum([one[pair][kind] for one in walks]) for kind in kinds}
        for pair, kinds in walks[0].items()
    }


def _sum(tallies: list[Tally]) -> Tally:
    total = Tally()
    for one in tallies:
        total.verdicts.update(one.verdicts)
        total.off_rad += one.off_rad
        total.share_of_allowed += one.share_of_allowed
        total.look_ms += one.look_ms
        total.missed += one.missed
    return total


def judged(rig: Rig, views: list[WalkView]) -> dict[str, dict[str, Tally]]:
    """Judge every move by every pair: honest pictures, those of before, those of the next view."""
    tallies = {pair: {kind: Tally() for kind in ("honest", "before", "next")} for pair in PAIRS}
    for before, after, later in zip(views, views[1:], views[2:], strict=False):
        for pair, names in PAIRS.items():
            for kind, shown in (("honest", after), ("before", before), ("next", later)):
                tally = tallies[pair][kind]
                former = {name: fresh(before.pictures[name]) for name in names}
                told_as = after.pictures[names[0]]
                new = {name: fresh(shown.pictures[name], told_as) for name in names}
                begun_s = time.thread_time()
                results = [
                    shown_view(rig, name, former[name], new[name], (other, former[other]))
                    for name, other in (names, names[::-1])
                ]
                tally.look_ms.append(1e3 * (time.thread_time() - begun_s))
                read = np.array(shown.pictures[names[0]].angles_rad)
                for result in results:
                    tally.verdicts[result.verdict] += 1
                    if np.isfinite(result.pan_rad):
                        off = np.array([result.pan_rad, result.tilt_rad]) - read
                        tally.off_rad.append(float(np.abs(off).max()))
                        share = np.abs(off) / np.array(result.allowed_rad)
                        tally.share_of_allowed.append(float(share.max()))
                        lie = is_lie(shown, told_as, result.allowed_rad)
                        tally.missed += lie and result.verdict != "contradicted"
    return tallies


def told(tallies: dict[str, dict[str, Tally]]) -> list[dict[str, object]]:
    """The table's rows."""
    return [
        {
            "pair": pair,
            "pictures": kind,
            "verdicts": ", ".join(f"{count} {word}" for word, count in tally.verdicts.most_common()),
            "rms_mrad": None
            if not tally.off_rad
            else 1e3 * float(np.sqrt(np.mean(np.square(tally.off_rad)))),
            "worst_mrad": None if not tally.off_rad else 1e3 * max(tally.off_rad),
            "worst_of_allowed": None if not tally.off_rad else max(tally.share_of_allowed),
            "missed": tally.missed,
            "median_ms": statistics.median(tally.look_ms),
        }
        for pair, kinds in tallies.items()
        for kind, tally in kinds.items()
    ]


COLUMNS = {
    "pair": "{pair}", "pictures": "{pictures}", "rms, mrad": "{rms_mrad:.2f}", "worst": "{worst_mrad:.2f}",
    "of allowed": "{worst_of_allowed:.2f}", "missed": "{missed}", "ms a look": "{median_ms:.1f}",
    "verdicts": "{verdicts}",
}  # fmt: skip


def main(words: Sequence[str] | None = None) -> int:
    """Walk, and print a table or a document."""
    parser = options(__doc__, 1, "walks, each with the next seed", as_json=True)
    parser.add_argument("--moves", type=at_least(1), default=30, help="moves of a walk (default 30)")
    parser.add_argument("--head", choices=("ptu_d46_70", "dynamixel_x", "ph42"), default="ptu_d46_70")
    args = parser.parse_args(words)
    rig = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig
    walks = [Walk(rig, args.moves, args.seed + number, args.head) for number in range(args.cases)]
    found = run_cases(args, "walks", walked, walks, "seed {0.seed}, {0.moves} moves".format)
    show(args, told(together(found)), COLUMNS)
    return 0


if __name__ == "__main__":
    end(main)
