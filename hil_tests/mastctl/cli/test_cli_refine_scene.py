"""``calibrate --refine-scene`` on real pictures: Opportunity's five Navcam frames and their labels' mast."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calib.files.mast_file import save_rig
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


STATED = pytest.mark.long(4, "the same with a stated scatter of the joints, a second fit of real pictures")


@pytest.mark.parametrize(
    "joint_sigma",
    [
        pytest.param([], id="default"),
        pytest.param(["--joint-sigma-rad", "0.0013"], marks=STATED, id="flight's"),
    ],
)
def test_what_explains_real_pictures_but_predicts_no_others_is_refused(
    joint_sigma: list[str], mast: Path, frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three pairs of pictures tell no correction from rests that err each by itself: 1.3 mrad, as flown."""
    out = mast.with_name("new.yaml")
    words = ["calibrate", str(mast), "--refine-scene", str(frames), "--out", str(out), "--json"]
    assert main([*words, *joint_sigma]) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "not_predictive"
    assert "rests of the head err each by itself" in error["message"]
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
