"""A bench calibration by a worker beside the daemon: what it sends, how it ends, and what it never does."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from hil_tests.mastctl.bench.operation_world import (
    BEGUN,
    DONE,
    PLACE,
    PROGRESS,
    Step,
    answered,
    gives_up,
    killed,
    says_folder,
    says_lease_and_token,
    script,
    worker_pid,
    world,
    writes_files,
)
from hil_tests.waiting import present, until
from mastctl.control.lease import Caller
from mastctl.errors import NotKnown, NotNow

BO = Caller("Bo", "operate")


def gone(pid: int | None) -> bool:
    assert pid is not None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


def test_a_run_is_followed_over_a_placement_to_its_verdict(tmp_path: Path) -> None:
    with world(tmp_path, script(BEGUN, PLACE, answered, PROGRESS, writes_files, DONE)) as made:
        begun = made.begin(wanted_px=0.5)
        assert (begun["state"], begun["by"], begun["wanted_px"]) == ("running", "Ana", 0.5)
        requested = made.until("waiting")["requested"]
        assert requested is not None and requested["turned_deg"] == [20.0, 0.0]
        assert requested["needs_confirmation"]
        assert present(made.leases.control())["holder"] == "bench calibration"
        made.bench.stands()
        run = made.until("done")
        assert made.leases.control() is None and made.lent == []
        assert run["curve"] == [[3, 6.2]] and run["cameras"]["navcam_left"]["cells"] == [2] * 48
        assert run["result"] is not None and run["result"]["verdict"]["words"] == "trust it"
        assert run["mast_file"] == f"bench-{run['name']}.yaml" and run["report"] == run["name"]
        until(lambda: made.published and made.published[-1]["state"] == "done", "the end is published")
        (listed,) = made.bench.answer()["runs"]
        assert (listed["state"], listed["grade"], listed["mast_file"]) == ("done", "good", run["mast_file"])
        with pytest.raises(NotNow, match="has its verdict"):
            made.begin(board=None, resume=run["name"])


def test_the_worker_gets_lease_and_token_but_not_on_its_command_line(tmp_path: Path) -> None:
    with world(tmp_path, script(BEGUN, says_lease_and_token, PLACE, answered)) as made:
        made.begin()
        (said,) = made.until("waiting")["sentences"]
        token, lease_id = said.split()
        assert token == "secret-of-the-worker" and made.leases.holds(lease_id)
        shown = Path(f"/proc/{worker_pid()}/cmdline").read_bytes().decode()
        assert "secret" not in shown and lease_id not in shown


@pytest.mark.parametrize(
    ("end", "how"), [(killed, "was ended by signal 9 (Killed)"), (gives_up, "ended with exit code 7")]
)
def test_a_worker_that_dies_is_reported_and_frees_the_lease(tmp_path: Path, end: Step, how: str) -> None:
    with world(tmp_path, script(BEGUN, end)) as made:
        made.begin()
        pid = worker_pid()
        run = made.until("interrupted")
        assert run["code"] == "program_ended" and how in run["sentence"] and "can go on" in run["sentence"]
        assert gone(pid) and made.leases.control() is None and made.lent == []


def test_a_stop_ends_the_run_and_takes_its_right_to_steer_at_once(tmp_path: Path) -> None:
    with world(tmp_path, script(BEGUN, says_lease_and_token, PROGRESS, answered)) as made:
        made.begin()
        until(lambda: made.bench.run and made.bench.run["pictures"] == 3, "it is at work")
        pid, run = worker_pid(), made.bench.run
        assert run is not None
        lease_id = run["sentences"][0].split()[1]
        with made.leases.steering(BO, lease_id):
            pass
        made.leases.stop_came("the head was stopped by Bo")
        with pytest.raises(NotNow, match="the head was stopped by Bo"), made.leases.steering(BO, lease_id):
            pass
        run = made.until("interrupted")
        assert run["code"] == "stopped" and gone(pid) and made.leases.control() is None
        assert run["sentence"].startswith("the head was stopped by Bo; everything seen is kept")


def test_a_stop_while_the_board_is_placed_ends_the_run_too(tmp_path: Path) -> None:
    with world(tmp_path, script(BEGUN, PLACE, answered)) as made:
        made.begin()
        made.until("waiting")
        made.leases.stop_came("the head was stopped by Bo")
        assert made.until("interrupted")["code"] == "stopped"
        with pytest.raises(NotNow, match="no bench calibration is at work"):
            made.bench.stands()


def test_a_run_is_removed_with_all_it_saw_but_not_while_it_is_at_work(tmp_path: Path) -> None:
    with world(tmp_path, script(BEGUN, answered)) as made:
        made.begin()
        folder = made.bench.runs.all()[0]
        (folder.seen / "images").mkdir(parents=True)
        (folder.seen / "images" / "0-p1-navcam_left.png").write_bytes(bytes(3_000_000))
        with pytest.raises(NotNow, match="is at work"):
            made.bench.forget(folder.name)
        made.bench.leave("Ana")
        (listed,) = made.bench.answer()["runs"]
        assert listed["size_mb"] == pytest.approx(3.0) and listed["pictures"] == 1
        with pytest.raises(NotKnown, match="there is no run"):
            made.bench.forget("20260101-000000")
        assert made.bench.forget(folder.name)["runs"] == []
        assert list(made.bench.runs.folder.iterdir()) == []


def test_a_client_that_takes_over_ends_the_run(tmp_path: Path) -> None:
    with world(tmp_path, script(BEGUN, answered)) as made:
        made.begin()
        lease = made.leases.take(BO, "I need it")
        made.stops.running = "000003-now-of-Bo"
        run = made.until("interrupted")
        assert run["code"] == "taken" and "Bo took over: I need it" in run["sentence"]
        assert made.leases.holds(lease.id), "the new holder's lease is let alone"
        assert made.stops.running is not None


def test_a_run_that_is_left_goes_on_from_its_folder(tmp_path: Path) -> None:
    with world(tmp_path, script(BEGUN, says_folder, PLACE, answered)) as made:
        first = made.begin(pictures=33, by_hand=True)
        run = made.until("waiting")
        with made.leases.steering(BO, made.lease_id):
            made.stops.running = "000004"
        left = made.bench.leave("Bo")
        assert left["code"] == "left" and left["sentence"].startswith("Bo ended the run")
        assert made.stops.running is None, "what it began is stopped"
        (listed,) = made.bench.answer()["runs"]
        assert (listed["name"], listed["state"]) == (first["name"], "interrupted")
        again = made.begin(board=None, resume=first["name"])
        assert (again["name"], again["most"], again["by_hand"]) == (first["name"], 33, True)
        assert run["sentences"] == made.until("waiting")["sentences"] == [first["name"]]
        assert made.bench.answer()["runs"][0]["state"] == "running"


def test_a_run_that_was_cut_off_with_its_daemon_is_listed_and_goes_on(tmp_path: Path) -> None:
    with world(tmp_path, script(BEGUN, PLACE, answered)) as made:
        name = made.begin()["name"]
        made.until("waiting")
    file = tmp_path / "state" / "bench" / name / "run.json"
    document = json.loads(file.read_text())
    assert "the daemon ended" in document["sentence"]
    file.write_text(json.dumps(document | {"state": "running"}))
    with world(tmp_path, script(BEGUN, DONE)) as made:
        (listed,) = made.bench.answer()["runs"]
        assert listed["state"] == "interrupted" and "cut off" in listed["sentence"]
        made.begin(board=None, resume=name)
        assert made.until("done")["name"] == name
