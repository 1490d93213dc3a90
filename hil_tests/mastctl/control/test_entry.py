"""The one entry: what is asked in which order, and what is left of each command."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from drivers.clock import ManualClock
from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import on_disk
from mastctl.control.entry import (
    ESTOP,
    STOP,
    Answers,
    Command,
    CommandEntry,
    CommandRequest,
)
from mastctl.control.lease import Caller, LeaseTable
from mastctl.control.operations import OperationRunner
from mastctl.control.publisher import Publisher
from mastctl.drift.journal import JournalThread
from mastctl.errors import MastctlError, NotNow

POINT = Command("point", steers=True, need="motion")
JOG = Command("jog", steers=True, goes_on=True)
POSE = Command("pose")
BENCH = Caller("bench")
ROVER = Caller("rover")


class World:
    """An entry on a turned clock; what it tells operations; what it records."""

    def __init__(self, path: Path) -> None:
        self.clock = ManualClock(100.0)
        self.runs = False
        self.leases = LeaseTable(self.clock, lambda: self.runs)
        self.path = path
        self.thread = JournalThread(self.clock)
        self.deadlines: list[tuple[str, float, float]] = []
        self.ended_by_stop: list[str] = []
        self.refuses: str | None = None
        self.publisher = Publisher()
        self.entry = CommandEntry(
            self.clock,
            self.leases,
            Answers(self.clock),
            cast(OperationRunner, self),
            self.publisher,
            path.parent,
            self.thread.put,
        )
        self.acts = 0

    @property
    def published(self) -> list[Any]:
        """What who begins to listen now still hears of."""
        with self.publisher.subscribe("command") as heard:
            return heard.wait(0.0)

    def end_within(self, name: str, left_s: float, allowed_s: float) -> None:
        self.deadlines.append((name, left_s, allowed_s))

    def end(self, name: str) -> None:
        self.ended_by_stop.append(name)

    def refusal(self, need: str) -> NotNow | None:
        return None if self.refuses is None else NotNow(self.refuses, f"{need} does not fit")

    def asked(self, caller: Caller = BENCH, **others: Any) -> CommandRequest:
        return CommandRequest(caller, self.clock.now_s(), **others)

    def act(self) -> dict[str, Any]:
        self.acts += 1
        return {"id": f"00000{self.acts}-abcd"}

    def lines(self) -> list[dict[str, Any]]:
        on_disk(self.thread)
        return [json.loads(line) for line in self.path.read_text().splitlines()]


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    made = World(tmp_path / "audit.jsonl")
    yield made
    made.thread.close()


def refused(code: str, act: Callable[[], object]) -> str:
    with pytest.raises(MastctlError) as refusal:
        act()
    assert refusal.value.code == code
    return str(refusal.value)


def test_a_record_has_caller_lease_request_time_and_result(world: World) -> None:
    lease = world.leases.acquire(BENCH)
    request = {"pan_rad": 0.1, "tilt_rad": 0.2}
    world.entry.run(POINT, world.asked(request=request, lease=lease.id, key="k"), world.act)
    (line,) = world.lines()
    assert line.pop("time").endswith("+00:00")
    assert line == {
        "number": 1, "monotonic_s": 100.0, "command": "point", "who": "bench", "role": "admin",
        "via": "loopback", "request": request, "lease": lease.id[:8], "key": "k", "again": False,
        "result": "ok", "operation": "000001-abcd",
    }  # fmt: skip
    assert lease.id not in world.path.read_text()
    assert [(one.key, one.value["number"]) for one in world.published] == [("1", 1)]


def test_an_operations_end_is_a_line_of_its_own(world: World) -> None:
    world.entry.run(POINT, world.asked(), world.act)
    world.entry.ended("000001-abcd", "failed", {"code": "deadline_passed", "message": "too late"})
    begun, line = world.lines()
    assert line["ended"] == begun["operation"] == "000001-abcd"
    assert (line["number"], line["state"], line["code"]) == (2, "failed", "deadline_passed")


@pytest.mark.parametrize("error", [NoReply("no answer"), ZeroDivisionError("secret")])
def test_what_fails_is_recorded_with_its_code_and_raised(world: World, error: Exception) -> None:
    def act() -> dict[str, Any]:
        raise error

    with pytest.raises(type(error)):
        world.entry.run(POINT, world.asked(), act)
    (line,) = world.lines()
    assert line["result"] == ("no_reply" if isinstance(error, NoReply) else "internal")
    assert "secret" not in line["message"]


def test_each_refusal_is_recorded_and_nothing_is_done(world: World) -> None:
    entry, asked = world.entry, world.asked
    refused("role", lambda: entry.run(POINT, asked(Caller("page", "view")), world.act))
    lease = world.leases.acquire(BENCH)
    refused("leased", lambda: entry.run(POINT, asked(ROVER), world.act))
    refused("lease_unknown", lambda: entry.run(POINT, asked(ROVER, lease="x"), world.act))
    world.refuses = "stopped"
    refused("stopped", lambda: entry.run(POINT, asked(lease=lease.id), world.act))
    late = asked(ROVER, deadline_s=1.0)
    world.clock.advance(1.0)
    refused("deadline_passed", lambda: entry.run(POSE, late, world.act))
    assert [line["result"] for line in world.lines()] == [
        "role", "leased", "lease_unknown", "stopped", "deadline_passed",
    ]  # fmt: skip
    assert world.acts == 0


def test_a_stop_asks_for_nothing_acts_and_is_recorded_after(world: World) -> None:
    world.leases.acquire(BENCH)
    world.refuses = "stopped"
    told: list[int] = []

    def act() -> dict[str, Any]:
        told.append(len(world.published))
        return {"stopped": True, "operation": "000001-abcd"}

    locks: list[Any] = [world.leases._lock, world.entry._answers._changed]
    for lock in locks:
        lock.__enter__()  # whoever holds them holds no stop
    try:
        world.entry.first(STOP, world.asked(Caller("page", "view"), lease="x"), act)
    finally:
        for lock in locks:
            lock.__exit__(None, None, None)
    assert told == [0]
    assert world.lines()[0]["result"] == "ok"


def test_a_command_sent_twice_acts_once_and_both_are_recorded(world: World) -> None:
    asked = world.asked(key="k", request={"pan_rad": 0.1})
    assert world.entry.run(POINT, asked, world.act) == world.entry.run(POINT, asked, world.act)
    assert world.acts == 1
    assert [(line["operation"], line["again"]) for line in world.lines()] == [
        ("000001-abcd", False),
        ("000001-abcd", True),
    ]
    refused(
        "key_reused",
        lambda: world.entry.run(POINT, world.asked(key="k", request={"pan_rad": 0.2}), world.act),
    )
    refused(
        "key_reused",
        lambda: world.entry.run(POSE, world.asked(key="k", request={"pan_rad": 0.1}), world.act),
    )


def test_an_answer_is_given_again_after_the_lease_under_which_it_was_made(world: World) -> None:
    lease = world.leases.acquire(BENCH, for_s=5.0)
    asked = world.asked(key="k", lease=lease.id)
    answer: dict[str, Any] = world.entry.run(POINT, asked, world.act)
    world.clock.advance(6.0)
    world.leases.acquire(ROVER)
    assert world.entry.run(POINT, asked, world.act) == answer
    assert world.acts == 1


def test_an_operation_is_given_what_is_left_of_its_time(world: World) -> None:
    def slow() -> dict[str, Any]:
        world.clock.advance(2.0)
        return world.act()

    world.entry.run(POINT, world.asked(deadline_s=5.0), slow, usual_s=60.0)
    world.entry.run(POINT, world.asked(), world.act, usual_s=60.0)
    world.entry.run(POINT, world.asked(), world.act)
    world.entry.run(POSE, world.asked(), lambda: {"operation": None, "track": {}}, usual_s=60.0)
    assert world.deadlines == [("000001-abcd", 3.0, 5.0), ("000002-abcd", 60.0, 60.0)]


def test_what_does_not_steer_is_let_through_whoever_steers(world: World) -> None:
    world.leases.acquire(BENCH)
    world.entry.run(POSE, world.asked(ROVER), world.act)
    world.entry.run(Command("reload", "admin"), world.asked(ROVER), world.act)
    assert world.acts == 2


def test_of_heartbeats_the_first_is_recorded_and_what_is_refused(world: World) -> None:
    for request in ({}, {"id": "000001-abcd"}, {"id": "000001-abcd"}):
        world.entry.run(JOG, world.asked(request=request), lambda: {"id": "000001-abcd", "taken": True})
    world.entry.run(JOG, world.asked(), lambda: {"id": None, "taken": False})
    world.leases.acquire(BENCH)
    refused("leased", lambda: world.entry.run(JOG, world.asked(ROVER), dict[str, Any]))
    world.entry.ended("000001-abcd", "done", None)
    told = [(line.get("result"), line.get("ended")) for line in world.lines()]
    assert told == [("ok", None), ("leased", None), (None, "000001-abcd")]


def test_a_move_requested_before_a_stop_is_not_done_after_it(world: World) -> None:
    early = world.asked(last_stop=world.leases.last_stop)
    world.entry.first(STOP, world.asked(ROVER), dict[str, Any])
    words = refused("stopped", lambda: world.entry.run(POINT, early, world.act))
    assert "requested before a stop" in words and world.acts == 0
    world.entry.run(POSE, early, dict[str, Any])  # moves nothing
    world.entry.run(POINT, world.asked(last_stop=world.leases.last_stop), world.act)
    assert world.acts == 1 and world.ended_by_stop == []


def test_what_begins_while_a_stop_comes_is_ended_by_it(world: World) -> None:
    def act() -> dict[str, Any]:
        world.leases.stop_came()
        return world.act()

    world.entry.run(POINT, world.asked(last_stop=world.leases.last_stop), act)
    assert world.ended_by_stop == ["000001-abcd"]


def test_strangers_push_nobody_elses_records_out(tmp_path: Path) -> None:
    world = World(tmp_path / "audit.jsonl")
    who = Caller("anonymous", "view", "network", "10.0.0.9")
    world.entry.run(POINT, world.asked(Caller("operate", via="token", address="10.0.0.1")), world.act)
    for number in range(1000):
        world.entry.first(ESTOP, world.asked(who, request={"reason": "x" * 4000}), lambda: {"id": "-"})
        if number % 50 == 0:
            on_disk(world.thread)
    world.entry.refused(Caller("view", "view", "token", "10.0.0.2"), "POST /point", "role", "may view")
    world.entry.refused(who, "GET /status", "wrong_token", "nobody's")
    known = world.lines()
    assert [(line["who"], line["address"], line["result"]) for line in known] == [
        ("operate", "10.0.0.1", "ok"),
        ("view", "10.0.0.2", "role"),
    ]
    assert known[1]["command"] == "POST /point"
    last = json.loads((tmp_path / "strangers.jsonl").read_text().splitlines()[-1])
    assert (last["address"], last["result"]) == ("10.0.0.9", "wrong_token")
    assert len(world.published) == 256, "no refusal is published"
    world.thread.close()
