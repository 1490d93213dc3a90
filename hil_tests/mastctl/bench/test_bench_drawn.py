"""What is drawn of a bench, however many cameras it has."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from mastctl.bench.drawn import against_joints
from mastctl.report.plots import COLOURS


def test_residuals_of_more_cameras_than_colours_are_drawn_against_the_joints() -> None:
    names = [f"camera_{index}" for index in range(len(COLOURS) + 1)]
    images = [
        SimpleNamespace(
            camera=name,
            purpose="fit",
            pan_rad=0.1 * index,
            tilt_rad=-0.1 * index,
            used=np.ones(3, dtype=bool),
            residuals_px=np.full((3, 2), 0.01 * index),
        )
        for index, name in enumerate(names)
    ]
    figure = against_joints(SimpleNamespace(images=images), names)  # type: ignore[arg-type]
    _, labels = figure.axes[0].get_legend_handles_labels()
    assert labels == names
