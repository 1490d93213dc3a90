"""The HTTP interface from outside: meanings of the contract, and one form for every refusal."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import cv2
import httpx
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.errors import NoReply
from drivers.faults import FaultPanel
from hil_tests.mastctl.service_fakes import CONFIG, HTTP, PLAIN, FakeHardware, Hang, ScriptedLoop, fake_daemon
from hil_tests.waiting import NET_S, joined, until
from mastctl.daemon import RunningDaemon
from mastctl.devices import devices as devices_module
from mastctl.http.guard import LARGEST_BODY_BYTES
from mastctl.service import service as service_module
from mastctl.service import steering as steering_module
from mastctl.web import described as described_module

ANGLES = {"pan_rad": 0.1, "tilt_rad": -0.1}


@pytest.fixture
def daemon(pair: tuple[RunningDaemon, FakeHardware]) -> RunningDaemon:
    return pair[0]


@pytest.fixture
def hardware(pair: tuple[RunningDaemon, FakeHardware]) -> FakeHardware:
    return pair[1]


@pytest.fixture
def web(daemon: RunningDaemon) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as client:
        yield client


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


def test_the_time_of_real_hardware_is_this_machines(web: httpx.Client) -> None:
    for _ in range(3):
        before_s = time.monotonic()
        told_s = web.get("/status").json()["now_s"]
        assert before_s - 1e-3 <= told_s <= time.monotonic() + 1e-3  # it is rounded


def test_a_head_that_fails_shows_as_fault_in_plain_words(web: httpx.Client, hardware: FakeHardware) -> None:
    def fail(name: str) -> None:
        raise NoReply("no answer on the bus", device="pan_tilt")

    hardware.head.hook = fail
    until(lambda: web.get("/status").json()["state"] == "fault", "the fault")
    fault = web.get("/status").json()["faults"][0]
    assert (fault["device"], fault["code"]) == ("pan_tilt", "no_reply")
    assert fault["message"] == "pan_tilt: no answer on the bus"
    hardware.head.hook = lambda name: None
    until(lambda: web.get("/status").json()["state"] == "holding", "recovery")


# Point


def test_a_pointing_operation_is_accepted_and_its_record_tells_steps_and_residual(
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
    assert record["residual_sigma_px"] == [0.05, 0.06]
    assert record["position_m"] == [6.0, 0.0, 0.1]
    assert record["error"] is None
    status = web.get("/status").json()
    assert status["last_residual"]["residual_px"] == [0.25, -0.5]
    assert status["last_residual"]["operation"] == record["id"]
    assert status["target"] == record["request"]
    listed = web.get("/operations").json()["operations"]
    assert [entry["id"] for entry in listed] == [record["id"]]
    assert ("move", 0.1, -0.1, 0.5) in hardware.head.calls


def test_the_request_reaches_the_loop_as_it_was_made(
    web: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests: list[Any] = []
    monkeypatch.setattr(
        ScriptedLoop, "script", staticmethod(lambda request, *others: requests.append(request))
    )
    frame_id = web.get("/snapshot/navcam_left").headers["X-Mastctl-Frame-Id"]
    pixel = {"camera": "navcam_left", "frame_id": frame_id, "x_px": 12.5, "y_px": 7}
    aim = {"camera": "navcam_right", "x_px": 1.0, "y_px": 2.0}
    for body in (
        {"pixel": pixel, "aim": aim, "pointings": 2},
        {"position_m": [1, 2, 3], "frame": "site"},
        dict(ANGLES),
    ):
        ended(web, web.post("/point", json=body).json()["id"])
    clicked, placed, turned = requests
    assert (clicked.target.camera, clicked.target.frame_id) == ("navcam_left", frame_id)
    assert (clicked.target.x_px, clicked.target.y_px, clicked.pointings) == (12.5, 7.0, 2)
    assert (clicked.aim.camera, clicked.aim.x_px, clicked.aim.y_px) == ("navcam_right", 1.0, 2.0)
    assert (tuple(placed.target.position_m), placed.target.frame) == ((1.0, 2.0, 3.0), "site")
    assert (turned.target.pan_rad, turned.target.tilt_rad, turned.aim) == (0.1, -0.1, None)


def test_a_second_operation_is_refused_naming_the_first(
    web: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    hang = Hang()
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(lambda *any: hang()))
    first = web.post("/point", json=ANGLES).json()["id"]
    assert hang.entered.wait(NET_S)
    assert web.get("/status").json()["state"] == "moving"
    assert first in refused(web.post("/point", json=ANGLES), 409, "busy")
    hang.let_go()
    assert ended(web, first)["state"] == "done"


def test_an_operation_that_fails_says_why_and_stops_the_mast(
    web: httpx.Client, hardware: FakeHardware, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(request: Any, record: Any, cancelled: Any, devices: Any) -> None:
        devices.move(0.0, 1.5)

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(fail))
    record = ended(web, web.post("/point", json={"position_m": [1, 2, 3]}).json()["id"])
    assert record["state"] == "failed"
    assert record["error"]["code"] == "outside_limits"
    assert record["error"]["message"] == "tilt 1.5 rad is beyond the soft limit 1 rad"
    assert hardware.head.calls == [("stop",)]


def test_a_defect_in_the_loop_is_one_sentence_and_the_daemon_goes_on(
    web: httpx.Client, hardware: FakeHardware, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(lambda *any: 1 / 0))
    record = ended(web, web.post("/point", json=ANGLES).json()["id"])
    assert record["state"] == "failed"
    assert record["error"]["code"] == "internal"
    assert "division" not in record["error"]["message"]
    assert hardware.head.calls in ([("stop",)], [("stop",)] * 2)  # beside a busy thread, and in turn
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(ScriptedLoop.good))
    assert ended(web, web.post("/point", json=ANGLES).json()["id"])["state"] == "done"


P = {"camera": "navcam_left", "frame_id": "f", "x_px": 1.0, "y_px": 2.0}
BAD_POINTS: list[tuple[Any, str]] = [
    ({}, "0 targets where exactly one of pixel, position_m, pan_rad with tilt_rad is expected"),
    ({"pixel": P, "position_m": [1, 2, 3]}, "2 targets where exactly one"),
    ({"pan_rad": 0.1}, "tilt_rad is missing"),
    ({"tilt_rad": 0.1}, "pan_rad is missing"),
    ({"pixle": P}, "pixle: unknown key; the nearest known is 'pixel'"),
    ({"pixel": {**P, "frame_idd": 1}}, "pixel.frame_idd: unknown key; the nearest known is 'frame_id'"),
    ({"pixel": {"camera": "navcam_left", "x_px": 1, "y_px": 2}}, "pixel.frame_id is missing"),
    ({"pixel": {**P, "x_px": "12"}}, 'pixel.x_px: "12" where a valid number is expected'),
    ({"pixel": {**P, "x_px": True}}, "pixel.x_px: true where a valid number is expected"),
    ({"pixel": {**P, "x_px": None}}, "pixel.x_px: null where a valid number is expected"),
    ({"pixel": {**P, "x_px": 1e300}}, "pixel.x_px: 1e+300 where less than or equal to 100000 is expected"),
    ({"pixel": {**P, "camera": 7}}, "pixel.camera: 7 where a valid string is expected"),
    ({"pixel": {**P, "camera": ""}}, "pixel.camera"),
    ({"pixel": [1, 2]}, "pixel: [1, 2] where an object with keys is expected"),
    ({"position_m": [1, 2]}, "position_m: [1, 2] where a list of 3 numbers is expected"),
    ({"position_m": [1, 2, 3, 4]}, "position_m: [1, 2, 3, 4] where a list of 3 numbers is expected"),
    ({"position_m": [1, 2, "3"]}, 'position_m[2]: "3" where a valid number is expected'),
    ({"position_m": {"x": 1}}, "position_m"),
    ({"position_m": [1, 2, 10**400]}, "position_m[2]"),
    ({"position_m": [1, 2, 3], "frame": "mast"}, "frame: \"mast\" where 'rover' or 'site' is expected"),
    ({**ANGLES, "frame": "rover"}, "frame goes with position_m only"),
    ({**ANGLES, "aim": {"camera": "navcam_left", "x_px": 1, "y_px": 1}}, "aim goes with pixel or position_m"),
    ({**ANGLES, "pointings": 2}, "pointings is 2, which goes with pixel only"),
    ({"position_m": [6, 1, 0], "pointings": 2}, "pointings is 2, which goes with pixel only"),
    ({**ANGLES, "pointings": 3}, "pointings: 3 where less than or equal to 2 is expected"),
    ({**ANGLES, "pointings": 0}, "pointings: 0"),
    ({**ANGLES, "pointings": 1.5}, "pointings: 1.5"),
    ({**ANGLES, "pointings": True}, "pointings: true"),
    ({"pan_rad": 7.0, "tilt_rad": 0.0}, "pan_rad: 7.0 where less than or equal to 6.28"),
    ([], "the body: [] where an object with keys is expected"),
    ("point", 'the body: "point" where an object with keys is expected'),
    (7, "the body: 7"),
    (None, "the body"),
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
    (b"", "application/json", 422, "bad_request"),
    (b"{", "application/json", 400, "not_json"),
    (b"\xff\xfe\x00", "application/json", 400, "not_json"),
    (b'{"pan_rad": NaN, "tilt_rad": 0}', "application/json", 400, "not_json"),
    (b'{"pan_rad": Infinity, "tilt_rad": 0}', "application/json", 400, "not_json"),
    (b'{"pan_rad": 1e999, "tilt_rad": 0}', "application/json", 422, "bad_request"),
    (b'{"pan_rad": 0, "pan_rad": 1, "tilt_rad": 0}', "application/json", 400, "not_json"),
    (b'{"pan_rad": ' + b"9" * 5000 + b', "tilt_rad": 0}', "application/json", 400, "not_json"),
    (b"[" * 30000, "application/json", 400, "not_json"),
    (b'{"a":' * 10000 + b"1" + b"}" * 10000, "application/json", 400, "not_json"),
    (b'{"pan_rad": 0, "tilt_rad": 0}', "text/plain", 415, "not_json"),
    (b'{"pan_rad": 0, "tilt_rad": 0}', "application/x-www-form-urlencoded", 415, "not_json"),
    (b" " * (LARGEST_BODY_BYTES + 1), "application/json", 413, "too_large"),
]


@pytest.mark.parametrize(
    ("body", "kind", "status", "code"), RAW_BODIES, ids=[f"{b[0][:24]!r} {b[1]}" for b in RAW_BODIES]
)
def test_what_is_no_good_json_does_not_get_far(
    quiet: httpx.Client, body: bytes, kind: str, status: int, code: str
) -> None:
    refused(quiet.post("/point", content=body, headers={"content-type": kind}), status, code)


def test_a_body_without_a_length_is_bounded_too(quiet: httpx.Client) -> None:
    chunks = (b" " * 10000 for _ in range(20))
    answer = quiet.post("/point", content=chunks, headers={"content-type": "application/json"})
    refused(answer, 413, "too_large")


def test_a_stop_works_whatever_body_comes_with_it(quiet: httpx.Client) -> None:
    for body in (b"{", b" " * (LARGEST_BODY_BYTES + 1)):
        answer = quiet.post("/stop", content=body, headers={"content-type": "application/json"})
        assert answer.status_code == 200, answer.text


KEYS = st.sampled_from(["pixel", "position_m", "frame", "pan_rad", "aim", "pointings", "camera", "x_px"])
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(KEYS, JSON, max_size=4) | JSON)
def test_any_json_gets_a_sentence_or_an_operation(quiet: httpx.Client, body: Any) -> None:
    if isinstance(body, dict):
        body.pop("position_m", None)  # so that nothing is accepted: an operation would be right, but moves
    answer = quiet.post("/point", json=body)
    assert answer.json()["error"]["message"]
    assert 400 <= answer.status_code < 500


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/api/v1/nothing", 404, "not_found"),
        ("GET", "/page/nothing.js", 404, "not_found"),
        ("GET", "/api/v1/point", 405, "method_not_allowed"),
        ("DELETE", "/api/v1/status", 405, "method_not_allowed"),
        ("GET", "/api/v1/stop", 405, "method_not_allowed"),
        ("GET", "/api/v1/operations/000001-ffff", 404, "operation_unknown"),
        ("GET", "/api/v1/snapshot/navcam_center", 404, "unknown_camera"),
        ("GET", "/api/v1/snapshot/navcam_left?format=gif", 422, "bad_request"),
        ("GET", "/api/v1/snapshot/navcam_left?fresh=perhaps", 422, "bad_request"),
        ("GET", "/api/v1/snapshot/navcam_left?frehs=true", 422, "bad_request"),
        ("GET", "/api/v1/snapshot/navcam_left?frame_id=navcam_left-000009-x-y", 404, "frame_unknown"),
        ("GET", "/api/v1/simulation/faults", 404, "not_simulated"),
        ("DELETE", "/api/v1/simulation/faults", 404, "not_simulated"),
        ("GET", "/api/v1/simulation/boards", 404, "not_simulated"),
        ("DELETE", "/api/v1/simulation/boards/b1", 404, "not_simulated"),
    ],
)
def test_other_refusals_have_the_one_form(
    quiet: httpx.Client, method: str, path: str, status: int, code: str
) -> None:
    refused(quiet.request(method, f"{quiet.base_url.copy_with(path='')}{path}"), status, code)


def test_a_query_that_is_no_boolean_is_told_in_plain_words(quiet: httpx.Client) -> None:
    message = refused(quiet.get("/snapshot/navcam_left?fresh=perhaps"), 422, "bad_request")
    assert message == 'fresh: "perhaps" where a valid boolean is expected'


def test_an_unknown_query_key_is_named_with_the_nearest(quiet: httpx.Client) -> None:
    message = refused(quiet.get("/snapshot/navcam_left?frehs=true"), 422, "bad_request")
    assert message == "frehs: unknown key; the nearest known is 'fresh'"


def test_faults_of_real_hardware_are_refused_with_the_reason(quiet: httpx.Client) -> None:
    answer = quiet.post("/simulation/faults", json={"device": "pan_tilt", "word": "stuck"})
    assert "simulated rover only" in refused(answer, 404, "not_simulated")


def test_faults_of_a_simulated_rover_are_set_told_and_cleared(
    web: httpx.Client, hardware: FakeHardware
) -> None:
    panel = FaultPanel(time.monotonic, ["navcam_left"])
    hardware.simulation = SimpleNamespace(faults=panel)
    assert web.get("/simulation/faults").json() == {"faults": []}
    body = {"device": "navcam_left", "word": "delayed", "parameters": {"delay_s": 0.25, "for_s": 60}}
    told = web.post("/simulation/faults", json=body).json()["faults"]
    assert [(fault["device"], fault["word"], fault["parameters"]["delay_s"]) for fault in told] == [
        ("navcam_left", "delayed", 0.25)
    ]
    web.post("/simulation/faults", json={"device": "pan_tilt", "word": "stuck"})
    assert web.get("/simulation/faults").json()["faults"][1]["end_s"] is None
    for bad in (
        {"device": "navcam_lift", "word": "dark"},
        {"device": "navcam_left", "word": "drak"},
        {"device": "navcam_left", "word": "dark", "parameters": {"probability": 1}},
        {"device": "navcam_left", "word": "delayed", "parameters": {"delay_s": -1}},
    ):
        refused(web.post("/simulation/faults", json=bad), 422, "bad_options")
    for name in ("device", "word", "self"):
        bad = {"device": "navcam_left", "word": "delayed", "parameters": {name: 1}}
        refused(web.post("/simulation/faults", json=bad), 422, "bad_request")
    refused(web.delete("/simulation/faults?device=navcam_lift"), 422, "bad_options")
    refused(web.delete("/simulation/faults?devize=pan_tilt"), 422, "bad_request")
    assert len(panel.active()) == 2
    assert len(web.delete("/simulation/faults?device=pan_tilt").json()["faults"]) == 1
    assert web.delete("/simulation/faults").json() == {"faults": []}


def test_angles_beyond_the_limits_are_refused_at_once(quiet: httpx.Client) -> None:
    message = refused(quiet.post("/point", json={"pan_rad": 0.0, "tilt_rad": 1.5}), 422, "outside_limits")
    assert message == "tilt 1.5 rad is beyond the soft limit 1 rad"


def test_an_aim_needs_a_camera_on_the_head(quiet: httpx.Client) -> None:
    for camera in ("hazcam_left", "pancam_left"):
        body = {"position_m": [1, 2, 3], "aim": {"camera": camera, "x_px": 1, "y_px": 1}}
        assert "navcam_left" in refused(quiet.post("/point", json=body), 422, "bad_aim")


def test_an_aim_outside_the_image_is_refused_at_once(quiet: httpx.Client) -> None:
    for x_px, y_px in ((63.6, 1), (1, -0.6)):
        body = {"position_m": [6, 1, 0], "aim": {"camera": "navcam_left", "x_px": x_px, "y_px": y_px}}
        refused(quiet.post("/point", json=body), 422, "outside_image")


def test_nothing_is_aimed_with_a_camera_that_the_daemon_lacks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given: list[Any] = []

    class Loop(ScriptedLoop):
        def __init__(self, rig: Any, *others: Any) -> None:
            given.append(rig)
            super().__init__(rig, *others)

    lacking = CONFIG.replace("navcam_left: {{driver: fake}}, ", "")
    with fake_daemon(monkeypatch, tmp_path, config=lacking, loop=Loop) as (daemon, _):
        assert sorted(given[0].cameras) == ["hazcam_left", "navcam_right"]
        assert dict(given[0].stereo) == {}
        with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as client:
            body = {"position_m": [6, 1, 0], "aim": {"camera": "navcam_left", "x_px": 1, "y_px": 1}}
            assert "navcam_right" in refused(client.post("/point", json=body), 422, "bad_aim")


def test_a_click_is_refused_by_name_if_its_frame_does_not_serve(
    web: httpx.Client, daemon: RunningDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame_id = web.get("/snapshot/navcam_left").headers["X-Mastctl-Frame-Id"]
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
    assert shot.headers["X-Mastctl-Moving"] == "true"
    pixel = {"camera": "navcam_left", "frame_id": shot.headers["X-Mastctl-Frame-Id"], "x_px": 1, "y_px": 1}
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


@pytest.mark.parametrize(
    ("body", "kind"),
    [(b"", ""), (b"{", "application/json"), (b"now!", "text/plain"), (b"{}", "application/json")],
)
def test_stop_works_whatever_body_comes_with_it(
    quiet: httpx.Client, standing: tuple[RunningDaemon, FakeHardware], body: bytes, kind: str
) -> None:
    standing[1].head.calls.clear()
    answer = quiet.post("/stop", content=body, headers={"content-type": kind} if kind else {})
    assert answer.json() == {"stopped": True, "operation": None}
    assert standing[1].head.calls == [("stop",)]


def test_stop_does_not_wait_behind_hanging_cameras(
    web: httpx.Client, daemon: RunningDaemon, hardware: FakeHardware
) -> None:
    hang = Hang()
    for camera in hardware.fake_cameras.values():
        camera.hook = hang
    askers = [
        threading.Thread(target=lambda: HTTP.get(f"{daemon.url}/api/v1/snapshot/navcam_left?fresh=true"))
        for _ in range(45)  # more than there are worker threads
    ]
    for asker in askers:
        asker.start()
    assert hang.entered.wait(NET_S)
    assert web.post("/stop").status_code == 200
    # twice where the head's own thread was kept from running: beside it, and then in its turn
    assert hardware.head.calls in ([("stop",)], [("stop",)] * 2)
    hang.let_go()
    joined(*askers)


def test_an_unconfirmed_stop_says_so(
    web: httpx.Client, hardware: FakeHardware, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices_module, "STOP_TIMEOUT_S", 0.3)
    hang = Hang()
    hardware.head.hook = hang
    assert hang.entered.wait(NET_S)
    assert "may still move" in refused(web.post("/stop"), 504, "no_reply")
    hardware.head.hook = lambda name: None
    hang.let_go()


# Pictures


def test_a_snapshot_is_the_picture_with_its_facts(web: httpx.Client, daemon: RunningDaemon) -> None:
    shot = web.get("/snapshot/navcam_left")
    assert shot.headers["content-type"] == "image/png"
    frame_id = shot.headers["X-Mastctl-Frame-Id"]
    kept = daemon.service.devices.frame_by_id(frame_id)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(shot.content, np.uint8), -1), kept.image)
    assert shot.headers["X-Mastctl-Camera"] == "navcam_left"
    assert int(shot.headers["X-Mastctl-Sequence"]) == kept.sequence
    assert float(shot.headers["X-Mastctl-Mid-Exposure-S"]) == kept.mid_exposure_s
    assert float(shot.headers["X-Mastctl-Exposure-S"]) == kept.exposure_s
    assert float(shot.headers["X-Mastctl-Pan-Rad"]) == kept.pan_rad
    assert float(shot.headers["X-Mastctl-Tilt-Rad"]) == kept.tilt_rad
    assert shot.headers["X-Mastctl-Moving"] == "false"
    assert shot.headers["X-Mastctl-Mast-Digest"] == daemon.service.stored.digest
    assert shot.headers["cache-control"] == "no-store"
    again = web.get(f"/snapshot/navcam_left?frame_id={frame_id}&format=jpeg")
    assert again.headers["X-Mastctl-Frame-Id"] == frame_id
    assert again.headers["content-type"] == "image/jpeg"
    assert again.content[:3] == b"\xff\xd8\xff"


def test_a_fresh_snapshot_is_exposed_after_the_request_and_another_may_be_kept(
    web: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_module, "SNAPSHOT_AGE_S", NET_S)
    first, second = (web.get("/snapshot/navcam_left").headers["X-Mastctl-Frame-Id"] for _ in range(2))
    assert first == second
    now_s = web.get("/status").json()["now_s"]
    shot = web.get("/snapshot/navcam_left?fresh=true")
    began_s = (
        float(shot.headers["X-Mastctl-Mid-Exposure-S"]) - float(shot.headers["X-Mastctl-Exposure-S"]) / 2
    )
    assert shot.headers["X-Mastctl-Frame-Id"] != first
    assert began_s > now_s


def test_a_camera_that_fails_is_a_gateway_error_in_plain_words(
    web: httpx.Client, hardware: FakeHardware
) -> None:
    hardware.fake_cameras["navcam_left"].change = lambda frame: "junk"
    refused(web.get("/snapshot/navcam_left?fresh=true"), 502, "bad_frame")

    def fail() -> None:
        raise KeyError("what")

    hardware.fake_cameras["navcam_left"].hook = fail
    refused(web.get("/snapshot/navcam_left?fresh=true"), 502, "driver_error")
    assert web.get("/status").json()["state"] == "ready"
    assert web.get("/status").json()["faults"][0]["device"] == "navcam_left"


def test_the_mast_file_is_served_byte_for_byte(web: httpx.Client, daemon: RunningDaemon) -> None:
    answer = web.get("/mast")
    assert answer.content == daemon.service.config.mast_file.read_bytes()
    assert answer.headers["X-Mastctl-Mast-Digest"] == daemon.service.stored.digest


# Who may ask


def test_the_interface_describes_itself(quiet: httpx.Client) -> None:
    document = quiet.get(str(quiet.base_url.copy_with(path="/openapi.json"))).json()
    paths = document["paths"]
    assert {f"/api/v1/{path}" for path in ("status", "point", "stop", "snapshot/{camera}")} <= set(paths)
    refusal = paths["/api/v1/point"]["post"]["responses"]["422"]["content"]["application/json"]
    assert refusal["schema"]["$ref"].endswith("/ErrorBody")


def test_the_description_is_made_once_and_holds_no_stop_up(
    quiet: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    making, plain, made = Hang(), described_module._describe, []

    def slow(document: Any, answers: Any) -> None:
        making()
        made.append(document)
        plain(document, answers)

    monkeypatch.setattr(described_module, "_describe", slow)
    described_module._made.cache_clear()
    where = str(quiet.base_url.copy_with(path="/openapi.json"))
    answers: list[int] = []
    asking = [threading.Thread(target=lambda: answers.append(quiet.get(where).status_code)) for _ in range(2)]
    for one in asking:
        one.start()
    try:
        assert making.entered.wait(60.0)
        assert quiet.post("/stop").status_code == 200
        assert answers == [], "the stop was answered while the description was made"
    finally:
        making.let_go()
        for one in asking:
            one.join(60.0)
    assert answers == [200, 200]
    assert len(made) == 1


def test_daemons_of_one_process_have_nothing_in_common_but_their_routes(
    quiet: httpx.Client, web: httpx.Client
) -> None:
    lease = web.post("/lease", json={"name": "one of them"}).json()
    assert web.get("/lease").json()["control"]["holder"] == "one of them"
    assert quiet.get("/lease").json()["control"] is None
    web.post("/point", json=ANGLES, headers={"Mastctl-Lease": lease["lease_id"]})
    assert [len(one.get("/operations").json()["operations"]) for one in (web, quiet)] == [1, 0]


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "", "127.0.0.1.evil.example", "[::2]", "["]
)
def test_a_foreign_host_name_is_refused(quiet: httpx.Client, host: str) -> None:
    where = urlsplit(str(quiet.base_url))
    with socket.create_connection((where.hostname, where.port), timeout=NET_S) as line:
        line.sendall(f"GET /api/v1/status HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
        answer = b"".join(iter(lambda: line.recv(65536), b""))
    assert answer.startswith(b"HTTP/1.1 403")
    assert b"foreign_host" in answer


def test_loopback_names_are_welcome(quiet: httpx.Client) -> None:
    port = quiet.base_url.port
    for host in (f"localhost:{port}", f"127.0.0.1:{port}", f"[::1]:{port}", "LOCALHOST"):
        assert quiet.get("/status", headers={"Host": host}).status_code == 200, host


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://["])
def test_another_sites_page_changes_nothing(quiet: httpx.Client, origin: str) -> None:
    for path in ("/stop", "/point"):
        refused(quiet.post(path, json=ANGLES, headers={"Origin": origin}), 403, "foreign_origin")


def test_the_services_own_page_may_ask(quiet: httpx.Client) -> None:
    own = f"http://{quiet.base_url.host}:{quiet.base_url.port}"
    refused(quiet.post("/point", json={}, headers={"Origin": own}), 422, "bad_request")


def test_what_is_not_http_does_no_harm(quiet: httpx.Client) -> None:
    where = urlsplit(str(quiet.base_url))
    with socket.create_connection((where.hostname, where.port), timeout=NET_S) as line:
        line.sendall(b"\x00\x01\x02 GET\r\n\r\n")
        assert line.recv(4096).startswith(b"HTTP/1.1 400")
    assert quiet.get("/status").status_code == 200


# Limits


def test_the_sun_is_told_kept_out_and_forgotten(web: httpx.Client) -> None:
    assert web.get("/limits/sun").json() == {"sun": None, "boxes": []}
    body = {"azimuth_rad": 0.1, "elevation_rad": -0.1, "half_angle_rad": 0.2, "valid_s": 3600.0}
    answer = web.post("/limits/sun", json=body).json()
    told, boxes = answer["sun"], answer["boxes"]
    assert any(low <= 0.1 <= high for low, high in (box["pan_rad"] for box in boxes))
    assert told["active"] and told["frame"] == "site" and 3600.0 - NET_S < told["left_s"] <= 3600.0
    assert "keep-out sun" in refused(web.post("/point", json=ANGLES), 422, "keep_out")
    vector = {"direction": [-2.0, 0.0, 0.0], "frame": "rover", "half_angle_rad": 0.2}
    assert web.post("/limits/sun", json=vector).json()["sun"]["direction"] == [-1.0, 0.0, 0.0]
    ended(web, web.post("/point", json=ANGLES).json()["id"])
    assert web.delete("/limits/sun").json() == {"sun": None, "boxes": []}


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"half_angle_rad": 0.2}, "azimuth_rad with elevation_rad, or direction, is expected"),
        ({"azimuth_rad": 0.1, "half_angle_rad": 0.2}, "azimuth_rad with elevation_rad, or direction"),
        ({"direction": [0, 0, 0], "half_angle_rad": 0.2}, "its length is 0"),
        ({"direction": [1, 0, 0], "half_angle_rad": 0.2, "azimuth_rad": 1.0}, "or direction, is expected"),
        ({"azimuth_rad": 0.1, "elevation_rad": 1.6, "half_angle_rad": 0.2}, "elevation_rad"),
        ({"direction": [1, 0, 0], "half_angle_rad": 2.0}, "half_angle_rad"),
    ],
)
def test_a_sun_that_is_none_is_refused(web: httpx.Client, body: dict[str, Any], words: str) -> None:
    assert words in refused(web.post("/limits/sun", json=body), 422, "bad_request")
