"""The site of docs/: it builds, and nothing in it points to what is not there."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tools.page_tables import DIRECTIVE


@pytest.mark.long(
    1, "half a minute: the whole site is built, with broken links, images and references as errors"
)
def test_the_site_builds_without_a_warning(repository: Path, tmp_path: Path) -> None:
    build: list[str | Path] = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        "html",
        "-d",
        tmp_path / "trees",
    ]
    done = subprocess.run([*build, repository / "docs", tmp_path / "html"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    commands = (tmp_path / "html/reference/generated/commands.html").read_text()
    assert commands.count("--") > 300 and re.findall(r"[–—][a-z][a-z-]*", commands) == []
    assert "calib.solve" in (tmp_path / "html/reference/generated/python-calib.html").read_text()


def test_every_page_stands_in_the_contents(repository: Path) -> None:
    docs = repository / "docs"
    pages = {str(page.relative_to(docs).with_suffix("")) for page in docs.rglob("*.md")}
    pages = {page for page in pages if not page.startswith("_build/") and "generated" not in page}
    pages |= {f"tutorials/generated/{one.stem}-notebook" for one in (docs / "tutorials").glob("*.ipynb")}
    assert pages - {"index"} <= set((docs / "index.md").read_text().split())


def test_every_measured_table_has_its_source_and_its_page(repository: Path) -> None:
    folder = repository / "docs" / "evidence"
    with (folder / "data" / "sources.csv").open(newline="") as file:
        sources = {row["table"]: row["command"] for row in csv.DictReader(file)}
    shown = {name for page in folder.glob("*.md") for name in DIRECTIVE.findall(page.read_text())}
    assert all(sources.values())
    assert shown == {*sources, "sources"} == {table.stem for table in (folder / "data").glob("*.csv")}
