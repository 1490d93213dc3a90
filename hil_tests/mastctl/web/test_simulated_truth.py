"""What only a simulation knows: where a point of the scene truly is, and which faults its devices take."""

from __future__ import annotations

import numpy as np
import pytest

from hil_tests.waiting import present
from mastctl.client import Client

pytestmark = pytest.mark.mastctl(picture_width_px=512, scene={"relief_m": 0.0, "rocks": 0})


def test_the_truth_of_a_pixel_and_of_its_point_agree(
    mast_client: Client,
) -> None:
    mast_client.wait(mast_client.point(pan_rad=0.1, tilt_rad=-0.3))
    shot = mast_client.snapshot("navcam_left", fresh=True)
    told = mast_client.truth(shot.frame_id, pixel=(200.0, 250.0))
    assert told["position_m"] is not None and told["position_in_site_m"] is not None
    assert told["position_in_site_m"][2] == pytest.approx(0.0, abs=1e-3), "relief 0: the ground is at z = 0"
    assert told["position_m"] == pytest.approx(told["position_in_site_m"], abs=1e-9), (
        "it stands at the origin"
    )
    back = mast_client.truth(shot.frame_id, position_in_site_m=told["position_in_site_m"])
    assert back["pixel_px"] == pytest.approx([200.0, 250.0], abs=1e-6)
    mast_client.stand(0.5, 0.0, 0.0)
    later = mast_client.snapshot("navcam_left", fresh=True)
    there = mast_client.truth(later.frame_id, position_in_site_m=told["position_in_site_m"])
    assert there["position_m"] is not None
    moved = np.subtract(there["position_m"], told["position_m"])
    assert moved == pytest.approx([-0.5, 0.0, 0.0], abs=1e-3), "half a metre ahead, so it is nearer"


def test_the_sky_and_a_point_behind_the_camera_are_null(mast_client: Client) -> None:
    mast_client.wait(mast_client.point(pan_rad=0.0, tilt_rad=0.4))
    shot = mast_client.snapshot("navcam_left", fresh=True)
    sky = mast_client.truth(shot.frame_id, pixel=(256.0, 10.0))
    assert list(sky.values()) == [None, None, None]
    assert mast_client.truth(shot.frame_id, position_in_site_m=(-5.0, 0.0, 0.0))["pixel_px"] is None


def test_a_simulated_rover_reports_its_first_pose_at_the_start(mast_client: Client) -> None:
    pose = present(mast_client.track()["pose"])
    assert (pose["position_m"], pose["quaternion"]) == ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
    later = present(mast_client.pose([0.25, 0.0, 0.0], [1, 0, 0, 0], time_s=1.0)["track"]["pose"])
    assert later["time_s"] == 1.0, "any clock may follow"
