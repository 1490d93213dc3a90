"""Rigid alignment, its covariance, and the naming of points that were mis-measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from calib.calibrate.starts.survey import StationPoses, station_poses
from calib.geometry.rigid import Rigid
from calib.survey.alignment import NotAligned, align, mirrored, rover_from_station, station_from_board
from calib.survey.reader import read_survey
from calib.survey.records import Sigma, StationPoint, Survey
from hil_tests.calib.survey.survey_case import write_files

PRISMS = np.array([(0.10, -0.25, -0.75), (0.10, 0.25, -0.80), (-0.30, -0.25, -0.90), (-0.30, 0.25, -0.70)])
NAMES = ("p1", "p2", "p3", "p4")
SIGMA_M = 0.001


def some_pose(rng: np.random.Generator) -> Rigid:
    turn = Rotation.random(random_state=int(rng.integers(2**31)))
    return Rigid(turn.as_matrix(), rng.uniform(-5, 5, 3))


@pytest.mark.parametrize("count", [3, 4, 7])
def test_exact_points_give_the_pose(count: int) -> None:
    rng = np.random.default_rng(count)
    for _ in range(50):
        pose = some_pose(rng)
        points = rng.normal(0, 0.4, (count, 3))
        found = align(points, pose.points(points), 0.001, (NAMES * 2)[:count])
        assert np.allclose(found.b_from_a.rotation, pose.rotation, atol=1e-10)
        assert np.allclose(found.b_from_a.translation_m, pose.translation_m, atol=1e-10)
        assert np.linalg.det(found.b_from_a.rotation) > 0
        assert found.rejected == ()
        assert found.doubt == ""


def test_pose_is_the_least_of_squares() -> None:
    """SciPy's general minimiser over a rotation vector finds nothing better."""
    rng = np.random.default_rng(3)
    measured = some_pose(rng).points(PRISMS) + rng.normal(0, 0.01, (4, 3))
    found = align(PRISMS, measured, 0.01, NAMES)

    def cost(x: np.ndarray) -> float:
        moved = Rotation.from_rotvec(x[:3]).apply(PRISMS) + x[3:]
        return float(np.sum(((moved - measured) / 0.01) ** 2))

    turn = Rotation.from_matrix(found.b_from_a.rotation).as_rotvec()
    start = np.concatenate([turn, found.b_from_a.translation_m])
    best = minimize(cost, start + 0.01, method="BFGS", options={"gtol": 1e-6}).fun
    assert cost(start) <= best + 1e-6 * best
    np.testing.assert_allclose(found.residuals_m, measured - found.b_from_a.points(PRISMS))


@pytest.mark.parametrize("wrong", range(4))
def test_one_wrong_point_of_four_is_named_and_left_out(wrong: int) -> None:
    rng = np.random.default_rng(wrong)
    named = 0
    for _ in range(100):
        pose = some_pose(rng)
        measured = pose.points(PRISMS) + rng.normal(0, SIGMA_M, (4, 3))
        shift = rng.normal(size=3)
        measured[wrong] += 0.06 * shift / np.linalg.norm(shift)
        found = align(PRISMS, measured, SIGMA_M, NAMES)
        assert found.rejected in ((), (NAMES[wrong],)), "never another one"
        if found.rejected:
            named += 1
            error = found.b_from_a.points(PRISMS) - pose.points(PRISMS)
            assert np.abs(error).max() < 0.025
        else:
            assert found.doubt
    assert named >= 80


def test_two_wrong_points_of_seven_are_named() -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(0, 0.4, (7, 3))
    measured = some_pose(rng).points(points) + rng.normal(0, SIGMA_M, (7, 3))
    measured[2] += (0.05, 0, 0.02)
    measured[6] -= (0, 0.03, 0.03)
    names = tuple("abcdefg")
    found = align(points, measured, SIGMA_M, names)
    assert sorted(found.rejected) == ["c", "g"]
    assert found.doubt == ""
    assert np.linalg.norm(found.residuals_m[2]) > 0.04


def test_good_points_are_hardly_ever_doubted() -> None:
    rng = np.random.default_rng(6)
    doubted = 0
    for _ in range(1500):
        measured = some_pose(rng).points(PRISMS) + rng.normal(0, SIGMA_M, (4, 3))
        found = align(PRISMS, measured, SIGMA_M, NAMES)
        doubted += bool(found.rejected or found.doubt)
    assert doubted <= 2


def test_of_three_points_the_distances_say_which_is_off() -> None:
    rng = np.random.default_rng(7)
    tapes = np.array([(-0.44, -0.44, 0.0), (0.44, -0.44, 0.0), (-0.44, 0.44, 0.0)])
    moved = tapes.copy()
    moved[0] += (-0.02, -0.01, 0)
    found = align(tapes, some_pose(rng).points(moved), SIGMA_M, ("a", "b", "c"))
    assert found.rejected == ()
    assert "a and b are 0.8800 m apart in one list and 0.9001 m in the other (20.1 mm" in found.doubt
    assert found.doubt.endswith("is one of a")


def test_the_worst_of_several_wrong_distances_is_named_with_its_size() -> None:
    """Tape a moved 5 mm towards b, and c 30 mm away from a."""
    tapes = np.array([(-0.44, -0.44, 0.0), (0.44, -0.44, 0.0), (-0.44, 0.44, 0.0)])
    moved = tapes + np.array([(0.005, 0, 0), (0, 0, 0), (0, 0.03, 0)])
    found = align(tapes, some_pose(np.random.default_rng(8)).points(moved), SIGMA_M, ("a", "b", "c"))
    apart = f"a and c are 0.8800 m apart in one list and {np.hypot(0.005, 0.91):.4f} m in the other (30.0 mm"
    assert apart in found.doubt


@pytest.mark.parametrize(
    "points", [PRISMS[:2], np.outer([0, 1, 2, 3], [1, 2, 3]), np.ones((4, 3)), np.zeros((0, 3))]
)
def test_points_without_a_pose_are_refused(points: np.ndarray) -> None:
    with pytest.raises(NotAligned):
        align(points, points, SIGMA_M, NAMES[: len(points)])


def test_swapped_coordinates_are_a_mirror_image() -> None:
    rng = np.random.default_rng(9)
    measured = some_pose(rng).points(PRISMS) + rng.normal(0, SIGMA_M, (4, 3))
    assert not mirrored(measured, PRISMS, SIGMA_M)
    assert mirrored(measured[:, [1, 0, 2]], PRISMS, SIGMA_M)
    assert mirrored(measured * [1, 1, -1], PRISMS, SIGMA_M)
    assert not mirrored(measured[:, [1, 2, 0]], PRISMS, SIGMA_M), "a rotation of the axes does no harm"
    assert not mirrored(measured[:3, [1, 0, 2]], PRISMS[:3], SIGMA_M), "three points have no handedness"


def test_poses_of_a_survey(tmp_path: Path) -> None:
    survey = read_survey(write_files(tmp_path))
    rover = rover_from_station(survey)["level"].b_from_a
    assert np.allclose(rover.points([1.1, -0.25, -0.75]), PRISMS[0])
    board = station_from_board(survey)["level", "near"].b_from_a
    assert np.allclose(board.points([0, 0, 0]), [4, 0, 0], atol=1e-12)
    assert np.allclose(board.vectors([0, 0, 1]), [1, 0, 0], atol=1e-12), "z goes into the board"


def test_a_set_up_with_two_prisms_is_named(tmp_path: Path) -> None:
    text = (write_files(tmp_path) / "station.csv").read_text()
    gone = "".join(line for line in text.splitlines(True) if ",p3," not in line and ",p4," not in line)
    survey = read_survey(write_files(tmp_path, station=gone))
    with pytest.raises(NotAligned, match=r"prisms of set-up level: 2 points \(p1, p2\)"):
        rover_from_station(survey)


CAD_M = 0.01


def several_set_ups(
    base: Survey, rng: np.random.Generator, setups: int = 5, drawing: np.ndarray = PRISMS
) -> tuple[Survey, np.ndarray]:
    """A survey of prisms whose drawing is off by 10 mm (one sigma), and where they are."""
    true = drawing + rng.normal(0, CAD_M, PRISMS.shape)
    station: list[StationPoint] = []
    for number in range(setups):
        measured = some_pose(rng).points(true) + rng.normal(0, SIGMA_M, PRISMS.shape)
        for name, place in zip(NAMES, measured, strict=True):
            station.append(StationPoint(f"s{number}", "prism", "", name, place, len(station) + 2))
    changed = vars(base) | {
        "station": tuple(station),
        "prisms_in_rover_m": dict(zip(NAMES, drawing, strict=True)),
        "sigma": Sigma(SIGMA_M, 0.1, 0.0, CAD_M),
    }
    return Survey(**changed), true


@pytest.fixture
def base(tmp_path: Path) -> Survey:
    return read_survey(write_files(tmp_path))


def test_refined_prisms_are_far_better_than_the_drawing(base: Survey) -> None:
    rng = np.random.default_rng(10)
    spacing, drawn = [], []
    for _ in range(50):
        survey, true = several_set_ups(base, rng)
        found = station_poses(survey)
        spacing.append(_spacing(places_in_rover_m(found)) - _spacing(true))
        drawn.append(_spacing(PRISMS) - _spacing(true))
    assert np.sqrt(np.mean(np.square(spacing))) < 0.001
    assert np.sqrt(np.mean(np.square(drawn))) > 0.01


def places_in_rover_m(found: StationPoses) -> np.ndarray:
    return np.array([found.prisms_in_rover_m[name] for name in NAMES])


def _spacing(places: np.ndarray) -> float:
    return float(np.linalg.norm(places[0] - places[3]))


@pytest.mark.parametrize("off_m", [(0.05, 0.03, 0.0), (0.012, 0.0, 0.005)], ids=["gross", "small"])
def test_a_prism_wrong_in_one_set_up_is_named(base: Survey, off_m: tuple[float, float, float]) -> None:
    survey, true = several_set_ups(base, np.random.default_rng(13))
    survey.station[6].position_m[:] += off_m
    found = station_poses(survey)
    assert [(o.kind, o.name) for o in found.blunders] == [("prism", "prism p3 of set-up s1")]
    assert found.blunders[0].size == pytest.approx(np.linalg.norm(off_m), abs=0.01)
    assert _spacing(places_in_rover_m(found)) == pytest.approx(_spacing(true), abs=0.003)


def test_a_wrong_prism_is_named_where_the_others_but_one_stand_on_a_line(base: Survey) -> None:
    """Without that one no set-up stands: it cannot be the one to leave out."""
    line = np.array([(0.1, -0.3, -0.8), (0.1, 0.0, -0.8), (0.1, 0.3, -0.8), (-0.3, 0.1, -0.7)])
    survey, _ = several_set_ups(base, np.random.default_rng(15), drawing=line)
    survey.station[5].position_m[:] += (0.05, 0.03, 0.0)
    assert [o.name for o in station_poses(survey).blunders] == ["prism p2 of set-up s1"]


def test_a_prism_wrong_in_the_drawing_is_named_for_every_set_up(base: Survey) -> None:
    survey, _ = several_set_ups(base, np.random.default_rng(12))
    drawing = dict(survey.prisms_in_rover_m) | {"p2": PRISMS[1] + (0.2, 0.0, 0.1)}
    found = station_poses(Survey(**(vars(survey) | {"prisms_in_rover_m": drawing})))
    set_ups = dict.fromkeys(point.setup for point in survey.station)
    assert [o.name for o in found.blunders] == [f"prism p2 of set-up {name}" for name in set_ups]


def test_a_set_up_without_prisms_is_named(base: Survey) -> None:
    survey, _ = several_set_ups(base, np.random.default_rng(14))
    check = StationPoint("bare", "check", "", "c1", np.zeros(3), 99)
    with pytest.raises(NotAligned, match="set-up bare"):
        station_poses(Survey(**(vars(survey) | {"station": (*survey.station, check)})))
