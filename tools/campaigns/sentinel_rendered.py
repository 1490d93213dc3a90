"""The sentinel's campaign on rendered pictures: false alarms, their noise, and which changes are told."""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib.calibrate.scene.drift import SceneDrift, ViewShift, find_drift, view_change
from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from mastctl.packaged import config_folder
from mastctl.watch.looks import view_shifts
from mastctl.watch.reference import Reference, save_reference
from tools.campaigns.sentinel_days import (
    RESTS,
    ChangedRig,
    Days,
    DaysLook,
    Surroundings,
    Weather,
    alarm,
    moved_stones,
    smaller,
    weather_of,
)

RENEWED = 25
"""Days that a reference is looked at, in surroundings of their own."""

LOOKS = 4
"""How many looks a change is given."""

CALM = {"haze": 0.05, "gain": 1.0, "noise_dn": 1.0, "blur_px": 0.0, "dirty": "", "strangers": ()}
"""The day of a reference, but for its sun."""

TURNS_RAD = (0.3e-3, 0.5e-3, 1e-3, 2e-3, 5e-3)
FOCUS = (1e-3, 2e-3, 5e-3, 1e-2)
SLIPS_RAD = (1e-3, 2e-3, 5e-3, 1e-2)


def eyes_of(name: str, by: int) -> Rig:
    """The two Navcams of a packaged mast file, in ``by`` times fewer pixels."""
    rig = load_rig(config_folder() / name).rig
    cameras = {
        eye: replace(camera, model=smaller(camera.model, by))
        for eye, camera in rig.cameras.items()
        if eye.startswith("navcam")
    }
    return replace(rig, cameras=cameras, stereo={})


@dataclass
class ViewNoise:
    """What pictures of days without a change were off by, beside what the head truly stood off."""

    views: int = 0
    silent: int = 0
    features: list[int] = field(default_factory=list)
    numbers: list[FloatArray] = field(default_factory=list)  # (4,) a view
    scatter: list[float] = field(default_factory=list)  # of a view's features, in sigmas told
    strays: list[float] = field(default_factory=list)  # part of a view's features beyond 4 sigma
    of_rest: dict[tuple[int, int], list[FloatArray]] = field(default_factory=lambda: defaultdict(list))

    def add(self, day: int, rig: Rig, shift: ViewShift, off_px: FloatArray) -> None:
        """Take in a view: how far its features were measured off the truth (n, 2)."""
        self.views += 1
        self.features.append(len(off_px))
        size_px = rig.cameras[shift.camera].model.size_px
        change = view_change(replace(shift, moved_px=off_px), size_px) if len(off_px) else None
        if change is None:
            self.silent += 1
            return
        self.numbers.append(change.numbers)
        apart = (off_px - np.median(off_px, axis=0)) / shift.sigma_px[:, None]
        sigma = 1.4826 * float(np.median(np.abs(apart)))
        self.scatter.append(sigma)
        self.strays.append(float(np.mean(np.abs(apart).max(axis=1) > 4.0 * max(sigma, 1.0))))
        self.of_rest[day, shift.pose].append(change.numbers[:2])

    def told(self) -> Iterator[str]:
        """Say it."""
        parts = np.percentile(self.features, [5, 50, 95]).round()
        yield (
            f"{self.views} views, {self.silent} of them silent; features of a view: "
            f"5 % below {parts[0]:.0f}, median {parts[1]:.0f}, 95 % below {parts[2]:.0f}"
        )
        if not self.numbers:
            return
        all_of = np.array(self.numbers)
        for k, (name, unit) in enumerate((("shift x", "px"), ("shift y", "px"), ("turn", ""), ("scale", ""))):
            rms, far, most = (
                float(np.sqrt(np.mean(all_of[:, k] ** 2))),
                float(np.percentile(np.abs(all_of[:, k]), 95)),
                float(np.abs(all_of[:, k]).max()),
            )
            words = f"{rms:.2g} rms, 95 % below {far:.2g}, largest {most:.2g} {unit}"
            yield f"  {name} of a view: {words}".rstrip()
        pairs = np.array([np.ravel(two) for two in self.of_rest.values() if len(two) == 2])
        if len(pairs) > 2:
            same = float(np.sum(pairs[:, :2] * pairs[:, 2:]) / np.sqrt(
                np.sum(pairs[:, :2] ** 2) * np.sum(pairs[:, 2:] ** 2)))  # fmt: skip
            yield f"  both eyes of a rest: correlation {same:.2f}"
        yield (
            f"  features about their view: {np.median(self.scatter):.1f} sigma in the median, 95 % below "
            f"{np.percentile(self.scatter, 95):.1f}; strays: {np.mean(self.strays):.0%}, 95 % below "
            f"{np.percentile(self.strays, 95):.0%}"
        )


class RenderedSite:
    """Surroundings with their reference look, through the sentinel's own folder and matching."""

    def __init__(self, seed: int, at: int, by: int, hour: str, folder: Path) -> None:
        self.rng = np.random.default_rng([seed, at])
        self.believed = eyes_of("masts/rocky8_simulated.yaml", by)
        true = eyes_of("sim/rocky8.yaml", by)
        self.eyes = list(true.cameras)
        self.days = Days(true, Surroundings(1000 * seed + at), RESTS)
        first = replace(weather_of(self.rng, self.eyes, {}, None), **CALM)
        self.hour_rad = first.hour_rad if hour == "same" else None
        self.then = self.days.look(self.rng, first)[0]
        self.reference: Reference = save_reference(
            folder, f"2026-01-01T00:00:{at % 60:02d}+00:00", RESTS, self.then.pictures
        )
        self._stones: dict[int, tuple[float, float] | None] = {}

    def next_day(self) -> Weather:
        """The next day's weather, stones moved since the reference included."""
        self._stones = moved_stones(self.rng, self._stones)
        return weather_of(self.rng, self.eyes, self._stones, self.hour_rad)

    def seen(self, look: DaysLook) -> tuple[list[ViewShift], SceneDrift]:
        """What the sentinel finds in a look's pictures."""
        shifts = view_shifts(self.believed, self.reference, look.pictures)
        return shifts, find_drift(self.believed, shifts)


def calm_days(days: int, seed: int, by: int, hour: str) -> int:
    """Look at days without a change; return how many false alarms there were."""
    noise, false, largest, blind, named = ViewNoise(), [], 0.0, 0, 0
    begun_s = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        site: RenderedSite | None = None
        before: SceneDrift | None = None
        for day in range(days):
            if site is None or day % RENEWED == 0:
                if site is not None:
                    site.days.close()
                site, before = RenderedSite(seed, day // RENEWED, by, hour, Path(folder)), None
                _progress(f"day {day}, {len(false)} false alarms")
            look = site.days.look(site.rng, site.next_day())[0]
            shifts, now = site.seen(look)
            for shift in shifts:
                off_px = shift.moved_px - site.days.truly_moved(site.then, look, shift)
                noise.add(day, site.believed, shift, off_px)
            largest = max(largest, *(change.sigmas for change in now.changes), 0.0)
            if alarm(before, now):
                false.append(f"day {day}: {now.sentence}")
            named += now.named is not None
            blind += not now.views
            before = now if now.views else before
    print(
        f"{days} rendered days without a change, pictures 1/{by}, hour {hour}, seed {seed}: "
        f"{len(false)} false alarms, {named} single looks that named something"
    )
    print(
        f"  largest {largest:.1f} sigma; {blind} days saw nothing they knew; "
        f"{time.process_time() - begun_s:.0f} s of processor"
    )
    for sentence in false:
        print(f"  {sentence}")
    for sentence in noise.told():
        print(sentence)
    return len(false)


def power(sites: int, seed: int, by: int, hour: str) -> None:
    """Provoke changes of many sizes and say how many are told, how soon, and named rightly."""
    told: dict[str, list[tuple[int, bool]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        for at in range(sites):
            _progress(f"site {at} of {sites}")
            site = RenderedSite(seed, 500 + at, by, hour, Path(folder))
            cases = provoked(site.rng, site.eyes)
            before: dict[str, SceneDrift] = {}
            found: dict[str, tuple[int, bool]] = {}
            for look in range(LOOKS):
                open_cases = [case for case in cases if case not in found]
                looks = site.days.look(site.rng, site.next_day(), [cases[case] for case in open_cases])
                for case, one in zip(open_cases, looks, strict=True):
                    now = site.seen(one)[1]
                    if name := alarm(before.get(case), now):
                        wanted = cases[case].name
                        found[case] = (look + 1, wanted == name or wanted in now.instead)
                    if now.views:
                        before[case] = now
            for case in cases:
                told[case].append(found.get(case, (0, False)))
            site.days.close()
    print(
        f"{sites} sites, pictures 1/{by}, hour {hour}, seed {seed}; a change is given {LOOKS} looks, "
        "two must agree"
    )
    print(f"  {'change':28s} {'told by 2':>9s} {'told':>6s} {'rightly':>8s}")
    for case, all_of in told.items():
        quick = sum(at == 2 for at, _ in all_of)
        some, right = sum(at > 0 for at, _ in all_of), sum(right for _, right in all_of)
        print(f"  {case:28s} {quick:9d} {some:6d} {right:8d}")


def provoked(rng: np.random.Generator, eyes: list[str]) -> dict[str, ChangedRig]:
    """Return a change of each kind and size, about a random axis, of a random eye or joint."""
    cases: dict[str, ChangedRig] = {}
    for size in TURNS_RAD:
        eye, axis = str(rng.choice(eyes)), rng.normal(size=3)
        turn = size * axis / np.linalg.norm(axis)
        cases[f"turned {1e3 * size:g} mrad"] = ChangedRig(turned={eye: turn}, name=f"{eye} turned")
    for part in FOCUS:
        eye, way = str(rng.choice(eyes)), float(rng.choice([-1, 1]))
        cases[f"refocused {100 * part:g} %"] = ChangedRig(focal={eye: way * part}, name=f"{eye} refocused")
    for size in SLIPS_RAD:
        joint, way = int(rng.integers(2)), float(rng.choice([-1, 1]))
        slip = (way * size, 0.0) if joint == 0 else (0.0, way * size)
        cases[f"slipped {1e3 * size:g} mrad"] = ChangedRig(
            slip=slip, name=f"{('pan', 'tilt')[joint]} slipped"
        )
    return cases


def _progress(words: str) -> None:
    sys.stderr.write(f"{words}\n")
    sys.stderr.flush()
