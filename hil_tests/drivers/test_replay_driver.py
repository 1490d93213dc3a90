"""Replay of a small made-up recording: pointings, time, sequence, grey levels, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.errors import BadFrame, BadOptions, NoFreshFrame
from drivers.interfaces import Camera, PanTilt
from drivers.recordings.replay import NoRecording, Replay, open_replay

ANGLES = [(0.1, -0.2), (0.5, -0.2), (1.0, 0.1)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Left eye at three pointings, right eye at the first two."""
    rows = ["camera,pan_rad,tilt_rad,file"]
    for index, (pan, tilt) in enumerate(ANGLES):
        for eye in ("left", "right")[: 2 if index < 2 else 1]:
            image = np.full((6, 8), 40 * index + (5 if eye == "right" else 0), np.uint8)
            cv2.imwrite(str(tmp_path / f"{eye}{index}.png"), image)
            rows.append(f"navcam_{eye},{pan},{tilt},{eye}{index}.png")
    (tmp_path / "frames.csv").write_text("\n".join(rows) + "\n")
    return tmp_path


def opened(folder: Path, clock: ManualClock | None = None, **options: Any) -> Replay:
    return open_replay({"frames": "frames.csv", **options}, folder, clock or ManualClock(100.0))


def test_the_devices_are_those_of_the_protocols(folder: Path) -> None:
    recording = opened(folder)
    assert isinstance(recording.pan_tilt, PanTilt)
    assert sorted(recording.cameras) == ["navcam_left", "navcam_right"]
    assert all(isinstance(camera, Camera) for camera in recording.cameras.values())


def test_the_head_goes_to_the_nearest_pointing_and_reads_what_was_measured_there(folder: Path) -> None:
    recording = opened(folder)
    assert (recording.pan_tilt.read().pan_rad, recording.pan_tilt.read().tilt_rad) == ANGLES[0]
    recording.pan_tilt.move(0.5015, -0.1985, 0.3)
    reading = recording.pan_tilt.read()
    assert (reading.pan_rad, reading.tilt_rad) == ANGLES[1]
    assert not reading.moving
    assert reading.time_s == 100.0


@pytest.mark.parametrize(("pan", "refused"), [(0.5019, False), (0.5021, True)])
def test_the_tolerance_is_tested_on_both_sides(folder: Path, pan: float, refused: bool) -> None:
    head = opened(folder).pan_tilt
    if not refused:
        head.move(pan, -0.2)
        assert head.read().pan_rad == 0.5
        return
    with pytest.raises(NoRecording) as caught:
        head.move(pan, -0.2)
    assert "nearest recording is at pan 0.5, tilt -0.2 rad" in str(caught.value)
    assert caught.value.code == "no_recording"
    assert head.read().pan_rad == 0.1


def test_angles_that_are_no_numbers_are_refused(folder: Path) -> None:
    with pytest.raises(NoRecording):
        opened(folder).pan_tilt.move(float("nan"), 0.0)


def test_frames_are_exposed_after_the_asked_moment_and_counted(folder: Path) -> None:
    clock = ManualClock(100.0)
    recording = opened(folder, clock)
    camera = recording.cameras["navcam_left"]
    first = camera.next_frame(clock.now_s(), 1.0)
    assert first.mid_exposure_s - first.exposure_s / 2 > 100.0
    assert (first.image == 0).all()
    recording.pan_tilt.move(1.0, 0.1)
    moved_s = clock.now_s()
    second = camera.next_frame(moved_s, 1.0)
    assert second.mid_exposure_s - second.exposure_s / 2 > moved_s
    assert second.mid_exposure_s + second.exposure_s / 2 <= clock.now_s()
    assert second.sequence > first.sequence
    assert (second.image == 80).all()
    assert not second.image.flags.writeable
    clock.advance(10.0)
    late = camera.next_frame(moved_s, 1.0)
    assert late.mid_exposure_s > clock.now_s() - 0.2
    assert late.sequence - second.sequence == pytest.approx(100, abs=2)


def test_a_frame_begun_before_the_move_shows_the_old_pointing(folder: Path) -> None:
    clock = ManualClock(100.0)
    recording = opened(folder, clock)
    clock.advance(0.15)
    recording.pan_tilt.move(0.5, -0.2)
    clock.advance(0.01)
    assert (recording.cameras["navcam_left"].next_frame(0.0, 1.0).image == 0).all()


def test_no_frame_in_time_says_when_the_next_one_comes(folder: Path) -> None:
    clock = ManualClock(100.0)
    camera = opened(folder, clock).cameras["navcam_left"]
    with pytest.raises(NoFreshFrame, match=r"came within 0\.02 s"):
        camera.next_frame(100.0, 0.02)
    assert clock.now_s() == pytest.approx(100.02)


def test_an_eye_that_took_nothing_here_says_so(folder: Path) -> None:
    clock = ManualClock(100.0)
    recording = opened(folder, clock)
    recording.pan_tilt.move(1.0, 0.1)
    with pytest.raises(NoFreshFrame, match=r"took nothing at pan 1, tilt 0\.1"):
        recording.cameras["navcam_right"].next_frame(clock.now_s(), 1.0)


@pytest.mark.parametrize(("low_dn", "high_dn"), [(0, 4080), (800, 2840)])
def test_sixteen_bits_become_eight_by_one_scale_for_all_frames(
    folder: Path, low_dn: int, high_dn: int
) -> None:
    for index in range(3):
        image = np.linspace(1000 * index, 1000 * index + 1000, 48).reshape(6, 8).astype(np.uint16)
        cv2.imwrite(str(folder / f"left{index}.png"), image)
    clock = ManualClock(100.0)
    recording = opened(folder, clock, grey_range_dn=[low_dn, high_dn])
    recording.pan_tilt.move(0.5, -0.2)
    image = recording.cameras["navcam_left"].next_frame(clock.now_s(), 1.0).image
    assert image.dtype == np.uint8
    dn_a_level = {0: 16, 800: 8}[low_dn]
    assert (image[0, 0], image[-1, -1]) == (
        round((1000 - low_dn) / dn_a_level),
        round((2000 - low_dn) / dn_a_level),
    )
    scales = {pointing.frames["navcam_left"].scale for pointing in opened(folder).pointings}
    assert len(scales) == 1


def test_a_file_that_is_gone_is_a_bad_frame(folder: Path) -> None:
    clock = ManualClock(100.0)
    recording = opened(folder, clock)
    (folder / "left1.png").unlink()
    recording.pan_tilt.move(0.5, -0.2)
    with pytest.raises(BadFrame, match=r"left1\.png"):
        recording.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "one of options.recording, options.products and options.frames"),
        (
            {"frames": "frames.csv", "products": "*.IMG"},
            "one of options.recording, options.products and options.frames",
        ),
        ({"frame": "frames.csv"}, "did you mean 'frames'"),
        ({"frames": 3}, "path of a CSV"),
        ({"frames": "missing.csv"}, "missing.csv"),
        ({"frames": "frames.csv", "camera": "navcam_left"}, "name their own"),
        ({"frames": "frames.csv", "tolerance_rad": 0}, "options.tolerance_rad is 0"),
        ({"frames": "frames.csv", "tolerance_rad": "wide"}, "options.tolerance_rad is 'wide'"),
        ({"frames": "frames.csv", "grey_range_dn": [5, 5]}, "options.grey_range_dn is [5, 5]"),
        ({"products": "*.IMG"}, "options.camera is missing"),
        ({"products": "*.IMG", "camera": "navcam_left"}, "no file matches"),
        ({"products": 7, "camera": "navcam_left"}, "list of files or a pattern"),
        ({"products": [], "camera": "navcam_left"}, "empty"),
        ({"products": ["left0.png"], "camera": "navcam_left"}, "left0.png"),
    ],
)
def test_options_that_make_no_recording_are_refused_in_one_line(
    folder: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(BadOptions) as caught:
        open_replay(options, folder, ManualClock())
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("navcam_left,0.3,0.0", "row 6: 3 cells where 4"),
        ("navcam_left,far,0.0,left0.png", "row 6, pan_rad: 'far' where an angle"),
        ("navcam_left,0.0,far,left0.png", "row 6, tilt_rad: 'far' where an angle"),
        ("navcam_left,nan,0.0,left0.png", "'nan' where an angle"),
        ("navcam_left,7.1,0.0,left0.png", "'7.1' where an angle"),
        (",0.3,0.0,left0.png", "a camera and a file"),
        ("navcam_left,0.3,0.0,frames.csv", "no image that can be read"),
        ("navcam_left,0.3,0.0,none.png", "none.png"),
        ("navcam_left,0.1,-0.2,left1.png", "same angles"),
        ("navcam_left,0.3,0.0,big.png", "8 x 6 is expected"),
    ],
)
def test_a_malformed_row_is_refused_with_its_place(folder: Path, line: str, words: str) -> None:
    cv2.imwrite(str(folder / "big.png"), np.zeros((20, 30), np.uint8))
    table = folder / "frames.csv"
    table.write_text(table.read_text() + line + "\n")
    with pytest.raises(BadOptions) as caught:
        opened(folder)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe\x00", b"a,b\n1,2\n", b'camera,pan_rad,tilt_rad,file\n"x']
)
def test_a_table_that_is_none_is_refused(folder: Path, content: bytes) -> None:
    (folder / "frames.csv").write_bytes(content)
    with pytest.raises(BadOptions):
        opened(folder)
