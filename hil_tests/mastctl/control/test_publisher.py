"""Publisher and subscriptions: the newest of each key, in order, and nobody held up by a slow one."""

from __future__ import annotations

import asyncio
import random
import threading

import pytest

from hil_tests.waiting import NET_S, joined, until
from mastctl.control.publisher import Published, Publisher


def told(some: list[Published]) -> list[tuple[str, str, object]]:
    return [(one.topic, one.key, one.value) for one in some]


def test_a_slow_coroutine_gets_the_newest_and_counts_the_lost() -> None:
    publisher = Publisher()

    async def listen() -> None:
        with publisher.subscribe_here() as slow:
            for number in range(1000):
                publisher.publish("joints", "head", number)
                publisher.publish("frame", f"camera {number % 2}", number)
                publisher.publish("operation", "1", number)
            publisher.forget("operation", "1")
            assert told(await slow.wait(0.0)) == [
                ("frame", "camera 0", 998), ("joints", "head", 999), ("frame", "camera 1", 999),
            ]  # fmt: skip
            assert slow.lost == 999 + 998 + 1000
            publisher.publish("operation", "2", 1)
            publisher.forget("operation", "2")
            assert await slow.wait(0.0) == []
            publisher.publish("operation", "3", 1)
            assert told(await slow.wait(NET_S)) == [("operation", "3", 1)]

    asyncio.run(listen())


def test_a_thread_gets_every_value_in_order_and_loses_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mastctl.control.publisher.MOST_UNREAD", 4)
    publisher = Publisher()
    for key, value in (("a", 1), ("b", 2), ("a", 3)):
        publisher.publish("operation", key, value)
    with publisher.subscribe() as counts:
        assert [one.value for one in counts.wait(0)] == [2, 3]  # what is known, the oldest first
        for number in range(4, 8):
            publisher.publish("operation", "a", number)
        publisher.forget("operation", "a")
        assert counts.lost == 0
        publisher.publish("operation", "a", 8)
        assert [one.value for one in counts.wait(0)] == [5, 6, 7, 8]
        assert counts.lost == 1 and counts.wait(0) == []


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


def test_a_coroutine_hears_other_threads_without_blocking_its_loop() -> None:
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
