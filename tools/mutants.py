"""Change single places of the code, drawn at random, and count the changes that no test notices.

    .venv/bin/pip install cosmic-ray
    .venv/bin/python -m tools.mutants calib drivers mastctl --mutants 100 --seed 1 --out mutants.csv
    .venv/bin/python -m tools.mutants --again mutants.csv      # the same changes, on the present code

Cosmic Ray makes the changes, each in a worktree of the present commit beside the checkout. The nearest test
files run until one fails: those that import the changed module, then those of the same folder, at most
``--files``. A change survives if they all pass; one that takes too long counts as noticed.
"""

from __future__ import annotations

import csv
import re
import shlex
import subprocess
import sys
import tempfile
from contextlib import chdir
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mastctl.cli.options import at_least
from tools.command import end, options

REPOSITORY = Path(__file__).resolve().parent.parent
LEFT_OUT = ("drivers/sim/kernels.py",)
"""Compiled by numba, so that a change is seen only by a new compilation of minutes."""


class Mutant(NamedTuple):
    """One change: Cosmic Ray's operator, and which of its places in the module."""

    module: str
    operator: str
    occurrence: int


def drawn(places: list[str], count: int, seed: int) -> list[Mutant]:
    """Draw so many changes; a module is drawn in proportion to its lines."""
    from cosmic_ray.commands.init import _all_work_items

    listed = subprocess.run(
        ["git", "ls-files", *(f"{place}/**.py" for place in places)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    modules = [name for name in listed if not name.startswith(LEFT_OUT)]
    sizes = np.array([(REPOSITORY / name).read_text(encoding="utf-8").count("\n") for name in modules])
    found: list[Mutant] = []
    rng = np.random.default_rng(seed)
    while len(found) < count:
        module = str(rng.choice(modules, p=sizes / sizes.sum()))
        with chdir(REPOSITORY):
            specs = [item.mutations[0] for item in _all_work_items([module], {})]
        if specs:
            spec = specs[rng.integers(len(specs))]
            found.append(Mutant(module, spec.operator_name, spec.occurrence))
    return found


def nearest_tests(module: str, most: int, root: Path = REPOSITORY) -> list[str]:
    """Return the test files that import a module, then those of its folder, as paths in the repository."""
    dotted = module.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    package, _, name = dotted.rpartition(".")
    imports = re.compile(rf"\b{re.escape(dotted)}\b|from {re.escape(package)} import [^\n]*\b{name}\b")
    files = sorted((root / "hil_tests").rglob("test_*.py"))
    by_import = [file for file in files if imports.search(file.read_text(encoding="utf-8"))]
    folder = root / "hil_tests" / Path(module).parent
    beside = [file for file in files if file.parent == folder or file.parent == folder.parent]
    stem = Path(module).stem
    beside.sort(key=lambda file: (file.stem != f"test_{stem}", file.parent != folder))
    return [str(file.relative_to(root)) for file in dict.fromkeys([*by_import, *beside])][:most]


def tried(mutant: Mutant, root: Path, most: int, timeout_s: float) -> tuple[str, str]:
    """Make a change in a worktree and run its tests: the outcome, and the change as one line."""
    from cosmic_ray.mutating import mutate_and_test
    from cosmic_ray.work_item import MutationSpec

    tests = nearest_tests(mutant.module, most, root)
    command = ["env", f"--chdir={root}", f"PYTHONPATH={root}", sys.executable, "-m", "pytest", "-x", "-q"]
    command += ["-p", "no:cacheprovider", *tests]
    spec = MutationSpec(str(root / mutant.module), mutant.operator, mutant.occurrence, (0, 0), (0, 1))
    result = mutate_and_test([spec], shlex.join(command), timeout_s)
    changed = [line for line in (result.diff or "").splitlines() if re.match(r"[+-](?![+-])", line)]
    outcome = str(result.test_outcome.value) if result.test_outcome else str(result.worker_outcome.value)
    return outcome, " -> ".join(line[1:].strip() for line in changed)


def main() -> int:
    """Draw, try and print."""
    parser = options(__doc__, seed=1, tasks=False)
    parser.add_argument("places", nargs="*", default=["calib", "drivers", "mastctl"], metavar="PLACE")
    parser.add_argument("--mutants", type=at_least(1), default=100, metavar="N", help="default 100")
    parser.add_argument("--files", type=at_least(1), default=8, metavar="N", help="of tests a change (8)")
    parser.add_argument("--timeout", type=float, default=600.0, metavar="S", help="of a change (600)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write changes and outcomes as CSV")
    parser.add_argument("--again", type=Path, metavar="FILE", help="try the changes of such a file")
    args = parser.parse_args()
    try:
        import cosmic_ray  # noqa: F401
    except ImportError:
        parser.error("Cosmic Ray is not installed; .venv/bin/pip install cosmic-ray")
    if args.again:
        with args.again.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        mutants = [Mutant(row["module"], row["operator"], int(row["occurrence"])) for row in rows]
    else:
        mutants = drawn(args.places, args.mutants, args.seed)
    found: list[tuple[Mutant, str, str]] = []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "changed"
        subprocess.run(["git", "worktree", "add", "-q", "--detach", root], cwd=REPOSITORY, check=True)
        try:
            for mutant in mutants:
                outcome, change = tried(mutant, root, args.files, args.timeout)
                found.append((mutant, outcome, change))
                print(f"{outcome:11} {mutant.module}: {change}", flush=True)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", root], cwd=REPOSITORY, check=False)
    if args.out:
        with args.out.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow([*Mutant._fields, "outcome", "change"])
            writer.writerows([*mutant, outcome, change] for mutant, outcome, change in found)
    noticed = sum(outcome != "survived" for _, outcome, _ in found)
    print(f"{noticed} of {len(found)} changes noticed")
    return 0


if __name__ == "__main__":
    end(main)
