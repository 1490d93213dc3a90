"""Targets carried between two frames of Opportunity, as docs/evidence/tracking.md reports; some of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tools.flight import real_handoff
from tools.flight.mer import FlightView
from tools.flight.real_handoff import CarriedTarget, carried, level_plane, summary, targets


@pytest.fixture(scope="module")
def frames(mer_folder: Path) -> list[FlightView]:
    return real_handoff.views(mer_folder)


@pytest.fixture(scope="module")
def some(frames: list[FlightView]) -> list[CarriedTarget]:
    first, second = frames[2], frames[3]
    pixels = targets(first, second)[::6]
    return [carried(first, second, pixel, level_plane(first.camera), 0.2, 7) for pixel in pixels]


def test_nearly_all_targets_are_found_near_their_epipolar_lines(some: list[CarriedTarget]) -> None:
    found = summary(some)
    assert found["targets"] >= 20
    assert found["found"] >= 0.9 * found["targets"]
    assert found["across_worst_px"] < 2.0
    assert found["worst_px"] < 6.0


def test_ecc_finds_the_same_places(some: list[CarriedTarget]) -> None:
    found = summary(some)
    assert found["ecc_agrees"] >= 0.85 * found["found"]
    assert found["ecc_apart_median_px"] < 0.2


def test_a_target_of_another_place_is_not_found(frames: list[FlightView]) -> None:
    """The third frame's targets in the first, taken for the fourth: other ground altogether."""
    first = frames[2]
    wrong = replace(frames[3], image=frames[0].image)
    pixels = targets(first, frames[3])[::12]
    verdicts = [carried(first, wrong, p, level_plane(first.camera), 0.2, 7).verdict for p in pixels]
    assert "good" not in verdicts
