"""The HTTP interface from outside: meanings of the contract, and one form for every refusal."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from hil_tests.mastctl.service_fakes import PLAIN, FakeHardware, ScriptedLoop
from hil_tests.waiting import NET_S, until
from mastctl.daemon import RunningDaemon
from mastctl.http.guard import LARGEST_BODY_BYTES
from mastctl.service import service as service_module
from mastctl.service import steering as steering_module

ANGLES = {"pan_rad": 0.1, "tilt_rad": -0.1}


def refused(answer: httpx.Response, status: int, code: str) -> str:
    """Check the one form of a refusal and return its sentence."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/json"
    error = answer.json()["error"]
    assert set(error) == {"code", "message", "detail"}
    assert error["code"] == code
    assert "\n" not in error["message"]
    assert "Traceback" not in answer.text
    return str(error["message"])


def ended(web: httpx.Client, operation: str) -> dict[str, Any]:
    """An operation's record after its end."""
    until(lambda: web.get(f"/operations/{operation}").json()["state"] not in ("queued", "running"), "the end")
    return dict(web.get(f"/operations/{operation}").json())


# Status


def test_status_tells_what_the_contract_asks(
    web: httpx.Client, daemon: RunningDaemon, hardware: FakeHardware
) -> None:
    hardware.head.pan_rad = 0.5
    until(lambda: daemon.service.devices.read().pan_rad == 0.5, "a reading")
    web.get("/snapshot/navcam_left")
    status = web.get("/status").json()
    assert status["state"] == "ready"
    assert (status["simulated"], status["hardware"]) == (False, "real")
    assert status["joints"]["pan_rad"] == 0.5
    assert 0.0 <= status["joints"]["age_s"] <= status["uptime_s"]
    assert status["moving"] is False
    limits = {"pan_rad": [-2.0, 2.0], "tilt_rad": [-1.0, 1.0], "speed_rad_per_s": 0.5}
    assert {key: status["limits"][key] for key in limits} == limits
    assert status["limits"]["keep_out"] == [] and status["limits"]["acceleration_rad_per_s2"] is None
    assert status["target"] is None
    assert status["last_residual"] is None
    assert status["control"] is None
    assert set(status["cameras"]) == {"navcam_left", "navcam_right", "hazcam_left"}
    assert status["cameras"]["navcam_left"]["age_s"] >= 0.0
    assert status["cameras"]["navcam_right"]["age_s"] is None
    assert status["mast"] == {"file": "little.yaml", "name": "little", "digest": daemon.service.stored.digest}
    assert status["faults"] == []
    assert status["version"]
    assert 0.0 < status["uptime_s"] < NET_S


# Point


def test_a_pointing_is_accepted_and_records_steps_and_residual(
    web: httpx.Client, hardware: FakeHardware
) -> None:
    answer = web.post("/point", json={"position_m": [6, 0.0, 0.1]})
    assert answer.status_code == 202
    record = ended(web, answer.json()["id"])
    assert record["state"] == "done"
    assert record["request"] == {"position_m": [6.0, 0.0, 0.1], "pointings": 1}
    assert [step["name"] for step in record["steps"]] == ["look", "measure"]
    assert record["steps"][1]["detail"] == {"not_a_number": None}
    assert record["residual_px"] == [0.25, -0.5]
    assert record["residual_sigma_px"] == [0.1, 0.2]
    assert record["position_m"] == [6.0, 0.0, 0.1]
    assert record["error"] is None
    status = web.get("/status").json()
    assert status["last_residual"]["residual_px"] == [0.25, -0.5]
    assert status["last_residual"]["operation"] == record["id"]
    assert status["target"] == record["request"]
    listed = web.get("/operations").json()["operations"]
    assert [entry["id"] for entry in listed] == [record["id"]]
    assert ("move", 0.1, -0.1, 0.5) in hardware.head.calls


P = {"camera": "navcam_left", "frame_id": "f", "x_px": 1.0, "y_px": 2.0}
BAD_POINTS: list[tuple[Any, str]] = [
    ({}, "0 targets where exactly one of pixel, panorama, position_m, pan_rad with tilt_rad is expected"),
    ({"pixle": P}, "pixle: unknown key; the nearest known is 'pixel'"),
    ({"pixel": {"camera": "navcam_left", "x_px": 1, "y_px": 2}}, "pixel.frame_id: the key is missing"),
    ({"pixel": {**P, "x_px": "12"}}, "pixel.x_px: the text '12' where a number is expected"),
    ({"position_m": [1, 2]}, "position_m: a list of 2 where a list of 3 numbers is expected"),
    ({**ANGLES, "frame": "rover"}, "frame goes with position_m only"),
    ({**ANGLES, "aim": {"camera": "navcam_left", "x_px": 1, "y_px": 1}}, "aim goes with pixel or position_m"),
    ({**ANGLES, "pointings": 2}, "pointings is 2, which goes with a pixel only"),
    ([], "the body: a list of 0 where a mapping with deadline_s, "),
    (None, "the request has no body where a JSON object is expected"),
]


@pytest.fixture
def quiet(standing: tuple[RunningDaemon, FakeHardware]) -> Iterator[httpx.Client]:
    """A client of the standing daemon; afterwards nothing may have happened there."""
    with httpx.Client(base_url=f"{standing[0].url}/api/v1", **PLAIN) as client:
        yield client
        assert client.get("/operations").json() == {"operations": []}
    assert [call for call in standing[1].head.calls if call[0] == "move"] == []


@pytest.mark.parametrize(("body", "words"), BAD_POINTS, ids=[str(b[0])[:40] for b in BAD_POINTS])
def test_a_bad_request_is_told_with_place_value_and_what_is_expected(
    quiet: httpx.Client, body: Any, words: str
) -> None:
    answer = quiet.post("/point", content=json.dumps(body), headers={"content-type": "application/json"})
    assert words in refused(answer, 422, "bad_request")


RAW_BODIES: list[tuple[bytes, str, int, str]] = [
    (b"{", "application/json", 400, "not_json"),
    (b'{"pan_rad": NaN, "tilt_rad": 0}', "application/json", 422, "bad_request"),
    (b"[" * 30000, "application/json", 400, "not_json"),
    (b'{"pan_rad": 0, "tilt_rad": 0}', "text/plain", 415, "not_json"),
    (b'{"pan_rad": 0, "tilt_rad": 0}', "", 415, "not_json"),
    (b" " * (LARGEST_BODY_BYTES + 1), "application/json", 413, "too_large"),
]


@pytest.mark.parametrize(
    ("body", "kind", "status", "code"), RAW_BODIES, ids=[f"{b[0][:24]!r} {b[1]}" for b in RAW_BODIES]
)
def test_what_is_no_good_json_does_not_get_far(
    quiet: httpx.Client, body: bytes, kind: str, status: int, code: str
) -> None:
    refused(quiet.post("/point", content=body, headers={"content-type": kind}), status, code)


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/api/v1/nothing", 404, "not_found"),
        ("PUT", "/api/v1/session", 405, "method_not_allowed"),
        ("GET", "/api/v1/operations/000001-ffff", 404, "operation_unknown"),
        ("GET", "/api/v1/snapshot/navcam_center", 404, "unknown_camera"),
        ("GET", "/api/v1/snapshot/navcam_left?format=gif", 422, "bad_request"),
        ("GET", "/api/v1/snapshot/navcam_left?frehs=true", 422, "bad_request"),
        ("GET", "/api/v1/snapshot/navcam_left?frame_id=navcam_left-000009-x-y", 404, "frame_unknown"),
        ("GET", "/api/v1/simulation/faults", 404, "not_simulated"),
    ],
)
def test_other_refusals_have_the_one_form(
    quiet: httpx.Client, method: str, path: str, status: int, code: str
) -> None:
    answer = quiet.request(method, f"{quiet.base_url.copy_with(path='')}{path}")
    refused(answer, status, code)
    assert answer.headers.get("Allow", "DELETE, GET, POST") == "DELETE, GET, POST"


def test_angles_beyond_the_limits_are_refused_at_once(quiet: httpx.Client) -> None:
    message = refused(quiet.post("/point", json={"pan_rad": 0.0, "tilt_rad": 1.5}), 422, "outside_limits")
    assert message == "tilt 1.5 rad is beyond the soft limit 1 rad"


def test_a_click_is_refused_by_name_if_its_frame_does_not_serve(
    web: httpx.Client, daemon: RunningDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame_id = web.get("/snapshot/navcam_left").headers["Mastctl-Frame-Id"]
    camera, sequence, mast, run = frame_id.rsplit("-", 3)
    good = {"camera": "navcam_left", "frame_id": frame_id, "x_px": 10.0, "y_px": 10.0}

    def click(**changes: Any) -> httpx.Response:
        return web.post("/point", json={"pixel": {**good, **changes}})

    refused(click(frame_id=f"{camera}-{sequence}-ffffffff-{run}"), 409, "other_mast_file")
    refused(click(mast_digest="f" * 64), 409, "other_mast_file")
    refused(click(frame_id=f"{camera}-{sequence}-{mast}-{int(run, 16) ^ 1:04x}"), 404, "frame_unknown")
    refused(click(camera="navcam_right"), 422, "wrong_camera")
    refused(click(x_px=63.6), 422, "outside_image")
    refused(click(y_px=-0.6), 422, "outside_image")
    with monkeypatch.context() as patch:
        patch.setattr(steering_module, "CLICK_AGE_S", 0.0)
        refused(click(), 410, "frame_too_old")
    assert click(x_px=63.5, mast_digest=daemon.service.stored.digest).status_code == 202


def test_a_click_on_a_frame_taken_in_motion_is_refused(web: httpx.Client, hardware: FakeHardware) -> None:
    hardware.head.moving = True
    until(lambda: web.get("/status").json()["moving"], "motion")
    assert web.get("/status").json()["state"] == "moving"
    shot = web.get("/snapshot/navcam_left?fresh=true")
    assert shot.headers["Mastctl-Moving"] == "true"
    pixel = {"camera": "navcam_left", "frame_id": shot.headers["Mastctl-Frame-Id"], "x_px": 1, "y_px": 1}
    refused(web.post("/point", json={"pixel": pixel}), 409, "frame_moving")


# Stop


def test_stop_ends_the_operation_and_lets_no_later_move_out(
    web: httpx.Client, hardware: FakeHardware, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered = threading.Event()

    def stubborn(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> None:
        devices.move(0.1, 0.1)
        entered.set()
        assert cancelled.wait(NET_S)
        devices.move(0.2, 0.2)  # a loop that looked before the stop came, and moves after it

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(stubborn))
    operation = web.post("/point", json=ANGLES).json()["id"]
    assert entered.wait(NET_S)
    answer = web.post("/stop")
    assert answer.status_code == 200
    assert answer.json() == {"stopped": True, "operation": operation}
    record = ended(web, operation)
    assert record["state"] == "stopped"
    assert record["error"]["code"] == "stopped"
    assert [call[:3] for call in hardware.head.calls if call[0] == "move"] == [("move", 0.1, 0.1)]
    assert hardware.head.calls[-1] == ("stop",)
    assert web.get("/status").json()["state"] == "holding"
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(ScriptedLoop.good))
    assert ended(web, web.post("/point", json=ANGLES).json()["id"])["state"] == "done"


# Pictures


def test_a_snapshot_is_the_picture_with_its_facts(web: httpx.Client, daemon: RunningDaemon) -> None:
    shot = web.get("/snapshot/navcam_left")
    assert shot.headers["content-type"] == "image/png"
    frame_id = shot.headers["Mastctl-Frame-Id"]
    kept = daemon.service.devices.store.by_id(frame_id)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(shot.content, np.uint8), -1), kept.image)
    assert shot.headers["Mastctl-Camera"] == "navcam_left"
    assert int(shot.headers["Mastctl-Sequence"]) == kept.sequence
    assert float(shot.headers["Mastctl-Mid-Exposure-S"]) == kept.mid_exposure_s
    assert float(shot.headers["Mastctl-Exposure-S"]) == kept.exposure_s
    assert float(shot.headers["Mastctl-Pan-Rad"]) == kept.pan_rad
    assert float(shot.headers["Mastctl-Tilt-Rad"]) == kept.tilt_rad
    assert shot.headers["Mastctl-Moving"] == "false"
    assert shot.headers["Mastctl-Mast-Digest"] == daemon.service.stored.digest
    assert shot.headers["cache-control"] == "no-store"
    again = web.get(f"/snapshot/navcam_left?frame_id={frame_id}&format=jpeg")
    assert again.headers["Mastctl-Frame-Id"] == frame_id
    assert again.headers["content-type"] == "image/jpeg"
    assert again.content[:3] == b"\xff\xd8\xff"


def test_a_fresh_snapshot_is_exposed_after_the_request(
    web: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_module, "SNAPSHOT_AGE_S", NET_S)
    first, second = (web.get("/snapshot/navcam_left").headers["Mastctl-Frame-Id"] for _ in range(2))
    assert first == second
    now_s = web.get("/status").json()["now_s"]
    shot = web.get("/snapshot/navcam_left?fresh=true")
    began_s = float(shot.headers["Mastctl-Mid-Exposure-S"]) - float(shot.headers["Mastctl-Exposure-S"]) / 2
    assert shot.headers["Mastctl-Frame-Id"] != first
    assert began_s > now_s


def test_the_mast_file_is_served_byte_for_byte(web: httpx.Client, daemon: RunningDaemon) -> None:
    answer = web.get("/mast")
    assert answer.content == daemon.service.config.mast_file.read_bytes()
    assert answer.headers["Mastctl-Mast-Digest"] == daemon.service.stored.digest


# Limits


def test_the_sun_is_told_kept_out_and_forgotten(web: httpx.Client) -> None:
    assert web.get("/limits/sun").json() == {"sun": None, "boxes": []}
    body = {"azimuth_rad": 0.1, "elevation_rad": -0.1, "half_angle_rad": 0.2, "valid_s": 3600.0}
    answer = web.post("/limits/sun", json=body).json()
    told, boxes = answer["sun"], answer["boxes"]
    assert any(low <= 0.1 <= high for low, high in (box["pan_rad"] for box in boxes))
    assert told["active"] and told["frame"] == "site" and 3600.0 - NET_S < told["left_s"] <= 3600.0
    assert "keep-out sun" in refused(web.post("/point", json=ANGLES), 422, "keep_out")
    behind = {"azimuth_rad": np.pi, "elevation_rad": 0.0, "frame": "rover", "half_angle_rad": 0.2}
    assert web.post("/limits/sun", json=behind).json()["sun"]["direction"] == pytest.approx([-1, 0, 0])
    ended(web, web.post("/point", json=ANGLES).json()["id"])
    assert web.delete("/limits/sun").json() == {"sun": None, "boxes": []}


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"half_angle_rad": 0.2}, "azimuth_rad: the key is missing"),
        ({"azimuth_rad": 0.1, "elevation_rad": 1.6, "half_angle_rad": 0.2}, "elevation_rad"),
    ],
)
def test_a_sun_that_is_none_is_refused(web: httpx.Client, body: dict[str, Any], words: str) -> None:
    assert words in refused(web.post("/limits/sun", json=body), 422, "bad_request")
