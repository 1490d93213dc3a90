"""The page's panels on fakes, and pairs: places, operations with pictures, a day of events, odd clocks."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from drivers.errors import NoReply
from drivers.interfaces import AxisReport
from hil_tests.mastctl.service_fakes import (
    FakeHardware,
    FakePointing,
    FakeResult,
    FakeStep,
    ScriptedLoop,
    fake_daemon,
)
from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.waiting import until
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.motion.results import PointingError

BOTH = tuple[RunningDaemon, FakeHardware]
Visits = Callable[..., Visit]
KEEPS_NOTHING = """Object.defineProperty(window, 'localStorage', {
  get: () => { throw new DOMException('denied', 'SecurityError'); } })"""


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[BOTH]:
    with fake_daemon(monkeypatch, tmp_path) as made:
        yield made


def looks_after(request: Any, record: Callable[[Any], None], cancelled: Any, devices: Any) -> FakeResult:
    """A pointing that ends with a picture of its own."""
    devices.move(0.1, -0.1)
    devices.read()
    frame = devices.frames(["navcam_left"], time.monotonic(), 10.0)["navcam_left"]
    record(FakeStep("measure", "done", 0.0, 0.01, {}))
    pointing = FakePointing([0.25, -0.5], [0.05, 0.06], frame.frame_id, aim_px=[31.5, 23.5])
    return FakeResult([6.0, 0.0, 0.1], 6.0, (pointing,))


def turns(request: Any, record: Callable[[Any], None], cancelled: Any, devices: Any) -> FakeResult:
    """Turns to the angles that are asked for."""
    devices.move(request.target.pan_rad, request.target.tilt_rad)
    devices.read()
    return FakeResult(None, None, ())


def test_a_place_is_kept_for_everybody_gone_to_and_forgotten(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, hardware = pair
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(turns))
    one, other = visit(daemon.url), visit(daemon.url)
    for each in (one, other):
        each.word("ready")
    with Client(daemon.url) as client:
        client.wait(client.point(pan_rad=0.2, tilt_rad=-0.1))
    one.page.wait_for_selector("#at-pan >> text=+11.46°")
    one.page.locator("#place-name").fill("chart")
    one.page.get_by_role("button", name="Keep this place").click()
    there = other.page.get_by_role("button", name="chart", exact=True)
    there.wait_for()
    other.page.locator("#home").click()
    until(lambda: hardware.head.pan_rad == 0.0, "home is 0, 0")
    until(lambda: daemon.service.operations.running is None, "it has arrived")
    there.click()
    until(lambda: hardware.head.pan_rad == 0.2, "it is there again")
    one.page.locator("#place-name").fill("Home")
    until(lambda: daemon.service.operations.running is None, "it has arrived")
    one.page.get_by_role("button", name="Keep this place").click()
    other.page.wait_for_selector("#home[title='+11.5° −5.7°']")
    one.page.get_by_role("button", name="Forget chart").click()
    there.wait_for(state="detached")


def test_an_operation_is_opened_with_its_picture_its_steps_and_who_asked(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, _ = pair
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(looks_after))
    with Client(daemon.url, name="Ana at the bench") as client:
        shot = client.snapshot("navcam_left")
        client.wait(client.point(pixel=("navcam_left", shot.frame_id, 30, 20)))
        for _ in range(20):  # more pictures than are kept of those that anybody takes
            client.snapshot("navcam_left", fresh=True)
        one = visit(daemon.url)
        one.page.locator(".operation summary").first.click()
        one.page.wait_for_selector(".operation .pictures .enlarged .vector")
        words = one.page.locator(".operation").first.inner_text()
        assert "Ana at the bench" in words and "+0.250 ± 0.050 px" in words and "Steps (1)" in words
        client.wait(client.point(pan_rad=0.0, tilt_rad=0.0))
        until(lambda: one.page.locator(".operation").count() == 2, "another one")
        assert one.page.locator(".operation[open]").count() == 1, "what is open stays open"


def test_an_operation_whose_picture_is_gone_says_so(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    with Client(daemon.url) as client:
        shot = client.snapshot("navcam_left")
        client.wait(client.point(pixel=("navcam_left", shot.frame_id, 30, 20)))
    one = visit(daemon.url)
    one.page.locator(".operation summary").first.click()
    one.page.wait_for_selector(".operation .pictures >> text=not kept any more")


def test_a_mast_file_that_is_being_chosen_stays_chosen_while_others_work(
    pair: BOTH, visit: Visits, tmp_path: Path
) -> None:
    daemon, _ = pair
    (tmp_path / "other.yaml").write_text((tmp_path / "little.yaml").read_text().replace("little", "other"))
    os.utime(tmp_path / "other.yaml", (1_700_000_000, 1_700_000_000))
    one = visit(daemon.url)
    one.word("ready")
    one.page.locator("#mast-file select").select_option("other.yaml")
    with Client(daemon.url) as client:
        client.wait(client.point(pan_rad=0.2, tilt_rad=-0.1))
    one.page.wait_for_selector(".operation")
    one.page.wait_for_timeout(1200)  # it asks at most twice a second
    assert one.page.locator("#mast-file select").input_value() == "other.yaml"
    one.page.get_by_role("button", name="Use", exact=True).click()
    one.page.get_by_role("button", name="Go back to little.yaml").click()
    one.page.wait_for_selector("#mast >> text=little.yaml")


def test_a_daemon_that_ends_is_no_longer_told_to_be_ready(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, visit: Visits
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        one = visit(daemon.url)
        one.word("ready")
    one.word("lost")
    words = one.page.locator("#state").inner_text()
    assert "no connection" in words and "last heard" in words
    one.complaints.clear()


def test_events_of_weeks_leave_no_more_than_the_newest(pair: BOTH, visit: Visits) -> None:
    """What the page keeps is bounded, however many operations and commands there were."""
    one = visit(pair[0].url)
    one.word("ready")
    kept = one.page.evaluate(
        """async () => {
          const { Events } = await import("/page/events.js");
          const { OperationList } = await import("/page/operations.js");
          const events = new Events();
          const list = new OperationList(events);
          for (let k = 0; k < 5000; k += 1) {
            const value = { id: `x${k}`, state: "done", created_s: k, request: {}, pointings: [], steps: [] };
            events.take({ topic: "operation", key: value.id, value });
            const command = { operation: value.id, who: "x", time: "2026-01-01T00:00:00Z" };
            events.take({ topic: "command", key: String(k), value: command });
          }
          list.draw();
          return [...events.known.values(), list.records, list.by, list.items].map((one) => one.size);
        }"""
    )
    assert max(kept) <= 64, kept


def test_the_browser_s_clock_does_not_matter(pair: BOTH, visit: Visits) -> None:
    """Ages come from the daemon, not from the difference of two clocks."""
    daemon, _ = pair
    one = visit(daemon.url)
    one.word("ready")
    one.page.clock.install(time="2020-01-01T00:00:00Z")
    one.page.clock.resume()
    one.page.reload()
    one.frame()
    assert one.page.evaluate("new Date().getFullYear()") == 2020
    one.page.get_by_role("button", name="Take", exact=True).click()
    one.page.get_by_role("button", name="Release", exact=True).wait_for()
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        http.post("/lease/take", json={"for_s": 60.0, "reason": "noon"}, headers={"Mastctl-Client": "Ben"})
    one.page.wait_for_selector("#control >> text=/Ben, (\\d+ s|1 min 0 s) left/")
    assert one.page.locator(".eye[data-stale]").count() == 0


def test_a_lease_that_somebody_takes_ends_the_jog_and_is_told(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url)
    one.word("ready")
    one.page.get_by_role("button", name="Take", exact=True).click()
    one.page.get_by_role("button", name="Release", exact=True).wait_for()
    one.page.locator("#pad").focus()
    one.page.keyboard.down("ArrowRight")
    until(lambda: [call for call in hardware.head.calls if call[0] == "move"], "the head turns")
    renewals: list[Any] = []
    one.page.route("**/lease/renew", lambda route: renewals.append(route))
    with httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as http:
        http.post("/lease/take", json={"for_s": 60.0, "reason": "mine"}, headers={"Mastctl-Client": "Ben"})
    one.page.wait_for_selector("#jog .warn:not(:empty)")
    until(lambda: daemon.service.operations.running is None, "the jog has ended")
    moved = len(hardware.head.calls)
    one.page.wait_for_timeout(400)
    assert len(hardware.head.calls) == moved, "a held key moves nothing more"
    one.page.wait_for_selector("#control >> text=Ben")  # before any renewal was answered
    one.page.keyboard.up("ArrowRight")
    assert renewals, "it asks at once how its lease ended"
    for renewal in renewals:
        renewal.continue_()
    one.page.wait_for_selector("#alarm >> text=You steer no longer")


def test_a_command_that_failed_is_an_alarm_until_it_was_read(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, _ = pair
    one = visit(daemon.url)
    one.word("ready")
    edge = "getComputedStyle(document.getElementById('state')).borderLeftColor"
    green = one.page.evaluate(edge)

    def stuck(*_: Any) -> FakeResult:
        raise PointingError("stuck", "pan is stuck at 0.21 rad")

    said = one.page.locator("#failed:not([hidden])")
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(stuck))
    with Client(daemon.url) as client:
        client.wait(client.point(pan_rad=0.2, tilt_rad=-0.1))
        one.page.wait_for_selector("#failed >> text=pan is stuck at 12.03°")
        one.word("ready")
        assert one.page.evaluate(edge) != green and "pan is stuck" in one.page.locator("#alarm").inner_text()
        later = visit("about:blank")
        later.page.add_init_script(KEEPS_NOTHING)
        later.url = daemon.url
        later.page.goto(daemon.url)
        later.page.wait_for_selector("#failed >> text=pan is stuck")
        monkeypatch.setattr(ScriptedLoop, "script", staticmethod(turns))
        client.wait(client.point(pan_rad=0.1, tilt_rad=-0.1))
    later.page.wait_for_selector("#failed", state="hidden")  # it came when the failure was of the past
    assert said.is_visible(), "what went well afterwards does not take it back"
    said.get_by_role("button", name="Read").click()
    assert not said.is_visible() and one.page.evaluate(edge) == green


def test_angles_of_a_head_that_is_not_read_are_told_as_of_then(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    one = visit(daemon.url, turned=True)
    one.page.wait_for_selector("#at-pan >> text=0.00°")
    assert not one.page.locator("#head-old").is_visible()

    def hook(name: str) -> None:
        raise NoReply("no answer", device="pan_tilt")

    hardware.head.hook = hook
    one.page.wait_for_selector("#faults >> text=no answer")
    one.page.clock.fast_forward(12_000)
    one.page.wait_for_selector("#head-old >> text=/Last read 1\\d s ago/")
    hardware.head.hook = lambda name: None
    one.page.wait_for_selector("#head-old", state="hidden")


def test_residuals_of_a_former_mast_file_leave_with_it(pair: BOTH, visit: Visits, tmp_path: Path) -> None:
    daemon, _ = pair
    (tmp_path / "other.yaml").write_text((tmp_path / "little.yaml").read_text().replace("little", "other"))
    one = visit(daemon.url)
    one.word("ready")
    measured = {
        "time_s": 1.0, "operation": "x", "camera": "navcam_left", "residual_px": [0.25, -0.5],
        "match_sigma_px": [0.05, 0.05], "range_m": 6.0,
    }  # fmt: skip
    body = json.dumps({"sentence": "it holds", "newest": [measured]})
    one.page.route("**/calibration/health", lambda route: route.fulfill(status=200, body=body))
    one.page.reload()
    one.page.wait_for_selector("#residuals .scatter:not([hidden])", state="attached")
    one.page.unroute("**/calibration/health")
    with Client(daemon.url) as client:
        client.use_mast("other.yaml")
    one.page.wait_for_selector("#residuals >> text=None has been measured by this mast file yet")


def test_two_tabs_of_one_browser_are_two_parties(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    one = visit(daemon.url)
    one.word("ready")
    tab = one.page.context.new_page()
    tab.goto(daemon.url)
    tab.wait_for_selector("#state[data-word=ready]")
    one.page.get_by_role("button", name="Take", exact=True).click()
    tab.get_by_role("button", name="Take over", exact=True).wait_for()
    tab.locator("#home").click()
    tab.wait_for_selector("#jog .bad:not(:empty)")
    assert "steers" in tab.locator("#jog .bad").inner_text()
    tab.close()
    one.page.get_by_role("button", name="Release", exact=True).wait_for()


def test_a_preview_that_hangs_leaves_stop_and_the_next_click(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, hardware = pair
    one = visit(daemon.url)
    frame = one.frame()
    one.page.route("**/point/preview", lambda route: None)  # it never answers
    frame.click()
    one.target("asked")
    one.page.keyboard.press("Escape")
    until(lambda: ("stop",) in hardware.head.calls, "the head was told to stop")
    one.page.wait_for_selector("#stop[data-pressed=confirmed]")
    one.page.unroute("**/point/preview")
    refused = json.dumps({"error": {"code": "x", "message": "Seen again.", "detail": None}})
    one.page.route("**/point/preview", lambda route: route.fulfill(status=409, body=refused))
    frame.click()
    one.page.wait_for_selector("#target >> text=Seen again.")


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
        client.keep_place("chart", 0.1, 0.1)  # a command: the page asks for the status again
        until(lambda: one.page.wait_for_timeout(50) or held, "the page asks")
        client.keep_place("board", 0.2, 0.1)
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
        client.forget_place("chart")
    assert True not in one.page.evaluate("window.shown"), "it was never taken back"
    assert "by Ana: sparks" in one.page.locator("#estop").inner_text()


def test_joints_temperatures_and_events_are_drawn_over_time(
    pair: BOTH, visit: Visits, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, _ = pair
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(turns))
    warm = AxisReport(None, 0, 0.0, 0, 0.0, "unknown", None, None, 41.5, None)
    monkeypatch.setattr(daemon.service.devices, "_reported", lambda: {"pan": warm})
    with Client(daemon.url, name="Ana") as client:
        client.wait(client.point(pan_rad=0.2, tilt_rad=-0.1))
        with pytest.raises(ClientError):
            client.point(pan_rad=3.0, tilt_rad=0.0)
        until(lambda: any("3 rad" in one["words"] for one in client.history()["events"]), "it is told")
    one = visit(daemon.url)
    one.page.locator("#history summary").first.click()
    drawn = one.page.locator("#history svg")
    drawn.first.wait_for()
    assert re.search(r"now pan \+11.5°, tilt −5.7°", drawn.first.get_attribute("aria-label"))
    assert "now pan +41.5 °C" in drawn.nth(1).get_attribute("aria-label")
    words = one.page.locator("#history").inner_text()
    assert "Ana: point: pan 171.89° is beyond" in words
    assert one.page.locator("#history .tick.worse").count() > 0
    assert not one.serious("#history")


def test_recordings_are_listed_fetched_and_deleted_by_two_presses(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    with Client(daemon.url) as client:
        client.start_recording("stone")
        one = visit(daemon.url)
        one.page.wait_for_selector("#recordings >> text=being written")
        assert one.page.get_by_role("button", name="Delete").count() == 0
        ended = client.stop_recording()
        file = one.page.locator(f"#recordings a[download='{Path(ended['file']).name}']")
        file.wait_for()
        with one.page.expect_download() as fetched:
            file.click()
        assert fetched.value.path().read_bytes() == Path(ended["file"]).read_bytes()
        assert fetched.value.suggested_filename == Path(ended["file"]).name
        one.page.get_by_role("button", name=f"Delete {ended['run']}").click()
        assert Path(ended["file"]).exists()
        one.page.get_by_role("button", name=f"Really delete {ended['run']}").click()
        file.wait_for(state="detached")
        assert not Path(ended["file"]).exists()
