"""Hand-offs of a recording, predicted again: a simulated rover whose mast file is wrong hands over, and the
right file must say where the picture showed the target.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Rig
from hil_tests.mastctl.motion.test_tracking_simulated import ROVER, STEP_M, Drive, begun, cropped
from hil_tests.mastctl.recorder.test_what_if import wrong_mast
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.drift.handoffs import read_log

FELT_PX = 1.2
RIGHT_PX = 0.6
"""What a hand-off may be off with a mast file that is true: the match, and the range from the other pair."""


def approach(folder: Path) -> Path:
    """Track a target with the wrong mast file until it is handed over; return the recording."""
    with RunningDaemon(load_config(folder / "rover.yaml")) as daemon, Client(daemon.url) as client:
        client.start_recording("approach")
        drive = Drive(client)
        begun(client, daemon)
        log = folder / "handed.jsonl"
        for step in range(1, 5):
            drive.to(STEP_M * step, 0.04 * step, 0.05 * step)
        until(lambda: log.exists() and len(read_log(log).handoffs) == 1, "it was handed over")
        return Path(client.stop_recording()["file"])


@pytest.fixture(scope="module")
def files(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("handed")
    whole = load_rig(repository / "configs/sim/rocky8.yaml").rig
    cameras = {name: cropped(whole.cameras[name]) for name in whole.stereo["navcam"]}
    cameras |= {name: whole.cameras[name] for name in whole.stereo["hazcam"]}
    right = Rig("small", whole.mast, cameras, {pair: whole.stereo[pair] for pair in ("navcam", "hazcam")})
    save_rig(right, folder / "rig.yaml")
    save_rig(wrong_mast(right), folder / "wrong.yaml")
    record = f"record: {{folder: {folder / 'records'}, free_mb: 10}}\n"
    (folder / "rover.yaml").write_text(ROVER.replace("mast_file: rig.yaml", "mast_file: wrong.yaml") + record)
    return {"right": folder / "rig.yaml", "wrong": folder / "wrong.yaml", "run": approach(folder)}


def handed(files: dict[str, Path], mast: str, capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    assert main(["record", "replay", str(files["run"]), "--mast", str(files[mast]), "--json"]) == 0
    rows: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["handoffs"]
    assert {one["camera"] for one in rows} == {"hazcam_left", "hazcam_right"}
    return rows


@pytest.mark.long(
    4, "hand-offs are recorded on a rendered rover; the pointings of a recording are in the quick run"
)
def test_the_right_mast_file_hands_over_to_where_the_target_was_seen(
    files: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    rows = handed(files, "right", capsys)
    for one in rows:
        before, after = np.array(one["recorded_px"]), np.array(one["would_be_px"])
        assert np.hypot(*before) > FELT_PX, "the wrong file is felt"
        assert np.abs(after).max() < RIGHT_PX
        assert (np.abs(after) < 3.5 * np.array(one["sigma_px"])).all(), one
