"""Run the notebooks of docs/tutorials from top to bottom and keep the outputs and figures inside them.

    .venv/bin/python -m tools.notebooks                  # all of them, in place
    .venv/bin/python -m tools.notebooks first-pointing   # one

A cell is plain Python, without the magics of Jupyter, so that neither a kernel nor IPython is needed. As in
Jupyter, a cell shows the text it prints, the value of its last expression, and the figures of pyplot it made.
The suite runs a copy (`hil_tests/test_notebooks.py`); `tools/site_pages.py` makes the pages of the site.
"""

from __future__ import annotations

import argparse
import ast
import base64
import io
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from tools.command import end

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
FIGURE_DPI = 80

Notebook = dict[str, Any]


def run(notebook: Notebook, folder: Path) -> Notebook:
    """Return a notebook with the outputs of its cells, run one after the other in a folder.

    Raises whatever a cell raises, with the cell's number as a note.
    """
    import matplotlib as mpl

    mpl.use("agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    cells, count = [], 0
    with _inside(folder):
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                count += 1
                try:
                    outputs = list(_outputs("".join(cell["source"]), names, count))
                except BaseException as error:
                    error.add_note(f"in code cell {count}")
                    raise
                cell = {**cell, "execution_count": count, "outputs": outputs}
            cells.append(cell)
    return {**notebook, "cells": cells}


def _outputs(source: str, names: dict[str, Any], count: int) -> Iterator[dict[str, Any]]:
    """Run one cell, and yield its outputs in Jupyter's format (nbformat 4)."""
    from matplotlib import pyplot

    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with redirect_stdout(printed):
        exec(compile(tree, f"<cell {count}>", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), f"<cell {count}>", "eval"), names)
    if printed.getvalue():
        yield {"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(True)}
    if value is not None:
        data = {"text/plain": repr(value).splitlines(True)}
        yield {"output_type": "execute_result", "execution_count": count, "data": data, "metadata": {}}
    for number in pyplot.get_fignums():
        png = io.BytesIO()
        pyplot.figure(number).savefig(png, format="png", dpi=FIGURE_DPI, metadata={"Software": None})
        figure = {"image/png": base64.b64encode(png.getvalue()).decode()}
        yield {"output_type": "display_data", "data": figure, "metadata": {}}
    pyplot.close("all")


@contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def texts(notebook: Notebook) -> Iterator[str]:
    """Yield what each code cell printed or returned as text."""
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            shown = [one.get("text") or one["data"].get("text/plain", []) for one in cell["outputs"]]
            yield "".join("".join(lines) + "\n" for lines in shown if lines)


def figures(notebook: Notebook) -> list[bytes]:
    """Return the figures of a notebook as PNG, in their order."""
    outputs = (one for cell in notebook["cells"] for one in cell.get("outputs", ()))
    return [
        base64.b64decode(one["data"]["image/png"]) for one in outputs if "image/png" in one.get("data", {})
    ]


def read(path: Path) -> Notebook:
    """Return a notebook."""
    notebook: Notebook = json.loads(path.read_text(encoding="utf-8"))
    return notebook


def main() -> int:
    """Run the named notebooks, or all."""
    known = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
    parser = argparse.ArgumentParser(description="Run the notebooks of docs/tutorials in place.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"default: all ({', '.join(known)})")
    for name in parser.parse_args().names or known:
        path = FOLDER / f"{name}.ipynb"
        with tempfile.TemporaryDirectory() as folder:
            done = run(read(path), Path(folder))
        path.write_text(json.dumps(done, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(f"{path}: {len(figures(done))} figures, {path.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    end(main)
