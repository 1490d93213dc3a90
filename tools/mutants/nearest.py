"""Which test files stand nearest to a module: by imports, then by how often they name what it defines."""

from __future__ import annotations

import ast
import re
from collections import deque
from collections.abc import Mapping
from pathlib import Path

PACKAGES = ("calib", "drivers", "mastctl", "tools")
TESTS = "hil_tests"


def imports(repository: Path) -> dict[str, frozenset[str]]:
    """Return, for each Python file of the checkout, the files of the checkout that it imports."""
    folders = [repository / folder for folder in (*PACKAGES, TESTS)]
    paths = [path.relative_to(repository) for folder in folders for path in sorted(folder.rglob("*.py"))]
    names = {_module(path): str(path) for path in paths}
    wanted = {
        str(path): {names[name] for name in _wanted(repository / path) if name in names} for path in paths
    }
    return {file: frozenset(used - {file}) for file, used in wanted.items()}


def nearest(
    repository: Path, graph: Mapping[str, frozenset[str]], file: str, count: int, among: str = TESTS
) -> list[str]:
    """Return up to ``count`` test files of a folder: fewest imports away first, then most mentions of it."""
    users: dict[str, set[str]] = {}
    for user, used in graph.items():
        for name in used:
            users.setdefault(name, set()).add(user)
    away = {file: 0}
    queue = deque([file])
    while queue:
        at = queue.popleft()
        for user in users.get(at, ()):
            if user not in away:
                away[user] = away[at] + 1
                queue.append(user)
    tests = [
        name for name in away if Path(among) in Path(name).parents and Path(name).name.startswith("test_")
    ]
    words = _defined(repository / file)
    mentions = {name: len(words.findall((repository / name).read_text())) for name in tests}
    return sorted(tests, key=lambda name: (away[name], -mentions[name], name))[:count]


def _module(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _wanted(path: Path) -> set[str]:
    """Every module name that a file may import."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def _defined(path: Path) -> re.Pattern[str]:
    """A pattern for the names that a module defines, and its own."""
    tree = ast.parse(path.read_text())
    defined = [
        node.name
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("__")
    ]
    return re.compile(rf"\b({'|'.join([path.stem, *defined])})\b")
