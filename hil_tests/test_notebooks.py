"""The notebooks of the tutorials: run from top to bottom they show what is kept inside them."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from hil_tests.test_tutorials import agrees
from tools import notebooks
from tools.site_pages import notebook_page

RUN = """
import json, sys
from pathlib import Path
from tools import notebooks
done = notebooks.run(notebooks.read(Path(sys.argv[1])), Path(sys.argv[2]))
Path(sys.argv[3]).write_text(json.dumps(done))
"""


def test_a_cell_shows_what_it_prints_its_last_value_and_its_figures(tmp_path: Path) -> None:
    sources = ["x = 3\nprint('three')\nx + 1", "from matplotlib import pyplot as plt\nplt.plot([1, 2])\nNone"]
    cells = [{"cell_type": "code", "source": [source], "outputs": []} for source in sources]
    done = notebooks.run({"cells": [{"cell_type": "markdown", "source": ["# One"]}, *cells]}, tmp_path)
    assert list(notebooks.texts(done)) == ["three\n\n4\n", ""]
    (figure,) = notebooks.figures(done)
    assert figure.startswith(b"\x89PNG")
    page = notebook_page(done, "one.ipynb", ["one-0.png"])
    assert page.startswith("# One\n") and "```text\nthree\n```" in page and "(one-0.png)" in page


def test_a_cell_that_fails_is_named_by_its_number(tmp_path: Path) -> None:
    cells = [{"cell_type": "code", "source": [source], "outputs": []} for source in ("1", "1 / 0")]
    with pytest.raises(ZeroDivisionError) as raised:
        notebooks.run({"cells": cells}, tmp_path)
    assert raised.value.__notes__ == ["in code cell 2"]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("first-pointing", marks=pytest.mark.long(2, "a notebook: a daemon and two pointings")),
        pytest.param("recalibrate", marks=pytest.mark.long(3, "a notebook: a bench and what-if")),
    ],
)
def test_a_notebook_shows_what_it_kept(name: str, repository: Path, tmp_path: Path) -> None:
    kept = notebooks.read(notebooks.FOLDER / f"{name}.ipynb")
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="n") as short:  # sockets
        words: list[str | Path] = [
            sys.executable,
            "-c",
            RUN,
            notebooks.FOLDER / f"{name}.ipynb",
            short,
            tmp_path / "done.json",
        ]
        ran = subprocess.run(words, cwd=repository, capture_output=True, text=True, timeout=3600.0)
    assert ran.returncode == 0, ran.stderr
    done = json.loads((tmp_path / "done.json").read_text())
    for before, now in zip(notebooks.texts(kept), notebooks.texts(done), strict=True):
        assert agrees(before, now), f"{now}\nwhere the notebook shows\n{before}"
    assert len(notebooks.figures(done)) == len(notebooks.figures(kept)) > 0
