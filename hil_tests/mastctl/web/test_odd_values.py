"""What comes from outside (numbers, files, names) is refused or passed over, and never a defect."""

from __future__ import annotations

import os
from pathlib import Path

import httpx
import pytest

LARGE = {"of 400 digits": "4" * 400, "of 5000 digits": "3" * 5000}


def refusal(answer: httpx.Response) -> str:
    assert 400 <= answer.status_code < 500, answer.text
    return str(answer.json()["error"]["code"])


BODIES = {
    "/point": '{"pan_rad": NUMBER, "tilt_rad": 0}',
    "/jog": '{"pan_rad_per_s": 0, "tilt_rad_per_s": 0, "sequence": NUMBER}',
    "/lease": '{"for_s": NUMBER}',
    "/bench": '{"board": "charuco_a2", "pictures": NUMBER}',
    "/simulation/boards/x": '{"position_m": [2, 0, -1], "board": {"kind": "charuco", "square_m": NUMBER}}',
}


@pytest.mark.parametrize("number", LARGE.values(), ids=LARGE)
@pytest.mark.parametrize("path", BODIES)
def test_an_integer_beyond_every_float_is_refused(web: httpx.Client, path: str, number: str) -> None:
    body = BODIES[path].replace("NUMBER", number)
    answer = web.post(path, content=body, headers={"Content-Type": "application/json"})
    assert refusal(answer) in ("bad_request", "not_json", "not_simulated")


def test_only_plain_files_are_recordings(web: httpx.Client) -> None:
    runs = Path(web.get("/recordings").json()["recorder"]["folder"]) / "runs"
    runs.mkdir(parents=True, exist_ok=True)
    (runs / "folder.mcap").mkdir()
    os.mkfifo(runs / "pipe.mcap")
    (runs / "file.mcap").write_bytes(b"x")
    listed = web.get("/recordings").json()["recordings"]
    assert [one["name"] for one in listed if one["kind"] == "run"] == ["file"]
    for name in ("folder", "pipe"):
        assert refusal(web.get(f"/recordings/{name}/{name}.mcap")) == "recording_unknown"
        assert refusal(web.delete(f"/recordings/{name}")) == "recording_unknown"
