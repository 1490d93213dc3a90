"""``mastctl camera mode``: a mast file for another mode of a camera, or a sentence on why there is none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.mode import in_mode
from calib.geometry.sensor_mode import Mode, SensorMode
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
    words += ["--bin", "2", "--flip", "both", "--size", "24", "20", "--out", str(new), "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    stored = load_rig(new)
    mode = "crop 48x40 px from (8, 4), binning 2x2, flip horizontal and vertical"
    assert (told["size_px"], told["mode"], told["digest"]) == ([24, 20], mode, stored.digest)
    expected = in_mode(
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


def test_the_sensors_mode_is_carried_over_and_one_that_is_not_told_is_left_out(
    mast: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    little, new = load_rig(mast).rig, tmp_path / "new.yaml"
    off_middle = SensorMode((64, 48), (30, 8, 64, 48), (128, 96))

    def written(mode: SensorMode, *options: str) -> SensorMode | None:
        held = replace(little.cameras["navcam_left"], sensor_mode=mode)
        save_rig(replace(little, cameras={**little.cameras, "navcam_left": held}), mast)
        words = ["camera", "mode", str(mast), "--camera", "navcam_left", *options, "--out", str(new)]
        assert main(words) == 0
        return load_rig(new).rig.cameras["navcam_left"].sensor_mode

    binned = written(off_middle, "--crop", "8", "4", "48", "40", "--bin", "2")
    assert binned == SensorMode((24, 20), (38, 12, 48, 40), (128, 96))
    assert written(off_middle, "--flip", "both") is None
    told = "which part of the sensor navcam_left then shows is not known: its sensor_mode is left out"
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("modes", "kept"), [(3, [3]), (None, []), ({"a": 1}, [{"a": 1}]), ([{"mode": "x"}], [{"mode": "x"}])]
)
def test_other_modes_of_a_provenance_stay_whatever_they_are(
    mast: Path, tmp_path: Path, modes: object, kept: list[object]
) -> None:
    """Anybody may write anything under ``provenance``."""
    save_rig(replace(load_rig(mast).rig, provenance={"modes": modes}), mast)
    new = tmp_path / "new.yaml"
    assert (
        main(["camera", "mode", str(mast), "--camera", "navcam_left", "--flip", "both", "--out", str(new)])
        == 0
    )
    noted = load_rig(new).rig.provenance["modes"]
    assert list(noted[:-1]) == kept and noted[-1]["mode"] == "flip horizontal and vertical"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--bin", "5"], "binning by 5 does not divide a picture 64 px wide"),
        (
            ["--crop", "40", "0", "30", "48"],
            "the crop of 30x48 px from (40, 0) is not inside the calibrated 64x48",
        ),
        (["--size", "32", "24"], "they may be binned by 2 or cropped: say which with --bin or --crop"),
        (["--size", "32", "18"], "no binning alone changes 64x48 px to that shape: say its --crop"),
        (["--size", "48", "36"], "a scale of 1/1.33333 is no binning"),
        ([], "--crop, --bin or --flip is expected"),
        (["--bin", "1", "2", "3"], "--bin has 3 numbers where one or two are expected"),
    ],
)
def test_a_mode_that_cannot_be_is_refused_and_nothing_is_written(
    mast: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    new = tmp_path / "new.yaml"
    assert main(["camera", "mode", str(mast), "--camera", "navcam_left", *options, "--out", str(new)]) != 0
    assert words in capsys.readouterr().err and not new.exists()


def test_the_calibrated_file_is_not_written_over(mast: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = mast.read_bytes()
    words = ["camera", "mode", str(mast), "--camera", "navcam_left", "--flip", "both", "--out", str(mast)]
    assert main(words) == 2
    assert "which a second run would change again" in capsys.readouterr().err
    assert mast.read_bytes() == before
