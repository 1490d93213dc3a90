"""The operator page in a real browser, on fakes: what is always in sight, STOP, control, old images, jog."""

from __future__ import annotations

import json
import math
import re
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import (
    FakeHardware,
    ScriptedLoop,
    fake_daemon,
)
from hil_tests.mastctl.web.network import network_daemon
from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.waiting import NET_S, until
from mastctl.as_json import as_json
from mastctl.client import Client
from mastctl.control.lease import Caller
from mastctl.daemon import RunningDaemon
from mastctl.web.page import PAGE_FOLDER

BOTH = tuple[RunningDaemon, FakeHardware]
Visits = Callable[..., Visit]
SEEN = as_json(
    {
        "camera": "navcam_left", "frame_id": "a", "pixel_px": (32.0, 24.0), "position_m": (6.0, 0.5, 0.1),
        "range_m": 6.02, "range_from": "stereo", "range_interval_m": None, "goal_rad": (0.1, -0.1),
        "aim": {"camera": "navcam_left", "x_px": 31.5, "y_px": 23.5}, "refused": None,
        "other_camera": "navcam_right", "other_frame_id": "b", "other_pixel_px": (30.0, 24.0),
        "other_sigma_px": (0.05, 0.05), "correlation": 0.97, "second": 0.4, "across_px": 0.02,
        "sigma_m": (0.03, 0.01, 0.01), "covariance_m2": None, "range_sigma_m": 0.031,
    }
)  # fmt: skip


class Previewing(ScriptedLoop):
    """A scripted loop that sees what is clicked."""

    def preview(self, request: Any) -> Any:
        return SEEN


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[BOTH]:
    with fake_daemon(monkeypatch, tmp_path, loop=Previewing) as made:
        yield made


def test_the_page_comes_compressed_and_is_kept_by_the_browser(pair: BOTH, visit: Visits) -> None:
    one = visit(pair[0].url)
    one.word("ready")
    one.page.goto(pair[0].url)
    one.word("ready")  # of what the browser has kept
    with httpx.Client(base_url=pair[0].url, trust_env=False) as http:
        page = http.get("/")
        files = re.findall(r'"(/page/[a-z]+\.(?:js|css))"', page.text)
        assert len(files) >= 6
        for path in ("/", *files):
            whole = http.get(path)
            assert whole.headers["cache-control"] == "no-cache"
            assert path == "/" or whole.headers["content-encoding"] == "gzip"
            again = http.get(path, headers={"If-None-Match": whole.headers["etag"]})
            assert (again.status_code, again.content) == (304, b"")
            policies = {one.headers["content-security-policy"] for one in (whole, again)}
            assert len(policies) == 1, "a browser takes it from the newest answer"
            (policy,) = policies
            assert "default-src" in policy and "unsafe" not in policy
        assert http.get("/api/v1/status").headers["cache-control"] == "no-store"


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


def test_stop_works_before_any_module_of_the_page_has_come(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit("about:blank")
    one.url = daemon.url
    modules = {one.name for one in PAGE_FOLDER.glob("*.js")} - {"stop.js", "scheme.js"}
    for name in modules:
        one.page.route(f"**/{name}", lambda route: None)  # on a slow link they come seconds later
    one.page.goto(daemon.url, wait_until="commit")
    stop = one.page.get_by_role("button", name="STOP", exact=True)
    stop.click()
    until(lambda: ("stop",) in hardware.head.calls, "the head stops")
    one.page.wait_for_selector("#stop[data-pressed=confirmed]")
    one.page.keyboard.press("Escape")
    until(lambda: hardware.head.calls.count(("stop",)) > 1, "Escape stops the head")
    one.page.locator("#latch").click()
    until(lambda: Client(daemon.url).status()["estop"], "E-STOP latches")


def test_commands_not_yet_sent_at_a_stop_are_never_sent(
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
        client.request("POST", "/places/chart", pan_rad=0.1, tilt_rad=0.1)
        one.page.get_by_role("button", name="chart", exact=True).wait_for()
        assert said.is_visible(), "another command confirms no stop"
        client.stop()
    said.wait_for(state="hidden")


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


def test_what_was_chosen_before_a_stop_a_turn_or_a_takeover_is_never_sent(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url)
    ben = {"Mastctl-Client": "Ben"}
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False, headers=ben) as http:

        def released() -> None:
            one.page.wait_for_selector("#latch[aria-pressed=true]")
            http.post("/reset", json={"reason": "mended", "name": "Ben"}).raise_for_status()

        def latched_here() -> None:
            one.page.locator("#latch").click()
            released()

        def latched_elsewhere() -> None:
            http.post("/estop")
            released()

        def taken() -> None:
            lease = http.post("/lease", json={"for_s": 60.0}).json()["lease_id"]
            one.page.wait_for_selector("#control >> text=Ben")
            http.delete("/lease", headers={"Mastctl-Lease": lease}).raise_for_status()

        comings: dict[str, Callable[[], Any]] = {
            "STOP was pressed": lambda: one.page.keyboard.press("Escape"),
            "E-STOP was pressed": latched_here,
            "The head was stopped": lambda: http.post("/stop"),
            "stopped|emergency stop was pressed": latched_elsewhere,
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


def test_an_answer_from_before_a_stop_does_not_take_it_back(pair: BOTH, visit: Visits) -> None:
    """What is pushed is newer than a status that was asked for before it and comes after it."""
    daemon, _ = pair
    one = visit(daemon.url)
    one.word("ready")
    held: list[Any] = []
    asked: list[Any] = []

    def hold(route: Any) -> None:
        asked.append(route)
        if held:
            route.continue_()
        else:
            held.append((route, route.fetch()))

    one.page.route("**/api/v1/status", hold)
    with Client(daemon.url) as client:
        client.request(
            "POST", "/places/chart", pan_rad=0.1, tilt_rad=0.1
        )  # a command: the page asks for the status again
        until(lambda: one.page.title() and held, "the page requests it")
        client.request("POST", "/places/board", pan_rad=0.2, tilt_rad=0.1)
        one.page.wait_for_timeout(1500)
        assert len(asked) == 1, "one question at a time"
        client.estop(name="Ana", reason="sparks")
    one.word("stopped")
    one.page.evaluate(
        """() => {
          window.shown = [];
          const place = document.getElementById("estop");
          new MutationObserver(() => window.shown.push(place.hidden)).observe(place, { attributes: true });
        }"""
    )
    route, answer = held[0]
    with one.page.expect_response("**/api/v1/status"):  # the next one, of after the stop
        route.fulfill(response=answer)
    with one.page.expect_response("**/api/v1/status"), Client(daemon.url) as client:
        client.request("DELETE", "/places/chart")
    assert True not in one.page.evaluate("window.shown"), "it was never taken back"
    assert "by Ana: sparks" in one.page.locator("#estop").inner_text()


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
