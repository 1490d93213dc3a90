"""mastctl camera list, check, grab and focus on vivid's cameras."""

from __future__ import annotations

import hashlib
import io
import json
import re
import textwrap
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PillowImage

from mastctl.cli.main import main

from .conftest import BUS

SETTINGS = ["--size", "640", "480", "--rate", "25", "--set", "timestamp_source=start_of_exposure"]

HEAD = '''
import time
from drivers.interfaces import Reading

class Head:
    """A head that stands still."""
    def read(self):
        return Reading(0.25, -0.125, False, time.monotonic())
    def move(self, pan_rad, tilt_rad, speed_rad_per_s=None):
        raise AssertionError("a picture moves nothing")
    def stop(self):
        pass
    def close(self):
        pass
'''


def told(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, object]:
    capsys.readouterr()
    code = main(["camera", *words, "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert code == 0, answer
    return answer


def test_the_list_names_both_cameras_and_not_the_metadata_node(capsys: pytest.CaptureFixture[str]) -> None:
    cameras = told(capsys, "list")["cameras"]
    assert [c["bus"] for c in cameras] == list(BUS)  # type: ignore[attr-defined, index]


def test_a_check_tells_rate_losses_light_and_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    found = told(capsys, "check", BUS[0], "--seconds", "2", *SETTINGS)
    assert found["rate_hz"] == pytest.approx(25.0, rel=0.1)  # by stamps and counts: gaps do not matter
    assert found["damaged"] == 0
    assert sum(found["quality"]["histogram"]) == pytest.approx(1.0)  # type: ignore[index]
    assert {"YUYV", "GREY"} <= {f["code"] for f in found["formats"]}  # type: ignore[attr-defined, index]
    assert "brightness" in {c["name"] for c in found["controls"]}  # type: ignore[attr-defined, index]


def test_a_check_for_people_is_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["camera", "check", BUS[0], "--seconds", "1", *SETTINGS]) == 0
    out = capsys.readouterr().out
    assert "dropped, damaged, late" in out and "brightness" in out


def test_a_grabbed_picture_carries_its_time(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "grey.png"
    found = told(capsys, "grab", BUS[0], "--out", str(file), *SETTINGS)
    with PillowImage.open(io.BytesIO(file.read_bytes())) as opened:
        opened.load()
        words = opened.text  # type: ignore[attr-defined]
        assert opened.size == (640, 480) and opened.mode == "L"
    assert words["bus"] == BUS[0] and words["mid_exposure_s"] == found["mid_exposure_s"]
    assert datetime.fromisoformat(words["time_utc"]).utcoffset() is not None


def test_the_aim_pixel_is_marked_and_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "aim.png"
    told(capsys, "grab", BUS[0], "--out", str(file), "--aim", "100", "50", *SETTINGS)
    with PillowImage.open(file) as opened:
        image = np.asarray(opened)
        assert opened.text["aim_x_px"] == "100.0"  # type: ignore[attr-defined]
    assert (image[50, 106] == [255, 255, 0]).all() and not (image[50, 100] == [255, 255, 0]).all()


def test_sharpness_is_told_again_and_again(capsys: pytest.CaptureFixture[str]) -> None:
    found = told(capsys, "focus", BUS[0], "--seconds", "1.6", *SETTINGS)
    seen: Any = found["sharpness"]
    assert len(seen) >= 2 and found["best"] == max(seen)


@pytest.fixture
def config(tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A configuration: the camera as navcam_left, a head that stands still, a mast file of its size."""
    (tmp_path / "still_head.py").write_text(HEAD)
    monkeypatch.syspath_prepend(tmp_path)
    mast = (repository / "configs" / "masts" / "rocky8_simulated.yaml").read_text()
    (tmp_path / "mast.yaml").write_text(re.sub(r"size_px: .*", "size_px: [640, 480]", mast))
    (tmp_path / "other.yaml").write_text(mast)
    path = tmp_path / "config.yaml"
    path.write_text(
        textwrap.dedent(f"""
        schema: mastctl/config/1
        mast_file: mast.yaml
        pan_tilt: {{driver: "still_head:Head"}}
        cameras:
          navcam_left:
            driver: v4l2
            options: {{bus: "{BUS[0]}", rate_hz: 25, controls: {{timestamp_source: 1, osd_text_mode: none}}}}
        limits: {{pan_rad: [-2.6, 2.6], tilt_rad: [-1.2, 0.7], speed_rad_per_s: 1.0}}
        """)
    )
    return path


def test_a_configured_camera_carries_joints_and_mast_digest(
    capsys: pytest.CaptureFixture[str], config: Path, tmp_path: Path
) -> None:
    file = tmp_path / "x.png"
    told(capsys, "grab", "navcam_left", "--config", str(config), "--out", str(file))
    with PillowImage.open(file) as opened:
        opened.load()
        words = opened.text  # type: ignore[attr-defined]
    assert words["mast_digest"] == hashlib.sha256((tmp_path / "mast.yaml").read_bytes()).hexdigest()
    assert (words["pan_rad"], words["tilt_rad"], words["moving"]) == ("0.25", "-0.125", "false")


def test_another_size_than_the_mast_files_is_told(
    capsys: pytest.CaptureFixture[str], config: Path, tmp_path: Path
) -> None:
    config.write_text(config.read_text().replace("mast.yaml", "other.yaml"))
    assert (
        main(["camera", "grab", "navcam_left", "--config", str(config), "--out", str(tmp_path / "x.png")])
        == 1
    )
    words = capsys.readouterr().err
    assert "navcam_left: the image is 640x480 px where the mast file has 1024x768 px" in words
