"""All error codes: status and remedy from docs/reference/http.md, meaning from the code.

A code that has a class of its own is explained by the class. One that a family carries is shown by the
messages that are raised with it. `site_pages` writes the page at each build of the site.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
PACKAGES = ("calib", "drivers", "mastctl")
REFUSALS = Path("docs/reference/http.md")
CODE = re.compile(r"[a-z]+(_[a-z]+)*")
DEFINED = re.compile(r"^``([a-z_]+)``: ((?:.+\n?)+?)(?=\n\n|``[a-z_]+``:|\Z)", re.MULTILINE)
SHOWN = 2
OPERATION = "operation"  # its remedy in the table is that of all codes of operations
ANSWER = "error_response"
STATUS_FIRST = (ANSWER, "GuardError")


def refusals(page: str) -> dict[str, list[tuple[str, str]]]:
    """Return status and remedy of each code in the table of refusals."""
    section = page.split("## Refusals", 1)[1].split("\n## ", 1)[0]
    found: dict[str, list[tuple[str, str]]] = {}
    for status, codes, remedy in re.findall(
        r"^\| (\w+) \| ([^|]*`[^|]*) \| ([^|]*) \|", section, re.MULTILINE
    ):
        for code in re.findall(r"`(\w+)`", codes):
            found.setdefault(code, []).append((status, remedy.replace("](../", "](../../").strip()))
    return found


def meanings(listed: Collection[str], root: Path = REPOSITORY) -> dict[str, list[str]]:
    """Return what the code says of each error code: the listed ones, and those of commands alone.

    In this order: a line ``code``: meaning in a docstring of a class; the first sentence of a class with this
    code; the messages that are raised with it; the first sentence of the family that carries it, where a
    message is put together elsewhere.
    """
    modules = [
        ast.parse(path.read_text(encoding="utf-8"))
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
    ]
    every = [node for module in modules for node in ast.walk(module)]
    raised = {
        node.exc.func.id
        for node in every
        if isinstance(node, ast.Raise)
        and isinstance(node.exc, ast.Call)
        and isinstance(node.exc.func, ast.Name)
    }
    kinds = [one for one in every if isinstance(one, ast.ClassDef) and one.name in raised]
    sentences = {kind.name: _first_sentence(kind) for kind in kinds}
    defined: dict[str, list[str]] = {}
    classes: dict[str, list[str]] = {}
    messages: dict[str, list[str]] = {}
    beside: dict[str, list[str]] = {}
    anywhere: dict[str, list[str]] = {}
    for kind in kinds:
        for code, words in DEFINED.findall(ast.get_docstring(kind) or ""):
            defined[code] = [" ".join(words.split())]
        for code in _codes_of(kind):
            classes.setdefault(code, []).append(sentences[kind.name])
    for module in modules:
        known: dict[str, str] = {}
        for node in _in_order(module):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                known = {}
            elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                known[node.targets[0].id] = _message(node.value, known)
            elif isinstance(node, ast.Tuple):
                for code, message in _side_by_side(node.elts, known):
                    beside.setdefault(code, []).append(message)
            elif isinstance(node, ast.Call) and _name(node.func) in raised | {ANSWER}:
                values = node.args[1:] if _name(node.func) in STATUS_FIRST else node.args
                for code, message in _side_by_side(values[:2], known):
                    messages.setdefault(code, []).append(message)
                for code in (code for one in values[:1] for code in _constant(one)):
                    beside.setdefault(code, []).append(sentences.get(_name(node.func), ""))
            if isinstance(node, ast.Call):
                for code, message in _side_by_side(node.args, known):
                    anywhere.setdefault(code, []).append(message)
    of_commands = {**messages, **classes}
    found = {**anywhere, **beside, **of_commands, **defined}
    return {code: words for code, words in found.items() if code in listed or code in of_commands}


def _name(called: ast.expr) -> str:
    return called.id if isinstance(called, ast.Name) else ""


def _first_sentence(kind: ast.ClassDef) -> str:
    return " ".join((ast.get_docstring(kind) or "").split("\n\n")[0].split())


def _in_order(node: ast.AST) -> Iterator[ast.AST]:
    """Yield nodes as they stand in the text, so that a message is known before it is raised."""
    waiting = [node]
    while waiting:
        one = waiting.pop()
        if one is not node:
            yield one
        waiting.extend(reversed(list(ast.iter_child_nodes(one))))


def _codes_of(kind: ast.ClassDef) -> Iterator[str]:
    """Yield the code that a class of errors carries itself."""
    for node in ast.walk(kind):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "code":
            yield from _constant(node.value)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(".__init__"):
            first = 0 if ast.unparse(node.func).startswith("super()") else 1
            yield from (code for value in node.args[first : first + 1] for code in _constant(value))


def _constant(node: ast.expr) -> Iterator[str]:
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and CODE.fullmatch(node.value):
        yield node.value


def _side_by_side(values: list[ast.expr], words: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Yield a code and the message behind it."""
    for first, second in pairwise(values):
        message = _message(second, words)
        if len(re.findall(r"[a-z]{2,}", message)) > 1:
            yield from ((code, message) for code in _constant(first))


def _message(node: ast.expr, words: dict[str, str]) -> str:
    """Return a message with `…` for each value filled in; nothing, if it is put together elsewhere."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_message(one, words) if isinstance(one, ast.Constant) else "…" for one in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _message(node.left, words) + _message(node.right, words)
    if isinstance(node, ast.IfExp):
        return _message(node.body, words)
    return words.get(node.id, "") if isinstance(node, ast.Name) else ""


def rows(root: Path = REPOSITORY) -> list[tuple[str, str, str, str]]:
    """Return code, status, meaning and remedy (Markdown) of every code; a command's own has no status."""
    listed = refusals((root / REFUSALS).read_text(encoding="utf-8"))
    meant = meanings(listed, root)
    codes = sorted({*listed, *meant})
    return [
        (
            code,
            ", ".join(status for status, _ in listed.get(code, ())),
            "; or: ".join(list(dict.fromkeys(meant.get(code, ())))[:SHOWN]),
            "; ".join(dict.fromkeys(what for status, what in listed.get(code, ()) if status != OPERATION)),
        )
        for code in codes
    ]
