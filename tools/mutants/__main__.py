"""Change the code in small ways, drawn at random, and see whether the nearest tests object.

    .venv/bin/python -m tools.mutants calib/geometry drivers/flir_ptu/head.py --mutants 40 --seed 1

Each mutant is one change in one line of a copy of the checkout. Of the eight test files nearest to the
module, those that enter the changed function run against it, the quickest first, until the first failure,
which counts if the same test fails again with the change and passes without it. A mutant that no test objects
to has survived: either the tests lack something, or the line decides nothing.
Survivors are printed with their place, to be looked at one by one.

N mutants are drawn from each place named. Told apart from what a test objected to are those that only took
too long, and broken ones: the changed module cannot even be imported, which is no test's merit, so these are
not counted at all. Test files that fail without any change, or take longer than --longest seconds of
processor time, are left out.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import py_compile
import random
import shutil
import signal
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import active_children, get_context
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import NamedTuple

from mastctl.cli.output import at_least
from tools.command import end, new_file, options
from tools.mutants.sites import TESTS, MutantSite, imports, nearest, sites
from tools.mutants.trial import MutantEnded, end_with_tests, run, run_change, warm

REPOSITORY = Path(__file__).resolve().parent.parent.parent
FOLDERS = ("calib", "drivers", "mastctl", "hil_tests", "configs", "tools", "docs")
FILES = (
    "pyproject.toml",
    "README.md",
    "CHANGELOG.md",
    "LICENSE",
    "requirements.lock",
    "requirements-demo.txt",
)
ALONE_S = 10.0  # what any test may take in processor time, beside three times what its file takes unchanged
PATIENCE_S = 1200.0  # by the clock on the wall, for a run that waits for what never comes


class Tried(NamedTuple):
    """What became of one mutant, by which tests, and who objected."""

    site: MutantSite
    outcome: str
    test: str
    cpu_s: float
    tests: list[str]


class _Own:
    """What a worker has to itself: its copy of the checkout."""

    copy: Path


def _begin(copies: SimpleQueue[Path]) -> None:
    _Own.copy = copies.get()
    os.environ["PYTHONPATH"] = str(_Own.copy)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end_with_tests)
    warm()


def _copied(folder: Path, count: int) -> list[Path]:
    """Copies of the checkout, compiled so that only a change in the text makes a module compile again."""
    copies = [folder / str(number) / "checkout" for number in range(count)]
    for copy in copies:
        copy.mkdir(parents=True)
        for name in FOLDERS:
            shutil.copytree(REPOSITORY / name, copy / name, ignore=shutil.ignore_patterns("*.pyc"))
            compileall.compile_dir(
                copy / name, quiet=2, invalidation_mode=py_compile.PycInvalidationMode.CHECKED_HASH
            )
        for name in FILES:
            shutil.copy(REPOSITORY / name, copy)
        (copy / ".venv").symlink_to(REPOSITORY / ".venv")
        shared = REPOSITORY.parent / "shared"
        if shared.is_dir():
            (copy.parent / "shared").symlink_to(shared)
    return copies


def _unchanged(test: str, longest_s: float) -> MutantEnded:
    """Run one test file on the code as it is."""
    return run(_Own.copy, {test: longest_s}, PATIENCE_S, watched=True)


def _tried(site: MutantSite, allowed_s: dict[str, float]) -> Tried:
    """Make one change, run the tests until one objects, and take it back."""
    tests = [*allowed_s]
    if not tests:
        return Tried(site, "untested", "", 0.0, tests)
    file = _Own.copy / site.file
    ended = run_change(file, site.applied(file.read_text()), _Own.copy, allowed_s, PATIENCE_S)
    return Tried(site, ended.outcome.replace("passed", "survived"), ended.test, ended.cpu_s, tests)


def _modules(place: str) -> list[str]:
    """The modules in the place named, as files relative to the checkout."""
    path = REPOSITORY / place
    if not path.exists():
        raise FileNotFoundError(2, "there is no such place in this checkout", place)
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    return [str(file.relative_to(REPOSITORY)) for file in files]


def _drawn(modules: list[str], count: int, seed: int) -> list[MutantSite]:
    """Changes in ``count`` lines, drawn at random from all lines that can be changed."""
    lines: dict[tuple[str, int], list[MutantSite]] = {}
    for module in modules:
        for site in sites(REPOSITORY, module):
            lines.setdefault((module, site.line), []).append(site)
    draw = random.Random(seed)
    chosen = draw.sample(sorted(lines), min(count, len(lines)))
    return [draw.choice(lines[place]) for place in chosen]


def _counted(place: str, outcomes: list[str]) -> str:
    """One place's figures in one line."""
    of = Counter(outcomes)
    drawn = len(outcomes) - of["broken"]
    objected = of["killed"] + of["killed by timeout"]
    share = f"{objected} of {drawn} killed ({objected / drawn:.0%})" if drawn else "nothing to change"
    also = [f"{of[word]} {word}" for word in ("killed by timeout", "untested", "broken") if of[word]]
    return f"{place}: {', '.join([share, *also])}"


def _allowed_s(site: MutantSite, near: list[str], alone: dict[str, MutantEnded]) -> dict[str, float]:
    """The tests for one change, quickest first, with the processor time that a test of each may take."""
    files = [
        test
        for test in near
        if (ended := alone[test]).outcome == "passed"
        and (not site.function or ended.reached is None or (site.file, site.function) in ended.reached)
    ]
    return {
        test: ALONE_S + 3 * alone[test].cpu_s for test in sorted(files, key=lambda test: alone[test].cpu_s)
    }


def _all_tried(chosen: list[MutantSite], args: argparse.Namespace, copies: list[Path]) -> Iterator[Tried]:
    graph = imports(REPOSITORY)
    near = {site.file: nearest(REPOSITORY, graph, site.file, args.tests, args.among) for site in chosen}
    files = sorted({test for tests in near.values() for test in tests})
    context = get_context("fork")
    own: SimpleQueue[Path] = context.SimpleQueue()
    for copy in copies:
        own.put(copy)
    with ProcessPoolExecutor(len(copies), context, _begin, (own,)) as pool:
        try:
            runs = pool.map(_unchanged, files, [args.longest] * len(files))
            alone = dict(zip(files, runs, strict=True))
            for test, ended in alone.items():
                if ended.outcome != "passed":
                    why = f"unchanged it is {ended.outcome} after {ended.cpu_s:.0f} s"
                    print(f"left out, {why}: {test}", flush=True)
            yield from pool.map(_tried, chosen, [_allowed_s(site, near[site.file], alone) for site in chosen])
        except BaseException:  # a signal too: nobody waits for what runs
            for worker in active_children():
                worker.terminate()
            raise


def main() -> int:
    parser = options(__doc__, seed=None, tasks=False)
    number = at_least(1)
    parser.add_argument("places", nargs="+", metavar="PLACE", help="folders or modules of this checkout")
    parser.add_argument("--mutants", type=number, default=40, metavar="N", help="from each place")
    parser.add_argument("--seed", type=at_least(0), default=1)
    parser.add_argument("--tests", type=number, default=8, metavar="N", help="test files a mutant")
    parser.add_argument("--among", default=TESTS, metavar="FOLDER", help="only tests in this folder")
    parser.add_argument("--jobs", type=number, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument(
        "--longest", type=number, default=120, metavar="S", help="slower test files are left out"
    )
    parser.add_argument("--out", type=new_file, metavar="FILE", help="every mutant and its end, as JSON")
    args = parser.parse_args()
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    drawn = {place: _drawn(_modules(place), args.mutants, args.seed) for place in args.places}
    chosen = [site for some in drawn.values() for site in some]
    ended: list[Tried] = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        for one in _all_tried(chosen, args, _copied(Path(folder), args.jobs)):
            ended.append(one)
            if one.outcome != "killed":
                by = f"  ({one.test})" if one.test else ""
                print(
                    f"{one.outcome}: {one.site.told((REPOSITORY / one.site.file).read_text())}{by}",
                    flush=True,
                )
    print(f"seed {args.seed}")
    outcome = {one.site: one.outcome for one in ended}
    for place, some in drawn.items():
        print(_counted(place, [outcome[site] for site in some]))
    if len(drawn) > 1:
        print(_counted("all", [one.outcome for one in ended]))
    if args.out:
        args.out.write_text(json.dumps([one._asdict() | {"site": vars(one.site)} for one in ended], indent=1))
    return 0


if __name__ == "__main__":
    end(main)
