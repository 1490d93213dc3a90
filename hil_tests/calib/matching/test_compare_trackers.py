"""The comparison of trackers: its arithmetic, and the other trackers on pictures moved by a known amount."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from tools.against_others.tracker_methods import lucas_kanade, lucas_kanade_grid, match_template
from tools.against_others.trackers import TrackerRow, judged, row, verdicts

STEPS = 20


@pytest.fixture(scope="module")
def moved() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture, the same moved by whole pixels and a half (by the band-limited shift), and the shift."""
    rng = np.random.default_rng(5)
    smooth = ndimage.gaussian_filter(rng.normal(0.0, 1.0, (512, 640)), 1.5)
    picture = 128 + 35 * smooth / smooth.std()
    shift = np.array([11.5, -6.5])
    spectrum = ndimage.fourier_shift(np.fft.fft2(picture), shift[::-1])
    after = np.fft.ifft2(spectrum).real
    return *(np.clip(np.rint(one), 0, 255).astype(np.uint8) for one in (picture, after)), shift


@pytest.mark.parametrize("follow", [match_template, lucas_kanade, lucas_kanade_grid])
def test_the_others_find_a_known_shift(
    moved: tuple[np.ndarray, np.ndarray, np.ndarray], follow: Callable[..., np.ndarray | None]
) -> None:
    before, after, shift = moved
    pixel = np.array([300.0, 250.0])
    found = follow(before, pixel, after, pixel, 1.0)
    assert found is not None
    assert np.linalg.norm(found - pixel - shift) < 0.15


@pytest.mark.parametrize("follow", [match_template, lucas_kanade, lucas_kanade_grid])
def test_the_others_lose_what_is_not_there(
    moved: tuple[np.ndarray, np.ndarray, np.ndarray], follow: Callable[..., np.ndarray | None]
) -> None:
    noise = np.random.default_rng(6).integers(0, 256, moved[0].shape).astype(np.uint8)
    pixel = np.array([300.0, 250.0])
    assert follow(moved[0], pixel, noise, pixel, 1.0) is None


def test_matching_scales_its_template(moved: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    before, pixel, scale = moved[0], np.array([300.0, 250.0]), 1.25
    rows, columns = np.indices(before.shape)
    places = [(rows - pixel[1]) / scale + pixel[1], (columns - pixel[0]) / scale + pixel[0]]
    after = np.clip(np.rint(ndimage.map_coordinates(before.astype(float), places)), 0, 255).astype(np.uint8)
    found = match_template(before, pixel, after, pixel + 3.0, scale)
    assert found is not None
    assert np.linalg.norm(found - pixel) < 0.1


def tracked(errors_px: list[tuple[int, int, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels off by 0.1 px in x, but for some steps and eyes; 4 ms a step."""
    found = np.zeros((STEPS, 2, 2))
    found[..., 0] = 0.1
    for step, eye, error in errors_px:
        found[step, eye, 0] = error
    return found, np.full(STEPS, 4.0)


def test_runs_are_counted_by_hand() -> None:
    ours = [tracked([]), tracked([(3, 0, np.nan)]), tracked([]), tracked([])]
    other = [
        tracked([(19, 0, 0.7), (19, 1, 0.1)]),
        tracked([(5, 1, 6.0)]),
        tracked([(19, 1, np.nan)]),
        tracked([(7, 0, -5.5), (19, 0, np.nan)]),
    ]
    truth, pixel_m = np.zeros((4, STEPS, 2, 2)), np.full(4, 0.002)
    mine, its = (judged(runs, truth, pixel_m) for runs in (ours, other))
    first, second = row("plane", "B", "ours", mine, mine, its), row("plane", "B", "other", its, mine, its)
    assert (first.kept, first.lost, first.wrong, first.missed) == (4, 0, 0, pytest.approx(1 / 80))
    assert (second.kept, second.lost, second.wrong) == (1, 2, 2)
    assert second.drift_px == pytest.approx(0.5)
    assert second.drift_mm == pytest.approx(1.0)
    assert second.median_px == pytest.approx(0.1)
    assert second.rms_px == pytest.approx(np.sqrt((39 * 0.01 + 0.49) / 40))
    assert second.to_ours == pytest.approx(np.sqrt((39 * 0.01 + 0.49) / 40) / 0.1)
    assert (second.milliseconds, second.milliseconds_p95, first.to_match_template) == (4.0, 4.0, 1.0)


def test_ours_is_held_against_the_best_of_those_that_keep_targets() -> None:
    def one(method: str, kept: int, to_ours: float, milliseconds: float = 9.0) -> TrackerRow:
        return TrackerRow(
            "plane", "B", method, 12, kept, 0, 0, 0.0, 0.1, 0.1, 0.15, 0.3, to_ours, milliseconds, 12.0, 8.0
        )

    answers = verdicts(
        [one("ours", 12, 1.0, 11.0), one("few", 2, 1.1), one("most", 9, 1.8), one("most, assisted", 9, 3.0)]
    )
    assert [answer["met"] for answer in answers] == [False, True, False, True]


def test_without_opencv_contrib_the_worker_says_so(repository: Path) -> None:
    worker = repository / "tools" / "against_others" / "contrib_tracker.py"
    done = subprocess.run(
        [sys.executable, str(worker), "NoSuchTracker", "41"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "has no tracker NoSuchTracker; it wants opencv-contrib" in done.stderr
