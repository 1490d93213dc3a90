"""Stereo pairs: frames of two cameras made up with known offsets, jitter, losses and drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from drivers.v4l2.pairing import Pair, Pairing

PERIOD_S = 0.040


@dataclass(frozen=True)
class Shot:
    """A frame as pairing sees it; ``trigger`` is the truth that pairing does not look at."""

    sequence: int
    mid_exposure_s: float
    driver_sequence: int = 0
    stream: int = 1
    trigger: int = 0


def run(pairing: Pairing[Shot], left: list[Shot], right: list[Shot]) -> list[Pair[Shot]]:
    """Feed frames in the order of their times."""
    found = []
    for shot, add in sorted(
        [(s, pairing.add_left) for s in left] + [(s, pairing.add_right) for s in right],
        key=lambda item: item[0].mid_exposure_s,
    ):
        if pair := add(shot):
            found.append(pair)
    return found


def series(
    count: int, offset_s: float, jitter_s: float = 0.0, seed: int = 1, period_s: float = PERIOD_S
) -> list[Shot]:
    noise = np.random.default_rng(seed).uniform(-jitter_s, jitter_s, count)
    return [Shot(n, 10 + n * period_s + offset_s + float(noise[n]), n, 1, n) for n in range(count)]


@pytest.mark.parametrize("offset_s", [0.0, 0.003, -0.012, 0.0195, -0.0195])
def test_free_running_cameras_are_paired_with_their_offset_learned(offset_s: float) -> None:
    pairing: Pairing[Shot] = Pairing(PERIOD_S)
    pairs = run(pairing, series(100, 0.0, 0.001, 1), series(100, offset_s, 0.001, 2))
    assert len(pairs) >= 98
    assert pairing.offset_s == pytest.approx(offset_s, abs=0.0015)
    assert all(abs(pair.dt_s - offset_s) <= 0.002 for pair in pairs)


def test_each_frame_serves_one_pair() -> None:
    pairs = run(Pairing(PERIOD_S), series(60, 0.0, 0.004, 3), series(60, 0.018, 0.004, 4))
    assert len({pair.left.sequence for pair in pairs}) == len(pairs) == len({p.right.sequence for p in pairs})


def test_the_same_frame_given_again_makes_no_second_pair() -> None:
    pairing: Pairing[Shot] = Pairing(PERIOD_S)
    left, right = Shot(4, 1.0), Shot(9, 1.001)
    assert pairing.add_left(left) is None
    assert pairing.add_right(right) is not None
    assert pairing.add_right(right) is None and pairing.add_left(left) is None


def test_a_lost_frame_costs_one_pair_and_mixes_no_others() -> None:
    right = [shot for shot in series(40, 0.004) if shot.sequence not in (10, 11, 25)]
    pairs = run(Pairing(PERIOD_S), series(40, 0.0), right)
    assert len(pairs) == 37
    assert all(pair.left.trigger == pair.right.trigger for pair in pairs)


def test_frames_more_than_half_a_period_apart_are_no_pair() -> None:
    pairing: Pairing[Shot] = Pairing(PERIOD_S)
    assert pairing.add_left(Shot(1, 1.0)) is None
    assert pairing.add_right(Shot(1, 1.0 + PERIOD_S / 2 + 0.0021)) is None


def test_cameras_that_drift_past_each_other_are_paired_all_the_way() -> None:
    right = series(2000, 0.0, period_s=PERIOD_S * 1.001)  # a whole period apart after 1000 frames
    pairs = run(Pairing(PERIOD_S), series(2000, 0.0), right)
    assert len(pairs) > 1950
    assert max(abs(pair.dt_s) for pair in pairs) <= PERIOD_S / 2 + 0.002
    assert min(pair.dt_s for pair in pairs) < -0.015 and max(pair.dt_s for pair in pairs) > 0.015


def test_triggered_cameras_are_paired_by_count() -> None:
    # The right camera began to count three triggers earlier; its stamps jitter by nearly half a period.
    left = series(50, 0.0)
    noise = np.random.default_rng(8).uniform(-0.017, 0.017, 50)
    noise[0] = 0.0
    right = [Shot(n, 10 + n * PERIOD_S + float(noise[n]), n + 3, 1, n) for n in range(50)]
    pairs = run(Pairing(PERIOD_S, triggered=True), left, right)
    assert all(pair.left.trigger == pair.right.trigger for pair in pairs)
    assert len(pairs) >= 49


def test_a_missed_trigger_is_noticed_by_time() -> None:
    left = series(40, 0.0)
    kept = [shot for shot in series(40, 0.0005) if shot.sequence != 20]
    right = [Shot(n, shot.mid_exposure_s, n, 1, shot.trigger) for n, shot in enumerate(kept)]
    pairs = run(Pairing(PERIOD_S, triggered=True), left, right)
    assert all(pair.left.trigger == pair.right.trigger for pair in pairs)
    assert len(pairs) >= 37


def test_a_camera_that_was_opened_again_is_learned_anew() -> None:
    pairing: Pairing[Shot] = Pairing(PERIOD_S, triggered=True)
    run(pairing, series(20, 0.0), series(20, 0.005))
    again = [Shot(100 + n, 11 + n * PERIOD_S, n, 2, n) for n in range(20)]
    left = [Shot(25 + n, 11 + n * PERIOD_S + 0.001, 25 + n, 1, n) for n in range(20)]
    pairs = run(pairing, left, again)
    assert len(pairs) == 20 and all(pair.left.trigger == pair.right.trigger for pair in pairs)


def test_a_pair_measures_only_what_holds_still_or_moves_little_between_the_exposures() -> None:
    pair = Pair(Shot(1, 1.0), Shot(1, 1.0167), 0.0167, None)
    assert pair.may_measure(still=True)
    assert not pair.may_measure(still=False)
    assert pair.may_measure(still=False, image_speed_px_per_s=10.0)  # 0.17 px
    assert not pair.may_measure(still=False, image_speed_px_per_s=100.0)  # 1.7 px
