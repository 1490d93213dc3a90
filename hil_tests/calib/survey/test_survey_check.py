"""The check before the fit: nothing to say about a good survey, and the right thing about a bad one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.survey.check import check_survey
from calib.survey.records import StationPoint, Survey, SurveyFinding, SurveyImage
from calib.targets.boards import Board
from hil_tests.support.sim_survey.blunders import with_moved_tape, with_swapped_boards, with_wrong_prism
from hil_tests.support.sim_survey.plan import SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(ROOT / "configs/sim/rocky8.yaml").rig


@pytest.fixture(scope="module")
def good(rig: Rig) -> Survey:
    return simulate_survey(rig, 1)[0]


def only(findings: tuple[SurveyFinding, ...]) -> SurveyFinding:
    assert len(findings) == 1, [str(finding) for finding in findings]
    return findings[0]


def with_images(survey: Survey, change: Callable[[SurveyImage], SurveyImage | None]) -> Survey:
    return replace(survey, images=tuple(i for i in map(change, survey.images) if i is not None))


def with_station(survey: Survey, change: Callable[[StationPoint], StationPoint | None]) -> Survey:
    return replace(survey, station=tuple(p for p in map(change, survey.station) if p is not None))


MORE = pytest.mark.long(3, "more surveys of the same plan")


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=MORE) for seed in range(2, 6))])
@pytest.mark.parametrize("rough", [True, False])
def test_nothing_is_said_about_a_good_survey(rig: Rig, seed: int, rough: bool) -> None:
    survey, _ = simulate_survey(rig, seed, SurveyPlan(rough=rough))
    assert check_survey(survey) == ()


def test_a_finding_reads_as_a_sentence() -> None:
    finding = SurveyFinding("error", "set-up level", "two prisms are measured", "Measure a third")
    assert str(finding) == "error: set-up level: two prisms are measured. Measure a third."


# what is missing


def test_images_without_dots_or_picture(good: Survey, tmp_path: Path) -> None:
    names = [i.name for i in good.images if i.camera == "navcam_left"][:6]
    dots = {name: found for name, found in good.dots.items() if name not in names}
    finding = only(check_survey(replace(good, dots=dots, folder=tmp_path)))
    assert finding.severity == "error"
    assert "6 of 20 images have neither dots in dots.csv nor a picture" in finding.message
    assert f"images/{names[0]}.png is missing" in finding.message
    (tmp_path / "images").mkdir()
    for name in names:
        (tmp_path / "images" / f"{name}.png").touch()
    assert check_survey(replace(good, dots=dots, folder=tmp_path)) == ()


def test_a_camera_without_images(good: Survey) -> None:
    changed = with_images(good, lambda i: None if i.camera == "hazcam_right" else i)
    finding = only(check_survey(changed))
    assert (finding.severity, finding.place) == ("error", "camera hazcam_right")


def test_an_image_of_a_placement_that_was_not_measured(good: Survey) -> None:
    one = next(i for i in good.images if i.placement == "mast-3")
    changed = with_images(good, lambda i: replace(i, placement="mats-3") if i is one else i)
    finding = only(check_survey(changed))
    assert "mats-3 has no tapes in set-up level" in finding.message
    assert "'mast-3'" in finding.message
    assert str(one.row) in finding.place


def test_a_placement_with_two_tapes(good: Survey) -> None:
    changed = with_station(good, lambda p: None if (p.placement, p.point) == ("mast-1", "c") else p)
    few = only(check_survey(changed))
    assert few.severity == "error"
    assert "2 of three tapes are measured (a, b)" in few.message


@pytest.mark.parametrize(("left", "severity"), [(2, "error"), (3, "warning")])
def test_a_set_up_with_few_prisms(good: Survey, left: int, severity: str) -> None:
    gone = ["p4", "p3", "p2"][: 4 - left]
    changed = with_station(good, lambda p: None if p.setup == "tilted-back" and p.point in gone else p)
    findings = check_survey(changed)
    assert (findings[0].severity, findings[0].place) == (severity, "set-up tilted-back")


def test_no_check_images(good: Survey) -> None:
    changed = with_images(good, lambda i: None if i.purpose == "check" else i)
    changed = with_station(changed, lambda p: None if p.placement.startswith("check") else p)
    finding = only(check_survey(changed))
    assert finding.severity == "warning"
    assert "never fitted" in finding.advice


# too little spread


def test_boards_at_one_distance(good: Survey) -> None:
    near = {i.name for i in good.images if "pancam" not in i.camera or i.placement.startswith("pancam-5m")}
    changed = with_images(good, lambda i: i if i.name in near else None)
    findings = [f for f in check_survey(changed) if "stand between" in f.message]
    assert [f.place for f in findings] == ["camera pancam_left", "camera pancam_right"]
    assert "focal length and place of the camera can trade" in findings[0].message
    assert "m as well" in findings[0].advice


@pytest.mark.parametrize(
    ("share", "place", "emptiest"), [(0.3, 0.0, "right"), (0.2, 0.52, "left")], ids=["left", "middle"]
)
def test_dots_in_one_part_of_the_picture(good: Survey, share: float, place: float, emptiest: str) -> None:
    width = good.cameras["navcam_left"].size_px[0]
    dots = {
        n: replace(d, pixels_px=d.pixels_px * (share, 1) + (place * width, 0)) if "navcam_left" in n else d
        for n, d in good.dots.items()
    }
    findings = check_survey(replace(good, dots=dots))
    finding = only(tuple(f for f in findings if "of the picture" in f.message))
    assert (finding.severity, finding.place) == ("warning", "camera navcam_left")
    assert finding.advice == f"Photograph boards in the {emptiest} part of the picture"


def test_images_with_few_dots(good: Survey) -> None:
    names = [i.name for i in good.images if i.camera == "navcam_left"][:5]
    seen = {name: good.dots[name] for name in names}
    few = {
        n: replace(d, rows=d.rows[:4], columns=d.columns[:4], pixels_px=d.pixels_px[:4])
        for n, d in seen.items()
    }
    finding = only(check_survey(replace(good, dots={**good.dots, **few})))
    assert (finding.severity, finding.place) == ("warning", "camera navcam_left")
    assert f"5 of 20 images have fewer than 20 dots ({names[0]}, " in finding.message


def test_few_boards_for_the_mast(good: Survey) -> None:
    kept = sorted({i.placement for i in good.images if i.purpose == "mast"})[:4]
    changed = with_images(good, lambda i: i if i.purpose != "mast" or i.placement in kept else None)
    findings = [f.message for f in check_survey(changed) if f.place == "the mast"]
    assert "4 placements of purpose mast; 5 to 8 are adequate" in findings


def test_few_boards(good: Survey) -> None:
    kept = {i.placement for i in good.images if i.camera == "hazcam_left" and i.purpose == "camera"}
    for count, severity in ((2, "error"), (3, "warning"), (4, "warning")):
        gone = sorted(kept)[count:]
        changed = with_images(good, lambda i, gone=gone: None if i.placement in gone else i)
        changed = with_station(changed, lambda p, gone=gone: None if p.placement in gone else p)
        found = [f for f in check_survey(changed) if f"{count} placements are there" in f.message]
        assert [f.severity for f in found] == [severity] * 2


def test_a_head_that_hardly_moved(good: Survey) -> None:
    still = with_images(good, lambda i: replace(i, tilt_rad=-0.1) if i.tilt_rad is not None else i)
    findings = [f for f in check_survey(still) if f.place == "the mast"]
    assert "tilt goes from -0.10 to -0.10 rad only" in only(tuple(findings)).message
    unmoved = with_images(still, lambda i: replace(i, pan_rad=0.0) if i.pan_rad is not None else i)
    errors = [f for f in check_survey(unmoved) if f.place == "the mast"]
    assert only(tuple(errors)).severity == "error"


# wrong units


def test_angles_in_degrees(good: Survey) -> None:
    changed = with_images(
        good,
        lambda i: (
            i
            if i.pan_rad is None or i.tilt_rad is None
            else replace(i, pan_rad=math.degrees(i.pan_rad), tilt_rad=math.degrees(i.tilt_rad))
        ),
    )
    findings = check_survey(changed)
    assert [f.severity for f in findings] == ["error", "error"]
    assert all("If the angles are in degrees, write radians" in f.advice for f in findings)


def test_an_angle_outside_the_limits(good: Survey) -> None:
    first = next(i for i in good.images if i.tilt_rad is not None)
    changed = with_images(good, lambda i: replace(i, tilt_rad=1.6) if i is first else i)
    assert "outside -1.57 to 1.57 rad" in only(check_survey(changed)).message


@pytest.mark.parametrize(
    ("unit", "scale"), [("feet", 1 / 0.3048), ("millimetres", 1000.0), ("centimetres", 100.0)]
)
def test_a_station_in_other_units(good: Survey, unit: str, scale: float) -> None:
    changed = with_station(good, lambda p: replace(p, position_m=p.position_m * scale))
    finding = only(check_survey(changed))
    assert (finding.severity, finding.place) == ("error", "station.csv")
    assert f"station.csv is in {unit}" in finding.message
    named = float(finding.message.split(" times")[0].split()[-1])
    assert named == pytest.approx(scale, rel=0.01)


def test_a_drawing_in_feet(good: Survey) -> None:
    feet = {name: place / 0.3048 for name, place in good.prisms_in_rover_m.items()}
    finding = only(check_survey(replace(good, prisms_in_rover_m=feet)))
    assert "prisms_in_rover_m is in feet" in finding.message
    board = Board(10, 10, 0.08, 0.04, {n: p / 0.3048 for n, p in good.board.tapes_in_board_m.items()})
    finding = only(check_survey(replace(good, board=board)))
    assert "board.tapes_in_board_m is in feet" in finding.message


def test_a_spacing_in_feet_and_a_wrong_focal_length(good: Survey) -> None:
    board = replace(good.board, spacing_m=0.08 / 0.3048, dot_diameter_m=0.04 / 0.3048)
    findings = check_survey(replace(good, board=board))
    assert len(findings) == 6
    assert all("0.3048" in f.advice for f in findings)
    cameras = dict(good.cameras)
    cameras["navcam_left"] = replace(cameras["navcam_left"], focal_px=3000)
    finding = only(check_survey(replace(good, cameras=cameras)))
    number = float(finding.message.split("focal length of ")[1].split()[0])
    assert number == pytest.approx(1290, rel=0.15)


# what disagrees


@pytest.mark.parametrize("axes", [[1, 0, 2], [0, 2, 1]])
def test_swapped_columns_of_the_station(good: Survey, axes: list[int]) -> None:
    changed = with_station(good, lambda p: replace(p, position_m=p.position_m[axes]))
    findings = check_survey(changed)
    assert "two columns of coordinates are swapped" in findings[0].message
    assert findings[0].severity == "error"


def test_swapped_columns_of_the_dots(good: Survey) -> None:
    for dots in (
        {n: replace(d, pixels_px=d.pixels_px[:, ::-1]) for n, d in good.dots.items()},
        {n: replace(d, rows=d.columns, columns=d.rows) for n, d in good.dots.items()},
    ):
        findings = [f for f in check_survey(replace(good, dots=dots)) if "in a mirror" in f.message]
        assert f"{len(dots)} of {len(dots)} images" in only(tuple(findings)).message


def test_a_moved_tape_is_reported_with_its_size(good: Survey) -> None:
    design = good.board.tapes_in_board_m
    there = {p.point: p.position_m for p in good.station if p.placement == "mast-2"}
    along = (there["b"] - there["a"]) / np.linalg.norm(design["b"] - design["a"])
    finding = only(check_survey(with_moved_tape(good, "level", "mast-2", "b", 0.02 * along)))
    assert (finding.severity, finding.place) == ("warning", "set-up level, placement mast-2")
    assert "every distance that disagrees is one of b" in finding.message
    assert "are 0.8800 m apart" in finding.message


def test_a_wrong_prism_is_named(good: Survey) -> None:
    finding = only(check_survey(with_wrong_prism(good, "level", "p3", (0.05, 0.02, -0.03))))
    assert finding.severity == "warning"
    assert "prism p3 (" in finding.message
    assert "will be left out" in finding.message


@pytest.mark.parametrize("names", [("a", "b"), ("a", "c"), ("b", "c")])
def test_exchanged_tapes_are_named(good: Survey, names: tuple[str, str]) -> None:
    other = {names[0]: names[1], names[1]: names[0]}
    changed = with_station(
        good,
        lambda p: replace(p, point=other.get(p.point, p.point)) if p.placement == "mast-2" else p,
    )
    findings = [f for f in check_survey(changed) if f.severity == "error"]
    assert findings[0].place == "set-up level, placement mast-2"
    if names != ("b", "c"):
        assert f"{names[0]} and {names[1]} are exchanged" in findings[0].message
    else:
        assert "turns its back" in findings[0].message


def test_two_boards_mixed_up(good: Survey, rig: Rig) -> None:
    findings = check_survey(with_swapped_boards(good, "level", "mast-1", "mast-8"))
    mixed = {i.name for i in good.images if i.placement in ("mast-1", "mast-8")}
    named = {f.place.split("image ")[1] for f in findings}
    assert named == mixed
    assert all(f.severity == "warning" and "Two boards may be mixed up" in f.advice for f in findings)
    findings = check_survey(with_swapped_boards(good, "level", "pancam-5m-1", "pancam-10m-3"))
    mixed = {i.name for i in good.images if i.placement in ("pancam-5m-1", "pancam-10m-3")}
    named = {f.place.split("image ")[1] for f in findings}
    assert named == mixed
    assert "times" in findings[0].message


def test_placements_of_a_camera_that_slipped_by_rows_are_one_error(
    good: Survey,
) -> None:
    mine = [i for i in good.images if i.camera == "navcam_left" and i.purpose == "mast"]
    half = len(mine) // 2
    slipped = {i.name: o for i, o in zip(mine, mine[half:] + mine[:half], strict=True)}
    changed = with_images(
        good,
        lambda i: (
            (
                replace(i, setup=slipped[i.name].setup, placement=slipped[i.name].placement)
                if i.name in slipped
                else i
            )
            if i.camera != "navcam_left" or i.name in slipped
            else None
        ),
    )
    named = [f for f in check_survey(changed) if "cannot show" in f.message]
    finding = only(tuple(named))
    assert finding.severity == "error" and finding.place == "camera navcam_left"
    assert f"of {len(mine)} images cannot show the board they name, e.g. {mine[0].name}" in finding.message


def with_joints(survey: Survey, read: Callable[[float, float], tuple[float, float]]) -> Survey:
    def change(image: SurveyImage) -> SurveyImage:
        if image.pan_rad is None or image.tilt_rad is None:
            return image
        pan_rad, tilt_rad = read(image.pan_rad, image.tilt_rad)
        return replace(image, pan_rad=pan_rad, tilt_rad=tilt_rad)

    return with_images(survey, change)


@pytest.mark.parametrize(
    ("read", "phrase"),
    [
        (lambda p, t: (-p, t), "the sign of pan_rad is wrong:"),
        (lambda p, t: (p, -t), "the sign of tilt_rad is wrong:"),
        (lambda p, t: (-p, -t), "the sign of pan_rad is wrong and the sign of tilt_rad is wrong:"),
        (lambda p, t: (t, p), "pan_rad and tilt_rad are exchanged:"),
        (lambda p, t: (-t, p), "pan_rad and tilt_rad are exchanged:"),
    ],
)
def test_joints_that_count_the_other_way(
    good: Survey, read: Callable[[float, float], tuple[float, float]], phrase: str
) -> None:
    finding = only(check_survey(with_joints(good, read)))
    assert finding.severity == "error"
    assert finding.message.startswith(phrase)


def test_a_board_larger_than_any_image_shows(good: Survey) -> None:
    tall = check_survey(replace(good, board=replace(good.board, rows=12)))
    assert "12 rows, 0 to 11" in only(tuple(f for f in tall if f.severity == "error")).message
    shifted = {n: replace(d, columns=d.columns + 1) for n, d in good.dots.items()}
    wide = check_survey(replace(good, dots=shifted, board=replace(good.board, columns=11)))
    assert "are in columns 1 to 10" in only(tuple(f for f in wide if f.severity == "error")).message


@pytest.mark.parametrize("shift_m", [0.05, 1.0])
def test_one_wrong_prism_is_no_matter_of_units(good: Survey, shift_m: float) -> None:
    wrong = with_wrong_prism(good, "level", "p2", (0.6 * shift_m, 0.64 * shift_m, 0.48 * shift_m))
    one_setup = with_station(wrong, lambda p: p if p.setup == "level" else None)
    one_setup = with_images(one_setup, lambda i: i if i.setup == "level" else None)
    cameras = {n: c for n, c in good.cameras.items() if c.on == "head"}
    finding = only(check_survey(replace(one_setup, cameras=cameras)))
    assert "prism p2" in finding.message


def test_images_that_share_their_dots_are_named(good: Survey) -> None:
    first, second = good.images[0].name, good.images[2].name
    dots = dict(good.dots) | {second: good.dots[first]}
    copied = [f for f in check_survey(replace(good, dots=dots)) if "very same" in f.message]
    assert f"those of image {first}" in only(tuple(copied)).message


def test_it_answers_for_any_survey_that_can_be_read(good: Survey) -> None:
    """Parts taken away at random: always an answer, never an exception."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        keep = rng.uniform(0, 1, 3)
        spoiled = with_station(good, lambda p, keep=keep: p if rng.random() < keep[0] else None)
        spoiled = with_images(spoiled, lambda i, keep=keep: i if rng.random() < keep[1] else None)
        dots = {}
        for name, found in good.dots.items():
            chosen = rng.random(len(found.rows)) < rng.choice([0.0, 0.03, keep[2], 1.0])
            if chosen.any():
                dots[name] = replace(
                    found,
                    rows=found.rows[chosen],
                    columns=found.columns[chosen],
                    pixels_px=found.pixels_px[chosen],
                )
        findings = check_survey(replace(spoiled, dots=dots))
        assert all("nan" not in str(finding) for finding in findings)
    assert check_survey(replace(good, images=(), station=(), dots={}))
