"""Frames of several cameras that belong together: made-up times with known offsets, jitter, losses, drift."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from drivers.frame_times import Offset, Pace, Pairing, learned
from drivers.interfaces import FrameTime

PERIOD_S = 0.040


@dataclass(frozen=True)
class Shot:
    """A frame; ``trigger`` is the truth that pairing does not look at."""

    sequence: int
    exposure_began_s: float
    trigger: int


@dataclass
class Eye:
    """A camera of made-up frames that gives, like a real one, its newest or the first to come."""

    shots: list[Shot]
    period_s: float = PERIOD_S
    trigger: str = ""
    now_s: float = 0.0

    @property
    def pace(self) -> Pace:
        seen = [shot for shot in self.shots if shot.exposure_began_s <= self.now_s][-30:]
        times = [FrameTime(shot.sequence, shot.exposure_began_s) for shot in seen]
        return Pace(self.period_s, self.trigger, times)

    def take(self, after_s: float, now_s: float) -> Shot:
        fresh = [shot for shot in self.shots if shot.exposure_began_s > after_s]
        ready = [shot for shot in fresh if shot.exposure_began_s <= now_s]
        return ready[-1] if ready else fresh[0]


def series(
    count: int,
    offset_s: float,
    jitter_s: float = 0.0,
    seed: int = 1,
    period_s: float = PERIOD_S,
    first: int = 0,
) -> list[Shot]:
    noise = np.random.default_rng(seed).uniform(-jitter_s, jitter_s, count)
    return [Shot(first + n, 10 + n * period_s + offset_s + float(noise[n]), n) for n in range(count)]


@dataclass
class Story:
    """Pairs taken one after the other, as the service takes them: asked for at odd moments."""

    left: Eye
    right: Eye
    used_s: list[float] = field(default_factory=lambda: [0.0, 0.0])
    offset: Offset | None = None
    late_s: float = 0.0

    def pair(self, asked_s: float) -> tuple[Shot, Shot]:
        self.left.now_s = self.right.now_s = asked_s
        self.offset = learned(self.left.pace, self.right.pace, self.offset)
        pairing = Pairing("left", {"right": self.offset})
        after_s = pairing.moments(max(asked_s, *self.used_s))
        eyes = {"left": self.left, "right": self.right}
        frames = {name: eyes[name].take(after_s[name], asked_s) for name in eyes}
        for _ in range(10):
            if not (after_s := pairing.again(frames)):
                self.used_s = [frames["left"].exposure_began_s, frames["right"].exposure_began_s]
                return frames["left"], frames["right"]
            now_s = max(frame.exposure_began_s for frame in frames.values())
            now_s += self.late_s  # the threads get to it late, and the newest frame may be another by then
            for name, moment_s in after_s.items():
                frames[name] = eyes[name].take(moment_s, now_s)
        raise AssertionError("no pair after ten rounds")

    def pairs(self, moments_s: list[float]) -> list[tuple[Shot, Shot]]:
        return [self.pair(moment_s) for moment_s in moments_s]


def moments(count: int, first_s: float = 11.5, seed: int = 7) -> list[float]:
    return list(first_s + np.cumsum(np.random.default_rng(seed).uniform(0.05, 0.3, count)))


def dt_s(pair: tuple[Shot, Shot]) -> float:
    return pair[1].exposure_began_s - pair[0].exposure_began_s


@pytest.mark.parametrize("offset_s", [0.0, -0.012, 0.0195])
def test_free_running_cameras_are_paired_with_their_offset_learned(offset_s: float) -> None:
    story = Story(Eye(series(400, 0.0, 0.001, 1)), Eye(series(400, offset_s, 0.001, 2)))
    pairs = story.pairs(moments(30))
    assert all(abs(dt_s(pair) - offset_s) <= 0.002 for pair in pairs)
    usual_s = learned(story.left.pace, story.right.pace).usual_s
    assert usual_s == pytest.approx(offset_s, abs=0.0015)


@pytest.mark.parametrize("late_s", [0.03, 0.05, 0.1])
def test_who_is_slower_than_the_cameras_gets_pairs_all_the_same(late_s: float) -> None:
    gone = set(range(45, 400, 3))
    right = [shot for shot in series(400, 0.012) if shot.sequence not in gone]
    pairs = Story(Eye(series(400, 0.0)), Eye(right), late_s=late_s).pairs(moments(20))
    assert all(one.trigger == other.trigger for one, other in pairs)


def test_near_half_a_period_the_same_partner_is_taken_each_time() -> None:
    """By nearest time alone it would be now the one before, now the one after."""
    story = Story(Eye(series(400, 0.0, 0.003, 3)), Eye(series(400, 0.0199, 0.003, 4)))
    pairs = story.pairs(moments(30, seed=1))
    assert len({one.trigger - other.trigger for one, other in pairs}) == 1
    usual_s = [learned(story.left.pace, story.right.pace).usual_s]
    for story.left.now_s in moments(30, seed=1):
        story.right.now_s = story.left.now_s
        usual_s.append(learned(story.left.pace, story.right.pace).usual_s)
    assert (
        len({np.sign(time_s) for time_s in usual_s if time_s is not None}) == 2
    )  # so it was the last choice that held it


@pytest.mark.parametrize("usual_s", [(-0.012, -0.003), (-0.012, 0.015), (0.003, 0.015)])
@pytest.mark.parametrize("asked_s", [7.001, 7.019, 7.021])
def test_cameras_are_asked_half_a_period_before_their_next_frames(
    asked_s: float, usual_s: tuple[float, float]
) -> None:
    offsets = {name: Offset(PERIOD_S, by_s, began_s=3.0) for name, by_s in zip("bc", usual_s, strict=True)}
    asked_after_s = Pairing("a", offsets).moments(asked_s)
    began_s = {"a": 3.0, "b": 3.0 + usual_s[0], "c": 3.0 + usual_s[1]}
    for name, moment_s in asked_after_s.items():
        periods = (moment_s - began_s[name]) / PERIOD_S
        assert periods % 1.0 == pytest.approx(0.5)
    assert asked_s <= min(asked_after_s.values()) < asked_s + PERIOD_S


def test_lost_frames_mix_no_others() -> None:
    gone = set(range(45, 300, 3))
    right = [shot for shot in series(400, 0.004) if shot.sequence not in gone]
    pairs = Story(Eye(series(400, 0.0)), Eye(right)).pairs(moments(30))
    assert all(left.trigger == right.trigger for left, right in pairs)


def test_cameras_that_drift_past_each_other_are_paired_all_the_way() -> None:
    right = series(4000, 0.0, period_s=PERIOD_S * 1.001)  # a whole period apart after 1000 frames
    story = Story(Eye(series(4000, 0.0)), Eye(right))
    pairs = story.pairs(list(np.linspace(11.5, 140.0, 150)))  # with pauses in which nothing is learned
    drift_s = 1e-3 * 0.6  # since the middle of the second from which the offset is learned
    assert max(abs(dt_s(pair)) for pair in pairs) <= PERIOD_S / 2 + 0.002 + drift_s
    assert min(map(dt_s, pairs)) < -0.015 and max(map(dt_s, pairs)) > 0.015


def test_triggered_cameras_are_paired_by_count() -> None:
    """The right camera began to count three triggers earlier; its stamps jitter by nearly half a period."""
    left = Eye(series(400, 0.0), trigger="strobe")
    right = Eye(series(400, 0.0, 0.017, 8, first=3), trigger="strobe")
    pairs = Story(left, right).pairs(moments(30))
    assert all(one.trigger == other.trigger for one, other in pairs)


def missed(trigger: int) -> list[Shot]:
    """A camera that misses a trigger counts on without a gap."""
    kept = [shot for shot in series(400, 0.0005) if shot.sequence != trigger]
    return [Shot(n, shot.exposure_began_s, shot.trigger) for n, shot in enumerate(kept)]


@pytest.mark.parametrize("which", [0, 1])
def test_a_missed_trigger_is_noticed_by_time(which: int) -> None:
    shots = [series(400, 0.0), series(400, 0.0)]
    shots[which] = missed(60)
    left, right = (Eye(made, trigger="strobe") for made in shots)
    pairs = Story(left, right).pairs(list(12.0 + np.arange(20) * 0.041))  # frames 50 to 70
    assert all(one.trigger == other.trigger for one, other in pairs)


def test_three_cameras_wait_for_the_one_that_is_last() -> None:
    pairing = Pairing("a", {"b": Offset(PERIOD_S), "c": Offset(PERIOD_S)})
    frames = {"a": Shot(1, 1.0, 0), "b": Shot(1, 1.04, 0), "c": Shot(1, 1.01, 0)}
    assert set(pairing.behind(frames)) == {"a"}
    frames["a"] = Shot(2, 1.04, 0)
    assert set(pairing.behind(frames)) == {"c"}
    frames["c"] = Shot(2, 1.05, 0)
    assert pairing.behind(frames) == {}
