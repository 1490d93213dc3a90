"""The commands of the service: documents for programs, lines for people, the contract's exit codes."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.errors import NoReply
from hil_tests.mastctl.cli.conftest import Run
from hil_tests.mastctl.service_fakes import FakeHardware, ScriptedLoop
from hil_tests.waiting import NET_S
from mastctl.cli.main import main
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]


def document(result: tuple[int, str, str], code: int = 0) -> dict[str, Any]:
    """The one JSON document on stdout."""
    assert result[0] == code, result
    found = json.loads(result[1])
    assert isinstance(found, dict)
    return found


def error_of(result: tuple[int, str, str], code: int) -> dict[str, Any]:
    """The refusal on stdout."""
    error = document(result, code)["error"]
    assert "\n" not in error["message"]
    return dict(error)


def test_status_for_programs_and_for_people(run: Run, pair: BOTH) -> None:
    pair[0].service.devices.read()
    assert document(run("status", "--json"))["mast"]["name"] == "little"
    code, out, _ = run("status")
    assert code == 0
    for words in ("ready", "real", "limits.pan rad", "-2, 2", "little.yaml"):
        assert words in out


def test_status_waits_for_a_daemon_that_carries_out_commands(run: Run, pair: BOTH) -> None:
    assert document(run("status", "--wait", "60", "--json"))["state"] == "ready"
    assert run("estop", "--name", "Ana", "--reason", "sparks")[0] == 0
    code, _, told = run("status", "--wait", "60")
    assert code == 1 and "not ready after" not in told, "it does not wait for what no waiting ends"
    assert "the daemon is stopped" in told and "sparks" in told and "mastctl reset" in told


def test_status_waits_for_a_daemon_that_is_not_there_yet(capsys: pytest.CaptureFixture[str]) -> None:
    nobody = ["--url", "http://127.0.0.1:1", "--json"]
    assert main(["status", "--wait", "0.2", *nobody]) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "not_ready" and "no daemon answers" in error["message"]
    assert main(["status", "--wait", "9", "--url", "mars"]) == 2, "what no waiting mends is told at once"


def test_point_in_each_of_its_forms(
    run: Run, pair: BOTH, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shot = document(run("snapshot", "navcam_left", "--out", str(tmp_path / "a.png"), "--json"))
    frame_id = shot["frame_id"]
    forms = {
        "pixel": (
            *("--pixel", "navcam_left", frame_id, "3.5", "4"),
            *("--aim", "navcam_right", "1", "2", "--pointings", "2"),
        ),
        "fresh": ("--camera", "navcam_left", "--at", "5", "6"),
        "position": ("--position", "6", "-1e-1", "0.1", "--frame", "site"),
        "angles": ("--angles", "0.5", "-0.25"),
    }
    records = {name: document(run("point", *words, "--json")) for name, words in forms.items()}
    assert {record["state"] for record in records.values()} == {"done"}
    requests = {name: record["request"] for name, record in records.items()}
    assert requests["pixel"] == {
        "pixel": {"camera": "navcam_left", "frame_id": frame_id, "x_px": 3.5, "y_px": 4.0},
        "aim": {"camera": "navcam_right", "x_px": 1.0, "y_px": 2.0},
        "pointings": 2,
    }
    fresh = requests["fresh"]["pixel"]
    assert (fresh["x_px"], fresh["y_px"]) == (5.0, 6.0)
    assert fresh["frame_id"] != frame_id
    assert requests["position"] == {"position_m": [6.0, -0.1, 0.1], "frame": "site", "pointings": 1}
    assert requests["angles"] == {"pan_rad": 0.5, "tilt_rad": -0.25, "pointings": 1}


def test_a_failed_operation_ends_with_1_and_its_reason(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*ignored: Any) -> None:
        raise NoReply("the head does not answer", device="pan_tilt")

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(fail))
    error = error_of(run("point", "--angles", "0.1", "0.1", "--json"), 1)
    assert (error["code"], error["message"]) == ("no_reply", "pan_tilt: the head does not answer")
    assert error["detail"]["operation"]["state"] == "failed"
    code, out, log = run("point", "--angles", "0.1", "0.1")
    assert (code, out) == (1, "")
    assert log.splitlines()[-1] == "mastctl: pan_tilt: the head does not answer"


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("point", "--angles", "0", "1.5"), "outside_limits"),
        (("point", "--angles", "0", "nan"), "wrong_use"),
        (("point", "--pixel", "navcam_left", "f", "1", "2"), "frame_unknown"),
        (("snapshot", "navcam_left", "--out", "no/such/folder/x.png"), "wrong_use"),
    ],
)
def test_wrong_use_and_bad_input_end_with_2(
    run: Run, pair: BOTH, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: tuple[str, ...], code: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert error_of(run(*words, "--json"), 2)["code"] == code
    exit_code, out, log = run(*words)
    assert (exit_code, out) == (2, "")
    assert log.startswith("mastctl: ")
    assert log.count("\n") == 1
    assert [call for call in pair[1].head.calls if call[0] == "move"] == []


def test_stop_tells_what_it_stopped(run: Run, pair: BOTH) -> None:
    told = document(run("stop", "--json"))
    reached = told.pop("reached")
    assert told == {"stopped": True, "operation": None}
    assert run("stop")[:2] == (0, f"stopped at {reached}")
    assert pair[1].head.calls == [("stop",), ("stop",)]


def test_a_snapshot_becomes_a_file(run: Run, pair: BOTH, tmp_path: Path) -> None:
    out = tmp_path / "left.png"
    shot = document(run("snapshot", "navcam_left", "--out", str(out), "--json"))
    kept = pair[0].service.devices.store.by_id(shot["frame_id"])
    np.testing.assert_array_equal(cv2.imread(str(out), cv2.IMREAD_UNCHANGED), kept.image)
    assert shot["mast_digest"] == pair[0].service.stored.digest
    assert shot["size_px"] == [64, 48]
    jpeg = tmp_path / "left.jpg"
    assert run("snapshot", "navcam_left", "--out", str(jpeg), "--frame-id", shot["frame_id"])[0] == 0
    assert jpeg.read_bytes()[:3] == b"\xff\xd8\xff"


@pytest.mark.parametrize("word", ["stop", "estop"])
def test_a_stop_without_a_daemon_says_what_else_stops_a_head(
    word: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    url = f"unix:{tmp_path}/none.sock"
    assert main([word, "--url", url]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"mastctl: no daemon answers at {url}; if the head moves")
    assert "mastctl stop --without-daemon" in said
    assert "starts one" not in said


def test_a_stop_that_a_hung_daemon_takes_says_what_else_stops_a_head(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mastctl.client.client.STOP_ANSWER_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as hung:
        assert main(["stop", "--url", f"http://127.0.0.1:{hung.getsockname()[1]}"]) == 1
    said = capsys.readouterr().err
    assert "did not answer" in said and "kill -9" in said and "mastctl stop --without-daemon" in said


def test_the_address_comes_from_the_configuration(
    pair: BOTH, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    config = tmp_path / "daemon.yaml"
    port = pair[0].url.rpartition(":")[2]
    assert main(["status", "--json", "--config", str(config)]) == 2  # port 0: nobody knows which it became
    assert "give --url" in capsys.readouterr().out
    config.write_text(config.read_text().replace("port: 0", f"port: {port}"))
    assert main(["status", "--json", "--config", str(config)]) == 0
    config.write_text(config.read_text().replace("limits", "limit"))
    capsys.readouterr()
    assert main(["status", "--config", str(config)]) == 2
    assert capsys.readouterr().err.startswith(
        f"mastctl: {config}: limit: unknown key; the nearest known is 'limits'"
    )


ENCODES = """
import atexit, threading, time
import cv2, numpy as np
from mastctl.cli import main as cli

picture = np.random.default_rng(1).integers(0, 255, (2000, 3000), np.uint8)

def encodes():
    while True:
        cv2.imencode(".png", picture)

def command(words):
    for _ in range(2):
        threading.Thread(target=encodes, daemon=True).start()
    time.sleep(0.3)
    atexit.register(print, "and tidied", flush=True)
    print("ended")
    return 3

cli._run = command
cli.process()
"""


def test_a_process_ends_with_its_code_while_opencv_is_at_work() -> None:
    """A daemon thread that came back from C++ into an interpreter at its end made it abort (SIGABRT)."""
    done = subprocess.run([sys.executable, "-c", ENCODES], capture_output=True, text=True, timeout=NET_S)
    assert (done.returncode, done.stdout, done.stderr) == (3, "ended\nand tidied\n", "")
