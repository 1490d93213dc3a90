"""The commands on files: numbers, JSON keys, exit codes and refusals of the contract."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from mastctl.cli.main import MODULES, main

# Cameras whose projections need no program: at the mast's origin, f = 1000, centre (320, 240), 0.2 m apart.
MAST = """\
schema: mastctl/mast/1
name: bench
mast: {translation_m: [1, 2, -3], rotation_rad: [0, 0, 0]}
cameras:
  eye_left: {on: head, size_px: [641, 481], model: CAHV, C: [0, -0.1, 0],
             A: [1, 0, 0], H: [320, 1000, 0], V: [240, 0, 1000]}
  eye_right: {on: head, size_px: [641, 481], model: CAHV, C: [0, 0.1, 0],
              A: [1, 0, 0], H: [320, 1000, 0], V: [240, 0, 1000]}
  body_left: {on: rover, size_px: [641, 481], model: CAHV, C: [0, 0, 0],
              A: [1, 0, 0], H: [320, 1000, 0], V: [240, 0, 1000]}
stereo: {eye: [eye_left, eye_right]}
fit: {rms_px: 0.1}
"""
CAMERA = """\
schema: mastctl/camera/1
frame: bench
size_px: [641, 481]
model: CAHV
C: [0, 0, 0]
A: [1, 0, 0]
H: [320, 1000, 0]
V: [240, 0, 1000]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to stand in, with a mast file, a camera file and tables."""
    monkeypatch.chdir(tmp_path)
    Path("mast.yaml").write_text(MAST)
    Path("camera.yaml").write_text(CAMERA)
    Path("points.csv").write_text("x_m,y_m,z_m\n10,1,-2\n-1,0,0\nnan,0,0\n10,100,0\n")
    Path("pixels.csv").write_text("x_px,y_px\n320,240\n1320,240\n")
    return tmp_path


class Run:
    """What a command did."""

    def __init__(self, words: str, capsys: pytest.CaptureFixture[str]) -> None:
        capsys.readouterr()
        self.code = main(words.split())
        self.out, self.err = capsys.readouterr()

    @property
    def json(self) -> Any:
        return json.loads(self.out)

    def rows(self) -> list[list[str]]:
        return [line.split(",") for line in self.out.splitlines()]


def test_project_gives_a_row_for_every_point_and_empty_cells_for_those_without_a_pixel(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run("camera project camera.yaml --points points.csv", capsys)
    assert run.code == 0
    assert run.rows() == [["x_px", "y_px"], ["420.0", "40.0"], ["", ""], ["", ""], ["10320.0", "240.0"]]
    behind, no_number = run.err.splitlines()
    assert behind.endswith(
        "row 2: (-1, 0, 0) m is 180.0 degrees from the axis of this CAHV camera, which does not see it"
    )
    assert no_number.endswith("points.csv: row 3: (nan, 0, 0) is not finite")
    assert Run("camera project camera.yaml --points points.csv --json", capsys).out == run.out


def opencv_mast(kind: str, distortion: str) -> None:
    """A mast file with a pair of one of OpenCV's lenses in the place of the folder's."""
    lens = f"""on: head
    size_px: [1280, 960]
    model: {kind}
    camera_matrix: [[900, 0, 640], [0, 900, 480], [0, 0, 1]]
    distortion: {distortion}
    rotation: [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
"""
    Path("mast.yaml").write_text(
        "schema: mastctl/mast/1\nname: lenses\nmast: {translation_m: [0, 0, 0], rotation_rad: [0, 0, 0]}\n"
        f"cameras:\n  eye_left:\n    {lens}    C: [0, -0.1, 0]\n  eye_right:\n    {lens}    C: [0, 0.1, 0]\n"
        "stereo: {eye: [eye_left, eye_right]}\n"
    )


@pytest.mark.parametrize(
    ("kind", "distortion", "pixel", "ends"),
    [
        (
            "OPENCV5",
            "[-0.31, 0.12, 0.001, -0.0007, -0.02]",
            "5000,480",
            "the lens folds at 59.0 degrees from its axis",
        ),
        ("OPENCV8", "[0, 0, 0, 0, 0, -2, 0, 0]", "", "the lens folds at 35.3 degrees from its axis"),
        (
            "OPENCV14",
            "[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1.45, 0]",
            "640,-3000",
            "plane ends 6.9 degrees from the axis",
        ),
        ("OPENCV_FISHEYE", "[-0.2, 0, 0, 0]", "5000,480", "the lens folds at 74.0 degrees from its axis"),
        ("OPENCV_FISHEYE", "[1e6, -1e6, 1e6, 1e6]", "", ""),
    ],
)
@pytest.mark.filterwarnings("error")
def test_a_row_that_the_lens_does_not_see_is_empty_with_a_sentence_of_where_the_lens_ends(
    folder: Path, capsys: pytest.CaptureFixture[str], kind: str, distortion: str, pixel: str, ends: str
) -> None:
    opencv_mast(kind, distortion)
    where = "mast.yaml --camera eye_left --pan 0 --tilt 0"
    # 0.5, 0.5 is the pole of the rational lens
    Path("points.csv").write_text("x_m,y_m,z_m\n5,0,0\n0.1,0.2,5\n1,0.4,0.5\n")
    Path("pixels.csv").write_text(f"x_px,y_px\n640,480\n{pixel or '600,400'}\n")
    project = Run(f"camera project {where} --points points.csv", capsys)
    ray = Run(f"camera ray {where} --pixels pixels.csv", capsys)
    assert (project.code, ray.code) == (0, 0)
    if ends:
        told = [line for line in project.err.splitlines() if "points.csv: row" in line]
        assert (
            f"points.csv: row 2: (0.1, 0.2, 5) m is 88.9 degrees from the axis of this {kind} camera, which"
            in told[0]
        )
        assert ends in told[0]
        assert len(told) == sum(row == ["", ""] for row in project.rows())
    assert bool(pixel) == ("pixels.csv: row" in ray.err)
    if pixel:
        assert (
            f"pixels.csv: row 2: ({pixel.replace(',', ', ')}) px has no ray in this {kind} camera: "
            in ray.err
        )
        assert ends in ray.err


def test_of_many_empty_rows_some_are_told_and_the_rest_counted(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("points.csv").write_text("x_m,y_m,z_m\n" + "-1,0,0\n" * 50)
    lines = Run("camera project camera.yaml --points points.csv", capsys).err.splitlines()
    assert len(lines) == 21
    assert lines[-1].endswith("points.csv: 30 more rows are empty, the last is row 50")


@pytest.mark.parametrize("distortion", ["[0, 0, 0, 0, 0, -2, 0, 0]", "[0, 0, 0, 0, 0, -0.3, 0, 0]"])
@pytest.mark.filterwarnings("error")
def test_two_clicks_that_meet_where_the_lens_sees_nothing_are_refused_without_nan(
    folder: Path, capsys: pytest.CaptureFixture[str], distortion: str
) -> None:
    opencv_mast("OPENCV8", distortion)
    run = Run("triangulate mast.yaml --pair eye --pan 0 --tilt 0 --left 640 480 --right 620 200", capsys)
    assert run.code == 1
    assert "the two pixels do not mean one point: their rays pass each other at 1" in run.err
    assert "where eye_left sees nothing: the lens folds at" in run.err


def test_project_with_a_mast_file_is_in_the_rover_frame_at_the_joint_angles(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Pan a quarter turn to the right: the head looks along the rover's y; its right is the rover's -x.
    Path("points.csv").write_text("x_m,y_m,z_m\n1,12,-3\n0,12,-3\n")
    run = Run(
        f"camera project mast.yaml --camera eye_left --pan {math.pi / 2!r} --tilt -0e-1 --points points.csv",
        capsys,
    )
    assert run.code == 0
    pixels = np.array(run.rows()[1:], dtype=float)
    # C is 0.1 m to the left, which is at x = 1.1 m; then the point is 0.1 m, or 1.1 m, to the right of it.
    np.testing.assert_allclose(pixels, [[330.0, 240.0], [430.0, 240.0]], rtol=0, atol=1e-9)
    body = Run("camera project mast.yaml --camera body_left --points points.csv", capsys)
    assert body.rows()[1] == ["12320.0", "-2760.0"]


def test_ray_gives_origin_and_direction(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Run("camera ray camera.yaml --pixels pixels.csv", capsys)
    assert run.code == 0
    assert run.rows()[0] == ["ox_m", "oy_m", "oz_m", "dx", "dy", "dz"]
    values = np.array(run.rows()[1:], dtype=float)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(values, [[0, 0, 0, 1, 0, 0], [0, 0, 0, half, half, 0]], rtol=0, atol=1e-15)


def test_rays_lead_back_to_their_pixels_bit_for_bit_through_csv(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(6)
    pixels = rng.uniform([0, 0], [640, 480], (200, 2))
    Path("q.csv").write_text("x_px,y_px\n" + "".join(f"{x!r},{y!r}\n" for x, y in pixels.tolist()))
    where = "mast.yaml --camera eye_right --pan -2.5 --tilt 0.3"
    rays = np.array(Run(f"camera ray {where} --pixels q.csv", capsys).rows()[1:], dtype=float)
    points = rays[:, :3] + 7.0 * rays[:, 3:]
    Path("p.csv").write_text(
        "x_m,y_m,z_m\n" + "".join(",".join(map(repr, p)) + "\n" for p in points.tolist())
    )
    back = np.array(Run(f"camera project {where} --points p.csv", capsys).rows()[1:], dtype=float)
    np.testing.assert_allclose(back, pixels, rtol=0, atol=1e-9)


def test_solve_puts_the_target_on_the_pixel(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Run("solve mast.yaml --camera eye_left --target -3 2.5 -3.5 --pixel 100 -50.5 --json", capsys)
    assert (run.code, run.err) == (0, "")
    solutions = json.loads(run.out)["solutions"]
    assert len(solutions) == 2
    Path("p.csv").write_text("x_m,y_m,z_m\n-3,2.5,-3.5\n")
    for solution in solutions:
        assert set(solution) == {"pan_rad", "tilt_rad", "range_m"}
        where = f"--pan {solution['pan_rad']!r} --tilt {solution['tilt_rad']!r}"
        pixel = Run(f"camera project mast.yaml --camera eye_left {where} --points p.csv", capsys).rows()[1]
        np.testing.assert_allclose(np.array(pixel, dtype=float), [100, -50.5], rtol=0, atol=1e-7)
        rays = f"camera ray mast.yaml --camera eye_left {where} --pixels pixels.csv"
        origin = np.array(Run(rays, capsys).rows()[1][:3], dtype=float)
        assert solution["range_m"] == pytest.approx(math.dist(origin, (-3, 2.5, -3.5)), abs=1e-9)
    assert abs(solutions[0]["tilt_rad"]) <= math.pi / 2 < abs(solutions[1]["tilt_rad"])


def test_solve_aims_at_the_image_centre_by_default(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # eye_right, aimed ahead at the mast's own height: pan carries its 0.1 m, exactly asin(0.1/10).
    best = Run("solve mast.yaml --camera eye_right --target 11 2 -3 --json", capsys).json["solutions"][0]
    assert best["pan_rad"] == pytest.approx(-math.asin(0.01), abs=1e-12)
    assert best["tilt_rad"] == pytest.approx(0.0, abs=1e-12)
    table = Run("solve mast.yaml --camera eye_right --target 11 2 -3", capsys)
    assert f"{-math.asin(0.01):.9f}" in table.out


def test_an_unreachable_target_is_a_failure_with_its_own_code(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run("solve mast.yaml --camera eye_left --target 1 2 -3.05 --json", capsys)
    assert run.code == 1
    assert json.loads(run.out)["error"]["code"] == "unreachable"
    assert json.loads(run.out)["error"]["message"]
    plain = Run("solve mast.yaml --camera eye_left --target 1 2 -3.05", capsys)
    assert (plain.code, plain.out) == (1, "")
    assert plain.err.count("\n") == 1


def test_triangulate_finds_the_point_and_how_well(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # 10 m ahead of the mast: disparity is f b / range = 20 px.
    words = "triangulate mast.yaml --pair eye --pan 0 --tilt 0 --left 330 240 --right 310 240"
    run = Run(f"{words} --json", capsys)
    assert run.code == 0
    assert set(run.json) == {"position_m", "covariance_m2", "ray_gap_m"}
    np.testing.assert_allclose(json.loads(run.out)["position_m"], [11, 2, -3], rtol=0, atol=1e-9)
    assert json.loads(run.out)["ray_gap_m"] == pytest.approx(0, abs=1e-12)
    # Range error by the paper's eq. (1): R^2/(f b) times the disparity's sigma, 0.2 px times the root of 2.
    expected = 100 / (1000 * 0.2) * 0.2 * math.sqrt(2)
    assert math.sqrt(json.loads(run.out)["covariance_m2"][0][0]) == pytest.approx(expected, rel=1e-3)
    twice = Run(f"{words} --json --sigma-px 0.4", capsys).json
    assert twice["covariance_m2"][0][0] == pytest.approx(
        4 * json.loads(run.out)["covariance_m2"][0][0], rel=1e-9
    )
    assert "11.000000" in Run(words, capsys).out


def test_rays_that_do_not_meet_are_a_failure(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "triangulate mast.yaml --pair eye --pan 0 --tilt 0 --left 310 240 --right 330 240 --json"
    run = Run(words, capsys)
    assert (run.code, json.loads(run.out)["error"]["code"]) == (1, "behind_camera")


def test_pixels_of_two_things_are_a_failure_that_says_by_how_much(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The rows are the epipolar lines: 30 rows apart at a disparity of 20 columns. The file says nothing of
    # its errors, so that 1 px is taken: with clicks of 0.2 px a row is good to the root of 2 (1 + 0.04).
    words = "triangulate mast.yaml --pair eye --pan 0 --tilt 0 --left 330 240 --right 310 270 --json"
    run = Run(words, capsys)
    assert (run.code, json.loads(run.out)["error"]["code"]) == (1, "not_one_point")
    assert "30.0 px off the epipolar line" in json.loads(run.out)["error"]["message"]
    assert f"{30 / math.sqrt(2 * 1.04):.1f} sigma" in json.loads(run.out)["error"]["message"]
    assert Run(words.replace("310 270", "310 243"), capsys).code == 0
    assert Run(f"{words} --sigma-px 10", capsys).code == 0


def test_budget_is_the_papers_table_1(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Run("budget --json", capsys)
    assert run.code == 0
    printed = {  # Table I; the two Navcam cells lost in the text are from the errata
        "pancam": (9.69, 22.22, 1.45),
        "navcam": (38.8, 43.6, 3.9),
        "hazcam": (202.17, 203.16, 10.11),
    }
    for camera in json.loads(run.out)["cameras"]:
        found = [camera[key] for key in ("stereo_cm", "untracked_cm", "tracked_cm")]
        np.testing.assert_allclose(found, printed[camera["name"]], rtol=0, atol=0.06)
    assert [camera["name"] for camera in json.loads(run.out)["cameras"]] == list(printed)
    assert "202.17" in Run("budget", capsys).out


def test_convert_names_the_lens_it_took_and_how_far_that_is_off(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = json.loads(Run("camera convert mast.yaml eye.ros.yaml --camera eye_left --json", capsys).out)
    taken = told["cameras"]["eye_left"]
    assert taken["lens"] == "plumb_bob" and taken["worst_px"] < 1e-9
    lines = Run("camera convert mast.yaml again.ros.yaml --camera eye_left", capsys).out.splitlines()
    assert lines[1].startswith("eye_left, plumb_bob: worst ") and lines[1].endswith(" px rms over the image")
    assert "cameras" not in Run("camera convert mast.yaml eye.yaml --camera eye_left --json", capsys).json


def test_convert_says_what_the_target_cannot_hold(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Run("camera convert mast.yaml eye.cahvor --camera eye_left --json", capsys)
    assert run.code == 0
    assert (json.loads(run.out)["format"], run.json["frame"]) == ("cahvor", "head")
    assert any("name of the frame ('head')" in sentence for sentence in json.loads(run.out)["lost"])
    assert any("'fit' is left out" in sentence for sentence in json.loads(run.out)["notes"])
    plain = Run("camera convert eye.cahvor eye.yaml", capsys)
    assert plain.out.splitlines() == ["eye.yaml: mastctl/camera/1, frame 'unknown'"]
    assert yaml.safe_load(Path("eye.yaml").read_text())["C"] == [0.0, -0.1, 0.0]


def test_a_conversion_in_place_keeps_the_version_before(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert Run("camera convert camera.yaml camera.yaml", capsys).code == 0
    assert Path("camera.previous.yaml").read_text() == CAMERA


def test_a_mast_file_is_not_replaced_by_one_of_its_cameras(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert Run("camera convert mast.yaml ./mast.yaml --camera eye_left", capsys).code == 2
    assert Path("mast.yaml").read_text() == MAST


WRONG_USE = [
    "",
    "slove",
    "camera",
    "camera paint",
    "solve mast.yaml",
    "solve mast.yaml --camera eye_left --target 1 2",
    "solve mast.yaml --camera eye_left --target 1 2 x",
    "solve mast.yaml --camera eye_left --target 1 2 nan",
    "solve mast.yaml --camera eye_left --target 1 2 -inf",
    "solve mast.yaml --camera eye_left --target 1 2 1_0",
    "solve mast.yaml --camera eye_lift --target 1 2 3",
    "solve mast.yaml --camera body_left --target 1 2 3",
    "solve mast.yaml --cam eye_left --target 1 2 3",
    "solve camera.yaml --camera eye_left --target 1 2 3",
    "solve absent.yaml --camera eye_left --target 1 2 3",
    "solve . --camera eye_left --target 1 2 3",
    "camera project mast.yaml --points points.csv",
    "camera project mast.yaml --camera eye_left --points points.csv",
    "camera project mast.yaml --camera eye_left --pan 0 --points points.csv",
    "camera project camera.yaml --pan 0 --tilt 0 --points points.csv",
    "camera project camera.yaml --camera eye_left --points points.csv",
    "camera project camera.yaml --points pixels.csv",
    "camera project camera.yaml --points absent.csv",
    "camera project points.csv --points points.csv",
    "camera ray camera.yaml --pixels points.csv",
    "camera convert mast.yaml out.yaml",
    "camera convert camera.yaml out.json",
    "camera convert camera.yaml absent/out.yaml",
    "triangulate mast.yaml --pair ear --pan 0 --tilt 0 --left 1 1 --right 1 1",
    "triangulate mast.yaml --pair eye --pan 0 --left 1 1 --right 1 1",
    "triangulate mast.yaml --pair eye --pan 0 --tilt 0 --left 1 1 --right 1 1 --sigma-px 0",
    "budget now",
]


@pytest.mark.parametrize("words", WRONG_USE)
def test_wrong_use_and_bad_input_end_with_2_and_one_line_and_change_nothing(
    words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    run = Run(words, capsys)
    assert (run.code, run.out) == (2, "")
    assert run.err.count("\n") == 1
    assert run.err.startswith("mastctl: ")
    told = Run(f"{words} --json", capsys)
    assert (told.code, told.err) == (2, "")
    assert told.out.count("\n") == 1
    error = told.json["error"]
    assert error["code"] in ("wrong_use", "bad_file")
    assert error["message"]
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("words", "phrases"),
    [
        ("slove", ["'slove'", "'solve'"]),
        ("solve mast.yaml --camera eye_lift --target 1 2 3", ["'eye_lift'", "'eye_left'", "mast.yaml"]),
        ("solve mast.yaml --camera eye_left --target 1 2 nan", ["'nan'", "finite"]),
        ("camera project camera.yaml --points pixels.csv", ["pixels.csv", "x_px,y_px", "x_m,y_m,z_m"]),
        ("camera project mast.yaml --camera eye_left --pan 0 --points points.csv", ["--tilt"]),
        ("solve absent.yaml --camera eye_left --target 1 2 3", ["absent.yaml", "No such file"]),
    ],
)
def test_a_refusal_names_what_is_wrong_and_what_would_be_right(
    words: str, phrases: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = Run(words, capsys).err
    assert all(phrase in error for phrase in phrases), error


def test_control_characters_of_a_file_do_not_reach_the_terminal(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("evil.csv").write_bytes(b"\x1b[31mx\x07,y\r\n")
    run = Run("camera project camera.yaml --points evil.csv", capsys)
    assert run.code == 2
    assert run.err.strip().isprintable()


def test_notes_go_to_stderr_and_stdout_stays_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("long.yaml").write_text(MAST.replace("A: [1, 0, 0]", "A: [1.001, 0, 0]"))
    run = Run("solve long.yaml --camera eye_left --target 5 2 -3 --json", capsys)
    assert run.code == 0
    assert json.loads(run.out)["solutions"]
    assert "cameras.eye_left: |A| = 1.001" in run.err


def test_a_defect_is_told_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def defect(*_: object) -> None:
        raise ZeroDivisionError("made for this test")

    monkeypatch.setattr("calib.geometry.stereo.target_approach_budget", defect)
    run = Run("budget --json", capsys)
    assert (run.code, json.loads(run.out)["error"]["code"]) == (1, "internal")


def test_every_command_helps(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ("--help", "camera --help", "camera project --help", "solve --help", "budget --help"):
        run = Run(words, capsys)
        assert run.code == 0
        assert run.out.startswith("usage: mastctl")
    assert all(command in Run("--help", capsys).out for names in MODULES.values() for command in names)
    assert Run("--version", capsys).out.startswith("mastctl ")


def _process(folder: Path, *words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "mastctl", *words], cwd=folder, capture_output=True, text=True, **options
    )


def test_a_geometry_command_does_not_load_what_it_does_not_need(folder: Path) -> None:
    script = (
        "import sys; from mastctl.cli.main import main\n"
        "code = main('solve mast.yaml --camera eye_left --target 5 2 -3 --json'.split())\n"
        "slow = {'cv2', 'numba', 'fastapi', 'httpx', 'matplotlib', 'rich', 'scipy'} & set(sys.modules)\n"
        "sys.exit(f'loaded {slow}' if slow else code)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_whole_help_loads_nothing_that_is_slow() -> None:
    script = (
        "import sys; from mastctl.cli.main import build_parser\n"
        "build_parser([])\n"
        "slow = {'numpy', 'yaml', 'cv2', 'numba', 'fastapi', 'httpx', 'rich', 'scipy'} & set(sys.modules)\n"
        "sys.exit(f'loaded {slow}' if slow else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("given", "told"),
    [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3"), ({"OMP_NUM_THREADS": "2"}, "None")],
)
def test_a_command_computes_with_one_thread_unless_it_is_told_otherwise(
    given: dict[str, str], told: str
) -> None:
    script = (
        "import os; from mastctl.cli import main as door\n"
        "door.main = lambda: print(os.environ.get('OPENBLAS_NUM_THREADS')) or 0\n"
        "door.process()"
    )
    usual = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=usual | given)
    assert done.stdout == f"{told}\n", done.stderr


def test_a_reader_that_goes_away_ends_the_command_quietly(folder: Path) -> None:
    Path("many.csv").write_text("x_m,y_m,z_m\n" + "10,1,1\n" * 100_000)
    command = [sys.executable, "-m", "mastctl", "camera", "project", "camera.yaml", "--points", "many.csv"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "x_px,y_px\n"
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait() == 141


def test_a_full_disk_is_a_failure_in_one_line(folder: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "mastctl", "budget"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["mastctl: No space left on device"]


def test_closed_streams_are_no_reason_to_fail(folder: Path) -> None:
    shell = '"$0" -m mastctl budget >&- && "$0" -m mastctl solve 2>&-; test $? = 2'
    done = subprocess.run(["sh", "-c", shell, sys.executable], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_module_runs_as_the_command_does(folder: Path) -> None:
    done = _process(folder, "budget", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(json.loads(done.stdout)["cameras"]) == 3


def test_maps_are_written_for_a_camera_and_for_a_pair(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run("camera maps mast.yaml --camera eye_left --out eye.npz --json", capsys)
    assert run.code == 0
    assert json.loads(run.out)["frame"] == "head"
    held = np.load("eye.npz")
    assert held["map_x"].dtype == np.float32
    assert held["map_x"].shape == (481, 641)
    assert 0.9 < json.loads(run.out)["shown"]["eye_left"] <= 1.0
    run = Run("camera maps mast.yaml --pair eye --out pair.npz", capsys)
    assert run.code == 0
    assert {"left_map_x", "right_map_y", "Q", "left_K"} <= set(np.load("pair.npz"))


@pytest.mark.parametrize("words", ["--camera eye_left --out a.txt", "--pair yes --out a.npz", "--out a.npz"])
def test_maps_of_nothing_are_refused(words: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert Run(f"camera maps mast.yaml {words}", capsys).code == 2
    assert not Path("a.npz").exists()
