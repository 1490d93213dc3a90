"""The shell lines of docs/how-to/upgrade.md: run as written, with another root than the machine's.

`sudo` runs its command, `systemctl` writes down what it was asked, and `python3 -m venv` makes an environment
whose `pip` installs nothing and whose `mastctl` is the one under test. tar, mv and `doctor` are real.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

STUBS = {
    "sudo": 'exec "$@"',
    "systemctl": 'echo "$*" >> "$ROOT/systemctl.log"',
    "python3": 'mkdir -p "$3/bin"\nln -sf "$MASTCTL" "$3/bin/mastctl"\n'
    'printf "#!/bin/sh\\necho \\$0 \\$* >> $ROOT/pip.log\\n" > "$3/bin/pip"\nchmod +x "$3/bin/pip"',
}


@pytest.fixture
def root(repository: Path) -> Iterator[Path]:
    """A root with a configuration, a state folder of a daemon and an old environment in their places."""
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="u") as short:  # a socket's path is short
        top = Path(short)
        for folder in ("etc/mastctl", "var/lib/mastctl/records", "opt/mastctl/bin", "stubs"):
            (top / folder).mkdir(parents=True)
        shutil.copy(repository / "configs/default.yaml", top / "etc/mastctl/mastctl.yaml")
        shutil.copytree(repository / "configs/masts", top / "etc/mastctl/masts")
        (top / "var/lib/mastctl/tokens.json").write_text("{}")
        (top / "var/lib/mastctl/records/long.mcap").write_text("large")
        with socket.socket(socket.AF_UNIX) as stop:
            stop.bind(str(top / "var/lib/mastctl/stop.sock"))
        for name, body in STUBS.items():
            (top / "stubs" / name).write_text(f"#!/bin/sh\n{body}\n")
            (top / "stubs" / name).chmod(0o755)
        yield top


def section(repository: Path, title: str) -> list[str]:
    """The shell blocks below a heading of the page."""
    page = (repository / "docs/how-to/upgrade.md").read_text(encoding="utf-8")
    text = page.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]
    return [re.sub(r"(?m)^ {3}", "", block) for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL)]


def run(script: str, root: Path) -> str:
    """Run a block below another root; return what it prints."""
    script = re.sub(r"(?<![\w.])/(?=opt/|etc/|var/)", f"{root}/", script).replace("-C / ", f"-C {root} ")
    environ = os.environ | {
        "PATH": f"{root}/stubs:{os.environ['PATH']}",
        "ROOT": str(root),
        "MASTCTL": str(Path(sys.executable).with_name("mastctl")),
        "XDG_STATE_HOME": f"{root}/state",
    }
    done = subprocess.run(
        ["bash", "-ec", script], cwd=root, env=environ, capture_output=True, text=True, timeout=300.0
    )
    assert done.returncode == 0, f"{script}\n{done.stdout}{done.stderr}"
    return done.stdout


def test_a_backup_holds_configuration_and_state_without_sockets_and_recordings(
    repository: Path, root: Path
) -> None:
    (script,) = section(repository, "Back up")
    run(script, root)
    with tarfile.open(root / "mastctl-backup.tar.gz") as archive:
        names = set(archive.getnames())
    assert {"etc/mastctl/mastctl.yaml", "var/lib/mastctl/tokens.json"} <= names
    assert not any("records" in name or name.endswith(".sock") for name in names)
    assert (root / "systemctl.log").read_text() == "stop mastctl\nstart mastctl\n"


def test_an_upgrade_checks_the_configuration_first_and_exchanges_the_folders(
    repository: Path, root: Path
) -> None:
    beside, exchange = section(repository, "Upgrade")
    assert "mast file" in run(beside, root) and (root / "opt/mastctl-new/bin/mastctl").exists()
    run(exchange, root)
    assert (root / "opt/mastctl-old/bin").is_dir() and (root / "opt/mastctl/bin/mastctl").exists()
    assert not (root / "opt/mastctl-new").exists()
    lines = (root / "pip.log").read_text().splitlines()
    assert [line.split("/opt/")[1] for line in lines] == [
        "mastctl-new/bin/pip install .",
        "mastctl/bin/pip install .",
    ]
    asked = (root / "systemctl.log").read_text().splitlines()
    assert asked == ["stop mastctl", "start mastctl", "status mastctl"]
