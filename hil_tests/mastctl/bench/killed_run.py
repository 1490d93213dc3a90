"""A bench of corners in a process of its own, to be killed: the folder, and where the checkout is."""

from __future__ import annotations

import sys
from pathlib import Path

from bench_world import corner_bench, run_of

from calib.plan.placements import Placement


def main(folder: str, repository: str) -> None:
    """Run it; the board stands where it stood, as it does while only the program dies."""
    bench = corner_bench(Path(repository), seed=5)
    run, _ = run_of(bench, Path(folder))
    if run.known.placements():
        number = int(run.known.placements()[-1].removeprefix("p"))
        bench.stand(_placement(number))
    run._teller.place = lambda name, *_: bench.stand(_placement(int(name[1:])))  # type: ignore[method-assign]
    sys.stdout.write("begun\n")
    sys.stdout.flush()
    run.run()
    sys.stdout.write("done\n")


def _placement(number: int) -> Placement:
    places = (Placement(1.1, 0.0, 0.0, (20.0, 0.0)), Placement(1.4, 45.0, -20.0, (0.0, -25.0)))
    return (*places, Placement(1.4, -45.0, -15.0, (25.0, 0.0)))[(number - 1) % 3]


if __name__ == "__main__":
    main(*sys.argv[1:])
