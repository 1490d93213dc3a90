"""The command handoff: the contract's keys, refusals and exit codes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.pointing import solve
from mastctl.cli.main import main

HEAD = ["--pan", "0.1", "--tilt", "-0.55"]
TARGET = (2.3, 0.2, -0.1)


@pytest.fixture
def run(repository: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run the command on the true rig; returns exit code and the JSON document."""

    def command(*words: str) -> tuple[int, Any]:
        code = main(["handoff", str(repository / "configs/sim/rocky8.yaml"), *words, "--json"])
        return code, json.loads(capsys.readouterr().out)

    return command


@pytest.fixture
def clicked(repository: Path) -> list[str]:
    """The target's pixels in the Navcams as options."""
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    words = []
    for side, name in zip(("--left", "--right"), rig.stereo["navcam"], strict=True):
        pixel, _ = rig.camera_in_rover(name, 0.1, -0.55).project(np.array(TARGET))
        words += [side, *map(repr, pixel.tolist())]
    return words


def test_the_contracts_keys(run: Any, clicked: list[str]) -> None:
    code, told = run("--from", "navcam", "--to", "hazcam", *HEAD, *clicked)
    assert code == 0
    assert np.allclose(told["position_m"], TARGET, atol=1e-9)
    assert set(told["pixels"]) == {"hazcam_left", "hazcam_right"}
    for seen in told["pixels"].values():
        covariance = np.array(seen["covariance_px2"])
        assert covariance.shape == (2, 2) and np.all(np.linalg.eigvalsh(covariance) > 0)


def test_a_camera_that_does_not_see_it_is_null_with_a_reason(
    run: Any, clicked: list[str], repository: Path
) -> None:
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    best = solve(rig.mast, rig.cameras["pancam_left"].model, TARGET, (200.0, 380.0))[0]
    turned = ("--to-pan", repr(best.pan_rad), "--to-tilt", repr(best.tilt_rad))
    code, told = run("--from", "navcam", "--to", "pancam", *turned, *HEAD, *clicked)
    assert code == 0
    assert abs(told["pixels"]["pancam_left"]["x_px"] - 200) < 1e-6
    assert told["pixels"]["pancam_right"] is None
    assert "outside the image of 1024 x 768" in told["reasons"]["pancam_right"]


def test_a_turned_head_that_nobody_sees_with_ends_with_one(run: Any, clicked: list[str]) -> None:
    code, told = run("--from", "navcam", "--to", "pancam", "--to-pan", "2.0", *HEAD, *clicked)
    assert code == 1
    assert told["error"]["code"] == "not_seen"
    assert "pancam_left" in told["error"]["message"] and "pancam_right" in told["error"]["message"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--from", "mono", "--to", "hazcam", *HEAD), "mono"),
        (("--from", "navcam", "--to", "hazcam"), "--pan"),
    ],
)
def test_wrong_use_is_one_sentence(run: Any, clicked: list[str], words: Any, expected: str) -> None:
    code, told = run(*words, *clicked)
    assert code == 2
    assert expected in told["error"]["message"]
