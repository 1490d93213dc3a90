"""A fresh machine and nothing else: the Containerfile's steps in a bare Debian, then a booted systemd there.

The steps are executed as the Containerfile has them; only the engine that would read it is another one.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil_tests.machine import debian
from hil_tests.waiting import until
from mastctl.answers import WELL
from mastctl.client import Client, ClientError

pytestmark = pytest.mark.long(4, "a whole Debian is made, mastctl installed and systemd booted in it")

CONTAINERFILE = Path("configs/container/Containerfile")
RIG = "configs/rigs/two_servos_two_webcams"
HEAD = "192.0.2.10"  # of the range for documentation: no machine has it
SERVOS = """
[Service]
User=mastctl
RuntimeDirectory=servos
ExecStart=/opt/mastctl/bin/mastctl rig sim dynamixel --pty --link /run/servos/line --servo xl330_m288:1 \
--servo xl330_m288:2 --baud 1000000
"""


@pytest.fixture(scope="module")
def steps(repository: Path) -> dict[str, list[str]]:
    return debian.instructions(repository / CONTAINERFILE)


@pytest.fixture(scope="module")
def root(
    repository: Path, steps: dict[str, list[str]], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Path]:
    """The image: a bare Debian after COPY and RUN."""
    assert steps["FROM"] == ["docker.io/library/debian:12-slim"] and steps["COPY"] == [". /src"]
    folder = debian.bare(tmp_path_factory.mktemp("debian") / "root")
    assert not (folder / "usr/bin/python3").exists()
    listed = subprocess.run(
        ["git", "ls-files", "-zco", "--exclude-standard"], cwd=repository, capture_output=True, text=True
    )
    # the list that Docker and buildah both read beside the Containerfile
    left_out = (repository / f"{CONTAINERFILE}.dockerignore").read_text().split()
    assert {".git", ".venv", "hil_tests"} <= set(left_out)
    for name in filter(None, listed.stdout.split("\0")):
        if name.split("/")[0] not in left_out and (repository / name).is_file():
            (folder / "src" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(repository / name, folder / "src" / name)
    for step in steps["RUN"]:
        debian.run(folder, *debian.words_of(step), network=True)
    yield folder
    shutil.rmtree(folder)  # a gigabyte


@pytest.fixture(scope="module")
def environment(steps: dict[str, list[str]]) -> dict[str, str]:
    return dict(variable.split("=", 1) for variable in steps["ENV"])


def container(root: Path, steps: dict[str, list[str]], environment: dict[str, str], *words: str) -> Any:
    """What `podman run IMAGE WORDS` starts."""
    (entry,), (user,) = steps["ENTRYPOINT"], steps["USER"]
    command = ["/usr/bin/env", *debian.words_of(entry), *words]
    return debian.running(root, *command, user=user, environment=environment)


def test_the_demo_runs_in_the_container(
    root: Path, steps: dict[str, list[str]], environment: dict[str, str]
) -> None:
    words = ("demo", "--targets", "1", "--out", "/tmp/demo", "--json")
    with container(root, steps, environment, *words) as demo:
        out, _ = demo.communicate(timeout=debian.TIMEOUT_S)
    assert demo.returncode == 0
    assert [(row["targets"], row["failed"]) for row in json.loads(out)["distances"]] == [(1, 0)] * 3


def test_the_published_port_takes_a_stop_from_anyone_and_a_command_with_a_token(
    root: Path, steps: dict[str, list[str]], environment: dict[str, str]
) -> None:
    (command,), (port,) = steps["CMD"], steps["EXPOSE"]
    with container(root, steps, environment, *debian.words_of(command)) as daemon:
        assert daemon.stdout is not None
        assert daemon.stdout.readline().strip() == f"http://127.0.0.1:{port}"
        first = debian.first_process(daemon)
        with debian.published(first, int(port)) as outside:
            url = f"http://127.0.0.1:{outside}"
            with Client(url) as stranger:
                with pytest.raises(ClientError) as refused:
                    stranger.status()
                assert refused.value.code == "no_token"
            token = (root / "var/lib/mastctl/operate.token").read_text().strip()
            with Client(url, token=token) as operator, Client(url) as stranger:
                record = operator.wait(operator.point(pan_rad=0.2, tilt_rad=-0.1))
                assert record["state"] == "done", record["error"]
                stranger.estop()
                assert operator.status()["state"] == "stopped"
        os.kill(first, signal.SIGTERM)
        assert daemon.wait(timeout=60.0) == 0
    with container(root, steps, environment, *debian.words_of(command)) as daemon:  # of the same volume
        assert daemon.stdout is not None and daemon.stdout.readline().startswith("http://")
        with (
            debian.published(debian.first_process(daemon), int(port)) as outside,
            Client(f"http://127.0.0.1:{outside}", token=token) as operator,
        ):
            assert operator.status()["state"] == "stopped"


@pytest.fixture(scope="module")
def service_root(root: Path, repository: Path) -> Path:
    """The same Debian with systemd, the unit as it is shipped, and simulated servos on a serial line."""
    wanted = "systemd systemd-sysv dbus iproute2"
    debian.run(
        root, "sh", "-c", f"apt-get update -qq && apt-get install -y -qq --no-install-recommends {wanted}",
        network=True, DEBIAN_FRONTEND="noninteractive",
    )  # fmt: skip
    for left in (root / "var/lib/mastctl").iterdir():
        shutil.rmtree(left) if left.is_dir() else left.unlink()
    units = root / "etc/systemd/system"
    shutil.copy(repository / "configs/systemd/mastctl.service", units)
    (units / "servos.service").write_text(SERVOS)
    (root / "etc/mastctl").mkdir()
    shutil.copy(repository / f"{RIG}_mast.yaml", root / "etc/mastctl")
    rig = (repository / f"{RIG}.yaml").read_text()
    for was, now in (
        ("port: /dev/mast ", "port: /run/servos/line "),
        ("speed_rad_per_s: 0.8", "speed_rad_per_s: 0.05"),
    ):
        assert rig.count(was) == 1
        rig = rig.replace(was, now)
    (root / "etc/mastctl/mastctl.yaml").write_text(rig)
    return root


class Booted:
    """The service in a systemd that runs."""

    def __init__(self, first: int) -> None:
        self._first = first

    def run(self, *command: str, fails: bool = False) -> str:
        done = subprocess.run(
            debian.inside(self._first, *command), capture_output=True, text=True, timeout=60
        )
        assert (done.returncode != 0) == fails, f"{command}: {done.stdout} {done.stderr}"
        return done.stdout + done.stderr

    def mastctl(self, *words: str, fails: bool = False) -> str:
        named = "MASTCTL_URL=http://127.0.0.1:8420"
        return self.run("/usr/bin/env", named, "/opt/mastctl/bin/mastctl", *words, fails=fails)

    def status(self, *words: str) -> dict[str, Any]:
        return dict(json.loads(self.mastctl("status", "--json", *words)))

    def property(self, name: str) -> str:
        return self.run("systemctl", "show", "--property", name, "--value", "mastctl").strip()

    def journal(self) -> str:
        return self.run("journalctl", "--unit", "mastctl", "--no-pager", "--output", "cat")

    def back_after(self, signal_name: str) -> str:
        """Send the daemon's process a signal; return what systemd did until the service is up again."""
        before, restarts = len(self.journal()), int(self.property("NRestarts"))
        self.run("systemctl", "kill", f"--signal={signal_name}", "--kill-whom=main", "mastctl")
        until(lambda: self.property("NRestarts") == str(restarts + 1), "systemd begins it again")
        until(lambda: self.property("ActiveState") == "active", "the service is up")
        return self.journal()[before:]


@pytest.fixture(scope="module")
def machine(service_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Booted]:
    with debian.booted(service_root, tmp_path_factory.mktemp("console") / "console.txt") as first:
        yield Booted(first)


def test_systemd_starts_the_service_and_says_how_it_is(machine: Booted) -> None:
    machine.run("systemctl", "start", "servos", "mastctl")
    assert machine.property("ActiveState") == "active"
    assert machine.status("--wait", "30")["state"] in WELL
    until(lambda: machine.property("StatusText") in WELL, "systemd knows it")
    assert "1.4 OK" in machine.run("systemd-analyze", "security", "--no-pager", "mastctl")


def test_a_daemon_that_hangs_is_killed_its_servos_halted_and_it_comes_back(machine: Booted) -> None:
    machine.mastctl("point", "--angles", "1.3", "0", "--no-wait")
    until(lambda: machine.status()["state"] == "moving", "the head moves")
    in_order(
        machine.back_after("STOP"),
        r"Watchdog timeout",
        r"Killing process \d+ \(mastctl\) with signal SIGKILL",
        r"pan \(servo 1\) was (stopped by its watchdog|commanded to stand)",
        r"Failed with result 'watchdog'",
        r"Started mastctl.service",
    )
    until(lambda: not machine.status("--wait", "30")["moving"], "the head stands")
    assert machine.status()["joints"]["pan_rad"] < 1.25


def test_a_latch_is_held_through_a_kill_until_somebody_resets_it(machine: Booted) -> None:
    machine.mastctl("estop")
    in_order(machine.back_after("KILL"), r"Failed with result 'signal'", r"Started mastctl.service")
    assert machine.property("StatusText").startswith("stopped: an emergency stop is latched")
    assert "emergency stop is latched" in machine.mastctl("point", "--angles", "0", "0", fails=True)
    machine.mastctl("reset", "--reason", "tried", "--name", "the suite")
    assert machine.status()["state"] == "holding"


def test_systemctl_stop_stops_the_head_first_and_nothing_starts_again(machine: Booted) -> None:
    machine.mastctl("point", "--angles", "-1.3", "0", "--no-wait")
    until(lambda: machine.status()["state"] == "moving", "the head moves")
    before = len(machine.journal())
    machine.run("systemctl", "stop", "mastctl")
    in_order(
        machine.journal()[before:],
        r"ending: the mast is stopped first",
        r"pan \(servo 1\) was commanded to stand where it is, and holds",
        r"Deactivated successfully",
    )
    assert machine.property("ActiveState") == "inactive"  # and not "activating", as before a restart
    assert machine.property("Result") == "success"


PTU = f"""
[Service]
User=mastctl
ExecStart=/opt/mastctl/bin/mastctl rig sim ptu --tcp {HEAD}:4000
"""


def test_a_head_on_the_network_is_reached_once_the_unit_allows_its_address(
    machine: Booted, service_root: Path, repository: Path
) -> None:
    machine.run("systemctl", "stop", "mastctl")  # with the servos of the tests before
    machine.run("ip", "address", "add", f"{HEAD}/32", "dev", "lo")
    units, file = service_root / "etc/systemd/system", service_root / "etc/mastctl/mastctl.yaml"
    (units / "ptu.service").write_text(PTU)
    limits = "pan: {limits_rad: [-2.5, 2.5], sign: -1}, tilt: {limits_rad: [-0.7, 0.4]}"
    text, count = re.subn(
        r"^pan_tilt:\n(  .*\n|#.*\n)+",
        f"pan_tilt: {{driver: flir_ptu, options: {{port: 'socket://{HEAD}:4000', {limits}}}}}\n",
        file.read_text(), flags=re.MULTILINE,
    )  # fmt: skip
    assert count == 1
    file.write_text(text)
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "start", "ptu")
    before = len(machine.journal())
    machine.run("systemctl", "start", "mastctl", fails=True)
    in_order(
        machine.journal()[before:],
        r"socket://192\.0\.2\.10:4000 cannot be opened: timed out; .*IPAddressAllow",
    )
    machine.run("systemctl", "stop", "mastctl")
    page = (repository / "docs/how-to/operations.md").read_text()
    drop_in = re.search(r"```ini\n(\[Service\]\nIPAddressAllow=)[\d.]+\n```", page)
    assert drop_in is not None, "the page shows the drop-in"
    (units / "mastctl.service.d").mkdir()
    (units / "mastctl.service.d/override.conf").write_text(f"{drop_in[1]}{HEAD}\n")
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "start", "mastctl")
    assert machine.status("--wait", "30")["state"] in WELL
    in_order(machine.back_after("KILL"), r"pan and tilt halted \(H\), confirmed", r"Started mastctl.service")
    machine.run("systemctl", "stop", "mastctl", "ptu")


def in_order(text: str, *patterns: str) -> None:
    """Assert that these stand in a text, one after the other."""
    place = 0
    for pattern in patterns:
        found = re.search(pattern, text[place:])
        assert found, f"{pattern!r} is not there, or too early, in:\n{text}"
        place += found.end()
