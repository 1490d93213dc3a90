"""Targets carried between two frames of Opportunity, as docs/evidence/tracking.md reports; some of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.flight import real_handoff
from tools.flight.mer import FlightView
from tools.flight.real_handoff import CarriedTarget, carried, level_plane, targets, told


@pytest.fixture(scope="module")
def frames(mer_folder: Path) -> list[FlightView]:
    return real_handoff.views(mer_folder)


@pytest.fixture(scope="module")
def some(frames: list[FlightView]) -> list[CarriedTarget]:
    first, second = frames[2], frames[3]
    pixels = targets(first, second)[::6]
    return [carried(first, second, pixel, level_plane(first.camera), 0.2, 7) for pixel in pixels]


def test_nearly_all_targets_are_found_near_their_epipolar_lines(some: list[CarriedTarget]) -> None:
    found = told(some)
    assert found["targets"] >= 20
    assert found["found"] >= 0.9 * found["targets"]
    assert found["across_worst_px"] < 2.0
    assert found["worst_px"] < 6.0


def test_ecc_finds_the_same_places(some: list[CarriedTarget]) -> None:
    found = told(some)
    assert found["ecc_agrees"] >= 0.85 * found["found"]
    assert found["ecc_apart_median_px"] < 0.2


def test_a_target_of_another_place_is_not_found(frames: list[FlightView]) -> None:
    """The third frame's targets in the first, taken for the fourth: other ground altogether."""
    first = frames[2]
    wrong = replace(frames[3], image=frames[0].image)
    pixels = targets(first, frames[3])[::12]
    verdicts = [carried(first, wrong, p, level_plane(first.camera), 0.2, 7).verdict for p in pixels]
    assert "good" not in verdicts


def test_a_folder_without_the_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="holds 0 frames"):
        real_handoff.views(tmp_path)


def test_residuals_are_summed_by_hand() -> None:
    here, nowhere = np.zeros(2), np.full(2, np.nan)

    def one(verdict: str, x: float, y: float, ecc: np.ndarray) -> CarriedTarget:
        return CarriedTarget(here, here, np.eye(2), verdict, "", np.array([x, y]), y, ecc)

    found = told(
        [
            one("good", 3.0, 0.0, np.array([3.1, 0.0])),
            one("misfit", 0.0, 4.0, nowhere),
            one("weak", *nowhere, nowhere),
        ]
    )
    assert found["verdicts"] == {"good": 1, "misfit": 1, "weak": 1}
    assert found["rms_px"] == pytest.approx([np.sqrt(4.5), np.sqrt(8.0)])
    assert (found["worst_px"], found["across_worst_px"], found["ecc_agrees"]) == (4.0, 4.0, 1)
    assert found["ecc_apart_rms_px"] == pytest.approx([0.1, 0.0])
