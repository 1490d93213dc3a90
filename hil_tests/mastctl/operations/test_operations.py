"""Operations with a mover that notes what it is told: the order of a stop, what ends how, what is kept."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from drivers.clock import ManualClock
from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import FakePointing, FakeResult, eventually
from mastctl.errors import NotKnown, NotNow, Stopped, Unable, error_body
from mastctl.operations.operations import CLOSING, KEPT_OPERATIONS, STOP_ASKED, Operations
from mastctl.operations.records import Operation, Residual


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
def operations(mover: Mover) -> Operations:
    return Operations(mover, ManualClock(50.0))


def ended(operations: Operations, name: str) -> Operation:
    eventually(lambda: operations.get(name).state not in ("queued", "running"), "its end")
    return operations.get(name)


def until_cancelled(record: Callable[[Any], None], cancelled: threading.Event) -> None:
    record("it waits")
    assert cancelled.wait(30.0)
    raise Stopped("cancelled")


def pointed(*residuals: Any) -> FakeResult:
    """A result with a pointing for each residual."""
    return FakeResult([1.0, 2.0, 3.0], 3.7, tuple(FakePointing(one, [0.1, 0.2], "") for one in residuals))


def test_a_stop_blocks_and_halts_before_it_ends_what_runs(operations: Operations, mover: Mover) -> None:
    name = operations.start({}, until_cancelled).id
    eventually(lambda: operations.get(name).steps, "its step")
    seen: list[Any] = []
    mover.hook = lambda _: seen.append((dict(mover.blocks).values(), operations.motion.stopping))
    assert operations.stop() == name
    assert mover.told[:2] == [("block", STOP_ASKED), ("stop", None)]
    assert [(list(blocks), stopping) for blocks, stopping in seen[:1]] == [([STOP_ASKED], True)]
    record = ended(operations, name)
    assert record.state == "stopped" and record.steps == ("it waits",)
    assert record.error is not None and STOP_ASKED in record.error["message"]
    assert mover.blocks == {}, "moves are taken again"
    assert operations.motion.stopped and not operations.motion.stopping


def test_no_move_goes_out_between_a_stop_and_the_end_of_what_it_stopped(
    operations: Operations, mover: Mover
) -> None:
    go = threading.Event()

    def slow(record: Callable[[Any], None], cancelled: threading.Event) -> None:
        assert cancelled.wait(30.0) and go.wait(30.0)
        raise Stopped("cancelled")

    name = operations.start({}, slow).id
    operations.stop()
    assert list(mover.blocks.values()) == [STOP_ASKED]
    assert operations.motion.stopping
    with pytest.raises(NotNow, match="is being stopped"):
        operations.start({}, slow)
    go.set()
    ended(operations, name)
    assert mover.blocks == {} and not operations.motion.stopping


def test_a_stop_that_the_head_does_not_confirm_ends_what_runs_all_the_same(
    operations: Operations, mover: Mover
) -> None:
    name = operations.start({}, until_cancelled).id

    def silent(_: str) -> None:
        raise NoReply("no answer", device="pan_tilt")

    mover.hook = silent
    with pytest.raises(NoReply):
        operations.stop()
    assert ended(operations, name).state == "stopped"
    assert operations.motion.stopped and mover.blocks == {}


def test_nothing_starts_while_a_stop_is_held(operations: Operations, mover: Mover) -> None:
    with operations.held():
        assert operations.motion.stopping and list(mover.blocks.values()) == [STOP_ASKED]
        with pytest.raises(NotNow, match="the mast is being stopped") as refused:
            operations.start({}, until_cancelled)
        assert refused.value.code == "stopping"
    assert not operations.motion.stopping and mover.blocks == {}
    assert operations.stop() is None, "nothing ran"
    assert operations.all() == []


def test_one_operation_runs_at_a_time(operations: Operations) -> None:
    first = operations.start({"pan_rad": 0.1}, until_cancelled)
    assert (operations.motion.operation, operations.motion.target) == (first.id, {"pan_rad": 0.1})
    with pytest.raises(NotNow, match=f"operation {first.id} is running; wait for it or stop it") as busy:
        operations.start({}, until_cancelled)
    assert busy.value.code == "busy"
    operations.stop()
    ended(operations, first.id)
    assert operations.motion.operation is None
    second = operations.start({}, lambda record, cancelled: None)
    assert second.id != first.id and ended(operations, second.id).state == "done"
    assert not operations.motion.stopped, "a start ends the word of the stop"


def test_what_fails_halts_the_head_and_says_why(operations: Operations, mover: Mover) -> None:
    def fail(record: Callable[[Any], None], cancelled: threading.Event) -> None:
        raise NoReply("no answer", device="pan_tilt")

    told = ended(operations, operations.start({}, fail).id).told()
    assert (told["state"], told["error"]["code"]) == ("failed", "no_reply")
    assert mover.told == [("stop", None)]

    def defect(record: Callable[[Any], None], cancelled: threading.Event) -> None:
        raise ZeroDivisionError("secret")

    told = ended(operations, operations.start({}, defect).id).told()
    assert told["error"]["code"] == "internal" and "secret" not in told["error"]["message"]
    assert mover.told == [("stop", None)] * 2


def test_what_is_done_leaves_the_head_alone_and_its_last_residual_behind(
    operations: Operations, mover: Mover
) -> None:
    result = pointed([3.0, 4.0], [0.25, -0.5])
    name = operations.start({}, lambda record, cancelled: result).id
    told = ended(operations, name).told()
    assert told["residual_px"] == [0.25, -0.5] and len(told["pointings"]) == 2
    assert (told["position_m"], told["range_m"]) == ([1.0, 2.0, 3.0], 3.7)
    assert (told["created_s"], told["started_s"], told["ended_s"]) == (50.0, 50.0, 50.0)
    assert mover.told == []
    residual = Residual((0.25, -0.5), (0.1, 0.2), name)
    assert operations.motion.residual == residual
    for later in (pointed(), pointed(None), pointed([None, 1.0]), None):
        again = operations.start({}, lambda record, cancelled, later=later: later).id  # type: ignore[misc]
        assert ended(operations, again).state == "done"
        assert operations.motion.residual == residual, "the last one measured"


def test_who_waits_for_the_end_is_told_when_the_next_may_start(operations: Operations) -> None:
    heard: list[tuple[str, str | None]] = []

    def on_end(operation: Operation) -> None:
        heard.append((operation.state, operations.motion.operation))
        raise ZeroDivisionError

    name = operations.start({}, lambda record, cancelled: None, on_end).id
    eventually(lambda: heard, "the end")
    assert heard == [("done", None)]
    assert operations.get(name).state == "done"


def test_closing_halts_the_head_and_ends_what_runs_and_nothing_starts_after_it(
    operations: Operations, mover: Mover
) -> None:
    name = operations.start({}, until_cancelled).id
    operations.close()
    record = operations.get(name)
    assert record.state == "stopped" and record.error is not None and CLOSING in record.error["message"]
    assert mover.told[:2] == [("block", CLOSING), ("stop", None)]
    assert mover.blocks == {operations: CLOSING}, "for good"
    assert operations.closed
    with pytest.raises(Unable, match=CLOSING):
        operations.start({}, until_cancelled)
    told = len(mover.told)
    operations.close()
    assert len(mover.told) == told, "the devices may be closed by then"


def test_what_does_not_end_when_the_service_closes_is_given_up(
    operations: Operations, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mastctl.operations.operations.END_TIMEOUT_S", 0.05)
    go = threading.Event()
    name = operations.start({}, lambda record, cancelled: go.wait(30.0)).id
    operations.close()
    assert operations.get(name).state == "stopped"
    go.set()
    operations.wait_ended(name, 10.0)
    assert operations.get(name).state == "stopped", "its late end changes nothing"


def test_a_stop_that_raises_does_not_keep_the_service_from_closing(
    operations: Operations, mover: Mover
) -> None:
    def broken(_: str) -> None:
        raise KeyboardInterrupt

    mover.hook = broken
    name = operations.start({}, until_cancelled).id
    operations.close()
    assert operations.get(name).state == "stopped"


def test_the_newest_records_are_kept(operations: Operations) -> None:
    names = []
    for _ in range(KEPT_OPERATIONS + 1):
        names.append(operations.start({}, lambda record, cancelled: None).id)
        operations.wait_ended(names[-1], 10.0)
        ended(operations, names[-1])
    assert [one.id for one in operations.all()] == names[:0:-1], "newest first"
    with pytest.raises(NotKnown, match=f"operation {names[0]} is not known"):
        operations.get(names[0])


def test_an_operation_without_a_thread_is_told_and_leaves_room(
    operations: Operations, mover: Mover, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_left(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        with pytest.raises(Unable, match="was not started: can't start new thread"):
            operations.start({}, until_cancelled)
    assert [one.state for one in operations.all()] == ["failed"]
    assert ended(operations, operations.start({}, lambda record, cancelled: None).id).state == "done"


def test_an_error_that_cannot_be_put_into_words_is_told_as_a_defect() -> None:
    class Wordless(NoReply):
        def __str__(self) -> str:
            raise ZeroDivisionError

    assert error_body(Wordless("", device="x"))["code"] == "internal"
    assert error_body(NoReply("no\n answer", device="pan_tilt"))["message"] == "pan_tilt: no answer"
