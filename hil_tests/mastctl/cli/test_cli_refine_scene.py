"""``calibrate --refine-scene`` on real pictures: Opportunity's five Navcam frames and their labels' mast."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from calib.files.mast_file import load_rig, save_rig
from mastctl.cli.main import main
from tools.flight import mer

FRAMES = Path(__file__).parents[4] / "shared" / "data" / "mer_navcam"


@pytest.fixture
def mast(tmp_path: Path) -> Path:
    products = mer.labels(FRAMES)
    if len(products) != 5:
        pytest.skip(f"{FRAMES} does not hold the five frames")
    return save_rig(mer.rig(mer.fit(products), products), tmp_path / "mast.yaml").path


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """The five frames alone: the folder has other cameras' too."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for path in FRAMES.glob(mer.PRODUCTS):
        (folder / path.name).symlink_to(path)
    return folder


def test_real_pictures_correct_a_mast_and_what_was_corrected_stands_in_the_file(
    mast: Path, frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = mast.with_name("new.yaml")
    assert main(["calibrate", str(mast), "--refine-scene", str(frames), "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["pictures"] == 5
    assert told["median_px"]["after"] < 0.1 < told["median_px"]["before"]
    assert told["predicted_rms_px"]["after"] < told["predicted_rms_px"]["before"]
    rig = load_rig(out).rig
    assert rig.fit["refined_scene"]["corrected"] == told["corrected"]
    assert rig.provenance["refined"][0]["former_digest"] == load_rig(mast).digest
    assert yaml.safe_load(mast.read_text())["name"] == "opportunity"


def test_what_explains_some_pictures_but_predicts_no_others_is_refused(
    mast: Path, frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Joints that err by 1.3 mrad at each rest, as the flight project says, leave nothing common to tell."""
    out = mast.with_name("new.yaml")
    words = ["calibrate", str(mast), "--refine-scene", str(frames), "--out", str(out), "--json"]
    assert main([*words, "--joint-sigma-rad", "0.0013"]) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "not_predictive"
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "phrase"),
    [
        ("--refine-scene absent", "absent"),
        ("--refine-scene mast.yaml --report r", "belongs to a survey"),
        ("--refine-scene . --refine x.jsonl", "one of them is expected"),
        ("--camera eye", "belong to --refine-scene"),
    ],
)
def test_wrong_words_are_refused_in_one_sentence(
    words: str, phrase: str, mast: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(mast.parent)
    assert main(["calibrate", "mast.yaml", *words.split(), "--out", "new.yaml", "--json"]) == 2
    assert phrase in json.loads(capsys.readouterr().out)["error"]["message"]
    assert not Path("new.yaml").exists()
