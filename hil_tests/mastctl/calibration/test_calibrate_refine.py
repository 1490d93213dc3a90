"""``mastctl calibrate --refine``: a new mast file or a refusal, never a silent change."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files import digest_of
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.covariance import stored_covariance
from calib.geometry.parameters import parameter_names
from calib.geometry.rig import Rig
from calib.matching.handoff import MatchedHandoff
from hil_tests.calib.matching.handed_over import (
    HAZCAMS,
    hand_offs,
    moved_hazcams,
    plain_rig,
    targets,
    vectors,
)
from mastctl.cli.main import main
from mastctl.drift.handoffs import handoff_log, line_of

TURN_RAD = (0.0, 0.004, 0.003)
SHIFT_M = (0.002, 0.0, -0.002)


@pytest.fixture
def mast(repository: Path, tmp_path: Path) -> Path:
    """A mast file with a covariance."""
    rig = plain_rig(load_rig(repository / "configs/sim/rocky8.yaml").rig)
    names = [f"mast.{key}.{axis}" for key in ("translation_m", "rotation_rad") for axis in "xyz"]
    for name, camera in rig.cameras.items():
        names += [f"cameras.{name}.{part}" for part in parameter_names(camera.model.kind)]
    sigma = np.array([0.5 if n.split(".")[-2] in "HV" else 2e-3 if ".R." not in n else 1e-4 for n in names])
    fit = {
        "parameters": names,
        "covariance": np.diag(sigma**2).tolist(),
        "rms_px": {"hazcam_left": [0.1, 0.1]},
    }
    path = tmp_path / "mast.yaml"
    save_rig(replace(rig, fit=fit, provenance={"survey": "s"}), path)
    return path


def record(
    mast: Path, path: Path, moved: bool = True, count: int = 24, seed: int = 1
) -> list[MatchedHandoff]:
    """A record of hand-offs that the mast file hands over while its Hazcams truly stand elsewhere."""
    stored = load_rig(mast)
    rng = np.random.default_rng(seed)
    true = (
        moved_hazcams(stored.rig, Rotation.from_rotvec(TURN_RAD), SHIFT_M)
        if moved
        else {name: vectors(stored.rig, name) for name in HAZCAMS}
    )
    made = hand_offs(true, stored.rig, targets(rng, count), rng, digest=stored.digest)
    made = [replace(one, time=f"2026-01-01T00:00:{i:02d}Z") for i, one in enumerate(made)]
    for one in made:
        handoff_log(path).append(line_of(one))
    return made


def refine(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict[str, Any]]:
    capsys.readouterr()
    code = main(["calibrate", *map(str, words), "--json"])
    answer = capsys.readouterr()
    assert "Traceback" not in answer.out + answer.err
    document: dict[str, Any] = json.loads(answer.out, parse_constant=lambda word: pytest.fail(word))
    return code, document


def corrected(rig: Rig, name: str) -> np.ndarray:
    return np.array([getattr(rig.cameras[name].model, letter) for letter in "CAHVO"])


def test_a_significant_offset_gives_a_mast_file_that_says_its_origin(
    mast: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = tmp_path / "h.jsonl", tmp_path / "new.yaml"
    record(mast, log)
    before = mast.read_bytes()
    code, answer = refine(capsys, mast, "--refine", log, "--out", out)
    assert code == 0 and mast.read_bytes() == before
    said = answer["corrections"]["hazcam"]
    assert said["significant"] and said["significance_sigmas"] > 10 and said["handoffs"] == 24
    off = np.array(said["shift_m"] + said["turn_rad"]) - [*SHIFT_M, *TURN_RAD]
    assert off @ np.linalg.solve(np.array(said["covariance"]), off) < 22.5
    for rms in said["rms_px"].values():
        assert np.hypot(*rms["before"]) > 1.2 > 0.9 > np.hypot(*rms["after"])

    old, new = load_rig(mast), load_rig(out)
    assert answer["mast_file"] == {"path": str(out), "digest": new.digest, "previous": None}
    for name in old.rig.cameras:
        same = (corrected(old.rig, name) == corrected(new.rig, name)).all()
        assert same == (name not in HAZCAMS)
    step = new.rig.provenance["refined"][0]
    assert step["former_digest"] == digest_of(before) and step["records"][0]["digest"] == digest_of(
        log.read_bytes()
    )
    assert new.rig.provenance["survey"] == "s" and new.rig.fit["rms_px"] == old.rig.fit["rms_px"]
    known, was = stored_covariance(new.rig), stored_covariance(old.rig)
    assert known is not None and was is not None and known.names == was.names
    assert np.linalg.eigvalsh(known.covariance)[0] > -1e-12
    at = known.names.index("cameras.hazcam_left.C.z")
    tie = known.names.index("mast.translation_m.z")
    assert (
        was.covariance[at, tie] == 0.0 and known.covariance[at, tie] > 1e-7
    )  # the Hazcam now hangs on the mast
    head = known.names.index("cameras.navcam_left.C.z")
    assert known.covariance[head, head] == pytest.approx(was.covariance[head, head], rel=1e-6)
    assert new.rig.fit["sigma"]["cameras"]["hazcam_left"]["C"][2] == pytest.approx(
        known.covariance[at, at] ** 0.5
    )

    # The same record says nothing of the new file: it was made with the old one.
    code, answer = refine(capsys, out, "--refine", log, "--out", tmp_path / "again.yaml")
    assert (
        code == 1
        and answer["error"]["code"] == "too_few"
        and "another mast file" in answer["error"]["message"]
    )


def test_without_an_offset_nothing_is_written_and_the_exit_code_is_one(
    mast: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = tmp_path / "h.jsonl", tmp_path / "new.yaml"
    record(mast, log, moved=False)
    code, answer = refine(capsys, mast, "--refine", log, "--out", out)
    assert code == 1 and not out.exists()
    assert (
        answer["error"]["code"] == "not_significant" and "nothing was written" in answer["error"]["message"]
    )
    assert answer["error"]["detail"]["corrections"]["hazcam"]["significance_sigmas"] < 3


@pytest.mark.parametrize("which", ["mast", "record"])
def test_what_is_read_is_never_overwritten(
    mast: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], which: str
) -> None:
    log = tmp_path / "h.jsonl"
    record(mast, log)
    out = {"mast": mast, "record": log}[which]
    before = out.read_bytes()
    code, answer = refine(capsys, mast, "--refine", log, "--out", out)
    assert code == 2 and answer["error"]["code"] == "wrong_use" and out.read_bytes() == before


def test_bad_use_and_bad_files_end_with_two(
    mast: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = tmp_path / "h.jsonl", tmp_path / "new.yaml"
    record(mast, log, count=8)
    for words in (
        (mast, "--refine", log, "--out", out, "--method", "paper"),
        (mast, "--refine", tmp_path / "none.jsonl", "--out", out),
        (mast, "--refine", mast, "--out", out),
        (tmp_path, "--refine", log, "--out", out),
        (mast, "--refine", log, "--out", tmp_path / "no" / "new.yaml"),
    ):
        code, answer = refine(capsys, *words)
        assert code == 2 and answer["error"]["message"], words
    assert not out.exists()
