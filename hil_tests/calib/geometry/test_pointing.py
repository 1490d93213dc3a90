"""Exact pointing: re-projection, completeness, the edges of reach, the zenith, order, limits and refusals.

The kinematics that judge the solver are SciPy's rotations, in hil_tests/support/random_masts.py.
"""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from calib.errors import Unreachable
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import Solution, choose, solve
from calib.geometry.rig import Mast
from hil_tests.support import random_masts

WORST_PX = 1e-7
PANCAM_PX = 3441.0
ROUNDING_RAD = 1e-12
FORWARD, RIGHT, DOWN = np.eye(3)


def straight_mast(offset_m: float = 0.0, twist_rad: float = 0.0) -> Mast:
    return Mast(np.zeros(3), np.zeros(3), offset_m, twist_rad)


def pinhole(at_m: tuple[float, float, float] = (0.0, 0.0, 0.0), focal_px: float = PANCAM_PX) -> CameraModel:
    """A 1001 x 801 camera looking along the head's x axis, its principal point in the middle."""
    H, V = focal_px * RIGHT + 500.0 * FORWARD, focal_px * DOWN + 400.0 * FORWARD
    return CameraModel("CAHV", (1001, 801), np.array(at_m), FORWARD, H, V)


def solve_ray(
    mast: Mast, origin_m: ArrayLike, direction: ArrayLike, target_in_rover_m: ArrayLike, **start: float
) -> list[Solution]:
    """Solve for a camera whose image centre has a given ray."""
    across = Rotation.align_vectors([direction], [FORWARD])[0].apply([RIGHT, DOWN])
    H, V = PANCAM_PX * across + np.multiply.outer([500.0, 400.0], direction)
    return solve(
        mast, CameraModel("CAHV", (1001, 801), origin_m, direction, H, V), target_in_rover_m, **start
    )


def miss_px(
    mast: Mast, origin: np.ndarray, direction: np.ndarray, target: np.ndarray, one: Solution
) -> float:
    """Return the angle between the ray and the target, seen from the ray's origin, in Pancam pixels."""
    seen = random_masts.head_from_rover(mast, one.pan_rad, one.tilt_rad, target) - origin
    sine = np.linalg.norm(np.cross(direction, seen)) / np.linalg.norm(seen)
    assert seen @ direction > 0.0
    return float(PANCAM_PX * sine)


# -- re-projection and completeness


def test_random_masts_land_on_their_pixels_and_no_solution_is_lost() -> None:
    seed, cases = 20, 1500
    rng = np.random.default_rng(seed)
    for number in range(cases):
        outcome = random_masts.run_case(random_masts.random_case(rng, number))
        assert not outcome.refused, f"seed {seed}, case {number}: {outcome.refused}"
        assert outcome.found, f"seed {seed}, case {number}: the generating solution is lost"
        assert outcome.worst_px <= WORST_PX, f"seed {seed}, case {number}: {outcome.worst_px} px"


def count_by_scanning(mast: Mast, origin: np.ndarray, direction: np.ndarray, target: np.ndarray) -> int:
    """Return how many solutions there are: for each tilt the ray is cut with the sphere |u| = |p|, and the
    height of the cut compared with the target's."""
    p = Rotation.from_euler("XYZ", mast.rotation_rad).inv().apply(target - mast.translation_m)
    tilt = np.linspace(-np.pi, np.pi, 30_001)
    turns = Rotation.from_rotvec([mast.axis_twist_rad, 0, 0]) * Rotation.from_rotvec(tilt[:, None] * RIGHT)
    start = turns.apply(origin) + mast.axis_offset_m * FORWARD
    along = turns.apply(direction)
    half = np.einsum("ij,ij->i", start, along)
    inner = half**2 - np.einsum("ij,ij->i", start, start) + p @ p
    count = 0
    for sign in (1.0, -1.0):
        with np.errstate(invalid="ignore"):
            s = -half + sign * np.sqrt(inner)
            height = np.where(s > 0.0, start[:, 2] + s * along[:, 2] - p[2], np.nan)
        count += int(np.count_nonzero(height[1:] * height[:-1] < 0.0))
    return count


def test_number_of_solutions_agrees_with_a_scan_of_all_tilts() -> None:
    # Targets close to the head, where up to four solutions exist, and head cameras that look anywhere.
    seed = 5
    rng = np.random.default_rng(seed)
    counted = set()
    for number in range(60):
        offset = rng.uniform(-0.3, 0.3) if number % 3 else 0.0
        twist = rng.uniform(-1.3, 1.3) if number % 3 else 0.0
        mast = Mast(rng.normal(size=3), rng.normal(size=3) * 0.1, offset, twist)
        origin = rng.uniform(-0.3, 0.3, 3)
        direction = Rotation.random(random_state=rng).apply(FORWARD)
        pan, tilt = rng.uniform(-np.pi, np.pi, 2)
        reach = 10.0 ** rng.uniform(-1.5, 0.5)
        target = random_masts.rover_from_head(mast, pan, tilt, origin + reach * direction)
        found = solve_ray(mast, origin, direction, target)
        counted.add(len(found))
        assert len(found) == count_by_scanning(mast, origin, direction, target), f"seed {seed}, case {number}"
    assert {2, 4} <= counted


@pytest.mark.parametrize("offset_m", [1e-14, 1e-12, 1e-9, 1e-6, 1e-3, 0.1, 0.3, -0.3, -1e-6])
def test_any_axis_offset_is_exact(offset_m: float) -> None:
    rng = np.random.default_rng(6)
    for _ in range(50):
        mast = Mast(rng.normal(size=3), rng.normal(size=3) * 0.1, offset_m, rng.normal() * 0.1)
        origin, direction = (
            rng.uniform(-0.2, 0.2, 3),
            Rotation.from_rotvec(rng.normal(size=3) * 0.1).apply(FORWARD),
        )
        pan, tilt = rng.uniform(-3.0, 3.0), rng.uniform(-1.2, 1.2)
        target = random_masts.rover_from_head(mast, pan, tilt, origin + rng.uniform(0.5, 100.0) * direction)
        found = solve_ray(mast, origin, direction, target)
        assert max(miss_px(mast, origin, direction, target, one) for one in found) <= WORST_PX
        assert any(abs(one.pan_rad - pan) < 1e-6 and abs(one.tilt_rad - tilt) < 1e-6 for one in found)


# -- cases worked by hand


def test_target_to_the_right_needs_a_quarter_turn() -> None:
    best, over_the_shoulder = solve(straight_mast(), pinhole(), [0.0, 5.0, 0.0])
    assert best.pan_rad == pytest.approx(np.pi / 2, abs=ROUNDING_RAD)
    assert best.tilt_rad == pytest.approx(0.0, abs=ROUNDING_RAD)
    assert best.range_m == pytest.approx(5.0)
    assert over_the_shoulder.pan_rad == pytest.approx(-np.pi / 2, abs=ROUNDING_RAD)
    assert abs(over_the_shoulder.tilt_rad) == pytest.approx(np.pi, abs=ROUNDING_RAD)


def test_target_above_needs_positive_tilt() -> None:
    [best, _] = solve(straight_mast(), pinhole(), [3.0, 0.0, -4.0])
    assert best.tilt_rad == pytest.approx(math.atan2(4.0, 3.0), abs=ROUNDING_RAD)


def test_camera_beside_the_pan_axis_turns_back_by_its_own_angle() -> None:
    # 0.15 m to the right of the axis, target 10 m ahead: the ray is the tangent of a circle of radius 0.15 m.
    [best, _] = solve(straight_mast(), pinhole((0.0, 0.15, 0.0)), [10.0, 0.0, 0.0])
    assert best.pan_rad == pytest.approx(-math.asin(0.15 / 10.0), abs=ROUNDING_RAD)


def test_camera_above_the_tilt_axis_looks_down_a_little() -> None:
    [best, _] = solve(straight_mast(), pinhole((0.0, 0.0, -0.1)), [10.0, 0.0, 0.0])
    assert best.tilt_rad == pytest.approx(-math.asin(0.1 / 10.0), abs=ROUNDING_RAD)


def test_pixel_right_of_the_centre_pans_less() -> None:
    [best, _] = solve(straight_mast(), pinhole(), [10.0, 0.0, 0.0], [500.0 + 100.0, 400.0])
    assert best.pan_rad == pytest.approx(-math.atan2(100.0, PANCAM_PX), abs=ROUNDING_RAD)


def test_axis_offset_ahead_of_the_pan_axis_changes_the_range_only() -> None:
    [best, _] = solve(straight_mast(offset_m=0.2), pinhole(), [0.0, -10.0, 0.0])
    assert best.pan_rad == pytest.approx(-np.pi / 2, abs=ROUNDING_RAD)
    assert best.range_m == pytest.approx(9.8)


def test_image_centre_is_the_default_pixel() -> None:
    camera = pinhole((0.1, 0.2, -0.1))
    target = [4.0, 3.0, 1.0]
    assert solve(straight_mast(), camera, target) == solve(straight_mast(), camera, target, [500.0, 400.0])


# -- order and limits


def test_upright_comes_first_then_least_motion() -> None:
    for seed in range(20):
        case = random_masts.random_case(np.random.default_rng(seed), 1)
        at = np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
        found = solve(
            case.mast,
            case.camera,
            case.target_in_rover_m,
            case.pixel_px,
            from_pan_rad=at[0],
            from_tilt_rad=at[1],
        )
        keys = [
            (abs(one.tilt_rad) > np.pi / 2, max(abs(one.pan_rad - at[0]), abs(one.tilt_rad - at[1])))
            for one in found
        ]
        assert keys == sorted(keys), f"seed {seed}"


def test_angles_are_in_the_half_open_turn() -> None:
    # Straight behind: π, never -π.
    for y in (0.0, -0.0):
        [best, _] = solve(straight_mast(), pinhole(), [-5.0, y, 0.0])
        assert best.pan_rad == pytest.approx(np.pi, abs=ROUNDING_RAD)


def test_choose_takes_the_first_within_limits() -> None:
    near, far = Solution(0.1, 0.2, 5.0), Solution(-1.0, 0.3, 5.0)
    assert choose([near, far], (-2.0, 2.0), (-1.0, 1.0)) == near
    assert choose([near, far], (-2.0, 0.0), (-1.0, 1.0)) == far
    assert choose([near, far], (-2.0, 2.0), (-1.0, 1.0), from_pan_rad=-1.0) == far


def test_choose_takes_the_least_motion_of_readings_where_joints_read_wrong() -> None:
    one, other = Solution(0.1, 0.2, 5.0), Solution(-0.15, 0.2, 5.0)

    def read(solution: Solution) -> tuple[float, float]:
        return solution.pan_rad + 0.1, solution.tilt_rad

    assert choose([one, other], (-2.0, 2.0), (-1.0, 1.0), 0.0, 0.2, read) == other


def test_choose_prefers_an_upright_picture_to_less_motion() -> None:
    upright, upside_down = Solution(2.0, 0.2, 5.0), Solution(0.1, 3.0, 5.0)
    assert choose([upside_down, upright], (-3.0, 3.0), (-3.1, 3.1), from_tilt_rad=3.0) == upright


def test_limits_belong_to_the_reach() -> None:
    one = Solution(1.5, -0.7, 5.0)
    assert choose([one], (-1.5, 1.5), (-0.7, 0.7)) == one
    beyond = math.nextafter(1.5, 0.0)
    with pytest.raises(Unreachable):
        choose([one], (-beyond, beyond), (-0.7, 0.7))


def test_outside_the_limits_says_which_joint_and_by_how_much() -> None:
    with pytest.raises(Unreachable) as refusal:
        choose([Solution(0.0, 1.92, 5.0), Solution(-3.1, 1.22, 5.0)], (-2.6, 2.6), (-1.2, 1.57))
    assert refusal.value.code == "outside_limits"
    assert str(refusal.value) == "tilt 1.92 rad is 0.35 rad beyond the limit 1.57 rad"


def test_both_joints_outside_are_both_named() -> None:
    with pytest.raises(Unreachable, match=r"pan -1 rad is 0\.5 rad .* and tilt 1 rad is 0\.25 rad beyond"):
        choose([Solution(-1.0, 1.0, 5.0)], (-0.5, 0.5), (-0.5, 0.75))


def test_a_joint_that_turns_past_half_a_turn_gets_the_angle_it_can_reach() -> None:
    # The flown masts count azimuth from 20 to 350 degrees.
    chosen = choose([Solution(-1.0, 0.2, 5.0)], (math.radians(20.0), math.radians(350.0)), (-1.0, 1.0))
    assert chosen.pan_rad == pytest.approx(math.tau - 1.0)


def test_a_joint_that_turns_backwards_gets_the_angle_it_can_reach() -> None:
    chosen = choose([Solution(1.0, 0.2, 5.0)], (math.radians(-350.0), math.radians(-20.0)), (-1.0, 1.0))
    assert chosen.pan_rad == pytest.approx(1.0 - math.tau)
    chosen = choose([Solution(0.0, 2.0, 5.0)], (-1.0, 1.0), (-5.0, -4.0))
    assert chosen.tilt_rad == pytest.approx(2.0 - math.tau)


# -- the edge of reach, from both sides


@pytest.mark.parametrize("beyond", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("height_m", [-3.0, -0.2, 4.0])
def test_blind_cylinder_of_a_camera_beside_the_pan_axis(beyond: float, height_m: float) -> None:
    # A forward ray 0.1 m beside the pan axis never comes nearer to it than 0.1 m, whatever the joints.
    mast, camera = straight_mast(), pinhole((0.0, 0.1, 0.0))
    edge = np.array([0.06, -0.08, height_m])
    outside = edge * [1.0 + beyond, 1.0 + beyond, 1.0]
    found = solve(mast, camera, outside)
    assert len(found) == 2
    for one in found:
        assert miss_px(mast, camera.C, FORWARD, outside, one) <= WORST_PX
    with pytest.raises(Unreachable) as refusal:
        solve(mast, camera, edge * [1.0 - beyond, 1.0 - beyond, 1.0])
    assert refusal.value.code == "blind_cone"


def test_at_the_very_edge_the_two_solutions_are_one() -> None:
    mast, camera = straight_mast(), pinhole((0.0, 0.1, 0.0))
    target = np.array([0.06, -0.08, -3.0])
    [one] = solve(mast, camera, target)
    assert miss_px(mast, camera.C, FORWARD, target, one) <= WORST_PX


def test_blind_cone_says_how_far_inside_the_target_is() -> None:
    with pytest.raises(Unreachable) as refusal:
        solve(straight_mast(), pinhole((0.0, 0.1, 0.0)), [0.03, 0.04, -2.0])
    assert str(refusal.value) == (
        "target is 0.05 m from the pan axis (0.025 rad from straight up), inside the blind cone by 0.05 m: "
        "at its height this pixel reaches targets from 0.1 m on"
    )


def test_target_at_the_origin_of_a_mast_with_an_offset_is_refused() -> None:
    # The search for the edge of reach began at this distance of 0 and never grew.
    with pytest.raises(Unreachable, match=r"target is 0 m from the pan axis .* inside the blind cone by"):
        solve(
            Mast(np.zeros(3), np.zeros(3), axis_offset_m=0.05),
            pinhole(np.zeros(3)),
            [0.0, 0.0, 0.0],
            [600.0, 500.0],
        )


def nearest_to_the_pan_axis_m(
    mast: Mast, origin: np.ndarray, direction: np.ndarray, height_m: float
) -> float:
    """Return the least distance from the pan axis at which the ray is at a height, over all tilts."""

    def distance(tilt: float) -> float:
        turns = Rotation.from_rotvec([mast.axis_twist_rad, 0, 0]) * Rotation.from_rotvec([0, tilt, 0])
        start = turns.apply(origin) + mast.axis_offset_m * FORWARD
        along = turns.apply(direction)
        s = (height_m - start[2]) / along[2]
        return float(np.hypot(*(start + s * along)[:2])) if s > 0.0 else 1e9

    tilts = np.linspace(-np.pi, np.pi, 2001)
    best = tilts[np.argmin([distance(tilt) for tilt in tilts])]
    step = tilts[1] - tilts[0]
    return float(
        minimize_scalar(
            distance, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-11}
        ).fun
    )


@pytest.mark.parametrize(
    "offset_m,twist_rad", [(0.0, 0.0), (0.0, 0.2), (0.1, 0.0), (0.1, -0.05), (-0.25, 0.3), (1e-6, 1e-6)]
)
@pytest.mark.parametrize("height_m", [-2.0, 3.0])
def test_edge_of_reach_found_by_minimising_is_where_refusals_begin(
    offset_m: float, twist_rad: float, height_m: float
) -> None:
    mast = straight_mast(offset_m, twist_rad)
    origin = np.array([0.05, 0.16, -0.03])
    direction = np.array([1.0, 0.2, 0.1]) / np.linalg.norm([1.0, 0.2, 0.1])
    edge = nearest_to_the_pan_axis_m(mast, origin, direction, height_m)
    azimuth = np.array([math.cos(0.4), math.sin(0.4), 0.0])
    for part in (1e-7, 1e-4, 0.1):
        target = edge * (1.0 + part) * azimuth + height_m * DOWN
        found = solve_ray(mast, origin, direction, target)
        assert max(miss_px(mast, origin, direction, target, one) for one in found) <= WORST_PX
        inside = edge * (1.0 - part) * azimuth + height_m * DOWN
        with pytest.raises(Unreachable) as refusal:
            solve_ray(mast, origin, direction, inside)
        assert refusal.value.code == "blind_cone"
        told = re.search(r"reaches targets from (\S+) m on", str(refusal.value))
        assert told is not None and float(told.group(1)) == pytest.approx(edge, rel=1e-5)


def test_ray_that_never_reaches_a_height_says_so() -> None:
    # A camera that looks along the tilt axis sweeps one plane only.
    with pytest.raises(Unreachable, match="reaches no target at all"):
        solve_ray(straight_mast(), np.zeros(3), RIGHT, [3.0, 0.0, -1.0])


# -- the zenith, from both sides


@pytest.mark.parametrize("offset_m", [0.0, 0.1, -0.1])
@pytest.mark.parametrize("aside_m", [1e-1, 1e-3, 1e-6, 1e-9, 2e-11])
@pytest.mark.parametrize("height_m", [-10.0, 10.0])
def test_targets_near_the_pan_axis_are_hit_from_both_sides(
    offset_m: float, aside_m: float, height_m: float
) -> None:
    mast = straight_mast(offset_m)
    origin = np.zeros(3)
    straight_up_rad = math.copysign(math.atan2(abs(height_m), -offset_m), -height_m)
    for side in (1.0, -1.0):
        target = np.array([side * aside_m, 0.0, height_m])
        found = solve_ray(mast, origin, FORWARD, target)
        assert len(found) == 2
        assert max(miss_px(mast, origin, FORWARD, target, one) for one in found) <= WORST_PX
        # Passing overhead without panning: tilt goes on smoothly through straight up.
        still = min(found, key=lambda one: abs(one.pan_rad))
        assert still.pan_rad == pytest.approx(0.0, abs=1e-5)
        expected = math.copysign(math.atan2(abs(height_m), side * aside_m - offset_m), -height_m)
        assert still.tilt_rad == pytest.approx(expected, abs=1e-9)
        assert abs(still.tilt_rad - straight_up_rad) < 2.0 * aside_m


@pytest.mark.parametrize("offset_m", [0.0, 0.1])
def test_on_the_pan_axis_every_pan_does_and_the_head_keeps_its_own(offset_m: float) -> None:
    target = np.array([0.0, 0.0, -10.0])
    mast = straight_mast(offset_m)
    [one] = solve_ray(mast, np.zeros(3), FORWARD, target, from_pan_rad=0.7)
    assert one.pan_rad == pytest.approx(0.7)
    assert miss_px(mast, np.zeros(3), FORWARD, target, one) <= WORST_PX


def test_on_the_pan_axis_a_camera_beside_it_is_blind() -> None:
    with pytest.raises(Unreachable) as refusal:
        solve(straight_mast(), pinhole((0.0, 0.1, 0.0)), [0.0, 0.0, -10.0])
    assert refusal.value.code == "blind_cone"


# -- nearer than the head


def test_too_near_from_both_sides() -> None:
    mast, camera = straight_mast(), pinhole((0.3, 0.0, 0.0))
    [one, _] = solve(mast, camera, [0.3 * (1.0 + 1e-9), 0.0, 0.0])
    assert one.range_m == pytest.approx(0.3e-9, rel=1e-5)
    with pytest.raises(Unreachable) as refusal:
        solve(mast, camera, [0.2, 0.0, 0.0])
    assert refusal.value.code == "too_near"
    assert "0.1 m nearer" in str(refusal.value)
    with pytest.raises(Unreachable):
        solve(mast, camera, [0.3 * (1.0 - 1e-9), 0.0, 0.0])


def test_target_nearer_than_the_ray_passes_the_head_is_too_near() -> None:
    # The ray starts behind the head's origin and passes it at 0.25 m.
    with pytest.raises(Unreachable) as refusal:
        solve_ray(straight_mast(), [-0.5, 0.0, -0.25], FORWARD, [0.1, 0.0, 0.1])
    assert refusal.value.code == "too_near"


# -- what cannot be asked


@pytest.mark.parametrize(
    "target",
    [
        [np.nan, 0.0, 0.0],
        [1.0, np.nan, 0.0],
        [0.0, 0.0, np.inf],
        [1.0, 2.0],
        2.0,
        [2e9, 0.0, 0.0],
    ],
)
def test_bad_target_is_refused(target: list[float]) -> None:
    with pytest.raises(Unreachable) as refusal:
        solve(straight_mast(), pinhole(), target)
    assert refusal.value.code == "bad_target"


@pytest.mark.parametrize("pixel", [[np.nan, 0.0], [0.0, np.inf], [1.0], [1.0, 2.0, 3.0]])
def test_bad_pixel_is_refused(pixel: list[float]) -> None:
    with pytest.raises(Unreachable) as refusal:
        solve(straight_mast(), pinhole(), [5.0, 0.0, 0.0], pixel)
    assert refusal.value.code == "bad_pixel"


def test_pixel_without_a_ray_is_refused() -> None:
    # A fisheye of 300 px a radian ends well before a pixel 3000 px from its centre.
    H, V = 300.0 * RIGHT + 320.0 * FORWARD, 300.0 * DOWN + 240.0 * FORWARD
    fisheye = CameraModel("CAHVORE", (640, 480), np.zeros(3), FORWARD, H, V, FORWARD, cahvore_type=2)
    with pytest.raises(Unreachable) as refusal:
        solve(straight_mast(), fisheye, [5.0, 0.0, 0.0], [3320.0, 240.0])
    assert refusal.value.code == "bad_pixel"


def test_parallel_axes_are_refused_and_nearly_parallel_ones_solved() -> None:
    with pytest.raises(Unreachable) as refusal:
        solve(straight_mast(0.1, np.pi / 2), pinhole(), [5.0, 0.0, 0.0])
    assert refusal.value.code == "parallel_axes"
    mast = straight_mast(0.1, np.pi / 2 - 0.0011)
    target = random_masts.rover_from_head(mast, 0.4, -0.3, 5.0 * FORWARD)
    found = solve_ray(mast, np.zeros(3), FORWARD, target)
    assert max(miss_px(mast, np.zeros(3), FORWARD, target, one) for one in found) <= WORST_PX
    assert any(abs(one.pan_rad - 0.4) < 1e-6 and abs(one.tilt_rad + 0.3) < 1e-6 for one in found)


coordinate = st.floats(-1e3, 1e3)
small = st.floats(-0.4, 0.4)


@settings(max_examples=300)
@given(
    st.tuples(coordinate, coordinate, coordinate),
    small,
    st.floats(-1.5, 1.5),
    st.tuples(small, small, small),
    small,
    small,
)
def test_any_target_is_hit_or_refused_by_name(
    target: tuple[float, ...], offset: float, twist: float, at: tuple[float, ...], turn: float, rise: float
) -> None:
    mast = Mast(np.array([0.3, 0.0, -1.4]), np.array([-0.01, -0.02, 0.003]), offset, twist)
    origin = np.array(at)
    direction = Rotation.from_rotvec([0.0, rise, turn]).apply(FORWARD)
    try:
        found = solve_ray(mast, origin, direction, target)
    except Unreachable as refusal:
        assert refusal.code in ("blind_cone", "too_near")
        return
    size = np.linalg.norm(np.array(target) - mast.translation_m) + 0.5
    for one in found:
        there = random_masts.rover_from_head(
            mast, one.pan_rad, one.tilt_rad, origin + one.range_m * direction
        )
        assert one.range_m > 0.0
        assert np.linalg.norm(there - target) <= 3e-12 * size


def test_without_a_word_the_angles_nearest_to_zero_come_first() -> None:
    """A camera beside the pan axis sees what is steep above it upright two ways: panned less, tilted less.

    From a head that looks 1 rad up, the way with less pan would be the shorter one.
    """
    above = [0.11 * np.cos(2.0), 0.11 * np.sin(2.0), -0.3]
    panned, tilted = solve(straight_mast(-0.05), pinhole((0.0, 0.1, 0.0)), above)
    assert max(panned.pan_rad, panned.tilt_rad) < max(tilted.pan_rad, tilted.tilt_rad) < np.pi / 2
    assert max(panned.pan_rad, panned.tilt_rad - 1.0) > max(tilted.pan_rad, tilted.tilt_rad - 1.0)
    by_ray = solve_ray(straight_mast(-0.05), [0.0, 0.1, 0.0], FORWARD, above)
    assert [one.pan_rad for one in by_ray] == pytest.approx([panned.pan_rad, tilted.pan_rad])
    low, high = Solution(0.0, -0.5, 5.0), Solution(0.0, 0.7, 5.0)
    assert choose([high, low], (-2.0, 2.0), (-1.0, 1.0)) == low
    left, right = Solution(-0.5, 0.0, 5.0), Solution(0.7, 0.0, 5.0)
    assert choose([right, left], (-2.0, 2.0), (-1.0, 1.0)) == left
