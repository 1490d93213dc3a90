"""Mosaics: pixels beside OpenCV's and there and back; a drawn sphere composed, its seams, a slipped joint."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.mosaic import Canvas, MosaicSurface, canvas_of
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.matching.mosaic import NOBODY, Picture, Slip, composed, frames_of, gains_of, seams_of, slip_of

ANGLES = [(pan, tilt) for tilt in (-0.35, 0.0) for pan in (-0.6, 0.0, 0.6)]
SLIP_RAD = 1e-3


@pytest.fixture(scope="module")
def rig(repository: Path) -> Rig:
    """The Navcam at half its resolution, so that pictures are drawn quickly."""
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    camera = rig.cameras["navcam_left"]
    model = camera.model
    half = replace(model, size_px=(512, 384), H=model.H / 2 - model.A / 4, V=model.V / 2 - model.A / 4)
    return Rig("half", rig.mast, {"navcam_left": replace(camera, model=half)}, {})


WAVES = np.random.default_rng(4).normal(0.0, 60.0, (60, 3))


def drawn(camera: CameraModel, brightness: float = 1.0) -> Picture:
    """What a camera sees of a far sphere on which 60 plane waves are painted."""
    width, height = camera.size_px
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    waves = np.sin(camera.ray(grid).directions @ WAVES.T).sum(axis=-1)
    return np.clip(brightness * (110.0 + 9.0 * waves), 0, 255).round().astype(np.uint8)


def shots(rig: Rig, angles: list[tuple[float, float]]) -> list[Picture]:
    return [drawn(rig.camera_in_rover("navcam_left", *angle)) for angle in angles]


def canvas(rig: Rig) -> tuple[Canvas, list[CameraModel]]:
    cameras = [rig.camera_in_rover("navcam_left", *angle) for angle in ANGLES]
    return canvas_of(cameras, rig.mast.rover_from_mast, MosaicSurface.of("infinity")), cameras


def slip_in(rig: Rig, pictures: list[Picture]) -> Slip | None:
    whole, cameras = canvas(rig)
    return slip_of(rig, "navcam_left", ANGLES, whole, seams_of(whole, cameras, pictures.__getitem__).patches)


def test_each_pixel_shows_what_lies_in_its_direction(rig: Rig) -> None:
    whole, cameras = canvas(rig)
    owners, places = frames_of(whole, cameras)
    mosaic = composed(shots(rig, ANGLES).__getitem__, owners, places)
    rows, columns = np.nonzero(owners != NOBODY)
    chosen = np.random.default_rng(1).integers(len(rows), size=5000)
    pixels = np.column_stack([columns[chosen], rows[chosen]]).astype(float)
    expected = 110.0 + 9.0 * np.sin(whole.directions(pixels) @ WAVES.T).sum(axis=-1)
    off = mosaic[rows[chosen], columns[chosen]] - np.clip(expected, 0, 255)
    assert np.sqrt(np.mean(off**2)) < 4.0, "bilinear interpolation leaves some grey values"
    for number, camera in enumerate(cameras):  # the map is exact, and the picture that nearest its middle
        mine = owners[rows[chosen], columns[chosen]] == number
        found, _ = whole.in_camera(camera, pixels[mine])
        assert np.abs(found - places[rows[chosen], columns[chosen]][mine]).max() < 1e-3
        far = np.linalg.norm(found - np.array(camera.image_center_px), axis=1)
        for other in cameras:
            place, seen = whole.in_camera(other, pixels[mine])
            inside = seen & (place >= 0).all(axis=1) & (place <= np.array(other.size_px) - 1).all(axis=1)
            assert (np.linalg.norm(place - np.array(other.image_center_px), axis=1) >= far - 1e-3)[
                inside
            ].all()


def test_one_factor_a_picture_brings_their_brightness_together(rig: Rig) -> None:
    whole, cameras = canvas(rig)
    factors = np.array([0.8, 1.0, 1.1, 0.9, 1.05, 0.95])
    pictures = [drawn(camera, factor) for camera, factor in zip(cameras, factors, strict=True)]
    gains = gains_of(whole, cameras, pictures.__getitem__)
    level = gains * factors
    assert np.abs(level / level.mean() - 1.0).max() < 0.01


def test_true_angles_leave_the_matchers_own_error(rig: Rig) -> None:
    whole, cameras = canvas(rig)
    seams = seams_of(whole, cameras, shots(rig, ANGLES).__getitem__)
    assert seams.whole is not None and seams.whole.count > 25
    assert max(seams.whole.rms_px) < 0.05
    assert slip_of(rig, "navcam_left", ANGLES, whole, seams.patches) is None


@pytest.mark.parametrize(("axis", "at"), [("pan", 0), ("tilt", 1)])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_joint_that_slipped_is_named_by_axis_size_and_view(rig: Rig, axis: str, at: int, sign: int) -> None:
    true: list[FloatArray] = [np.array(angle) for angle in ANGLES]
    for number in (4, 5):
        true[number][at] += sign * SLIP_RAD
    pictures = shots(rig, [(float(pan), float(tilt)) for pan, tilt in true])
    slip = slip_in(rig, pictures)
    assert slip is not None
    assert (slip.axis, slip.from_view) == (axis, 4)
    assert slip.size_rad == pytest.approx(sign * SLIP_RAD, rel=0.1)


def test_tilts_zero_shows_and_pans_turns_the_whole(rig: Rig) -> None:
    slip = slip_in(rig, shots(rig, [(pan, tilt + SLIP_RAD) for pan, tilt in ANGLES]))
    assert slip is not None and (slip.axis, slip.from_view) == ("tilt", 0)
    assert slip.size_rad == pytest.approx(SLIP_RAD, rel=0.1)
    assert slip_in(rig, shots(rig, [(pan + SLIP_RAD, tilt) for pan, tilt in ANGLES])) is None


SURFACES = ("infinity", "sphere:4", "ground", "ground:0.3")


@pytest.fixture(scope="module")
def whole_rig(repository: Path) -> Rig:
    return load_rig(repository / "configs/sim/rocky8.yaml").rig


def views(rig: Rig, name: str = "navcam_left") -> list[CameraModel]:
    return [rig.camera_in_rover(name, pan, tilt) for tilt in (-0.7, 0.1) for pan in np.linspace(-1.4, 1.4, 5)]


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("projection", ["equirectangular", "cylindrical"])
def test_there_and_back_is_the_same_pixel(whole_rig: Rig, surface: str, projection: str) -> None:
    cameras = [
        *views(whole_rig),
        whole_rig.camera_in_rover("hazcam_left", 0.0, 0.0),
    ]  # CAHVORE: its entrance moves
    shape = MosaicSurface.of(surface)
    canvas = canvas_of(cameras, whole_rig.mast.rover_from_mast, shape, projection)  # type: ignore[arg-type]
    rng = np.random.default_rng(1)
    for camera in cameras:
        pixels = rng.uniform(0.0, 1.0, (10_000, 2)) * (np.array(camera.size_px) - 1)
        back, seen = canvas.in_camera(camera, canvas.of_camera(camera, pixels))
        assert seen.mean() > 0.99
        assert np.abs(back - pixels)[seen].max() < 1e-6


def test_a_pixel_is_where_opencv_has_its_direction() -> None:
    """The formulas of the sphere, of the head and of the lens are written out here, and OpenCV projects."""
    matrix = np.array([[900.0, 0.0, 511.0], [0.0, 905.0, 380.0], [0.0, 0.0, 1.0]])
    distortion = np.array([-0.2, 0.05, 1e-3, -2e-3])
    in_rover = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # x right, y down, z ahead to x ahead, z down
    rng = np.random.default_rng(2)
    for pan, tilt in rng.uniform(-0.8, 0.8, (20, 2)):
        turn = Rotation.from_euler("ZY", [pan, tilt]).as_matrix() @ in_rover
        place = Rigid(np.eye(3), np.array([0.4, -0.2, -1.5]))
        size_px = (1024, 768)
        lens = matrix, [*distortion, 0.0], turn.T, place.translation_m
        camera = CameraModel.of_matrix("OPENCV5", size_px, *lens)
        canvas = Canvas(
            "equirectangular", 700.0, -1.5, 1.0, (2100, 1400), place, MosaicSurface.of("infinity")
        )
        pixels = rng.uniform(0.0, 1.0, (200, 2)) * np.array(canvas.size_px)
        azimuth, elevation = -1.5 + pixels[:, 0] / 700.0, 1.0 - pixels[:, 1] / 700.0
        rays = np.column_stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)]
        )
        ahead = (rays @ turn)[:, 2] > 0.5
        expected = cv2.projectPoints(rays[ahead] @ turn, np.zeros(3), np.zeros(3), matrix, distortion)[0][
            :, 0
        ]
        found, seen = canvas.in_camera(camera, pixels[ahead])
        inside = seen & (expected > 0).all(axis=1) & (expected < [1023, 767]).all(axis=1)
        assert inside.any()
        np.testing.assert_allclose(found[inside], expected[inside], atol=1e-6)


def test_the_ground_is_seen_where_it_lies(whole_rig: Rig) -> None:
    cameras = views(whole_rig)
    canvas = canvas_of(cameras, whole_rig.mast.rover_from_mast, MosaicSurface.of("ground"))
    points = np.array([[3.0, 0.5, 0.0], [5.0, -2.0, 0.0], [2.0, 0.0, 0.0]])
    away = points - canvas.origin_m
    pixels = canvas.pixels(away)
    np.testing.assert_allclose(canvas.points(pixels), points, atol=1e-9)
    for camera in cameras:
        expected, _ = camera.project(points)
        found, _ = canvas.in_camera(camera, pixels)
        np.testing.assert_allclose(found, expected, atol=1e-7)


def test_straight_ahead_lies_between_pixels_and_a_turn_has_no_seam_in_front(whole_rig: Rig) -> None:
    canvas = canvas_of(views(whole_rig), Rigid.identity(), MosaicSurface.of("infinity"))
    ahead = canvas.pixels(np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(ahead % 1.0, 0.5, atol=1e-9)
    right = canvas.pixels(np.array([0.0, 1.0, 0.0]))
    assert right[0] - ahead[0] == pytest.approx(math.pi / 2 * canvas.px_per_rad)


@pytest.mark.parametrize("text", ["", "sphere", "sphere:0", "ground:high", "infinity:3", "flat"])
def test_a_surface_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(CalibError, match="infinity, sphere:METRES, ground or ground:Z is expected"):
        MosaicSurface.of(text)


def test_a_mosaic_too_large_is_refused_and_a_long_lens_gets_what_fits(whole_rig: Rig) -> None:
    with pytest.raises(CalibError, match="px per degree"):
        canvas_of(views(whole_rig), Rigid.identity(), MosaicSurface.of("infinity"), px_per_rad=1e5)
    model = whole_rig.cameras["navcam_left"].model
    long = replace(model, H=model.H + 19.0 * (model.H - model.A * (model.H @ model.A)))
    turned = [long.moved(whole_rig.mast.rover_from_head(float(pan), 0.0)) for pan in np.linspace(-3, 3, 31)]
    canvas = canvas_of(turned, Rigid.identity(), MosaicSurface.of("infinity"))
    width, height = canvas.size_px
    assert width <= 30_000 and 50_000_000 < width * height <= 60_000_000
    ahead = canvas.pixels(np.array([1.0, 0.0, 0.0]))
    assert ahead[0] == pytest.approx(width / 2, rel=0.02), "the cut is behind"


@pytest.mark.parametrize("tilt_rad", [1.4, -1.4])
def test_a_view_of_straight_up_or_down_is_whole_on_the_canvas(whole_rig: Rig, tilt_rad: float) -> None:
    camera = whole_rig.camera_in_rover("navcam_left", 0.3, tilt_rad)
    canvas = canvas_of([camera], whole_rig.mast.rover_from_mast, MosaicSurface.of("infinity"))
    pixels = np.random.default_rng(1).uniform(0.0, 1.0, (5000, 2)) * (np.array(camera.size_px) - 1)
    found = canvas.of_camera(camera, pixels)
    assert (found >= -1.0).all() and (found <= np.array(canvas.size_px)).all()
