"""Operations with a mover that notes what it is told: the order of a stop, what ends how, what is kept."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from drivers.clock import ManualClock
from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import fake_result
from hil_tests.waiting import NET_S, joined, present, until
from mastctl.control.machine import CLOSING, StateMachine
from mastctl.control.operations import KEPT_OPERATIONS, STOP_REQUESTED, Operation, OperationRunner
from mastctl.errors import NotKnown, NotNow, Stopped, Unable, error_body


class Mover:
    """Notes what it is told, in order; ``hook(name)`` runs in every call and may raise."""

    def __init__(self) -> None:
        self.told: list[tuple[str, Any]] = []
        self.blocks: dict[object, str] = {}
        self.hook: Callable[[str], Any] = lambda name: None

    def stop(self) -> None:
        self.told.append(("stop", None))
        self.hook("stop")

    def block_moves(self, holder: object, reason: str) -> None:
        self.told.append(("block", reason))
        self.blocks[holder] = reason

    def allow_moves(self, holder: object) -> None:
        self.blocks.pop(holder, None)


@pytest.fixture
def mover() -> Mover:
    return Mover()


@pytest.fixture
def machine() -> StateMachine:
    return StateMachine(ManualClock(50.0))


@pytest.fixture
def operations(mover: Mover, machine: StateMachine) -> OperationRunner:
    return OperationRunner(mover, ManualClock(50.0), machine=machine)


def word(machine: StateMachine) -> str:
    """The state of a machine whose head was read at rest."""
    machine.head_read(False)
    return machine.standing.state


def ended(operations: OperationRunner, name: str) -> Operation:
    until(lambda: operations.get(name).state not in ("queued", "running"), "its end")
    return operations.get(name)


def until_cancelled(record: Callable[[Any], None], cancelled: threading.Event) -> None:
    record("it waits")
    assert cancelled.wait(NET_S)
    raise Stopped("cancelled")


def pointed(*residuals: Any) -> dict[str, Any]:
    """A result with a pointing for each residual."""
    return fake_result([1.0, 2.0, 3.0], 3.7, *residuals)


def test_a_stop_blocks_and_halts_before_it_ends_what_runs(
    operations: OperationRunner, mover: Mover, machine: StateMachine
) -> None:
    name = operations.start({}, until_cancelled).id
    until(lambda: operations.get(name).steps, "its step")
    seen: list[Any] = []
    mover.hook = lambda _: seen.append((dict(mover.blocks).values(), machine.standing.state))
    assert operations.stop() == name
    assert mover.told[:2] == [("block", STOP_REQUESTED), ("stop", None)]
    assert [(list(blocks), word) for blocks, word in seen[:1]] == [([STOP_REQUESTED], "stopping")]
    record = ended(operations, name)
    assert record.state == "stopped" and record.steps == ("it waits",)
    assert record.error is not None and STOP_REQUESTED in record.error["message"]
    assert mover.blocks == {}, "moves are taken again"
    assert word(machine) == "holding"


def test_no_move_goes_out_between_a_stop_and_the_end_of_what_it_stopped(
    operations: OperationRunner, mover: Mover, machine: StateMachine
) -> None:
    go = threading.Event()

    def slow(record: Callable[[Any], None], cancelled: threading.Event) -> None:
        assert cancelled.wait(NET_S) and go.wait(NET_S)
        raise Stopped("cancelled")

    name = operations.start({}, slow).id
    operations.stop()
    assert list(mover.blocks.values()) == [STOP_REQUESTED]
    assert word(machine) == "stopping"
    with pytest.raises(NotNow, match="is being stopped"):
        operations.start({}, slow)
    go.set()
    ended(operations, name)
    assert mover.blocks == {} and word(machine) == "holding"


def test_a_stop_that_the_head_does_not_confirm_ends_what_runs_all_the_same(
    operations: OperationRunner, mover: Mover, machine: StateMachine
) -> None:
    name = operations.start({}, until_cancelled).id

    def silent(_: str) -> None:
        raise NoReply("no answer", device="pan_tilt")

    mover.hook = silent
    with pytest.raises(NoReply):
        operations.stop()
    assert ended(operations, name).state == "stopped"
    assert word(machine) == "holding" and mover.blocks == {}


def test_an_operation_that_ends_during_a_stop_was_stopped_by_it(
    operations: OperationRunner, mover: Mover
) -> None:
    go = threading.Event()

    def refused(record: Any, cancelled: threading.Event) -> None:
        assert go.wait(NET_S)
        raise Stopped("a move was refused, since the mast is being stopped")

    def until_it_has_ended(_: str) -> None:
        mover.hook = lambda name: None  # the operation stops the mast too as it ends
        go.set()
        until(lambda: operations.running is None, "the operation's end")

    mover.hook = until_it_has_ended
    name = operations.start({}, refused).id
    assert operations.stop() == name
    assert operations.get(name).error == error_body(Stopped(STOP_REQUESTED))


def test_nothing_starts_while_a_stop_is_under_way(
    operations: OperationRunner, mover: Mover, machine: StateMachine
) -> None:
    with operations.stopping():
        assert word(machine) == "stopping" and list(mover.blocks.values()) == [STOP_REQUESTED]
        with pytest.raises(NotNow, match="the mast is being stopped") as refused:
            operations.start({}, until_cancelled)
        assert refused.value.code == "stopping"
    assert word(machine) == "holding" and mover.blocks == {}
    assert operations.stop() is None, "nothing ran"
    assert operations.all() == []


def test_one_operation_runs_at_a_time(operations: OperationRunner, machine: StateMachine) -> None:
    first = operations.start({"pan_rad": 0.1}, until_cancelled)
    assert (operations.running, machine.standing.target) == (
        first.id,
        {"pan_rad": 0.1},
    )
    with pytest.raises(NotNow, match=f"operation {first.id} is running; wait for it or stop it") as busy:
        operations.start({}, until_cancelled)
    assert busy.value.code == "busy"
    operations.stop()
    ended(operations, first.id)
    assert operations.running is None
    second = operations.start({}, lambda record, cancelled: None)
    assert second.id != first.id and ended(operations, second.id).state == "done"
    assert word(machine) == "ready", "a start ends the word of the stop"


def test_what_fails_halts_the_head_and_says_why(operations: OperationRunner, mover: Mover) -> None:
    def fail(record: Callable[[Any], None], cancelled: threading.Event) -> None:
        raise NoReply("no answer", device="pan_tilt")

    told = ended(operations, operations.start({}, fail).id).as_json()
    assert (told["state"], present(told["error"])["code"]) == ("failed", "no_reply")
    assert mover.told == [("stop", None)]

    def defect(record: Callable[[Any], None], cancelled: threading.Event) -> None:
        raise ZeroDivisionError("secret")

    told = ended(operations, operations.start({}, defect).id).as_json()
    assert present(told["error"])["code"] == "internal" and "secret" not in present(told["error"])["message"]
    assert mover.told == [("stop", None)] * 2


def test_what_is_done_leaves_the_head_alone_and_its_last_residual_behind(
    operations: OperationRunner, mover: Mover, machine: StateMachine
) -> None:
    result = pointed([3.0, 4.0], [0.25, -0.5])
    name = operations.start({}, lambda record, cancelled: result).id
    told = ended(operations, name).as_json()
    assert told["residual_px"] == [0.25, -0.5] and len(told["pointings"]) == 2
    assert (told["position_m"], told["range_m"]) == ([1.0, 2.0, 3.0], 3.7)
    assert (told["created_s"], told["started_s"], told["ended_s"]) == (50.0, 50.0, 50.0)
    assert mover.told == []
    residual = {"residual_px": [0.25, -0.5], "residual_sigma_px": [0.1, 0.2], "operation": name}
    assert machine.standing.residual == residual
    for later in (pointed(), pointed(None), pointed([None, 1.0]), None):
        again = operations.start({}, lambda record, cancelled, later=later: later).id  # type: ignore[misc]
        assert ended(operations, again).state == "done"
        assert machine.standing.residual == residual, "the last one measured"


def test_closing_halts_the_head_ends_what_runs_and_starts_nothing(
    operations: OperationRunner, mover: Mover, machine: StateMachine
) -> None:
    name = operations.start({}, until_cancelled).id
    operations.close()
    record = operations.get(name)
    assert record.state == "stopped" and record.error is not None and CLOSING in record.error["message"]
    assert mover.told[:2] == [("block", CLOSING), ("stop", None)]
    assert mover.blocks == {operations: CLOSING}, "for good"
    assert word(machine) == "closing"
    with pytest.raises(Unable, match=CLOSING):
        operations.start({}, until_cancelled)
    told = len(mover.told)
    operations.close()
    assert len(mover.told) == told, "the devices may be closed by then"


def test_a_stop_does_not_wait_for_the_operation_but_the_next_command_does(
    operations: OperationRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mastctl.control.operations.ENDS_SOON_S", 2.0 * NET_S)
    go = threading.Event()

    def ends_late(record: Any, cancelled: threading.Event) -> None:
        assert go.wait(NET_S)
        assert cancelled.is_set()
        raise Stopped("it noticed")

    first = operations.start({}, ends_late).id
    assert operations.stop() == first
    assert operations.get(first).state == "running"
    seen: list[Any] = []
    waits = threading.Thread(target=lambda: seen.append(operations.refusal("motion")))
    waits.start()
    assert operations.running == first
    go.set()
    joined(waits)
    assert seen == [None]
    assert operations.running is None
    assert operations.get(first).state == "stopped"
    operations.close()


def test_a_command_after_a_stop_waits_for_a_bounded_time(
    operations: OperationRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mastctl.control.operations.ENDS_SOON_S", 0.05)
    go = threading.Event()
    operations.start({}, lambda record, cancelled: go.wait(NET_S))
    operations.stop()
    refused = operations.refusal("motion")
    assert refused is not None
    assert refused.code == "stopping"
    with pytest.raises(NotNow, match="stop"):
        operations.start({}, until_cancelled)
    go.set()


def test_the_newest_records_are_kept(operations: OperationRunner) -> None:
    names = []
    for _ in range(KEPT_OPERATIONS + 1):
        names.append(operations.start({}, lambda record, cancelled: None).id)
        until(lambda: operations.running is None, "room for the next")
        ended(operations, names[-1])
    assert [one.id for one in operations.all()] == names[:0:-1], "newest first"
    with pytest.raises(NotKnown, match=f"operation {names[0]} is not known"):
        operations.get(names[0])


# Deadlines


def test_an_operation_that_runs_beyond_its_time_ends_with_the_mast_stopped(
    mover: Mover, operations: OperationRunner
) -> None:
    name = operations.start({}, until_cancelled).id
    operations.end_within(name, 0.05, 5.0)
    record = ended(operations, name)
    assert record.state == "failed"
    assert record.error is not None
    assert record.error["code"] == "deadline_passed"
    assert "did not end in the 5 s it was given" in record.error["message"]
    assert ("stop", None) in mover.told
    until(lambda: not mover.blocks, "moves are taken again")
    operations.start({}, lambda record, cancelled: None)


def test_the_next_command_waits_for_the_stop_of_a_deadline(
    mover: Mover, operations: OperationRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mastctl.control.operations.ENDS_SOON_S", 2.0 * NET_S)
    asked, go = threading.Event(), threading.Event()

    def slow_stop(name: str) -> None:
        asked.set()
        assert go.wait(NET_S)

    def ends_at_once(record: Any, cancelled: threading.Event) -> None:
        assert cancelled.wait(NET_S)

    name = operations.start({}, ends_at_once).id
    mover.hook = slow_stop
    operations.end_within(name, 0.0, 5.0)
    assert asked.wait(NET_S)
    ended(operations, name)
    refused: list[Any] = []
    next_one = threading.Thread(target=lambda: refused.append(operations.refusal("motion")))
    next_one.start()
    next_one.join(0.1)
    assert not refused, "it waits"
    go.set()
    joined(next_one)
    assert refused == [None]


def test_a_deadline_after_the_end_stops_nothing(mover: Mover, operations: OperationRunner) -> None:
    name = operations.start({}, lambda record, cancelled: None).id
    assert ended(operations, name).state == "done"
    operations.end_within(name, 0.0, 5.0)
    following = operations.start({}, until_cancelled).id
    operations.end_within(name, 0.0, 5.0)
    assert operations.running == following
    assert ("stop", None) not in mover.told
    operations.stop()
    ended(operations, following)


def test_a_stop_before_the_deadline_is_the_last_word(mover: Mover, operations: OperationRunner) -> None:
    go = threading.Event()

    def slow_to_end(record: Callable[[Any], None], cancelled: threading.Event) -> None:
        assert cancelled.wait(NET_S)
        assert go.wait(NET_S)
        raise Stopped("cancelled")

    name = operations.start({}, slow_to_end).id
    operations.stop()
    before = len(mover.told)
    operations.end_within(name, 0.0, 5.0)
    go.set()
    record = ended(operations, name)
    assert mover.told[before:] == [("stop", None)], "by the operation itself, as it ends"
    assert record.state == "stopped"
    assert record.error == error_body(Stopped(STOP_REQUESTED))


def test_a_stop_after_the_deadline_is_sent_all_the_same(
    mover: Mover, operations: OperationRunner, machine: StateMachine
) -> None:
    go = threading.Event()

    def slow_to_end(record: Callable[[Any], None], cancelled: threading.Event) -> None:
        assert cancelled.wait(NET_S)
        assert go.wait(NET_S)
        raise Stopped("cancelled")

    name = operations.start({}, slow_to_end).id
    operations.end_within(name, 0.0, 5.0)
    until(lambda: ("stop", None) in mover.told, "the deadline's stop")
    assert word(machine) == "stopping"
    stops = mover.told.count(("stop", None))
    operations.stop()
    assert mover.told.count(("stop", None)) > stops
    go.set()
    assert ended(operations, name).state == "stopped"
