"""Let the drift sentinel look at a rover's surroundings day after day: false alarms, and real changes named.

    .venv/bin/python -m tools.campaigns.sentinel --days 1000 --changes 100 --seed 1

A day, at the level of features: six rests, two eyes; each rest of the head off by chance (0.2 mrad each
joint), a mast that bends with the day's temperature (0.1 mrad), dust and dusk that leave 20 to 100 % of the
features and make the rest up to twice as uncertain as told; light that moves a rest's views together, turns
and stretches each, by what was measured in rendered pictures (``--rendered``); shadows that drag up to a
quarter of the features along by some pixels; rocks that moved, up to 20 % of the features of a view,
together, by up to 30 px; now and then (1 % of the views) another scene altogether. Each 100 days have a
reference of their own. Pixels come from this file's own formulas.

Then changes of a random kind and size: how many looks until it is told, and is it named rightly.
An alarm takes two looks one after the other that name the same. Then masts that lean slowly: told as slow?
"""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from calib.calibrate.scene.drift import SceneDrift, ViewShift, find_drift
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera
from calib.geometry.rigid import FloatArray
from mastctl.cli.output import at_least
from mastctl.watch.reference import Reference, look_line
from mastctl.watch.sentinel import slow_course, standing
from tools.campaigns.sentinel_days import RESTS, ChangedRig, about, alarm
from tools.campaigns.sentinel_rendered import calm_days, power
from tools.command import end, options

SIZE = (1024, 768)
FOCAL_PX = 1280.0
EYES_M = {"navcam_left": np.array([0.06, -0.1, -0.08]), "navcam_right": np.array([0.06, 0.1, -0.08])}
MAST_M = np.array([0.2, 0.0, -1.1])
FEATURES = 60
JOINT_SIGMA_RAD, BEND_RAD = 2e-4, 1e-4
LIGHT_PX, EYE_PX, LIGHT_TURN, LIGHT_SCALE = np.array([0.16, 0.08]), 0.03, 1e-4, 1.4e-4
"""What light moves both views of a rest, and one of them, by, turns and stretches it by beside the features'
own noise; one sigma, of rendered days at any hour (at the same hour two thirds of it)."""

SLOW_RAD, SLOW_DAYS = (2e-5, 1e-4), 60
"""How fast a mast leans, radians a day, and for how long."""

RENEWED = 100
"""Days that a reference is looked at."""

LOOKS = 12
"""How many looks a change is given."""


def rig() -> Rig:
    """The rig that is believed: two ideal eyes on an upright mast."""
    cx, cy = (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2
    cameras = {
        name: RigCamera("head", CameraModel("CAHV", SIZE, C, [1, 0, 0], [cx, FOCAL_PX, 0], [cy, 0, FOCAL_PX]))
        for name, C in EYES_M.items()
    }
    return Rig("campaign", Mast(MAST_M, np.zeros(3)), cameras)


def shown(points: FloatArray, eye: str, pan: float, tilt: float, truth: ChangedRig) -> FloatArray:
    """Pixels (n, 2) of points (n, 3) in the rover's first frame, by a pinhole and turns one after another."""
    r = truth.rover
    seen = points @ (about(2, r[2]) @ about(1, r[1]) @ about(0, r[0]))
    in_head = (seen - MAST_M) @ (about(2, pan + truth.slip[0]) @ about(1, tilt + truth.slip[1]))
    t = truth.turned.get(eye, np.zeros(3))
    x, y, z = ((in_head - EYES_M[eye]) @ (about(2, t[2]) @ about(1, t[1]) @ about(0, t[0]))).T
    f = FOCAL_PX * (1.0 + truth.focal.get(eye, 0.0))
    return np.stack([f * y / x + (SIZE[0] - 1) / 2, f * z / x + (SIZE[1] - 1) / 2], axis=1)


class FeatureSite:
    """A rover's surroundings with its reference look."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.rig = rig()
        self.pixels: dict[tuple[int, str], FloatArray] = {}
        self.points: dict[tuple[int, str], FloatArray] = {}
        self.then: dict[tuple[int, str], FloatArray] = {}
        off = rng.normal(0.0, JOINT_SIGMA_RAD, (len(RESTS), 2))
        for pose, (pan, tilt) in enumerate(RESTS):
            for eye, place in EYES_M.items():
                pixels = rng.uniform([30, 30], np.array(SIZE) - 30, (FEATURES, 2))
                y = (pixels[:, 0] - (SIZE[0] - 1) / 2) / FOCAL_PX
                z = (pixels[:, 1] - (SIZE[1] - 1) / 2) / FOCAL_PX
                ahead = np.stack([np.ones(FEATURES), y, z], axis=1)
                far = rng.uniform(2.0, 25.0, FEATURES)[:, None]
                points = MAST_M + (place + ahead * far) @ (about(2, pan) @ about(1, tilt)).T
                self.points[pose, eye] = points
                self.then[pose, eye] = shown(points, eye, *(np.array([pan, tilt]) + off[pose]), ChangedRig())

    def look(self, truth: ChangedRig) -> SceneDrift:
        """One day's look: what the sentinel finds."""
        rng = self.rng
        dust, spoil = rng.uniform(0.2, 1.0), rng.uniform(1.0, 2.0)
        bend = rng.normal(0.0, BEND_RAD, 2)
        shifts = []
        for pose, (pan, tilt) in enumerate(RESTS):
            light = rng.normal(0.0, LIGHT_PX)
            angles = np.array([pan, tilt]) + rng.normal(0.0, JOINT_SIGMA_RAD, 2) + bend
            for eye in EYES_M:
                now = shown(self.points[pose, eye], eye, *angles, truth)
                moved = now - self.then[pose, eye]
                sigma = rng.uniform(0.03, 0.15, FEATURES)
                moved = moved + spoil * sigma[:, None] * rng.normal(0, 1, moved.shape)
                arm = self.then[pose, eye] - (np.array(SIZE) - 1) / 2
                across = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
                moved += light + rng.normal(0.0, EYE_PX, 2)
                moved += rng.normal(0.0, LIGHT_TURN) * across + rng.normal(0.0, LIGHT_SCALE) * arm
                dragged = rng.random(FEATURES) < rng.uniform(0.0, 0.25)
                moved[dragged] += rng.normal(0, 1, 2) * rng.uniform(0.0, 3.0)
                if rng.random() < 0.3:
                    rocks = rng.random(FEATURES) < rng.uniform(0.0, 0.2)
                    moved[rocks] += rng.uniform(-30, 30, 2)
                if rng.random() < 0.01:
                    moved = rng.uniform(-20, 20, moved.shape)
                kept = rng.random(FEATURES) < dust
                shifts.append(
                    ViewShift(eye, pose, pan, tilt, self.then[pose, eye][kept], moved[kept], sigma[kept])
                )
        return find_drift(self.rig, shifts)


def random_change(rng: np.random.Generator) -> ChangedRig:
    """A bump, a slip, another focus or a rover that sank, from some sigmas up."""
    eye = str(rng.choice(list(EYES_M)))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    match rng.integers(5):
        case 0:
            return ChangedRig(turned={eye: direction * rng.uniform(1.0e-3, 3e-3)}, name=f"{eye} turned")
        case 1:
            return ChangedRig(
                focal={eye: float(rng.choice([-1, 1]) * rng.uniform(1e-3, 5e-3))}, name=f"{eye} refocused"
            )
        case 2:
            return ChangedRig(
                slip=(float(rng.choice([-1, 1]) * rng.uniform(1.5e-3, 5e-3)), 0.0), name="pan slipped"
            )
        case 3:
            return ChangedRig(
                slip=(0.0, float(rng.choice([-1, 1]) * rng.uniform(1.5e-3, 5e-3))), name="tilt slipped"
            )
        case _:
            level = np.array([direction[0], direction[1], 0.0])
            level /= np.linalg.norm(level)
            return ChangedRig(rover=level * rng.uniform(2e-3, 5e-3), name="rover turned")


def main() -> int:
    """Run both parts; 1 if there was a false alarm."""
    parser = options(__doc__, tasks=False)
    parser.add_argument("--days", type=at_least(0), default=1000)
    parser.add_argument("--changes", type=at_least(0), default=100)
    parser.add_argument("--rendered", action="store_true", help="full pictures of rendered days instead")
    parser.add_argument("--smaller", type=at_least(1), default=1, help="in so many times fewer pixels a side")
    parser.add_argument("--hour", choices=("any", "same"), default="any", help="of the looks, by the sun")
    args = parser.parse_args()
    if args.rendered:
        false_days = calm_days(args.days, args.seed, args.smaller, args.hour) if args.days else 0
        if args.changes:
            power(args.changes, args.seed, args.smaller, args.hour)
        return 1 if false_days else 0
    rng = np.random.default_rng(args.seed)
    site, before, false, largest = FeatureSite(rng), None, [], 0.0
    for day in range(args.days):
        if day and day % RENEWED == 0:
            site, before = FeatureSite(rng), None
        now = site.look(ChangedRig())
        largest = max(largest, *(change.sigmas for change in now.changes), 0.0)
        if alarm(before, now):
            false.append(f"day {day}: {now.sentence}")
        before = now if now.views else before
    print(
        f"{args.days} days without a change, seed {args.seed}: {len(false)} false alarms, "
        f"largest {largest:.1f} sigma"
    )
    for sentence in false:
        print(f"  {sentence}")
    told: Counter[str] = Counter()
    for _ in range(args.changes):
        truth, site, before = random_change(rng), FeatureSite(rng), None
        kind = truth.name.split()[-1] if truth.name.startswith("navcam") else truth.name
        for look in range(LOOKS):
            now = site.look(truth)
            if named := alarm(before, now):
                right = named == truth.name or truth.name in now.instead
                told[f"{kind}: {'named rightly' if right else 'named ' + named}"] += 1
                told["looks"] += look + 1
                break
            before = now if now.views else before
        else:
            told[f"{kind}: not told in {LOOKS} looks"] += 1
    found = sum(count for words, count in told.items() if "named" in words)
    print(
        f"{args.changes} changes: {found} told, "
        f"after {told.pop('looks', 0) / max(found, 1):.1f} looks in the mean"
    )
    for words, count in sorted(told.items()):
        print(f"  {words}: {count}")
    _slow(rng, args.changes // 5)
    return 1 if false else 0


def _slow(rng: np.random.Generator, masts: int) -> None:
    """Masts that lean by a little each day: are they told, as slow, and how fast?"""
    told, slow, off = 0, 0, []
    for _ in range(masts):
        site, rate = FeatureSite(rng), float(rng.choice([-1, 1])) * rng.uniform(*SLOW_RAD)
        begin = datetime(2026, 1, 1, tzinfo=UTC)
        reference = Reference(begin.isoformat(), "", RESTS, (), Path())
        looks = []
        for day in range(1, SLOW_DAYS + 1):
            now = begin + timedelta(days=day)
            drift = site.look(ChangedRig(slip=(0.0, rate * day)))
            looks.append(look_line(reference, now.isoformat(), drift))
        says = standing(reference, looks, now)
        told += says.level == "bad"
        course = slow_course(reference.time, looks, "tilt slipped")
        if "grown slowly" in says.sentence and course is not None:
            slow += 1
            off.append(course[0] / rate - 1.0)
    if masts:
        worst = f", the rate within {100 * max(map(abs, off)):.0f} %" if off else ""
        print(
            f"{masts} masts that lean by 0.02 to 0.1 mrad a day for {SLOW_DAYS} days: {told} told, "
            f"{slow} as slow{worst}"
        )


if __name__ == "__main__":
    end(main)
