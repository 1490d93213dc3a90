"""Write the client for asyncio from the one that waits, so that both have the same methods.

    .venv/bin/python -m tools.async_client

Methods become coroutines, questions to the daemon are awaited, streams are asynchronous. What is written is
committed; a test asks whether it still comes of its source.
"""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
from pathlib import Path

from tools.arguments import end

FOLDER = Path(__file__).resolve().parent.parent / "mastctl" / "client"
FILES = {"client.py": "async_client.py", "following.py": "async_following.py"}
NAMES = {
    "Client": "AsyncClient",
    "DaemonHttp": "AsyncDaemonHttp",
    "Iterator": "AsyncIterator",
    "contextmanager": "asynccontextmanager",
    "followed": "async_followed",
    "__enter__": "__aenter__",
    "__exit__": "__aexit__",
}
PLAIN = {"__init__", "use_lease", "jog", "_target", "_how_far"}
"""Functions that ask nothing."""
STREAMS = {"events", "heard", "followed", "_stream", "async_followed"}
ASKED = {"json", "command", "ask", "close", "operation", "acquire_lease", "wait"}
"""What is awaited, of ``self``, ``self._daemon``, or by itself."""


class Asynchronous(ast.NodeTransformer):
    """Turns functions that wait into coroutines."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        self.generic_visit(node)
        node.name = NAMES.get(node.name, node.name)
        if node.name in PLAIN:
            return node
        fields = {name: getattr(node, name) for name in node._fields}
        return ast.copy_location(ast.AsyncFunctionDef(**fields), node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        self.generic_visit(node)
        node.name = NAMES.get(node.name, node.name)
        return node

    def visit_Name(self, node: ast.Name) -> ast.AST:
        node.id = NAMES.get(node.id, node.id)
        return node

    def visit_alias(self, node: ast.alias) -> ast.AST:
        node.name = NAMES.get(node.name, node.name)
        return node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST:
        self.generic_visit(node)
        if any(one.name == "AsyncDaemonHttp" for one in node.names):
            node.names = [one for one in node.names if one.name != "AsyncDaemonHttp"]
            asynchronous = ast.parse("from mastctl.client.async_connection import AsyncDaemonHttp").body
            return [*asynchronous, node]  # type: ignore[return-value]
        if node.module == "mastctl.client.following":
            node.module = "mastctl.client.async_following"
        return node

    def visit_Lambda(self, node: ast.Lambda) -> ast.AST:
        return node  # its caller awaits

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        self.generic_visit(node)
        text = ast.unparse(node)
        if text == "Callable[[], T]":
            return ast.parse("Callable[[], Awaitable[T]]", mode="eval").body
        return node

    def visit_For(self, node: ast.For) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.iter, ast.Call) and _called(node.iter) in STREAMS:
            return ast.AsyncFor(node.target, node.iter, node.body, node.orelse, lineno=node.lineno)
        return node

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.value, ast.YieldFrom):
            stream = ast.unparse(node.value.value)
            text = f"async def _():\n    async for event in {stream}:\n        yield event"
            return ast.parse(text).body[0].body[0]  # type: ignore[attr-defined,no-any-return]
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        text, name = ast.unparse(node.func), _called(node)
        if text in ("held.end",):
            return ast.Await(ast.parse("asyncio.to_thread(held.end)", mode="eval").body)
        if text == "time.sleep":
            return ast.Await(ast.parse(f"asyncio.sleep({ast.unparse(node.args[0])})", mode="eval").body)
        owner = text.rpartition(".")[0]
        if name in ASKED and owner in ("", "self", "self._daemon"):
            return ast.Await(node)
        return node


def _called(node: ast.Call) -> str:
    return ast.unparse(node.func).rpartition(".")[2]


def written(source: str) -> str:
    """Return the client for asyncio that comes of a source."""
    tree = Asynchronous().visit(ast.parse(source))
    text = ast.unparse(ast.fix_missing_locations(tree))
    head, _, rest = text.partition("from __future__ import annotations\n")
    awaitable = "from collections.abc import Awaitable\n" if "Awaitable" in rest else ""
    made = f"{head}from __future__ import annotations\nimport asyncio\n{awaitable}{rest}"
    made = made.replace('"""', '"""Asyncio: ', 1)
    return tidy(f"# Made by tools/async_client.py; what is to be changed is changed in its source.\n{made}")


def tidy(text: str) -> str:
    """The same in the project's form."""
    ruff = str(Path(sys.executable).with_name("ruff"))
    for words in (["check", "--fix", "-q", "--exit-zero", "--line-length", "110"], ["format", "-q"]):
        command = [ruff, *words, "--stdin-filename", str(FOLDER / "made.py"), "-"]
        text = subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout
    return text


def main() -> None:
    """Write the files."""
    words = "Write the client for asyncio from the one that waits for its answers."
    argparse.ArgumentParser(description=words).parse_args()
    for source, target in FILES.items():
        (FOLDER / target).write_text(written((FOLDER / source).read_text()))


if __name__ == "__main__":
    end(main)
