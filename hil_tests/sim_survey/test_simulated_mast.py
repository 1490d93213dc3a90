"""The command that makes the shipped mast file makes the shipped mast file."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.covariance import stored_covariance
from tools.simulated.mast import projection_error_px, turned_rover_frame

SAME_PX = 1e-3
"""Another processor's arithmetic may end the fit this far away."""

PAIRS = [("rocky8_simulated", "rocky8"), ("skew8_simulated", "skew8")]


def run_tool(repository: Path, words: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    """Run the tool as its command does, in this process."""
    monkeypatch.chdir(repository)
    monkeypatch.setattr("sys.argv", words[2:])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(words[2], run_name="__main__")
    return int(ended.value.code or 0)


@pytest.mark.long(4, "makes the shipped mast files anew; their content is tested quickly")
@pytest.mark.parametrize("name", ["rocky8_simulated", "skew8_simulated"])
def test_its_own_command_makes_the_shipped_mast_file_again(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    shipped = load_rig(repository / "configs" / "masts" / f"{name}.yaml").rig
    words = str(shipped.provenance["command"]).split()
    again = tmp_path / f"{name}.yaml"
    words[words.index("--out") + 1] = str(again)
    assert run_tool(repository, [*words, "--targets", "2"], monkeypatch) == 0
    made = load_rig(again).rig
    rng = np.random.default_rng(1)
    for camera in shipped.cameras:
        pan, tilt = rng.uniform(-1, 1), rng.uniform(-0.8, 0.2)
        old, new = (rig.camera_in_rover(camera, pan, tilt) for rig in (shipped, made))
        pixels = rng.uniform(0, 1, (50, 2)) * old.size_px
        rays = old.ray(pixels)
        points = rays.origins_m + rng.uniform(2, 10, (50, 1)) * rays.directions
        moved = new.project(points)[0] - pixels
        assert np.abs(moved).max() < SAME_PX, camera


@pytest.mark.parametrize(("name", "true_name"), PAIRS)
def test_the_shipped_mast_file_is_as_good_as_a_survey_and_no_better(
    repository: Path, name: str, true_name: str
) -> None:
    shipped = load_rig(repository / "configs" / "masts" / f"{name}.yaml").rig
    true = load_rig(repository / "configs" / "sim" / f"{true_name}.yaml").rig
    together = turned_rover_frame(true, shipped, (10.0, 6.0, 2.0, 1.0))
    for camera in shipped.cameras:
        as_surveyed = projection_error_px(true, shipped, camera, 2.0)
        error_px = projection_error_px(together, shipped, camera, 2.0)
        worst_px = np.linalg.norm(error_px, axis=1).max()
        assert 0.01 < worst_px < (0.7 if "pancam" in camera else 0.35), camera
        assert np.sqrt(np.mean(as_surveyed**2)) > 0.1, "the truth has leaked into the mast file"
    covariance = stored_covariance(shipped)
    assert covariance is not None
    assert {name.split(".")[1] for name in covariance.names if name.startswith("cameras.")} == set(
        shipped.cameras
    )
