"""Change the code in small ways, drawn at random, and see whether the nearest tests object.

    .venv/bin/python -m tools.mutants calib/geometry drivers/flir_ptu/head.py --mutants 40 --seed 1

Each mutant is one change in one line of a copy of the checkout. Up to --tests test files run against it,
those nearest to the module first (by imports and by place), until the first failure, which counts if the
same test fails again with the change and passes without it. A mutant that no test objects to has survived:
either the tests lack something, or the line decides nothing.
Each mutant's end is printed with its place, survivors to be looked at one by one.

N mutants are drawn from each place named. Told apart from what a test objected to are those that only took
too long, and broken ones: the changed module cannot even be imported, which is no test's merit, so these are
not counted at all.
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
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import NamedTuple

from mastctl.cli.output import at_least
from tools.command import end, new_file, options
from tools.mutants.sites import TESTS, MutantSite, imports, nearest, sites
from tools.mutants.trial import end_with_tests, run_change, warm

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


def _tried(site: MutantSite, tests: list[str], allowed_s: float) -> Tried:
    """Make one change, run the tests until one objects, and take it back."""
    if not tests:
        return Tried(site, "untested", "", 0.0, tests)
    file = _Own.copy / site.file
    ended = run_change(file, site.applied(file.read_text()), _Own.copy, tests, allowed_s, PATIENCE_S)
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


def _all_tried(chosen: list[MutantSite], args: argparse.Namespace, copies: list[Path]) -> Iterator[Tried]:
    graph = imports(REPOSITORY)
    context = get_context("fork")
    own: SimpleQueue[Path] = context.SimpleQueue()
    for copy in copies:
        own.put(copy)
    with ProcessPoolExecutor(len(copies), context, _begin, (own,)) as pool:
        try:
            near = [nearest(REPOSITORY, graph, site.file, args.tests, args.among) for site in chosen]
            # and no pool.map: it cancels what waits, and the pool of ended workers stumbles over that
            tried = [pool.submit(_tried, *one, args.longest) for one in zip(chosen, near, strict=True)]
            yield from (one.result() for one in as_completed(tried))
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
        "--longest", type=number, default=60, metavar="S", help="processor time that a test may take"
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
            by = f"  ({one.test})" if one.test else ""
            what = one.site.told((REPOSITORY / one.site.file).read_text())
            print(f"{len(ended)}/{len(chosen)} {one.outcome}, {one.cpu_s:.0f} s: {what}{by}", flush=True)
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
