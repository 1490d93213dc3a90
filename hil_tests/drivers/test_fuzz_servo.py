"""A short share of tools/fuzz_servo.py: the parsers of drivers and simulators on broken bytes."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest


def test_no_parser_fails(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(repository / "tools"))
    fuzz = importlib.import_module("fuzz_servo")
    monkeypatch.delitem(sys.modules, "fuzz_servo")
    counts, _, failures = fuzz.campaign(3000, seed=11)
    assert failures == []
    for name, counter in counts.items():
        assert counter["right"] > 0.7 * 500, name
