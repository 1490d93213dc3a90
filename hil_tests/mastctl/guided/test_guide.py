"""A bench calibration by a program beside the daemon: what it tells, how it ends, and what it never does."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.guided.guided_world import BEGUN, DONE, PLACE, PROGRESS, lines, world
from hil_tests.waiting import until
from mastctl.control.caller import Caller
from mastctl.errors import NotKnown, NotNow
from mastctl.guided.guide import WayIn, command_of
from mastctl.guided.runs import GuidedFolder
from mastctl.guided.told import GuidedRun, heard

ANA, BO = Caller("Ana", "operate"), Caller("Bo", "operate")


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


def stop_pressed(who: str = "Bo", command: str = "stop") -> dict[str, Any]:
    return {"number": 1, "command": command, "who": who, "result": "ok"}


def test_a_run_is_followed_over_a_placement_to_its_verdict(tmp_path: Path) -> None:
    script = lines(BEGUN, PLACE) + "assert answered() == 'stands'\n"
    script += lines({"event": "stands", "name": "p1"}, {"event": "step", "step": "search"}, PROGRESS)
    script += "import pathlib\npathlib.Path(REPORT).mkdir()\n"
    script += "pathlib.Path(REPORT, 'bench.html').write_text('<title>Bench</title>')\n"
    with world(tmp_path, script + lines(DONE)) as made:
        begun = made.begin(wanted_px=0.5)
        assert (begun.state, begun.by, begun.wanted_px) == ("running", "Ana", 0.5)
        asked = made.until("asking").asked
        assert asked is not None and asked.turned_deg == (20.0, 0.0) and asked.needs_confirmation
        assert made.leases.control().holder == "bench calibration"  # type: ignore[union-attr]
        made.guide.stands()
        run = made.until("done")
        assert made.leases.control() is None and made.lent == []
        assert run.curve == ((3, 6.2),) and run.cameras["navcam_left"].cells == (2,) * 48
        assert run.result is not None and run.result["verdict"]["words"] == "trust it"
        assert run.result["cameras"][0]["promised_px"] == 0.09
        assert run.mast_file == f"bench-{run.name}.yaml" and run.report == run.name
        until(lambda: made.told and made.told[-1].state == "done", "the end is published")
        (listed,) = made.guide.told()["runs"]
        assert (listed["state"], listed["grade"], listed["mast_file"]) == ("done", "good", run.mast_file)
        with pytest.raises(NotNow, match="has its verdict"):
            made.begin(board=None, resume=run.name)


def test_the_program_gets_lease_and_token_but_not_on_its_command_line(tmp_path: Path) -> None:
    script = (
        lines(BEGUN)
        + "tell(event='said', sentence=os.environ['MASTCTL_TOKEN'] + os.environ['MASTCTL_LEASE'])\n"
    )
    with world(tmp_path, script + lines(PLACE) + "answered()\n") as made:
        made.begin()
        run = made.until("asking")
        work = made.guide._work
        assert work is not None and run.sentences == (f"secret-of-the-child{work.lease.id}",)
        shown = Path(f"/proc/{made.pid}/cmdline").read_bytes().decode()
        assert "secret" not in shown and work.lease.id not in shown
    folder = GuidedFolder(tmp_path / "run")
    asked = {"wanted_px": 0.2, "pictures": 60, "by_hand": True}
    words = command_of(folder, asked, WayIn("http://127.0.0.1:1", None), tmp_path / "m.yaml")
    assert words[3:6] == ["calibrate", "bench", "--lines"] and words[-1] == "--by-hand"


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)\n", "was ended by SIGKILL"),
        (
            "sys.stderr.write('no numbers today\\n'); sys.exit(7)\n",
            "ended with exit code 7 (no numbers today)",
        ),
        ("while True: print('x' * 50)\n", "printed more than can be read"),
    ],
)
def test_a_program_that_dies_or_floods_is_reported_and_frees_the_lease(
    tmp_path: Path, script: str, words: str
) -> None:
    with world(tmp_path, lines(BEGUN) + script) as made:
        made.begin()
        pid = made.pid
        run = made.until("interrupted")
        assert run.code == "program_ended" and words in run.sentence and "can go on" in run.sentence
        assert gone(pid) and made.leases.control() is None and made.lent == []


GARBAGE = [
    "", "[]", '{"event": 3}', '{"event": "place"}', '{"event": "done", "result": 4}', "[" * 100000,
    json.dumps({**PROGRESS, "cells": {"other": [1] * 48}}), json.dumps({**PLACE, "range_m": 1e400}),
]  # fmt: skip


@pytest.mark.parametrize("line", GARBAGE)
def test_a_line_that_makes_no_sense_changes_nothing_but_a_count(line: str) -> None:
    before = heard(GuidedRun("a", "b", "c"), json.dumps(BEGUN).encode())
    assert heard(before, line.encode()) == replace(before, unread_lines=1)


def test_a_stop_ends_the_run_and_what_it_began_and_waits_for_neither(tmp_path: Path) -> None:
    with world(tmp_path, lines(BEGUN, PROGRESS) + "time.sleep(60)\n") as made:
        made.begin()
        until(lambda: made.guide.run and made.guide.run.pictures == 3, "it is at work")
        pid = made.pid
        made.stops.running = "000002-race"  # sent out between the stop and its end
        made.stops.confirms.clear()  # the head takes its time to confirm what ends that
        made.publisher.publish("command", "1", stop_pressed())
        assert made.stops.reasons == [], "who pressed stop waits for none of it"
        made.stops.confirms.set()
        run = made.until("interrupted")
        assert run.code == "stopped" and run.sentence.startswith("Bo pressed stop; the head stands still")
        assert made.stops.running is None and gone(pid) and made.leases.control() is None


def test_a_stop_takes_the_programs_right_to_steer_before_it_is_public(tmp_path: Path) -> None:
    with world(tmp_path, lines(BEGUN) + "time.sleep(60)\n") as made:
        made.begin()
        work = made.guide._work
        assert work is not None
        with made.leases.steering(BO, work.lease.id):
            pass
        made.leases.stop_came()
        with pytest.raises(NotNow, match="the head was stopped"), made.leases.steering(BO, work.lease.id):
            pass
        made.publisher.publish("command", "1", stop_pressed() | {"result": "no_reply"})
        run = made.until("interrupted")
        assert run.code == "stopped"
        assert run.sentence.startswith("Bo pressed stop; the head did not confirm it")


def test_a_run_is_removed_with_all_it_saw_but_not_while_it_is_at_work(tmp_path: Path) -> None:
    with world(tmp_path, lines(BEGUN) + "time.sleep(60)\n") as made:
        made.begin()
        folder = made.guide.runs.all()[0]
        (folder.seen / "images").mkdir(parents=True)
        (folder.seen / "images" / "0-p1-navcam_left.png").write_bytes(bytes(3_000_000))
        with pytest.raises(NotNow, match="is at work"):
            made.guide.forget(folder.name)
        made.guide.leave("Ana")
        (listed,) = made.guide.told()["runs"]
        assert listed["size_mb"] == pytest.approx(3.0)
        with pytest.raises(NotKnown, match="there is no run"):
            made.guide.forget("20260101-000000")
        assert made.guide.forget(folder.name)["runs"] == []
        assert list(made.guide.runs.folder.iterdir()) == []


def test_a_stop_while_the_board_is_placed_ends_the_run_too(tmp_path: Path) -> None:
    with world(tmp_path, lines(BEGUN, PLACE) + "answered()\n") as made:
        made.begin()
        made.until("asking")
        made.publisher.publish("command", "1", stop_pressed(command="estop"))
        assert "the emergency stop" in made.until("interrupted").sentence
        with pytest.raises(NotNow, match="no bench calibration is at work"):
            made.guide.stands()


def test_who_takes_over_ends_the_run_and_keeps_what_moves(tmp_path: Path) -> None:
    with world(tmp_path, lines(BEGUN) + "time.sleep(60)\n") as made:
        made.begin()
        made.stops.running = "000003-now-of-Bo"
        lease = made.leases.take(BO, "I need it")
        run = made.until("interrupted")
        assert run.code == "taken" and "Bo took over: I need it" in run.sentence
        assert made.leases.holds(lease.id), "the new holder's lease is let alone"
        assert made.stops.reasons == [] and made.stops.running is not None


def test_whoever_may_ends_a_run_and_it_goes_on_from_its_folder(tmp_path: Path) -> None:
    script = lines(BEGUN) + "tell(event='said', sentence=os.getcwd())\n" + lines(PLACE) + "answered()\n"
    with world(tmp_path, script) as made:
        first = made.begin(pictures=33, by_hand=True)
        made.until("asking")
        made.stops.running = "000004"
        left = made.guide.leave("Bo")
        assert (
            left.code == "left"
            and left.sentence.startswith("Bo ended the run")
            and made.stops.running is None
        )
        (listed,) = made.guide.told()["runs"]
        assert (listed["name"], listed["state"]) == (first.name, "interrupted")
        again = made.begin(board=None, resume=first.name)
        assert (again.name, again.most, again.by_hand) == (first.name, 33, True)
        assert made.until("asking").sentences[0].endswith(first.name)
        assert made.guide.told()["runs"][0]["state"] == "running"


def test_a_run_that_was_cut_off_with_its_daemon_is_listed_and_goes_on(tmp_path: Path) -> None:
    with world(tmp_path, lines(BEGUN, PLACE) + "answered()\n") as made:
        name = made.begin().name
        made.until("asking")
    end = tmp_path / "state" / "bench" / name / "end.json"
    assert "the daemon ended" in end.read_text()
    end.unlink()
    with world(tmp_path, lines(BEGUN, DONE)) as made:
        (listed,) = made.guide.told()["runs"]
        assert listed["state"] == "interrupted" and "cut off" in listed["sentence"]
        made.begin(board=None, resume=name)
        assert made.until("done").name == name
