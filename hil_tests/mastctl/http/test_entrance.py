"""Attacks on a daemon that other machines reach: by pages of other sites, without a token."""

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
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from hil_tests.mastctl.service_fakes import PLAIN, fake_daemon, on_disk
from hil_tests.mastctl.web.network import NAME, Network, network_daemon
from hil_tests.waiting import NET_S, until
from mastctl.answers import Role

ANGLES = {"pan_rad": 0.1, "tilt_rad": -0.1}
EVIL = "http://evil.example"
RESET = {"reason": "a test", "name": "a test"}


@pytest.fixture(scope="module")
def one_daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with pytest.MonkeyPatch.context() as patch, network_daemon(patch, tmp_path_factory.mktemp("net")) as made:
        yield made


@pytest.fixture
def net(one_daemon: Network) -> Network:
    one_daemon.daemon.service.stopping.stop()
    one_daemon.hardware.head.calls.clear()
    return one_daemon


def code(answer: httpx.Response) -> tuple[int, str]:
    """Status and code of a refusal; the code of any other answer is empty."""
    if answer.is_success:
        return answer.status_code, ""
    return answer.status_code, answer.json()["error"]["code"]


def moves(net: Network) -> list[Any]:
    return [call for call in net.hardware.head.calls if call[0] == "move"]


def described(net: Network) -> Iterator[tuple[str, str]]:
    """Method and path of every route, its parameters filled."""
    document = net.ask("GET", str(httpx.URL(f"{net.url}/openapi.json")), "view").json()
    for path, methods in document["paths"].items():
        for method in methods:
            filled = path.replace("{camera}", "navcam_left").replace("{operation_id}", "x")
            yield method.upper(), filled.removeprefix("/api/v1")


# Tokens


def test_every_route_but_stops_and_health_requires_a_token(net: Network) -> None:
    answers = {
        f"{method} {path}": code(net.ask(method, path, json={} if method == "POST" else None))
        for method, path in described(net)
    }
    free = {route for route, (_, refusal) in answers.items() if refusal != "no_token"}
    assert free == {"POST /stop", "POST /estop", "GET /health/live", "GET /health/ready"}
    assert len(answers) > 15
    assert answers["POST /stop"] == answers["POST /estop"] == (200, "")
    assert net.ask("POST", "/reset", "admin", json=RESET).status_code == 200
    for path in ("/openapi.json", "/api/v1/nothing", "/redoc", "/api/v1//status"):
        answer = net.ask("GET", f"{net.url}{path}")
        assert code(answer) == (401, "no_token"), path
        assert answer.headers["www-authenticate"] == "Bearer"


def test_health_answers_strangers_without_the_reason_of_a_stop(net: Network) -> None:
    net.ask("POST", "/estop", json={"reason": "a dog is near the mast", "name": "Ida"})
    for role, shows in ((None, False), ("view", True)):
        answer = net.ask("GET", "/health/ready", role)  # type: ignore[arg-type]
        assert code(answer) == (503, "not_ready")
        assert answer.json()["error"]["message"].startswith("stopped")
        assert ("a dog" in answer.text) == shows
    assert net.ask("POST", "/reset", "admin", json=RESET).status_code == 200


def test_the_folder_of_tokens_is_shown_on_this_machine_alone(net: Network) -> None:
    answer = net.ask("GET", "/health/live").json()
    assert answer == {"live": True, "token_folder": str(net.tokens.folder)}
    by_a_proxy = net.ask("GET", "/health/live", headers={"X-Forwarded-For": "192.0.2.7"}).json()
    assert by_a_proxy == {"live": True}


def test_a_recording_is_deleted_by_an_administrator_only(net: Network) -> None:
    assert code(net.ask("DELETE", "/recordings/x", "operate")) == (403, "role")
    assert code(net.ask("DELETE", "/recordings/x", "admin")) == (404, "recording_unknown")


@pytest.mark.parametrize("role", ["view", "operate"])
def test_every_token_reads_and_those_of_operators_change_things(net: Network, role: Role) -> None:
    for path in ("/status", "/snapshot/navcam_left"):
        assert net.ask("GET", path, role).status_code == 200
    answer = net.ask("POST", "/point", role, json=ANGLES)
    assert code(answer) == ((403, "role") if role == "view" else (202, ""))
    assert bool(moves(net)) <= (role == "operate")
    assert net.ask("POST", "/stop", role).status_code == 200


@pytest.mark.parametrize("shown", ["Basic dmlldzp2aWV3", "Bearer", "Bearer  a b", f"Bearer {'A' * 43}"])
def test_what_is_no_token_opens_nothing(net: Network, shown: str) -> None:
    assert net.ask("GET", "/status", headers={"Authorization": shown}).status_code == 401


def test_a_stop_needs_no_token_and_no_name(net: Network) -> None:
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Cookie": "x=y"}, {"Host": "evil.example"}):
        net.hardware.head.calls.clear()
        assert net.ask("POST", "/stop", headers=headers).status_code == 200
        assert ("stop",) in net.hardware.head.calls
    assert net.raw("POST /api/v1/stop HTTP/1.0\r\n\r\n").startswith(b"HTTP/1.1 200")


def test_no_token_is_logged(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG")
    with network_daemon(monkeypatch, tmp_path) as net:
        texts = [net.token(role) for role in ("view", "operate", "admin")]
        net.ask("POST", "/session", "admin")
        net.ask("GET", "/status", params={"token": texts[0]})
        net.ask("GET", "/status", headers={"Cookie": f"mastctl-{net.port}={texts[1]}"})
        net.ask("GET", "/status", headers={"Authorization": "Bearer wrong"})
    own = "".join(one.getMessage() for one in caplog.records if not one.name.startswith("http"))
    assert str(net.tokens.folder) in own, "their folder is logged"
    assert not [text for text in texts if text in own]


# Pages of other sites


@pytest.mark.parametrize("host", ["evil.example", f"{NAME}.evil.example", "rover", "", "[", f"{NAME}@evil"])
def test_a_name_that_others_may_point_to_the_daemon_is_refused(net: Network, host: str) -> None:
    answer = net.raw(
        f"GET /api/v1/status HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n"
        f"Authorization: Bearer {net.token('admin')}\r\n\r\n"
    )
    assert answer.startswith(b"HTTP/1.1 403") and b"foreign_host" in answer


@pytest.mark.parametrize("host", [NAME, f"{NAME.upper()}:1", "localhost:8420", "[::1]:9", "10.1.2.3"])
def test_own_names_and_any_address_are_answered(net: Network, host: str) -> None:
    assert net.ask("GET", "/status", "view", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    ("origin", "path"),
    [
        *((EVIL, path) for path in ("/stop", "/point", "/session", "/track/stop")),
        *((origin, "/stop") for origin in ("null", f"http://{NAME}:1", f"http://{NAME}", "", "https://[")),
    ],
)
def test_a_page_of_another_site_changes_nothing(net: Network, origin: str, path: str) -> None:
    answer = net.ask("POST", path, "admin", json=ANGLES, headers={"Origin": origin})
    assert code(answer) == (403, "foreign_origin")
    assert net.hardware.head.calls == []


@pytest.mark.parametrize("site", ["cross-site", "nonsense"])
def test_a_page_of_another_site_reads_nothing(net: Network, site: str) -> None:
    for path in ("/snapshot/navcam_left", "/status"):
        answer = net.ask("GET", path, "view", headers={"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "image"})
        assert code(answer) == (403, "foreign_origin"), path
    assert code(net.ask("POST", "/stop", headers={"Sec-Fetch-Site": site})) == (403, "foreign_origin")
    for own in ("same-origin", "none"):
        assert net.ask("GET", "/status", "view", headers={"Sec-Fetch-Site": own}).status_code == 200


def test_no_answer_may_be_embedded_or_stored(net: Network) -> None:
    requests: list[tuple[str, str, Role | None]] = [
        ("GET", "/snapshot/navcam_left", "view"),
        ("GET", "/status", None),
        ("OPTIONS", "/point", None),
        ("POST", "/stop", None),
    ]
    for method, path, role in requests:
        answer = net.ask(method, path, role, headers={} if method != "OPTIONS" else {"Origin": EVIL})
        assert method != "OPTIONS" or not answer.is_success
        headers = answer.headers
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert headers["cache-control"] == "no-store"
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert "access-control-allow-origin" not in headers


def test_reading_moves_nothing(net: Network) -> None:
    for method, path in described(net):
        if method == "GET" and not path.endswith(("stream", "events")):
            net.ask("GET", path, "admin")
    assert {call[0] for call in net.hardware.head.calls} <= {"read"}


# The page's cookie


def cookie_of(net: Network, role: Role = "operate", **headers: str) -> tuple[str, Any]:
    """The cookie that keeps a role's token, as a browser sends it, and its attributes."""
    answer = net.ask("POST", "/session", role, headers=headers)
    assert answer.json()["role"] == role
    (morsel,) = SimpleCookie(answer.headers["set-cookie"]).values()
    return f"{morsel.key}={morsel.value}", morsel


def test_the_cookie_goes_to_no_script_and_to_no_other_site(net: Network) -> None:
    _, morsel = cookie_of(net, "view")
    assert morsel.key == f"mastctl-{net.port}"
    assert morsel["httponly"] and morsel["samesite"] == "strict" and morsel["path"] == "/"
    assert not morsel["domain"] and not morsel["secure"] and int(morsel["max-age"]) == 12 * 3600
    _, behind_tls = cookie_of(net, "view", Origin=net.origin.replace("http:", "https:"))
    assert behind_tls["secure"]


def test_the_cookie_reads_and_drives_from_the_own_page_only(net: Network) -> None:
    headers = {"Cookie": cookie_of(net)[0]}
    assert net.ask("GET", "/snapshot/navcam_left", headers=headers).status_code == 200
    for foreign in ({"Origin": EVIL}, {"Sec-Fetch-Site": "cross-site"}):
        answer = net.ask("POST", "/point", json=ANGLES, headers=headers | foreign)
        assert code(answer) == (403, "foreign_origin")
    assert moves(net) == []
    own = {**headers, "Origin": net.origin}
    assert net.ask("POST", "/point", json=ANGLES, headers=own).status_code == 202
    answer = net.ask("GET", "/session", headers={**headers, "Mastctl-Client": "wall"}).json()
    assert answer == {"name": "operate/wall", "role": "operate", "via": "token", "needs_token": True}


def test_a_wrong_cookie_opens_nothing_and_is_replaced_by_a_token(net: Network) -> None:
    stale = {"Cookie": f"mastctl-{net.port}=old", "Origin": net.origin}
    assert code(net.ask("GET", "/status", headers=stale)) == (401, "wrong_token")
    assert net.ask("POST", "/session", "view", headers=stale).json()["role"] == "view"
    ended = net.ask("DELETE", "/session", "view", headers=stale)
    assert next(iter(SimpleCookie(ended.headers["set-cookie"]).values()))["max-age"] == "0"


# What is recorded


def recorded(net: Network, strangers: bool = False) -> list[dict[str, Any]]:
    """The audit log, or that of strangers."""
    service = net.daemon.service
    on_disk(service.journals)
    path = service.folder.path / ("strangers.jsonl" if strangers else "audit.jsonl")
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_each_refusal_is_recorded_with_its_address(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with network_daemon(monkeypatch, tmp_path) as net:
        net.ask("POST", "/point", "view", json=ANGLES)
        net.ask("POST", "/point", "operate", json={"pan_rad": "left"}, headers={"Mastctl-Client": "x"})
        net.ask("POST", "/point", "operate", content=b"{", headers={"Content-Type": "application/json"})
        net.ask("POST", "/nothing", "operate")
        net.ask("GET", "/nothing", "operate")
        net.ask("POST", "/lease/renew", "operate", headers={"Mastctl-Lease": "x"})
        lines = recorded(net)
        assert {line["address"] for line in lines} == {"127.0.0.1"}
        assert [(line["command"], line["who"], line["result"]) for line in lines] == [
            ("POST /api/v1/point", "view", "role"),
            ("POST /api/v1/point", "operate/x", "bad_request"),
            ("POST /api/v1/point", "operate", "not_json"),
            ("POST /api/v1/nothing", "operate", "not_found"),
            ("lease.renew", "operate", "lease_unknown"),
        ]
        foreign = {"Origin": EVIL}
        net.ask("GET", "/status", headers={"Authorization": "Bearer wrong"})
        net.ask("POST", "/point", "admin", json=ANGLES, headers=foreign)
        net.ask("POST", "/stop", headers=foreign)
        net.ask("GET", "/status", "admin", headers={"Host": "evil.example"})
        net.ask("GET", "/status")
        net.ask("POST", "/point", json=ANGLES)
        with pytest.raises(InvalidStatus):
            opened(net, "/events", {"Authorization": f"Bearer {net.token('view')}", "Origin": EVIL})
        net.ask("POST", "/estop", json={"reason": "y" * 4000})
        strangers = recorded(net, strangers=True)
        assert {(line["via"], line["role"], line["address"]) for line in strangers} == {
            ("network", "view", "127.0.0.1")
        }
        assert [(line["command"], line["result"]) for line in strangers] == [
            ("GET /api/v1/status", "wrong_token"),
            ("POST /api/v1/point", "foreign_origin"),
            ("POST /api/v1/stop", "foreign_origin"),
            ("GET /api/v1/status", "foreign_host"),
            ("POST /api/v1/point", "no_token"),
            ("GET /api/v1/events", "foreign_origin"),
            ("estop", "ok"),
        ]
        assert len(strangers[-1]["request"]["reason"]) == 200, "as it is latched"
        assert not [one for one in caplog.records if one.levelname == "ERROR"], caplog.text


# What a token opened ends with it


def opened(net: Network, path: str, headers: dict[str, str]) -> ClientConnection:
    """A WebSocket, by the daemon's name."""
    sent = dict(headers)
    origin: Any = sent.pop("Origin", None)
    sock = socket.create_connection(("127.0.0.1", net.port))
    address = f"ws://{NAME}:{net.port}/api/v1{path}"
    return connect(address, sock=sock, additional_headers=sent, origin=origin, close_timeout=2.0)


def test_all_that_a_token_opened_ends_with_it_and_so_does_its_lease(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with network_daemon(monkeypatch, tmp_path) as net, contextlib.ExitStack() as stack:
        shown = {"Authorization": f"Bearer {net.tokens.new('bench', 'operate')}"}
        until(lambda: net.ask("GET", "/status", headers=shown).status_code == 200, "the new token")
        admins = stack.enter_context(
            opened(net, "/events", {"Authorization": f"Bearer {net.token('admin')}"})
        )
        lines = [
            stack.enter_context(opened(net, path, shown))
            for path in ("/events", "/images?camera=navcam_left")
        ]
        client = stack.enter_context(httpx.Client(base_url=f"{net.url}/api/v1", **PLAIN))
        request = client.build_request("GET", "/events", headers={"Host": f"{NAME}:{net.port}", **shown})
        answer = client.send(request, stream=True)
        stack.callback(answer.close)
        stream = answer.iter_raw()
        next(stream)
        lease = net.ask("POST", "/lease", headers=shown, json={"for_s": 3600.0}).json()["lease_id"]
        steering = {**shown, "Mastctl-Lease": lease}
        rates = {"pan_rad_per_s": 0.01, "tilt_rad_per_s": 0.0, "sequence": 1}
        assert net.ask("POST", "/jog", headers=steering, json=rates).status_code == 200
        assert code(net.ask("POST", "/lease", "operate", json={})) == (409, "leased")

        net.tokens.revoke("bench")
        for line in lines:
            with pytest.raises(ConnectionClosed) as closed:
                for _ in range(1000):
                    line.recv(timeout=NET_S)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008
        with contextlib.suppress(httpx.HTTPError):
            assert len(list(itertools.islice(stream, 1000))) < 1000
        assert code(net.ask("POST", "/jog", headers=steering, json=rates))[0] == 401
        until(lambda: net.ask("POST", "/lease", "operate", json={}).status_code == 200, "another's lease")
        renewed = net.ask("POST", "/lease/renew", "admin", headers={"Mastctl-Lease": lease})
        assert code(renewed) == (409, "lease_over")
        while json.loads(admins.recv(timeout=NET_S))["topic"] != "lease":
            pass  # the administrator's stream goes on


# A daemon of this machine only


def test_on_the_loopback_address_every_client_may_do_everything(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    by_a_proxy = {"X-Forwarded-For": "127.0.0.1"}
    with fake_daemon(monkeypatch, tmp_path) as (daemon, hardware):
        with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as web:
            answer = web.post("/session", headers={"Mastctl-Client": "bench", "Authorization": "Bearer old"})
            assert answer.json() == {
                "name": "bench",
                "role": "admin",
                "via": "loopback",
                "needs_token": False,
            }
            assert "set-cookie" not in answer.headers
            for host in ("evil.example", "127.0.0.1.evil.example"):
                assert code(web.get("/status", headers={"Host": host})) == (403, "foreign_host")
            picture = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image", "Sec-Fetch-Mode": "no-cors"}
            assert code(web.get("/snapshot/navcam_left", headers=picture)) == (403, "foreign_origin")
        with httpx.Client(base_url=f"{daemon.url}/api/v1", headers=by_a_proxy, **PLAIN) as web:
            for path in ("/point", "/lease", "/reset", "/track", "/panoramas"):
                refusal = web.post(path, json=ANGLES)
                assert code(refusal) == (401, "no_token")
                assert "proxy" in refusal.text and "listen.hosts" in refusal.text
            assert web.get(f"{daemon.url}/").status_code == 200, "the page, which has no data"
            assert web.get("/health/live").json() == {"live": True}
            address = f"{daemon.url.replace('http', 'ws')}/api/v1/events"
            with pytest.raises(InvalidStatus) as refused, connect(address, additional_headers=by_a_proxy):
                pass
            assert refused.value.response.status_code == 401
            assert not [call for call in hardware.head.calls if call[0] == "move"]
            assert web.post("/stop").status_code == 200
            assert ("stop",) in hardware.head.calls


@pytest.mark.parametrize(
    "header", ["Forwarded", "X-Real-IP", "x-forwarded-for", "X-Forwarded-Proto", "Via", "CF-Connecting-IP"]
)
def test_each_header_of_a_proxy_makes_a_stranger(standing_url: str, header: str) -> None:
    answer = httpx.get(f"{standing_url}/api/v1/status", headers={header: "for=127.0.0.1"}, **PLAIN)
    assert code(answer) == (401, "no_token")


@pytest.fixture(scope="module")
def standing_url(standing: tuple[Any, Any]) -> str:
    return str(standing[0].url)
