"""A bench calibration from the page: on a program of the test, and once on the simulated bench itself."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from hil_tests.mastctl.bench.operation_world import (
    BEGUN,
    DONE,
    PROGRESS,
    answered,
    script,
    worker_pid,
    writes_files,
)
from hil_tests.mastctl.service_fakes import FakeHardware, fake_daemon
from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.waiting import present
from mastctl.client import Client
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]
Visits = Callable[..., Visit]


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
    tops = [present(one.page.locator(part).bounding_box())["y"] for part in (first, second)]
    return bool(tops[0] < tops[1])


def shown(one: Visit) -> str:
    return str(one.page.locator("#bench").inner_text())


def test_stop_ends_it_says_so_and_it_goes_on_from_there(pair: BOTH, visit: Visits) -> None:
    daemon, hardware = pair
    bench = daemon.service.bench
    bench.work = script(BEGUN, PROGRESS, answered)
    one = visit(daemon.url)
    begin(one)
    one.page.wait_for_selector(".curve")
    pid = worker_pid()
    assert pid is not None
    one.page.locator("#bench").press("Escape")
    one.page.wait_for_selector(".bench-verdict:has-text('the head was stopped by')")
    assert any(call[0] == "stop" for call in hardware.head.calls)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    (kept,) = bench.runs.all()
    next_words = one.page.locator(".bench-next").inner_text()
    assert f"are kept in {kept.path}: 3 pictures a camera" in next_words
    assert "Go on continues" in next_words and "Begin another starts anew" in next_words
    assert not one.page.locator(".bench-place").is_visible(), "no board is requested"
    assert not one.page.locator(".bench-steps").is_visible(), "no step is ticked that was not taken"
    bench.work = script(BEGUN, writes_files, DONE)
    one.page.click("#bench button:has-text('Go on')")
    one.page.wait_for_selector(".bench-grade")
    assert not one.page.locator(".bench-next").is_visible()
    assert len(bench.runs.all()) == 1, "the same run"


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
