"""A bench's mast on a whole daemon: its sentences when something is pulled out, dark, stopped or taken."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.mode import SensorMode
from calib.geometry.rig import AxisJoint, JointErrors
from calib.plan.placements import Placement
from calib.targets.boards import Charuco
from hil_tests.waiting import until
from mastctl.bench import mast as bench_mast
from mastctl.bench.mast import BenchInterrupted, DaemonMast, NoLight, NotThere, SimulatedBoard, beside_goal
from mastctl.bench.survey import survey_cameras
from mastctl.client import Client
from mastctl.config import Config, Listen, load_config
from mastctl.daemon import RunningDaemon

BOARD = Charuco(10, 7, 0.055, 0.042)
CAMERAS = ("navcam_left", "navcam_right")


def bench(repository: Path) -> Config:
    """The packaged bench, quick."""
    config = load_config(repository / "configs/bench.yaml")
    simulation = {**config.hardware.simulation, "speed": "max", "samples": 1}
    return replace(config, listen=Listen(port=0), hardware=replace(config.hardware, simulation=simulation))


@pytest.fixture(scope="module")
def client(repository: Path) -> Iterator[Client]:
    config = bench(repository)
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        yield client


@pytest.fixture
def mast(client: Client, monkeypatch: pytest.MonkeyPatch) -> Iterator[DaemonMast]:
    monkeypatch.setattr(bench_mast, "PATIENCE_S", 0.2)
    monkeypatch.setattr(bench_mast, "AGAIN_S", 0.05)
    mast = DaemonMast(client, CAMERAS, BOARD)
    SimulatedBoard(client, BOARD, mast.head.rig).stand(Placement(1.2, 0.0, 0.0, (15.0, 0.0)))
    yield mast
    client.clear_faults()


def test_a_look_shows_the_board_with_one_reading_and_describes_the_head(mast: DaemonMast) -> None:
    assert mast.head.one_sided and mast.head.count_rad == pytest.approx(5.6e-5, rel=0.01)
    left = mast.head.rig.cameras["navcam_left"]
    whole = SensorMode(left.model.size_px, (0, 0, *left.model.size_px), left.model.size_px)
    assert left.sensor_mode == whole
    kept = survey_cameras(mast.head.rig)
    assert kept["navcam_left"].sensor_mode == whole
    look = mast.look(0.05, -0.02)
    assert [one.camera for one in look.found] == list(CAMERAS)
    assert look.pan_rad == pytest.approx(0.05, abs=1e-4)
    assert all(one.corners is not None and len(one.corners) > 20 and one.data for one in look.found)
    assert mast.look(0.05, -0.02, cameras=CAMERAS[1:]).cameras == CAMERAS[1:]


def test_a_head_with_joints_in_its_file_is_turned_to_wanted_readings(
    repository: Path, tmp_path: Path
) -> None:
    config = bench(repository)
    wave = AxisJoint(harmonics_rad=((0.006, 0.0),))
    rig = replace(load_rig(config.mast_file).rig, joints=JointErrors(wave, wave))
    save_rig(rig, tmp_path / "waves.yaml")
    config = replace(config, mast_file=tmp_path / "waves.yaml")
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        look = DaemonMast(client, CAMERAS, BOARD).look(0.05, -0.02)
    assert (look.pan_rad, look.tilt_rad) == (pytest.approx(0.05, abs=1e-4), pytest.approx(-0.02, abs=1e-4))


def test_a_camera_that_is_pulled_out_is_named_and_the_other_still_looks(
    client: Client, mast: DaemonMast
) -> None:
    client.set_fault("navcam_right", "off")
    look = mast.look(0.02, 0.0)
    assert [one.camera for one in look.found] == ["navcam_left"]
    assert look.seen[1].why == "camera navcam_right gave no picture"


def test_when_no_camera_gives_a_picture_the_bench_waits_and_then_says_so(
    client: Client, mast: DaemonMast
) -> None:
    for camera in CAMERAS:
        client.set_fault(camera, "off")
    with pytest.raises(BenchInterrupted, match="navcam"):
        mast.look(0.0, 0.0)
    client.clear_faults()
    assert mast.look(0.0, 0.0).found  # and goes on


def test_pictures_in_the_dark_say_that_they_are_dark(client: Client, mast: DaemonMast) -> None:
    client.set_fault("navcam_left", "dark")
    look = mast.look(0.0, 0.0)
    assert look.seen[0].why.startswith("the picture is dark") and look.seen[1].corners
    client.set_fault("navcam_right", "dark")
    with pytest.raises(NoLight, match=r"navcam_left: the picture is dark.*; turn on a light"):
        mast.look(0.0, 0.0)  # elsewhere it may be light: a search goes on


def test_beyond_the_limits_nothing_is_looked_at_and_nothing_ends(mast: DaemonMast) -> None:
    with pytest.raises(NotThere):
        mast.look(3.0, 0.0)


FAR_RAD = 2.0


@pytest.fixture(scope="module")
def url(repository: Path) -> Iterator[str]:
    """A head that cannot arrive while a test runs: what is done once it turns is done in the middle."""
    config = bench(repository)
    simulation = {**config.hardware.simulation, "speed": 1.0}
    limits = replace(config.limits, speed_rad_per_s=0.02)
    config = replace(config, limits=limits, hardware=replace(config.hardware, simulation=simulation))
    with RunningDaemon(config) as daemon:
        yield daemon.url


@contextmanager
def in_the_move(url: str, act: Callable[[Client], object]) -> Iterator[DaemonMast]:
    """The mast of a bench that steers; something is done as soon as the head turns."""

    def wait_and_act() -> None:
        with Client(url, name="Ana") as other:
            until(lambda: other.status()["moving"], "the head turns")
            act(other)

    thread = threading.Thread(target=wait_and_act)
    with Client(url, name="bench") as client, client.lease("calibrate bench", take_over="a test"):
        mast = DaemonMast(client, CAMERAS[:1], BOARD)
        thread.start()
        yield mast
        thread.join()


@pytest.mark.parametrize(
    ("act", "reason"),
    [
        (lambda ana: ana.stop(), "the head was stopped in the middle of a move: a stop was requested"),
        (lambda ana: ana.estop(reason="a hand", name="Ana"), "an emergency stop"),
        (lambda ana: ana.acquire_lease("Ana", take_over="it is needed"), "Ana took over: it is needed"),
    ],
    ids=["stop", "emergency stop", "taken over"],
)
def test_what_ends_a_move_is_named(url: str, act: Callable[[Client], object], reason: str) -> None:
    with in_the_move(url, act) as mast, pytest.raises(BenchInterrupted, match=reason):
        mast.look(FAR_RAD, 0.0)
    with Client(url) as client:
        if client.status()["estop"] is not None:
            client.reset(reason="the hand is away", name="Ana")


def test_ctrl_c_in_the_middle_of_a_move_leaves_no_head_behind_that_turns(url: str) -> None:
    main = threading.main_thread().ident
    assert main is not None
    interrupt = partial(signal.pthread_kill, main, signal.SIGINT)
    with in_the_move(url, lambda ana: interrupt()) as mast, pytest.raises(KeyboardInterrupt):
        mast.look(FAR_RAD, 0.0)
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
