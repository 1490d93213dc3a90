"""The plug-in's fixtures as a test of a rover program uses them; the suite itself is such a project here."""

from __future__ import annotations

import math
import os
import signal
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from hil_tests.waiting import NET_S, until
from mastctl.client import Client, ClientError
from mastctl.testing import RoverError, SetFault, SimulatedRover

pytestmark = pytest.mark.mastctl(picture_width_px=320, scene={"relief_m": 0.0, "rocks": 0})

SetsFault = Callable[..., SetFault]

MIDDLE_PX = (159.5, 119.5)
SEEN: list[str] = []


def clicked(client: Client) -> tuple[str, str, float, float]:
    shot = client.snapshot("navcam_left")
    return "navcam_left", shot.frame_id, 200.0, 150.0


def ended(client: Client, pixel: tuple[str, str, float, float]) -> str:
    record = client.wait(client.point(pixel=pixel))
    return str(record["error"]["code"] if record["error"] else record["state"])


def points_again(client: Client) -> None:
    """Stop, which also arms a bus watchdog that has tripped, and point, until that is done."""

    def stopped() -> bool:
        try:
            client.stop()
        except ClientError:  # it is not back yet
            return False
        return True

    def done() -> bool:
        try:
            code = ended(client, clicked(client))
        except ClientError as error:
            code = error.code
        if code not in ("done", "frame_moving"):  # another stop would keep it from being seen at rest
            stopped()
        return code == "done"

    until(stopped, "a stop is confirmed")
    until(done, "it points again")


def code_of_snapshot(client: Client, camera: str) -> str:
    try:
        client.snapshot(camera)
    except ClientError as error:
        return error.code
    return "done"


def listening_at(port: int) -> list[int]:
    """The processes with a socket that listens at a port of this machine."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    sockets = {f"socket:[{row[9]}]" for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "0A"}
    found = []
    for folder in Path("/proc").glob("[0-9]*/fd"):
        with suppress(OSError):
            if any(str(one.readlink()) in sockets for one in folder.iterdir()):
                found.append(int(folder.parent.name))
    return found


def test_the_address_is_that_of_a_daemon(mast_daemon: str) -> None:
    with urllib.request.urlopen(f"{mast_daemon}/api/v1/status", timeout=NET_S) as answer:
        assert b'"simulated"' in answer.read()


def test_what_was_clicked_comes_to_the_middle_in_truth(
    mast_client: Client, simulated_rover: SimulatedRover
) -> None:
    pixel = clicked(mast_client)
    point_m = simulated_rover.true_point(*pixel[1:])
    assert point_m is not None and abs(point_m[2]) < 0.01, "flat ground"
    assert simulated_rover.true_pixel(pixel[1], point_m) == pytest.approx(pixel[2:], abs=1e-6)
    record = mast_client.wait(mast_client.point(pixel=pixel))
    landed = record["pointings"][0]["frame_id"]
    assert simulated_rover.true_pixel(landed, point_m) == pytest.approx(MIDDLE_PX, abs=0.3)
    pan_rad, tilt_rad = simulated_rover.true_joints()
    assert math.hypot(pan_rad, tilt_rad) > 0.05


@pytest.mark.parametrize("turn", [1, 2])
def test_every_test_begins_with_a_rover_just_switched_on(
    mast_client: Client, simulated_rover: SimulatedRover, turn: int
) -> None:
    status = mast_client.status()
    assert (status["faults"], status["track"]["state"], status["last_residual"]) == ([], "idle", None)
    assert mast_client.operations() == [] and mast_client.faults() == []
    assert simulated_rover.true_pose()[0] == (0.0, 0.0, 0.0)
    shot = mast_client.snapshot("navcam_left")
    SEEN.append(shot.frame_id)
    assert SEEN[-1] == SEEN[0], "the same commands from the same seed"
    simulated_rover.set_fault("pan_tilt", "wrong")
    simulated_rover.stand(3.0, 1.0, 0.5)
    mast_client.wait(mast_client.point(pan_rad=0.4, tilt_rad=-0.2))
    simulated_rover.advance(100.0)


def test_the_clock_stands_still_between_commands_and_advances_when_told(
    mast_client: Client, simulated_rover: SimulatedRover
) -> None:
    before_s = simulated_rover.now_s()
    assert simulated_rover.now_s() == before_s == mast_client.simulation_time()["now_s"]
    assert simulated_rover.advance(2.5) == pytest.approx(before_s + 2.5)
    with pytest.raises(RoverError, match="expected a number from 0"):
        simulated_rover.advance(-1.0)


def test_a_fault_goes_by_itself_by_a_block_or_by_hand(
    mast_client: Client, simulated_rover: SimulatedRover, fault: SetsFault
) -> None:
    with fault("navcam_left", "off"):
        assert code_of_snapshot(mast_client, "navcam_left") == "no_fresh_frame"
    assert code_of_snapshot(mast_client, "navcam_left") == "done"
    dark = fault("navcam_left", "dark")
    fault("navcam_left", "slow", factor=0.5)
    assert code_of_snapshot(mast_client, "navcam_left") == "bad_frame"
    dark.clear()
    assert code_of_snapshot(mast_client, "navcam_left") == "done"
    assert [one["word"] for one in mast_client.faults()] == ["slow"]
    fault("navcam_left", "off", for_s=30.0)
    simulated_rover.advance(31.0)
    assert code_of_snapshot(mast_client, "navcam_left") == "done"


@pytest.mark.parametrize(
    ("device", "word", "numbers", "message"),
    [
        ("navcam_lef", "off", {}, "did you mean 'navcam_left'"),
        ("navcam_left", "drak", {}, "did you mean 'dark'"),
        ("pan_tilt", "slow", {"factor": 2.0}, "expected a number from 0.0001 to 1"),
    ],
)
def test_what_is_no_fault_is_told(
    fault: SetsFault, device: str, word: str, numbers: dict[str, float], message: str
) -> None:
    with pytest.raises(RoverError, match=message):
        fault(device, word, **numbers)


def test_the_truth_of_a_frame_that_was_not_taken_is_refused(simulated_rover: SimulatedRover) -> None:
    for frame_id in ("nonsense", "navcam_left-000777-ef203a9e-91b7"):
        with pytest.raises(RoverError):
            simulated_rover.true_point(frame_id, 0, 0)


def test_places_and_points_that_are_none_are_told(
    mast_client: Client, simulated_rover: SimulatedRover
) -> None:
    before = simulated_rover.true_pose()
    for place in ((math.nan, 0.0, 0.0), (0.0, 0.0, math.nan), (0.0, 0.0, 0.0, math.inf)):
        with pytest.raises(RoverError, match=r"expected a finite number|off the simulated ground"):
            simulated_rover.stand(*place)
    assert simulated_rover.true_pose() == before
    frame_id = mast_client.snapshot("navcam_left").frame_id
    with pytest.raises(RoverError, match="position_m has 2 numbers, expected three"):
        simulated_rover.true_pixel(frame_id, (1.0, 2.0))


@pytest.mark.parametrize(
    ("device", "word", "numbers", "code"),
    [
        ("pan_tilt", "silent", {"axis": 0}, "no_reply"),
        ("pan_tilt", "silent", {"axis": 1}, "no_reply"),
        ("pan_tilt", "not_a_number", {"axis": 1}, "bad_reply"),
        ("navcam_left", "hang", {"call": 1}, "no_reply"),
        ("navcam_right", "hang", {"call": 3}, "no_reply"),
        ("navcam_right", "hang", {"call": 5}, "no_reply"),
        ("navcam_left", "hang", {}, "no_reply"),
    ],
)
def test_the_daemon_outlives_a_fault_and_points_again_when_it_is_over(
    mast_client: Client,
    simulated_rover: SimulatedRover,
    fault: SetsFault,
    device: str,
    word: str,
    numbers: dict[str, float],
    code: str,
) -> None:
    pixel = clicked(mast_client)
    with fault(device, word, **numbers):
        assert ended(mast_client, pixel) == code
        if device != "pan_tilt":
            assert code_of_snapshot(mast_client, "hazcam_left") == "done", "the others go on"
        assert any(one["device"] == device for one in mast_client.status()["faults"])
        before = simulated_rover.true_joints()
        assert mast_client.status()["state"] != "moving" and simulated_rover.true_joints() == before
    simulated_rover.advance(5.0)
    assert ended(mast_client, clicked(mast_client)) == "done"
    assert mast_client.status()["faults"] == []


@pytest.mark.mastctl(wire="dynamixel")
def test_one_silent_servo_on_a_bus_ends_a_pointing_and_comes_back(
    mast_client: Client, fault: SetsFault
) -> None:
    mast_client.wait(mast_client.point(pan_rad=0.05, tilt_rad=-0.1))  # the driver moves when it opens
    pixel = clicked(mast_client)
    with fault("pan_tilt", "silent", axis=1):
        assert ended(mast_client, pixel) == "no_reply"
        assert any(one["device"] == "pan_tilt" for one in mast_client.status()["faults"])
    points_again(mast_client)


@pytest.mark.mastctl(wire="flir_ptu")
def test_a_unit_that_tells_no_number_ends_a_pointing_and_comes_back(
    mast_client: Client, fault: SetsFault
) -> None:
    mast_client.wait(mast_client.point(pan_rad=0.05, tilt_rad=-0.1))  # the driver moves when it opens
    pixel = clicked(mast_client)
    with fault("pan_tilt", "not_a_number", axis=1):
        assert ended(mast_client, pixel) == "bad_reply"
    points_again(mast_client)


def test_a_daemon_that_ends_and_starts_again_is_found_at_its_address(
    mast_client: Client, simulated_rover: SimulatedRover
) -> None:
    pixel = clicked(mast_client)
    simulated_rover.end_daemon()
    with pytest.raises(ClientError) as nobody:
        mast_client.status()
    assert nobody.value.code == "no_daemon"
    with pytest.raises(RoverError, match="the daemon does not run"):
        simulated_rover.true_joints()
    simulated_rover.start_daemon()
    assert mast_client.operations() == []
    with pytest.raises(ClientError, match="not taken by this run"):
        mast_client.point(pixel=pixel)
    assert ended(mast_client, clicked(mast_client)) == "done"
    with pytest.raises(RoverError, match="runs already"):
        simulated_rover.start_daemon()


def test_a_process_that_died_is_told_and_the_next_test_gets_another(
    simulated_rover: SimulatedRover, mast_client: Client
) -> None:
    address = int(mast_client.url.rpartition(":")[2])
    killed = [pid for pid in listening_at(address) if pid != os.getpid()]
    assert len(killed) == 1
    os.kill(killed[0], signal.SIGKILL)
    with pytest.raises(RoverError, match="the daemon's process does not answer: it ended with -9"):
        simulated_rover.true_joints()


@pytest.mark.mastctl(faults=[{"device": "hazcam_left", "word": "hang", "call": 4}])
def test_a_camera_that_hangs_telling_its_size_keeps_nobody_from_starting(
    mast_client: Client, simulated_rover: SimulatedRover
) -> None:
    assert code_of_snapshot(mast_client, "hazcam_left") == "no_reply"
    assert ended(mast_client, clicked(mast_client)) == "done"
    simulated_rover.clear_faults()
    simulated_rover.advance(1.0)
    assert code_of_snapshot(mast_client, "hazcam_left") == "done"


def test_nothing_waits_for_a_log_that_is_stalled(mast_client: Client, fault: SetsFault) -> None:
    with fault("log", "stalled"):
        for _ in range(3):
            assert ended(mast_client, clicked(mast_client)) == "done"
        mast_client.stop()
    assert mast_client.status()["faults"] == []
