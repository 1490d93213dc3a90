"""``mastctl camera mode``: a mast file for another mode of a camera, or a sentence on why there is none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.mode import Mode, in_mode
from hil_tests.mastctl.service_fakes import rig
from mastctl.cli.main import main


@pytest.fixture
def mast(tmp_path: Path) -> Path:
    save_rig(rig((64, 48)), tmp_path / "mast.yaml")
    return tmp_path / "mast.yaml"


def test_a_mast_file_of_a_mode_is_written_and_says_so(
    mast: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = tmp_path / "new.yaml"
    words = ["camera", "mode", str(mast), "--camera", "navcam_left", "--crop", "8", "4", "48", "40"]
    words += ["--bin", "2", "--flip", "both", "--out", str(new), "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    stored = load_rig(new)
    mode = "crop 48x40 px from (8, 4), binning 2x2, flip horizontal and vertical"
    assert (told["size_px"], told["mode"], told["digest"]) == ([24, 20], mode, stored.digest)
    expected, _ = in_mode(
        load_rig(mast).rig.cameras["navcam_left"].model, Mode((8, 4, 48, 40), (2, 2), (True, True))
    )
    found = stored.rig.cameras["navcam_left"].model
    for letter in "CAHV":
        assert getattr(found, letter) == pytest.approx(getattr(expected, letter), abs=1e-12)
    assert found.size_px == (24, 20)
    assert stored.rig.cameras["navcam_right"].model.size_px == (64, 48), "the others are as they were"
    assert stored.rig.provenance["modes"] == [
        {"camera": "navcam_left", "of": load_rig(mast).digest, "mode": mode}
    ]


def test_the_calibrated_file_is_not_written_over(mast: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = mast.read_bytes()
    words = ["camera", "mode", str(mast), "--camera", "navcam_left", "--flip", "both", "--out", str(mast)]
    assert main(words) == 2
    assert "which a second run would change again" in capsys.readouterr().err
    assert mast.read_bytes() == before
