"""The machine: every event in every state, and what never happens whatever comes in whatever order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from drivers.clock import ManualClock
from mastctl.answers import LastResidual, ServiceState
from mastctl.control.machine import Latched, Standing, StandingFault, StateMachine
from mastctl.control.publisher import Publisher, Topic
from mastctl.errors import MastctlError, NotNow, Unable

LATCH = Latched("Ana", "a hand in the way", "2026-01-02T03:04:05Z")
SILENT = StandingFault("pan_tilt", "no_reply", "the head is silent", 3.0, "it answers")
HOT = StandingFault("pan_tilt", "device_fault", "the tilt motor is hot", 4.0, "it has cooled")


class Heard(Publisher):
    """Keeps each standing that is published, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.standings: list[Standing] = []

    def publish(self, topic: Topic, key: str, value: Any) -> None:
        assert (topic, key) == ("state", "machine")
        self.standings.append(value)
        super().publish(topic, key, value)


def stopped_head(machine: StateMachine) -> None:
    machine.stop_requested()
    machine.stop_ended()


def estop_requested(machine: StateMachine) -> None:
    machine.stop_requested()
    machine.estop_requested(lambda: (LATCH,))


def latched(machine: StateMachine) -> None:
    estop_requested(machine)
    machine.stop_ended()


def asked_reset(machine: StateMachine, name: str) -> None:
    refusal = machine.standing.refusal("latch")
    if refusal is not None:
        raise refusal
    machine.reset(name, "it is gone")


# The way into each state, by what is told on it alone.
INTO: dict[ServiceState, Callable[[StateMachine], Any]] = {
    "starting": lambda machine: None,
    "ready": lambda machine: None,
    "moving": lambda machine: machine.operation_began("1", {}),
    "tracking": lambda machine: machine.follow("1"),
    "holding": stopped_head,
    "stopping": lambda machine: machine.stop_requested(),
    "stopped": latched,
    "fault": lambda machine: machine.head_faults((SILENT,)),
    "closing": lambda machine: machine.closing(),
}
TELL: dict[str, Callable[[StateMachine], Any]] = {
    "operation_began": lambda machine: machine.operation_began("2", {}),
    "operation_ended": lambda machine: machine.operation_ended(),
    "head_moves": lambda machine: machine.head_read(True),
    "head_rests": lambda machine: machine.head_read(False),
    "track_began": lambda machine: machine.follow("2"),
    "track_ended": lambda machine: machine.follow(None),
    "stop_requested": lambda machine: machine.stop_requested(),
    "stop_ended": lambda machine: machine.stop_ended(),
    "estop_requested": estop_requested,
    "reset": lambda machine: asked_reset(machine, "Ana"),
    "fault_stands": lambda machine: machine.head_faults((HOT,)),
    "fault_cleared": lambda machine: machine.head_faults(()),
    "closing": lambda machine: machine.closing(),
}
# What must follow, written down from what the states mean and not from the table: the state after each event,
# ! and the code of a refusal. Columns as in TELL.
MUST = """
           began       ended    moves    rests    track    untrack  stop     stopped  estop    reset         fault fine    closing
starting   moving      starting moving   ready    tracking starting stopping starting stopping !not_estopped  fault starting closing
ready      moving      ready    moving   ready    tracking ready    stopping ready    stopping !not_estopped  fault ready    closing
moving     !busy       ready    moving   moving   tracking moving   stopping moving   stopping !not_estopped  fault moving   closing
tracking   tracking    tracking tracking tracking tracking ready    stopping tracking stopping !not_estopped  fault tracking closing
holding    moving      holding  moving   holding  tracking holding  stopping holding  stopping !not_estopped  fault holding  closing
stopping   !stopping   stopping stopping stopping stopping stopping stopping holding  stopping !stopping     stopping stopping closing
stopped    !estopped   stopped  stopped  stopped  stopped  stopped  stopped  stopped  stopped  holding       stopped stopped closing
fault      fault       fault    fault    fault    fault    fault    stopping fault    stopping !not_estopped  fault holding  closing
closing    !closing    closing  closing  closing  closing  closing  closing  closing  closing  !closing      closing closing closing
"""  # noqa: E501
ROWS = [line.split() for line in MUST.strip().splitlines()[1:]]
PAIRS = [(row[0], event, must) for row in ROWS for event, must in zip(TELL, row[1:], strict=True)]


def machine_in(word: ServiceState) -> tuple[StateMachine, Heard, ManualClock]:
    clock, heard = ManualClock(10.0), Heard()
    machine = StateMachine(clock, heard)
    if word != "starting":
        machine.head_read(False)
    INTO[word](machine)
    assert machine.standing.state == word
    return machine, heard, clock


@pytest.mark.parametrize(("word", "event", "must"), PAIRS)
def test_every_event_in_every_state_does_what_states_mean(word: ServiceState, event: str, must: str) -> None:
    machine, heard, clock = machine_in(word)
    before, published = machine.standing, len(heard.standings)
    clock.advance(5.0)
    if must.startswith("!"):
        with pytest.raises(MastctlError) as refused:
            TELL[event](machine)
        assert refused.value.code == must[1:] and len(str(refused.value)) > 20
        assert machine.standing is before, "what is refused changes nothing"
        return
    TELL[event](machine)
    now = machine.standing
    assert now.state == must
    assert now.since_s == (before.since_s if now.state == word else 15.0)
    assert now.reason or now.state == "ready"
    assert heard.standings[-1] is now
    changes = len(heard.standings) - published
    assert changes <= (2 if event == "estop_requested" else 1)


def test_a_stop_is_over_when_all_are_confirmed_and_nothing_runs() -> None:
    machine, _, _ = machine_in("moving")
    machine.stop_requested()
    machine.stop_requested()
    machine.stop_ended()
    assert machine.standing.state == "stopping" and "is being stopped" in machine.standing.reason
    machine.stop_ended()
    assert (machine.standing.state, machine.standing.reason) == ("stopping", "operation 1 is being stopped")
    machine.operation_ended()
    assert machine.standing.state == "holding" and "next command starts" in machine.standing.reason


def test_an_unconfirmed_stop_ends_in_a_fault_or_latched() -> None:
    machine, _, _ = machine_in("ready")
    machine.stop_requested()
    machine.head_faults((SILENT,))
    machine.stop_ended()
    assert machine.standing.state == "fault"
    assert machine.standing.reason == "the head is silent, until it answers"
    latched(machine)
    assert machine.standing.state == "stopped"
    assert "Ana: a hand in the way" in machine.standing.reason and "silent" in machine.standing.reason
    machine.reset("Ben", "nobody there")
    assert machine.standing.state == "fault" and machine.standing.latched == ()
    machine.head_faults(())
    assert machine.standing.state == "holding"
    assert "Ben: nobody there" in machine.standing.reason


def test_a_fault_that_is_over_leaves_a_head_that_holds_and_says_so() -> None:
    machine, _, _ = machine_in("ready")
    machine.head_faults((SILENT, HOT))
    assert machine.standing.reason == "the head is silent, until it answers (and 1 more)"
    machine.head_faults((HOT,))
    assert machine.standing.reason == "the tilt motor is hot, until it has cooled"
    machine.head_faults(())
    assert machine.standing.state == "holding"
    assert machine.standing.reason == "it is over: the tilt motor is hot; the next command starts"
    machine.operation_began("1", {})
    machine.operation_ended()
    assert machine.standing.state == "ready"


def test_a_head_that_rests_after_a_failed_stop_was_not_stopped() -> None:
    machine, _, _ = machine_in("ready")
    machine.stop_requested()
    machine.head_faults((SILENT,))
    machine.stop_ended()
    machine.head_faults(())
    assert machine.standing.reason == "it is over: the head is silent; the next command starts"
    machine.head_faults((SILENT,))
    machine.stop_requested()
    machine.head_faults(())  # since this one was confirmed
    machine.stop_ended()
    assert machine.standing.reason == "a stop dropped the goal; the next command starts"


def test_an_operation_that_lives_through_a_fault_goes_on() -> None:
    machine, _, _ = machine_in("moving")
    machine.head_faults((SILENT,))
    machine.head_faults(())
    assert machine.standing.state == "moving"
    machine.operation_ended()
    assert machine.standing.state == "ready"


def test_a_head_that_is_moved_while_it_holds_holds_again_afterwards() -> None:
    machine, _, _ = machine_in("holding")
    machine.head_read(True)
    assert machine.standing.state == "moving"
    machine.head_read(False)
    assert machine.standing.state == "holding"


def test_a_head_that_still_runs_out_after_a_confirmed_stop_holds() -> None:
    machine, _, _ = machine_in("moving")
    machine.head_read(True)
    machine.stop_requested()
    machine.operation_ended()
    machine.stop_ended()
    assert machine.standing.state == "holding" and machine.standing.head_moves
    machine.head_read(False)
    assert machine.standing.state == "holding"


def test_an_operation_beside_a_track_leaves_the_track_active() -> None:
    machine, _, _ = machine_in("tracking")
    machine.operation_began("9", {"pan_rad": 0.1})
    with pytest.raises(NotNow, match="operation 9 is running"):
        machine.operation_began("10", {})
    residual: LastResidual = {
        "residual_px": [0.1, 0.2], "residual_sigma_px": [0.1, 0.1], "operation": "9",
    }  # fmt: skip
    machine.operation_ended(residual)
    now = machine.standing
    assert (now.state, now.track, now.operation, now.residual) == ("tracking", "1", None, residual)
    assert now.target == {"pan_rad": 0.1}


def test_a_latch_from_before_the_start_blocks_at_once() -> None:
    machine = StateMachine(ManualClock(), latched=(LATCH,))
    assert machine.standing.state == "stopped"
    machine.head_read(False)
    assert machine.standing.state == "stopped"
    machine.stop_requested()
    machine.estop_requested(lambda: (LATCH, Latched("Ben", "again", "")))
    machine.stop_ended()
    assert machine.standing.latched[0] == LATCH and len(machine.standing.latched) == 2
    machine.reset("Ben", "checked")
    assert (machine.standing.state, machine.standing.reason) == (
        "holding",
        "reset by Ben: checked; the next command starts",
    )


@pytest.mark.parametrize(
    ("word", "codes"),
    [
        ("starting", (None, None, None, "not_estopped")),
        ("ready", (None, None, None, "not_estopped")),
        ("moving", ("busy", "busy", "busy", "not_estopped")),
        ("tracking", (None, "busy", None, "not_estopped")),
        ("holding", (None, None, None, "not_estopped")),
        ("stopping", ("stopping", "stopping", "stopping", "stopping")),
        ("stopped", ("estopped", "estopped", None, None)),
        ("fault", (None, None, None, "not_estopped")),
        ("closing", ("closing", "closing", "closing", "closing")),
    ],
)
def test_what_each_state_refuses(word: ServiceState, codes: Sequence[str | None]) -> None:
    machine, _, _ = machine_in(word)
    for need, code in zip(("motion", "track", "rest", "latch"), codes, strict=True):
        refusal = machine.standing.refusal(need)  # type: ignore[arg-type]
        assert (None if refusal is None else refusal.code) == code, need
        assert refusal is None or isinstance(refusal, Unable if code == "closing" else NotNow)


def test_a_mast_file_is_not_changed_under_a_head_that_moves() -> None:
    machine, _, _ = machine_in("ready")
    machine.head_read(True)
    refusal = machine.standing.refusal("rest")
    assert refusal is not None and refusal.code == "moving"
    assert machine.standing.refusal("motion") is None
