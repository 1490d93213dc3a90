"""Matching against exact pictures of textured planes; the truth is the test's own pinhole geometry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline

from calib.errors import CalibError
from calib.matching.least_squares import LeastSquaresMatch
from calib.matching.partner import find_partner
from calib.matching.patch import (
    MatchSettings,
    PatchMatch,
    correlations,
    expected_correlation,
    judged,
    match_patch,
    texture_lacks,
)
from calib.matching.warp import Plane, PosedImage, Relief, Surface, Template, carry, facing_plane, grey
from hil_tests.calib.matching.textured_planes import Edge, Pinhole, TexturedPlane, picture, random_texture

FOCAL_PX = 1290.0  # the paper's Navcam
SIZE_PX = (360, 280)
NOISE_DN = 2.0
MEAN_PX, RMS_PX = 0.01, 0.05  # what the pictures of the simulated rover are asked to allow
PLANE = MatchSettings(roughness=0.0)  # the tests' surfaces are plane
HONEST = (0.75, 1.3)  # rms of errors over their own sigmas


def wall(
    seed: int, normal: tuple[float, float, float] = (-1.0, 0.2, -0.3), **texture: float
) -> TexturedPlane:
    return TexturedPlane(
        np.array([4.0, 0.0, 0.0]), np.array(normal), random_texture(seed, 8.0, 1024, **texture), 0.0012
    )


LEFT = Pinhole(np.zeros(3), 0.0, 0.0, FOCAL_PX, SIZE_PX)
TURNED = Pinhole(np.array([0.01, 0.05, -0.02]), 0.03, 0.02, FOCAL_PX, SIZE_PX, 0.01)
RIGHT = Pinhole(np.array([0.0, 0.2, 0.0]), 0.01, 0.0, FOCAL_PX, SIZE_PX, 0.002)


@cache
def seen(camera: Pinhole, seed: int, noise_dn: float = NOISE_DN, contrast_dn: float = 25.0) -> np.ndarray:
    plane = wall(seed, contrast_dn=contrast_dn)
    return picture(camera, plane, noise_dn=noise_dn, seed=hash((camera.azimuth_rad, seed)) % 2**31)


def shot(camera: Pinhole, *what: float) -> PosedImage:
    return camera.posed(seen(camera, *what))


def errors_of(matches: list[tuple[PatchMatch, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 2) in pixels and the same over their own sigmas."""
    errors = np.array([found.pixel_px - truth for found, truth in matches])
    normalised = [
        np.linalg.solve(np.linalg.cholesky(found.covariance_px2), error)
        for (found, _), error in zip(matches, errors, strict=True)
    ]
    return errors, np.array(normalised)


def matched(
    first: np.ndarray, second: np.ndarray, plane: TexturedPlane, count: int, guess: float = 0.0
) -> list[tuple[PatchMatch, np.ndarray]]:
    """Matches of pictures by the left and the turned camera over the plane, or over one across the sight that
    is so much too far, each with the true place."""
    rng, matches = np.random.default_rng(8), []
    for _ in range(count):
        pixel = np.array([rng.uniform(90, 270), rng.uniform(70, 210)])
        point = plane.hit(LEFT.position_m, LEFT.rays(pixel))
        surface = Plane(point, plane.normal)
        if guess:
            surface = facing_plane(LEFT.model, pixel, (1.0 + guess) * float(np.linalg.norm(point)))
        found = match_patch(LEFT.posed(first), pixel, surface, TURNED.posed(second), 15, PLANE)
        assert found.verdict == "good", f"pixel {pixel}: {found.reason}"
        matches.append((found, TURNED.pixel(point)))
    return matches


def test_patch_warped_over_a_guessed_plane_is_found_where_geometry_says() -> None:
    matches = []
    for seed in (0, 1):
        matches += matched(seen(LEFT, seed), seen(TURNED, seed), wall(seed), 40, guess=0.01)
    errors, normalised = errors_of(matches)
    assert np.abs(errors.mean(axis=0)).max() < MEAN_PX
    assert np.sqrt((errors**2).mean(axis=0)).max() < RMS_PX
    rms = np.sqrt((normalised**2).mean())
    assert HONEST[0] < rms < HONEST[1], rms


def test_sigma_grows_with_noise_and_stays_honest() -> None:
    errors, normalised = errors_of(matched(seen(LEFT, 2, 8.0), seen(TURNED, 2, 8.0), wall(2), 40))
    assert 0.015 < np.sqrt((errors**2).mean()) < 0.1
    rms = np.sqrt((normalised**2).mean())
    assert HONEST[0] < rms < HONEST[1], rms


def shared_noise(image: np.ndarray, seed: int) -> np.ndarray:
    """Noise of 4 grey levels as interpolated between a colour's filters, which are two pixels apart."""
    noise = np.random.default_rng(seed).normal(size=image.shape)
    for axis in (0, 1):
        noise = ndimage.correlate1d(noise, [0.5, 1.0, 0.5], axis=axis)
    return np.asarray(image + 4.0 * noise / noise.std(), dtype=np.float32)


def test_noise_that_hangs_together_over_several_pixels_is_in_the_sigma() -> None:
    first, second = shared_noise(seen(LEFT, 2, 0.0), 1), shared_noise(seen(TURNED, 2, 0.0), 2)
    _, normalised = errors_of(matched(first, second, wall(2), 80))
    assert 0.8 < np.sqrt((normalised**2).mean()) < 1.15


@pytest.mark.parametrize("zoom", [2.67, 1 / 2.67])
def test_cameras_of_different_focal_length_match(zoom: float) -> None:
    """Navcam to Pancam and back."""
    near, far = (LEFT, 1.0) if zoom > 1 else (None, zoom)
    source = near or Pinhole(np.zeros(3), 0.0, 0.0, FOCAL_PX / far, SIZE_PX)
    other = Pinhole(np.array([0.0, 0.1, 0.0]), -0.025, 0.0, source.focal_px * zoom, SIZE_PX, 0.003)
    plane, rng, matches = wall(4, (-1.0, 0.05, -0.1)), np.random.default_rng(4), []
    first = picture(source, plane, noise_dn=NOISE_DN, seed=1)
    second = picture(other, plane, noise_dn=NOISE_DN, seed=2)
    reach = 25 if zoom > 1 else 100
    for _ in range(12):
        pixel = np.array([180.0, 140.0]) + rng.uniform(-reach, reach, 2)
        point = plane.hit(source.position_m, source.rays(pixel))
        guess = facing_plane(source.model, pixel, float(np.linalg.norm(point)))
        found = match_patch(source.posed(first), pixel, guess, other.posed(second), search_px=12)
        assert found.verdict == "good", f"seed 4, pixel {pixel}: {found.reason}"
        matches.append((found, other.pixel(point)))
    errors, _ = errors_of(matches)
    assert np.sqrt((errors**2).mean()) < RMS_PX


def test_partner_is_found_along_the_line_with_range_and_slope() -> None:
    plane, rng, matches, across = wall(5), np.random.default_rng(5), [], []
    for _ in range(15):
        pixel = np.array([rng.uniform(120, 330), rng.uniform(40, 240)])
        point = plane.hit(LEFT.position_m, LEFT.rays(pixel))
        found = find_partner(shot(LEFT, 5), pixel, shot(RIGHT, 5), settings=PLANE)
        assert found.match.verdict == "good", f"seed 5, pixel {pixel}: {found.match.reason}"
        assert found.plane is not None
        assert np.linalg.norm(found.plane.point_m - point) < 0.02
        cosine = abs(found.plane.normal @ plane.normal) / np.linalg.norm(plane.normal)
        assert np.arccos(min(cosine, 1.0)) < np.radians(12)
        matches.append((found.match, RIGHT.pixel(point)))
        across.append(found.across_px / found.across_sigma_px)
    errors, normalised = errors_of(matches)
    # A wall is plane: what single windows differ by must not move the place along the line.
    assert np.sqrt((errors**2).mean(axis=0)).max() < 0.012
    assert 0.5 < np.sqrt((normalised**2).mean()) < 1.6
    assert np.sqrt(np.mean(np.square(across))) < 2.0


def test_picture_shifted_across_the_line_shows_as_that_offset() -> None:
    shifted = np.roll(seen(RIGHT, 5), 2, axis=0)
    found = find_partner(shot(LEFT, 5), (200.0, 140.0), RIGHT.posed(shifted))
    assert found.match.verdict == "good", found.match.reason
    assert abs(abs(found.across_px) - 2.0) < 0.1
    assert found.across_sigma_px < 0.05


def test_surface_without_texture_is_flat() -> None:
    plain = seen(LEFT, 0, NOISE_DN, 0.001), seen(RIGHT, 0, NOISE_DN, 0.001)
    found = find_partner(LEFT.posed(plain[0]), (180.0, 140.0), RIGHT.posed(plain[1]))
    assert found.match.verdict == "flat"
    assert np.isnan(found.match.pixel_px).all()


@pytest.mark.parametrize(("sigma_px", "enough"), [(0.09, True), (0.3, False)])
def test_waves_are_texture_enough_if_noise_moves_them_less_than_is_allowed(
    sigma_px: float, enough: bool
) -> None:
    """Waves a sin kx + a sin ky over n pixels hold a place to sqrt(2) noise / sqrt(n a^2 k^2 / 2)."""
    noise_dn, k, side = 0.5, 2 * np.pi / 16, 31
    height_dn = 2 * noise_dn / (sigma_px * k * side)
    x = np.arange(side)
    waves = (100 + height_dn * (np.sin(k * x) + np.sin(k * x)[:, None])).astype(np.float32)
    settings = MatchSettings(noise_dn=noise_dn)
    assert 0.09 < settings.flat_sigma_px < 0.3
    assert (texture_lacks(waves, settings) == "") == enough


def test_straight_edge_is_flat_along_itself() -> None:
    edge = np.full(SIZE_PX[::-1], 60.0, np.float32)
    edge[:, 180:] = 180.0
    edge += np.random.default_rng(0).normal(scale=NOISE_DN, size=edge.shape).astype(np.float32)  # type: ignore[attr-defined]
    found = match_patch(
        LEFT.posed(edge), (180.0, 140.0), facing_plane(LEFT.model, (180, 140), 4), LEFT.posed(edge), 10
    )
    assert found.verdict == "flat"
    assert "one direction" in found.reason


def test_repeated_texture_is_ambiguous() -> None:
    tile = random_texture(6, 8.0, 64)
    repeated = TexturedPlane(np.array([4.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), tile, 0.0012)
    first = picture(LEFT, repeated, noise_dn=NOISE_DN, seed=1)
    second = picture(TURNED, repeated, noise_dn=NOISE_DN, seed=2)
    guess = facing_plane(LEFT.model, (180.0, 140.0), 4.0)
    found = match_patch(LEFT.posed(first), (180.0, 140.0), guess, TURNED.posed(second), search_px=40)
    assert found.verdict == "ambiguous", found


def test_something_else_in_the_picture_is_weak() -> None:
    guess = facing_plane(LEFT.model, (180.0, 140.0), 4.0)
    for seed in (0, 1, 2):
        found = match_patch(shot(LEFT, seed), (180.0, 140.0), guess, shot(TURNED, 9), 40)
        assert found.verdict == "weak", f"scene {seed}: {found}"


def test_target_hidden_from_one_eye_is_refused() -> None:
    """A board before the right eye: what it hides must not be matched to the board."""
    right = seen(RIGHT, 5).copy()
    point = wall(5).hit(LEFT.position_m, LEFT.rays(np.array([230.0, 140.0])))
    x, y = np.rint(RIGHT.pixel(point)).astype(int)
    right[y - 45 : y + 45, x - 45 : x + 45] = seen(RIGHT, 9)[y - 45 : y + 45, x - 45 : x + 45]
    found = find_partner(shot(LEFT, 5), (230.0, 140.0), RIGHT.posed(right))
    assert found.match.verdict in ("weak", "ambiguous", "border")


def test_a_faint_target_is_matched_as_far_as_it_is_certain() -> None:
    point = wall(6).hit(LEFT.position_m, LEFT.rays(np.array([200.0, 140.0])))
    left, right = (seen(camera, 6, contrast_dn=4.0) for camera in (LEFT, RIGHT))
    found = find_partner(LEFT.posed(left), (200.0, 140.0), RIGHT.posed(right)).match
    assert found.verdict == "good", found.reason
    assert (np.abs(found.pixel_px - RIGHT.pixel(point)) < 3.0 * found.sigma_px).all()


def test_target_outside_the_other_picture_is_at_the_border() -> None:
    away = Pinhole(np.zeros(3), 1.2, 0.0, FOCAL_PX, SIZE_PX)
    guess = facing_plane(LEFT.model, (180.0, 140.0), 4.0)
    found = match_patch(shot(LEFT, 0), (180.0, 140.0), guess, away.posed(seen(TURNED, 0)), 20)
    assert found.verdict == "border"
    assert (found.correlation, found.second, found.half_px) == (0.0, 0.0, 0)  # nothing was compared


def test_a_line_that_leaves_the_other_picture_altogether_has_no_partner() -> None:
    turned = Pinhole(RIGHT.position_m, 1.2, 0.0, FOCAL_PX, SIZE_PX)
    found = find_partner(shot(LEFT, 5), (200.0, 140.0), turned.posed(seen(RIGHT, 5)))
    assert found.match.verdict == "border"
    assert found.match.reason == "nothing that this pixel may show lies in the other camera's picture"


def test_a_line_too_short_for_a_second_place_has_no_rival() -> None:
    """From 3.9 m on the line is a few pixels long: the wall at 4 m is the only place on it."""
    pixel = np.array([200.0, 140.0])
    point = wall(5).hit(LEFT.position_m, LEFT.rays(pixel))
    near = Pinhole(np.array([0.0, 0.02, 0.0]), 0.0, 0.0, FOCAL_PX, SIZE_PX)
    found = find_partner(shot(LEFT, 5), pixel, shot(near, 5), float(np.linalg.norm(point)) * 0.9)
    assert found.match.verdict == "good", found.match.reason
    assert np.linalg.norm(found.match.pixel_px - near.pixel(point)) < 4 * RMS_PX
    assert found.match.second < found.match.correlation


def test_small_shift_of_the_window_does_not_hide_a_target_at_its_edge() -> None:
    """A target just outside the window is told, not taken for the nearest other place."""
    point = wall(0).hit(LEFT.position_m, LEFT.rays(np.array([180.0, 140.0])))
    guess = facing_plane(LEFT.model, (180.0, 140.0), float(np.linalg.norm(point)))
    moved = np.roll(seen(TURNED, 0), 12, axis=1)
    found = match_patch(shot(LEFT, 0), (180.0, 140.0), guess, TURNED.posed(moved), search_px=11)
    assert found.verdict in ("border", "weak")


def test_plane_carries_pixels_as_the_pinhole_does() -> None:
    plane = wall(0)
    pixel = np.array([100.0, 60.0])
    point = plane.hit(LEFT.position_m, LEFT.rays(pixel))
    carried, valid = carry(pixel, LEFT.model, Plane(plane.point_m, plane.normal), TURNED.model)
    assert bool(valid)
    assert np.allclose(carried, TURNED.pixel(point), atol=1e-9)


def test_arrays_that_are_no_picture_are_refused_in_a_sentence() -> None:
    with pytest.raises(CalibError, match="shape"):
        grey(np.zeros((4, 4, 2)))
    with pytest.raises(CalibError, match="not finite"):
        grey(np.array([[1.0, np.nan]]))
    with pytest.raises(CalibError, match="direction"):
        Plane(np.zeros(3), np.zeros(3))


def test_a_partner_beyond_infinity_is_no_match() -> None:
    pixel = np.array([200.0, 140.0])
    point = wall(5).hit(LEFT.position_m, LEFT.rays(pixel))
    far_px = RIGHT.pixel(LEFT.position_m + 1e6 * (point - LEFT.position_m))
    beyond = np.roll(seen(RIGHT, 5), round(far_px[0] - RIGHT.pixel(point)[0]) + 1, axis=1)
    found = find_partner(shot(LEFT, 5), pixel, RIGHT.posed(beyond))
    assert found.match.verdict == "weak" and "see no common point" in found.match.reason, found.match


def test_a_picture_that_is_nothing_but_not_a_number_matches_nowhere() -> None:
    nothing = np.full_like(seen(RIGHT, 5), np.nan)
    found = find_partner(shot(LEFT, 5), (200.0, 140.0), RIGHT.posed(nothing))
    assert found.match.verdict == "weak" and "line" in found.match.reason


def test_a_rough_surface_adds_uncertainty_along_the_parallax_only() -> None:
    pixel = np.array([180.0, 140.0])
    point = wall(5).hit(LEFT.position_m, LEFT.rays(pixel))
    sigmas = []
    for roughness in (0.0, 0.05):
        found = match_patch(
            shot(LEFT, 5), pixel, Plane(point, wall(5).normal), shot(RIGHT, 5), 10,
            MatchSettings(roughness=roughness),
        )  # fmt: skip
        sigmas.append(found.sigma_px)
    # Half a patch of 41 px at 4 m is 62 mm, a twentieth of it 3 mm; f b / z² of it is some 0.05 px.
    assert 0.03 < np.sqrt(sigmas[1][0] ** 2 - sigmas[0][0] ** 2) < 0.12
    assert np.sqrt(sigmas[1][1] ** 2 - sigmas[0][1] ** 2) < 0.01


@pytest.mark.parametrize("pixel_px", [(180.0, 20.0), (180.0, SIZE_PX[1] - 21.0)])
def test_beside_the_border_a_lower_patch_finds_the_place_as_well(pixel_px: tuple[float, float]) -> None:
    pixel = np.array(pixel_px)
    point = wall(5).hit(LEFT.position_m, LEFT.rays(pixel))
    found = match_patch(shot(LEFT, 5), pixel, Plane(point, wall(5).normal), shot(RIGHT, 5), 10, PLANE)
    assert found.verdict == "good", found.reason
    assert found.half_px < PLANE.half_px
    assert np.abs(found.pixel_px - RIGHT.pixel(point)).max() < 0.15


def test_what_is_left_unexplained_makes_the_surface_term_larger() -> None:
    """With (1 - correlation / what noise allows) = u, roughness counts 1 + u / relief times."""
    pixel = np.array([180.0, 140.0])
    point = wall(5).hit(LEFT.position_m, LEFT.rays(pixel))
    other = seen(RIGHT, 5) + 0.5 * (seen(RIGHT, 77) - seen(RIGHT, 77).mean())  # as strong as twice the noise
    for image, least, most in ((seen(RIGHT, 5), 1.0, 1.1), (other, 1.5, 4.0)):
        variances = []
        for roughness, relief in ((0.0, 0.0), (0.05, 0.0), (0.05, 0.1)):
            found = match_patch(
                shot(LEFT, 5), pixel, Plane(point, wall(5).normal), RIGHT.posed(image), 10,
                MatchSettings(roughness=roughness, relief=relief),
            )  # fmt: skip
            assert found.verdict == "good", found.reason
            variances.append(found.covariance_px2[0, 0])
        larger = np.sqrt((variances[2] - variances[0]) / (variances[1] - variances[0]))
        assert least <= larger < most
        unexplained = 10.0 * (1.0 - found.correlation / (1.0 - NOISE_DN**2 / 25.0**2))
        assert larger == pytest.approx(1.0 + max(0.0, unexplained), abs=0.15)


def test_best_and_second_place_are_compared_before_the_best_is_deformed() -> None:
    """Correlations 0.6 and 0.4 as found are rivals, though deforming the best brought it to 0.81."""
    values = random_texture(6)[:25, :25].astype(np.float32)
    template = Template(values, np.array([50, 50]), np.array([50.0, 50.0]), 1.0)
    refined = LeastSquaresMatch(np.array([50.0, 50.0]), 1e-4 * np.eye(2), np.zeros((2, 2)), 0.81)
    none = np.zeros((2, 2))
    assert judged(template, refined, 0.6, 0.4, none, PLANE).verdict == "ambiguous"
    assert judged(template, refined, 0.8, 0.4, none, PLANE).verdict == "good"


@pytest.mark.parametrize(("contrast_dn", "correlation", "verdict"), [
    (25.0, 0.72, "good"), (25.0, 0.66, "weak"), (8.0**0.5, 0.37, "good"), (8.0**0.5, 0.33, "weak"),
])  # fmt: skip
def test_a_faint_patch_may_correlate_by_as_much_less_as_noise_explains(
    contrast_dn: float, correlation: float, verdict: str
) -> None:
    """Noise of 2 grey levels is half of the variance of a patch of 8: of 0.7, 0.35 is left to ask for."""
    values = random_texture(6)[:25, :25]
    values = (120.0 + contrast_dn * (values - values.mean()) / values.std()).astype(np.float32)
    template = Template(values, np.array([50, 50]), np.array([50.0, 50.0]), 1.0)
    refined = LeastSquaresMatch(np.array([50.0, 50.0]), 1e-4 * np.eye(2), np.zeros((2, 2)), correlation)
    judgement = judged(template, refined, 0.8, 0.0, np.zeros((2, 2)), PLANE)
    assert judgement.verdict == verdict, judgement.reason


def test_noise_is_held_against_the_contrast_of_what_counts() -> None:
    """Faint ground, and beside it what does not count, of strong contrast."""
    rng = np.random.default_rng(1)
    values = np.concatenate([rng.normal(100, 4.0, (41, 30)), rng.normal(100, 40.0, (41, 11))], axis=1)
    counts = np.concatenate([np.ones((41, 30)), np.zeros((41, 11))], axis=1)
    faint = expected_correlation(values[:, :30].astype(np.float32), PLANE)
    assert faint == pytest.approx(1 - (PLANE.noise_dn / 4.0) ** 2, abs=0.03)
    assert expected_correlation(values.astype(np.float32), PLANE, counts) == pytest.approx(faint)


def test_what_lies_far_from_the_target_does_not_pull_it() -> None:
    """A picture whose outer part is displaced by 1.5 px, as relief displaces it when the view changes."""
    plane, pixel = wall(4), np.array([180.0, 140.0])
    point = plane.hit(LEFT.position_m, LEFT.rays(pixel))
    there = TURNED.pixel(point)
    inner, outer = seen(TURNED, 4), np.roll(seen(TURNED, 4), 2, axis=1)
    y, x = np.mgrid[0 : SIZE_PX[1], 0 : SIZE_PX[0]]
    mixed = np.where(np.hypot(x - there[0], y - there[1]) < 7, inner, outer).astype(np.float32)
    off = {}
    for near_px in (0.0, 6.0):
        settings = MatchSettings(half_px=12, near_px=near_px, roughness=0.05)
        surface = Plane(point, plane.normal)
        found = match_patch(shot(LEFT, 4), pixel, surface, TURNED.posed(mixed), 8, settings)
        assert found.verdict == "good", found.reason
        off[near_px] = float(np.linalg.norm(found.pixel_px - there))
    assert off[0.0] > 0.6
    assert off[6.0] < 0.15


TILTED = Pinhole(np.array([0.0, 0.0, 0.02]), 0.0, 0.04, FOCAL_PX, SIZE_PX)
"""As a head's camera after a tilt: 6 cm ahead of the axis, it has moved by 2 cm."""


def step(seed: int) -> Edge:
    """A face 4 m away that ends where the left eye has pixel x = 180, and ground 0.5 m behind it."""
    behind = TexturedPlane(
        np.array([4.5, 0.0, 0.0]), np.array([-1.0, 0.0, -0.5]), random_texture(seed + 50, 8.0), 0.0012
    )
    face = TexturedPlane(
        np.array([4.0, 0.0, 0.0]), np.array([-1.0, 0.1, 0.1]), random_texture(seed, 8.0), 0.0012
    )
    return Edge(face, behind, 0.0)


@pytest.mark.parametrize("seed", [1, 2])
def test_what_lies_behind_an_edge_does_not_pull_a_place_beside_it(seed: int) -> None:
    """The patch of 41 px shows face and ground; after a tilt the ground has shifted by 0.7 px against it."""
    scene = step(seed)
    left, right, tilted = (
        picture(camera, scene, 2, NOISE_DN, seed + k) for k, camera in enumerate((LEFT, RIGHT, TILTED))
    )
    rng = np.random.default_rng(seed)
    matches = []
    for pixel in np.column_stack([rng.uniform(150, 176, 16), rng.uniform(60, 180, 16)]):
        point = scene.hit(LEFT.position_m, LEFT.rays(pixel))
        stereo = find_partner(LEFT.posed(left), pixel, RIGHT.posed(right))
        assert stereo.match.verdict == "good", stereo.match.reason
        assert stereo.plane is not None
        assert abs(stereo.match.pixel_px[0] - RIGHT.pixel(point)[0]) < 1.0
        found = match_patch(
            LEFT.posed(left), pixel, stereo.plane, TILTED.posed(tilted), 20, relief=stereo.relief
        )
        assert found.verdict == "good", found.reason
        matches.append((found, TILTED.pixel(point)))
    errors, normalised = errors_of(matches)
    assert np.sqrt((errors**2).mean()) < 0.03
    assert np.sqrt((normalised**2).mean()) < 1.4
    assert np.abs(normalised).max() < 4.0


@pytest.mark.parametrize("flat_dn", [0.0, 20.0, 250.0, 255.0])
@pytest.mark.parametrize("side_px", [45, 60, 70])
def test_a_shadow_or_a_glare_without_noise_is_like_no_patch(flat_dn: float, side_px: int) -> None:
    image = np.rint(seen(LEFT, 0)[60:201, 60:201])
    patch = image[20:61, 20:61].copy()
    image[140 - side_px : 140, 140 - side_px : 140] = flat_dn
    counts = np.ones(patch.shape)
    counts[:, 30:] = 0.0
    scores = correlations(image, patch, counts)
    assert np.unravel_index(scores.argmax(), scores.shape) == (20, 20)
    assert np.abs(scores).max() < 1.001


@pytest.mark.parametrize("range_m", [1000.0, 30000.0])
def test_what_is_as_good_as_infinitely_far_has_a_partner(range_m: float) -> None:
    """It is 0.3 px from where infinity is, and nearer: nothing can be looked up beyond."""
    hill = TexturedPlane(
        np.array([range_m, 0.0, 0.0]), np.array([-1.0, 0.05, 0.05]), random_texture(3, 8.0), 3e-4 * range_m
    )
    left, right = (picture(camera, hill, 2, NOISE_DN, k) for k, camera in enumerate((LEFT, RIGHT)))
    pixel = np.array([170.3, 140.2])
    found = find_partner(LEFT.posed(left), pixel, RIGHT.posed(right)).match
    assert found.verdict == "good", found.reason
    off_px = found.pixel_px - RIGHT.pixel(hill.hit(LEFT.position_m, LEFT.rays(pixel)))
    assert (np.abs(off_px) < 3.0 * found.sigma_px).all()
    assert found.sigma_px.max() < 0.2


def test_a_relief_stays_on_the_target_when_the_reading_was_wrong() -> None:
    """The encoder errs by 4 mrad, 5 px, between click and new picture: the mask moves with the target."""
    counts = np.ones((47, 47), np.float32)
    counts[:, 30:] = 0.0  # an edge 7 px right of the target
    told = Pinhole(np.zeros(3), 0.1, 0.0, FOCAL_PX, SIZE_PX)
    true = Pinhole(np.zeros(3), 0.104, 0.0, FOCAL_PX, SIZE_PX)
    target = np.array([4.0, 0.2, 0.0])
    relief = Relief(LEFT.pixel(target), np.zeros((47, 47), np.float32), counts, 0.0)
    plane = facing_plane(LEFT.model, relief.pixel_px, float(np.linalg.norm(target)))
    clicked = relief.seen_by(told.model, true.pixel(target), plane, LEFT.model)
    assert clicked.counts[23, 29] > 0.5
    assert clicked.counts[23, 31] < 0.5


def test_a_wide_camera_searches_a_rocks_edge_as_far_as_the_pair_saw() -> None:
    """41 px of a Navcam are 109 px of a Pancam, of which its pair has looked up 47."""
    narrow = Pinhole(np.zeros(3), 0.0, 0.0, 3000.0, SIZE_PX)
    partner = Pinhole(np.array([0.0, 0.2, 0.0]), -0.05, 0.0, 3000.0, SIZE_PX)
    wide = Pinhole(np.array([0.0, 0.1, 0.05]), -0.025, 0.0, 3000.0 / 2.67, SIZE_PX)
    scene, rng, matches = replace(step(4), edge_y_m=0.02), np.random.default_rng(4), []
    images = [picture(camera, scene, 2, NOISE_DN, 4 + k) for k, camera in enumerate((narrow, partner, wide))]
    for _ in range(8):
        pixel = np.array([rng.uniform(130, 180), rng.uniform(90, 190)])
        stereo = find_partner(narrow.posed(images[0]), pixel, partner.posed(images[1]))
        assert stereo.plane is not None, stereo.match.reason
        found = match_patch(
            narrow.posed(images[0]), pixel, stereo.plane, wide.posed(images[2]), 20,
            MatchSettings(least_lead=0.03), stereo.relief,
        )  # fmt: skip
        assert found.verdict == "good", found.reason
        matches.append((found, wide.pixel(scene.hit(narrow.position_m, narrow.rays(pixel)))))
    _, normalised = errors_of(matches)
    assert np.sqrt((normalised**2).mean()) < 1.5


def test_a_surface_interpolates_grey_values_as_scipys_spline() -> None:
    image = np.random.default_rng(3).integers(0, 256, (40, 50)).astype(np.uint8)
    surface = Surface.around(image, (12.0, 11.0), (30.0, 24.0))
    places = np.stack(np.meshgrid(np.arange(12.0, 31.0), np.arange(11.0, 25.0)), axis=-1)
    np.testing.assert_allclose(
        surface.at(places), image[11:25, 12:31], atol=0.2
    )  # its cut ends some pixels off
    outside = RectBivariateSpline(np.arange(40.0), np.arange(50.0), image.astype(np.float64))
    between = places + np.array([0.37, 0.61])
    np.testing.assert_allclose(surface.at(between), outside.ev(between[..., 1], between[..., 0]), atol=0.5)
