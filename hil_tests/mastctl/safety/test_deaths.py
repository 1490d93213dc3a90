"""What the head does when its daemon dies, freezes or runs out of something; on simulated servos."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from calib.files.mast_file import save_rig
from drivers.servo_bus.settings import LONGEST_REPLY_S
from hil_tests import forks
from hil_tests.mastctl.outside_daemon import Pipe, daemon_process, free_port, line
from hil_tests.mastctl.service_fakes import rig
from hil_tests.support.servo_rigs import line_alone
from hil_tests.waiting import NET_S, present, until
from mastctl.client import Client, ClientError
from mastctl.safety.stop_socket import request

GOAL_RAD = 0.95
SPEED_RAD_PER_S = 0.05  # the way takes 19 s: a stop on a busy machine still comes before its end
STANDS_S = 0.3
SAME_RAD = 1e-4


@dataclass
class Bench:
    """A configuration of a head on a simulated line, and where its mechanism truly is."""

    driver: str
    folder: Path
    config: Path
    truth: Callable[[float], tuple[float, float]]

    @property
    def pan_rad(self) -> float:
        return self.truth(time.monotonic())[0]

    def stands(self) -> bool:
        """Whether pan has not moved for a while."""
        now_s = time.monotonic()
        return abs(self.truth(now_s)[0] - self.truth(now_s - STANDS_S)[0]) < SAME_RAD

    def stopped_on_the_way(self) -> None:
        """Wait until it stands; that must be short of its goal, and stay so."""
        until(self.stands, "the head stands")
        assert 0.0 < self.pan_rad < GOAL_RAD - 0.05

    def under_way(self, client: Client) -> None:
        """Send the head off, again where a starved simulator cost a pointing its answer."""

        def moves() -> bool:
            if self.pan_rad <= 0.02 and client.status()["operation"] is None:
                with contextlib.suppress(ClientError):
                    client.point(pan_rad=GOAL_RAD, tilt_rad=0.0)
            return self.pan_rad > 0.02

        until(moves, "the move")

    def halt(self) -> subprocess.CompletedProcess[str]:
        command = [*forks.MASTCTL, "stop", "--without-daemon", "--config", str(self.config), "--json"]
        return forks.run(command, timeout=NET_S)


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    driver, _, watchdog = getattr(request, "param", "dynamixel").partition(" with ")
    with made(driver, tmp_path, bool(watchdog)) as one:
        yield one


@contextlib.contextmanager
def made(driver: str, folder: Path, watchdog: bool = False) -> Iterator[Bench]:
    """Without its watchdog a head at rest was stopped by a command; a starved daemon does not trip it."""
    with line_alone(driver) as (options, truth):
        if driver == "dynamixel" and not watchdog:
            options |= {"watchdog_s": 0, "reply_timeout_s": LONGEST_REPLY_S}
        save_rig(rig(), folder / "little.yaml")
        limits = {"pan_rad": [-0.97, 0.97], "tilt_rad": [-0.5, 0.35], "speed_rad_per_s": SPEED_RAD_PER_S}
        document = {
            "schema": "mastctl/config/1",
            "mast_file": "little.yaml",
            "listen": {"port": free_port()},
            "pan_tilt": {"driver": driver, "options": options},
            "limits": limits,
            "state": {"folder": "state"},
        }
        config = folder / "bench.yaml"
        config.write_text(json.dumps(document))  # which is YAML too
        yield Bench(driver, folder, config, truth)


@pytest.mark.parametrize("bench", ["dynamixel with its watchdog", "feetech", "flir_ptu"], indirect=True)
def test_killed_under_way_the_watchdog_or_halt_stops_the_head(bench: Bench) -> None:
    with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
        bench.under_way(client)
        daemon.kill()
        daemon.wait(NET_S)
    if bench.driver == "flir_ptu":  # it has no watchdog: it goes on until somebody says stop
        killed_at_rad = bench.pan_rad
        until(lambda: bench.pan_rad > killed_at_rad + 0.02, "it goes on")
    else:
        bench.stopped_on_the_way()
    done = bench.halt()
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["halted"] is True
    bench.stopped_on_the_way()
    again = bench.halt()  # a head that stands is left standing
    assert again.returncode == 0, again.stderr
    bench.stopped_on_the_way()


def test_halt_stops_servos_that_move_without_a_watchdog(tmp_path: Path) -> None:
    with made("dynamixel", tmp_path) as bench:
        with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
            bench.under_way(client)
            daemon.kill()
            daemon.wait(NET_S)
        killed_at_rad = bench.pan_rad
        until(lambda: bench.pan_rad > killed_at_rad + 0.02, "it goes on")
        done = bench.halt()
        assert done.returncode == 0, done.stderr
        assert "commanded to stand" in json.loads(done.stdout)["said"][0]
        bench.stopped_on_the_way()


def test_halt_reads_only_what_the_configuration_says_of_the_head(bench: Bench) -> None:
    bench.config.write_text(
        json.dumps({**json.loads(bench.config.read_text()), "limits": "none", "mast_file": 3, "no": "such"})
    )
    assert bench.halt().returncode == 0
    bench.config.write_text("schema: mastctl/config/1")
    done = bench.halt()
    assert done.returncode == 2
    assert "pan_tilt: the key is missing" in done.stdout


def test_halt_of_a_line_that_is_gone_says_that_the_head_was_not_told(bench: Bench) -> None:
    document = json.loads(bench.config.read_text())
    document["pan_tilt"]["options"]["port"] = str(bench.folder / "no_such_line")
    bench.config.write_text(json.dumps(document))
    done = bench.halt()
    assert done.returncode == 1
    assert "no_such_line" in json.loads(done.stdout)["error"]["message"]


def test_a_frozen_daemons_head_is_stopped_by_the_watchdog_for_good(tmp_path: Path) -> None:
    with (
        made("dynamixel", tmp_path, watchdog=True) as bench,
        daemon_process(tmp_path, bench.config) as daemon,
        Client(line(daemon)) as client,
    ):
        bench.under_way(client)
        daemon.send_signal(signal.SIGSTOP)
        bench.stopped_on_the_way()
        stood_at_rad = bench.pan_rad
        daemon.send_signal(signal.SIGCONT)
        until(lambda: client.operations()[0]["state"] == "failed", "the operation fails")
        until(bench.stands, "the head stands")
        assert abs(bench.pan_rad - stood_at_rad) < 0.01


@pytest.mark.parametrize("bench", ["flir_ptu"], indirect=True)
def test_without_a_free_descriptor_a_stop_comes_through_its_socket(bench: Bench) -> None:
    with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
        bench.under_way(client)
        numbers = [int(path.name) for path in Path(f"/proc/{daemon.pid}/fd").iterdir()]
        _, hard = resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE, (max(numbers) + 1, hard))
        with contextlib.ExitStack() as stack:
            for _ in range(30):  # whatever is free is taken
                stack.enter_context(contextlib.closing(connected(client.url)))
            assert request(bench.folder / "state" / "stop.sock", "stop")["stopped"] is True
        bench.stopped_on_the_way()


def connected(url: str) -> Any:
    host, _, port = url.removeprefix("http://").rpartition(":")
    return socket.create_connection((host, int(port)), NET_S)


def test_a_full_disk_keeps_no_stop_from_the_head_and_latches_later(bench: Bench) -> None:
    with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
        bench.under_way(client)
        _, hard = resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE, (0, hard))
        outcome = client.estop(reason="sparks", name="Ana")
        assert (outcome["latched"], outcome["kept"]) == (True, False)
        assert "would not survive a restart" in present(outcome["message"])
        assert "latch_not_kept" in [fault["code"] for fault in client.status()["faults"]]
        bench.stopped_on_the_way()
        until(lambda: client.status()["state"] != "stopping", "the daemon knows that it stands")
        with pytest.raises(ClientError) as refused:
            client.point(pan_rad=0.1, tilt_rad=0.0)
        assert refused.value.code == "estopped"
        resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE, (hard, hard))
        until(
            lambda: "latch_not_kept" not in [fault["code"] for fault in client.status()["faults"]],
            "the disk takes it",
        )
        daemon.kill()
    # opened by a latched daemon the head does not move at all
    assert bench.halt().returncode == 0
    until(bench.stands, "the head stands")
    before_s, before_rad = time.monotonic(), bench.pan_rad
    with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
        assert present(client.status()["estop"])["name"] == "Ana"
        after_s = time.monotonic()
    steps = (before_s + (after_s - before_s) * part / 200 for part in range(201))
    assert max(abs(bench.truth(step_s)[0] - before_rad) for step_s in steps) < 2e-3  # a count of the servo


def test_with_a_full_log_pipe_stops_of_both_kinds_come_through_both_doors(bench: Bench) -> None:
    pipe = Pipe()
    with (
        daemon_process(bench.folder, bench.config, stderr=pipe.write) as daemon,
        Client(line(daemon)) as client,
    ):
        pipe.fill()
        bench.under_way(client)
        assert client.stop()["stopped"] is True
        bench.stopped_on_the_way()
        assert client.estop(name="Ana")["kept"] is True
        until(lambda: client.status()["state"] == "stopped", "the stop's end")
        client.reset(reason="looked", name="Ben")
        assert request(bench.folder / "state" / "stop.sock", "estop Cem: smoke")["kept"] is True
        assert present(client.status()["estop"])["name"] == "Cem"
    os.close(pipe.read)
    os.close(pipe.write)
