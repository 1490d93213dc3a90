"""What the head does when its daemon dies, freezes or runs out of something; on simulated servos."""

from __future__ import annotations

import ast
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
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from calib.files.mast_file import save_rig
from drivers.dynamixel.settings import LONGEST_REPLY_S
from hil_tests import forks
from hil_tests.mastctl.outside_daemon import Pipe, daemon_process, free_port, line
from hil_tests.mastctl.service_fakes import rig
from hil_tests.waiting import NET_S, until
from mastctl.client import Client, ClientError
from mastctl.client.jog import Jog
from mastctl.safety.stop_line import ask
from tools.campaigns.servo_rigs import line_alone

GOAL_RAD = 0.95
SPEED_RAD_PER_S = 0.05  # the way takes 19 s: a stop on a busy machine still comes before its end
STANDS_S = 0.3
SAME_RAD = 1e-4
COUNTS_RAD = 5e-3  # three of the coarser servo's
JOG_GOES_ON_S = 0.35  # docs/how-to/limits.md: a goal 0.25 s ahead, ten of them a second

DRIVERS = ["dynamixel", "flir_ptu"]


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
        client.point(pan_rad=GOAL_RAD, tilt_rad=0.0)
        until(lambda: self.pan_rad > 0.02, "the move")

    def halt(self) -> subprocess.CompletedProcess[str]:
        command = [*forks.MASTCTL, "halt", "--config", str(self.config), "--json"]
        return forks.run(command, timeout=NET_S)


@pytest.fixture(params=DRIVERS)
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    driver, _, watchdog = request.param.partition(" with ")
    with made(driver, tmp_path, bool(watchdog)) as one:
        yield one


@contextlib.contextmanager
def made(driver: str, folder: Path, watchdog: bool = False) -> Iterator[Bench]:
    """Without its watchdog a head that stands was told to; a starved daemon does not trip it."""
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


def test_killed_during_a_jog_the_head_goes_no_further_than_the_goal_ahead_whatever_its_driver(
    bench: Bench,
) -> None:
    with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
        with pytest.raises(ClientError) as gone, contextlib.ExitStack() as jogs:
            jog = turning(client, bench, jogs)
            daemon.kill()
            daemon.wait(NET_S)
            killed_at_rad = bench.pan_rad
            until(bench.stands, "the head stands")
            stood_at_rad = bench.pan_rad
            until(lambda: not_taken(jog), "a heartbeat is missed")
        assert gone.value.code in ("no_daemon", "jog_ended")  # the latter where one was late before the kill
    assert 0.0 <= stood_at_rad - killed_at_rad <= SPEED_RAD_PER_S * JOG_GOES_ON_S + COUNTS_RAD
    done = bench.halt()
    assert done.returncode == 0, done.stderr
    assert abs(bench.pan_rad - stood_at_rad) < COUNTS_RAD


def turning(client: Client, bench: Bench, jogs: contextlib.ExitStack) -> Jog:
    """A jog under which the head turns: begun anew where a busy machine was late with a heartbeat."""
    while True:
        jog = client.jog().__enter__()
        jog.rates(SPEED_RAD_PER_S, 0.0)
        until(partial(turns_or_ended, bench, jog), "the jog")
        if not not_taken(jog):
            jogs.push(jog)
            return jog
        with contextlib.suppress(ClientError):
            jog.__exit__(None)


def turns_or_ended(bench: Bench, jog: Jog) -> bool:
    return bench.pan_rad > 0.02 or not_taken(jog)


def not_taken(jog: Jog) -> bool:
    """Whether a heartbeat was refused."""
    try:
        jog.check()
    except ClientError:
        return True
    return False


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


@pytest.mark.parametrize(
    ("bench", "name"), [("dynamixel", "SIGTERM"), ("flir_ptu", "SIGHUP")], indirect=["bench"]
)
def test_ended_in_order_the_head_is_stopped_first(bench: Bench, name: str) -> None:
    with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
        bench.under_way(client)
        daemon.send_signal(signal.Signals[name])
        assert daemon.wait(NET_S) == 0
    bench.stopped_on_the_way()


def test_frozen_under_way_the_watchdog_stops_the_head_and_thawed_it_moves_no_further(tmp_path: Path) -> None:
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


def test_a_frozen_daemon_of_a_head_without_watchdog_holds_the_line_until_it_is_killed(tmp_path: Path) -> None:
    with made("flir_ptu", tmp_path) as bench:
        with daemon_process(tmp_path, bench.config) as daemon, Client(line(daemon)) as client:
            bench.under_way(client)
            daemon.send_signal(signal.SIGSTOP)
            refused = bench.halt()
            assert refused.returncode == 1
            assert "Traceback" not in refused.stderr
            daemon.kill()  # what the unit's watchdog does, and then halt
            daemon.wait(NET_S)
        done = bench.halt()
        assert done.returncode == 0, done.stderr
        bench.stopped_on_the_way()


@pytest.mark.parametrize(
    "bench",
    [
        "flir_ptu",
        pytest.param("dynamixel", marks=pytest.mark.long(3, "the same before the other driver of a head")),
    ],
    indirect=True,
)
def test_without_a_free_descriptor_a_stop_comes_through_its_socket(bench: Bench) -> None:
    with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
        bench.under_way(client)
        numbers = [int(path.name) for path in Path(f"/proc/{daemon.pid}/fd").iterdir()]
        _, hard = resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE, (max(numbers) + 1, hard))
        with contextlib.ExitStack() as stack:
            for _ in range(30):  # whatever is free is taken
                stack.enter_context(contextlib.closing(connected(client.url)))
            assert ask(bench.folder / "state" / "stop.sock", "stop")["stopped"] is True
        bench.stopped_on_the_way()


def connected(url: str) -> Any:
    host, _, port = url.removeprefix("http://").rpartition(":")
    return socket.create_connection((host, int(port)), NET_S)


def test_a_disk_that_takes_nothing_keeps_no_stop_from_the_head_and_what_it_takes_later_holds_the_next_daemon(
    bench: Bench,
) -> None:
    with daemon_process(bench.folder, bench.config) as daemon, Client(line(daemon)) as client:
        bench.under_way(client)
        _, hard = resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE, (0, hard))
        told = client.estop(reason="sparks", name="Ana")
        assert (told["latched"], told["kept"]) == (True, False)
        assert "would not survive a restart" in told["message"]
        assert "latch_not_kept" in [fault["code"] for fault in client.status()["faults"]]
        bench.stopped_on_the_way()
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
        assert client.status()["estop"]["name"] == "Ana"
        after_s = time.monotonic()
    steps = (before_s + (after_s - before_s) * part / 200 for part in range(201))
    assert max(abs(bench.truth(step_s)[0] - before_rad) for step_s in steps) < 2e-3  # a count of the servo


@pytest.mark.parametrize(
    "bench",
    [
        "dynamixel",
        pytest.param("flir_ptu", marks=pytest.mark.long(3, "the same before the other driver of a head")),
    ],
    indirect=True,
)
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
        assert ask(bench.folder / "state" / "stop.sock", "estop Cem: smoke")["kept"] is True
        assert client.status()["estop"]["name"] == "Cem"
    os.close(pipe.read)
    os.close(pipe.write)


# The machine's clock


WALL_CLOCKS = ("time.time", "time.time_ns", "time.localtime", "datetime.now", "datetime.utcnow")
STAMPS_ONLY = {
    "mastctl/control/audit.py", "mastctl/control/entry.py", "mastctl/control/lease.py",
    "mastctl/safety/latch.py",
}  # fmt: skip


COMPARED_ONLY = {"drivers/aravis/device.py"}  # with the library's own stamps; `WallClock` sees it being set


def test_no_deadline_reads_a_clock_that_can_be_set_back(repository: Path) -> None:
    """What runs a head lives on CLOCK_MONOTONIC; the wall's clock only stamps what people read."""
    found = set()
    for room in (
        "devices",
        "operations",
        "safety",
        "commands",
        "service",
        "state",
        "web",
        "pointing",
        "tracking",
    ):
        for path in (repository / "mastctl" / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Attribute) and ast.unparse(node) in WALL_CLOCKS:
                    found.add(str(path.relative_to(repository)))
    for path in (repository / "drivers").rglob("*.py"):
        if str(path.relative_to(repository)) in COMPARED_ONLY:
            continue
        text = path.read_text(encoding="utf-8")
        assert "time.time(" not in text and "datetime.now(" not in text, path
    assert found <= STAMPS_ONLY, found - STAMPS_ONLY
