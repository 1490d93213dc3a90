"""A rendered picture cropped, binned and flipped is the picture of the camera that was carried over."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.mode import in_mode
from calib.geometry.rigid import Rigid
from calib.geometry.sensor_mode import Mode
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene

SAME_DN = 0.5
"""Of some 40 dn of contrast: directions of rays are float32, and their last bits differ."""
MOST_MOVED_PX = 0.03
"""A binned picture is filtered by its own pixel's size, so its grey levels are not those of binned pixels."""


def moved_px(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """How far a picture lies beside another, by least squares over the grey levels' slopes."""
    down, across = np.gradient(0.5 * (one + other))
    slopes = np.column_stack([across.ravel(), down.ravel()]).astype(np.float64)
    return float(np.hypot(*np.linalg.lstsq(slopes, (one - other).ravel(), rcond=None)[0]))


def test_pictures_agree_in_every_mode(scene: Scene) -> None:
    renderer = Renderer(scene)
    axis = np.array([0.98, 0.05, 0.19])
    axis /= np.linalg.norm(axis)
    camera = CameraModel(
        "CAHVOR", (128, 96), C=[0.1, -0.05, 0.02], A=axis, H=62 * axis + [-12.0, 100.0, 0.6],
        V=47 * axis + [-20.0, 0.8, 99.0], O=axis, R=[0.0, -0.11, 0.03],
    )  # fmt: skip
    pose = Rigid(np.eye(3), np.array([0.0, 0.0, -1.5]))
    full = renderer.image(camera, pose, 1)
    assert full.std() > 3.0
    for flip in product((False, True), repeat=2):
        turned = np.s_[:: -1 if flip[1] else 1, :: -1 if flip[0] else 1]
        crop = full[8:88, 16:112]
        seen = renderer.image(in_mode(camera, Mode((16, 8, 96, 80), flip=flip)), pose, 1)
        assert seen.shape == crop.shape and np.quantile(np.abs(seen - crop[turned]), 0.999) < SAME_DN, flip
        mode = Mode((16, 8, 96, 80), (2, 2), flip)
        binned = np.ascontiguousarray(crop.reshape(40, 2, 48, 2).mean(axis=(1, 3))[turned])
        seen = renderer.image(in_mode(camera, mode), pose, 2)
        assert moved_px(seen, binned) < MOST_MOVED_PX, flip
    wrong = in_mode(camera, Mode((17, 8, 96, 80), (2, 2)))
    seen = renderer.image(wrong, pose, 2)
    binned = np.ascontiguousarray(full[8:88, 16:112].reshape(40, 2, 48, 2).mean(axis=(1, 3)))
    assert moved_px(seen, binned) > 5 * MOST_MOVED_PX, "half a pixel would be seen"
