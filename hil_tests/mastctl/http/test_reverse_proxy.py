"""The reverse proxy of docs/how-to/operations.md in front of a daemon: TLS, limits, and the stop."""

from __future__ import annotations

import json
import re
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from websockets.sync.client import connect

from hil_tests.mastctl.web.network import NAME, Network, network_daemon
from hil_tests.waiting import NET_S, until

IN_PAGE = re.compile(r"```nginx\n(.*?)```", re.DOTALL)
AROUND = """
daemon off; master_process off; pid {folder}/pid; error_log stderr;
events {{}}
http {{
    access_log off;
    client_body_temp_path {folder}; proxy_temp_path {folder}; fastcgi_temp_path {folder};
    uwsgi_temp_path {folder}; scgi_temp_path {folder};
    {documented}
}}
"""


@dataclass
class Proxied:
    """A daemon behind nginx."""

    net: Network
    port: int
    trusted: ssl.SSLContext

    @property
    def origin(self) -> str:
        return f"https://{NAME}:{self.port}"

    def client(self, token: str | None = None, **headers: str) -> httpx.Client:
        """Return a client of the proxy, by the daemon's name."""
        shown = {} if token is None else {"Authorization": f"Bearer {token}"}
        return httpx.Client(
            base_url=f"https://127.0.0.1:{self.port}/api/v1",
            headers={"Host": f"{NAME}:{self.port}", **shown, **headers},
            verify=self.trusted,
            trust_env=False,
            timeout=NET_S,
        )


def listens(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture(scope="module")
def proxied(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Iterator[Proxied]:
    nginx, openssl = shutil.which("nginx", path="/usr/sbin:/usr/bin"), shutil.which("openssl")
    if nginx is None or openssl is None:
        pytest.skip("needs nginx and openssl: apt-get install nginx-light openssl")
    folder = tmp_path_factory.mktemp("proxy")
    made = f"{openssl} req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2"
    names = (
        f"-subj /CN={NAME} -addext subjectAltName=DNS:{NAME},IP:127.0.0.1 -keyout rover.key -out rover.pem"
    )
    subprocess.run(f"{made} {names}".split(), cwd=folder, check=True, capture_output=True)
    page = (repository / "docs" / "how-to" / "operations.md").read_text()
    (documented,) = IN_PAGE.findall(page)
    with pytest.MonkeyPatch.context() as patch, network_daemon(patch, folder) as net:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        for old, new in (
            ("listen 443 ssl", f"listen 127.0.0.1:{port} ssl"),
            ("rover.local", NAME),
            ("127.0.0.1:8420", f"127.0.0.1:{net.port}"),
            ("ssl_certificate rover.pem", f"ssl_certificate {folder}/rover.pem"),
            ("ssl_certificate_key rover.key", f"ssl_certificate_key {folder}/rover.key"),
        ):
            assert old in documented
            documented = documented.replace(old, new)
        config = folder / "nginx.conf"
        config.write_text(AROUND.format(folder=folder, documented=documented))
        with subprocess.Popen(
            [nginx, "-p", str(folder), "-c", str(config)], stderr=subprocess.PIPE
        ) as process:
            try:
                until(lambda: listens(port) or process.poll() is not None, "nginx")
                assert process.poll() is None, process.stderr and process.stderr.read()
                yield Proxied(net, port, ssl.create_default_context(cafile=str(folder / "rover.pem")))
            finally:
                process.terminate()


def test_tokens_and_the_pages_cookie_pass_the_proxy(proxied: Proxied) -> None:
    token = proxied.net.token("operate")
    with proxied.client() as web:
        assert web.get("/status").status_code == 401
        assert "token_folder" not in web.get("/health/live").json(), "it came from another machine"
    with proxied.client(token) as web:
        assert web.get("/snapshot/navcam_left").content.startswith(b"\x89PNG")
        kept = web.post("/session", headers={"Origin": proxied.origin}).headers["set-cookie"]
        assert "Secure" in kept and "HttpOnly" in kept
        foreign = web.post("/stop", headers={"Origin": "https://evil.example"})
        assert foreign.status_code == 403
    with proxied.client(Cookie=kept.partition(";")[0], Origin=proxied.origin) as page:
        assert page.post("/point", json={"pan_rad": 0.1, "tilt_rad": 0.0}).status_code == 202


def test_live_events_pass_the_proxy(proxied: Proxied) -> None:
    with (
        socket.create_connection(("127.0.0.1", proxied.port)) as line,
        connect(
            f"wss://{NAME}:{proxied.port}/api/v1/events",
            sock=line,
            ssl=proxied.trusted,
            server_hostname=NAME,
            additional_headers={"Authorization": f"Bearer {proxied.net.token('view')}"},
        ) as events,
    ):
        assert "topic" in json.loads(events.recv(timeout=NET_S))


def test_a_stop_passes_the_limit_of_requests(proxied: Proxied) -> None:
    with proxied.client(proxied.net.token("view")) as web, ThreadPoolExecutor(20) as crowd:
        statuses = set[int]()

        def refused() -> bool:
            statuses.update(crowd.map(lambda _: web.get("/health/live").status_code, range(400)))
            return 429 in statuses

        until(refused, "the limit")
        proxied.net.hardware.head.calls.clear()
        for address in ("/stop", "/stop/", "/estop"):
            assert web.post(address).status_code == 200
        assert ("stop",) in proxied.net.hardware.head.calls
