"""docs/explanation/safety.md tells the states as the code has them, in its tables and in its picture."""

from __future__ import annotations

from pathlib import Path

import pytest

from mastctl.control import table
from mastctl.control.table import TABLE, WORDS
from tools import states

REPOSITORY = Path(__file__).resolve().parent.parent
PAGE = REPOSITORY / "docs" / "explanation" / "safety.md"


def test_the_page_agrees_with_the_code() -> None:
    text = PAGE.read_text()
    assert text == states.with_tables(text), "python -m tools.states --page docs/explanation/safety.md"
    assert all(f"| `{word}` |" in text for word in WORDS)


def test_the_picture_agrees_with_the_code() -> None:
    svg = (REPOSITORY / "docs" / "img" / "states.svg").read_text()
    assert svg == states.picture(), "python -m tools.states --svg docs/img/states.svg"


def test_another_table_makes_another_page_and_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    page, picture = PAGE.read_text(), states.picture()
    changed = {**TABLE["ready"], "head_moves": "tracking"}
    monkeypatch.setattr(table, "TABLE", {**TABLE, "ready": changed})
    monkeypatch.setattr(states, "TABLE", table.TABLE)
    assert states.with_tables(page) != page
    assert states.picture() != picture
