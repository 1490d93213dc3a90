"""A daemon that other machines may reach, on fakes: what it asks for, and the two ways to ask it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from hil_tests.mastctl.service_fakes import PLAIN, FakeHardware, fake_daemon
from hil_tests.waiting import NET_S
from mastctl.answers import Role
from mastctl.daemon import RunningDaemon
from mastctl.http.tokens import TokenList

NAME = "rover.test"


@dataclass
class Network:
    """The daemon, its hardware and its tokens."""

    daemon: RunningDaemon
    hardware: FakeHardware
    tokens: TokenList

    @property
    def url(self) -> str:
        return self.daemon.url

    @property
    def port(self) -> int:
        return urlsplit(self.url).port or 0

    @property
    def origin(self) -> str:
        """Of its own page."""
        return f"http://{NAME}:{self.port}"

    def token(self, role: Role) -> str:
        return self.tokens.file_of(role).read_text().strip()

    def ask(self, method: str, path: str, role: Role | None = None, **options: object) -> httpx.Response:
        """Ask as a program does, by the daemon's name and with a role's token."""
        told: dict[str, str] = options.pop("headers", {})  # type: ignore[assignment]
        headers = {"Host": f"{NAME}:{self.port}"}
        if role is not None:
            headers["Authorization"] = f"Bearer {self.token(role)}"
        with httpx.Client(base_url=f"{self.url}/api/v1", **PLAIN) as client:
            return client.request(method, path, headers={**headers, **told}, **options)  # type: ignore[arg-type]

    def raw(self, text: str | bytes, timeout_s: float = NET_S) -> bytes:
        """Send bytes, and return what comes until the daemon closes."""
        data = text.encode("latin-1") if isinstance(text, str) else text
        with socket.create_connection(("127.0.0.1", self.port), timeout=timeout_s) as line:
            line.sendall(data)
            return b"".join(iter(lambda: line.recv(65536), b""))


@contextmanager
def network_daemon(monkeypatch: pytest.MonkeyPatch, folder: Path, listen: str = "") -> Iterator[Network]:
    """A daemon that answers to a name of its own, and so asks for a token."""
    options = f"{{port: 0, hosts: [{NAME}]{listen}}}"
    with fake_daemon(monkeypatch, folder, options) as (daemon, hardware):
        yield Network(daemon, hardware, TokenList(daemon.service.folder.path))
