"""A bench of corners, with its folder and a person that places the board, for the tests of runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.targets.boards import Charuco
from hil_tests.mastctl.bench.bench_of_corners import CornerBench, SelfPlacing, TrueAxis
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.mast import BenchHead, BenchMast
from mastctl.bench.run import BenchRun, Reporter
from mastctl.bench.survey import open_survey

BOARD = Charuco(10, 7, 0.055, 0.042)
PAIR = ("navcam_left", "navcam_right")
PTU_COUNT_RAD = 5.6e-5


def rigs(repository: Path) -> tuple[Rig, Rig]:
    """What is so, and what is believed: the packaged bench's."""
    whole = load_rig(repository / "configs/sim/rocky8.yaml").rig
    true = replace(
        whole, cameras={name: whole.cameras[name] for name in PAIR}, stereo={"navcam": PAIR}, provenance={}
    )
    return true, load_rig(repository / "configs/masts/bench_drawing.yaml").rig


def one_camera(repository: Path) -> tuple[Rig, Rig]:
    """What is so of a head with one camera, and a drawing of it."""
    true = load_rig(repository / "configs/sim/one_camera.yaml").rig
    drawing = load_rig(repository / "configs/masts/bench_drawing.yaml").rig
    drawn = replace(drawing, cameras={"navcam": drawing.cameras["navcam_left"]}, stereo={})
    return replace(true, provenance={}), drawn


def corner_bench(
    repository: Path,
    seed: int = 1,
    one_sided: bool = True,
    of: Callable[[Path], tuple[Rig, Rig]] = rigs,
    **axis: Any,
) -> CornerBench:
    """A PTU's counts; ``axis`` is of both joints."""
    true, believed = of(repository)
    head = BenchHead(believed, (-2.6, 2.6), (-1.2, 0.5), one_sided, PTU_COUNT_RAD)
    pan, tilt = (TrueAxis(PTU_COUNT_RAD, one_sided=one_sided, **axis) for _ in range(2))
    return CornerBench(head, true, BOARD, np.random.default_rng(seed), pan, tilt)


def run_of(
    bench: CornerBench, folder: Path, mast: BenchMast | None = None, reporter: Reporter | None = None
) -> tuple[BenchRun, SelfPlacing]:
    """A run, and the person that places its board; ``mast`` and ``reporter`` instead of the bench's own."""
    person = SelfPlacing(bench)
    survey = open_survey(folder, BOARD, bench.head, bench.noise_px)
    known = BenchKnowledge(bench.head, survey, BOARD, (reporter or person).say)
    return BenchRun(mast or bench, known, reporter or person), person
