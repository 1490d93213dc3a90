"""The command that makes the shipped mast file makes the shipped mast file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calib.store import load_rig

SAME_PX = 1e-3
"""Another processor's arithmetic may end the fit this far away."""


@pytest.mark.parametrize("name", ["rocky8_simulated", "skew8_simulated"])
def test_its_own_command_makes_the_shipped_mast_file_again(
    repository: Path, tmp_path: Path, name: str
) -> None:
    shipped = load_rig(repository / "configs" / "masts" / f"{name}.yaml").rig
    words = str(shipped.provenance["command"]).split()
    again = tmp_path / f"{name}.yaml"
    words[words.index("--out") + 1] = str(again)
    done = subprocess.run(
        [sys.executable, *words, "--targets", "20"],
        cwd=repository,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
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


def test_a_true_rig_that_is_not_there_is_one_line(repository: Path, tmp_path: Path) -> None:
    command = ["tools/make_simulated_mast.py", "--rig", "nowhere.yaml", "--out", str(tmp_path / "x.yaml")]
    done = subprocess.run(
        [sys.executable, *command], cwd=repository, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "nowhere.yaml" in done.stderr
    assert not (tmp_path / "x.yaml").exists()
