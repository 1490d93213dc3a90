"""Commands from outside: who steers, once and not twice, until when, and what is left of it."""

from __future__ import annotations

import itertools
import json
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from hil_tests.mastctl.service_fakes import PLAIN, FakeHardware, ScriptedLoop, fake_daemon
from hil_tests.waiting import NET_S, joined, until
from mastctl.client import Client, ClientError
from mastctl.control.audit import AuditLog
from mastctl.control.caller import Caller
from mastctl.daemon import RunningDaemon
from mastctl.errors import Stopped
from mastctl.safety.stop_line import ask

ANGLES = {"pan_rad": 0.1, "tilt_rad": -0.1}
Pair = tuple[RunningDaemon, FakeHardware]


@pytest.fixture
def bench(pair: Pair) -> Iterator[Client]:
    with Client(pair[0].url, name="bench") as client:
        yield client


@pytest.fixture
def rover(pair: Pair) -> Iterator[Client]:
    with Client(pair[0].url, name="rover") as client:
        yield client


@pytest.fixture
def web(pair: Pair) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{pair[0].url}/api/v1", **PLAIN) as client:
        yield client


@pytest.fixture
def quiet(standing: Pair) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{standing[0].url}/api/v1", **PLAIN) as client:
        yield client


def refused(code: str, act: Callable[[], object]) -> ClientError:
    with pytest.raises(ClientError) as refusal:
        act()
    assert refusal.value.code == code
    return refusal.value


def waits(request: Any, record: Callable[[Any], None], cancelled: threading.Event, devices: Any) -> None:
    """A pointing that goes on until it is ended."""
    devices.move(0.1, -0.1)
    assert cancelled.wait(NET_S)
    raise Stopped("cancelled")


def moves(hardware: FakeHardware) -> int:
    return sum(call[0] == "move" for call in hardware.head.calls)


# Who steers


def test_while_one_program_holds_the_lease_another_is_told_who_and_moves_nothing(
    bench: Client, rover: Client, pair: Pair
) -> None:
    with bench.lease(for_s=3600.0):
        for command in (
            lambda: rover.point(**ANGLES),
            lambda: rover.start_track(position_m=(5.0, 0.0, 0.0)),
            rover.look,
            rover.stop_track,
            lambda: rover.use_mast("little.yaml"),
            rover.use_former_mast,
            lambda: rover.acquire_lease(),
        ):
            error = refused("leased", command)
            assert error.detail is not None
            assert (error.detail["holder"], error.detail["kind"]) == ("bench", "lease")
        assert moves(pair[1]) == 0
        control = rover.status()["control"]
        assert (control["holder"], control["kind"]) == ("bench", "lease")
        assert 3600.0 - NET_S < control["for_s"] <= 3600.0
        assert rover.control() is not None
        bench.wait(bench.point(**ANGLES))
    assert rover.status()["control"] is None
    rover.wait(rover.point(**ANGLES))
    assert moves(pair[1]) == 2


def test_the_holders_name_alone_does_not_steer(bench: Client, pair: Pair) -> None:
    with bench.lease(), Client(pair[0].url, name="bench") as another:
        refused("leased", lambda: another.point(**ANGLES))


def test_a_stop_and_a_pose_need_no_lease(bench: Client, rover: Client, pair: Pair) -> None:
    with bench.lease():
        assert rover.stop()["stopped"]
        rover.pose([0, 0, 0], [1, 0, 0, 0])
    assert ("stop",) in pair[1].head.calls


def test_without_a_lease_who_started_what_runs_steers_until_it_ends(
    bench: Client, rover: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    operation = bench.point(**ANGLES)
    assert refused("leased", lambda: rover.point(**ANGLES)).detail == {
        "holder": "bench", "kind": "operation", "for_s": None, "until": None,
    }  # fmt: skip
    refused("leased", rover.acquire_lease)
    refused("busy", lambda: bench.point(**ANGLES))
    rover.stop()
    bench.wait(operation)
    until(lambda: rover.status()["control"] is None, "nobody steers")
    rover.acquire_lease()


def test_who_takes_over_steers_and_the_former_holder_learns_it_by_itself(
    bench: Client, rover: Client
) -> None:
    with bench.lease(for_s=4.0) as held, rover.lease(take_over="the bench is empty"):
        error = refused("lease_over", lambda: bench.point(**ANGLES))
        assert "rover took over: the bench is empty" in str(error)
        until(lambda: held.lost is not None, "the holder's thread learns it")
        assert held.lost is not None
        assert held.lost.code == "lease_over"
        rover.wait(rover.point(**ANGLES))
    bench.wait(bench.point(**ANGLES))


def test_a_held_lease_is_renewed_beyond_its_time_and_released_at_the_end(bench: Client, pair: Pair) -> None:
    leases = pair[0].service.leases
    with bench.lease(for_s=4.0) as held:
        first_s = leases._lease.until_s  # type: ignore[union-attr]
        until(lambda: (leases._lease or held).until_s > first_s + 1.5, "two renewals")  # type: ignore
        assert held.lost is None
    assert bench.control() is None


def test_two_programs_that_race_for_the_rover_never_steer_at_once(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, hardware = pair
    inside, both, done = list[str](), list[str](), dict[str, int]()
    turns = 5

    def program(name: str, leased: bool) -> None:
        with Client(daemon.url, name=name) as client:
            while done.get(name, 0) < turns:
                try:
                    if leased:
                        with client.lease(for_s=30.0):
                            inside.append(name)
                            both.extend(one for one in inside if one != name)
                            record = client.wait(client.point(**ANGLES))
                            inside.remove(name)
                    else:
                        record = client.wait(client.point(**ANGLES))
                except ClientError as error:
                    assert error.code in ("leased", "busy"), error
                    continue
                assert record["state"] == "done"
                done[name] = done.get(name, 0) + 1

    threads = [
        threading.Thread(target=program, args=(name, name != "plain"))
        for name in ("first", "second", "plain")
    ]
    for thread in threads:
        thread.start()
    joined(*threads)
    assert both == []
    assert done == {"first": turns, "second": turns, "plain": turns}
    assert moves(hardware) == 3 * turns
    records = sorted(daemon.service.operations.all(), key=lambda one: one.created_s)
    assert all(
        one.ended_s is not None and one.ended_s <= other.created_s
        for one, other in itertools.pairwise(records)
    )


def test_a_lease_can_be_shown_taken_and_given_back_by_hand(bench: Client, rover: Client) -> None:
    granted = bench.acquire_lease(for_s=600.0)
    assert (granted["holder"], granted["for_s"]) == ("bench", pytest.approx(600.0, abs=NET_S))
    refused("leased", lambda: bench.point(**ANGLES))
    bench.use_lease(granted["lease_id"])
    assert bench.renew_lease(3600.0)["for_s"] == pytest.approx(3600.0, abs=NET_S)
    bench.release_lease()
    refused("lease_over", bench.release_lease)
    bench.use_lease("0" * 32)
    refused("lease_unknown", lambda: bench.point(**ANGLES))


@pytest.mark.parametrize(
    ("path", "body", "words"),
    [
        ("/lease", {"for_s": 0.5}, "for_s: 0.5 where"),
        ("/lease", {"for_s": 3601}, "for_s: 3601 where"),
        ("/lease", {"fors": 5}, "fors: unknown key"),
        ("/lease/take", {}, "reason is missing"),
        ("/lease/take", {"reason": "  "}, "reason:"),
        ("/lease/renew", {}, "Mastctl-Lease is missing"),
    ],
)
def test_what_is_wrong_with_a_lease_is_one_sentence(
    quiet: httpx.Client, path: str, body: dict[str, Any], words: str
) -> None:
    answer = quiet.post(path, json=body)
    assert answer.status_code == 422
    assert words in answer.json()["error"]["message"]
    assert quiet.get("/lease").json() == {"control": None}


# Once and not twice


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/limits/sun", {"direction": [-1, 0, 0], "frame": "rover", "half_angle_rad": 0.1}),
        ("/pose", {"position_m": [0, 0, 0], "quaternion": [1, 0, 0, 0]}),
    ],
)
def test_a_head_under_way_into_what_comes_to_be_kept_out_is_stopped(
    web: httpx.Client, pair: Pair, monkeypatch: pytest.MonkeyPatch, path: str, body: dict[str, Any]
) -> None:
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    name = web.post("/point", json=ANGLES).json()["id"]
    until(lambda: web.get(f"/operations/{name}").json()["state"] == "running", "it runs")
    assert web.post(path, json=body).status_code == 200
    assert web.get(f"/operations/{name}").json()["state"] == "running"
    door = pair[0].service.devices.door
    monkeypatch.setattr(door, "in_the_way", lambda reading: "sun")
    assert web.post(path, json=body).status_code == 200
    until(lambda: web.get(f"/operations/{name}").json()["state"] == "stopped", "it is stopped")
    assert "keep-out sun" in web.get(f"/operations/{name}").json()["error"]["message"]
    assert ("stop",) in pair[1].head.calls


def test_a_key_that_released_one_lease_does_not_tell_that_the_next_one_is_released(web: httpx.Client) -> None:
    def acquired() -> dict[str, str]:
        lease = web.post("/lease", json={}, headers={"Mastctl-Client": "bench"}).json()["lease_id"]
        return {"Idempotency-Key": "a-key", "Mastctl-Client": "bench", "Mastctl-Lease": lease}

    for send in (
        lambda headers: web.request("DELETE", "/lease", headers=headers),
        lambda headers: web.post("/lease/renew", headers={**headers, "Idempotency-Key": "another"}),
    ):
        first = acquired()
        assert send(first).status_code == 200
        web.request("DELETE", "/lease", headers={"Mastctl-Lease": first["Mastctl-Lease"]})
        second = acquired()
        assert send(second).json()["error"]["code"] == "key_reused"
        assert web.get("/lease").json()["control"]["holder"] == "bench"
        web.request("DELETE", "/lease", headers={"Mastctl-Lease": second["Mastctl-Lease"]})


KEYED = {"Mastctl-Client": "bench", "Idempotency-Key": "a-key"}


@pytest.mark.parametrize("path", ["/lease", "/lease/take"])
@pytest.mark.parametrize("name", [{}, {"Mastctl-Client": "anonymous"}], ids=["no name", "anonymous"])
def test_nobody_shares_a_lease_by_a_key_without_a_name(
    web: httpx.Client, path: str, name: dict[str, str]
) -> None:
    body = {"reason": "work"} if path.endswith("take") else {}
    for _ in range(2):
        answer = web.post(path, json=body, headers={"Idempotency-Key": "1", **name})
        assert (answer.status_code, answer.json()["error"]["code"]) == (422, "bad_request")
        assert "Mastctl-Client" in answer.json()["error"]["message"]
        assert "lease_id" not in answer.text
    assert web.get("/lease").json() == {"control": None}


def test_a_lease_whose_answer_was_lost_is_had_by_its_key_while_it_holds_and_no_longer(
    web: httpx.Client, pair: Pair
) -> None:
    leases = pair[0].service.leases
    first = web.post("/lease", json={}, headers=KEYED).json()
    assert web.post("/lease", json={}, headers=KEYED).json() == first

    def ended(key: dict[str, str], lease: str, path: str = "/lease", body: Any = None) -> str:
        headers = {**key, "Mastctl-Lease": lease}
        answer = web.post(path, json={} if body is None else body, headers=headers)
        told = answer.json()["error"]
        assert (answer.status_code, told["code"]) == (409, "lease_over")
        assert told["message"].endswith("with another Idempotency-Key")
        return str(told["message"])

    renewal = {**KEYED, "Idempotency-Key": "renewal"}
    held = {"Mastctl-Lease": first["lease_id"]}
    assert web.post("/lease/renew", headers={**renewal, **held}).status_code == 200
    web.request("DELETE", "/lease", headers=held).raise_for_status()
    assert "it was released" in ended(KEYED, "")
    assert "it was released" in ended(renewal, first["lease_id"], "/lease/renew")

    take = {**KEYED, "Idempotency-Key": "take"}
    reason = {"reason": "work"}
    second = web.post("/lease/take", json=reason, headers=take).json()
    leases.take(Caller("rover"), "mine")
    assert "rover took over: mine" in ended(take, second["lease_id"], "/lease/take", reason)
    leases.take(Caller("bench"), "back")
    ending = {**KEYED, "Idempotency-Key": "ending"}
    leases._end("the test goes on")
    web.post("/lease", json={"ends_with_stop": True}, headers=ending).raise_for_status()
    web.post("/stop").raise_for_status()
    assert "the head was stopped" in ended(ending, "", body={"ends_with_stop": True})
    assert web.get("/lease").json() == {"control": None}


def test_a_key_from_before_a_restart_grants_a_lease_that_holds(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    granted = []
    for _ in range(2):
        with fake_daemon(monkeypatch, tmp_path) as (daemon, _), httpx.Client(**PLAIN) as web:
            url = f"{daemon.url}/api/v1/lease"
            granted.append(web.post(url, json={}, headers=KEYED).json()["lease_id"])
            assert daemon.service.leases.holds(granted[-1])
            if len(granted) == 2:
                answer = web.post(f"{url}/renew", headers={"Mastctl-Lease": granted[0]})
                assert answer.json()["error"]["code"] == "lease_unknown"
    assert granted[0] != granted[1]


def test_what_a_dead_client_began_is_stopped_if_its_lease_says_so(
    bench: Client, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    granted = bench.acquire_lease(for_s=1.0, stops_when_silent=True)
    bench.use_lease(granted["lease_id"])
    operation = bench.point(**ANGLES)
    record = bench.wait(operation, NET_S)  # nobody renews the lease
    assert record["state"] == "stopped"
    assert record["error"] is not None
    assert "bench began it and has fallen silent: its 1 s were over" in record["error"]["message"]


def test_a_command_sent_twice_with_one_key_is_carried_out_once(web: httpx.Client, pair: Pair) -> None:
    headers = {"Idempotency-Key": "a-key", "Mastctl-Client": "bench"}
    first = web.post("/point", json=ANGLES, headers=headers)
    again = web.post("/point", json=ANGLES, headers=headers)
    assert (first.status_code, first.json()) == (again.status_code, again.json())
    other = web.post("/point", json={"pan_rad": 0.2, "tilt_rad": 0.0}, headers=headers)
    assert (other.status_code, other.json()["error"]["code"]) == (422, "key_reused")
    until(lambda: moves(pair[1]) == 1, "the move")
    assert len(web.get("/operations").json()["operations"]) == 1


def test_a_key_is_one_callers(web: httpx.Client) -> None:
    ids = set()
    for name in ("bench", "rover"):
        headers = {"Idempotency-Key": "1", "Mastctl-Client": name}
        operation = web.post("/point", json=ANGLES, headers=headers).json()["id"]
        until(
            lambda operation=operation: web.get(f"/operations/{operation}").json()["state"] == "done",  # type: ignore[misc]
            "its end",
        )
        ids.add(operation)
    assert len(ids) == 2


class Dropping:
    """A way to the daemon on which answers are lost: ``drop`` of them, after the request went through."""

    def __init__(self, url: str, drop: int) -> None:
        self.drop = drop
        self._to = urlsplit(url)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._work, daemon=True).start()

    def _work(self) -> None:
        while True:
            try:
                came, _ = self._listener.accept()
            except OSError:
                return
            with came, socket.create_connection((self._to.hostname, self._to.port)) as on:  # type: ignore[arg-type]
                request = b""
                while b"\r\n\r\n" not in request or not request.endswith(b"}"):
                    request += came.recv(65536)
                on.sendall(request.replace(b"keep-alive", b"close"))
                answer = b""
                while part := on.recv(65536):
                    answer += part
                if self.drop:
                    self.drop -= 1
                else:
                    came.sendall(answer)

    def close(self) -> None:
        self._listener.close()


def test_a_command_whose_answer_is_lost_is_sent_again_and_carried_out_once(pair: Pair) -> None:
    daemon, hardware = pair
    way = Dropping(daemon.url, drop=2)
    with Client(way.url, name="bench") as client:
        operation = client.point(**ANGLES)
    way.close()
    assert way.drop == 0
    with Client(daemon.url) as client:
        client.wait(operation)
    assert [one.id for one in daemon.service.operations.all()] == [operation]
    assert moves(hardware) == 1


def test_a_command_whose_answers_are_all_lost_says_that_the_connection_broke(pair: Pair) -> None:
    way = Dropping(pair[0].url, drop=3)
    with Client(way.url) as client:
        assert "broke" in str(refused("no_daemon", lambda: client.point(**ANGLES)))
    way.close()


# Until when


def test_an_operation_beyond_its_deadline_ends_with_the_head_stopped(
    bench: Client, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    record = bench.wait(bench.point(**ANGLES, deadline_s=0.1))
    assert record["state"] == "failed"
    assert record["error"]["code"] == "deadline_passed"
    assert ("stop",) in pair[1].head.calls
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(ScriptedLoop.good))
    assert bench.wait(bench.point(**ANGLES))["state"] == "done"


def test_the_shorter_of_the_deadlines_of_header_and_body_counts(
    web: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    for header, body in (("0.1", 60.0), ("60", 0.1)):
        answer = web.post("/point", json={**ANGLES, "deadline_s": body}, headers={"Deadline-S": header})
        operation = answer.json()["id"]
        until(lambda op=operation: web.get(f"/operations/{op}").json()["error"], "the deadline")  # type: ignore[misc]
        assert web.get(f"/operations/{operation}").json()["error"]["code"] == "deadline_passed"


@pytest.mark.parametrize("deadline", ["0", "-1", "3601", "nan", "inf", "soon", ""])
def test_a_deadline_that_is_none_is_refused_by_a_command_and_nothing_to_a_stop(
    quiet: httpx.Client, standing: Pair, deadline: str
) -> None:
    answer = quiet.post("/point", json=ANGLES, headers={"Deadline-S": deadline})
    assert answer.status_code == 422
    assert "eadline" in answer.json()["error"]["message"]
    assert moves(standing[1]) == 0
    headers = {"Deadline-S": deadline, "Mastctl-Lease": "none", "Idempotency-Key": "\x7f" * 300}
    assert quiet.post("/stop", headers=headers).json()["stopped"]


# What is left of it


def test_each_command_leaves_a_line_and_its_operation_another(
    bench: Client, rover: Client, pair: Pair, tmp_path: Path
) -> None:
    path = tmp_path / "audit.jsonl"
    entry = pair[0].service.entry
    entry.audit = AuditLog(path)
    with bench.lease() as held:
        operation = bench.point(**ANGLES)
        bench.wait(operation)
        refused("leased", lambda: rover.point(**ANGLES))
        rover.stop()

    def lines() -> list[dict[str, Any]]:
        assert entry.audit.flush(NET_S)
        return [json.loads(line) for line in path.read_text().splitlines()]

    until(lambda: any("ended" in line for line in lines()), "the operation's line")
    told = [(line["command"], line["who"], line.get("result", line.get("state"))) for line in lines()]
    assert sorted(told) == sorted(
        [
            ("lease", "bench", "ok"),
            ("point", "bench", "ok"),
            ("point", "bench", "done"),
            ("point", "rover", "leased"),
            ("stop", "rover", "ok"),
            ("lease.release", "bench", "ok"),
        ]
    )
    point = next(line for line in lines() if line["command"] == "point")
    assert point["request"] == {**ANGLES, "pointings": 1}
    assert (point["operation"], point["lease"]) == (operation, held.id[:8])
    assert held.id not in path.read_text()
    entry.audit.close()


def test_a_stop_is_answered_while_every_lock_of_the_entry_is_held_and_the_disk_hangs(
    pair: Pair, tmp_path: Path
) -> None:
    daemon, hardware = pair
    service = daemon.service
    locks = [service.leases._lock, service.entry._matching, service.entry._answers._changed]
    with Client(daemon.url, timeout_s=NET_S) as client:
        for lock in locks:
            lock.__enter__()
        try:
            assert client.stop()["stopped"]
        finally:
            for lock in locks:
                lock.__exit__(None, None, None)
    assert ("stop",) in hardware.head.calls


def test_what_a_caller_is_called_comes_from_its_header_and_any_header_will_do(
    web: httpx.Client, pair: Pair
) -> None:
    for name in ("bench", "", "é", "a" * 500, "<b>"):
        web.post("/lease", json={"for_s": 1.0}, headers={"Mastctl-Client": name.encode("latin-1")})  # type: ignore[dict-item]
        control = web.get("/lease").json()["control"]
        assert control["holder"] == (name[:80] or "anonymous")
        pair[0].service.leases._end("the test goes on")


def test_every_route_that_changes_something_passes_the_entry(
    pair: Pair, web: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = {"/login", "/logout", "/point/preview"}  # of who asks, not of the rover; and what changes nothing
    document = web.get(f"{pair[0].url}/openapi.json").json()
    asked = {
        (method, path.removeprefix("/api/v1"))
        for path, methods in document["paths"].items()
        for method in methods
        if method in ("post", "put", "patch", "delete")
    }
    assert len(asked) > 15
    for method, path in sorted(asked):
        if path in none:
            continue
        if path in ("/stop", "/estop"):
            continue  # the tests of the stop's way ask for their lines
        names = {
            one["name"].lower() for one in document["paths"][f"/api/v1{path}"][method].get("parameters", ())
        }
        headers = {"mastctl-client", "mastctl-lease", "idempotency-key", "deadline-s"}
        assert headers <= names, (method, path)


def test_commands_and_leases_are_published(bench: Client, pair: Pair) -> None:
    publisher = pair[0].service.machine.publisher
    with publisher.subscribe("command", "lease", known=False) as heard, bench.lease():
        bench.wait(bench.point(**ANGLES))
        told: list[Any] = []

        def all_heard() -> bool:
            told.extend(heard.wait(0.1))
            return any("ended" in one.value for one in told if one.topic == "command")

        until(all_heard, "the operation's end")
    assert [one.value["holder"] for one in told if one.topic == "lease"] == ["bench"]
    assert [one.value["command"] for one in told if one.topic == "command"] == ["lease", "point", "point"]


def test_what_the_machine_refuses_is_refused_before_anything_is_looked_at(bench: Client) -> None:
    bench.estop(reason="a test", name="bench")
    refused("estopped", lambda: bench.point(pixel=("no_such_camera", "x", 1.0, 1.0)))
    bench.reset(reason="a test", name="bench")
    refused("not_estopped", lambda: bench.reset(reason="again", name="bench"))


def test_stops_over_http_and_over_their_own_socket_leave_their_lines(
    pair: Pair, bench: Client, tmp_path: Path
) -> None:
    service = pair[0].service
    service.open_stop_socket()
    path = service.folder.path / "audit.jsonl"
    assert service.stop_socket is not None
    assert ask(service.stop_socket.path, "stop")["stopped"]
    assert ask(service.stop_socket.path, "estop rover: smoke")["latched"]
    bench.reset(reason="no fire", name="bench")
    bench.estop(reason="smoke again", name="bench")
    assert service.audit.flush(NET_S)
    told = [json.loads(line) for line in path.read_text().splitlines()]
    assert [(line["command"], line["via"], line["result"]) for line in told] == [
        ("stop", "stop socket", "ok"),
        ("estop", "stop socket", "ok"),
        ("reset", "loopback", "ok"),
        ("estop", "loopback", "ok"),
    ]
    assert [line["request"].get("reason") for line in told] == [None, "smoke", "no fire", "smoke again"]
    assert path.stat().st_mode & 0o777 == 0o600
