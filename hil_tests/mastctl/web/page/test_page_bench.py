"""A bench calibration from the page: on a program of the test, and once on the simulated bench itself."""

from __future__ import annotations

import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from hil_tests.mastctl.guided.guided_world import BEGUN, DONE, PLACE, PROGRESS, lines
from hil_tests.mastctl.service_fakes import FakeHardware, fake_daemon
from hil_tests.mastctl.web.network import network_daemon
from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.mastctl.web.test_bench_routes import scripted
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]
Visits = Callable[..., Visit]

STANDS = {"event": "stands", "name": "p1"}
SECOND = {**PLACE, "name": "p2", "bearing_deg": 50.0, "description": "50 degrees right"}
SAID = {"event": "said", "sentence": "pointed at corner 7: residual -0.01, 0.02 px"}
ENDS = (
    "import shutil\nshutil.copy(os.path.join(os.path.dirname(MAST), 'little.yaml'), MAST)\n"
    "os.mkdir(REPORT)\nopen(os.path.join(REPORT, 'bench.html'), 'w').write("
    "'<title>Bench</title><h1>Residuals</h1><script>document.title = 1</script>')\n"
)
HALF_SEEN = {**PROGRESS, "pictures": 7, "predicted_px": 0.9, "cells": {"navcam_left": [0] * 24 + [9] * 24}}
WHOLE = (
    lines(BEGUN, PLACE) + "answered()\n" + lines(STANDS, {"event": "step", "step": "pictures"}, PROGRESS)
    + lines(HALF_SEEN, SECOND) + "answered()\n" + lines(STANDS, SAID) + ENDS + lines(DONE)
)  # fmt: skip
AT_WORK = lines(BEGUN, PROGRESS) + "time.sleep(60)\n"


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[BOTH]:
    with fake_daemon(monkeypatch, tmp_path) as made:
        yield made


def begin(one: Visit, board: str = "charuco_a3") -> None:
    """Begin one by the form."""
    opened(one)
    one.page.select_option(".bench-form select", board)
    one.page.click(".bench-form button[type=submit]")


def opened(one: Visit) -> None:
    """Open the form, which is closed at first."""
    one.word("ready")
    if not one.page.locator(".bench-form").is_visible():
        one.page.click("#bench > details:first-child > summary")


def above(one: Visit, first: str, second: str) -> bool:
    """Whether a part of the page begins above another one."""
    tops = [one.page.locator(part).bounding_box()["y"] for part in (first, second)]
    return bool(tops[0] < tops[1])


def shown(one: Visit) -> str:
    return str(one.page.locator("#bench").inner_text())


def test_from_the_button_over_two_placements_to_the_verdict_its_report_and_its_mast_file(
    pair: BOTH, visit: Visits
) -> None:
    daemon, _ = pair
    scripted(daemon, WHOLE)
    one, other = visit(daemon.url), visit(daemon.url, viewport={"width": 820, "height": 1180}, has_touch=True)
    for each in (one, other):
        each.word("ready")
        assert above(each, ".panel.last", ".panel.bench"), "it is below the rest until one runs"
    begin(one)
    for each in (one, other):
        each.page.wait_for_selector(".bench-place[data-asking=true]")
        assert above(each, ".images", ".panel.bench") and above(each, ".panel.bench", ".panel.last")
        assert "put the board straight ahead. It need not be exact" in shown(each)
        assert each.page.locator(".sketches svg[role=img]").count() == 2
    assert one.page.locator(".bench-steps [aria-current=step]").inner_text().startswith("Place the board")
    assert "bench calibration" in one.page.locator("#control").inner_text()
    one.page.click(".stands")
    one.page.wait_for_selector(".bench-words:has-text('50 degrees right')")
    assert "navcam left 50 % seen" in shown(one).replace("\n", " ")
    assert "0.90 px after 7 pictures" in (one.page.locator(".curve").get_attribute("aria-label") or "")
    assert "pan +17°, tilt −6°: to 3.70 px" in shown(one)
    other.page.tap(".stands")
    for each in (one, other):
        each.page.wait_for_selector(".bench-grade")
        words = re.sub(r"\s+", " ", shown(each))
        assert "Trust it" in words and "navcam left 0.050, 0.060 0.070, 0.080 0.090" in words
        assert "pointing at 2 corners 0.100, 0.200 0.150" in words
    with one.page.context.expect_page() as opened:
        one.page.click(".bench-verdict .report-link")
    report = opened.value
    report.wait_for_load_state()
    assert report.locator("h1").inner_text() == "Residuals" and report.title() == "Bench", "no script ran"
    run = daemon.service.guide.run
    assert run is not None
    before = daemon.service.masts.in_use.path.name
    assert before == "little.yaml", "nothing came into use by itself"
    one.page.click("#bench-use")
    one.page.wait_for_selector("#bench-use:disabled")
    assert daemon.service.masts.in_use.path.name == run.mast_file
    one.page.click("#mast-file button:has-text('Go back')")
    until(lambda: daemon.service.masts.in_use.path.name == before, "the former one is in use again")
    assert run.name in one.page.locator("#reports").inner_text()


@pytest.mark.parametrize("how", ["escape", "button"])
def test_stop_ends_it_says_so_and_it_goes_on_from_there(pair: BOTH, visit: Visits, how: str) -> None:
    daemon, hardware = pair
    scripted(daemon, AT_WORK)
    one = visit(daemon.url)
    begin(one)
    one.page.wait_for_selector(".curve")
    work = daemon.service.guide._work
    assert work is not None and work.child is not None
    if how == "escape":
        one.page.locator("#bench").press("Escape")
    else:
        one.page.locator("#stop").dispatch_event("pointerdown", {"button": 0})
    one.page.wait_for_selector(".bench-verdict:has-text('pressed stop; the head stands still')")
    assert any(call[0] == "stop" for call in hardware.head.calls)
    with pytest.raises(ProcessLookupError):
        os.kill(work.child.pid, 0)
    (kept,) = daemon.service.guide.runs.all()
    next_words = one.page.locator(".bench-next").inner_text()
    assert f"are kept in {kept.path}: 3 pictures a camera" in next_words
    assert "Go on continues" in next_words and "Begin another starts anew" in next_words
    assert not one.page.locator(".bench-place").is_visible(), "no board is asked for"
    assert not one.page.locator(".bench-steps").is_visible(), "no step is ticked that was not taken"
    scripted(daemon, lines(BEGUN) + ENDS + lines(DONE))
    one.page.click("#bench button:has-text('Go on')")
    one.page.wait_for_selector(".bench-grade")
    assert not one.page.locator(".bench-next").is_visible()
    assert len(daemon.service.guide.runs.all()) == 1, "the same run"


def test_a_program_that_is_killed_is_told_and_another_steers_until_it_goes_on(
    pair: BOTH, visit: Visits
) -> None:
    daemon, _ = pair
    scripted(daemon, AT_WORK)
    one = visit(daemon.url)
    begin(one)
    one.page.wait_for_selector(".curve")
    work = daemon.service.guide._work
    assert work is not None and work.child is not None
    os.kill(work.child.pid, signal.SIGKILL)
    one.page.wait_for_selector(".bench-verdict:has-text('was ended by SIGKILL')")
    with Client(daemon.url, name="Bo") as bo, bo.lease(name="Bo"):
        one.page.click("#bench button:has-text('Go on')")
        one.page.wait_for_selector("#bench > .bad:has-text('Bo steers')")
    scripted(daemon, lines(BEGUN) + ENDS + lines(DONE))
    one.page.click("#bench button:has-text('Go on')")
    one.page.wait_for_selector(".bench-grade")


def test_a_run_that_its_daemon_cut_off_is_told_with_what_to_do_next(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    scripted(daemon, AT_WORK)
    one = visit(daemon.url)
    begin(one)
    one.page.click("#bench button:has-text('End it for now')")
    one.page.wait_for_selector(".bench-next")
    daemon.service.guide._work = None  # as another daemon, which only finds its folder
    one.page.reload()
    one.page.wait_for_selector(".bench-runs[open] summary:has-text('interrupted: go on with it')")
    scripted(daemon, lines(BEGUN) + ENDS + lines(DONE))
    one.page.click(".bench-runs button:has-text('Go on')")
    one.page.wait_for_selector(".bench-grade")
    assert len(daemon.service.guide.runs.all()) == 1, "the same run"


def test_who_had_the_lease_steers_no_longer_and_is_not_alarmed(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    scripted(daemon, AT_WORK)
    one = visit(daemon.url)
    one.word("ready")
    one.page.click("#take")
    one.page.wait_for_selector("#control:has-text('you')")
    begin(one)
    one.page.wait_for_selector(".curve")
    one.page.wait_for_selector("#control:has-text('bench calibration')")
    one.page.click("#bench button:has-text('End it for now')")
    one.page.wait_for_selector(".bench-verdict:has-text('ended the run')")
    one.page.wait_for_selector("#control:has-text('nobody')")
    assert "steer no longer" not in one.page.locator("body").inner_text()


def test_a_page_that_comes_later_sees_all_of_it_and_a_viewer_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, visit: Visits
) -> None:
    with network_daemon(monkeypatch, tmp_path) as net:
        scripted(net.daemon, lines(BEGUN, PROGRESS, PLACE) + "answered()\n")
        assert net.ask("POST", "/bench", "operate", json={"board": "charuco_a4"}).status_code == 202
        one = visit(net.url)
        one.page.fill("#token", net.token("view"))
        one.page.press("#token", "Enter")
        one.page.wait_for_selector(".bench-place[data-asking=true]")
        assert one.page.locator(".stands").is_disabled()
        assert one.page.locator("#bench button:has-text('End it for now')").is_disabled()
        assert one.page.locator(".coverage").count() == 1
        assert "1. place the board" not in one.page.locator("#alarm").inner_text().lower()


def test_a_board_of_ones_own_is_chosen_by_its_file_and_a_bad_one_is_told_with_its_place(
    pair: BOTH, visit: Visits, tmp_path: Path, repository: Path
) -> None:
    daemon, _ = pair
    scripted(daemon, AT_WORK)
    one = visit(daemon.url)
    begin(one, "")
    one.page.wait_for_selector("#bench > .bad:has-text('BOARD.yaml')")
    bad = tmp_path / "bad.yaml"
    bad.write_text("schema: mastctl/board/1\nkind: charuco\ncolumns: 9\n")
    one.page.set_input_files(".bench-form input[type=file]", str(bad))
    one.page.click(".bench-form button[type=submit]")
    one.page.wait_for_selector("#bench > .bad:has-text('rows')")
    assert daemon.service.guide.run is None
    one.page.set_input_files(
        ".bench-form input[type=file]", str(repository / "configs/boards/charuco_a2.yaml")
    )
    one.page.click(".bench-form button[type=submit]")
    one.page.wait_for_selector(".curve")


def test_an_earlier_run_is_removed_by_a_second_press_and_its_size_was_told(pair: BOTH, visit: Visits) -> None:
    daemon, _ = pair
    scripted(daemon, AT_WORK)
    one = visit(daemon.url)
    begin(one)
    one.page.click("#bench button:has-text('End it for now')")
    one.page.wait_for_selector(".bench-verdict:has-text('ended the run')")
    one.page.click("#bench button:has-text('Begin another')")
    one.page.click(".bench-runs summary")
    assert "0 pictures, 0 MB" in one.page.locator(".bench-runs").inner_text()
    one.page.click(".bench-runs button:has-text('Remove')")
    assert len(daemon.service.guide.runs.all()) == 1, "one press removes nothing"
    one.page.click(".bench-runs button:has-text('Really remove')")
    until(lambda: not daemon.service.guide.runs.all(), "the run is gone")
    one.page.wait_for_selector(".bench-runs", state="hidden")


def test_it_goes_by_the_keyboard_alone_and_axe_finds_nothing_serious_in_dark_and_light(
    pair: BOTH, visit: Visits
) -> None:
    daemon, _ = pair
    scripted(daemon, WHOLE)
    one = visit(daemon.url)
    one.word("ready")
    one.page.locator("#bench > details:first-child > summary").focus()
    one.page.keyboard.press("Enter")
    one.page.locator(".bench-form select").focus()
    one.page.keyboard.type("ChArUco, A3")
    for there in (
        ".bench-words:has-text('straight ahead')",
        ".bench-words:has-text('50 deg')",
        ".bench-grade",
    ):
        _serious(one)
        one.page.locator(".bench-form button[type=submit], .stands").locator("visible=true").first.focus()
        one.page.keyboard.press("Enter")
        one.page.wait_for_selector(there)
    _serious(one)
    assert one.page.locator("#said").inner_text() == "Bench calibration: verdict: trust it."


def _serious(one: Visit) -> None:
    for scheme in ("dark", "light"):
        one.page.emulate_media(color_scheme=scheme)
        assert not one.serious("#bench"), scheme


@pytest.mark.long(
    3, "draws the whole bench at full speed, some 40 s; its parts are tested above on a program"
)
def test_a_simulated_bench_is_calibrated_from_the_button_to_the_verdict(
    repository: Path, tmp_path: Path, visit: Visits
) -> None:
    """The program itself, while the page watches both cameras."""
    shutil.copy(repository / "configs/masts/bench_drawing.yaml", tmp_path)
    config = load_config(repository / "configs/bench.yaml")
    simulation = {**config.hardware.simulation, "speed": "max", "samples": 1}
    config = replace(
        config,
        mast_file=tmp_path / "bench_drawing.yaml",
        listen=Listen(port=0),
        state_folder=tmp_path / "state",
        hardware=replace(config.hardware, simulation=simulation),
    )
    with RunningDaemon(config) as daemon:
        one = visit(daemon.url)
        one.page.context.set_default_timeout(540_000)
        opened(one)
        wanted, pictures = one.page.locator(".bench-form input[type=number]").all()
        wanted.fill("5")
        pictures.fill("12")
        one.page.click(".bench-form button[type=submit]")
        one.page.wait_for_selector(".curve .line")
        one.page.wait_for_selector(".coverage:has-text('navcam right')")
        one.page.wait_for_selector(".bench-grade")
        words = shown(one)
        assert re.search("Trust it|Use it with care", words), words
        rows = one.page.locator(".residual-table tr").all_inner_texts()
        assert len(rows) == 4 and all(re.search(r"\d\.\d{3}", row) for row in rows[1:]), rows
        one.page.click("#bench-use")
        one.page.wait_for_selector("#bench-use:disabled")
        with Client(daemon.url, name="Bo") as bo:
            assert b"method: bench" in bo.mast_file()
