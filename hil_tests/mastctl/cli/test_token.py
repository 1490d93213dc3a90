"""The commands of tokens: one is shown once, the list shows none, and they go where the daemon reads them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil_tests.mastctl.service_fakes import CONFIG, little_mast_file
from hil_tests.mastctl.web.network import Network, network_daemon
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.client import Client, ClientError


@pytest.fixture
def net(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    """A daemon that requires tokens and keeps its state where its unit says, as systemd has it."""
    monkeypatch.delenv("MASTCTL_TOKEN", raising=False)
    with network_daemon(monkeypatch, tmp_path) as made:
        monkeypatch.setenv("MASTCTL_URL", made.url)
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "user"))
        yield made


def test_a_token_is_made_where_the_running_daemon_reads_it(
    net: Network, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rig", "token", "new", "--name", "wall", "--role", "view"]) == 0
    token = capsys.readouterr().out.strip()
    assert "wall" in [one.name for one in net.tokens.read() or ()]
    assert not (tmp_path / "user").exists()
    assert main(["rig", "token", "list", "--json"]) == 0
    shown = capsys.readouterr().out
    assert "wall" in [one["name"] for one in json.loads(shown)["tokens"]]
    assert token not in shown and all(one.sha256 not in shown for one in net.tokens.read() or ())
    with Client(net.url, token=token) as client:
        until(lambda: admitted(client), "the daemon to know the token")
    assert main(["rig", "token", "revoke", "wall"]) == 0
    assert "wall" not in [one.name for one in net.tokens.read() or ()]


def admitted(client: Client) -> bool:
    try:
        return client.request("GET", "/session")["role"] == "view"
    except ClientError:
        return False


def test_a_configuration_of_no_running_daemon_makes_no_token(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MASTCTL_URL", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "user"))
    config = tmp_path / "rover.yaml"
    (tmp_path / "little.yaml").write_bytes(little_mast_file())
    config.write_text(CONFIG.format(listen="{port: 1, hosts: [rover.test]}"))
    for words in (["new", "--name", "wall", "--role", "view"], ["list"], ["revoke", "wall"]):
        assert main(["rig", "token", *words, "--config", str(config)]) != 0
        said = capsys.readouterr().err
        assert "no daemon answers at http://127.0.0.1:1" in said
    assert not (tmp_path / "user").exists()


def test_a_command_without_its_token_is_referred_to_the_variable(
    net: Network, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for token in ("", "wrong"):
        monkeypatch.setenv("MASTCTL_TOKEN", token)
        assert main(["status"]) == 1
        said = capsys.readouterr().err
        assert "MASTCTL_TOKEN" in said and net.url in said and "Bearer" not in said
