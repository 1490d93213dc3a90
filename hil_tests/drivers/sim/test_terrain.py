"""Ground of one's own is where its map says, looks as its picture does, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.errors import BadOptions
from drivers.sim.scene import Scene
from drivers.sim.settings import scene_settings
from hil_tests.drivers.sim.small_scenes import build_small_scene

ROWS, COLUMNS, STEP_M = 41, 61, 0.25
PLACE = {"m_per_px": STEP_M, "origin_x_m": 7.0, "origin_y_m": -6.0}


def map_m() -> np.ndarray:
    """A slope up to the north and one down to the east, with a step of half a metre from 4 m north on."""
    north_m = 7.0 - STEP_M * np.arange(ROWS)[:, None]
    east_m = -6.0 + STEP_M * np.arange(COLUMNS)[None, :]
    return 5.0 + 0.05 * north_m - 0.03 * east_m + 0.5 * (north_m > 4.0)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("terrain")
    np.save(folder / "ground.npy", map_m())
    picture = np.full((ROWS * 4, COLUMNS * 4), 60, np.uint8)
    picture[:, COLUMNS * 2 :] = 180  # the eastern half
    cv2.imwrite(str(folder / "ground.png"), picture)
    terrain = {"heights": "ground.npy", "texture": "ground.png", "gravel": False, **PLACE}
    return build_small_scene(scene_settings({"rocks": 0, "terrain": terrain}, folder))


def test_the_ground_is_where_the_map_says(own: Scene) -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform([-2.5, -5.5], [3.6, 8.5], (200, 2))
    down = own.cast(np.column_stack([places, np.full(200, -5.0)]), [0.0, 0.0, 1.0])
    expected_z_m = -(0.05 * places[:, 0] - 0.03 * places[:, 1])  # over the origin's
    np.testing.assert_allclose(down - 5.0, expected_z_m, atol=1e-6)
    assert own.ground_z_m(5.0, 1.0) == pytest.approx(-(0.25 - 0.03 + 0.5), abs=1e-6)
    assert own.ground_z_m(0.0, 0.0) == pytest.approx(0.0, abs=1e-9)


def test_beyond_the_map_the_ground_goes_back_to_the_rovers_height(own: Scene) -> None:
    assert own.ground_z_m(10.0, 0.0) == pytest.approx(0.0, abs=1e-6)
    assert own.ground_z_m(-20.0, 20.0) == pytest.approx(0.0, abs=1e-6)
    assert own.ground_z_m(7.2, 0.0) < -0.5


def test_the_picture_lies_on_the_ground_that_it_covers(own: Scene) -> None:
    """Its middle column lies at y = -6 + 60 / 2 cells of 0.25 m."""
    broad = own.world.broad
    side = broad.size
    tones = broad.texels[: (side + 1) * (side + 32)].reshape(side + 1, side + 32)[:side, :side] / 16384.0
    cell_m = own.world.inner.cell_m
    at = lambda x, y: tones[int((y + 32.0) / cell_m), int((x + 32.0) / cell_m)]  # noqa: E731
    for x in (-2.0, 1.0, 3.0):
        assert at(x, 1.6) / at(x, 1.4) == pytest.approx(3.0, rel=0.02)
        assert at(x, 4.0) == pytest.approx(at(x, 8.0), rel=0.01)


def test_grey_pictures_are_heights_between_black_and_white(tmp_path: Path) -> None:
    grey = np.zeros((ROWS, COLUMNS), np.uint16)
    grey[:14] = 65535
    cv2.imwrite(str(tmp_path / "ground.png"), grey)
    terrain = {"heights": "ground.png", "black_m": -1.0, "white_m": 0.5, **PLACE}
    scene = build_small_scene(scene_settings({"rocks": 0, "terrain": terrain}, tmp_path))
    assert scene.ground_z_m(5.0, 0.0) == pytest.approx(-1.5, abs=1e-6)
    assert scene.ground_z_m(1.0, 0.0) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"heights": ""}, "terrain has no heights"),
        ({"heights": "no.npy"}, r"no\.npy: No such file or directory; a \.npy or PNG"),
        ({"heights": "text.npy"}, r"text\.npy is no NumPy file"),
        ({"heights": "text.png"}, "holds no grey picture or table"),
        ({"heights": "cube.npy"}, "holds no grey picture or table"),
        ({"heights": "hole.npy"}, "holds a height that is not finite"),
        ({"heights": "cliff.npy"}, "rises by 100 m, expected 30 m at most"),
        ({"origin_x_m": -3.0}, "expected the site's origin within"),
        ({"m_per_px": 0}, r"terrain\.m_per_px is 0.0, expected a number from 0.005 to 20"),
        ({"texture": "text.png"}, r"terrain\.texture: .*text\.png is no picture"),
        ({"slope": 3}, "terrain has no key 'slope'"),
        ({"digest": "0"}, "terrain has no key 'digest'"),
    ],
)
def test_a_map_that_cannot_be_ground_is_refused(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    flat = np.zeros((ROWS, COLUMNS))
    for name, values in (("ground", flat), ("cube", np.zeros((3, 3, 3))), ("hole", flat + np.nan)):
        np.save(tmp_path / f"{name}.npy", values)
    np.save(tmp_path / "cliff.npy", 100.0 * np.eye(60))
    for name in ("text.npy", "text.png"):
        (tmp_path / name).write_text("no map")
    with pytest.raises(BadOptions, match=told):
        scene_settings({"terrain": {"heights": "ground.npy", **PLACE, **changes}}, tmp_path)


def test_another_map_by_the_same_name_is_another_scene(tmp_path: Path) -> None:
    found = []
    for height_m in (0.0, 1.0):
        np.save(tmp_path / "ground.npy", np.full((ROWS, COLUMNS), height_m))
        found.append(scene_settings({"terrain": {"heights": "ground.npy", **PLACE}}, tmp_path))
    assert repr(found[0]) != repr(found[1])
