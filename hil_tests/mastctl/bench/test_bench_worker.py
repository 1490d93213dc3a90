"""The program itself on the simulated bench: its daemon killed half-way, gone on with, stopped."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import psutil
import pytest
import yaml

from hil_tests.support.living_daemon import started, written
from hil_tests.waiting import until
from mastctl.client import Client

BOUND_S = 300.0
"""A look takes a second; many, where others use the machine."""


def config(folder: Path, repository: Path) -> Path:
    """The packaged bench, quick, with a mast file and a state of its own."""
    packaged = repository / "configs"
    document = yaml.safe_load((packaged / "bench.yaml").read_text())
    (folder / "mast.yaml").write_bytes((packaged / document["mast_file"]).read_bytes())
    simulation = {**document["simulation"], "rover": str(packaged / document["simulation"]["rover"])}
    simulation |= {"samples": 1, "speed": "max"}
    own = {"mast_file": "mast.yaml", "listen": {"port": 0}, "state": {"folder": str(folder / "state")}}
    return written(folder, {**document, **own, "simulation": simulation})


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists() or "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text()


def workers(pid: int) -> list[int]:
    """The workers that a daemon has started, without the tracker of multiprocessing's resources."""
    children = psutil.Process(pid).children()
    return [
        child.pid for child in children if not any("resource_tracker" in word for word in child.cmdline())
    ]


@pytest.mark.long(
    2, "draws a bench at full speed for two daemons; each step has a quick test in test_bench_operation"
)
def test_a_run_outlives_its_killed_daemon_only_as_a_folder_to_go_on(tmp_path: Path, repository: Path) -> None:
    path = config(tmp_path, repository)

    def pictures(client: Client) -> int:
        return run["pictures"] if (run := client.bench()["run"]) else 0

    with started(path) as (daemon, port), Client(f"http://127.0.0.1:{port}", name="Ana") as client:
        name = client.begin_bench("charuco_a2")["name"]
        until(lambda: pictures(client) >= 2, "two pictures", BOUND_S)
        (program,) = workers(daemon.pid)
        os.kill(daemon.pid, signal.SIGKILL)
        until(lambda: gone(program), "the program is over too")
    with started(path) as (daemon, port), Client(f"http://127.0.0.1:{port}", name="Ana") as client:
        (kept,) = client.bench()["runs"]
        assert (kept["name"], kept["state"]) == (name, "interrupted") and kept["pictures"] >= 2
        client.begin_bench(resume=name)
        until(lambda: pictures(client) > kept["pictures"], "more", BOUND_S)
        (program,) = workers(daemon.pid)
        run = client.bench()["run"]
        assert run is not None and any("going on with" in sentence for sentence in run["sentences"])
        client.stop()
        until(lambda: client.bench()["runs"][0]["state"] == "interrupted", "it has ended", BOUND_S)
        run = client.bench()["run"]
        assert run is not None and gone(program) and client.control() is None
        # Where the stop met a move the program itself may have been the first to say so.
        assert run["code"] in ("stopped", "interrupted") and "stop" in run["sentence"], run["sentence"]
        assert client.bench()["runs"][0]["pictures"] > kept["pictures"]
