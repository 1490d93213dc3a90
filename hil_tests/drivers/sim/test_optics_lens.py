"""Falloff, defocus and dust, against the ray's angle, a lens of many pinholes, and a shadow by counting."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.rigid import Rigid
from drivers.sim.optics import SimulatedLens
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene
from drivers.sim.settings import LensSettings

EYE = "pancam_left"


def lens(rig: Path, scene: Scene, **settings: Any) -> SimulatedLens:
    model = load_rig(rig).rig.cameras[EYE].model
    return SimulatedLens(LensSettings(**settings), model, EYE, 5, scene.cast)


def looking_down(rig: Path) -> Rigid:
    return load_rig(rig).rig.mast.rover_from_head(0.1, -0.35)


def test_light_falls_off_with_the_fourth_power_of_the_cosine(small_rig: Path, scene: Scene) -> None:
    rig = load_rig(small_rig).rig
    for name, least in (("navcam_left", 0.75), ("hazcam_left", 0.5)):
        model = rig.cameras[name].model
        width, height = model.size_px
        flat = SimulatedLens(LensSettings(falloff=4), model, name, 5, scene.cast).transmission
        for x, y in ((0, 0), (width - 1, height - 1), (width // 2, 3)):
            ray = model.ray(np.array([[float(x), float(y)]])).directions[0]
            assert flat[y, x] == pytest.approx((ray @ model.A) ** 4, abs=2e-3)
        assert flat[0, 0] < least < 0.99 < flat.max()


def test_defocus_is_what_a_lens_of_many_pinholes_sees(small_rig: Path, scene: Scene) -> None:
    """Each point of the aperture is a pinhole; their pictures meet where the lens is focused."""
    focus_m, f_number, pitch_um = 4.0, 0.9, 48.0  # the small picture's pixels are four times as wide
    soft = lens(small_rig, scene, f_number=f_number, focus_m=focus_m, pitch_um=pitch_um)
    model, pose = soft.camera, looking_down(small_rig)
    renderer = Renderer(scene)
    sharp = renderer.image(model, pose, 3)
    focal_px = float(np.linalg.norm(np.cross(model.A, model.H)))
    radius_m = 0.5 * focal_px * pitch_um * 1e-6 / f_number
    right = np.cross(np.cross(model.A, model.H), model.A) / focal_px
    down = np.cross(model.A, right)
    total, n = np.zeros_like(sharp), 4
    pinholes = [(i, j) for i in range(-n, n + 1) for j in range(-n, n + 1) if i * i + j * j <= n * n]
    for i, j in pinholes:
        across_m, along_m = radius_m * i / n, radius_m * j / n
        pinhole = replace(
            model,
            C=model.C + across_m * right + along_m * down,
            H=model.H + (focal_px * across_m / focus_m) * model.A,
            V=model.V + (focal_px * along_m / focus_m) * model.A,
        )
        total += renderer.image(pinhole, pose, 3)
    renderer.close()
    truth = total / len(pinholes)
    discs_px = soft.discs_px(pose)
    assert discs_px.max() > 2.5 and discs_px.min() < 0.3, "it is sharp somewhere, and soft elsewhere"
    ours = soft.through(sharp, pose)
    edge = slice(6, -6), slice(6, -6)
    left = float(np.std((ours - truth)[edge]))
    assert left < 0.35 * float(np.std((sharp - truth)[edge])) and left < 2.0
