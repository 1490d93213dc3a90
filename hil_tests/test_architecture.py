"""What docs/explanation/architecture.md says: its files exist, its tools answer, its picture is true."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tools.__main__ import tools

FOLDER = Path(__file__).resolve().parent.parent / "tools"
WORKERS = {"against_others.mrcal_fit"}
"""Started by a tool, not by people."""
TOOLS = sorted(set(tools()) - WORKERS)


def test_every_tools_parser_describes_the_tool() -> None:
    for tool in TOOLS:
        place = FOLDER.joinpath(*tool.split("."))
        tree = ast.parse((place / "__main__.py" if place.is_dir() else place.with_suffix(".py")).read_text())
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        parsers = [call for call in calls if ast.unparse(call.func).endswith("ArgumentParser")]
        described = any(word.arg == "description" for parser in parsers for word in parser.keywords)
        assert described or any(ast.unparse(call).startswith("options(__doc__") for call in calls), tool


@pytest.mark.parametrize("room", ["dynamixel", "flir_ptu", "servo_bus"])
def test_a_driver_waits_on_the_clock_that_it_is_given_and_on_nothing_beside_it(
    room: str, repository: Path
) -> None:
    beside = re.compile(
        r"^import time$|^from (?:time|queue) |threading\.(?:Thread|Event|Condition|Timer|Semaphore)", re.M
    )
    files = sorted((repository / "drivers" / room).glob("*.py"))
    assert len(files) > 5
    assert {file.name: found for file in files if (found := beside.findall(file.read_text()))} == {}
