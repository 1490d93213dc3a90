"""`mastctl rig sim new`: a rig that runs at once, drawn as its mast file says it was calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rigid import tangents
from mastctl.cli.main import main
from mastctl.config import load_config
from mastctl.setup.simulated_rig import true_twin

FILES = ("config.yaml", "mast.yaml", "true_rig.yaml")


def made(folder: Path, *words: str) -> dict[str, bytes]:
    assert main(["rig", "sim", "new", str(folder), *words]) == 0
    return {name: (folder / name).read_bytes() for name in FILES}


def parameters(believed: Path, drawn: Path) -> dict[str, float]:
    """How far a rig is from another, by the names of a fit, without the code that moved it."""
    one, other = load_rig(believed).rig, load_rig(drawn).rig
    found: dict[str, float] = {}
    for kind in ("translation_m", "rotation_rad"):
        difference = getattr(other.mast, kind) - getattr(one.mast, kind)
        found |= {f"mast.{kind}.{axis}": float(d) for axis, d in zip("xyz", difference, strict=True)}
    for name, camera in one.cameras.items():
        for letter in camera.model.kind:
            at = getattr(camera.model, letter)
            moved = getattr(other.cameras[name].model, letter)
            if letter in "AO":  # the step before the vector was made one of length 1 again
                moved = moved / (moved @ at)
                parts = dict(zip("12", tangents(at) @ (moved - at), strict=True))
            else:
                names = {"R": "012", "E": "012"}.get(letter, "xyz")
                parts = dict(zip(names, moved - at, strict=True))
            found |= {f"cameras.{name}.{letter}.{part}": float(value) for part, value in parts.items()}
    return found


def test_all_that_is_drawn_comes_from_the_seed(tmp_path: Path) -> None:
    first, again = made(tmp_path / "a", "--seed", "3"), made(tmp_path / "b", "--seed", "3")
    other = made(tmp_path / "c", "--seed", "4")
    assert first == again
    assert first["mast.yaml"] != other["mast.yaml"] and first["true_rig.yaml"] != other["true_rig.yaml"]


def test_the_numbers_asked_for_are_those_of_the_rig(tmp_path: Path) -> None:
    words = "--height 2.2 --baseline 0.4 --size 800x600 --view-deg 50 --head ph42 --speed max"
    made(tmp_path, *words.split())
    rig = load_rig(tmp_path / "mast.yaml").rig
    left, right = (rig.cameras[f"navcam_{side}"].model for side in ("left", "right"))
    assert left.size_px == (800, 600)
    assert rig.mast.translation_m == pytest.approx([0.0, 0.0, -2.2], abs=0.01)
    assert np.linalg.norm(right.C - left.C) == pytest.approx(0.4, abs=0.015)
    edges = left.ray([(-0.5, 299.5), (799.5, 299.5)]).directions
    assert np.degrees(np.arccos(edges[0] @ edges[1])) == pytest.approx(50.0, abs=1.5)
    config = load_config(tmp_path / "config.yaml")
    assert config.hardware.simulation["head"] == "ph42" and config.hardware.simulation["speed"] == "max"


def test_a_rig_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = made(tmp_path, "--seed", "1")
    (tmp_path / "config.yaml").unlink()
    assert main(["rig", "sim", "new", str(tmp_path), "--seed", "2"]) == 2
    told = capsys.readouterr().err
    assert "mast.yaml exists, and nothing is replaced" in told
    assert (tmp_path / "mast.yaml").read_bytes() == before["mast.yaml"]
    assert not (tmp_path / "config.yaml").exists()


def test_a_twin_believes_the_file_and_is_drawn_from_its_covariance(repository: Path, tmp_path: Path) -> None:
    from scipy.stats import chi2  # slow to load, and every worker loads this file

    file = repository / "configs" / "masts" / "rocky8_simulated.yaml"
    fit: Any = load_rig(file).rig.fit
    weight = np.linalg.inv(np.array(fit["covariance"]))
    squares = []
    for seed in range(6):
        folder = tmp_path / str(seed)
        assert made(folder, "--from", str(file), "--seed", str(seed))["mast.yaml"] == file.read_bytes()
        apart = parameters(folder / "mast.yaml", folder / "true_rig.yaml")
        step = np.array([apart[name] for name in fit["parameters"]])
        squares.append(float(step @ weight @ step))
    low, high = (float(chi2.ppf(p, 6 * len(fit["parameters"]))) for p in (0.001, 0.999))
    assert low < sum(squares) < high, squares


def test_a_file_without_covariance_gets_stated_sigmas_and_they_are_told(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All kinds of cameras, on the head and on the body; by the sigmas' own meaning."""
    rig = replace(load_rig(repository / "configs" / "sim" / "skew8.yaml").rig, fit={})
    save_rig(rig, tmp_path / "bare.yaml")
    made(tmp_path / "twin", "--from", str(tmp_path / "bare.yaml"))
    assert "no covariance" in capsys.readouterr().out
    assert (
        "stated sigmas"
        in yaml.safe_load((tmp_path / "twin" / "true_rig.yaml").read_text())["provenance"]["drawn"]
    )
    focal, places, turns = [], [], []
    for seed in range(60):
        true_rig = true_twin(rig, np.random.default_rng(seed)).true_rig
        for name, camera in rig.cameras.items():
            one, other = camera.model, true_rig.cameras[name].model
            lengths = [np.linalg.norm(np.cross(model.A, model.V)) for model in (one, other)]
            focal.append(lengths[1] / lengths[0] - 1.0)
            places.append(other.C - one.C)
            turns.append(tangents(one.A) @ (other.A - one.A))
    for values, sigma in ((focal, 1e-4), (places, 2e-4), (turns, 5e-5)):
        assert np.std(np.array(values)) == pytest.approx(sigma, rel=0.12)
