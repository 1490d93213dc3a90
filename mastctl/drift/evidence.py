"""How strongly pointings and hand-offs speak against the mast file, judged as often as one likes.

A sample is a target whose position a pair of cameras gave, and the pixel at which a camera then showed it.
``off_px`` is where the image shows the target, less where position, mast file and *measured* joint angles put
it. A servo that stops a count short is a matter of the servo, not of the calibration.

    source      a sample is              its sigma                                what it shows
    pointing    the measured residual    matches, counts, the mast file's own     turns of cameras on the head
    hand-off    each camera's match      the same, and relief between the views   those of body cameras too

The ``off_px`` of n samples are expected to be Gaussian about zero with the covariance S = R + J C Jᵀ: R
differs from sample to sample, C is the mast file's own covariance, whose error all of them share. Against
that is set: one camera, or both of a pair, turned by some angle, of which nothing is known but its usual
size; or everything is some times as wrong as expected. The ratio of the likelihoods, averaged over all of
these, has the mean 1 while the mast file is valid, and is a martingale as samples come in: the chance that it
*ever* reaches k is at most 1/k (Ville's inequality; Ramdas et al., "Game-theoretic statistics and safe
anytime-valid inference", 2023). So it may be judged after each sample, and the false alarms do not add up.

Windows begin every six hours and last until now; each is judged by itself, so that what began on Tuesday is
not watered down by Monday. A window's evidence exceeds 4000 by chance in one of 4000 at most; with four
windows a day that is one false alarm in a thousand days. The sample that is farthest off does not count in a
window: one false match is no drift.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import groupby
from typing import Literal

import numpy as np
from pydantic import TypeAdapter

from calib.errors import CalibError
from calib.files.mast_file import StoredRig
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import JOINT_NAMES, click_rates, pixel_rates, stored_covariance
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, tangents
from calib.geometry.stereo import triangulate
from calib.matching.handoff import MODEL_PX, MatchedHandoff
from drivers.interfaces import COARSE_COUNT_RAD
from mastctl.answers import MeasuredPointing, ResidualVerdict
from mastctl.control.operations import Operation

DISAGREE = "eyes_disagree"
HANDOFF = "hand-off"
"""In place of an operation's id."""

CLICK_SIGMA_PX = 0.1
"""One sigma of a match in each camera of a pair that pointed."""
UNMODELLED_PX = 0.1
"""What no camera model describes and no match knows of, one sigma: another at each place of an image."""

sample_of = TypeAdapter(MeasuredPointing).validate_python
"""Returns the sample of a line of the journal; raises ValueError for anything else."""


def pointing_sample(operation: Operation, mast: StoredRig, time_s: float) -> MeasuredPointing | None:
    """Return what a pointing that has ended measured; None if it was none, or measured nothing.

    One that failed because another camera did not confirm the measurement counts too: a bumped camera does
    that. Of two pointings at one target the first counts; the second starts from the first one's result.
    """
    pixel = operation.request.get("pixel")
    confirmed = operation.state == "done"
    if not isinstance(pixel, Mapping) or not (confirmed or (operation.error or {}).get("code") == DISAGREE):
        return None
    source, rig = str(pixel.get("camera")), mast.rig
    partners = [a if source == b else b for a, b in rig.stereo.values() if source in (a, b)]
    steps = {step["name"]: step["detail"] for step in reversed(operation.steps)}  # the first of each name
    try:
        rest, seen, settled, found = (steps[name] for name in ("rest", "triangulate", "settle", "measure"))
        found = steps.get("repeat", found)
        to_rad = [settled["true_pan_rad"], settled["true_tilt_rad"]]
        view = rig.camera_in_rover(found["camera"], *to_rad)
        predicted = view.project(seen["position_m"])[0].tolist()
        counts = settled.get("count_rad", {})
        return sample_of(
            {
                "time_s": time_s,
                "operation": operation.id,
                "confirmed": confirmed,
                "mast_digest": mast.digest,
                "source": source,
                "partner": partners[0],
                "camera": found["camera"],
                "from_rad": [rest["true_pan_rad"], rest["true_tilt_rad"]],
                "to_rad": to_rad,
                "position_m": seen["position_m"],
                "range_m": math.dist(seen["position_m"], view.C.tolist()),
                "residual_px": found["residual_px"],
                "off_px": [a - b for a, b in zip(found["pixel_px"], predicted, strict=True)],
                "match_sigma_px": found["sigma_px"],
                "count_rad": [counts.get(axis, COARSE_COUNT_RAD) for axis in ("pan", "tilt")],
            }
        )
    except (LookupError, TypeError, ValueError):  # it did not come so far, or could not measure a number
        return None


def handoff_samples(handoff: MatchedHandoff, mast: StoredRig, time_s: float) -> list[MeasuredPointing]:
    """Return one sample of each camera in which a hand-off found its target; none of another mast file."""
    rig, found = mast.rig, handoff.found
    if handoff.mast_digest != mast.digest:
        return []
    joints, to_joints = handoff.joints, handoff.to_joints
    samples = []
    try:
        pair = [rig.camera_in_rover(name, joints.pan_rad, joints.tilt_rad) for name in handoff.pair]
        position_m = triangulate(pair[0], pair[1], *handoff.clicks_px).position_m
        for camera, landed in found.items():
            assert landed.found_px is not None and landed.found_covariance_px2 is not None
            view = rig.camera_in_rover(camera, to_joints.pan_rad, to_joints.tilt_rad)
            off_px = (landed.found_px - view.project(position_m)[0]).tolist()
            sigma_px = np.sqrt(np.diag(landed.found_covariance_px2) + MODEL_PX**2)
            sample = {
                "time_s": time_s,
                "operation": HANDOFF,
                "confirmed": True,
                "mast_digest": mast.digest,
                "source": handoff.pair[0],
                "partner": handoff.pair[1],
                "camera": camera,
                "from_rad": [joints.pan_rad, joints.tilt_rad],
                "to_rad": [to_joints.pan_rad, to_joints.tilt_rad],
                "position_m": position_m.tolist(),
                "range_m": float(np.linalg.norm(position_m - view.C)),
                "residual_px": off_px,
                "off_px": off_px,
                "match_sigma_px": sigma_px.tolist(),
                "count_rad": 2 * [joints.sigma_rad * math.sqrt(12.0)],
                # cameras that share their clicks are samples by themselves if these vary so many times more
                "click_sigma_px": handoff.sigma_px * math.sqrt(len(found)),
            }
            samples.append(sample_of(sample))
    except (CalibError, LookupError, ValueError):  # the mast file lacks a camera, or the rays do not meet
        return []
    return samples


def expected(
    rig: Rig, parameters: Sequence[str], cameras: Sequence[str], one: MeasuredPointing
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what a sample's ``off_px`` depends on.

    First (2, 2) its noise, px²: what differs from sample to sample, matches and counts. Then (2, p) its rates
    by each of the ``parameters``, names as `calib.geometry.covariance` has them. Last (2, 3 c) px/rad by a
    turn of each of the ``cameras`` about x, y and z of the frame that it is mounted on. Raises CalibError if
    the rig lacks a camera of it, or cannot have seen the target so.
    """
    pair, involved = (one["source"], one["partner"]), {one["source"], one["partner"], one["camera"]}
    if missing := involved - set(rig.cameras):
        raise CalibError(f"the mast file has no camera {min(missing)}")
    known = set(parameters)
    free = [
        f"cameras.{name}.{part}"
        for name in involved
        for part in parameter_names(rig.cameras[name].model.kind)
    ]
    names = (*parameters, *(name for name in free if name not in known), *JOINT_NAMES)
    point = np.array(one["position_m"])
    (from_pan, from_tilt), (to_pan, to_tilt) = one["from_rad"], one["to_rad"]
    views = [rig.camera_in_rover(name, from_pan, from_tilt).project_jacobian(point)[1] for name in pair]
    if not np.isfinite(views).all():
        raise CalibError("the pair cannot have seen the target of the sample")
    position_rates = np.linalg.pinv(np.concatenate(views))  # (3, 4) m/px of the pair's clicks
    by_click = rig.camera_in_rover(one["camera"], to_pan, to_tilt).project_jacobian(point)[1] @ position_rates
    before = by_click @ click_rates(rig, names, pair, from_pan, from_tilt, point)
    after = pixel_rates(rig, names, one["camera"], to_pan, to_tilt, point[None]).to_rig[0]
    joints = np.concatenate([before[:, -2:], after[:, -2:]], axis=1)
    sigma_rad = np.array(2 * one["count_rad"]) / math.sqrt(12.0)
    noise = (
        np.diag(np.square(one["match_sigma_px"]) + UNMODELLED_PX**2)
        + one.get("click_sigma_px", CLICK_SIGMA_PX) ** 2 * by_click @ by_click.T
        + (joints * sigma_rad) @ (joints * sigma_rad).T
    )
    rates = before + after
    if not (np.isfinite(rates).all() and np.isfinite(noise).all()):
        raise CalibError("the target of the sample is nowhere that its cameras see")
    at = {name: i for i, name in enumerate(names)}
    turned = np.zeros((2, 3 * len(cameras)))
    for number, camera in enumerate(cameras):
        if camera in involved:
            model = rig.cameras[camera].model
            mine = [at[f"cameras.{camera}.{part}"] for part in parameter_names(model.kind)]
            turned[:, 3 * number : 3 * number + 3] = rates[:, mine] @ _turn_rates(model)
    return noise, rates[:, : len(parameters)], turned


def _turn_rates(model: CameraModel) -> FloatArray:
    """(p, 3) of a camera's parameters to a turn about its own place, by the axes of the model's frame."""
    rates = np.zeros((len(parameter_names(model.kind)), 3))
    for letter in dict.fromkeys(model.letters):
        if letter in "CRED":
            continue
        x, y, z = getattr(model, letter)
        follows = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # of turn x letter
        if letter in "AO":
            follows = tangents(getattr(model, letter)) @ follows
        rates[parameter_part(model.kind, letter)] = follows
    return rates


DAYS = 7
DAY_S = 86400.0
SPAN_S = 6 * 3600.0
LOG_THRESHOLD = math.log(DAY_S / SPAN_S / 1e-3)
"""Of one false alarm in a thousand days."""
FEWEST = 3
"""Samples that a judgement needs."""
KEPT = 2000
"""Newest samples that count."""
AS_LIKELY = math.log(20.0)
"""Cameras whose evidence is nearer than this to the strongest one's cannot be distinguished from it."""
TURN_RAD = 2e-3
"""Usual size of a bump, about each axis."""
TIMES = (1.5, 2.0, 4.0)
"""As how many times as wrong everything may be taken."""
FAR = 3.0
"""A turn accounts for samples if it leaves no more than so many sigma of them, rms."""


@dataclass(frozen=True, eq=False)
class Turned:
    """How far a camera, or a pair, seems turned about x, y, z (3,), radians; covariance (3, 3); evidence."""

    cameras: int
    turn_rad: FloatArray
    covariance_rad2: FloatArray
    log_evidence: float


@dataclass(frozen=True, eq=False)
class Evidence:
    """What some samples say against the mast file.

    ``times``: how many times as wrong as expected everything confirmed is, rms; ``log_evidence``: natural
    logarithm of the averaged ratio, ``log_wider`` of its part that everything is some times as wrong.
    """

    count: int
    since_s: float
    times: float
    log_evidence: float
    log_wider: float
    turned: dict[str, Turned]


def rows_of(noise: FloatArray, rates: FloatArray, turned: FloatArray, off_px: FloatArray) -> FloatArray:
    """Return (2, p + 3 c + 1) a sample's `expected` rates, turns and ``off_px`` (2,), in units of its noise.

    What samples say together is the sum of rowsᵀ rows.
    """
    whole = np.column_stack([rates, turned, off_px])
    return np.asarray(np.linalg.solve(np.linalg.cholesky(noise), whole))


class Judge:
    """Weighs samples against a mast file of (p, p) covariance, for turns of (c,) cameras.

    ``groups``: which of the cameras may have been turned together, by name.
    """

    def __init__(self, covariance: FloatArray, groups: Mapping[str, tuple[int, ...]]) -> None:
        values, vectors = np.linalg.eigh(covariance)
        kept = values > 1e-15 * max(float(values.max(initial=0.0)), 1e-300)
        self._groups = {name: [slice(3 * one, 3 * one + 3) for one in each] for name, each in groups.items()}
        self._root = vectors[:, kept] * np.sqrt(values[kept])  # covariance = root rootᵀ

    def weigh(
        self, gram: FloatArray, count: int, since_s: float, sure: tuple[FloatArray, int] | None = None
    ) -> Evidence:
        """Return what samples say: the sum of their rowsᵀ rows, how many they are, when the first was.

        ``sure``: sum and number of those that are no false matches, all by default: only they can say that
        everything is wider. A turn has to account for all.
        """
        reduced = self._reduced(gram)
        normal, right, square = reduced[:-1, :-1], reduced[:-1, -1], float(reduced[-1, -1])
        turned = {}
        for name, parts in self._groups.items():
            along = np.sum([right[a] for a in parts], axis=0)
            turn, covariance, log_one = _turned(
                np.sum([normal[a, b] for a in parts for b in parts], axis=0), along
            )
            if square - float(along @ turn) > FAR**2 * 2 * count:  # it does not account for them
                log_one = min(0.0, log_one)
            turned[name] = Turned(len(parts), turn, covariance, log_one)
        sure_count = count
        if sure is not None:
            sure_count, square = sure[1], float(self._reduced(sure[0])[-1, -1])
        wider = [-2 * sure_count * math.log(times) + 0.5 * square * (1.0 - times**-2) for times in TIMES]
        log_wider = _log_mean(wider)
        log_evidence = _log_mean([log_wider, *(one.log_evidence for one in turned.values())])
        times = math.sqrt(max(square, 0.0) / max(2 * sure_count, 1))
        return Evidence(count, since_s, times, log_evidence, log_wider, turned)

    def _reduced(self, gram: FloatArray) -> FloatArray:
        """The sum for turns and ``off_px``, without what the mast file's own covariance explains."""
        p, root = len(self._root), self._root
        inner = np.eye(root.shape[1]) + root.T @ gram[:p, :p] @ root
        across = root.T @ gram[:p, p:]
        return np.asarray(gram[p:, p:] - across.T @ np.linalg.solve(inner, across))


def _turned(normal: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """The likeliest turn of usual size, its covariance, and the ratio of the likelihoods of any and none."""
    inner = normal + np.eye(3) / TURN_RAD**2
    covariance = np.asarray(np.linalg.inv(inner), dtype=np.float64)
    turn = covariance @ right
    log_evidence = 0.5 * float(right @ turn) - 0.5 * float(np.linalg.slogdet(inner * TURN_RAD**2)[1])
    return turn, covariance, log_evidence


def _log_mean(logs: list[float]) -> float:
    """Logarithm of the mean of numbers that are given by their logarithms."""
    return float(np.logaddexp.reduce(logs)) - math.log(len(logs))


@dataclass(frozen=True, eq=False)
class Judged:
    """A sample with its `rows_of`; ``sigma_px``: (2,) of everything together; ``square``: χ² of both axes."""

    sample: MeasuredPointing
    rows: FloatArray
    sigma_px: FloatArray
    square: float


class Windows:
    """The samples of one mast file; used by one thread.

    Raises CalibError if it has no covariance, or one that is none: then nothing can be expected of it.
    """

    def __init__(self, mast: StoredRig) -> None:
        covariance = stored_covariance(mast.rig)
        if covariance is None:
            raise CalibError("the mast file does not say how sure it is (fit.covariance)")
        self.digest = mast.digest
        self._rig = mast.rig
        self._parameters = covariance.names
        self._covariance: FloatArray = covariance.covariance
        at = {name: number for number, name in enumerate(mast.rig.cameras)}
        pairs = {name: (at[left], at[right]) for name, (left, right) in mast.rig.stereo.items()}
        self._judge = Judge(covariance.covariance, {**{name: (at[name],) for name in at}, **pairs})
        self.judged: list[Judged] = []

    def add(self, one: MeasuredPointing) -> Judged | None:
        """Count a sample; None if it is of another mast file, or cannot be judged by this one."""
        if one["mast_digest"] != self.digest:
            return None
        try:
            noise, rates, turned = expected(self._rig, self._parameters, tuple(self._rig.cameras), one)
        except CalibError:
            return None
        total = noise + rates @ self._covariance @ rates.T
        off = np.array(one["off_px"])
        square = float(off @ np.linalg.solve(total, off))
        judged = Judged(one, rows_of(noise, rates, turned, off), np.sqrt(np.diag(total)), square)
        self.judged.append(judged)
        return judged

    def forget(self, now_s: float) -> None:
        """Let go of what is older than the days that count, and of what is too many."""
        oldest = math.floor((now_s - DAYS * DAY_S) / SPAN_S)
        self.judged = [one for one in self.judged if _span(one) >= oldest][-KEPT:]

    def evidence(self) -> Evidence | None:
        """Return that of the window with the strongest; None with too few samples."""
        found: Evidence | None = None
        window: list[Judged] = []
        every = sure = _gram(self.judged[:1]) * 0.0
        for _, span in groupby(sorted(self.judged, key=_span, reverse=True), _span):
            these = list(span)
            window += these
            every = every + _gram(these)
            sure = sure + _gram([one for one in these if one.sample["confirmed"]])
            if len(window) < FEWEST:
                continue
            worst = max(window, key=lambda one: one.square)
            confirmed = [one for one in window if one.sample["confirmed"] and one is not worst]
            off = _gram([worst])
            now = self._judge.weigh(
                every - off,
                len(window) - 1,
                min(one.sample["time_s"] for one in window),
                (sure - off if worst.sample["confirmed"] else sure, len(confirmed)),
            )
            if found is None or now.log_evidence > found.log_evidence:
                found = now
        return found


def _span(one: Judged) -> int:
    return math.floor(one.sample["time_s"] / SPAN_S)


def _gram(those: list[Judged]) -> FloatArray:
    """The sum of rowsᵀ rows."""
    if not those:
        return np.zeros(())
    rows = np.concatenate([one.rows for one in those])
    return np.asarray(rows.T @ rows)


TOO_FEW = f"fewer than {FEWEST} pointings with this mast file have a residual"


def verdict_of(evidence: Evidence | None, samples: int) -> ResidualVerdict:
    """Return the verdict on the evidence of the strongest window; of so many samples altogether."""
    if evidence is None:
        return no_verdict("few", TOO_FEW, samples)
    verdict = no_verdict("good", "residuals are as the mast file predicts", samples)
    if evidence.log_evidence >= LOG_THRESHOLD:
        since = datetime.fromtimestamp(evidence.since_s, UTC).isoformat(timespec="seconds")
        verdict |= {"verdict": "drifts", "sentence": _drift(evidence, since), "since": since}
    return {
        **verdict,
        "times_expected": evidence.times,
        "log10_evidence": evidence.log_evidence / math.log(10),
        "cameras": {
            name: {
                "turn_rad": one.turn_rad.tolist(),
                "sigma_rad": np.sqrt(np.diag(one.covariance_rad2)).tolist(),
                "log10_evidence": one.log_evidence / math.log(10),
            }
            for name, one in evidence.turned.items()
        },
    }


def no_verdict(
    verdict: Literal["good", "drifts", "few", "unknown"], sentence: str, samples: int = 0
) -> ResidualVerdict:
    """Return a verdict without figures."""
    return {
        "verdict": verdict, "sentence": sentence, "pointings": samples, "since": None,
        "times_expected": None, "log10_evidence": None, "log10_threshold": LOG_THRESHOLD / math.log(10),
        "cameras": {},
    }  # fmt: skip


def _drift(evidence: Evidence, since: str) -> str:
    """Which camera, about which axes by how much, since when, and what to do."""
    which = f"{evidence.count + 1} measurements since {since}"
    strongest = max(evidence.turned.values(), key=lambda one: one.log_evidence)
    if evidence.log_wider >= strongest.log_evidence:
        return (
            f"residuals are {evidence.times:.1f} times as large as the mast file, counts and matches explain "
            f"({which}), and no one camera accounts for it. Check the head's mount and gears, or calibrate "
            "again"
        )
    order = sorted(evidence.turned.items(), key=lambda item: (item[1].cameras, -item[1].log_evidence))
    likely = {name: one for name, one in order if one.log_evidence > strongest.log_evidence - AS_LIKELY}
    fewest = min(one.cameras for one in likely.values())  # a pair only if neither of its cameras explains it
    names = [name for name, one in likely.items() if one.cameras == fewest]
    strongest = likely[names[0]]
    turn, covariance = 1e3 * strongest.turn_rad, 1e6 * strongest.covariance_rad2
    size = float(np.linalg.norm(turn))
    along = turn / max(size, 1e-9)
    axes = ", ".join(f"{axis} {part:+.2f}" for axis, part in zip("xyz", turn, strict=True))
    return (
        f"{' or '.join(names)} is turned by {size:.2f} ± {math.sqrt(along @ covariance @ along):.2f} mrad "
        f"from where the mast file has it (about {axes}; {which}): check its mount, then calibrate again"
    )
