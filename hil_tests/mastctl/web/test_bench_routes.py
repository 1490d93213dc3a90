"""Bench calibrations and reports over HTTP: who may, when not, and that nothing moves after a stop."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.bench.operation_world import (
    BEGUN,
    DONE,
    PLACE,
    answered,
    script,
    writes_files,
)
from hil_tests.mastctl.service_fakes import HTTP, FakeHardware, ScriptedLoop
from hil_tests.mastctl.web.network import network_daemon
from hil_tests.waiting import NET_S, until
from mastctl.answers import BenchRunRecord
from mastctl.bench.runs import BenchJob
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon

Pair = tuple[RunningDaemon, FakeHardware]


def steers(job: BenchJob) -> Client:
    """A client as the real worker has it."""
    client = Client(job.url, name="bench calibration", token=job.token)
    client.use_lease(job.lease_id)
    return client


def points(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    client = steers(job)
    client.wait(client.point(pan_rad=0.2, tilt_rad=0.1))
    return {}


def never_gives_up(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    client, k = steers(job), 0
    while True:
        k += 1
        with suppress(ClientError):
            client.wait(client.point(pan_rad=0.01 * (k % 50), tilt_rad=0.0))


def says_its_session(job: BenchJob, link: Connection) -> Mapping[str, Any]:
    """Its token backwards: sentences are kept, and the token must not be."""
    session = steers(job).request("GET", "/session")
    assert job.token is not None
    return {"sentences": [json.dumps([session["name"], session["role"], job.token[::-1]])]}


def ended(daemon: RunningDaemon) -> BenchRunRecord:
    def over() -> BenchRunRecord | None:
        run = daemon.service.bench.run
        return run if run is not None and run["step"] == "over" else None

    run = until(over, "the run is over")
    assert run is not None
    return run


def refused(code: str, act: Callable[[], object]) -> ClientError:
    with pytest.raises(ClientError) as refusal:
        act()
    assert refusal.value.code == code, refusal.value
    return refusal.value


@pytest.fixture
def ana(pair: Pair) -> Iterator[Client]:
    with Client(pair[0].url, name="Ana") as client:
        yield client


@pytest.fixture
def bo(pair: Pair) -> Iterator[Client]:
    with Client(pair[0].url, name="Bo") as client:
        yield client


def test_a_bench_run_takes_the_lease_of_the_client_that_begins_it(
    pair: Pair, ana: Client, bo: Client
) -> None:
    daemon, hardware = pair
    daemon.service.bench.work = script(BEGUN, points, PLACE, answered, DONE)
    lease = ana.acquire_lease()
    ana.use_lease(lease["lease_id"])
    run = ana.begin_bench("charuco_a3", wanted_px=0.3, pictures=20)
    assert (run["by"], run["state"], run["most"]) == ("Ana", "running", 20)
    assert "Ana began it" in str(refused("lease_over", lambda: ana.request("POST", "/lease/renew")))
    ana.use_lease(None)
    for client in (ana, bo):
        told = refused("leased", partial(client.point, pan_rad=0.0, tilt_rad=0.0))
        assert told.detail is not None and told.detail["holder"] == "bench calibration"
        refused("leased", partial(client.begin_bench, "charuco_a3"))
    for event in bo.events("bench"):
        value: Any = event["value"]
        if value["state"] == "waiting":
            break
    assert any(call[0] == "move" for call in hardware.head.calls), "the program steered"
    assert bo.board_stands()["name"] == run["name"]
    over = ended(daemon)
    assert over["state"] == "done" and over["mast_file"] is not None
    assert bo.control() is None and bo.bench()["runs"][0]["by"] == "Ana"
    refused("bench_idle", bo.board_stands)
    refused("bench_idle", bo.leave_bench)
    assert ana.point(pan_rad=0.0, tilt_rad=0.0)


def test_no_bench_run_begins_while_steered_busy_or_latched(
    pair: Pair, ana: Client, bo: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, _ = pair
    daemon.service.bench.work = script(BEGUN)
    with bo.lease():
        refused("leased", lambda: ana.begin_bench("charuco_a3"))
    resume = threading.Event()

    def waits(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> Any:
        resume.wait(NET_S)
        return ScriptedLoop.good(request, record, cancelled, devices)

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    running = ana.point(pan_rad=0.1, tilt_rad=0.0)
    refused("busy", lambda: ana.begin_bench("charuco_a3"))
    resume.set()
    ana.wait(running)
    ana.estop(name="Ana", reason="a hand")
    refused("estopped", lambda: ana.begin_bench("charuco_a3"))
    assert ana.bench()["runs"] == [] and ana.bench()["run"] is None
    ana.reset(name="Ana", reason="away")


@pytest.mark.parametrize("how", ["stop", "leave"])
def test_nothing_moves_after_a_stop_though_the_program_never_gives_up(
    pair: Pair, ana: Client, how: str
) -> None:
    """It takes no notice of refusals: between two of its moves the stop finds nothing that it could end."""
    daemon, hardware = pair
    daemon.service.bench.work = script(BEGUN, never_gives_up)
    for _ in range(2):
        ana.begin_bench("charuco_a3")
        before = len(hardware.head.calls)
        until(lambda: len(hardware.head.calls) > before + 6, "it moves the head")  # noqa: B023
        if how == "leave":
            assert ana.leave_bench()["state"] == "interrupted"
        else:
            ana.stop()
        run = ended(daemon)
        assert run["code"] == ("left" if how == "leave" else "stopped"), run["sentence"]
        until(lambda: daemon.service.operations.running is None, "nothing runs")
        moves = [call for call in hardware.head.calls if call[0] == "move"]
        newest = ana.operations()[0]["id"]
        threading.Event().wait(0.3)
        assert [call for call in hardware.head.calls if call[0] == "move"] == moves
        assert ana.operations()[0]["id"] == newest and ana.control() is None


def test_a_board_file_is_judged_and_kept(pair: Pair, ana: Client) -> None:
    daemon, _ = pair
    daemon.service.bench.work = script(BEGUN, DONE)
    refused("bad_board", lambda: ana.begin_bench(board_file="kind: [charuco"))
    text = "schema: mastctl/board/1\nkind: charuco\ncolumns: 9\nrows: 6\nsquare_m: 0.03\n"
    text += "marker_m: 0.022\ndictionary: DICT_5X5_100\n# printed on a Tuesday\n"
    run = ana.begin_bench(board_file=text)
    folder = Path(ana.bench()["folder"]) / run["name"]
    assert (folder / "board.yaml").read_text() == text
    ended(daemon)


def test_a_bench_program_has_a_token_that_ends_with_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with network_daemon(monkeypatch, tmp_path) as net:
        net.daemon.service.bench.work = script(BEGUN, says_its_session, PLACE, answered)
        for path, code in (("/bench", 200), ("/reports/20260101-000000", 404)):
            assert net.ask("GET", path).status_code == 401
            assert net.ask("GET", path, "view").status_code == code
        for path in ("/bench", "/bench/stands", "/bench/leave"):
            assert net.ask("POST", path, "view", json={}).status_code == 403
        assert net.ask("POST", "/bench", "operate", json={"board": "charuco_a4"}).status_code == 202
        bench = net.daemon.service.bench
        until(lambda: bench.run and bench.run["state"] == "waiting", "it came in")
        assert bench.run is not None
        name, role, backwards = json.loads(bench.run["sentences"][0])
        token = backwards[::-1]
        assert (name, role) == ("bench calibration/bench calibration", "operate")
        shown = {"Authorization": f"Bearer {token}"}
        assert net.ask("GET", "/status", headers=shown).status_code == 200
        assert net.ask("POST", "/bench/leave", "operate", json={}).status_code == 200
        assert net.ask("GET", "/status", headers=shown).status_code == 401
        assert token not in (tmp_path / "daemon.yaml").read_text()
        for file in net.daemon.service.folder.path.rglob("*"):
            assert not file.is_file() or token.encode() not in file.read_bytes(), file


# Reports


def test_a_run_has_a_report_that_is_read_and_can_do_nothing(pair: Pair, ana: Client) -> None:
    daemon, _ = pair
    daemon.service.bench.work = script(BEGUN, writes_files, DONE)
    name = ana.begin_bench("charuco_a3")["name"]
    assert ended(daemon)["report"] == name
    answer = HTTP.get(f"{daemon.url}/api/v1/reports/{name}")
    assert answer.content == ana.report(name) and "<h1>Residuals</h1>" in answer.text
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    policy = answer.headers["content-security-policy"].split("; ")
    assert "default-src 'none'" in policy and "sandbox" in policy and "frame-ancestors 'none'" in policy
    assert not any("script" in one or "allow" in one for one in policy)
    assert (
        answer.headers["x-content-type-options"] == "nosniff" and answer.headers["x-frame-options"] == "DENY"
    )
    page = HTTP.get(daemon.url).headers["content-security-policy"]
    assert "unsafe" not in page and "sandbox" not in page
    refused("bench_unknown", lambda: ana.report("20260101-000000"))


@pytest.mark.parametrize(
    "name", ["..", "..%2fdaemon.json", "..%5cdaemon.json", "%00", "arm", "%2fetc%2fpasswd"]
)
def test_what_is_no_run_has_no_report_whatever_its_name(standing: Pair, name: str) -> None:
    answer = HTTP.get(f"{standing[0].url}/api/v1/reports/{name}")
    assert answer.status_code in (404, 422) or (name.endswith("/") and answer.status_code == 307)
