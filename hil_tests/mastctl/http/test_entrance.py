"""Attacks on a daemon that other machines reach: by pages of other sites, without a token, by a wrong one."""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
from collections.abc import Iterator
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from hil_tests.mastctl.service_fakes import PLAIN, FakeHardware, fake_daemon
from hil_tests.mastctl.web.network import NAME, Network, network_daemon
from hil_tests.waiting import NET_S, until
from mastctl.answers import Role
from mastctl.http import guard
from mastctl.http.access import MOST_OF_ONE

ANGLES = {"pan_rad": 0.1, "tilt_rad": -0.1}


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with pytest.MonkeyPatch.context() as patch, network_daemon(patch, tmp_path_factory.mktemp("net")) as made:
        yield made


@pytest.fixture
def net(held: Network) -> Network:
    held.daemon.service.stopping.stop()
    held.hardware.head.calls.clear()
    return held


def code(answer: httpx.Response) -> tuple[int, str]:
    """Status and word of a refusal, or of an answer an empty word."""
    if answer.is_success:
        return answer.status_code, ""
    return answer.status_code, answer.json()["error"]["code"]


def moves(net: Network) -> list[Any]:
    return [call for call in net.hardware.head.calls if call[0] == "move"]


# Tokens


def described(net: Network) -> Iterator[tuple[str, str]]:
    """Method and path of every route."""
    document = net.ask("GET", str(httpx.URL(f"{net.url}/openapi.json")), "view").json()
    for path, methods in document["paths"].items():
        for method in methods:
            yield method.upper(), path


def test_every_route_but_the_stops_and_the_log_in_asks_for_a_token(net: Network) -> None:
    asked = {}
    for method, path in described(net):
        filled = path.replace("{camera}", "navcam_left").replace("{operation_id}", "x")
        answer = net.ask(method, f"{net.url}{filled}", json={} if method == "POST" else None)
        asked[f"{method} {path.removeprefix('/api/v1')}"] = code(answer)
    free = {route for route, (status, word) in asked.items() if word != "no_token"}
    assert free == {"POST /stop", "POST /estop", "POST /login"}
    assert len(asked) > 15
    assert asked["POST /stop"] == asked["POST /estop"] == (200, "")
    assert net.ask("POST", "/reset", "admin", json={"reason": "a test", "name": "a test"}).status_code == 200


def test_a_recording_is_deleted_by_an_administrator_only(net: Network) -> None:
    assert code(net.ask("DELETE", "/recordings/x", "view")) == (403, "role")
    assert code(net.ask("DELETE", "/recordings/x", "operate")) == (403, "role")
    assert code(net.ask("DELETE", "/recordings/x", "admin")) == (404, "recording_unknown")


def test_what_is_no_route_asks_for_a_token_too(net: Network) -> None:
    for path in ("/openapi.json", "/api/v1/nothing", "/api/v1/../v1/status", "/redoc", "/api/v1//status"):
        assert code(net.ask("GET", f"{net.url}{path}")) == (401, "no_token"), path


def test_the_refusal_says_how_to_show_a_token(net: Network) -> None:
    answer = net.ask("GET", "/status")
    assert answer.headers["www-authenticate"] == "Bearer"
    assert "Authorization: Bearer" in answer.json()["error"]["message"]


@pytest.mark.parametrize("role", ["view", "operate", "admin"])
def test_a_token_reads_and_only_those_of_operators_and_up_change_things(net: Network, role: Role) -> None:
    assert net.ask("GET", "/status", role).status_code == 200
    assert net.ask("GET", "/snapshot/navcam_left", role).status_code == 200
    answer = net.ask("POST", "/point", role, json=ANGLES)
    assert code(answer) == ((403, "role") if role == "view" else (202, ""))
    if role == "view":
        assert moves(net) == []


def test_view_may_stop_and_say_who_it_is(net: Network) -> None:
    assert net.ask("POST", "/stop", "view").status_code == 200
    told = net.ask("GET", "/session", "view", headers={"Mastctl-Client": "wall display"}).json()
    assert (told["name"], told["role"], told["via"]) == ("view/wall display", "view", "token")
    assert told["needs_token"] is True and told["ends_in_s"] is None


@pytest.mark.parametrize(
    "shown",
    [
        "Basic dmlldzp2aWV3",
        "Bearer",
        "Bearer ",
        "Bearer wrong",
        "Bearer  a b",
        "bearer\tx",
        "Token x",
        "Bearer " + "A" * 43,
        "Bearer " + "A" * 4000,
        "Bearer é",
    ],
)
def test_what_is_no_token_opens_nothing(net: Network, shown: str) -> None:
    head = (
        f"GET /api/v1/status HTTP/1.1\r\nHost: {NAME}\r\nAuthorization: {shown}\r\nConnection: close\r\n\r\n"
    )
    assert net.raw(head).startswith((b"HTTP/1.1 401", b"HTTP/1.1 400", b"HTTP/1.1 429"))


@pytest.mark.parametrize("key", ["token", "access_token", "Authorization", "api_key", "TOKEN"])
def test_a_token_in_an_address_is_refused(net: Network, key: str) -> None:
    answer = net.ask("GET", "/status", params={key: net.token("admin")})
    assert code(answer) == (400, "token_in_address")
    assert net.token("admin") not in answer.text


def test_a_stop_needs_no_token_and_a_wrong_one_does_no_harm(net: Network) -> None:
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "nonsense"}, {"Cookie": "x=y"}):
        net.hardware.head.calls.clear()
        assert net.ask("POST", "/stop", headers=headers).status_code == 200
        assert ("stop",) in net.hardware.head.calls


@pytest.mark.parametrize("host", ["", "evil.example", "rover-by-another-name:8420"])
def test_a_stop_by_any_name_is_a_stop(net: Network, host: str) -> None:
    answer = net.raw(f"POST /api/v1/stop HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 200")
    assert net.raw("POST /api/v1/stop HTTP/1.0\r\n\r\n").startswith(b"HTTP/1.1 200")


def test_guessing_ends_in_silence_for_a_while_and_shuts_out_no_known_token_and_no_stop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with network_daemon(monkeypatch, tmp_path) as net:
        for number in range(MOST_OF_ONE):
            bearer = {"Authorization": f"Bearer guess{number}"}
            assert code(net.ask("GET", "/status", headers=bearer)) == (401, "wrong_token")
        answer = net.ask("GET", "/status", headers={"Authorization": "Bearer another"})
        assert code(answer) == (429, "too_many_guesses")
        assert 0 < int(answer.headers["retry-after"]) <= 60
        assert code(net.ask("POST", "/login", json={"token": "another"})) == (429, "too_many_guesses")
        assert net.ask("POST", "/stop").status_code == 200
        assert net.ask("POST", "/stop", "admin").status_code == 200
        lease = net.ask("POST", "/lease", "operate", json={})
        assert lease.status_code == 200, "the colleague at the same address"
        steering = {"Mastctl-Lease": lease.json()["lease_id"]}
        still = {"pan_rad_per_s": 0.0, "tilt_rad_per_s": 0.0}
        assert code(net.ask("POST", "/jog", "operate", json=still, headers=steering))[0] not in (401, 429)
        net.ask("POST", "/estop")
        why = {"reason": "a test", "name": "a test"}
        assert net.ask("POST", "/reset", "operate", json=why).status_code == 200
        assert net.ask("POST", "/login", json={"token": net.token("admin")}).status_code == 200


def test_a_new_token_opens_and_a_revoked_one_does_not_while_the_daemon_runs(net: Network) -> None:
    made = net.tokens.new("bench", "operate")
    bearer = {"Authorization": f"Bearer {made}"}
    until(lambda: net.ask("GET", "/status", headers=bearer).status_code == 200, "the new token")
    net.tokens.revoke("bench")
    until(lambda: net.ask("GET", "/status", headers=bearer).status_code == 401, "its end")


def test_no_token_stands_in_the_log(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG")
    with network_daemon(monkeypatch, tmp_path) as net:
        texts = [net.token(role) for role in ("view", "operate", "admin")]
        net.ask("GET", "/status", "admin")
        net.ask("GET", "/status", params={"token": texts[0]})
        net.ask("POST", "/login", json={"token": texts[1]})
        net.ask("GET", "/status", headers={"Authorization": "Bearer wrong"})
    own = "".join(one.getMessage() for one in caplog.records if not one.name.startswith("http"))
    assert str(net.tokens.folder) in own, "where they lie is told"
    assert not [text for text in texts if text in own]


# Pages of other sites


@pytest.mark.parametrize("host", ["evil.example", f"{NAME}.evil.example", "rover", "", "[", f"{NAME}@evil"])
def test_a_name_that_somebody_else_may_point_here_is_refused(net: Network, host: str) -> None:
    answer = net.raw(
        f"GET /api/v1/status HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n"
        f"Authorization: Bearer {net.token('admin')}\r\n\r\n"
    )
    assert answer.startswith(b"HTTP/1.1 403") and b"foreign_host" in answer


@pytest.mark.parametrize(
    "host", [NAME, f"{NAME.upper()}:1", "127.0.0.1", "localhost:8420", "[::1]:9", "10.1.2.3"]
)
def test_its_own_names_and_addresses_that_nobody_else_can_point_here_are_answered(
    net: Network, host: str
) -> None:
    assert net.ask("GET", "/status", "view", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", f"http://{NAME}:1", f"http://{NAME}", "", "https://[", f"ftp://{NAME}"],
)
@pytest.mark.parametrize("path", ["/stop", "/point", "/login", "/logout", "/track/stop"])
def test_another_sites_page_changes_nothing_not_even_by_a_stop(net: Network, origin: str, path: str) -> None:
    answer = net.ask("POST", path, "admin", json=ANGLES, headers={"Origin": origin})
    assert code(answer) == (403, "foreign_origin")
    assert net.hardware.head.calls == []


def test_a_rebound_page_that_agrees_with_itself_is_refused(net: Network) -> None:
    headers = {"Host": "evil.example:80", "Origin": "http://evil.example:80"}
    for path in ("/stop", "/point"):
        assert code(net.ask("POST", path, "admin", json=ANGLES, headers=headers)) == (403, "foreign_host")
    assert net.hardware.head.calls == []


@pytest.mark.parametrize("site", ["cross-site", "same-site", "Cross-Site", "nonsense"])
def test_another_sites_page_is_shown_nothing(net: Network, site: str) -> None:
    for path in ("/snapshot/navcam_left", "/status", "/track/stream", "/mast"):
        answer = net.ask("GET", path, "view", headers={"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "image"})
        assert code(answer) == (403, "foreign_origin"), path
    asked = net.ask("POST", "/stop", headers={"Sec-Fetch-Site": site})
    assert code(asked) == (403, "foreign_origin")


def test_the_own_page_and_programs_are_shown_everything(net: Network) -> None:
    for told in ({"Sec-Fetch-Site": "same-origin"}, {"Sec-Fetch-Site": "none"}, {}):
        assert net.ask("GET", "/snapshot/navcam_left", "view", headers=told).status_code == 200


def test_every_answer_may_be_embedded_by_nobody(net: Network) -> None:
    asked: list[tuple[str, str, Role | None]] = [
        ("GET", "/snapshot/navcam_left", "view"),
        ("GET", "/status", "view"),
        ("GET", "/status", None),
        ("GET", "/nothing", "view"),
        ("POST", "/stop", None),
    ]
    for method, path, role in asked:
        headers = net.ask(method, path, role).headers
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert headers["cache-control"] == "no-store"
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert "access-control-allow-origin" not in headers
        assert len(headers.get_list("content-security-policy")) == 1


def test_a_question_before_a_foreign_request_is_answered_with_no_permission(net: Network) -> None:
    told = {"Origin": "http://evil.example", "Access-Control-Request-Method": "POST"}
    answer = net.ask("OPTIONS", "/point", headers=told)
    assert not answer.is_success
    assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize(
    "kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""]
)
def test_what_a_form_of_a_page_can_send_is_no_command(net: Network, kind: str) -> None:
    answer = net.ask("POST", "/point", "admin", content=json.dumps(ANGLES), headers={"Content-Type": kind})
    assert code(answer) == (415, "not_json")
    assert net.hardware.head.calls == []


def test_nothing_is_changed_by_reading(net: Network) -> None:
    for method, path in described(net):
        if method == "GET" and not path.endswith(("stream", "events")):
            filled = path.replace("{camera}", "navcam_left").replace("{operation_id}", "x")
            net.ask("GET", f"{net.url}{filled}", "admin")
    assert [call for call in net.hardware.head.calls if call[0] != "read"] == []


def test_who_asks_is_not_who_a_header_says(net: Network) -> None:
    lies = {
        "X-Forwarded-For": "127.0.0.1",
        "X-Forwarded-Host": "localhost",
        "X-Forwarded-Proto": "https",
        "Forwarded": "for=127.0.0.1;host=localhost",
        "X-Real-IP": "127.0.0.1",
        "X-HTTP-Method-Override": "GET",
        "X-Original-URL": "/api/v1/stop",
    }
    assert code(net.ask("GET", "/status", headers=lies)) == (401, "no_token")
    rebound = {**lies, "Host": "evil.example"}
    assert code(net.ask("GET", "/status", "admin", headers=rebound)) == (403, "foreign_host")
    assert code(net.ask("POST", "/point", "view", json=ANGLES, headers=lies)) == (403, "role")


# Sessions of pages


def log_in(net: Network, role: Role = "operate") -> str:
    """A session's cookie, as a browser sends it."""
    answer = net.ask("POST", "/login", json={"token": net.token(role)}, headers={"Origin": net.origin})
    assert answer.status_code == 200, answer.text
    (morsel,) = SimpleCookie(answer.headers["set-cookie"]).values()
    return f"{morsel.key}={morsel.value}"


def test_a_session_is_a_cookie_that_no_script_and_no_other_site_gets(net: Network) -> None:
    answer = net.ask("POST", "/login", json={"token": net.token("operate")})
    (morsel,) = SimpleCookie(answer.headers["set-cookie"]).values()
    assert morsel.key == f"mastctl-{net.port}"
    assert morsel["httponly"] and morsel["samesite"] == "strict" and morsel["path"] == "/"
    assert not morsel["domain"] and not morsel["secure"] and int(morsel["max-age"]) == 12 * 3600
    assert net.token("operate") not in answer.headers["set-cookie"] + answer.text
    assert answer.json()["role"] == "operate" and answer.json()["ends_in_s"] > 0


def test_a_session_reads_and_drives_from_its_own_page(net: Network) -> None:
    cookie = {"Cookie": log_in(net)}
    assert net.ask("GET", "/snapshot/navcam_left", headers=cookie).status_code == 200
    own = {**cookie, "Origin": net.origin}
    assert net.ask("POST", "/point", json=ANGLES, headers=own).status_code == 202
    told = net.ask("GET", "/session", headers=cookie).json()
    assert told["role"] == "operate" and 0 < told["ends_in_s"] <= 12 * 3600


def test_a_session_without_an_origin_changes_nothing(net: Network) -> None:
    cookie = {"Cookie": log_in(net)}
    assert code(net.ask("POST", "/point", json=ANGLES, headers=cookie)) == (403, "foreign_origin")
    assert moves(net) == []


def test_two_sessions_in_one_request_are_none(net: Network) -> None:
    both = {"Cookie": f"{log_in(net)}; {log_in(net)}"}
    assert code(net.ask("GET", "/status", headers=both)) == (401, "no_token")


def test_the_cookie_of_another_port_is_no_session(net: Network) -> None:
    other = log_in(net).replace(f"mastctl-{net.port}", "mastctl-1")
    assert code(net.ask("GET", "/status", headers={"Cookie": other})) == (401, "no_token")


def test_a_session_ends_by_a_log_out(net: Network) -> None:
    cookie = {"Cookie": log_in(net), "Origin": net.origin}
    gone = net.ask("POST", "/logout", headers=cookie)
    assert gone.status_code == 200 and "Max-Age=0" in gone.headers["set-cookie"]
    assert code(net.ask("GET", "/status", headers=cookie)) == (401, "no_token")
    assert net.ask("POST", "/stop", headers=cookie).status_code == 200


def test_a_wrong_log_in_is_refused_and_a_body_that_is_none_too(net: Network) -> None:
    assert code(net.ask("POST", "/login", json={"token": "wrong log-in"})) == (401, "wrong_token")
    assert code(net.ask("POST", "/login", json={})) == (422, "bad_request")
    assert code(net.ask("POST", "/login", json={"token": "x" * 201})) == (422, "bad_request")
    assert code(net.ask("POST", "/login", json={"token": 7})) == (422, "bad_request")


# Names in headers


@pytest.mark.parametrize(
    "path",
    [
        "/snapshot/navcam_left%0d%0aX-Evil:%201",
        "/snapshot/..%2f..%2fetc%2fpasswd",
        "/snapshot/navcam_left?frame_id=a%0d%0aX-Evil:%201",
        "/operations/..%2f..%2fstop",
        "/operations/%00",
        "/snapshot/%ff%fe",
    ],
)
def test_what_stands_in_an_address_becomes_no_header_and_no_path(net: Network, path: str) -> None:
    answer = net.ask("GET", path, "view")
    assert answer.status_code in (404, 422)
    assert "x-evil" not in answer.headers and "root:" not in answer.text


@pytest.mark.parametrize(
    "file", ["../little.yaml", "/etc/passwd", "..", "a/../../b.yaml", "\x00.yaml", "daemon.yaml"]
)
def test_no_mast_file_is_taken_from_elsewhere(net: Network, file: str) -> None:
    answer = net.ask("POST", "/mast", "admin", json={"file": file})
    assert code(answer) == (422, "bad_mast_file")
    assert "root:" not in answer.text


def test_a_strange_name_of_a_client_is_one_printable_line(net: Network) -> None:
    name = "x\x1b[31m" + "y" * 500
    raw = net.raw(
        f"GET /api/v1/session HTTP/1.1\r\nHost: {NAME}\r\nAuthorization: Bearer {net.token('view')}\r\n"
        f"Mastctl-Client: {name.replace(chr(27), chr(0xE9))}\r\nConnection: close\r\n\r\n"
    )
    told = json.loads(raw.partition(b"\r\n\r\n")[2])["name"]
    assert told.startswith("view/x") and told.isprintable() and len(told) < 100


# What is recorded


def recorded(net: Network, strangers: bool = False) -> list[dict[str, Any]]:
    """The audit log, or that of strangers."""
    service = net.daemon.service
    log = service.strangers if strangers else service.audit
    assert log.flush(NET_S)
    path = service.folder.path / ("strangers.jsonl" if strangers else "audit.jsonl")
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_each_refusal_is_recorded_with_the_address_it_came_from(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with network_daemon(monkeypatch, tmp_path) as net:
        net.ask("POST", "/point", "view", json=ANGLES)
        net.ask("POST", "/point", "operate", json={"pan_rad": "left"}, headers={"Mastctl-Client": "x"})
        net.ask("POST", "/point", "operate", content=b"{", headers={"Content-Type": "application/json"})
        net.ask("POST", "/lease/renew", "operate")
        net.ask("POST", "/nothing", "operate")
        net.ask("POST", "/point", "operate", json={**ANGLES, "deadline_s": 0.5}, headers={"Deadline-S": "no"})
        net.ask("GET", "/nothing", "operate")
        net.ask("POST", "/lease/renew", "operate", headers={"Mastctl-Lease": "x"})
        lines = recorded(net)
        assert {line["address"] for line in lines} == {"127.0.0.1"}
        assert [(line["command"], line["who"], line["result"]) for line in lines] == [
            ("POST /api/v1/point", "view", "role"),
            ("POST /api/v1/point", "operate/x", "bad_request"),
            ("POST /api/v1/point", "operate", "not_json"),
            ("POST /api/v1/lease/renew", "operate", "bad_request"),
            ("POST /api/v1/nothing", "operate", "not_found"),
            ("POST /api/v1/point", "operate", "bad_request"),
            ("lease.renew", "operate", "lease_unknown"),
        ]
        foreign = {"Origin": "http://evil.example"}
        net.ask("GET", "/status", headers={"Authorization": "Bearer wrong"})
        net.ask("POST", "/login", json={"token": "wrong too"})
        net.ask("POST", "/point", "admin", json=ANGLES, headers=foreign)
        net.ask("POST", "/stop", headers=foreign)
        net.ask("GET", "/status", "admin", headers={"Host": "evil.example"})
        net.ask("GET", "/status")
        net.ask("POST", "/point", json=ANGLES)
        upgrade = (
            f"GET /api/v1/events HTTP/1.1\r\nHost: {NAME}:{net.port}\r\nOrigin: http://evil.example\r\n"
            f"Authorization: Bearer {net.token('view')}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        )
        assert b"foreign_origin" in net.raw(upgrade)
        net.ask("POST", "/estop", json={"reason": "y" * 4000})
        told = recorded(net, strangers=True)
        assert {(line["via"], line["role"], line["address"]) for line in told} == {
            ("network", "view", "127.0.0.1")
        }
        assert [(line["command"], line["result"]) for line in told] == [
            ("GET /api/v1/status", "wrong_token"),
            ("POST /api/v1/login", "wrong_token"),
            ("POST /api/v1/point", "foreign_origin"),
            ("POST /api/v1/stop", "foreign_origin"),
            ("GET /api/v1/status", "foreign_host"),
            ("POST /api/v1/point", "no_token"),
            ("estop", "ok"),
        ]
        assert len(told[-1]["request"]["reason"]) == 200, "as it is latched"
        (line,) = recorded(net)[len(lines) :]
        assert (line["command"], line["who"]) == ("GET /api/v1/events", "view")
        assert line["result"] == "foreign_origin"
        assert not [one for one in caplog.records if one.levelname == "ERROR"], caplog.text
        assert "wrong too" not in json.dumps(told)


def test_refusals_in_a_flood_are_counted_instead(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(guard, "RECORDED", 10)
    monkeypatch.setattr(guard, "RARELY", 15)
    monkeypatch.setattr(guard, "COUNTED_S", 1e9)  # however long they take
    with network_daemon(monkeypatch, tmp_path) as net:
        for _ in range(16):
            net.ask("POST", "/point", "view", json=ANGLES)
        net.ask("POST", "/nothing", "operate")
        assert [line.get("times") for line in recorded(net)] == [None] * guard.RECORDED + [15, None]


def test_a_token_has_its_refusals_counted_over_all_of_its_sessions(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(guard, "RECORDED", 5)
    monkeypatch.setattr(guard, "COUNTED_S", 1e9)
    with network_daemon(monkeypatch, tmp_path) as net:
        for _ in range(4):
            jar = net.ask("POST", "/login", json={"token": net.token("view")}).headers["set-cookie"]
            page = {"Cookie": jar.partition(";")[0], "Origin": net.origin}
            for name in ("x", "y", "z"):
                answer = net.ask("POST", "/point", json=ANGLES, headers=page | {"Mastctl-Client": name})
                assert code(answer) == (403, "role")
        assert [line["who"] for line in recorded(net)] == [f"view/{name}" for name in "xyzxy"]


# What is open when a token or a session ends


@pytest.mark.parametrize("how", ["revoked", "logged out"])
def test_what_a_token_or_a_session_opened_is_closed_with_it_and_its_lease_ends(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, how: str
) -> None:
    with network_daemon(monkeypatch, tmp_path) as net, contextlib.ExitStack() as stack:
        made = net.tokens.new("bench", "operate")
        bearer = {"Authorization": f"Bearer {made}"}
        until(lambda: net.ask("GET", "/status", headers=bearer).status_code == 200, "the new token")
        if how == "logged out":
            answer = net.ask("POST", "/login", json={"token": made}, headers={"Origin": net.origin})
            (morsel,) = SimpleCookie(answer.headers["set-cookie"]).values()
            shown = {"Cookie": f"{morsel.key}={morsel.value}", "Origin": net.origin}
        else:
            shown = bearer

        def opened(path: str, headers: dict[str, str]) -> ClientConnection:
            told = dict(headers)
            origin = told.pop("Origin", None)
            sock = socket.create_connection(("127.0.0.1", net.port))
            address = f"ws://{NAME}:{net.port}/api/v1{path}"
            return stack.enter_context(
                connect(address, sock=sock, additional_headers=told, origin=origin, close_timeout=2.0)  # type: ignore[arg-type]
            )

        admins = opened("/events", {"Authorization": f"Bearer {net.token('admin')}"})
        lines = [opened("/events", shown), opened("/images?camera=navcam_left", shown)]
        client = stack.enter_context(httpx.Client(base_url=f"{net.url}/api/v1", **PLAIN))
        host = {"Host": f"{NAME}:{net.port}"}
        streams = []
        for path in ("/events", "/track/stream"):
            asked = client.build_request("GET", path, headers={**host, **shown}, timeout=NET_S)
            answer = client.send(asked, stream=True)
            stack.callback(answer.close)
            assert answer.status_code == 200
            streams.append(answer.iter_raw())
            next(streams[-1])
        lease = net.ask("POST", "/lease", headers=shown, json={"for_s": 3600.0}).json()["lease_id"]
        steering = {**shown, "Mastctl-Lease": lease}
        rates = {"pan_rad_per_s": 0.01, "tilt_rad_per_s": 0.0}
        assert net.ask("POST", "/jog", headers=steering, json=rates).status_code == 200
        assert code(net.ask("POST", "/lease", "operate", json={})) == (409, "leased")

        if how == "revoked":
            net.tokens.revoke("bench")
        else:
            assert net.ask("POST", "/logout", headers=shown).status_code == 200
        for line in lines:
            with pytest.raises(ConnectionClosed) as closed:
                for _ in range(1000):
                    line.recv(timeout=NET_S)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008
            assert "ended" in closed.value.rcvd.reason
        for stream in streams:
            with contextlib.suppress(httpx.HTTPError):
                assert len(list(itertools.islice(stream, 1000))) < 1000
        assert net.ask("GET", "/lease", "view").json()["control"] in (
            None, {"holder": "bench", "kind": "operation", "for_s": None, "until": None},
        )  # fmt: skip
        assert code(net.ask("POST", "/jog", headers=steering, json=rates))[0] == 401
        until(lambda: net.ask("POST", "/lease", "operate", json={}).status_code == 200, "another's lease")
        assert code(net.ask("POST", "/lease/renew", "admin", headers={"Mastctl-Lease": lease})) == (
            409, "lease_over",
        )  # fmt: skip
        while json.loads(admins.recv(timeout=NET_S))["topic"] != "lease":
            pass  # the administrator's is told on


# A daemon of this machine only


def test_on_the_loopback_address_everybody_may_do_everything_and_nobody_logs_in(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        assert isinstance(hardware, FakeHardware)
        with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as web:
            told = web.get("/session", headers={"Mastctl-Client": "bench"}).json()
            assert told == {
                "name": "bench", "role": "admin", "via": "loopback", "ends_in_s": None, "needs_token": False
            }  # fmt: skip
            assert code(web.post("/login", json={"token": "x"})) == (409, "no_login")
            assert web.get("/status", headers={"Authorization": "Bearer old"}).status_code == 200
            picture = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image", "Sec-Fetch-Mode": "no-cors"}
            assert code(web.get("/snapshot/navcam_left", headers=picture)) == (403, "foreign_origin")
