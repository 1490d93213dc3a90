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

from mastctl.cli.main import main

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


def test_project_gives_a_row_per_point_and_empty_cells_without_a_pixel(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run("camera project camera.yaml --points points.csv", capsys)
    assert run.code == 0
    assert run.rows() == [["x_px", "y_px"], ["420.0", "40.0"], ["", ""], ["", ""], ["10320.0", "240.0"]]
    assert run.err.startswith("points.csv: no pixel in row 2, 3: behind the camera")
    assert Run("camera project camera.yaml --points points.csv --json", capsys).out == run.out


def test_project_with_a_mast_file_is_in_the_rover_frame_at_its_angles(
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
    np.testing.assert_allclose(values, [[0, 0, 0, 1, 0, 0], [0, 0, 0, half, half, 0]], rtol=0, atol=1e-15)  # type: ignore[arg-type]


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
    assert "11, 2, -3" in Run(words, capsys).out


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


def test_convert_says_what_the_target_cannot_hold(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Run("camera convert mast.yaml eye.cahvor --camera eye_left --json", capsys)
    assert run.code == 0
    assert (json.loads(run.out)["format"], run.json["frame"]) == ("cahvor", "head")
    assert any("name of the frame ('head')" in sentence for sentence in json.loads(run.out)["lost"])
    assert any("'fit' is left out" in sentence for sentence in json.loads(run.out)["notes"])
    plain = Run("camera convert eye.cahvor eye.yaml", capsys)
    assert plain.out.splitlines() == ["eye.yaml: mastctl/camera/1, frame 'unknown'"]
    assert yaml.safe_load(Path("eye.yaml").read_text())["C"] == [0.0, -0.1, 0.0]


def test_a_mast_file_is_not_replaced_by_one_of_its_cameras(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert Run("camera convert mast.yaml ./mast.yaml --camera eye_left", capsys).code == 2
    assert Path("mast.yaml").read_text() == MAST


WRONG_USE = [
    "",
    "solve mast.yaml --camera eye_left --target 1 2 nan",
    "solve mast.yaml --camera eye_lift --target 1 2 3",
    "solve mast.yaml --camera body_left --target 1 2 3",
    "solve absent.yaml --camera eye_left --target 1 2 3",
    "camera project mast.yaml --camera eye_left --pan 0 --points points.csv",
    "camera project camera.yaml --points pixels.csv",
    "camera convert camera.yaml absent/out.yaml",
    "triangulate mast.yaml --pair eye --pan 0 --left 1 1 --right 1 1",
    "triangulate mast.yaml --pair eye --pan 0 --tilt 0 --left 1 1 --right 1 1 --sigma-px 0",
]


@pytest.mark.parametrize("words", WRONG_USE)
def test_wrong_use_and_bad_input_end_with_2_and_change_nothing(
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


def test_a_defect_is_told_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def defect(*_: object) -> None:
        raise ZeroDivisionError("made for this test")

    monkeypatch.setattr("calib.geometry.stereo.target_approach_budget", defect)
    run = Run("budget --json", capsys)
    assert (run.code, json.loads(run.out)["error"]["code"]) == (1, "internal")


def test_a_geometry_command_does_not_load_what_it_does_not_need(folder: Path) -> None:
    script = (
        "import sys; from mastctl.cli.main import main\n"
        "code = main('solve mast.yaml --camera eye_left --target 5 2 -3 --json'.split())\n"
        "slow = {'cv2', 'numba', 'fastapi', 'httpx', 'matplotlib', 'rich', 'scipy'} & set(sys.modules)\n"
        "sys.exit(f'loaded {slow}' if slow else code)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=folder, capture_output=True, text=True)
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
