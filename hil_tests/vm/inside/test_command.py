"""mastctl camera list, check and focus on vivid's cameras."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image as PillowImage

from mastctl.cli.main import main

from .conftest import BUS

SETTINGS = ["--size", "640", "480", "--rate", "25", "--set", "timestamp_source=start_of_exposure"]


def told(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, object]:
    capsys.readouterr()
    code = main(["camera", *words, "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert code == 0, answer
    return answer


def test_the_list_names_both_cameras_and_not_the_metadata_node(capsys: pytest.CaptureFixture[str]) -> None:
    cameras = told(capsys, "list")["cameras"]
    assert [c["bus"] for c in cameras] == list(BUS)  # type: ignore[attr-defined]


def test_a_check_tells_rate_losses_light_and_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    found = told(capsys, "check", BUS[0], "--seconds", "2", *SETTINGS)
    assert found["rate_hz"] == pytest.approx(25.0, rel=0.1)  # by stamps and counts: gaps do not matter
    assert found["damaged"] == 0
    assert 0.0 < found["quality"]["mean"] < 255.0  # type: ignore[index]
    assert {"YUYV", "GREY"} <= {f["code"] for f in found["formats"]}  # type: ignore[attr-defined]
    assert "brightness" in {c["name"] for c in found["controls"]}  # type: ignore[attr-defined]


def test_a_grabbed_picture_carries_its_time(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "grey.png"
    found = told(capsys, "grab", BUS[0], "--out", str(file), *SETTINGS)
    with PillowImage.open(file) as opened:
        opened.load()
        assert opened.size == (640, 480) and opened.mode == "L"
        assert opened.text["time_utc"] == found["time_utc"]  # type: ignore[attr-defined]
