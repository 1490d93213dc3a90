"""Who steers: one at a time, by a lease on a turned clock, or by what it started."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from drivers.clock import ManualClock, SystemClock
from drivers.errors import NoReply
from hil_tests.waiting import joined, until
from mastctl.control import lease as lease_module
from mastctl.control.lease import SHORTEST_S, Caller, Lease, Leased, LeaseTable
from mastctl.errors import MastctlError, NotNow

BENCH = Caller("bench")
ROVER = Caller("rover")


class World:
    """Leases on a clock that a test turns, and something that runs or does not."""

    def __init__(self) -> None:
        self.clock = ManualClock(100.0)
        self.runs = False
        self.changes: list[str | None] = []
        self.stops: list[str] = []
        self.leases = LeaseTable(self.clock, lambda: self.runs, self.changed, self.stop)

    def changed(self) -> None:
        self.changes.append(self.steerer())

    def steerer(self) -> str | None:
        """Who steers, and by what."""
        control = self.leases.control()
        return None if control is None else f"{control['holder']}, {control['kind']}"

    def stop(self, why: str) -> None:
        self.runs = False
        self.stops.append(why)

    def steer(self, caller: Caller, lease: Lease | None = None, starts: bool = False) -> None:
        with self.leases.steering(caller, None if lease is None else lease.id):
            self.runs = self.runs or starts


@pytest.fixture
def world() -> World:
    return World()


def refused(code: str, act: Callable[[], object]) -> str:
    with pytest.raises(MastctlError) as refusal:
        act()
    assert refusal.value.code == code
    return str(refusal.value)


def test_of_many_who_acquire_at_once_exactly_one_steers() -> None:
    for _ in range(50):
        world = World()
        start, got, refusals = threading.Barrier(8), list[Lease](), list[str]()

        def acquire(number: int, world: World = world, start: threading.Barrier = start) -> None:
            start.wait()
            try:
                got.append(world.leases.acquire(Caller(f"program {number % 4}")))  # noqa: B023
            except NotNow as error:
                refusals.append(error.code)  # noqa: B023

        threads = [threading.Thread(target=acquire, args=(number,)) for number in range(8)]
        for thread in threads:
            thread.start()
        joined(*threads)
        assert (len(got), refusals) == (1, ["leased"] * 7)


def test_who_holds_no_lease_is_told_who_does_and_how_long(world: World) -> None:
    world.leases.acquire(BENCH, for_s=20.0)
    world.clock.advance(5.0)
    with pytest.raises(Leased, match=r"bench steers, for 15\.0 s more") as refusal:
        world.steer(ROVER)
    assert refusal.value.detail["holder"] == "bench"
    assert refusal.value.detail["for_s"] == 15.0
    assert refusal.value.detail["until"] is not None


def test_the_holders_own_name_does_not_do_instead_of_its_lease(world: World) -> None:
    lease = world.leases.acquire(BENCH)
    refused("leased", lambda: world.steer(BENCH))
    refused("leased", lambda: world.leases.acquire(BENCH))
    refused("lease_unknown", lambda: world.steer(BENCH, Lease("0" * 32, "bench", BENCH, 1, 2)))
    world.steer(ROVER, lease)  # who has been given the id steers in the holder's name


def test_a_lease_holds_up_to_its_end_and_not_at_it(world: World) -> None:
    lease = world.leases.acquire(BENCH, for_s=10.0)
    world.clock.advance(9.999)
    world.steer(BENCH, lease)
    refused("leased", lambda: world.leases.acquire(ROVER))
    world.clock.advance(0.001)
    assert world.leases.control() is None
    assert "the lease was not renewed for 10 s" in refused("lease_over", lambda: world.leases.renew(lease.id))
    refused("lease_over", lambda: world.steer(BENCH, lease))
    world.leases.acquire(ROVER)


def test_renewing_counts_from_then_on(world: World) -> None:
    lease = world.leases.acquire(BENCH, for_s=10.0)
    world.clock.advance(9.0)
    assert world.leases.renew(lease.id).until_s == 119.0
    world.clock.advance(9.0)
    assert world.leases.renew(lease.id, 2.0).until_s == 120.0
    world.clock.advance(2.0)
    refused("lease_over", lambda: world.leases.renew(lease.id))


def test_a_lease_is_released_once(world: World) -> None:
    lease = world.leases.acquire(BENCH)
    world.leases.release(lease.id)
    assert "released" in refused("lease_over", lambda: world.leases.release(lease.id))
    world.steer(ROVER)


def test_who_takes_over_steers_and_the_former_holder_hears_by_whom_and_why(world: World) -> None:
    former = world.leases.acquire(BENCH)
    lease = world.leases.take(ROVER, "the bench is empty")
    words = refused("lease_over", lambda: world.steer(BENCH, former))
    assert "rover took over: the bench is empty" in words
    world.steer(ROVER, lease)
    refused("lease_over", lambda: world.leases.release(former.id))  # the former id releases nobody else's


def test_without_a_lease_the_client_that_starts_something_steers(world: World) -> None:
    world.steer(BENCH, starts=True)
    assert world.leases.control() == {"holder": "bench", "kind": "operation", "for_s": None, "until": None}
    refused("leased", lambda: world.steer(ROVER))
    refused("leased", lambda: world.leases.acquire(ROVER))
    world.steer(BENCH)
    world.runs = False
    assert world.leases.control() is None
    world.steer(ROVER)


def test_nobody_gets_a_lease_while_anothers_command_is_under_way(world: World) -> None:
    with world.leases.steering(BENCH, None):
        refused("leased", lambda: world.leases.acquire(ROVER))
        refused("leased", lambda: world.steer(ROVER))
    world.leases.acquire(ROVER)


def test_all_who_tell_no_name_are_one_party(world: World) -> None:
    world.steer(Caller(), starts=True)
    world.steer(Caller(via="unix"))
    refused("leased", lambda: world.steer(BENCH))


def test_what_a_holder_started_is_its_own_until_it_is_stopped(world: World) -> None:
    lease = world.leases.acquire(BENCH, for_s=5.0)
    world.steer(BENCH, lease, starts=True)
    world.clock.advance(6.0)
    assert world.steerer() == "bench, operation"
    refused("leased", lambda: world.leases.acquire(ROVER))
    world.leases.stop_left_running()
    assert world.leases.control() is None
    world.steer(ROVER, world.leases.acquire(ROVER))


def test_a_command_that_fails_leaves_nobody_steering(world: World) -> None:
    with pytest.raises(ZeroDivisionError), world.leases.steering(BENCH, None):
        raise ZeroDivisionError
    assert world.leases.control() is None


def test_each_change_is_told_once_an_end_by_time_when_somebody_asks(world: World) -> None:
    lease = world.leases.acquire(BENCH, for_s=10.0)
    lease = world.leases.renew(lease.id, 20.0)
    world.leases.release(lease.id)
    world.leases.acquire(ROVER, for_s=1.0)
    world.clock.advance(2.0)
    refused("lease_over", lambda: world.leases.renew(lease.id))
    assert world.changes == ["bench, lease", "bench, lease", None, "rover, lease", None]


def test_a_stop_ends_no_other_lease(world: World) -> None:
    lease = world.leases.acquire(BENCH)
    world.leases.stop_came()
    world.steer(BENCH, lease)


def test_a_lease_that_ends_with_a_stop_ends_with_nothing_else(world: World) -> None:
    lease = world.leases.acquire(BENCH, last_stop=world.leases.last_stop)
    refused("leased", lambda: world.steer(ROVER))
    refused("leased", lambda: world.leases.acquire(ROVER))
    world.leases.renew(lease.id)
    assert not world.leases.was_stopped(lease)
    with world.leases._lock:  # whoever holds it, the stop waits for nobody
        world.leases.stop_came()
        assert world.leases.was_stopped(lease) and world.leases.control() is None
    assert "the head was stopped" in refused("lease_over", lambda: world.steer(BENCH, lease))
    world.leases.stop_left_running()
    assert world.stops == [], "the stop has come already"


def test_a_lease_ends_with_the_token_that_it_was_granted_to(world: World) -> None:
    shown = {"of a token"}
    world.leases.token_is_valid = shown.__contains__
    inside = world.leases.acquire(BENCH)
    assert world.leases.holds(inside.id), "who showed none keeps it"
    world.leases.release(inside.id)
    for grant in (world.leases.acquire, lambda caller: world.leases.take(caller, "a test")):
        shown.add("of a token")
        lease = grant(Caller("bench", credential="of a token"))
        assert world.leases.renew(lease.id).caller.credential == "of a token"
        shown.clear()
        assert world.leases.control() is None
        assert not world.leases.holds(lease.id)
        with pytest.raises(NotNow, match="token"):
            world.leases.renew(lease.id)
        world.leases.release(world.leases.acquire(ROVER).id)


def test_what_runs_is_stopped_when_its_lease_runs_out(world: World) -> None:
    lease = world.leases.acquire(ROVER, for_s=2.0)
    world.steer(ROVER, lease, starts=True)
    world.clock.advance(1.9)
    world.leases.renew(lease.id)
    world.clock.advance(1.9)
    world.leases.stop_left_running()
    assert world.runs
    world.clock.advance(0.2)
    world.leases.stop_left_running()
    world.leases.stop_left_running()
    assert world.stops == ["rover began it, and its lease has ended: the lease was not renewed for 2 s"]


def test_a_token_that_ends_stops_what_runs_under_its_lease(world: World) -> None:
    caller = Caller("rover", credential="of a token")
    world.steer(caller, world.leases.acquire(caller), starts=True)
    world.leases.token_is_valid = lambda credential: False
    world.leases.stop_left_running()
    assert len(world.stops) == 1 and "token" in world.stops[0]


@pytest.mark.parametrize("how", ["it was released", "bench took over: it is my turn"])
def test_a_released_or_taken_lease_stops_what_runs_under_it(world: World, how: str) -> None:
    lease = world.leases.acquire(ROVER, for_s=2.0)
    world.steer(ROVER, lease, starts=True)
    if how == "it was released":
        world.leases.release(lease.id)
    else:
        assert world.leases.take(BENCH, "it is my turn").holder == "bench"
    assert not world.runs
    assert world.stops == [f"rover began it, and its lease has ended: {how}"]


def test_a_command_under_way_when_its_lease_ends_is_stopped_too(world: World) -> None:
    lease = world.leases.acquire(ROVER)
    with world.leases.steering(ROVER, lease.id):
        world.leases.release(lease.id)
        world.runs = True
    world.leases.stop_left_running()
    assert world.stops == ["rover began it, and its lease has ended: it was released"]


def test_what_runs_without_a_lease_is_taken_over_and_goes_on(world: World) -> None:
    world.steer(BENCH, starts=True)
    world.leases.take(ROVER, "it is my turn")
    assert world.runs and world.stops == []


def test_the_stop_at_a_leases_end_is_sent_until_the_head_confirms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lease_module, "AGAIN_S", 0.01)
    runs, sent = list[bool](), list[str]()

    def unconfirmed_twice(why: str) -> None:
        runs.clear()  # the operation ends in any case
        sent.append(why)
        if len(sent) < 3:
            raise NoReply("the head did not answer", device="pan_tilt")

    leases = LeaseTable(SystemClock(), lambda: bool(runs), stop=unconfirmed_twice)
    watching = threading.Thread(target=leases.watch)
    watching.start()
    lease = leases.acquire(ROVER, for_s=SHORTEST_S)
    with leases.steering(ROVER, lease.id):
        runs[:] = [True]
    until(lambda: len(sent) == 3, "the stop that the head confirms")
    assert set(sent) == {"rover began it, and its lease has ended: the lease was not renewed for 1 s"}
    leases.close()
    joined(watching)


def test_a_lease_that_is_taken_is_none_if_the_head_did_not_stop(world: World) -> None:
    def unconfirmed(why: str) -> None:
        raise NoReply("the head did not answer", device="pan_tilt")

    world.runs, world.leases = True, LeaseTable(world.clock, lambda: True, stop=unconfirmed)
    leases = world.leases
    lease = leases.take(ROVER, "a test")
    with leases.steering(ROVER, lease.id):
        pass
    with pytest.raises(NoReply):
        leases.take(BENCH, "it hangs")
    assert world.steerer() == "rover, operation"


def test_a_refused_command_does_not_make_its_client_the_owner_of_what_runs(world: World) -> None:
    world.steer(BENCH, starts=True)
    lease = world.leases.take(ROVER, "it is my turn")
    with pytest.raises(NotNow), world.leases.steering(ROVER, lease.id):
        raise NotNow("busy", "operation 000001 is running")
    world.leases.release(lease.id)
    world.steer(BENCH)
    assert "bench steers" in refused("leased", lambda: world.steer(ROVER))
