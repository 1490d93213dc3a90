"""What comes over the wire and is no good request: slow, oversized, ambiguous; and a stop comes through."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from calib.errors import BadFile
from hil_tests.mastctl.web.network import NAME, Network, network_daemon
from hil_tests.waiting import NET_S, joined
from mastctl.client import Client, ClientError
from mastctl.http import connections, entrance, server

STATUS = f"GET /api/v1/status HTTP/1.1\r\nHost: {NAME}\r\n"
STOP = f"POST /api/v1/stop HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n\r\n"


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with pytest.MonkeyPatch.context() as patch, network_daemon(patch, tmp_path_factory.mktemp("net")) as made:
        yield made


@contextlib.contextmanager
def lines(net: Network, count: int, data: bytes = b"") -> Iterator[list[socket.socket]]:
    """Connections that have sent some bytes and go on to say nothing."""
    with contextlib.ExitStack() as stack:
        made = []
        for _ in range(count):
            one = stack.enter_context(socket.create_connection(("127.0.0.1", net.port), timeout=NET_S))
            one.sendall(data)
            made.append(one)
        yield made


def refused(answer: bytes, status: int, code: str) -> None:
    """Check the one form of a refusal, whoever sent it, and that nothing follows it."""
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(f"HTTP/1.1 {status} ".encode()), answer[:200]
    assert json.loads(body)["error"]["code"] == code
    assert b"cross-origin-resource-policy: same-origin" in head.lower()
    assert b"connection: close" in head.lower()


def reset_where_unread(sent_bytes: int) -> contextlib.AbstractContextManager[None]:
    """What the daemon reads in one piece is answered; beyond it, what it left unread may end in a reset."""
    return contextlib.suppress(*((ConnectionResetError,) if sent_bytes > 4096 else ()))


@pytest.mark.parametrize(
    "junk",
    [
        b"\x00\x01\x02 GET\r\n\r\n",
        b"GET /api/v1/status\r\n\r\n",
        b"GET  /api/v1/status HTTP/1.1\r\nHost: x\r\n\r\n",
        b"GET /api/v1/status HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET /api/v1/status HTTP/1.1\r\n\r\n",
        b"GET /api/v1/status HTTP/1.1\r\nHost : x\r\n\r\n",
        b"GET /api/v1/status HTTP/1.1\r\nHost: x\r\nA\r\n\r\n",
        b"GET /api/v1/status HTTP/1.1\r\nHost: x\r\nX: a\x00b\r\n\r\n",
        b"GET /" + b"a" * 70000,
        b"POST /api/v1/point HTTP/1.1\r\nHost: x\r\nContent-Length: -1\r\n\r\n",
        b"POST /api/v1/point HTTP/1.1\r\nHost: x\r\nContent-Length: +5\r\n\r\n",
        b"POST /api/v1/point HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: xchunked\r\n\r\n",
        b"POST /api/v1/point HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked, gzip\r\n\r\n",
        b"POST /api/v1/point HTTP/1.1\r\nHost: x\r\nTransfer-Encoding : chunked\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\x00" * 100 + b"\r\n\r\n",
    ],
    ids=lambda junk: repr(junk[:60]),
)
def test_what_is_no_http_is_refused_in_the_one_form_and_closed(net: Network, junk: bytes) -> None:
    with reset_where_unread(len(junk)):
        refused(net.raw(junk), 400, "not_http")
    assert net.raw(STOP).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "headers",
    [
        "Transfer-Encoding: chunked\r\nContent-Length: 4\r\n",
        "Content-Length: 4\r\nTransfer-Encoding: chunked\r\n",
        "Authorization: Bearer a\r\nAuthorization: Bearer b\r\n",
        f"Origin: http://{NAME}\r\nOrigin: http://evil.example\r\n",
        "Content-Type: application/json\r\nContent-Type: text/plain\r\n",
        "Cookie: a=b\r\nCookie: c=d\r\n",
        "Mastctl-Lease: a\r\nMastctl-Lease: b\r\n",
        "Content-Length: 2\r\nContent-Length: 2\r\n",
        "Content-Length: 1\r\ncontent-length: 2\r\n",
        "Content-Length: 2, 2\r\n",
        "Content-Length: 1, 2\r\n",
        "Content-Length:\r\n 2\r\n",
        "Cookie: a=b;\r\n\tmastctl-1=c\r\n",
        "X: a\n b\r\n",
        " X: a\r\n",
    ],
)
def test_what_two_programs_may_read_in_two_ways_is_refused_and_closed(net: Network, headers: str) -> None:
    smuggled = "0\r\n\r\n" + STATUS + "\r\n"
    answer = net.raw(f"POST /api/v1/point HTTP/1.1\r\nHost: {NAME}\r\n{headers}\r\n{smuggled}")
    refused(answer, 400, "ambiguous")
    assert answer.count(b"HTTP/1.1") == 1, "what was smuggled is not answered"


DOUBTFUL = ("Content-Length: 2\r\nContent-Length: 2\r\n", "Content-Length: 2, 2\r\n", "X: a\r\n b\r\n")


@pytest.mark.parametrize("headers", DOUBTFUL)
def test_what_may_be_read_in_two_ways_is_refused_in_pieces_and_behind_another_request_too(
    net: Network, headers: str
) -> None:
    shown = f"Authorization: Bearer {net.token('view')}\r\n"
    behind = net.raw(STATUS + shown + "\r\n" + STATUS + headers + "\r\n{}")
    assert behind.startswith(b"HTTP/1.1 200")
    refused(behind[behind.index(b"HTTP/1.1 400") :], 400, "ambiguous")
    with socket.create_connection(("127.0.0.1", net.port), timeout=NET_S) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for sign in STATUS + headers + "\r\n":
            line.sendall(sign.encode())
        refused(b"".join(iter(lambda: line.recv(65536), b"")), 400, "ambiguous")


@pytest.mark.parametrize("headers", DOUBTFUL)
@pytest.mark.parametrize("path", ["stop", "estop", "/stop/"])
def test_a_stop_is_one_however_its_headers_are_written(net: Network, path: str, headers: str) -> None:
    body = "{}" if "Length" in headers else ""
    head = f"POST /api/v1/{path} HTTP/1.1\r\nHost: {NAME}\r\n{headers}Connection: close\r\n\r\n{body}"
    assert net.raw(head).startswith(b"HTTP/1.1 200")
    if path == "estop":
        why = {"reason": "a test", "name": "a test"}
        assert net.ask("POST", "/reset", "admin", json=why).status_code == 200


@pytest.mark.parametrize(
    "headers", ["X: " + "a" * 30000 + "\r\n", "X: a\r\n" * 500, f"Cookie: {'a=b; ' * 9000}\r\n"]
)
def test_more_headers_than_anybody_needs_are_refused(net: Network, headers: str) -> None:
    with reset_where_unread(len(headers)):
        answer = net.raw(STATUS + headers + "\r\n")
        assert json.loads(answer.partition(b"\r\n\r\n")[2])["error"]["code"] in (
            "headers_too_large",
            "not_http",
        )
    assert net.raw(STOP).startswith(b"HTTP/1.1 200")


def test_a_bad_part_of_a_body_ends_the_connection_without_a_traceback(
    net: Network, caplog: pytest.LogCaptureFixture
) -> None:
    head = (
        f"POST /api/v1/point HTTP/1.1\r\nHost: {NAME}\r\nTransfer-Encoding: chunked\r\n"
        f"Authorization: Bearer {net.token('admin')}\r\nContent-Type: application/json\r\n\r\n"
    )
    for body in ("zz\r\n", "5\r\nabc", "FFFFFFFFFFFFFFFFFFFFFFFF\r\n", "1\r\nab\r\n"):
        with socket.create_connection(("127.0.0.1", net.port), timeout=NET_S) as line:
            line.sendall((head + body).encode())
            line.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                while line.recv(65536):  # a refusal may come; then the end
                    pass
    assert net.raw(STOP).startswith(b"HTTP/1.1 200")
    assert not [one for one in caplog.records if one.exc_info or one.levelname == "ERROR"], caplog.text


def test_requests_in_one_breath_are_answered_one_after_another_and_the_stop_among_them(net: Network) -> None:
    shown = f"Authorization: Bearer {net.token('view')}\r\n"
    many = (STATUS + shown + "\r\n") * 50 + STOP
    answers = net.raw(many)
    assert answers.count(b"HTTP/1.1 200") == 51
    assert b'"stopped":true' in answers


@pytest.mark.parametrize(
    ("address", "latches"),
    [
        ("/api/v1/stop/", False),
        ("//api/v1/stop", False),
        ("/api//v1///stop//?now", False),
        ("/api/v1/%73top/", False),
        (f"http://{NAME}/api/v1/stop", False),
        ("HTTPS://elsewhere.example:8420//api/v1/stop/", False),
        ("/api/v1/estop/", True),
        ("//api/v1/estop?why=fire", True),
        (f"http://{NAME}/api/v1/estop", True),
    ],
)
def test_a_stop_whose_address_is_written_otherwise_is_one(net: Network, address: str, latches: bool) -> None:
    net.hardware.head.calls.clear()
    answer = net.raw(f"POST {address} HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 200"), answer[:200]
    assert ("stop",) in net.hardware.head.calls
    assert bool(net.daemon.service.state().told()["estop"]) is latches
    if latches:
        net.daemon.service.stopping.reset("the test goes on", "test")


@pytest.mark.parametrize("address", ["/api/v1/track/stop/", f"http://{NAME}//api/v1/track/stop"])
def test_a_tracks_stop_written_otherwise_asks_for_the_same_token(net: Network, address: str) -> None:
    head = f"POST {address} HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n"
    refused(net.raw(f"{head}\r\n"), 401, "no_token")
    bearer = f"Authorization: Bearer {net.token('operate')}\r\n"
    assert net.raw(f"{head}{bearer}\r\n").startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "address",
    ["//api/v1/status", "/api/v1/status/", "/api/v1/stop/stop", "/x/api/v1/stop", "ftp://x/api/v1/stop"],
)
def test_nothing_but_a_stop_is_known_by_another_address(net: Network, address: str) -> None:
    bearer = f"Authorization: Bearer {net.token('operate')}\r\n"
    asked = f"POST {address} HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n{bearer}"
    net.hardware.head.calls.clear()
    answer = net.raw(f"{asked}Content-Type: application/json\r\nContent-Length: 2\r\n\r\n{{}}")
    assert not answer.startswith(b"HTTP/1.1 2"), answer[:200]
    assert ("stop",) not in net.hardware.head.calls


def test_another_sites_page_stops_nothing_by_another_address(net: Network) -> None:
    asked = f"POST //api/v1/stop/ HTTP/1.1\r\nHost: {NAME}\r\nOrigin: http://evil.example\r\n"
    net.hardware.head.calls.clear()
    refused(net.raw(f"{asked}Connection: close\r\n\r\n"), 403, "foreign_origin")
    assert ("stop",) not in net.hardware.head.calls


def test_an_upgrade_to_what_is_not_spoken_is_an_ordinary_request(net: Network) -> None:
    shown = f"Authorization: Bearer {net.token('view')}\r\n"
    for upgrade in ("websocket", "h2c", "TLS/1.0"):
        head = STATUS + shown + f"Upgrade: {upgrade}\r\nConnection: Upgrade, close\r\n\r\n"
        assert net.raw(head).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "begun",
    [
        b"",
        b"POST /api/v1/st",
        STATUS.encode(),
        b"POST /api/v1/point HTTP/1.1\r\nHost: rover.test\r\nContent-Length: 1000\r\n\r\n{",
        b"POST /api/v1/login HTTP/1.1\r\nHost: rover.test\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"POST /api/v1/login HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\nContent-Length: 9\r\n\r\n",
    ],
    ids=[
        "silent",
        "half a line",
        "half the headers",
        "half a body",
        "no part of a body",
        "waits to be asked",
    ],
)
def test_a_stop_comes_through_any_number_of_requests_that_do_not_come_whole(
    net: Network, begun: bytes
) -> None:
    with lines(net, connections.MOST + 20, begun):
        assert net.raw(STOP).startswith(b"HTTP/1.1 200")


def test_headers_that_come_a_byte_at_a_time_are_left_after_some_seconds(
    monkeypatch: pytest.MonkeyPatch, net: Network
) -> None:
    monkeypatch.setattr(connections, "REQUEST_S", 0.3)
    left, began_s = threading.Event(), time.monotonic()
    with lines(net, 1) as (line,):

        def trickle() -> None:
            with contextlib.suppress(OSError):
                for sign in STATUS * 1000:
                    line.sendall(sign.encode())
                    if left.wait(0.01):
                        return

        feeding = threading.Thread(target=trickle)
        feeding.start()
        with contextlib.suppress(ConnectionResetError):
            assert line.recv(1) == b"", "it was left, not answered"
        assert time.monotonic() - began_s > connections.REQUEST_S, "it was given its time"
        left.set()
        joined(feeding)


def test_more_requests_a_second_than_one_address_may_send_are_refused_but_no_stop(
    monkeypatch: pytest.MonkeyPatch, net: Network
) -> None:
    monkeypatch.setattr(entrance, "MOST_REQUESTS_PER_S", 3)
    shown = f"Authorization: Bearer {net.token('view')}\r\n"
    answers = net.raw((STATUS + shown + "\r\n") * 30 + STOP)
    assert b"too_many_requests" in answers and b"retry-after: 1" in answers.lower()
    assert b'"stopped":true' in answers


# TLS


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certificate of the daemon's name in a folder with its key."""
    folder = tmp_path_factory.mktemp("tls")
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs the program openssl to make a certificate")
    subprocess.run(
        [
            openssl,
            "req",
            "-x509",
            "-newkey",
            "ec",
            "-pkeyopt",
            "ec_paramgen_curve:prime256v1",
            "-nodes",
            "-days",
            "2",
            "-subj",
            f"/CN={NAME}",
            "-addext",
            f"subjectAltName=DNS:{NAME},IP:127.0.0.1",
            "-keyout",
            str(folder / "key.pem"),
            "-out",
            str(folder / "cert.pem"),
        ],
        check=True,
        capture_output=True,
    )
    return folder / "cert.pem"


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory, certificate: Path) -> Iterator[Network]:
    key = certificate.with_name("key.pem")
    folder = tmp_path_factory.mktemp("net")
    with (
        pytest.MonkeyPatch.context() as patch,
        network_daemon(patch, folder, f", tls: {{certificate: {certificate}, key: {key}}}") as made,
    ):
        yield made


def over_tls(net: Network, certificate: Path) -> httpx.Client:
    context = ssl.create_default_context(cafile=str(certificate))
    return httpx.Client(base_url=f"{net.url}/api/v1", verify=context, trust_env=False, timeout=NET_S)


def test_with_tls_everything_is_as_without_and_a_session_is_for_tls_only(
    secured: Network, certificate: Path
) -> None:
    assert secured.url.startswith("https://127.0.0.1:")
    with over_tls(secured, certificate) as web:
        assert web.get("/status").status_code == 401
        bearer = {"Authorization": f"Bearer {secured.token('view')}"}
        for _ in range(3):
            assert web.get("/status", headers=bearer).status_code == 200
        picture = web.get("/snapshot/navcam_left", headers=bearer)
        assert picture.content.startswith(b"\x89PNG")
        assert web.post("/stop").status_code == 200
        login = web.post("/login", json={"token": secured.token("view")})
        assert "Secure" in login.headers["set-cookie"]
        plain_page = {"Origin": f"http://{web.base_url.host}:{web.base_url.port}"}
        assert web.post("/stop", headers=plain_page).status_code == 403


def test_the_client_trusts_the_certificate_that_it_is_told(
    secured: Network, certificate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MASTCTL_TOKEN", secured.token("view"))
    with Client(secured.url) as client, pytest.raises(ClientError):
        client.status()
    monkeypatch.setenv("MASTCTL_CA_FILE", str(certificate))
    with Client(secured.url) as client:
        assert client.session()["role"] == "view"


def test_a_stop_comes_through_any_number_of_handshakes_that_do_not_come_whole(
    secured: Network, certificate: Path
) -> None:
    for begun in (b"", b"\x16\x03\x01", b"GET / HTTP/1.1\r\n"):
        with lines(secured, connections.MOST + 20, begun), over_tls(secured, certificate) as web:
            assert web.post("/stop").status_code == 200


def test_a_handshake_that_does_not_come_is_left_after_some_seconds(
    secured: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "HANDSHAKE_S", 0.3)
    began_s = time.monotonic()
    with lines(secured, 3) as silent:
        for one in silent:
            with contextlib.suppress(ConnectionResetError):
                assert one.recv(1) == b""
            assert time.monotonic() - began_s > server.HANDSHAKE_S, "it was given its time"


def test_a_request_in_the_same_breath_as_the_handshakes_end_is_answered(
    secured: Network, certificate: Path
) -> None:
    """The client's last message of the handshake and its request in one piece."""
    context = ssl.create_default_context(cafile=str(certificate))
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    speaker = context.wrap_bio(incoming, outgoing, server_hostname=NAME)
    with socket.create_connection(("127.0.0.1", secured.port), timeout=NET_S) as line:
        while True:
            try:
                speaker.do_handshake()
                break
            except ssl.SSLWantReadError:
                line.sendall(outgoing.read())
                incoming.write(line.recv(65536))
        speaker.write(STOP.encode())
        line.sendall(outgoing.read())
        answer = b""
        while b"stopped" not in answer:
            try:
                answer += speaker.read(65536)
            except ssl.SSLWantReadError:
                incoming.write(line.recv(65536))
    assert answer.startswith(b"HTTP/1.1 200")


def test_who_speaks_plain_http_to_a_tls_port_is_closed_and_nothing_is_logged_as_a_defect(
    secured: Network, caplog: pytest.LogCaptureFixture
) -> None:
    with contextlib.suppress(ConnectionResetError):
        assert not secured.raw(STOP).startswith(b"HTTP/1.1 200")
    assert not [one for one in caplog.records if one.exc_info or one.levelname == "ERROR"]


def test_a_certificate_and_a_key_that_do_not_belong_together_are_refused_before_anything_is_opened(
    tmp_path: Path, certificate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        pytest.raises(BadFile, match="belong together"),
        network_daemon(monkeypatch, tmp_path, f", tls: {{certificate: {certificate}, key: {certificate}}}"),
    ):
        pass


def test_a_program_of_the_daemon_trusts_its_certificate_and_no_other_whatever_its_name(
    secured: Network, certificate: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    door = secured.daemon.service.guide.door
    assert door is not None and door.certificate == certificate and door.lend is not None
    token, take_back = door.lend("a program")
    by_another_name = f"https://localhost:{secured.port}"
    monkeypatch.setenv("MASTCTL_CERTIFICATE", str(certificate))
    with Client(by_another_name, token=token) as client:
        assert client.session()["role"] == "operate"
    take_back()
    with Client(by_another_name, token=token) as client, pytest.raises(ClientError) as refusal:
        client.session()
    assert refusal.value.code == "wrong_token"
    other = tmp_path / "other.pem"
    openssl = shutil.which("openssl") or ""
    made = f"{openssl} req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -subj /CN={NAME}"
    subprocess.run(
        [*made.split(), "-keyout", str(tmp_path / "k"), "-out", str(other)], check=True, capture_output=True
    )
    monkeypatch.setenv("MASTCTL_CERTIFICATE", str(other))
    with Client(secured.url, token=token) as client, pytest.raises(ClientError):
        client.session()
    monkeypatch.setenv("MASTCTL_CERTIFICATE", str(tmp_path / "none.pem"))
    with pytest.raises(ClientError, match="no certificate can be read"):
        Client(secured.url)
