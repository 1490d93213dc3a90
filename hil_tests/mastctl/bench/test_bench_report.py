"""The tables of a bench's page."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from mastctl.bench import report
from mastctl.bench.run import Checked, CornerPointing


def image(camera: str, purpose: str, used: int) -> Any:
    return SimpleNamespace(camera=camera, purpose=purpose, used=np.arange(9) < used)


FIT: Any = SimpleNamespace(
    rig=SimpleNamespace(cameras={"left": None, "right": None}),
    images=[
        image("left", "fit", 7), image("left", "fit", 8), image("left", "check", 9), image("right", "fit", 3),
    ],
    rms_px={"left": np.array([0.1, 0.2]), "right": np.array([0.3, 0.4])},
    check_rms_px={"left": np.array([0.5, 0.6])},
)  # fmt: skip


def test_each_camera_has_what_was_fitted_what_was_not_and_what_was_promised() -> None:
    headings, rows = report._cameras(FIT, Checked({"left": 0.55}, ()))
    assert headings[-1] == "promised px"
    assert rows == [
        ["left", "2", "15", "0.100, 0.200", "1", "0.500, 0.600", "0.550"],
        ["right", "1", "3", "0.300, 0.400", "0", "", ""],
    ]
    assert [row[-1] for row in report._cameras(FIT, None).rows] == ["", ""]


def test_each_pointing_at_a_corner_has_its_residual_beside_its_promise() -> None:
    pointing = CornerPointing(17, 1.234, 12.6, (0.1, -0.2), 0.15)
    table = report._pointings(Checked({}, (pointing,)))
    assert table is not None and table.rows == [["17", "1.23", "13", "+0.100", "-0.200", "0.150"]]
    assert report._pointings(None) is None and report._pointings(Checked({}, ())) is None
