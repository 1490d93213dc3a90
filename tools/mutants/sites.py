"""Where a small change of the code is tried, and which test files stand nearest to it."""

from __future__ import annotations

import ast
import re
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, takewhile
from pathlib import Path

COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.MatMult: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
ONLY_TELLS = frozenset({"debug", "info", "warning", "error", "exception"})  # calls of a logger


@dataclass(frozen=True)
class MutantSite:
    """One possible change.

    Attributes
    ----------
    file
        The module, relative to the checkout.
    line, column, end_line, end_column
        What is replaced: lines from 1, columns in bytes from 0, as in `ast`.
    kind
        The sort of change.
    text
        What takes its place.
    """

    file: str
    line: int
    column: int
    end_line: int
    end_column: int
    kind: str
    text: str

    def applied(self, source: str) -> str:
        """Return the module's text with this change made."""
        lines = source.encode().splitlines(keepends=True)
        before = b"".join(lines[: self.line - 1]) + lines[self.line - 1][: self.column]
        after = lines[self.end_line - 1][self.end_column :] + b"".join(lines[self.end_line :])
        return (before + self.text.encode() + after).decode()

    def told(self, source: str) -> str:
        """Return the place, what stands there, and what would."""
        old = " ".join(self._old(source).split())
        return f"{self.file}:{self.line}  {self.kind}: {old}  ->  {self.text}"

    def _old(self, source: str) -> str:
        lines = source.encode().splitlines(keepends=True)
        if self.line == self.end_line:
            return lines[self.line - 1][self.column : self.end_column].decode()
        parts = [lines[self.line - 1][self.column :], *lines[self.line : self.end_line - 1]]
        return b"".join([*parts, lines[self.end_line - 1][: self.end_column]]).decode()


def sites(repository: Path, file: str) -> list[MutantSite]:
    """Return every possible change of one module, in the order of its text."""
    tree = ast.parse((repository / file).read_text())
    found = [
        MutantSite(
            file,
            node.lineno,
            node.col_offset,
            node.end_lineno,
            node.end_col_offset,
            kind,
            text,
        )
        for node, kind, text in _changes(tree)
        if node.end_lineno is not None and node.end_col_offset is not None
    ]
    return sorted(found, key=lambda site: (site.line, site.column, site.kind))


def _changes(tree: ast.Module) -> Iterator[tuple[ast.expr | ast.stmt, str, str]]:
    """Each node that can be changed, with the change."""
    for node in _code(tree):
        if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARISONS:
            ops = [COMPARISONS[type(node.ops[0])](), *node.ops[1:]]
            yield node, "comparison", _text(ast.Compare(node.left, ops, node.comparators))
        elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS and not _words(node):
            yield node, "operator", _text(ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield node, "sign", _text(node.operand)
        elif isinstance(node, ast.BoolOp):
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield node, "and, or", _text(ast.BoolOp(other, node.values))
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            yield node, "number", repr(node.value + 1)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) and not _tells(node.value):
            yield node, "call dropped", "pass"
        if isinstance(node, (ast.If, ast.While, ast.IfExp)):
            yield node.test, "condition", _text(ast.UnaryOp(ast.Not(), node.test))


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """What runs and decides: neither annotations nor words nor what a logger or an error is told."""
    if _only_for_readers(node):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        if isinstance(node, ast.Raise) or (isinstance(node, ast.Call) and _tells(node)):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr):
                yield from _code(child)


def _only_for_readers(node: ast.AST) -> bool:
    """Whether it never runs, or only makes words: a Protocol, what the type checker sees."""
    if isinstance(node, ast.ClassDef):
        return any("Protocol" in ast.unparse(base) for base in node.bases)
    if isinstance(node, ast.FunctionDef):
        return node.name in ("__repr__", "__str__") or any(
            ast.unparse(decorator) in ("overload", "abstractmethod") for decorator in node.decorator_list
        )
    if isinstance(node, ast.If):
        return ast.unparse(node.test) in ("TYPE_CHECKING", "__name__ == '__main__'")
    return False


def _tells(call: ast.Call) -> bool:
    return isinstance(call.func, ast.Attribute) and call.func.attr in ONLY_TELLS


def _words(node: ast.BinOp) -> bool:
    """Whether an operator joins texts, or types (``int | None``)."""
    return any(
        isinstance(side, ast.JoinedStr)
        or (isinstance(side, ast.Constant) and not isinstance(side.value, (int, float)))
        for side in (node.left, node.right)
    )


def _text(node: ast.expr) -> str:
    return f"({ast.unparse(node)})"


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
    """Return up to ``count`` test files of a folder, in turn the nearest by imports and the nearest by place.

    By imports are first those that reach the file by the fewest; by place, those in the folder of the same
    name, with words of the file's own name in theirs. Among equals, who mentions more of what it defines.
    """
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
    by_imports = sorted(tests, key=lambda name: (away[name], -mentions[name], name))
    by_place = sorted(by_imports, key=lambda name: -_alike(Path(file), Path(name).relative_to(TESTS)))
    return list(dict.fromkeys(chain.from_iterable(zip(by_imports, by_place, strict=True))))[:count]


def _alike(file: Path, test: Path) -> int:
    """How many folders from the top on, and words of their names, a module and a test have in common."""
    folders = takewhile(lambda pair: pair[0] == pair[1], zip(file.parts[:-1], test.parts[:-1], strict=False))
    words = set(file.stem.split("_")) & set(test.stem.split("_"))
    return len(list(folders)) + len(words)


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
        elif isinstance(node, ast.Constant) and "." in str(node.value):
            found.add(str(node.value))  # importlib is told a name
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
