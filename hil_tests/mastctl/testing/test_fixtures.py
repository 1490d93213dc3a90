"""The plug-in's fixtures as a test of a rover program uses them; the suite itself is such a project here."""

from __future__ import annotations

import math
import urllib.request
from collections.abc import Callable

import pytest

from hil_tests.waiting import NET_S
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


def code_of_snapshot(client: Client, camera: str) -> str:
    try:
        client.snapshot(camera)
    except ClientError as error:
        return error.code
    return "done"


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
