"""List the tests of the long run: each file, its part, and why it is not in the quick run.

    .venv/bin/python -m tools.long_tests                                        # the table, in Markdown
    .venv/bin/python -m tools.long_tests --page docs/contribute/testing.md      # the table in the page

Read from the markers ``pytest.mark.long(part, why)`` in the text of hil_tests; nothing is imported.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from tools.command import end, options

REPOSITORY = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- long tests: begin -->", "<!-- long tests: end -->"


def marked() -> list[tuple[int, str, str]]:
    """Return part, test and reason of every marker, in the order of the parts.

    Raises
    ------
    ValueError
        For a marker whose part and reason do not stand in the text as a number and a string.
    """
    found = [one for file in sorted((REPOSITORY / "hil_tests").rglob("*.py")) for one in _markers(file)]
    return sorted(found)


def _markers(file: Path) -> Iterator[tuple[int, str, str]]:
    name = str(file.relative_to(REPOSITORY))
    place: dict[int, str] = {}
    text = file.read_text()
    if "mark.long(" not in text:
        return
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            for decorator in node.decorator_list:
                place |= {id(inner): f"{name}::{node.name}" for inner in ast.walk(decorator)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and _is_marker(node.func):
            try:
                part, why = (ast.literal_eval(argument) for argument in node.args)
            except ValueError:
                raise ValueError(
                    f"{name}:{node.lineno}: long(part, why) wants a number and a string"
                ) from None
            yield part, place.get(id(node), name), why


def _is_marker(name: ast.expr) -> bool:
    return getattr(name, "attr", "") == "long" and ast.unparse(name) in ("pytest.mark.long", "mark.long")


def table() -> str:
    """Return the tests of the long run as a table in Markdown."""
    rows = [f"| {part} | `{test}` | {why} |" for part, test, why in marked()]
    return "\n".join(["| part | tests | why not in the quick run |", "| --- | --- | --- |", *rows])


def with_table(page: str) -> str:
    """Return a page with the table between its two marks renewed."""
    before, rest = page.split(BEGIN)
    after = rest.split(END)[1]
    return f"{before}{BEGIN}\n{table()}\n{END}{after}"


def main() -> int:
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--page", type=Path, metavar="FILE", help="renew the table in this page")
    args = parser.parse_args()
    if args.page:
        args.page.write_text(with_table(args.page.read_text()))
    else:
        print(table())
    return 0


if __name__ == "__main__":
    end(main)
