"""Change the code in small ways, drawn at random, and see whether the nearest tests object.

    .venv/bin/python -m tools.mutants calib/mast drivers/flir_ptu/head.py --mutants 40 --seed 1

Each mutant is one change in one line of a copy of the checkout; the eight test files nearest to the module
run against it until the first failure. A mutant that no test objects to has survived: either the tests lack
something, or the line decides nothing. Survivors are printed with their place, to be looked at one by one.
Test files that take longer than --slow seconds see only what the others let through; those that fail without
any change, or take longer than --timeout seconds, are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from mastctl.cli.output import at_least
from tools.arguments import end, new_file
from tools.mutants.nearest import imports, nearest
from tools.mutants.sites import Site, sites

REPOSITORY = Path(__file__).resolve().parent.parent.parent
FOLDERS = ("calib", "drivers", "mastctl", "hil_tests", "configs", "tools", "docs")
FILES = ("pyproject.toml", "README.md", "CHANGELOG.md", "LICENSE", "requirements.lock")


class Tried(NamedTuple):
    """What became of one mutant: ``killed``, ``survived`` or ``untested``, and by which tests."""

    site: Site
    outcome: str
    seconds: float
    tests: list[str]


class Copies:
    """Copies of the checkout, one for each process that tries mutants."""

    def __init__(self, folder: Path, count: int) -> None:
        self._free: SimpleQueue[Path] = SimpleQueue()
        for number in range(count):
            copy = folder / str(number) / "checkout"
            copy.mkdir(parents=True)
            for name in FOLDERS:
                shutil.copytree(REPOSITORY / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            for name in FILES:
                shutil.copy(REPOSITORY / name, copy)
            (copy / ".venv").symlink_to(REPOSITORY / ".venv")
            shared = REPOSITORY.parent / "shared"
            if shared.is_dir():
                (copy.parent / "shared").symlink_to(shared)
            self._free.put(copy)

    def tried(self, site: Site, runs: list[dict[str, float]], timeout_s: float) -> Tried:
        """Make one change, run tests run by run until one objects, and take it back.

        A run is test files with the seconds that each takes unchanged; ``timeout_s`` is on top of these.
        """
        tests = [test for run in runs for test in run]
        if not tests:
            return Tried(site, "untested", 0.0, [])
        copy = self._free.get()
        file = copy / site.file
        source = file.read_text()
        began_s = time.monotonic()
        try:
            file.write_text(site.applied(source))
            passed = all(_passes(copy, [*run], timeout_s + sum(run.values())) for run in runs if run)
        finally:
            file.write_text(source)
            self._free.put(copy)
        return Tried(site, "survived" if passed else "killed", time.monotonic() - began_s, tests)

    def unchanged(self, test: str, timeout_s: float) -> float | None:
        """How many seconds a test file takes without a change; None if it fails, or takes too long."""
        copy = self._free.get()
        began_s = time.monotonic()
        try:
            return time.monotonic() - began_s if _passes(copy, [test], timeout_s) else None
        finally:
            self._free.put(copy)


def _passes(copy: Path, tests: list[str], timeout_s: float) -> bool:
    """Whether the tests pass in that copy within the time; whatever they started ends with them."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    environment |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command,
        cwd=copy,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as running:
        try:
            return running.wait(timeout_s) == 0
        except subprocess.TimeoutExpired:
            return False
        finally:
            if running.poll() is None:
                os.killpg(running.pid, 9)


def _modules(places: list[str]) -> list[str]:
    """The modules in the places named, as files relative to the checkout."""
    found: list[str] = []
    for place in places:
        path = REPOSITORY / place
        if not path.exists():
            raise FileNotFoundError(2, "there is no such place in this checkout", place)
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        found += [str(file.relative_to(REPOSITORY)) for file in files]
    return found


def _drawn(modules: list[str], count: int, seed: int) -> list[Site]:
    """Changes in ``count`` lines, drawn at random from all lines that can be changed."""
    lines: dict[tuple[str, int], list[Site]] = {}
    for module in modules:
        for site in sites(REPOSITORY, module):
            lines.setdefault((module, site.line), []).append(site)
    draw = random.Random(seed)
    chosen = draw.sample(sorted(lines), min(count, len(lines)))
    return [draw.choice(lines[place]) for place in chosen]


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tools.mutants",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    number = at_least(1)
    parser.add_argument("places", nargs="+", metavar="PLACE", help="folders or modules of this checkout")
    parser.add_argument("--mutants", type=number, default=40, metavar="N")
    parser.add_argument("--seed", type=at_least(0), default=1)
    parser.add_argument("--tests", type=number, default=8, metavar="N", help="test files a mutant")
    parser.add_argument("--jobs", type=number, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument("--slow", type=number, default=40, metavar="S", help="slower test files come last")
    parser.add_argument("--timeout", type=number, default=240, metavar="S", help="who hangs is killed")
    parser.add_argument("--out", type=new_file, metavar="FILE", help="every mutant and its end, as JSON")
    args = parser.parse_args()
    chosen = _drawn(_modules(args.places), args.mutants, args.seed)
    graph = imports(REPOSITORY)
    near = {site.file: nearest(REPOSITORY, graph, site.file, args.tests) for site in chosen}
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(args.jobs) as pool:
        copies = Copies(Path(folder), args.jobs)
        files = sorted({test for tests in near.values() for test in tests})
        took_s = dict(
            zip(files, pool.map(lambda test: copies.unchanged(test, args.timeout), files), strict=True)
        )
        for test, seconds in took_s.items():
            if seconds is None:
                print(f"left out, fails or takes over {args.timeout} s unchanged: {test}", flush=True)

        def told(site: Site) -> Tried:
            timed = {test: seconds for test in near[site.file] if (seconds := took_s[test]) is not None}
            quick = {test: seconds for test, seconds in timed.items() if seconds <= args.slow}
            slow = {test: seconds for test, seconds in timed.items() if seconds > args.slow}
            one = copies.tried(site, [quick, slow], args.timeout)
            if one.outcome != "killed":
                print(f"{one.outcome}: {site.told((REPOSITORY / site.file).read_text())}", flush=True)
            return one

        ended = list(pool.map(told, chosen))
    killed = sum(one.outcome == "killed" for one in ended)
    print(f"{killed} of {len(ended)} killed ({killed / len(ended):.0%}), seed {args.seed}")
    if args.out:
        args.out.write_text(json.dumps([one._asdict() | {"site": vars(one.site)} for one in ended], indent=1))
    return 0


if __name__ == "__main__":
    end(main)
