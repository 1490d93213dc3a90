"""A command that is sent twice acts once."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from drivers.clock import ManualClock
from drivers.errors import NoReply
from drivers.simulation_clock import SimulationClock
from hil_tests.waiting import NET_S, joined
from mastctl.control.entry import Answers
from mastctl.errors import BadRequest, NotNow

SAME = {"command": "point", "request": {"pan_rad": 0.1}}


class Acts:
    """Counts how often something is done."""

    def __init__(self) -> None:
        self.done = 0
        self.error: BaseException | None = None

    def __call__(self) -> dict[str, Any]:
        self.done += 1
        if self.error is not None:
            raise self.error
        return {"id": self.done}


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def answers(clock: ManualClock) -> Answers:
    return Answers(clock)


def test_anothers_key_is_another_key(answers: Answers) -> None:
    acts = Acts()
    assert answers.once("bench", "1", SAME, acts) == ({"id": 1}, False)
    assert answers.once("rover", "1", SAME, acts) == ({"id": 2}, False)


def test_an_answer_is_kept_ten_minutes(answers: Answers, clock: ManualClock) -> None:
    acts = Acts()
    answers.once("bench", "k", SAME, acts)
    clock.advance(600.0 - 0.001)
    assert answers.once("bench", "k", SAME, acts) == ({"id": 1}, True)
    clock.advance(0.001)
    assert answers.once("bench", "k", SAME, acts) == ({"id": 2}, False)


def test_a_refusal_changed_nothing_so_the_same_key_asks_again(answers: Answers) -> None:
    acts = Acts()
    acts.error = NotNow("busy", "another runs")
    with pytest.raises(NotNow):
        answers.once("bench", "k", SAME, acts)
    acts.error = None
    assert answers.once("bench", "k", SAME, acts) == ({"id": 2}, False)


@pytest.mark.parametrize("error", [NoReply("no answer"), ZeroDivisionError()])
def test_what_failed_may_have_acted_so_it_is_not_done_again(answers: Answers, error: Exception) -> None:
    acts = Acts()
    acts.error = error
    for _ in range(2):
        with pytest.raises(type(error)):
            answers.once("bench", "k", SAME, acts)
    assert acts.done == 1


@pytest.mark.parametrize("simulated", [False, True])
def test_many_requests_of_one_key_act_once_and_get_one_answer(simulated: bool) -> None:
    clock = SimulationClock() if simulated else None
    answers = Answers(ManualClock(), clock)
    acts, inside, go = Acts(), threading.Event(), threading.Event()
    got: list[tuple[dict[str, Any], bool]] = []

    def slow() -> dict[str, Any]:
        inside.set()
        if clock is not None:
            clock.sleep(5.0)  # lets the others have their turns
        assert go.wait(NET_S)
        return acts()

    def ask() -> None:
        got.append(answers.once("bench", "k", SAME, slow))

    make = threading.Thread if clock is None else lambda target: clock.thread(target, "asks")
    threads = [make(target=ask) for _ in range(6)]
    threads[0].start()
    assert inside.wait(NET_S)
    for thread in threads[1:]:
        thread.start()
    go.set()
    joined(*threads)
    assert acts.done == 1
    assert sorted(again for _, again in got) == [False] + [True] * 5
    assert all(answer == {"id": 1} for answer, _ in got)


@pytest.mark.parametrize("key", ["", "a" * 201, "schlüssel", "a\nb"])
def test_what_is_no_key_is_refused_before_anything_is_done(answers: Answers, key: str) -> None:
    acts = Acts()
    with pytest.raises(BadRequest, match="Idempotency-Key"):
        answers.once("bench", key, SAME, acts)
    assert acts.done == 0
