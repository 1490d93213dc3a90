"""Pictures of the simulated world: every pixel where geometry puts it, filtered without a shift."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.sim import kernels
from drivers.sim.placed import SceneSettings
from drivers.sim.render import Renderer, Stills, compile_renderer, ray_table
from drivers.sim.scene import Scene, kept_scene
from hil_tests.support import rendered_patches as bias

MOST_BIAS_PX = 0.01
MOST_RMS_PX = 0.05
TABLE_PX = 1e-4
"""float32 directions: one part in 1.7e7 of a unit vector seen through 3441 px."""


@pytest.fixture(scope="module")
def flat() -> Renderer:
    return Renderer(kept_scene(SceneSettings(seed=2, relief_m=0.0, rocks=0)))


@pytest.fixture(scope="module")
def rough(scene: Scene) -> Renderer:
    return Renderer(scene)


def small(camera: CameraModel, part: int) -> CameraModel:
    """The same view with 1 / part of the pixels each way."""
    shift = (0.5 / part - 0.5) * camera.A
    size = (camera.size_px[0] // part, camera.size_px[1] // part)
    return replace(camera, size_px=size, H=camera.H / part + shift, V=camera.V / part + shift)


# ------------------------------------------------------------- sub-pixel honesty

VIEWS = (("NAVCAM", 6.0), ("NAVCAM", 2.0), ("PANCAM", 10.0), ("HAZCAM", 2.0))


@pytest.mark.parametrize(
    ("name", "range_m", "ground"),
    [
        ("NAVCAM", 2.0, "flat"),
        *((name, range_m, "rough") for name, range_m in VIEWS),
    ],
)
def test_matched_patches_lie_where_geometry_puts_them(
    ground: str, name: str, range_m: float, request: pytest.FixtureRequest
) -> None:
    """60 patches carried between pointings at 2x2 samples."""
    camera = getattr(bias, name)
    poses = bias.body_poses if name == "HAZCAM" else bias.turned_poses
    rng = np.random.default_rng(11)
    renderer = request.getfixturevalue(ground)
    found = bias.measure(renderer, camera, poses(camera, range_m, rng), 2, 60, rng)
    assert len(found) >= 55
    assert (np.abs(found.mean(axis=0)) < MOST_BIAS_PX).all()
    assert (np.sqrt((found**2).mean(axis=0)) < MOST_RMS_PX).all()


def test_pixels_do_not_move_when_the_camera_is_upside_down(flat: Renderer) -> None:
    """A common shift of all pixels hides from a turning head; rolled by half a turn it shows twice."""
    rng = np.random.default_rng(12)
    found = bias.measure(flat, bias.NAVCAM, bias.rolled_poses(bias.NAVCAM, 4.0, rng), 2, 60, rng)
    assert (np.abs(found.mean(axis=0)) < MOST_BIAS_PX).all()


# ------------------------------------------------------------- the same geometry as Scene.cast


def test_sky_is_seen_exactly_where_cast_finds_nothing(rough: Renderer) -> None:
    """On both sides of the horizon, through hills and past rocks, no block of pixels is skipped."""
    camera = small(bias.NAVCAM, 2)
    pose = bias.head_pose(1e6, 0.3, 0.0)
    rays = camera.ray(pixel_grid(camera))
    directions = pose.vectors(rays.directions)
    met = np.isfinite(rough.scene.cast(pose.points(rays.origins_m), directions))
    picture = rough.image(camera, pose, 1)
    # the sky's tone goes with height above the horizon alone
    bins = np.rint(-directions[..., 2] * 500).astype(int)
    tones = {height: np.median(picture[~met & (bins == height)]) for height in np.unique(bins[~met])}
    sky = np.vectorize(lambda height: tones.get(height, np.nan))(bins)
    apart = np.abs(picture - sky)
    before_hills = met & np.isfinite(sky)
    assert 0.2 < met.mean() < 0.9 and before_hills.sum() > 1000
    assert apart[~met].max() < 0.5
    assert (apart[before_hills] > 0.5).mean() > 0.99


# ------------------------------------------------------------- the table of rays


def pixel_grid(camera: CameraModel) -> np.ndarray:
    return np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in camera.size_px)), axis=-1)


@pytest.mark.parametrize("name", ["NAVCAM", "PANCAM", "HAZCAM"])
def test_table_rays_lead_back_to_their_samples(name: str) -> None:
    camera = getattr(bias, name)
    table = ray_table(camera, 2)
    starts = table.starts.astype(np.float64) if len(table.starts) else 0.0
    assert bool(len(table.starts)) == (name == "HAZCAM"), "only CAHVORE's rays start apart"
    points = camera.C + starts + 7.0 * table.rays.astype(np.float64)
    pixels, valid = camera.project(points)
    assert valid.all()
    for i, (x, y) in enumerate([(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)]):
        assert np.abs(pixels[:, :, i] - pixel_grid(camera) - [x, y]).max() < TABLE_PX


# ------------------------------------------------------------- pictures that are drawn once


def test_a_picture_is_drawn_again_as_soon_as_one_bit_differs(
    rough: Renderer,
) -> None:
    camera, pose = small(bias.NAVCAM, 8), bias.head_pose(4.0, 0.1, -0.1)
    stills = Stills(rough.image)
    first = stills.image(camera, pose, 1)
    assert stills.image(camera, Rigid(pose.rotation.copy(), pose.translation_m.copy()), 1) is first
    assert not first.flags.writeable
    up = np.nextafter(pose.translation_m, np.inf)
    others = (
        (camera, bias.head_pose(4.0, np.nextafter(0.1, 1.0), -0.1), 1),
        (camera, Rigid(pose.rotation, up), 1),
        (camera, pose, 2),
        (replace(camera, H=np.nextafter(camera.H, np.inf)), pose, 1),
        (replace(camera, C=np.nextafter(camera.C, np.inf)), pose, 1),
    )
    for other in others:
        assert stills.find(*other) is None
        np.testing.assert_array_equal(stills.image(*other), rough.image(*other))
    np.testing.assert_array_equal(first, rough.image(camera, pose, 1))


class Kernel:
    """The compiled function that draws, with a disk cache in another folder."""

    def __init__(self, folder: Path) -> None:
        self.stats = SimpleNamespace(cache_path=str(folder))
        self._true = kernels.render_tiles

    def __call__(self, *values: Any) -> Any:
        return self._true(*values)


def test_a_compilation_that_takes_long_is_announced_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(kernels, "render_tiles", Kernel(tmp_path))
    for announced in (1, 1):
        with caplog.at_level(logging.INFO, "drivers.sim.render"):
            compile_renderer()
        assert caplog.text.count("renderer is compiled") == announced
        (tmp_path / "kernels.render_tiles-1.py311.nbi").touch()
