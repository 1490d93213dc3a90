"""A board is held up before a simulated rover, moved and taken away while its daemon runs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mastctl.client import Client

pytestmark = pytest.mark.mastctl(picture_width_px=512, scene={"relief_m": 0.0, "rocks": 0})

PRINTED = {"kind": "charuco", "columns": 5, "rows": 4, "square_m": 0.08, "marker_m": 0.06}
BOARD = {**PRINTED, "dictionary": "DICT_4X4_50"}


def markers_seen(client: Client) -> dict[int, np.ndarray]:
    """The markers of a picture exposed from now on, and where their middles are."""
    shot = client.snapshot("navcam_left")
    image = cv2.imdecode(np.frombuffer(shot.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    if ids is None:
        return {}
    return {
        int(k): np.asarray(four).reshape(4, 2).mean(axis=0)
        for k, four in zip(ids.ravel(), corners, strict=True)
    }


def test_a_board_is_seen_from_when_it_is_put_there_until_it_is_taken_away(mast_client: Client) -> None:
    assert markers_seen(mast_client) == {}
    told = mast_client.put_board("bench", [1.6, 0.0, -1.3], board=BOARD)
    assert told["board"]["square_m"] == 0.08
    assert told["quaternion"] == pytest.approx([0.5, 0.5, 0.5, 0.5], abs=0.05)  # x right, y down, z away
    here = markers_seen(mast_client)
    assert set(here) == set(range(10))
    mast_client.put_board("bench", [1.6, 0.3, -1.3], bow_m=[0.0, 0.002])
    there = markers_seen(mast_client)
    assert min(there[k][0] - here[k][0] for k in there) > 20.0
    assert mast_client.boards()["bench"]["bow_m"] == [0.0, 0.002]
    assert mast_client.boards()["bench"]["position_m"] == pytest.approx([1.6, 0.3, -1.3])
    mast_client.take_board("bench")
    assert mast_client.boards() == {}
    assert markers_seen(mast_client) == {}
