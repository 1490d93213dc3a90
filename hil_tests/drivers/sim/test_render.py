"""Pictures of the simulated world: every pixel where geometry puts it, filtered without a shift."""

from __future__ import annotations

import threading
from dataclasses import replace

import numba
import numpy as np
import pytest

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.errors import BadOptions
from drivers.sim import ground, render
from drivers.sim import render as ray_tables
from drivers.sim.kept import is_compiled
from drivers.sim.kernels.light import hits_light, stretched_brightness
from drivers.sim.quick_start import kept_scene
from drivers.sim.render import Renderer, Stills, compile_renderer, ray_table
from drivers.sim.scene import Scene, SceneSettings
from tools.campaigns import render_bias as bias

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


FLAT_TOO = pytest.mark.long(4, "flat ground before other cameras; rough ground before each is quick")


@pytest.mark.parametrize(
    ("name", "range_m", "ground"),
    [
        ("NAVCAM", 2.0, "flat"),
        *((name, range_m, "rough") for name, range_m in VIEWS),
        *(pytest.param(name, range_m, "flat", marks=FLAT_TOO) for name, range_m in VIEWS if range_m != 2.0),
        pytest.param("HAZCAM", 2.0, "flat", marks=FLAT_TOO),
    ],
)
def test_matched_patches_lie_where_geometry_puts_them(
    ground: str, name: str, range_m: float, request: pytest.FixtureRequest
) -> None:
    """60 patches carried between pointings at 2x2 samples; `tools.campaigns.render_bias` takes thousands."""
    camera = getattr(bias, name)
    poses = bias.body_poses if name == "HAZCAM" else bias.turned_poses
    rng = np.random.default_rng(11)
    renderer = request.getfixturevalue(ground)
    found = bias.measure(renderer, camera, poses(camera, range_m, rng), 2, 60, rng)
    assert len(found.error_px) >= 55, found.line()
    assert (np.abs(found.error_px.mean(axis=0)) < MOST_BIAS_PX).all(), found.line()
    assert (np.sqrt((found.error_px**2).mean(axis=0)) < MOST_RMS_PX).all(), found.line()


def test_pixels_do_not_move_when_the_camera_is_upside_down(flat: Renderer) -> None:
    """A common shift of all pixels hides from a turning head; rolled by half a turn it shows twice."""
    rng = np.random.default_rng(12)
    found = bias.measure(flat, bias.NAVCAM, bias.rolled_poses(bias.NAVCAM, 4.0, rng), 2, 60, rng)
    assert (np.abs(found.error_px.mean(axis=0)) < MOST_BIAS_PX).all(), found.line()


def test_a_quarter_pixel_of_shift_would_be_reported(flat: Renderer) -> None:
    true = bias.NAVCAM
    shifted = replace(true, H=true.H + 0.25 * true.A, V=true.V + 0.25 * true.A)
    rng = np.random.default_rng(12)
    poses = bias.rolled_poses(true, 4.0, rng)
    found = bias.measure(flat, true, poses, 2, 60, rng, believed=shifted)
    np.testing.assert_allclose(found.error_px.mean(axis=0), [-0.5, -0.5], atol=0.02)


@pytest.mark.parametrize("axis", [0, 1])
def test_no_level_of_a_texture_is_shifted_against_another(axis: int) -> None:
    """A slope stays the same slope at every footprint, between texels and between levels."""
    size, texel_m = 512, 0.01
    slope = np.linspace(0.2, 1.8, size, endpoint=False) + 0.8 / size  # mean value of each texel
    tones = np.broadcast_to(slope if axis == 0 else slope[:, None], (size, size)).astype(np.float32)
    picture = ground.pyramid(tones, texel_m)
    look = numba.njit(stretched_brightness.py_func)  # Python cannot call what compiled code calls
    rng = np.random.default_rng(13)
    for width in (0.3, 1.0, 1.3, 1.7, 2.0, 3.1, 5.5, 9.0, 16.0):
        for stretch in (1.0, 4.0, 13.0):
            place = rng.uniform(0.35, 0.65, 2) * size * texel_m
            turn = rng.uniform(0, 2 * np.pi)
            value = look(
                picture, *place, width * texel_m, stretch * width * texel_m, np.cos(turn), np.sin(turn)
            )
            expected = 0.2 + 1.6 * place[axis] / (size * texel_m)
            assert value == pytest.approx(expected, abs=1.6 / size * 0.02), (width, stretch)


def test_hits_close_together_are_looked_up_at_their_middle(rough: Renderer) -> None:
    world, look = rough.scene.world, numba.njit(hits_light.py_func)
    rng, middle_m = np.random.default_rng(14), world.inner.cells * world.inner.cell_m / 2
    for _ in range(20):
        place = [*(middle_m + rng.uniform(-8.0, 8.0, 2)), rng.uniform(3.0, 20.0)]
        hits = np.array([*place, *rng.normal(size=3)]) + rng.normal(0.0, 1e-5, (4, 6))
        one_by_one, together = (
            look(world.inner, world.broad, world.detail, hits.copy(), 4, way, 0.002, 0.002)
            for way in (False, True)
        )
        assert together == pytest.approx(one_by_one, rel=1e-3)


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


@pytest.mark.parametrize("samples", [1, 2])
def test_how_pixels_are_grouped_makes_no_difference(
    rough: Renderer, samples: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beams only spare work: with one pixel a group, nothing is met later or missed."""
    poses = {"NAVCAM": bias.head_pose(8.0, 0.2, 0.0), "HAZCAM": Rigid.identity()}
    for name, pose in poses.items():
        camera = small(getattr(bias, name), 4)
        usual = rough.image(camera, pose, samples)
        for module in (render, ray_tables):
            monkeypatch.setattr(module, "TILE_PX", 1)
            monkeypatch.setattr(module, "BLOCK_PX", 1)
        single = Renderer(rough.scene).image(camera, pose, samples)
        monkeypatch.undo()
        assert np.abs(usual - single).max() < 4.0, "only the footprint is shared by a group"
        assert np.abs(usual - single).mean() < 0.1


def test_more_samples_come_nearer_to_the_mean_over_each_pixel(rough: Renderer) -> None:
    camera, pose = small(bias.NAVCAM, 4), bias.head_pose(4.0, -0.3, 0.0)
    many = rough.image(camera, pose, 8).astype(np.float64)
    apart = [np.sqrt(((rough.image(camera, pose, samples) - many) ** 2).mean()) for samples in (1, 3, 5)]
    assert 12.0 > apart[0] > 1.3 * apart[1] > 1.3 * apart[2]
    assert abs(rough.image(camera, pose, 1).mean() - many.mean()) < 0.5


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


def test_beams_hold_all_their_rays() -> None:
    for camera in (small(bias.HAZCAM, 4), small(bias.NAVCAM, 5)):  # 160 x 120 and 204 x 153: not whole tiles
        table = ray_table(camera, 2)
        rng = np.random.default_rng(14)
        for size, beams in ((ray_tables.TILE_PX, table.tile_beams), (ray_tables.BLOCK_PX, table.block_beams)):
            for _ in range(500):
                x, y = rng.integers(0, camera.size_px[0]), rng.integers(0, camera.size_px[1])
                beam = beams[y // size, x // size]
                assert np.linalg.norm(table.rays[y, x] - beam[:3], axis=-1).max() <= beam[3]
                if len(table.starts):
                    assert np.linalg.norm(table.starts[y, x], axis=-1).max() <= beam[4]


def test_pixels_without_a_ray_are_black(rough: Renderer) -> None:
    camera = replace(
        small(bias.HAZCAM, 4),
        H=bias.HAZCAM.H / 4 * 0.22 + 60.0 * bias.HAZCAM.A,
        V=bias.HAZCAM.V / 4 * 0.22,
        E=np.zeros(3),
    )
    valid = camera.ray(pixel_grid(camera)).valid
    picture = rough.image(camera, Rigid.identity(), 1)
    assert 0.05 < valid.mean() < 0.95, "the model reaches part of this picture only"
    assert (picture[~valid] == 0.0).all()
    assert (picture[valid] > 0.0).all()


def test_rays_that_start_under_the_ground_are_black(rough: Renderer) -> None:
    """At the rim of a wide fisheye the entrance point runs off along O, here into the ground and farther."""
    camera = small(bias.HAZCAM, 4)
    camera = replace(camera, H=0.22 * camera.H + 47.0 * camera.A, V=0.22 * camera.V + 47.0 * camera.A)
    rays = camera.ray(pixel_grid(camera))
    low = rays.valid & (rays.origins_m[..., 2] > 0.3)
    high = rays.valid & (rays.origins_m[..., 2] < -0.3)
    picture = rough.image(camera, Rigid.identity(), 1)
    assert low.sum() > 50 and (picture[low] == 0.0).all()
    assert high.sum() > 500 and (picture[high] > 0.0).all()


@pytest.mark.parametrize("place_m", [(0.0, 0.0, 3.0), (40.0, 0.0, -1.0)])
def test_a_camera_that_sees_nothing_is_refused(rough: Renderer, place_m: tuple[float, float, float]) -> None:
    with pytest.raises(BadOptions, match="under the ground or beyond its edge"):
        rough.image(small(bias.NAVCAM, 8), Rigid(np.eye(3), np.array(place_m)))


# ------------------------------------------------------------- the renderer as a thing to call


def test_pictures_are_float32_grey_levels_with_contrast(rough: Renderer) -> None:
    picture = rough.image(bias.NAVCAM, bias.head_pose(6.0, 0.0, 0.0))
    assert picture.dtype == np.float32 and picture.shape == (768, 1024)
    assert picture.min() >= 0.0 and picture.max() <= 255.0
    assert 60.0 < picture.mean() < 180.0 and picture[300:].std() > 10.0
    assert (picture >= 255.0).mean() < 0.002


def test_threads_may_draw_at_once(rough: Renderer) -> None:
    cameras = [small(bias.NAVCAM, 4), small(bias.PANCAM, 4), small(bias.HAZCAM, 2)]
    pose = bias.head_pose(5.0, 0.1, 0.0)
    alone = [rough.image(camera, pose) for camera in cameras]
    together: list[np.ndarray | None] = [None] * len(cameras)

    def draw(k: int) -> None:
        for _ in range(3):
            together[k] = rough.image(cameras[k], pose)

    threads = [threading.Thread(target=draw, args=(k,)) for k in range(len(cameras))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for mine, theirs in zip(alone, together, strict=True):
        assert theirs is not None and np.array_equal(mine, theirs)


@pytest.mark.parametrize("samples", [0, 9])
def test_samples_out_of_bounds_are_refused(rough: Renderer, samples: int) -> None:
    with pytest.raises(BadOptions, match=f"{samples} samples across a pixel where 1 to 8 are possible"):
        rough.image(bias.NAVCAM, Rigid.identity(), samples)


def test_compiling_is_known_to_be_done() -> None:
    compile_renderer()
    assert is_compiled()


# ------------------------------------------------------------- one triangle for many rays


def test_rays_meet_the_same_ground_together_as_alone(
    rough: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = small(bias.NAVCAM, 4)
    for range_m, pan_rad in ((2.0, 0.3), (8.0, np.pi / 4), (30.0, -np.pi / 2), (0.3, 2.9)):
        pose = bias.head_pose(range_m, pan_rad, 0.0)
        swept = rough.image(camera, pose, 2)
        table = ray_table(camera, 2)
        alone = table._replace(starts=np.zeros_like(table.rays))  # rays with starts of their own walk alone
        monkeypatch.setattr(rough, "_table", lambda camera, samples, alone=alone: alone)
        walked = rough.image(camera, pose, 2)
        monkeypatch.undo()
        assert np.abs(swept - walked).max() < 1e-3, range_m


# ------------------------------------------------------------- pictures that are drawn once


def test_a_standing_camera_is_drawn_once_and_any_other_bit_makes_a_new_picture(
    rough: Renderer,
) -> None:
    camera, pose = small(bias.NAVCAM, 8), bias.head_pose(4.0, 0.1, -0.1)
    stills = Stills(rough)
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


def test_only_the_last_few_pictures_are_kept(rough: Renderer) -> None:
    camera, stills = small(bias.NAVCAM, 32), Stills(rough)
    poses = [bias.head_pose(4.0, 0.01 * k, -0.1) for k in range(render.STILLS_KEPT + 1)]
    for pose in poses:
        stills.image(camera, pose, 1)
    assert stills.find(camera, poses[0], 1) is None
    assert all(stills.find(camera, pose, 1) is not None for pose in poses[1:])
