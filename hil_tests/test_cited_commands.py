"""Commands of tools that pages cite: their imports resolve, their options exist, and the cheap ones run."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
CITED = re.compile(r"python -m ((?:tools|hil_tests\.support)\.\w[\w.]*)((?: [\w./:=,+-]+)*)")
EXAMPLES = {"tools.NAME", "tools.studies.NAME"}
"""Stands for any tool."""

CHEAP = [
    "tools",
    "tools.budgets",
    "tools.benchmarks.daemon start --rounds 1",
    "tools.benchmarks.numeric --points 100 --rounds 1",
    "tools.against_others.families",
    "tools.campaigns.coverage survey --cases 1 --gross 0.05",
    "tools.campaigns.coverage bench --cases 1 --head driven --attitudes 8 --checks 3",
    "tools.campaigns.detection --cases 1 --kind dots",
    "tools.campaigns.handoff --cases 2 --good 1",
    "tools.campaigns.panorama --cases 1",
    "tools.campaigns.provocations survey --cases 3",
    "tools.campaigns.provocations bench --only ids",
    "tools.campaigns.residuals --cases 1 --day kind",
    "tools.campaigns.sweep joints --cases 1 --distances 2",
    "tools.flight.real_handoff hil_tests/data/mer_navcam",
    "tools.flight.validation",
    "tools.simulated.survey --rig configs/sim/rocky8.yaml --out {folder}/survey --seed 1",
    "tools.studies.approach --cases 1",
    "tools.studies.calibration --study mast --cases 1 --targets 2",
    "tools.studies.handoff --simulated --targets 1",
]

ELSEWHERE = {"tools.dist", "tools.simulated.mast", "tools.against_others.spheres"}
"""Run by test_packaging and test_simulated_mast; the last needs Hugin, which no test installs."""


def cited() -> Iterator[tuple[str, str, str]]:
    """Yield page, module and arguments of every command of a tool that a page shows."""
    listed = subprocess.run(
        ["git", "ls-files", "*.md", "docs/evidence/data/sources.csv"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in listed.stdout.split():
        for found in CITED.finditer((REPOSITORY / name).read_text(encoding="utf-8")):
            if found[1] not in EXAMPLES:
                yield name, found[1].rstrip("."), found[2]


def file_of(module: str) -> Path:
    """Return the file that ``python -m`` runs."""
    place = REPOSITORY.joinpath(*module.split("."))
    return place / "__main__.py" if place.is_dir() else place.with_suffix(".py")


@cache
def options_of(module: str) -> frozenset[str]:
    """Return the options that a tool's module and those of its own folder declare."""
    file = file_of(module)
    if not file.is_file():
        return frozenset()
    texts = [file.read_text(encoding="utf-8"), (REPOSITORY / "tools/command.py").read_text(encoding="utf-8")]
    texts.append((REPOSITORY / "mastctl/cli/experiment.py").read_text(encoding="utf-8"))
    texts += [one.read_text(encoding="utf-8") for one in file.parent.glob("*.py")]
    return frozenset(re.findall(r'"(--[a-z][\w-]*)[" ]', "\n".join(texts)))


def test_every_cited_tool_has_the_options_that_are_shown() -> None:
    seen, missing = 0, []
    for page, module, arguments in cited():
        seen += 1
        missing += [
            f"{page}: {module} {option}"
            for option in re.findall(r"(?<= )--[a-z][\w-]*", arguments)
            if option not in options_of(module)
        ]
        missing += [f"{page}: {module}"] if not file_of(module).is_file() else []
    assert seen > 30
    assert missing == []


def test_every_cited_tool_runs_in_the_smoke_test() -> None:
    modules = {module for _, module, _ in cited() if module.startswith("tools.")}
    assert modules - ELSEWHERE <= {command.split()[0] for command in CHEAP}


def imports(file: Path) -> Iterator[tuple[str, str | None]]:
    """Yield module and name of every import of this project's, those inside functions too."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((one.name, None) for one in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((node.module, one.name) for one in node.names)


@pytest.mark.parametrize("folder", ["tools", "hil_tests/support"])
def test_every_import_of_a_tool_resolves_late_ones_too(folder: str) -> None:
    broken, seen = [], 0
    for file in sorted((REPOSITORY / folder).rglob("*.py")):
        for module, name in imports(file):
            if module.split(".")[0] not in ("calib", "drivers", "mastctl", "tools", "hil_tests"):
                continue
            seen += 1
            try:
                found = importlib.import_module(module)
                if name and not hasattr(found, name):
                    importlib.import_module(f"{module}.{name}")
            except ImportError as error:
                broken.append(f"{file.relative_to(REPOSITORY)}: {error}")
    assert seen > 50
    assert broken == []


@pytest.mark.long(
    3, "runs tools for some seconds to a minute each; their imports are checked in the quick run"
)
@pytest.mark.parametrize("command", CHEAP)
def test_a_cited_tool_runs(command: str, tmp_path: Path) -> None:
    words = command.format(folder=tmp_path).split()
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=REPOSITORY, capture_output=True, text=True, timeout=1200
    )
    assert done.returncode in (0, 1) and "Traceback" not in done.stderr, done.stderr[-2000:]
    assert done.stdout.strip()
