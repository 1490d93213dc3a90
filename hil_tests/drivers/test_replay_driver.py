"""Replay of a small made-up recording: pointings, time, sequence, grey levels, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.errors import BadFrame, BadOptions, NoFreshFrame
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


def test_the_head_goes_to_the_nearest_recorded_pointing(folder: Path) -> None:
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
        deep = np.linspace(1000 * index, 1000 * index + 1000, 48).reshape(6, 8).astype(np.uint16)
        cv2.imwrite(str(folder / f"left{index}.png"), deep)
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
    recording.pan_tilt.move(1.0, 0.1)
    other = recording.cameras["navcam_left"].next_frame(clock.now_s(), 1.0).image
    assert other[0, 0] == round((2000 - low_dn) / dn_a_level), "one scale for all frames"


def test_a_file_that_is_gone_is_a_bad_frame(folder: Path) -> None:
    clock = ManualClock(100.0)
    recording = opened(folder, clock)
    (folder / "left1.png").unlink()
    recording.pan_tilt.move(0.5, -0.2)
    with pytest.raises(BadFrame, match=r"left1\.png"):
        recording.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("navcam_left,0.3,0.0", "row 6: 3 cells where 4"),
        ("navcam_left,far,0.0,left0.png", "row 6, pan_rad: 'far' where an angle"),
        ("navcam_left,nan,0.0,left0.png", "'nan' where an angle"),
        ("navcam_left,0.3,0.0,none.png", "none.png"),
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
