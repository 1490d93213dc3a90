"""What ends a look while the head turns: a stop, emergency or not, a lease that is taken, Ctrl-C."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from calib.targets.boards import Charuco
from hil_tests import forks
from hil_tests.waiting import until
from mastctl.bench import mast as bench_mast
from mastctl.bench.mast import BenchInterrupted, DaemonMast, beside_goal
from mastctl.client import Client

BOARD = Charuco(10, 7, 0.055, 0.042)
FAR_RAD = 2.0
CRAWLING_RAD_PER_S = 0.02
"""The head cannot arrive while a test runs: what is done once it turns is done in the middle of the move."""


@contextmanager
def crawling_daemon(repository: Path, folder: Path) -> Iterator[str]:
    """The address of a daemon in a process of its own."""
    text = (repository / "configs/bench.yaml").read_text().replace("8420", "0")
    for name in ("masts", "sim"):
        text = text.replace(f" {name}/", f" {repository}/configs/{name}/")
    text = re.sub(r"(speed_rad_per_s: )[\d.]+", rf"\g<1>{CRAWLING_RAD_PER_S}", text)
    (folder / "bench.yaml").write_text(text)
    command = [*forks.MASTCTL, "run", "--config", str(folder / "bench.yaml")]
    with (
        tempfile.TemporaryDirectory() as temporary,  # killed, it clears nothing away
        forks.Popen(
            command, stdout=subprocess.PIPE, text=True, env={**os.environ, "TMPDIR": temporary}
        ) as process,
    ):
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[-1]
        finally:
            process.kill()


@pytest.fixture(scope="module")
def url(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with crawling_daemon(repository, tmp_path_factory.mktemp("bench")) as address:
        yield address


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_mast, "PATIENCE_S", 0.2)
    monkeypatch.setattr(bench_mast, "AGAIN_S", 0.05)


def in_the_move(url: str, act: Callable[[Client], object]) -> threading.Thread:
    """Do something as soon as the head turns."""

    def wait_and_act() -> None:
        with Client(url, name="Ana") as other:
            until(lambda: other.status()["moving"], "the head turns")
            act(other)

    thread = threading.Thread(target=wait_and_act)
    thread.start()
    return thread


def far_look(url: str, act: Callable[[Client], object]) -> str:
    """What a look says in the middle of whose move something is done."""
    with Client(url, name="bench") as client, client.lease(name="calibrate bench"):
        mast = DaemonMast(client, ("navcam_left",), BOARD)
        thread = in_the_move(url, act)
        with pytest.raises(BenchInterrupted) as answer:
            mast.look(FAR_RAD, 0.0)
        thread.join()
        return str(answer.value)


def test_a_stop_and_an_emergency_stop_are_told_apart(url: str) -> None:
    assert far_look(url, lambda ana: ana.stop()) == (
        "the head was stopped in the middle of a move: a stop was requested"
    )
    answer = far_look(url, lambda ana: ana.estop(reason="a hand in the way", name="Ana"))
    assert "an emergency stop" in answer
    with Client(url) as client:
        client.reset(reason="the hand is away", name="Ana")


def test_a_lease_that_is_taken_stops_the_move_and_no_other_begins(url: str) -> None:
    with (
        Client(url, name="Ana") as ana,
        Client(url, name="bench") as client,
        client.lease(name="calibrate bench"),
    ):
        mast = DaemonMast(client, ("navcam_left",), BOARD)
        move = client.point(pan_rad=FAR_RAD, tilt_rad=0.0)
        until(lambda: ana.status()["moving"], "the head turns")
        with (
            ana.lease("Ana", take_over="the head is needed"),
            pytest.raises(BenchInterrupted, match="Ana took over: the head is needed"),
        ):
            mast.look(-FAR_RAD, 0.0)
        assert ana.wait(move)["state"] == "stopped"


def test_a_stop_between_two_moves_ends_it_and_is_told(url: str) -> None:
    with (
        Client(url, name="Ana") as ana,
        Client(url, name="bench") as client,
        client.lease(name="calibrate bench", ends_with_stop=True),
    ):
        mast = DaemonMast(client, ("navcam_left",), BOARD)
        here = ana.status()["joints"]
        assert here is not None
        client.wait(client.point(pan_rad=here["pan_rad"] + 0.01, tilt_rad=here["tilt_rad"]))
        ana.stop()
        stands = ana.status()["joints"]
        with pytest.raises(BenchInterrupted, match=r"^the head was stopped by Ana$"):
            mast.look(FAR_RAD, 0.0)
        now = ana.status()["joints"]
        assert stands is not None and now is not None and now["pan_rad"] == stands["pan_rad"]


def test_a_move_that_outlasts_its_time_is_stopped(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_mast, "TURN_TIMEOUT_S", 0.5)
    with Client(url, name="bench") as client, client.lease(name="calibrate bench"):
        mast = DaemonMast(client, ("navcam_left",), BOARD)
        with pytest.raises(BenchInterrupted, match=r"did not end in the 0\.5 s"):
            mast.look(FAR_RAD, 0.0)
        until(lambda: not client.status()["moving"], "the head has come to rest")
        joints = client.status()["joints"]
    assert joints is not None and joints["pan_rad"] < FAR_RAD - 0.2


def test_ctrl_c_in_the_middle_of_a_move_leaves_no_head_behind_that_turns(url: str) -> None:
    with Client(url, name="bench") as client, client.lease(name="calibrate bench"):
        mast = DaemonMast(client, ("navcam_left",), BOARD)
        main = threading.main_thread().ident
        assert main is not None
        thread = in_the_move(url, lambda ana: signal.pthread_kill(main, signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            mast.look(FAR_RAD, 0.0)
        thread.join()
    with Client(url) as other:
        until(lambda: not other.status()["moving"], "the head has come to rest")
        joints = other.status()["joints"]
    assert joints is not None and joints["pan_rad"] < FAR_RAD - 0.2


def test_a_head_with_play_passes_through_it_from_the_side_with_room() -> None:
    limits = (-1.0, 0.5)
    for side in (0, 1):  # it comes from below anyway
        assert beside_goal(0.2, -0.5, side, limits) == 0.2
    assert beside_goal(0.2, 0.19, 0, limits) == pytest.approx(0.14)  # too near to have gone through the play
    assert beside_goal(0.2, -0.5, -1, limits) == pytest.approx(0.26)
    assert beside_goal(0.49, 0.3, -1, limits) == 0.49  # no room above: from below, where it comes from anyway
    assert beside_goal(0.49, 0.48, -1, limits) == pytest.approx(0.43)
