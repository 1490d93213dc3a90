"""What only a simulation knows: where a point of the scene truly is, and which faults its devices take."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.faults import CAMERA_WORDS, HEAD_WORDS
from hil_tests.mastctl.service_fakes import HTTP
from mastctl.client import Client, ClientError

pytestmark = pytest.mark.mastctl(picture_width_px=512, scene={"relief_m": 0.0, "rocks": 0})


def test_a_pixel_of_flat_ground_shows_a_point_of_the_ground_and_lies_where_it_shows(
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


def test_half_a_question_is_refused(mast_client: Client) -> None:
    for query in ("", "x_px=1", "x_px=1&y_px=2&x_m=0&y_m=0&z_m=0", "x_px=nan&y_px=1", "x_m=1&y_m=2", "q=1"):
        answer = HTTP.get(f"{mast_client.url}/api/v1/simulation/truth?frame_id=x&{query}")
        assert answer.status_code == 422 and answer.json()["error"]["code"] == "bad_request", query


def test_a_frame_that_was_never_taken_has_no_truth(mast_client: Client) -> None:
    with pytest.raises(ClientError) as refusal:
        mast_client.truth("navcam_left-000001-00000000-0000", pixel=(1.0, 1.0))
    assert refusal.value.code in ("other_mast_file", "frame_unknown")


def test_the_words_of_each_device_are_told_with_usual_values_and_bounds(mast_client: Client) -> None:
    words = mast_client.fault_words()
    assert set(words["pan_tilt"]) == set(HEAD_WORDS)
    assert set(words["navcam_left"]) == set(CAMERA_WORDS) and set(words["log"]) == {"stalled"}
    wrong = words["pan_tilt"]["wrong"]
    assert "off by a constant" in wrong["effect"]
    offset = wrong["parameters"]["offset_rad"]
    assert offset == {"default": 0.0349, "least": -math.pi, "most": math.pi}
    assert wrong["parameters"]["for_s"] == {"default": None, "least": 0.0, "most": None}
    for device, its_words in words.items():
        for word, told in its_words.items():
            given = {name: one["default"] for name, one in told["parameters"].items()}
            usual = {name: value for name, value in given.items() if value is not None}
            mast_client.set_fault(device, word, **{**usual, "after_s": 3600.0})
    mast_client.clear_faults()
