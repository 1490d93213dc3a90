"""Camera models: what is refused, hand-worked pixels, motion, one against many, normalisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid, unit_vector
from hil_tests.calib.geometry.camera_cases import CENTER_PX, KINDS, SIZE, at_angle, plain, random_model

PIXEL_PX = 1e-8
RAY = 1e-11


@pytest.mark.parametrize(
    ("kind", "other", "words"),
    [
        ("CAHVO", {}, "kind is 'CAHVO'"),
        ("CAHV", {"size_px": (640, 0)}, r"size is \(640, 0\)"),
        ("CAHV", {"size_px": (640.5, 480)}, r"size is \(640.5, 480\)"),
        ("CAHV", {"size_px": (True, 480)}, "size is"),
        ("CAHV", {"size_px": 640}, "size is 640"),
        ("CAHV", {"size_px": (640, 480, 3)}, "size is"),
        ("CAHV", {"C": [0, 0]}, r"^C: shape \(2,\)"),
        ("CAHV", {"C": [0, 0, "far"]}, "^C: "),
        ("CAHV", {"H": [np.nan, 0, 1]}, "^H: .*not finite"),
        ("CAHVOR", {"R": [0, np.inf, 0]}, "^R: .*not finite"),
        ("CAHVOR", {"R": [-1, 0, 0]}, "R begins with -1"),
        ("CAHV", {"A": [0, 0, 1.00000001]}, "A is .* length 1"),
        ("CAHVOR", {"O": [0, 0, 0.99]}, "O is .* length 1"),
        ("CAHVOR", {"O": [0, 0, -1]}, "within 90 degrees of A"),
        ("CAHV", {"H": [0, 500, 319.5]}, "H, V and A lie in one plane"),
        ("CAHV", {"H": [0, 0, 1]}, "H, V and A lie in one plane"),
        ("CAHV", {"V": [0, 0, 0]}, "H, V and A lie in one plane"),
        ("CAHVOR", {"cahvore_type": 2}, "type is 2 where 0 is expected for CAHVOR"),
        ("CAHVORE", {"cahvore_type": 4}, "type is 4 where 1, 2 or 3 is expected for CAHVORE"),
        ("CAHVORE", {"cahvore_type": 3, "linearity": np.nan}, "linearity is nan"),
        ("CAHVORE", {"E": [0, 0]}, r"^E: shape \(2,\)"),
    ],
)
def test_numbers_that_are_no_camera_are_refused_by_letter(kind: str, other: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words) as refusal:
        plain(kind, **other)
    assert "\n" not in str(refusal.value)


def test_letters_that_do_not_count_are_neutral() -> None:
    model = plain("CAHV", O=[1, 0, 0], R=[1, 2, 3], E=[1, 2, 3])
    assert np.array_equal(model.O, model.A)
    assert not model.R.any() and not model.E.any()
    assert not plain("CAHVOR", E=[1, 2, 3]).E.any()
    assert plain("CAHVORE", linearity=0.3).linearity == 0.0
    assert plain("CAHVORE", cahvore_type=1, linearity=0.3).linearity == 1.0


def test_vectors_are_read_only_also_after_a_motion() -> None:
    model = plain("CAHVORE", E=[0.01, 0, 0])
    for each in (model, model.moved(Rigid.identity())):
        for letter in "CAHVORE":
            with pytest.raises(ValueError, match="read-only"):
                getattr(each, letter)[0] = 1.0


def test_wrong_shapes_are_refused() -> None:
    for call in (plain("CAHV").project, plain("CAHV").project_jacobian):
        with pytest.raises(ValueError, match=r"points of shape \(2,\)"):
            call([0.0, 1.0])
    for call in (plain("CAHV").ray, plain("CAHV").ray_jacobian):  # type: ignore[assignment]
        with pytest.raises(ValueError, match=r"pixels of shape \(4, 3\)"):
            call(np.zeros((4, 3)))


def test_a_pinhole_projects_by_division() -> None:
    pixel, valid = plain("CAHV").project([0.2, -0.1, 2.0])
    assert valid
    assert pixel.tolist() == [500 * 0.1 + 319.5, -500 * 0.05 + 239.5]


def test_a_fisheye_sees_a_right_angle_at_half_pi() -> None:
    wide = plain("CAHVORE", cahvore_type=2)
    pixel, valid = wide.project([3.0, 0.0, 0.0])
    assert valid
    assert np.allclose(pixel, [500 * np.pi / 2 + 319.5, 239.5], atol=PIXEL_PX, rtol=0)


@pytest.mark.parametrize(
    ("linearity", "chi"), [(0.5, np.tan(0.35) / 0.5), (0.0, 0.7), (-0.5, np.sin(0.35) / 0.5)]
)
def test_linearity_makes_tangent_angle_or_sine(linearity: float, chi: float) -> None:
    model = plain("CAHVORE", cahvore_type=3, linearity=linearity)
    pixel, _ = model.project(at_angle(0.7, around_rad=0.0))
    assert np.allclose(pixel, [500 * chi + 319.5, 239.5], atol=PIXEL_PX, rtol=0)


def test_the_entrance_point_moves_along_o() -> None:
    model = plain("CAHVORE", E=[0.02, 0.03, 0.04])
    rays = model.ray([500 * 0.8 + 319.5, 239.5])
    shift_m = (0.8 / np.sin(0.8) - 1) * (0.02 + 0.03 * 0.8**2 + 0.04 * 0.8**4)
    assert np.allclose(rays.origins_m, [0, 0, shift_m], atol=RAY, rtol=0)
    assert np.allclose(rays.directions, [np.sin(0.8), 0, np.cos(0.8)], atol=RAY, rtol=0)


def test_points_outside_the_image_keep_their_numbers() -> None:
    pixel, valid = plain("CAHV").project([20.0, 0.0, 1.0])
    assert valid and pixel.tolist() == [10319.5, 239.5]
    assert plain("CAHVOR").ray([1e5, -1e5]).valid


@pytest.mark.parametrize(
    ("pixel", "margin_px", "held"),
    [
        ((-0.5, -0.5), 0.0, True),
        ((SIZE[0] - 0.5, SIZE[1] - 0.5), 0.0, True),
        ((-0.51, 10.0), 0.0, False),
        ((10.0, SIZE[1] - 0.49), 0.0, False),
        ((0.0, SIZE[1] - 1.0), 0.5, True),
        ((0.0, 10.0), 0.6, False),
        ((np.nan, 10.0), 0.0, False),
    ],
)
def test_the_image_ends_half_a_pixel_outside_its_outer_pixels(
    pixel: tuple[float, float], margin_px: float, held: bool
) -> None:
    assert plain("CAHV").holds(pixel, margin_px) is held


def test_shapes_follow_the_input() -> None:
    model = plain("CAHVORE", E=[0.01, 0, 0])
    points = np.random.default_rng(1).uniform(0.5, 2.0, (2, 5, 3))
    pixels, jacobian, valid = model.project_jacobian(points)
    assert (pixels.shape, jacobian.shape, valid.shape) == ((2, 5, 2), (2, 5, 2, 3), (2, 5))
    rays, d_direction, d_origin = model.ray_jacobian(pixels)
    assert (rays.origins_m.shape, rays.valid.shape) == ((2, 5, 3), (2, 5))
    assert d_direction.shape == d_origin.shape == (2, 5, 3, 2)
    pixels, valid = model.project(points[0, 0])
    assert (pixels.shape, valid.shape) == ((2,), ())
    pixels, valid = model.project(np.zeros((0, 3)))
    assert (pixels.shape, valid.shape) == ((0, 2), (0,))
    _, jacobian, valid = model.project_jacobian(points[0, 0])
    assert (jacobian.shape, valid.shape) == ((2, 3), ())


@pytest.mark.parametrize("kind", KINDS)
def test_moving_the_camera_is_moving_the_points(kind: str) -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        model = random_model(rng, kind)
        b_from_a = Rigid(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3))
        moved = model.moved(b_from_a)
        rays = model.ray(rng.uniform(-0.5, np.array(SIZE) - 0.5, (100, 2)))
        points = (rays.origins_m + 3.0 * rays.directions)[rays.valid]
        pixels, _ = model.project(points)
        again, valid = moved.project(b_from_a.points(points))
        assert valid.all()
        assert np.abs(again - pixels).max(initial=0.0) <= PIXEL_PX
        moved_rays = moved.ray(pixels)
        expected = model.ray(pixels)
        assert np.abs(moved_rays.origins_m - b_from_a.points(expected.origins_m)).max(initial=0.0) <= RAY
        assert np.abs(moved_rays.directions - b_from_a.vectors(expected.directions)).max(initial=0.0) <= RAY
        assert np.allclose(moved.C, b_from_a.points(model.C), atol=1e-15)
        for letter in "AHVO":
            assert np.allclose(getattr(moved, letter), b_from_a.rotation @ getattr(model, letter), rtol=1e-14)
        assert np.array_equal(moved.R, model.R) and np.array_equal(moved.E, model.E)
        assert moved.kind == model.kind and moved.size_px == model.size_px


def test_many_small_motions_do_not_wear_the_model() -> None:
    model = plain("CAHVORE", R=[0, 0.05, 0], E=[0.01, 0.02, 0.0])
    step = Rigid(Rotation.from_rotvec([0.01, -0.02, 0.03]).as_matrix(), np.zeros(3))
    moved = model
    for _ in range(2000):
        moved = moved.moved(step)
    assert abs(np.linalg.norm(moved.A) - 1.0) <= 1e-11
    replace(moved)  # still a camera by its own rules


def test_jacobians_on_the_lens_axis_are_finite_and_right() -> None:
    model = plain("CAHVORE", R=[0.02, 0.05, 0.01], E=[0.01, 0.02, 0.0])
    pixels, jacobian, valid = model.project_jacobian([[0.0, 0.0, 2.0]])
    assert valid.all() and np.allclose(pixels, CENTER_PX)
    assert np.allclose(jacobian[0], np.array([[1.02 * 250, 0, 0], [0, 1.02 * 250, 0]]), atol=1e-9)
    _, d_direction, d_origin = model.ray_jacobian([CENTER_PX])
    assert np.allclose(d_direction[0], np.array([[1, 0], [0, 1], [0, 0]]) / (500 * 1.02), atol=1e-15)
    assert np.allclose(d_origin, 0.0, atol=1e-15)
    # a hundred-thousandth of a pixel off, s ~ e0 theta^2 / 6
    _, _, d_origin = model.ray_jacobian([CENTER_PX[0] + 1e-5, CENTER_PX[1]])
    theta = 1e-5 / 500 / 1.02
    assert np.allclose(d_origin[2, 0], 0.01 * theta / 3 / 500 / 1.02, rtol=1e-6)


def test_unit_vectors_keep_their_bits() -> None:
    axis = unit_vector([1.0, 2.0, 3.0])
    assert np.array_equal(unit_vector(axis), axis)
    with pytest.raises(ValueError, match=r"^\[0.0, 0.0, 0.0\] where a direction is expected"):
        unit_vector([0, 0, 0])


numbers = st.floats(allow_nan=True, allow_infinity=True)
moderate = st.floats(-3.0, 3.0)
triples = st.one_of(st.tuples(numbers, numbers, numbers), st.tuples(moderate, moderate, moderate))


@settings(max_examples=300, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
@given(
    kind=st.sampled_from(KINDS),
    c=triples,
    a=triples,
    h=triples,
    v=triples,
    o=triples,
    r=triples,
    e=triples,
    cahvore_type=st.integers(0, 3),
    linearity=st.one_of(numbers, moderate),
    point=triples,
)
@pytest.mark.filterwarnings("error")
def test_any_numbers_make_a_camera_or_one_sentence(
    kind: str,
    c: tuple,
    a: tuple,
    h: tuple,
    v: tuple,
    o: tuple,
    r: tuple,
    e: tuple,
    cahvore_type: int,
    linearity: float,
    point: tuple,
) -> None:
    try:
        with np.errstate(all="ignore"):
            cahvore_type = cahvore_type if kind == "CAHVORE" else 0
            model = CameraModel(
                kind, SIZE, c, unit_vector(a), h, v, unit_vector(o), r, e, cahvore_type, linearity
            )
    except ValueError as error:
        assert "\n" not in str(error)
        return
    for points in (np.array(point), np.array([point])):
        pixels, valid = model.project(points)
        assert np.isfinite(pixels).all() if valid.all() else np.isnan(pixels).all()
        rays = model.ray(points[..., :2])
        assert np.isfinite(rays.directions).all() if rays.valid.all() else np.isnan(rays.directions).all()
    model.project_jacobian(point)
    model.ray_jacobian(point[:2])
