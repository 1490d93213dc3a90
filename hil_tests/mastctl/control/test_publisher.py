"""Publisher and subscriptions: the newest of each key, in order, and nobody held up by a slow one."""

from __future__ import annotations

import asyncio
import gc
import random
import threading
import weakref

import pytest

from hil_tests.waiting import NET_S, joined, until
from mastctl.control.in_turn import InTurn
from mastctl.control.publisher import Published, Publisher


def told(some: list[Published]) -> list[tuple[str, str, object]]:
    return [(one.topic, one.key, one.value) for one in some]


def test_a_subscriber_hears_each_value_once_and_in_order() -> None:
    publisher = Publisher()
    with publisher.subscribe() as heard:
        publisher.publish("joints", "head", 1)
        publisher.publish("state", "machine", "ready")
        assert told(heard.wait(0)) == [("joints", "head", 1), ("state", "machine", "ready")]
        assert heard.wait(0) == [] and heard.lost == 0


def test_a_slow_subscriber_gets_the_newest_of_each_key_and_is_told_how_many_it_lost() -> None:
    publisher = Publisher()
    with publisher.subscribe() as slow:
        for number in range(1000):
            publisher.publish("joints", "head", number)
            publisher.publish("frame", f"camera {number % 2}", number)
        assert told(slow.wait(0)) == [
            ("frame", "camera 0", 998), ("joints", "head", 999), ("frame", "camera 1", 999),
        ]  # fmt: skip
        assert slow.lost == 999 + 998


def test_a_subscriber_hears_its_topics_only() -> None:
    publisher = Publisher()
    with publisher.subscribe("track", "fault") as heard:
        publisher.publish("joints", "head", 1)
        publisher.publish("fault", "head", ())
        assert told(heard.wait(0)) == [("fault", "head", ())]
    with pytest.raises(ValueError, match="jonts: there is no such topic"):
        publisher.subscribe("jonts")  # type: ignore[arg-type]


def test_who_comes_later_begins_with_what_is_known_unless_it_wants_changes_only() -> None:
    publisher = Publisher()
    for number in range(3):
        publisher.publish("joints", "head", number)
    with publisher.subscribe() as later, publisher.subscribe(known=False) as changes:
        assert told(later.wait(0)) == [("joints", "head", 2)]
        assert changes.wait(0) == []
        assert publisher.newest("joints", "head") == 2 and publisher.newest("track", "track") is None


def test_who_counts_hears_every_value_in_order_and_loses_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mastctl.control.publisher.MOST_UNREAD", 4)
    publisher = Publisher()
    for key, value in (("a", 1), ("b", 2), ("a", 3)):
        publisher.publish("operation", key, value)
    with publisher.subscribe(every=True) as counts:
        assert [one.value for one in counts.wait(0)] == [2, 3]  # what is known, the oldest first
        for number in range(4, 8):
            publisher.publish("operation", "a", number)
        publisher.forget("operation", "a")
        assert counts.lost == 0
        publisher.publish("operation", "a", 8)
        assert [one.value for one in counts.wait(0)] == [5, 6, 7, 8]
        assert counts.lost == 1 and counts.wait(0) == []


def test_what_is_forgotten_is_held_for_nobody() -> None:
    class Record:
        pass

    publisher = Publisher()
    with publisher.subscribe() as slow:
        records = [Record() for _ in range(300)]
        held = [weakref.ref(one) for one in records]
        for number, record in enumerate(records):
            publisher.publish("operation", str(number), record)
            if number >= 200:
                publisher.forget("operation", str(number - 200))
        del records, record
        gc.collect()
        assert sum(one() is not None for one in held) == 200
        assert [one.key for one in slow.wait(0)] == [str(number) for number in range(100, 300)]
        assert slow.lost == 100


def test_a_waiting_thread_wakes_for_a_value_and_for_the_end() -> None:
    publisher = Publisher()
    heard: list[tuple[str, str, object]] = []
    subscription = publisher.subscribe()

    def listen() -> None:
        while not subscription.closed:
            heard.extend(told(subscription.wait()))

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    publisher.publish("state", "machine", "ready")
    until(lambda: heard == [("state", "machine", "ready")], "the value")
    publisher.close()
    joined(thread)
    assert not thread.is_alive()
    assert subscription.wait() == [], "a closed one does not wait"
    assert publisher.subscribe().closed


def test_who_leaves_is_told_nothing_more() -> None:
    publisher = Publisher()
    subscription = publisher.subscribe()
    assert publisher.listeners == 1
    subscription.close()
    publisher.publish("joints", "head", 1)
    assert publisher.listeners == 0 and subscription.wait() == []


def test_a_coroutine_waits_without_keeping_its_loop_and_hears_other_threads() -> None:
    publisher = Publisher()

    async def listen() -> list[tuple[str, str, object]]:
        with publisher.subscribe_here("joints") as subscription:
            assert await subscription.wait(0.0) == []
            heard: list[tuple[str, str, object]] = []
            thread = threading.Thread(target=lambda: publish_all(publisher, 500))
            thread.start()
            while not heard or heard[-1][2] != 499:
                heard += told(await subscription.wait(NET_S))
            joined(thread)
            assert len(heard) + subscription.lost == 500
            publisher.close()
            assert await subscription.wait(None) == [] and subscription.closed
            return heard

    heard = asyncio.run(listen())
    assert heard == sorted(heard, key=lambda one: str(one[2]).zfill(4))
    publisher.publish("joints", "head", 1)


def publish_all(publisher: Publisher, count: int) -> None:
    for number in range(count):
        publisher.publish("joints", "head", number)


def test_a_loop_that_has_ended_holds_nobody_up() -> None:
    publisher = Publisher()

    async def forgetful() -> None:
        publisher.subscribe_here()

    asyncio.run(forgetful())
    with publisher.subscribe() as heard:
        publisher.publish("joints", "head", 1)
        publisher.publish("joints", "head", 2)
        assert told(heard.wait(0)) == [("joints", "head", 2)]


def test_publishing_waits_for_no_lock_however_long_its_holder_takes() -> None:
    publisher = Publisher()
    with publisher.subscribe() as heard:
        with publisher._turns._lock:  # whoever has its turn, and is kept from running
            publisher.publish("joints", "head", 1)
            assert heard.wait(0) == []
        publisher.publish("track", "track", 2)
        assert told(heard.wait(0)) == [("joints", "head", 1), ("track", "track", 2)]


@pytest.mark.parametrize("seed", range(3))
def test_all_listeners_hear_what_many_threads_say_in_one_order(seed: int) -> None:
    publisher = Publisher()
    heard: list[list[Published]] = [[], []]
    subscriptions = [publisher.subscribe() for _ in heard]

    def listen(number: int) -> None:
        while not subscriptions[number].closed:
            heard[number] += subscriptions[number].wait(NET_S)

    def say(name: str) -> None:
        chance = random.Random(f"{seed} {name}")
        for number in range(400):
            publisher.publish(chance.choice(("joints", "state", "frame")), name, number)

    listeners = [threading.Thread(target=listen, args=(number,)) for number in range(2)]
    speakers = [threading.Thread(target=say, args=(f"thread {number}",)) for number in range(4)]
    for thread in (*listeners, *speakers):
        thread.start()
    joined(*speakers)
    until(lambda: all(len(h) + s.lost == 1600 for h, s in zip(heard, subscriptions, strict=True)), "all")
    publisher.close()
    joined(*listeners)
    known: dict[int, Published] = {}
    for mine in heard:
        by_key: dict[tuple[str, str], int] = {}
        for one in mine:
            assert known.setdefault(one.sequence, one) is one, f"seed {seed}"
            assert by_key.get((one.topic, one.key), -1) < one.value, f"seed {seed}"
            by_key[one.topic, one.key] = one.value


def test_what_is_left_is_taken_by_who_comes_next_and_before_its_own() -> None:
    taken: list[str] = []
    turns = InTurn[str](taken.append)
    turns.leave("a note")
    assert taken == []
    turns.bring("something")
    assert taken == ["a note", "something"]
    turns.leave("another")
    with turns.alone():
        assert taken[-1] == "another"
        turns.bring("meanwhile")
        assert taken[-1] == "another"
    assert taken[-1] == "meanwhile"
    with pytest.raises(ZeroDivisionError), turns.alone():
        turns.leave("before a defect")
        raise ZeroDivisionError
    assert taken[-1] == "before a defect"
