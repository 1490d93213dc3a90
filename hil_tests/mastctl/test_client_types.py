"""The types of the client's answers are of use to a type checker."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from mastctl.client import Client
from mastctl.client.calls import Calls, KeepingCalls, LeaseCalls, SimulationCalls

PROGRAM = """
from mastctl.client import AsyncClient, Client
from mastctl.client.answers import Event

def known(client: Client) -> float:
    joints = client.status()["joints"]
    return 0.0 if joints is None else joints["pan_rad"]

def told(event: Event) -> str:
    return event["value"]["reason"] if event["topic"] == "state" else ""

async def waited(client: AsyncClient) -> str:
    return (await client.wait("1", on_step=lambda step: print(step["duration_s"])))["id"]

def wrong(client: Client) -> None:
    client.status()["jionts"]
    client.status()["joints"]["pan_rad"]
    client.track()["range_m"] + 1.0
    client.wait("1")["pointings"][0]["residual"]
"""
WRONG = (
    'TypedDict "Status" has no key "jionts"',
    'Value of type "Joints | None" is not indexable',
    "Unsupported operand types for +",
    'TypedDict "PointingTold" has no key "residual"',
)


def test_a_type_checker_knows_what_is_answered(tmp_path: Path, repository: Path) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--config-file=", str(tmp_path / "program.py")],
        capture_output=True,
        text=True,
        cwd=repository,
        check=False,
    )
    told = [line for line in done.stdout.splitlines() if "program.py" in line and ": error: " in line]
    assert len(told) == len(WRONG), done.stdout
    for line, words in zip(told, WRONG, strict=True):
        assert words in line


@pytest.mark.parametrize("of", [Client, Calls, KeepingCalls, LeaseCalls, SimulationCalls])
def test_no_method_answers_with_a_dictionary_of_anything(of: type) -> None:
    for name, method in vars(of).items():
        told = getattr(method, "__annotations__", {}).get("return", "")
        assert "Any" not in str(told), f"{name} returns {told}"


def test_the_client_that_waits_has_every_question_of_the_one_for_asyncio() -> None:
    assert {name for name in dir(Calls) if name[0] != "_"} == {name for name in dir(Client) if name[0] != "_"}
