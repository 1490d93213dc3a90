"""Following a target over motions of the rover, on exact pictures of a textured plane."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from calib.errors import CalibError
from calib.geometry.rigid import Rigid, rot_y, rot_z
from calib.matching.partner import find_partner
from calib.matching.patch import match_patch
from calib.matching.search import OnePoint, TrackSearch, pose_doubt, seen_by
from calib.matching.track import SIZES, Track, TrackSettings, indistinct, moved_track, start_track
from calib.matching.warp import Plane, PosedImage
from hil_tests.calib.matching.textured_planes import Pinhole, TexturedPlane, picture, random_texture

TARGET = np.array([3.0, 0.1, 0.0])
GROUND = TexturedPlane(TARGET, np.array([0.02, -0.03, -1.0]), random_texture(5), 0.002)
NAMES = ("left", "right")
EXACT = np.zeros((6, 6))


def pinholes(rover_x_m: float, heading_rad: float = 0.0) -> dict[str, Pinhole]:
    """The pair in the site frame, the rover ``rover_x_m`` ahead and turned."""
    turned = rot_z(heading_rad)
    down = float(np.arctan2(1.2, TARGET[0] - rover_x_m))
    return {
        name: Pinhole(
            turned @ np.array([0.0, y, -1.2]) + [rover_x_m, 0.0, 0.0], heading_rad, -down, 900.0, (321, 241)
        )
        for name, y in zip(NAMES, (-0.1, 0.1), strict=True)
    }


def eyes(
    rover_x_m: float, heading_rad: float = 0.0, plane: TexturedPlane = GROUND, seed: int = 0
) -> dict[str, PosedImage]:
    """Pictures with their cameras in the rover frame."""
    rover_from_site = pose(rover_x_m, heading_rad).inverse
    return {
        name: PosedImage(
            picture(camera, plane, noise_dn=1.5, seed=seed + i), camera.model.moved(rover_from_site)
        )
        for i, (name, camera) in enumerate(pinholes(rover_x_m, heading_rad).items())
    }


def pose(rover_x_m: float, heading_rad: float = 0.0) -> Rigid:
    """site_from_rover."""
    return Rigid(rot_z(heading_rad), np.array([rover_x_m, 0.0, 0.0]))


@pytest.fixture(scope="module")
def begun() -> Track:
    first = eyes(0.0)
    return start_track(first["left"], first["right"], pinholes(0.0)["left"].pixel(TARGET))


def step(track: Track, before: Rigid, now: Rigid, covariance: NDArray[np.float64] = EXACT) -> Track:
    return moved_track(track, now.inverse @ before, covariance)


def test_a_start_knows_the_position(begun: Track) -> None:
    off = begun.position_m - TARGET
    assert off @ np.linalg.solve(begun.covariance_m2, off) < 16.0
    assert np.linalg.norm(off) < 0.03


def test_eyes_that_do_not_mean_one_point_start_no_track() -> None:
    """The right eye sees 3 px lower than its model says; broad texture is found that far off the line."""
    first = eyes(0.0, plane=replace(GROUND, texel_m=0.006))
    camera = first["right"].camera
    knocked = replace(first["right"], camera=replace(camera, V=camera.V + 3.0 * camera.A))
    with pytest.raises(CalibError, match="px off the epipolar line"):
        start_track(first["left"], knocked, pinholes(0.0)["left"].pixel(TARGET))


def test_motion_carries_position_and_covariance(begun: Track) -> None:
    """Against draws of the motion's error by matrix exponentials."""
    from scipy.spatial.transform import Rotation

    motion = Rigid(rot_z(0.2), np.array([-0.5, 0.1, 0.02]))
    sigma = np.array([0.004, 0.006, 0.008, 0.01, 0.02, 0.005])
    after = moved_track(begun, motion, np.diag(sigma**2))
    rng = np.random.default_rng(2)
    root = np.linalg.cholesky(begun.covariance_m2)
    drawn = []
    for _ in range(4000):
        off = rng.normal(0.0, sigma)
        point = motion.points(begun.position_m + root @ rng.standard_normal(3))
        drawn.append(Rotation.from_rotvec(off[:3]).apply(point) + off[3:])
    np.testing.assert_allclose(after.position_m, motion.points(begun.position_m), atol=1e-12)
    ratio = np.linalg.solve(after.covariance_m2, np.cov(np.array(drawn).T))
    assert np.abs(np.linalg.eigvals(ratio) - 1.0).max() < 0.12


TOLD = np.diag([2e-3**2] * 3 + [0.015**2] * 3)


def after_a_wrong_pose(begun: Track, wrong_m: list[float], covariance: NDArray[np.float64]) -> TrackSearch:
    """A look 0.4 m nearer, after a pose that is ``wrong_m`` off."""
    said = Rigid(np.eye(3), np.array([0.4, 0.0, 0.0]) + wrong_m)
    return seen_by(moved_track(begun, said.inverse, covariance), eyes(0.4))


@pytest.mark.parametrize("wrong_m", [[0.1, 0, 0], [0, 0.1, 0], [0, 0, -0.1], [-0.15, 0.1, 0]])
def test_a_pose_10_cm_wrong_and_told_as_good_to_15_mm_is_said_to_be(
    begun: Track, wrong_m: list[float]
) -> None:
    look = after_a_wrong_pose(begun, wrong_m, TOLD)
    size = re.search(r"([\d.]+) cm \(([\d.]+) sigma\)", look.doubt)
    assert size is not None and float(size[2]) > 3.3
    assert float(size[1]) == pytest.approx(100 * np.linalg.norm(wrong_m), abs=1.2)


def test_a_target_that_is_kept_after_a_wrong_pose_is_kept_with_the_doubt(begun: Track) -> None:
    """9 cm along the range: just within what a look takes, and more than once in a thousand by chance."""
    look = after_a_wrong_pose(begun, [0.09, 0.0, 0.0], TOLD)
    assert (look.track.state, look.reason) == ("tracked", "")
    assert look.doubt.endswith("from where the pose does: the pose is wrong by more than its covariance says")


def test_a_pose_that_says_how_wrong_it_is_is_not_doubted(begun: Track) -> None:
    honest = np.diag([2e-3**2] * 3 + [0.06**2] * 3)
    for wrong_m in ([0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, -0.1]):
        look = after_a_wrong_pose(begun, wrong_m, honest)
        assert look.track.state == "tracked" and not look.doubt
    assert not after_a_wrong_pose(begun, [0.0, 0.0, 0.0], TOLD).doubt


def test_an_honest_motion_is_doubted_once_in_a_thousand_looks() -> None:
    rng = np.random.default_rng(2)
    prior, noise = (m @ m.T for m in rng.normal(0.0, 0.02, (2, 3, 3)))
    roots = [np.linalg.cholesky(m) for m in (prior, noise)]
    draws = 20_000
    doubted = 0
    for one, other in rng.standard_normal((draws, 2, 3)):
        seen = OnePoint(TARGET + roots[1] @ other, noise, 0.0)
        doubted += pose_doubt(TARGET + roots[0] @ one, prior, seen) != ""
    # 20 expected; outside 6 to 40 once in some 10^4 repetitions.
    assert 6 <= doubted <= 40


def test_a_target_is_kept_while_the_rover_nears_it_with_wrong_odometry(begun: Track) -> None:
    track, rng = begun, np.random.default_rng(7)
    before, renewed = pose(0.0), 0
    spread = np.diag(np.array([0.009] * 3 + [0.01] * 3) ** 2)
    for index, (x, heading) in enumerate([(0.3, 0.03), (0.6, -0.02), (0.85, 0.04), (1.1, 0.0), (1.3, 0.02)]):
        now = pose(x, heading)
        wrong = Rigid(rot_z(rng.normal(0.0, 0.009)), rng.normal(0.0, 0.01, 3))
        track = moved_track(track, wrong @ now.inverse @ before, spread)
        predicted = np.linalg.norm(track.position_m - now.inverse.points(TARGET))
        look = seen_by(track, eyes(x, heading, seed=10 * index + 10))
        assert look.track.state == "tracked", look.reason
        track, before = look.track, now
        renewed += look.renewed
        off = np.linalg.norm(track.position_m - now.inverse.points(TARGET))
        assert off < 0.02 and (off < predicted or predicted < 0.01)
        exact = pinholes(x, heading)["left"].pixel(TARGET)
        assert np.linalg.norm(look.found["left"].pixel_px - exact) < 0.6
    assert renewed >= 1


def test_each_change_of_key_adds_to_the_uncertainty_of_the_target(
    begun: Track,
) -> None:
    """2 cm of drift along the ground, to the right: that variance is added there, and nothing elsewhere."""
    right = np.array([0.0, 1.0, 0.0])
    drifted = replace(begun, key=replace(begun.key, drift_m2=0.02**2 * np.outer(right, right)))
    np.testing.assert_array_equal(begun.target_covariance_m2, begun.covariance_m2)
    more = drifted.target_covariance_m2 - begun.target_covariance_m2
    assert right @ more @ right == pytest.approx(4e-4)
    assert np.trace(more) == pytest.approx(4e-4)


def test_a_target_behind_its_key_camera_is_lost_and_says_so(begun: Track) -> None:
    """The pose jumps so far that the believed place lies behind where the key picture was taken."""
    behind = replace(begun, position_m=2.0 * begun.key.view.camera.C - begun.position_m)
    look = seen_by(behind, eyes(0.0, seed=3))
    assert look.track.state == "lost"
    assert "not visible from where its key picture was taken" in look.reason


def test_a_correlation_at_the_limit_keeps_the_key_and_one_below_renews_it(begun: Track) -> None:
    track, both = step(begun, pose(0.0), pose(0.1), np.diag([1e-6] * 3 + [0.003**2] * 3)), eyes(0.1, seed=20)
    worst = min(one.correlation for one in seen_by(track, both).found.values())
    assert not seen_by(track, both, TrackSettings(renew_below=worst)).renewed
    assert seen_by(track, both, TrackSettings(renew_below=float(np.nextafter(worst, 1.0)))).renewed


def nearer_by(ratio: float) -> float:
    """How far the rover has to drive for the cameras, 1.2 m up, to be that much nearer to the target."""
    return float(TARGET[0] - np.sqrt((TARGET[0] ** 2 + 1.44) / ratio**2 - 1.44))


@pytest.mark.parametrize(
    ("ratio", "settings", "renewed"),
    [
        # Nearer by a ratio, flat ground is seen as much larger across, and by its square along the sight.
        (1.44, TrackSettings(renew_shape=9.0, renew_below=0.0), False),  # 1.44^1.5 = 1.73 times larger
        (1.52, TrackSettings(renew_shape=9.0, renew_below=0.0), True),  # 1.87 times
        (1.46, TrackSettings(renew_grown=9.0, renew_below=0.0), False),  # 1.46 times another shape
        (1.54, TrackSettings(renew_grown=9.0, renew_below=0.0), True),
        (1.1, TrackSettings(renew_below=0.0), False),
        (1.1, TrackSettings(renew_below=1.0), True),
        (1.1, TrackSettings(renew_below=0.0, renew_shrunk=1.12), False),  # 1.15 times larger
        (1.1, TrackSettings(renew_below=0.0, renew_shrunk=1.18), True),
    ],
)
def test_the_key_is_renewed_when_the_ground_looks_different(
    begun: Track, ratio: float, settings: TrackSettings, renewed: bool
) -> None:
    x_m = nearer_by(ratio)
    spread = np.diag([1e-6] * 3 + [0.003**2] * 3)
    look = seen_by(step(begun, pose(0.0), pose(x_m), spread), eyes(x_m, seed=20), settings)
    assert look.track.state == "tracked", look.reason
    assert look.renewed == renewed


def test_one_good_look_in_a_thousand_is_refused_with_both_eyes() -> None:
    from scipy.stats import chi2  # slow to load, and every worker loads this file

    assert TrackSettings().worst_chi2 == pytest.approx(chi2.isf(0.001, 4), abs=0.05)


def test_a_hidden_target_is_lost_and_found_again(begun: Track) -> None:
    other = replace(GROUND, grey=random_texture(77))
    now = pose(0.2)
    track = step(begun, pose(0.0), now, np.diag([1e-5] * 3 + [1e-5] * 3))
    hidden = seen_by(track, eyes(0.2, plane=other))
    assert hidden.track.state == "lost" and hidden.track.misses == 1 and hidden.reason
    np.testing.assert_array_equal(hidden.track.position_m, track.position_m)
    again = seen_by(hidden.track, eyes(0.2))
    assert again.track.state == "tracked" and again.track.misses == 0


def test_one_hidden_eye_is_enough_to_doubt(begun: Track) -> None:
    both = eyes(0.0, seed=3)
    both["right"] = eyes(0.0, plane=replace(GROUND, grey=random_texture(78)))["right"]
    look = seen_by(begun, both)
    assert look.track.state == "lost"
    assert "does not confirm" in look.reason


@pytest.mark.parametrize("down_px", [2, 4, 8])
def test_an_eye_that_sees_the_target_elsewhere_contradicts_however_far_off(
    begun: Track, down_px: int
) -> None:
    """Also where the place lies at the edge of the searched window: 4 px there."""
    both = eyes(0.0, seed=3)
    both["right"] = replace(both["right"], image=np.roll(both["right"].image, down_px, axis=0))
    look = seen_by(begun, both)
    assert look.track.state == "lost", look.found["right"]


def test_a_lost_target_is_found_by_stereo_if_one_camera_is_sure(begun: Track) -> None:
    """With the believed slope the right eye does not find the key picture; the left one does."""
    normal = np.array([0.0, 1.0, -0.3]) / np.hypot(1.0, 0.3)
    doubtful = replace(begun, key=replace(begun.key, normal=normal), state="lost")
    look = seen_by(doubtful, eyes(0.0, seed=3))
    assert look.track.state == "tracked" and look.found["left"].correlation > 0.9
    assert np.linalg.norm(look.track.position_m - TARGET) < 0.03


def test_a_place_that_is_partly_alike_is_not_taken_for_a_lost_target(begun: Track) -> None:
    """The target shows another texture, a place 7 cm beside it one partly alike, which stereo confirms."""
    alike, other = np.roll(random_texture(5), (30, 20), (0, 1)) - 120.0, random_texture(77) - 120.0
    world = replace(GROUND, grey=120.0 + 0.72 * alike + np.sqrt(1.0 - 0.72**2) * other)
    both = {
        name: PosedImage(picture(camera, world, noise_dn=noise_dn, seed=seed), camera.model)
        for (name, camera), noise_dn, seed in zip(pinholes(0.0).items(), (1.5, 12.0), (50, 51), strict=True)
    }
    spread = np.diag(np.array([0.01] * 3 + [0.02] * 3) ** 2)
    lost = replace(step(begun, pose(0.0), pose(0.0), spread), state="lost", misses=1)
    look = seen_by(lost, both)
    assert look.found["left"].verdict == "good" and look.found["right"].verdict == "weak"
    assert look.track.state == "lost"


def test_a_missing_frame_of_one_eye_is_borne_while_tracked(begun: Track) -> None:
    look = seen_by(begun, {"left": eyes(0.0, seed=3)["left"]})
    assert look.track.state == "tracked"
    lost = replace(begun, state="lost")
    assert "one camera alone" in seen_by(lost, {"left": eyes(0.0, seed=3)["left"]}).reason
    assert "no picture" in seen_by(begun, {}).reason


def test_a_shifted_world_does_not_fit_the_prediction(begun: Track) -> None:
    """The whole ground moved by 3 cm while the rover says that it stood still: not the target's place."""
    slid = replace(GROUND, point_m=GROUND.point_m + np.array([0.0, 0.03, 0.0]))
    look = seen_by(begun, eyes(0.0, plane=slid, seed=4))
    assert look.track.state == "lost"


@pytest.mark.parametrize(
    ("pixel", "words"),
    [
        ((500.0, 10.0), "outside the picture of 321 x 241"),
        ((float("nan"), 3.0), "not two finite numbers"),
    ],
)
def test_a_click_that_is_no_target_is_refused(pixel: tuple[float, float], words: str) -> None:
    first = eyes(0.0)
    with pytest.raises(CalibError, match=words):
        start_track(first["left"], first["right"], np.array(pixel))


def test_a_plain_surface_cannot_be_followed() -> None:
    plain = eyes(0.0, plane=replace(GROUND, grey=np.full((64, 64), 130.0)))
    with pytest.raises(CalibError, match="too little texture"):
        start_track(plain["left"], plain["right"], np.array([160.0, 120.0]))


@pytest.mark.parametrize(("sigma_px", "enough"), [(0.13, True), (0.35, False)])
def test_texture_is_enough_if_noise_moves_it_by_a_fifth_of_a_pixel(sigma_px: float, enough: bool) -> None:
    """Between two pictures of 2 grey levels' noise: sqrt(2) 2 / sqrt(l), l of the patch's weighted slopes."""
    field = random_texture(5, contrast_dn=1.0)[:241, :321] - 120.0
    x, y, sigma = 160, 120, SIZES.near_px
    weights = np.exp(-((np.arange(321) - x) ** 2 + (np.arange(241)[:, None] - y) ** 2) / (2.0 * sigma**2))
    slopes = np.stack([ndimage.gaussian_filter(field, 1.0, order) for order in ((0, 1), (1, 0))])
    least = np.linalg.eigvalsh(np.einsum("iyx,jyx,yx->ij", slopes, slopes, weights))[0]
    contrast = np.sqrt(2.0) * 2.0 / (sigma_px * np.sqrt(least))
    rng = np.random.default_rng(8)
    image = (120.0 + contrast * field + rng.normal(0.0, 2.0, field.shape)).astype(np.float32)
    level = Pinhole(np.zeros(3), 0.0, 0.0, 900.0, (321, 241))
    wall = Plane(np.array([3.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    reason = indistinct(image, level.model, np.array([float(x), float(y)]), wall, SIZES)
    assert reason == ("" if enough else "the patch has too little texture to hold a position")


def test_an_edge_cannot_be_followed() -> None:
    """A straight border between dark and bright ground: nothing holds along it."""
    edge = eyes(0.0, plane=replace(GROUND, grey=np.tile(np.repeat([90.0, 160.0], 512), (1024, 1))))
    steps = np.abs(np.diff(edge["left"].image[120, 60:260]))
    assert steps.max() > 25.0
    pixel = np.array([60.0 + int(np.argmax(steps)), 120.0])
    with pytest.raises(CalibError, match="texture along one direction only"):
        start_track(edge["left"], edge["right"], pixel)


def test_the_edge_of_a_shadow_cannot_be_followed() -> None:
    """Faint texture would hold along it, but with other faint texture the same edge looks the same."""
    shadow = np.tile(np.repeat([70.0, 150.0], 512), (1024, 1)) + 0.3 * (random_texture(5) - 120.0)
    edge = eyes(0.0, plane=replace(GROUND, grey=shadow))
    steps = np.abs(np.diff(edge["left"].image[120, 60:260]))
    pixel = np.array([60.0 + int(np.argmax(steps)), 120.0])
    with pytest.raises(
        CalibError, match=r"an edge, a smooth place or a repeated pattern: what is \d+ px beside it"
    ):
        start_track(edge["left"], edge["right"], pixel)


def test_the_range_at_the_start_is_that_of_the_middle_of_the_patch() -> None:
    """A disc of 4 cm, 3 cm above the ground: the patch that tells the slope is three times as wide."""
    up_m, wide_m = 0.03, 0.04
    top = replace(GROUND, point_m=TARGET - [0.0, 0.0, up_m], grey=random_texture(6))
    both = {}
    for name, camera in pinholes(0.0).items():
        grid = np.stack(np.meshgrid(*map(np.arange, camera.size_px)), axis=-1).astype(float)
        hit = top.hit(camera.position_m, camera.rays(grid))
        on_disc = np.linalg.norm(hit - top.point_m, axis=-1) < wide_m
        image = np.where(on_disc, picture(camera, top, noise_dn=1.5), picture(camera, GROUND, noise_dn=1.5))
        both[name] = PosedImage(image.astype(np.float32), camera.model)
    track = start_track(both["left"], both["right"], pinholes(0.0)["left"].pixel(top.point_m))
    sight = top.point_m - both["left"].camera.C
    off_m = (track.position_m - top.point_m) @ sight / np.linalg.norm(sight)
    assert abs(off_m) < 0.02, "the ground would be 8 cm farther"


def test_the_sky_cannot_be_followed() -> None:
    """Bright and featureless above a horizon, noise only."""
    both = {}
    rng = np.random.default_rng(4)
    for name, eye in eyes(0.0).items():
        image = eye.image.copy()
        image[:110] = 210.0 + rng.normal(0.0, 1.5, image[:110].shape)
        both[name] = replace(eye, image=image.astype(np.float32))
    with pytest.raises(CalibError, match="too little texture"):
        start_track(both["left"], both["right"], np.array([160.0, 60.0]))


def test_a_pose_that_jumps_is_said_and_nothing_else_is_taken(begun: Track) -> None:
    """The rover is said to stand where it was, to a few millimetres, and is 25 cm aside and 20 ahead."""
    surely = np.diag([1e-6] * 3 + [9e-6] * 3)
    track = moved_track(begun, Rigid.identity(), surely)
    for index in range(2):
        turned = rot_z(0.08)
        site_from_rover = Rigid(turned, np.array([0.2, 0.25, 0.0]))
        seen = {}
        for name, y in zip(NAMES, (-0.1, 0.1), strict=True):
            down = float(np.arctan2(1.2, TARGET[0] - 0.2))
            position = turned @ np.array([0.0, y, -1.2]) + site_from_rover.translation_m
            camera = Pinhole(position, 0.08, -down, 900.0, (321, 241))
            image = picture(camera, GROUND, noise_dn=1.5, seed=40 + index)
            seen[name] = PosedImage(image, camera.model.moved(site_from_rover.inverse))
        look = seen_by(track, seen)
        assert look.track.state == "lost" and look.track.misses == index + 1
        assert look.reason
        np.testing.assert_array_equal(look.track.position_m, track.position_m)
        track = look.track


def test_a_found_target_tells_how_the_rover_was_turned(begun: Track) -> None:
    """Pitch reported wrong by 10 mrad: the key camera is put right by turning, as the rover's frame errs."""
    now = pose(0.1)
    wrong = Rigid(rot_y(0.010), np.zeros(3))
    spread = np.diag([0.009**2] * 3 + [0.002**2] * 3)
    track = moved_track(begun, wrong @ now.inverse @ pose(0.0), spread)
    look = seen_by(track, eyes(0.1, seed=60))
    assert look.track.state == "tracked" and not look.renewed
    exact = pinholes(0.0)["left"].model.moved(now.inverse)

    def turned_rad(one: Track) -> float:
        return float(np.arccos(np.clip(one.key.view.camera.A @ exact.A, -1.0, 1.0)))

    assert turned_rad(track) == pytest.approx(0.010, rel=0.05)
    assert turned_rad(look.track) < 0.003


@pytest.mark.parametrize("spread", [np.eye(3), np.full((6, 6), np.nan), -np.eye(6)])
def test_a_motion_without_a_usable_covariance_is_refused(begun: Track, spread: NDArray[np.float64]) -> None:
    with pytest.raises(CalibError, match="6 rows of 6"):
        moved_track(begun, Rigid.identity(), spread)


def test_an_eye_that_sees_the_surface_otherwise_is_asked_through_the_other(begun: Track) -> None:
    """With a slope believed far off, the eye beside the key camera's still fits, the other does not."""
    normal = np.array([0.0, 1.0, -0.3]) / np.hypot(1.0, 0.3)
    doubtful = replace(begun, key=replace(begun.key, normal=normal))
    both = eyes(0.0, seed=3)
    right = both["right"]
    key = begun.key
    alone = match_patch(key.view, key.pixel_px, Plane(begun.position_m, normal), right, 5.0)
    assert alone.verdict == "weak"
    look = seen_by(doubtful, both)
    assert look.track.state == "tracked"
    exact = pinholes(0.0)["right"].pixel(TARGET)
    np.testing.assert_allclose(look.found["right"].pixel_px, exact, atol=0.2)
    fresh = look.track.standby
    assert fresh is not None
    true = GROUND.normal / np.linalg.norm(GROUND.normal)
    off = np.degrees(np.arccos(abs(fresh.normal @ true) / np.linalg.norm(fresh.normal)))
    assert off < 6.0, "the slope is that of the two eyes, not the believed one"


def test_a_first_eye_found_through_the_second_hands_on_the_errors_of_both(begun: Track) -> None:
    """The key is as if taken by the second eye, and its slope believed far off; the second eye is noisy."""
    normal = np.array([0.0, 1.0, -0.3]) / np.hypot(1.0, 0.3)
    second = eyes(0.0)["right"]
    key = replace(begun.key, view=second, pixel_px=pinholes(0.0)["right"].pixel(TARGET), normal=normal)
    both = eyes(0.0, seed=3)
    noisy = picture(pinholes(0.0)["right"], GROUND, noise_dn=15.0, seed=9)
    both["right"] = replace(both["right"], image=noisy)
    believed = Plane(begun.position_m, normal)
    left = both["left"]
    alone = match_patch(second, key.pixel_px, believed, left, 5.0)
    assert alone.verdict == "weak"
    look = seen_by(replace(begun, key=key), both)
    assert look.track.state == "tracked" and look.renewed, look.reason
    rates = []  # how far a pixel reaches over the surface found, m
    for name in NAMES:
        camera, surface, landings = pinholes(0.0)[name], look.track.key.normal, []
        for axis in 0.1 * np.eye(2):
            ray = camera.model.ray(camera.pixel(TARGET) + axis)
            along = (TARGET - ray.origins_m) @ surface / (ray.directions @ surface)
            landings.append(ray.origins_m + along * ray.directions - TARGET)
        rates.append(10.0 * np.array(landings).T)
    left_px2, right_px2 = (look.found[name].covariance_px2 for name in NAMES)
    drift = rates[0] @ left_px2 @ rates[0].T
    np.testing.assert_allclose(look.track.key.drift_m2, drift, atol=0.02 * np.trace(drift))
    images = both["right"].image, both["right"].camera, look.found["right"].pixel_px
    stereo = find_partner(PosedImage(*images[:2]), images[2], both["left"], settings=SIZES).match
    handed = rates[0] @ (left_px2 - stereo.covariance_px2) @ rates[0].T
    seen = rates[1] @ right_px2 @ rates[1].T
    np.testing.assert_allclose(handed, seen, atol=0.02 * np.trace(seen))
    assert np.trace(seen) > 0.05 * np.trace(drift)


def test_a_place_that_may_have_drifted_too_far_is_not_called_tracked(begun: Track) -> None:
    """The same look counts with 2 cm of drift handed on by the keys before, and not with 4."""
    near, far = (replace(begun, key=replace(begun.key, drift_m2=s * s * np.eye(3))) for s in (0.02, 0.04))
    both = eyes(0.0, seed=3)
    assert seen_by(near, both).track.state == "tracked"
    look = seen_by(far, both)
    assert look.track.state == "lost" and "drifted by 4 cm" in look.reason
    np.testing.assert_array_equal(look.track.position_m, far.position_m)


def test_a_changed_look_from_nearer_is_less_certain_than_a_plane() -> None:
    """Another texture is mixed in, 14 parts in 100 of the correlation: doubly as much relief, and more."""
    left, near = eyes(0.0)["left"], pinholes(0.9)["left"]
    plane, pixel = Plane(TARGET, GROUND.normal), pinholes(0.0)["left"].pixel(TARGET)
    same = picture(near, GROUND, noise_dn=1.5, seed=3)
    other = picture(near, replace(GROUND, grey=random_texture(77)))
    larger, sigmas_px = [], []
    for image in (same, (same + 0.55 * (other - other.mean())).astype(np.float32)):
        told, flat = (
            match_patch(left, pixel, plane, PosedImage(image, near.model), 6.0, sizes)
            for sizes in (SIZES, replace(SIZES, relief=0.0))
        )
        assert told.verdict == flat.verdict == "good", told.reason
        larger.append(float(told.sigma_px.max() / flat.sigma_px.max()))
        sigmas_px.append(float(told.sigma_px.max()))
    assert larger[0] < 1.05
    assert larger[1] > 1.1
    assert sigmas_px[1] > 2.0 * sigmas_px[0], (larger, sigmas_px)


@pytest.mark.parametrize("near_px", [0.5, 1.5])
def test_weights_so_narrow_that_one_row_counts_end_in_a_verdict(near_px: float) -> None:
    both, narrow = eyes(0.0), replace(SIZES, near_px=near_px, flat_sigma_px=5.0, worst_sigma_px=50.0)
    left, right, plane = both["left"], both["right"], Plane(TARGET, GROUND.normal)
    pixel = pinholes(0.0)["left"].pixel(TARGET)
    found = match_patch(left, pixel, plane, right, 6.0, narrow)
    assert found.verdict in ("good", "weak")


def test_what_the_key_does_not_show_any_more_is_found_by_the_standby(begun: Track) -> None:
    """As when the light has changed: the key picture shows another texture, the last look's the right one."""
    near, nearer = pose(0.2), pose(0.4)
    track = seen_by(step(begun, pose(0.0), near), eyes(0.2, seed=40)).track
    assert track.standby is not None
    image = picture(pinholes(0.0)["left"], replace(GROUND, grey=random_texture(77)))
    changed = replace(track, key=replace(track.key, view=replace(track.key.view, image=image)))
    spread = np.diag(np.array([0.004] * 3 + [0.005] * 3) ** 2)
    now = eyes(0.4, seed=50)
    look = seen_by(step(changed, near, nearer, spread), now)
    assert look.track.state == "tracked" and look.renewed, look.reason
    assert np.linalg.norm(look.track.position_m - nearer.inverse.points(TARGET)) < 0.03
    alone = seen_by(step(changed, near, nearer, spread), {"left": now["left"]}).track
    assert alone.state == "tracked" and alone.standby is None, "the standby is the key then"
    assert np.linalg.eigvalsh(look.track.key.drift_m2)[-1] > 0.0, "the exchange hands on its error"
    assert seen_by(step(replace(changed, standby=None), near, nearer, spread), now).track.state == "lost"
