"""The operator page in a real browser, on fakes: what is always in sight, STOP, control, old images, jog."""

from __future__ import annotations

import json
import math
import os
import re
import socket
import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest

from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import (
    CONFIG,
    FakeHardware,
    FakePointing,
    FakeResult,
    FakeStep,
    ScriptedLoop,
    fake_daemon,
)
from hil_tests.mastctl.web.network import network_daemon
from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.waiting import NET_S, until
from mastctl.client import Client
from mastctl.control.caller import Caller
from mastctl.daemon import RunningDaemon
from mastctl.motion.requests import Aim
from mastctl.motion.results import Preview
from mastctl.web.page import page_files

BOTH = tuple[RunningDaemon, FakeHardware]
HIDDEN = "Object.defineProperty(document, 'hidden', {get: () => !window.seen})"
Visits = Callable[..., Visit]
SEEN = Preview(
    camera="navcam_left", frame_id="a", pixel_px=(32.0, 24.0), position_m=(6.0, 0.5, 0.1), range_m=6.02,
    range_from="stereo", aim=Aim("navcam_left", 31.5, 23.5), goal_rad=(0.1, -0.1), refused=None,
    other_camera="navcam_right", other_frame_id="b", other_pixel_px=(30.0, 24.0), other_sigma_px=(0.05, 0.05),
    correlation=0.97, second=0.4, across_px=0.02, sigma_m=(0.03, 0.01, 0.01), range_sigma_m=0.031,
)  # fmt: skip
ALONE = Preview(
    camera="navcam_left", frame_id="a", pixel_px=(32.0, 24.0), position_m=(6.0, 0.5, 0.1), range_m=6.02,
    range_from="unknown", aim=Aim("navcam_left", 31.5, 23.5), goal_rad=(0.1, -0.1), refused=None,
    range_interval_m=(1.5, None),
)  # fmt: skip


class Previewing(ScriptedLoop):
    """A scripted loop that sees what is clicked."""

    def preview(self, request: Any, cancelled: Any) -> Preview:
        return SEEN


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[BOTH]:
    with fake_daemon(monkeypatch, tmp_path, loop=Previewing) as made:
        yield made


def test_the_page_is_its_own_files_and_light(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    assert sum(map(len, page_files().values())) < 300_000
    one = visit(daemon.url)
    one.word("ready")
    one.frame()
    answer = httpx.get(daemon.url, trust_env=False)
    policy = answer.headers["content-security-policy"]
    assert "default-src 'self'" in policy and "unsafe" not in policy
    assert one.page.locator("#hardware").inner_text() == "HARDWARE"
    assert "little.yaml" in one.page.locator("#mast").inner_text()
    asked = {where.rpartition("/")[2] for where, _ in one.asked}
    assert {name for name in page_files() if name.endswith(".js")} <= asked


def test_the_page_comes_compressed_and_is_kept_by_the_browser(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url)
    one.word("ready")
    one.page.goto(pair[0].url)
    one.word("ready")  # of what the browser has kept
    with httpx.Client(base_url=pair[0].url, trust_env=False) as http:
        page = http.get("/")
        files = re.findall(r'"(/page/[0-9a-f]{16}/[a-z]+\.(?:js|css))"', page.text)
        assert len(files) >= 6
        for path in ("/", *files, "/openapi.json"):
            packed, plain = http.get(path), http.get(path, headers={"Accept-Encoding": "identity"})
            assert packed.headers["content-encoding"] == "gzip" and packed.content == plain.content
            assert int(packed.headers["content-length"]) < 0.6 * len(plain.content), path
            kept = "immutable" if path in files else "no-cache"
            assert kept in packed.headers["cache-control"] and "Accept-Encoding" in packed.headers["vary"]
            again = http.get(path, headers={"If-None-Match": packed.headers["etag"]})
            assert (again.status_code, again.content) == (304, b"")
            policies = {one.headers["content-security-policy"] for one in (packed, again)}
            assert len(policies) == 1, "a browser takes it from the newest answer"
        assert http.get("/api/v1/status").headers["cache-control"] == "no-store"


def test_a_click_shows_range_and_sigma_before_anything_moves_and_a_key_sends_it(
    pair: BOTH, visit: Visits
) -> None:
    daemon, hardware = pair
    one = visit(daemon.url)
    words = one.choose(part=(0.2, 0.2))
    assert "6.020 ± 0.031 m" in words and "0.970" in words
    assert one.page.locator(".eye[data-camera=navcam_right] .over .match").count() > 0
    assert not [call for call in hardware.head.calls if call[0] == "move"]
    asked = json.loads(one.posts("/point/preview")[-1])["pixel"]
    assert asked["camera"] == "navcam_left" and asked["mast_digest"] == daemon.service.stored.digest
    one.page.keyboard.press("p")
    words = one.target("ended")
    assert "+0.250" in words and "−0.500" in words and "± 0.050" in words
    assert "Nothing is to be gained" not in words
    sent = json.loads(one.posts("/point")[0])["pixel"]
    assert sent == asked, "what was seen is what is sent"


def test_the_page_says_when_nothing_is_to_be_gained_and_points_again_at_the_first_click(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle = FakeStep("settle", "done", 0.0, 0.01, {"count_rad": {"pan": 0.003, "tilt": 0.0}})

    def script(request: Any, record: Callable[[Any], None], *_: Any) -> FakeResult:
        record(settle)  # half a count of pan is 0.07 px of the little camera
        pointing = FakePointing([0.15, -0.1], [0.05, 0.06], "a", aim_px=[31.5, 23.5], target_px=[31.65, 23.4])
        return FakeResult([6.0, 0.0, 0.1], 6.0, (pointing,))

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(script))
    one = visit(pair[0].url)
    one.choose()
    one.page.keyboard.press("p")
    words = one.target("ended")
    assert re.search(r"Nothing is to be gained .* come to 0\.1\d, 0\.12 px", words), words
    one.page.keyboard.press("p")
    with one.page.expect_response("**/api/v1/point"):
        one.page.locator("#again").click()
    first, again = (json.loads(body) for body in one.posts("/point"))
    assert again == first
    one.target("ended")


def test_one_camera_alone_tells_between_which_ranges_it_is(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Previewing, "preview", lambda *_: ALONE)
    one = visit(pair[0].url)
    words = one.choose()
    assert "beyond 1.50 m" in words and "One camera alone" in words
    assert one.page.locator("#point").is_visible()


def test_a_head_of_one_camera_has_one_image_and_everything_else(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, visit: Visits
) -> None:
    config = CONFIG.replace(", navcam_right: {{driver: fake}}, hazcam_left: {{driver: fake}}", "")
    monkeypatch.setattr(Previewing, "preview", lambda *_: ALONE)
    with fake_daemon(monkeypatch, tmp_path, config=config, loop=Previewing) as (daemon, _):
        one = visit(daemon.url)
        assert "beyond 1.50 m" in one.choose()
        assert one.page.locator(".eye").count() == 1
        one.page.keyboard.press("p")
        one.target("ended")


def test_what_is_refused_is_told_in_words(pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, hardware = pair

    def refuse(*_: Any) -> Preview:
        raise NoReply("the camera is away", device="navcam_left")

    monkeypatch.setattr(Previewing, "preview", refuse)
    one = visit(daemon.url)
    assert "the camera is away" in one.choose()
    one.page.keyboard.press("p")
    assert not one.posts("/point") and not hardware.head.calls


def test_a_stale_image_is_hatched_and_blocks_clicks(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url, turned=True)
    one.frame()

    def fail() -> None:
        raise NoReply("no answer", device="navcam_left")

    hardware.fake_cameras["navcam_left"].hook = fail
    one.page.wait_for_selector("#faults:has-text('no answer')")
    one.wait_long()
    one.page.wait_for_selector(".eye[data-camera=navcam_left][data-stale]")
    one.page.locator(".eye[data-camera=navcam_left] .frame").click()
    assert "not of now" in one.target("refused")
    assert not one.posts("/point/preview")
    assert "no answer" in one.page.locator("#faults").inner_text().lower()
    assert "Clears when" in one.page.locator("#faults").inner_text()
    hardware.fake_cameras["navcam_left"].hook = lambda: None
    one.choose()
    one.target("preview")


def test_an_image_that_was_long_on_its_way_is_as_old_as_it_is_and_a_click_in_it_says_so(
    pair: BOTH, visit: Visits
) -> None:
    lines: list[Any] = []
    held: list[bytes] = []
    slow = threading.Event()

    def relay(line: Any) -> None:
        """The way back takes long at last: pictures come when the test says so, answers not at all."""
        server = line.connect_to_server()
        lines.append(line)
        server.on_message(
            lambda told: (isinstance(told, bytes) and held.append(told)) if slow.is_set() else line.send(told)
        )

    one = visit("about:blank", turned=True)
    one.page.route_web_socket(re.compile("/images"), relay)
    one.url = pair[0].url
    one.page.goto(one.url)
    one.frame()
    slow.set()
    until(lambda: one.page.wait_for_timeout(20) or held, "a picture is on its way")
    one.page.evaluate(
        """() => { window.shown = new Promise((go) => document.addEventListener("image-shown", (event) =>
          go([event.detail.camera, document.querySelector(`[data-camera=${event.detail.camera}] .age`)
            .textContent]), { once: true })); }"""
    )
    one.page.clock.fast_forward(5000)
    lines[-1].send(held[0])
    camera, age = one.page.evaluate("window.shown")
    assert 5.0 <= float(age.split()[0]) < NET_S, age
    one.choose(camera)
    assert re.search(r"was \d+\.\d s old when it was chosen", one.page.locator("#old").inner_text())


def test_a_page_that_is_hidden_from_the_start_asks_for_no_picture_until_it_is_seen(
    pair: BOTH, visit: Visits
) -> None:
    daemon, hardware = pair
    one = visit("about:blank")
    one.page.add_init_script(HIDDEN)
    one.url = daemon.url
    one.page.goto(daemon.url)
    one.page.wait_for_selector(".eye")  # the cameras are known: pictures would be asked for now
    one.page.locator("#tabs button").last.click()
    one.page.wait_for_selector(".eye[data-camera=hazcam_left]")
    assert not [where for where in one.told() if "/api/v1/images" in where]
    assert not any(camera.asked for camera in hardware.fake_cameras.values())
    one.page.evaluate("window.seen = true; document.dispatchEvent(new Event('visibilitychange'))")
    one.frame("hazcam_left")


def test_stop_needs_no_lease_and_no_confirmation(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        http.post("/lease", json={"for_s": 60.0}, headers={"Mastctl-Client": "somebody"})
    one = visit(daemon.url)
    one.word("ready")
    stop = one.page.get_by_role("button", name="STOP", exact=True)
    presses: dict[str, Callable[[], None]] = {
        "the button": stop.click,
        "Escape": lambda: one.page.keyboard.press("Escape"),
        "Enter on the button": lambda: stop.press("Enter"),
    }
    for how, press in presses.items():
        before = hardware.head.calls.count(("stop",))
        press()
        until(lambda: hardware.head.calls.count(("stop",)) > before, f"{how} stops the head")  # noqa: B023
        one.page.wait_for_selector("#stop[data-pressed=confirmed]")
        one.page.wait_for_selector("#stop[data-pressed='']")


def test_stop_goes_out_while_every_other_request_hangs(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, hardware = pair
    answered = threading.Event()
    monkeypatch.setattr(Previewing, "preview", lambda *_: answered.wait(NET_S) and SEEN)
    one = visit(daemon.url)
    frame = one.frame()
    for _ in range(8):
        frame.click()
    one.page.keyboard.press("Escape")
    until(lambda: ("stop",) in hardware.head.calls, "the head was told to stop")
    one.page.wait_for_selector("#stop[data-pressed=confirmed]")
    answered.set()


def test_what_the_page_had_not_sent_yet_when_stop_was_pressed_is_never_sent(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, hardware = pair
    answered = threading.Event()
    monkeypatch.setattr(Previewing, "preview", lambda *_: answered.wait(NET_S) and SEEN)
    one = visit(daemon.url)
    frame = one.frame()
    for _ in range(5):
        frame.click()
    until(lambda: len(one.posts("/point/preview")) >= 4, "no request is free")
    one.page.fill("#goal-pan", "20")
    one.page.fill("#goal-tilt", "-5")
    one.page.click(".angles button:has-text('Go')")
    one.page.keyboard.press("Escape")
    until(lambda: ("stop",) in hardware.head.calls, "the head was told to stop")
    answered.set()
    one.page.wait_for_selector("#jog .bad:has-text('STOP was pressed')")
    one.choose()
    assert one.posts("/point") == [] and not any(call[0] == "move" for call in hardware.head.calls)


def test_a_stop_that_is_not_confirmed_is_told_loudly(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url)
    one.word("ready")

    def hook(name: str) -> None:
        if name == "stop":
            raise NoReply("the line is dead", device="pan_tilt")

    hardware.head.hook = hook
    one.page.get_by_role("button", name="STOP", exact=True).click()
    said = one.page.locator("#stop-failed:not([hidden])")
    said.wait_for()
    assert "NOT CONFIRMED" in said.inner_text()
    hardware.head.hook = lambda name: None
    with Client(daemon.url) as client:
        client.keep_place("chart", 0.1, 0.1)
        one.page.get_by_role("button", name="chart", exact=True).wait_for()
        assert said.is_visible(), "another command confirms no stop"
        client.stop()
    said.wait_for(state="hidden")


def test_after_a_restart_nothing_of_the_dead_daemon_is_shown(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, visit: Visits
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    listen = f"{{port: {port}}}"
    dead = threading.Event()
    lines: list[Any] = []

    def relay(line: Any) -> None:
        """Of a daemon that was killed nothing is heard, not how its operations end either."""
        server, first = line.connect_to_server(), not lines
        lines.append(line)
        server.on_message(lambda told: None if first and dead.is_set() else line.send(told))

    def waits(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> Any:
        record(FakeStep("limits", "done", 0.0, 0.01, {"pan_rad": 0.3, "tilt_rad": 0.1}))
        cancelled.wait(NET_S)
        raise NoReply("it was ended", device="pan_tilt")

    with fake_daemon(monkeypatch, tmp_path, listen, loop=Previewing) as (daemon, _):
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
        one = visit("about:blank")
        one.page.route_web_socket(re.compile("/events"), relay)
        one.url = daemon.url
        one.page.goto(daemon.url)
        one.choose()
        one.page.keyboard.press("p")
        one.page.wait_for_selector("#target >> text=Under way")
        one.page.wait_for_selector(".operation .word.running")
        one.page.wait_for_selector(".range .wanted", state="attached")
        one.page.route("**/api/v1/stop", lambda route: route.abort())
        one.page.keyboard.press("Escape")
        one.page.wait_for_selector("#stop-failed:not([hidden])")
        dead.set()
    one.word("lost")
    assert one.page.locator("#stop-failed").is_visible(), "nobody knows yet"
    with fake_daemon(monkeypatch, tmp_path, listen, loop=Previewing):
        one.word("ready")
        one.page.wait_for_selector("#stop-failed", state="hidden")
        assert "started again" in one.target("refused")
        one.page.wait_for_selector("#operations >> text=None since the daemon began")
        one.page.wait_for_selector(".range .wanted", state="detached")
        one.page.unroute_all()
        one.complaints.clear()


def test_two_pages_and_the_lease(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    one, other = visit(daemon.url), visit(daemon.url)
    for each in (one, other):
        each.word("ready")
    one.page.get_by_role("button", name="Take", exact=True).click()
    one.page.get_by_role("button", name="Release", exact=True).wait_for()
    over = other.page.get_by_role("button", name="Take over", exact=True)
    over.wait_for()
    assert "left" in other.page.locator("#control").inner_text()
    other.page.locator("#home").click()
    other.page.wait_for_selector("#jog .bad:not(:empty)")
    assert "steers" in other.page.locator("#jog .bad").inner_text()
    one.page.locator("#home").click()
    until(lambda: daemon.service.operations.all(), "who holds the lease may move")
    over.click()
    other.page.get_by_role("button", name="Take it from them?").click()
    other.page.get_by_role("button", name="Release", exact=True).wait_for()
    other.page.get_by_role("button", name="Release", exact=True).click()
    until(lambda: daemon.service.leases.told() is None, "it is given back")


def test_a_page_that_is_closed_gives_its_lease_back(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    one = visit(daemon.url)
    one.word("ready")
    one.page.get_by_role("button", name="Take", exact=True).click()
    one.page.get_by_role("button", name="Release", exact=True).wait_for()
    one.page.goto("about:blank")
    until(lambda: daemon.service.leases.told() is None, "it is given back")


def test_pictures_whose_line_died_in_silence_come_by_another(pair: BOTH, visit: Visits) -> None:
    lines: list[Any] = []
    cut = threading.Event()

    def relay(line: Any) -> None:
        server, first = line.connect_to_server(), not lines
        lines.append(line)
        server.on_message(lambda told: None if first and cut.is_set() else line.send(told))

    one = visit("about:blank", turned=True)
    one.page.route_web_socket(re.compile("/images"), relay)
    one.url = pair[0].url
    one.page.goto(one.url)
    one.frame()
    cut.set()
    until(lambda: one.wait_long() or len(lines) == 2, "another is opened")
    one.frame()


def test_a_stream_that_died_in_silence_while_the_daemon_answers_is_begun_again(
    pair: BOTH, visit: Visits
) -> None:
    daemon, _ = pair
    cut = threading.Event()
    lines: list[Any] = []

    def relay(line: Any) -> None:
        server, first = line.connect_to_server(), not lines
        lines.append(line)
        server.on_message(lambda told: None if first and cut.is_set() else line.send(told))

    one = visit(daemon.url, turned=True)
    one.page.route_web_socket(re.compile("/events"), relay)
    one.page.reload()
    one.word("ready")
    cut.set()
    one.wait_long()
    until(lambda: bool(one.page.title()) and len(lines) == 2, "it is begun again")
    httpx.post(f"{daemon.url}/api/v1/estop", trust_env=False)
    one.word("stopped")
    assert len(lines) == 2, "and not again while it tells"


def test_a_connection_that_is_cut_is_told_and_comes_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, visit: Visits
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    listen = f"{{port: {port}}}"
    with fake_daemon(monkeypatch, tmp_path, listen) as (daemon, _):
        one = visit(daemon.url, turned=True)
        one.frame()
        one.page.get_by_role("button", name="Take", exact=True).click()
        one.page.get_by_role("button", name="Release", exact=True).wait_for()
    lost = one.page.locator("#lost")
    lost.wait_for(state="visible")
    assert "may go on until its deadline" in lost.inner_text()
    one.wait_long()
    one.page.wait_for_selector(".eye[data-camera=navcam_left][data-stale]")
    one.page.get_by_role("button", name="STOP", exact=True).click()
    one.page.wait_for_selector("#stop-failed:not([hidden])")
    with fake_daemon(monkeypatch, tmp_path, listen):
        lost.wait_for(state="hidden")
        one.word("ready")
        one.frame()
        one.page.wait_for_selector(".notice >> text=You steer no longer")
        one.page.get_by_role("button", name="Take", exact=True).wait_for()
        one.complaints.clear()


def test_a_token_is_asked_for_and_who_may_look_cannot_move(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, visit: Visits
) -> None:
    with network_daemon(monkeypatch, tmp_path) as net:
        one = visit(net.url)
        one.page.locator("#login").wait_for(state="visible")
        one.page.locator("#token").fill("nonsense")
        one.page.get_by_role("button", name="Log in").click()
        one.page.wait_for_selector("#login-said:not(:empty)")
        one.page.keyboard.press("Escape")
        until(lambda: ("stop",) in net.hardware.head.calls, "a stop needs no token")
        assert one.page.locator("#login").is_visible()
        told = len(net.hardware.head.calls)
        one.page.get_by_role("button", name="STOP", exact=True).click()
        until(lambda: len(net.hardware.head.calls) > told, "nor does the button, which no dialogue covers")
        one.page.locator("#token").fill(net.token("view"))
        one.page.get_by_role("button", name="Log in").click()
        one.frame().click()
        assert "You may look" in one.target("refused")
        one.page.wait_for_selector("#logout:not([hidden])")
        assert one.page.locator("#home").is_disabled() and one.page.locator("#take").is_disabled()
        assert not one.posts("/point/preview")
        assert net.token("view") not in one.page.content()
        one.page.get_by_role("button", name="Log out").click()
        one.page.locator("#login").wait_for(state="visible")
        assert one.page.evaluate("fetch('/api/v1/status').then((answer) => answer.status)") == 401
        one.page.locator("#token").fill(net.token("operate"))
        one.page.get_by_role("button", name="Log in").click()
        one.page.get_by_role("button", name="Take", exact=True).click()
        one.page.get_by_role("button", name="Release", exact=True).wait_for()
        one.page.route("**/lease/renew", lambda held: None)  # the page does not know yet
        net.daemon.service.leases.take(Caller("Ben"), "to try it")
        one.page.get_by_role("button", name="Log out").click()
        one.page.locator("#login").wait_for(state="visible")


def test_a_jog_ends_when_its_key_its_window_or_its_focus_is_gone(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url)
    one.word("ready")
    endings: dict[str, Callable[[], Any]] = {
        "keyup": lambda: one.page.keyboard.up("ArrowRight"),
        "window blur": lambda: one.page.evaluate("window.dispatchEvent(new Event('blur'))"),
        "tab hidden": lambda: one.page.evaluate("document.dispatchEvent(new Event('visibilitychange'))"),
        "focus goes elsewhere": one.page.locator("#goal-pan").focus,
    }
    for how, end in endings.items():
        here_rad = hardware.head.pan_rad
        one.page.locator("#pad").focus()
        one.page.keyboard.down("ArrowRight")
        until(lambda: hardware.head.pan_rad > here_rad, f"the head turns, before {how}")  # noqa: B023
        end()
        until(lambda: json.loads(one.posts("/jog")[-1])["pan_rad_per_s"] == 0, f"{how} ends it")
        until(lambda: daemon.service.operations.running is None, f"the jog has ended by {how}")
        one.page.keyboard.up("ArrowRight")


def test_a_finger_turns_the_head_and_chooses_a_point(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url, has_touch=True, viewport={"width": 820, "height": 1180})
    one.choose(press="tap")
    one.target("preview")
    one.page.locator("#point").tap()
    one.target("ended")
    small = one.page.evaluate(
        "[...document.querySelectorAll('button')].filter(b => b.offsetParent && b.offsetHeight < 28).length"
    )
    assert small == 0, "each button is large enough for a finger"
    assert one.page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing is cut off"
    assert one.page.locator("#stop").is_visible()
    until(lambda: daemon.service.operations.running is None, "it has arrived")
    button = one.page.locator("[data-way=right]")
    button.scroll_into_view_if_needed()
    box = button.bounding_box()
    assert box is not None
    point = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    here = len(hardware.head.calls)
    finger = one.page.context.new_cdp_session(one.page)
    finger.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point]})
    until(lambda: len(hardware.head.calls) > here, "the head turns")
    finger.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(lambda: json.loads(one.posts("/jog")[-1])["pan_rad_per_s"] == 0, "the finger's end ends it")
    until(lambda: daemon.service.operations.running is None, "the jog has ended")
    assert max(json.loads(body)["pan_rad_per_s"] for body in one.posts("/jog")) > 0


def test_no_gesture_begins_a_track_without_a_press(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url)
    follow = one.page.get_by_role("button", name="Follow it")

    def drag(way_px: float) -> None:
        box = one.frame().bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        one.page.mouse.move(x, y)
        one.page.mouse.down()
        one.page.mouse.move(x + way_px, y + way_px, steps=4)
        one.page.mouse.up()

    drag(7.0 / math.sqrt(2.0))
    one.target("preview")  # a hand that shakes has clicked
    assert not follow.is_visible()
    drag(150.0)
    follow.wait_for()
    one.page.keyboard.press("Escape")
    follow.wait_for(state="hidden")
    drag(150.0)
    one.page.get_by_role("button", name="Leave it").click()
    drag(150.0)
    assert not one.posts("/track")
    with one.page.expect_request("**/api/v1/track"):
        follow.click()
    assert len(one.posts("/track")) == 1 and not follow.is_visible()


def test_a_finger_scrolls_over_an_image_and_begins_nothing(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url, has_touch=True, is_mobile=True, viewport={"width": 390, "height": 844})
    frame = one.frame()
    frame.scroll_into_view_if_needed()
    finger = one.page.context.new_cdp_session(one.page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y} for x, y in points]
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    def middle() -> tuple[float, float]:
        box = frame.bounding_box()
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    before = one.page.evaluate("scrollY")
    x, y = middle()
    touch("touchStart", (x, y))
    for k in range(1, 21):
        touch("touchMove", (x + k / 4, y - 10 * k))
    touch("touchEnd")
    until(lambda: one.page.evaluate("scrollY") > before, "the page scrolls")
    assert not one.posts("/track") and not one.posts("/point/preview")


def test_a_finger_that_is_held_on_an_image_asks_whether_to_follow(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url, has_touch=True, is_mobile=True, viewport={"width": 390, "height": 844})
    frame = one.frame()
    frame.scroll_into_view_if_needed()
    finger = one.page.context.new_cdp_session(one.page)
    box = frame.bounding_box()
    place = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    finger.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [place]})
    follow = one.page.get_by_role("button", name="Follow it").first
    follow.wait_for()
    finger.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    assert not one.posts("/track") and not one.posts("/point/preview")
    with one.page.expect_request("**/api/v1/track"):
        follow.tap()


def test_by_the_keyboard_alone_a_pixel_is_chosen_and_sent(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    one = visit(daemon.url)
    one.frame()
    for _ in range(30):
        one.page.keyboard.press("Tab")
        if one.page.evaluate("document.activeElement.closest('.eye')?.dataset.camera") == "navcam_left":
            break
    for key in ("ArrowLeft", "Shift+ArrowUp", "Alt+ArrowRight"):
        one.page.keyboard.press(key)
    one.page.keyboard.press("Enter")
    one.target("preview")
    pixel = json.loads(one.posts("/point/preview")[0])["pixel"]
    assert (pixel["x_px"], pixel["y_px"]) == (30.6, 13.5)
    one.page.keyboard.press("p")
    one.target("ended")


def test_what_was_chosen_before_a_stop_a_turn_or_a_takeover_is_never_sent(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url)
    ben = {"Mastctl-Client": "Ben"}
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False, headers=ben) as http:

        def released() -> None:
            one.page.wait_for_selector("#latch[aria-pressed=true]")
            http.post("/reset", json={"reason": "mended", "name": "Ben"}).raise_for_status()

        def taken() -> None:
            lease = http.post("/lease", json={"for_s": 60.0}).json()["lease_id"]
            one.page.wait_for_selector("#control >> text=Ben")
            http.delete("/lease", headers={"Mastctl-Lease": lease}).raise_for_status()

        comings: dict[str, Callable[[], Any]] = {
            "STOP was pressed": lambda: one.page.keyboard.press("Escape"),
            "E-STOP was pressed": lambda: (one.page.locator("#latch").click(), released()),
            "The head was stopped": lambda: http.post("/stop"),
            "stopped|emergency stop was pressed": lambda: (http.post("/estop"), released()),
            "Ben took over": taken,
            "The head (was sent elsewhere|turned)": lambda: http.post(
                "/point", json={"pan_rad": 0.1, "tilt_rad": 0.0}
            ),
            "The head turned": lambda: setattr(hardware.head, "pan_rad", -0.3),
        }
        for words, come in comings.items():
            facing = (
                f"{round(math.degrees(hardware.head.pan_rad), 2):+.2f}°" if hardware.head.pan_rad else "0.00°"
            )
            one.page.wait_for_selector(
                f".eye[data-camera=navcam_left] .facing >> text=/^{re.escape(facing)}/"
            )
            assert "6.020" in one.choose(), words
            come()
            assert re.search(words, one.target("refused")), words
            assert one.page.locator(".over :is(.click, .match)").count() == 0, words
            one.page.keyboard.press("p")
    assert not one.posts("/point")


def test_a_preview_that_is_under_way_when_stop_is_pressed_is_not_offered(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    answered = threading.Event()
    monkeypatch.setattr(Previewing, "preview", lambda *_: answered.wait(NET_S) and SEEN)
    one = visit(pair[0].url)
    one.frame().click()
    one.target("asked")
    one.page.keyboard.press("Escape")
    with one.page.expect_response("**/point/preview"):
        answered.set()
    assert "STOP was pressed" in one.target("refused")
    one.page.keyboard.press("p")
    assert not one.posts("/point")


def test_point_is_not_offered_while_an_emergency_stop_is_latched(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    one = visit(daemon.url)
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        http.post("/estop")
        one.word("stopped")
        assert "The emergency stop is latched" in one.choose()
        assert one.page.locator("#point").count() == 0
        one.page.keyboard.press("p")
        http.post("/reset", json={"reason": "mended", "name": "Ben"}).raise_for_status()
        assert "was released" in one.target("refused")
        one.page.keyboard.press("p")
        assert not one.posts("/point")
        one.choose()
        one.page.keyboard.press("p")
        one.target("ended")


def test_another_mast_file_takes_back_what_was_chosen(pair: BOTH, visit: Visits, tmp_path: Path) -> None:
    daemon, _ = pair
    other = (tmp_path / "little.yaml").read_text().replace("name: little", "name: other")
    (tmp_path / "other.yaml").write_text(other)
    one = visit(daemon.url)
    one.choose()
    one.target("preview")
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        assert http.post("/mast", json={"file": "other.yaml"}).status_code == 200
    assert "Another mast file" in one.target("refused")
    one.page.wait_for_selector("#mast >> text=other.yaml")
    one.page.get_by_role("button", name="Go back").click()
    one.page.wait_for_selector("#mast >> text=little.yaml")


def test_an_emergency_stop_is_told_and_released_with_a_reason(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    one = visit(daemon.url)
    one.word("ready")
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        http.post("/estop", json={"reason": "sparks", "name": "Ana"})
    one.word("stopped")
    assert "by Ana: sparks" in one.page.locator("#estop").inner_text()
    one.page.locator("#release").click()
    one.page.get_by_role("button", name="STOP", exact=True).click()
    one.page.wait_for_selector("#stop[data-pressed=confirmed]")
    one.page.locator("#reset-reason").fill("a loose wire, mended")
    one.page.locator("#reset-name").fill("Ben")
    one.page.get_by_role("button", name="Release", exact=True).click()
    one.word("holding")
    assert one.page.locator("#estop").is_hidden()


def test_a_release_that_came_too_late_releases_nobody_else_s_stop(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    one = visit(daemon.url)
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        for name in ("Ana", "Ben"):
            http.post("/estop", json={"reason": "sparks", "name": name})
        one.page.get_by_role("button", name="Release Ana’s").click()
        http.post("/reset", json={"reason": "mended", "name": "Cleo", "latched_by": "Ana"}).raise_for_status()
        one.page.wait_for_selector("#estop:not(:has-text('Ana'))")
        one.page.locator("#reset-reason").fill("mended")
        one.page.locator("#reset-name").fill("Dan")
        one.page.get_by_role("button", name="Release", exact=True).click()
        one.page.wait_for_selector("#reset-said >> text=Ana")
        assert [each["name"] for each in http.get("/status").json()["estops"]] == ["Ben"]
        one.page.get_by_role("button", name="Leave it").click()
        assert "by Ben: sparks" in one.page.locator("#estop").inner_text()


def test_an_emergency_stop_is_pressed_without_a_lease_and_holds(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        lease = http.post("/lease", json={"for_s": 60.0}, headers={"Mastctl-Client": "somebody"}).json()
        one = visit(daemon.url)
        one.word("ready")
        latch = one.page.get_by_role("button", name="E-STOP latches until released")
        for presses, press in enumerate((latch.click, lambda: latch.press("Enter")), 1):
            one.page.wait_for_selector("#latch[aria-pressed=false]")
            before = hardware.head.calls.count(("stop",))
            press()
            until(lambda: hardware.head.calls.count(("stop",)) > before, "the head was told to stop")  # noqa: B023
            one.page.wait_for_selector("#latch[aria-pressed=true]")
            words = one.page.locator("#estop").inner_text()
            assert "pressed on the page" in words and "Nothing moves until it is released" in words
            assert len(one.posts("/estop")) == presses and not one.posts("/stop")
            refused = http.post(
                "/point", json={"pan_rad": 0.1, "tilt_rad": 0.0}, headers={"Mastctl-Lease": lease["lease_id"]}
            )
            assert refused.json()["error"]["code"] == "estopped"
            http.post("/reset", json={"reason": "once more", "name": "Ana"}).raise_for_status()


def test_the_cone_around_the_sun_is_in_the_joint_map_until_it_is_taken_back(
    pair: BOTH, visit: Visits
) -> None:
    daemon, _ = pair
    one = visit(daemon.url)
    one.word("ready")
    assert one.page.locator(".map .sun").count() == 0
    sun = {"direction": [1.0, 0.2, -0.1], "frame": "rover", "half_angle_rad": 0.2}
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        http.post("/limits/sun", json=sun)
        one.page.wait_for_selector(".map .sun", state="attached")
        assert "11.5° off the sun" in one.page.locator("#sun-note").inner_text()
        http.delete("/limits/sun")
    one.page.wait_for_selector(".map .sun", state="detached")
    assert one.page.locator("#sun-note").inner_text() == ""


def test_the_mast_file_s_date_is_told_and_whose_it_is(pair: BOTH, visit: Visits, tmp_path: Path) -> None:
    daemon, _ = pair
    os.utime(tmp_path / "little.yaml", (1_700_000_000, 1_700_000_000))
    plain = (tmp_path / "little.yaml").read_text()
    dated = plain.replace("provenance: {}", "provenance: {date: '2025-03-04'}")
    assert dated != plain
    (tmp_path / "dated.yaml").write_text(dated)
    one = visit(daemon.url)
    one.page.wait_for_selector("#mast >> text=file of 2023-11-1")
    assert "the file's own time" in one.page.locator("#mast-file").inner_text()
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        assert http.post("/mast", json={"file": "dated.yaml"}).status_code == 200
    one.page.wait_for_selector("#mast >> text=made 2025-03-04")
    assert "as the file says" in one.page.locator("#mast-file").inner_text()


def test_what_the_drift_sentinel_found_is_told_with_its_age(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        assert http.get("/sentinel").json()["level"] == "none"
        folder = daemon.service.folder.path / "sentinel"
        folder.mkdir()
        digest = daemon.service.stored.digest
        reference = {
            "schema": "mastctl/sentinel/1", "time": "2026-01-01T00:00:00+00:00", "mast_digest": digest,
            "rests": [[0.0, 0.0]], "pictures": [],
        }  # fmt: skip
        (folder / "reference.json").write_text(json.dumps(reference))
        at = (datetime.now(UTC) - timedelta(hours=2)).isoformat(timespec="seconds")
        words = "navcam_left turned 1.79 mrad about y, 9 sigma"
        look = {
            "time": at, "reference": reference["time"], "views": 4, "named": "navcam_left", "sentence": words,
        }  # fmt: skip
        (folder / "looks.jsonl").write_text(2 * (json.dumps(look) + "\n"))
        told = http.get("/sentinel").json()
        assert told["level"] == "bad" and 7199 <= told["age_s"] < 7400
        one = visit(daemon.url)
        one.page.wait_for_selector("#drift.bad")
        said = one.page.locator("#drift").inner_text()
        assert words in said and re.search(r"Last look 2 h \d min ago", said), said
        (folder / "reference.json").write_text(json.dumps({**reference, "mast_digest": "0" * 64}))
        assert "another mast file" in http.get("/sentinel").json()["sentence"]
        (folder / "reference.json").write_text("{")
        assert "take the reference again" in http.get("/sentinel").json()["sentence"]


def test_light_or_dark_is_switched_and_kept(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url, color_scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    one.word("ready")
    dark = one.page.evaluate(ground)
    one.page.get_by_role("button", name="Show the page light").click()
    light = one.page.evaluate(ground)
    assert light != dark
    one.page.reload()
    one.word("ready")
    assert one.page.evaluate(ground) == light
    one.page.get_by_role("button", name="Show the page dark").click()
    assert one.page.evaluate(ground) == dark


def test_places_are_kept_and_gone_to(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url)
    one.word("ready")
    one.page.locator("#goal-pan").fill("10")
    one.page.locator("#goal-tilt").fill("-5,5")
    one.page.get_by_role("button", name="Go", exact=True).click()
    until(lambda: hardware.head.calls, "it moves")
    until(lambda: daemon.service.operations.running is None, "it has arrived")
    asked = json.loads(one.posts("/point")[0])
    assert asked["pan_rad"] == pytest.approx(0.17453, abs=1e-5)
    assert asked["tilt_rad"] == pytest.approx(-0.09599, abs=1e-5)
    one.page.locator("#goal-pan").fill("a lot")
    one.page.get_by_role("button", name="Go", exact=True).click()
    one.page.wait_for_selector("#jog .bad:not(:empty)")
    assert "degrees" in one.page.locator("#jog .bad").inner_text()


SIZES = {
    "a desk": (1400, 950), "a small tablet": (1024, 768), "a phone on its side": (844, 390),
    "a phone": (390, 844), "200 %": (640, 512),
}  # fmt: skip
"""CSS pixels; the last is a window of 1280x1024 at that zoom, at 400 % it is 320x256."""
SEEN_AT = """(place) => {
  const box = place.getBoundingClientRect();
  const top = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
  return Boolean(top) && place.contains(top) && box.top >= 0 && box.bottom <= innerHeight;
}"""
WIDER = "document.documentElement.scrollWidth - innerWidth"


def test_image_stop_and_point_are_in_sight_together_at_each_size(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url)
    for name, (width, height) in SIZES.items():
        one.page.set_viewport_size({"width": width, "height": height})
        one.choose()
        for part in ("#point", "#stop", "#latch"):
            assert one.page.locator(part).evaluate(SEEN_AT), f"{part} is in sight and not covered at {name}"
        shown = one.page.locator(".eye[data-camera=navcam_left] .frame").evaluate(
            "(frame) => { const [image, bar] = [frame, document.querySelector('#stop')].map((one) =>"
            " one.getBoundingClientRect());"
            " return Math.min(innerHeight, image.bottom) - Math.max(bar.bottom, image.top); }"
        )
        assert shown > 150, f"{shown} px of the image's height are in sight at {name}"
        assert one.page.evaluate(WIDER) <= 0, name
    one.page.set_viewport_size({"width": 320, "height": 256})
    one.choose()
    for part in ("#point", "#stop"):
        assert one.page.locator(part).evaluate(SEEN_AT), f"{part} is in sight at 400 %"
    assert one.page.evaluate(WIDER) <= 0
    assert one.page.locator("h1").count() == 1


def test_the_pad_stays_where_it_is_during_a_pointing(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url)
    for width, height in ((1400, 950), (1024, 768), (390, 844)):
        one.page.set_viewport_size({"width": width, "height": height})
        one.frame()
        before = "document.getElementById('pad').getBoundingClientRect().top + scrollY"
        stood = one.page.evaluate(before)
        one.choose()
        assert one.page.evaluate(before) == stood
        one.page.keyboard.press("p")
        one.target("ended")
        assert one.page.evaluate(before) == stood


def test_long_names_scroll_nothing_sideways(pair: BOTH, visit: Visits, tmp_path: Path) -> None:
    daemon, _ = pair
    name = 40 * "W"
    (tmp_path / f"{name}.yaml").write_text((tmp_path / "little.yaml").read_text())
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        http.post("/mast", json={"file": f"{name}.yaml"}).raise_for_status()
        http.post(f"/places/{name}", json={"pan_rad": 0.1, "tilt_rad": 0.1}).raise_for_status()
        http.post("/lease", json={"for_s": 60.0, "name": name}).raise_for_status()
        http.post("/recordings/start", json={"name": name}).raise_for_status()
        http.post("/recordings/stop")
    one = visit(daemon.url)
    one.page.get_by_role("button", name=name, exact=True).wait_for()
    one.page.wait_for_selector(f"#control >> text={name}")
    for width, height in (*SIZES.values(), (320, 256)):
        one.page.set_viewport_size({"width": width, "height": height})
        assert one.page.evaluate(WIDER) <= 0, (width, height)


def test_an_emergency_stop_under_the_pointer_can_be_read(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url, color_scheme="light")
    one.word("ready")
    one.page.locator("#latch").click()
    one.page.wait_for_selector("#latch[aria-pressed=true]")
    one.page.locator("#latch").hover()
    style = "(b) => [getComputedStyle(b).color, getComputedStyle(b).backgroundColor]"
    assert one.page.locator("#latch").evaluate(style) == ["rgb(255, 255, 255)", "rgb(198, 36, 26)"]
    assert not one.serious("#latch")


def test_single_keys_are_listed_and_can_be_switched_off(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url)
    one.choose()
    one.page.keyboard.press("?")
    keys = one.page.locator("#keys")
    assert "STOP, wherever the focus is" in keys.inner_text()
    assert not one.serious("#keys")
    one.page.get_by_label("The keys P and ? do something").uncheck()
    keys.get_by_role("button", name="Close").click()
    one.page.keyboard.press("p")
    one.page.keyboard.press("?")
    assert not keys.is_visible() and not one.posts("/point")
    one.page.reload()
    one.choose()
    one.page.keyboard.press("p")
    one.page.get_by_role("button", name="Keys").click()
    assert not one.posts("/point") and not one.page.get_by_label("The keys P and ?").is_checked()


def test_who_steers_is_told_by_the_name_that_was_typed(pair: BOTH, visit: Visits) -> None:
    one, other = visit(pair[0].url), visit(pair[0].url)
    other.word("ready")
    one.page.get_by_role("button", name="Your name").click()
    assert not one.serious("#named")
    one.page.get_by_label("Name", exact=True).fill("Žofie 李")
    one.page.get_by_role("button", name="Keep it").click()
    one.page.get_by_role("button", name="as Žofie 李").wait_for()
    one.page.get_by_role("button", name="Take", exact=True).click()
    one.page.wait_for_selector("#control >> text=you, renewed")
    other.page.wait_for_selector("#control >> text=/^Žofie 李, \\d+ s left/")
    other.page.locator("#home").click()
    other.page.wait_for_selector("#jog .bad >> text=/^Žofie 李 steers/")
    one.page.locator("#latch").click()
    other.page.wait_for_selector("#estop >> text=by Žofie 李: pressed on the page")
    assert "page-" not in other.page.locator("#state").inner_text()


def test_refusals_speak_the_units_that_were_typed(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url)
    one.word("ready")
    said = one.page.locator("#jog .bad")

    def refused(pan: str, place: str = "") -> str:
        one.page.locator("#goal-pan").fill(pan)
        one.page.locator("#goal-tilt").fill("0")
        one.page.locator("#place-name").fill(place)
        button = "Keep this place" if place else "Go"
        one.page.get_by_role("button", name=button, exact=True).click()
        one.page.wait_for_selector("#jog .bad:not(:empty)")
        words = said.inner_text()
        one.page.evaluate("document.querySelector('#jog .bad').textContent = ''")
        assert not re.search(r"\brad\b|_rad|\^|\[\\|openapi", words), words
        return words

    assert "pan 120° is beyond the soft limit 114.59°" in refused("120")
    assert "2000.0° where −360° to 360° is expected" in refused("2000")
    assert "letters, digits" in refused("0", "a/b")
    with httpx.Client(base_url=f"{pair[0].url}/api/v1", trust_env=False) as http:
        told = http.post("/places/{a}", json={"pan_rad": 0.1, "tilt_rad": 0.1}).json()["error"]["message"]
    assert told.startswith('name: "{a}" where a name of 1 to 40 letters, digits')


@pytest.mark.long(
    2, "axe looks at the whole page in both schemes; the bench panel is looked at in the quick run"
)
def test_axe_finds_nothing_serious_in_dark_and_light(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url, color_scheme="dark")
    one.choose()
    one.target("preview")
    one.page.keyboard.press("p")
    one.target("ended")
    for scheme in ("dark", "light"):
        one.page.emulate_media(color_scheme=scheme)
        assert not one.serious(), scheme
