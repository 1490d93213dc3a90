"""How strongly pointings speak against the mast file, judged as often as one likes.

The residuals of n pointings are expected to be Gaussian about zero with the covariance S = R + J C Jᵀ: R
differs from pointing to pointing, C is the mast file's own covariance, whose error all of them share. Against
that stand: one camera was turned by some angle, of which nothing is known but its usual size; or everything
is some times as wrong as expected. The ratio of the likelihoods, averaged over all of these, has the mean 1
while the mast file holds, and is a martingale as pointings come in: the chance that it *ever* reaches k is at
most 1/k (Ville's inequality; Ramdas et al., "Game-theoretic statistics and safe anytime-valid inference",
2023). So it may be judged after each pointing, and the false alarms do not add up.

The pointings enter by sums only (`Sums`), which add up over time. What is judged of one is not the whole
residual but what is left of it beside the joints: where the picture shows the target, less where position,
mast file and *measured* joint angles put it. A servo that stops a count short is a matter of the servo, not
of the calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, TypeAdapter, with_config

from calib.errors import CalibError
from calib.files.mast_file import StoredRig
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import JOINT_NAMES, click_rates, pixel_rates
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, ReadOnlyArrays, tangents
from drivers.interfaces import COARSE_COUNT_RAD
from mastctl.answers import MeasuredPointing
from mastctl.control.operations import Operation
from mastctl.watch.journal import Journal

DISAGREE = "eyes_disagree"


@with_config(ConfigDict(extra="forbid", allow_inf_nan=False))
class Measured(MeasuredPointing):
    """A pointing of which a new image was taken, as the journal has it."""


measured_of = TypeAdapter(Measured).validate_python
"""Returns the pointing of a line of the journal; raises ValueError for anything else."""


def measured_by(operation: Operation, mast: StoredRig, time_s: float) -> Measured | None:
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
        return measured_of(
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


FILE = "pointings.jsonl"
MOST_BYTES = 4 << 20
"""At which the file is written anew with what still counts; some 6000 pointings."""


def pointing_journal(folder: Path) -> Journal[Measured]:
    """Return the journal of pointings in a state folder."""
    return Journal(folder / FILE, "pointings", dict, measured_of, most_bytes=MOST_BYTES)


TURN_RAD = 2e-3
"""Usual size of a bump, about each axis."""
TIMES = (1.5, 2.0, 4.0)
"""As how many times as wrong everything may be taken."""
FAR = 3.0
"""A turn accounts for residuals if it leaves no more than so many sigma of them, rms."""


@dataclass(frozen=True, eq=False)
class Sums:
    """What some pointings say together.

    ``gram``: the sum of [H r]ᵀ R⁻¹ [H r], with H the rates, then the turns; ``first_s``: when the first was.
    """

    count: int
    gram: FloatArray
    first_s: float

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.count + other.count, self.gram + other.gram, min(self.first_s, other.first_s))

    def __sub__(self, other: Sums) -> Sums:
        return Sums(self.count - other.count, self.gram - other.gram, self.first_s)


@dataclass(frozen=True)
class Turned:
    """How far a camera seems turned: by its axes and in all, radians, with one sigma; and the evidence."""

    turn_rad: tuple[float, float, float]
    sigma_rad: tuple[float, float, float]
    size_rad: float
    size_sigma_rad: float
    log_evidence: float


@dataclass(frozen=True, eq=False)
class Evidence:
    """What some pointings say against the mast file.

    ``times``: how many times as wrong as expected everything confirmed is, rms; ``log_evidence``: natural
    logarithm of the averaged ratio, ``log_wider`` of its part that everything is some times as wrong.
    """

    count: int
    since_s: float
    times: float
    log_evidence: float
    log_wider: float
    turned: dict[str, Turned]


def sums_of(one: Expected, off_px: Sequence[float], time_s: float) -> Sums:
    """Return what a single pointing says."""
    whole = np.column_stack([one.rates, one.turned, np.array(off_px)])
    return Sums(1, whole.T @ np.linalg.inv(one.noise_px2) @ whole, time_s)


class Judge:
    """Weighs sums of pointings against one mast file, of (p, p) covariance, for turns of (c,) cameras."""

    def __init__(self, covariance: FloatArray, cameras: tuple[str, ...]) -> None:
        values, vectors = np.linalg.eigh(covariance)
        kept = values > 1e-15 * max(float(values.max(initial=0.0)), 1e-300)
        self._cameras = cameras
        self._root = vectors[:, kept] * np.sqrt(values[kept])  # covariance = root rootᵀ
        self._size = len(covariance)

    def weigh(self, sums: Sums, confirmed: Sums | None = None) -> Evidence:
        """Return what pointings say.

        ``confirmed``: those of them that are no false matches for sure, all by default: only they can say
        that everything is wider. A turn has to account for all.
        """
        reduced = self._reduced(sums)
        normal, right, square = reduced[:-1, :-1], reduced[:-1, -1], float(reduced[-1, -1])
        count, first_s, turned = sums.count, sums.first_s, {}
        for number, camera in enumerate(self._cameras):
            part = slice(3 * number, 3 * number + 3)
            one = _turned(normal[part, part], right[part])
            left = square - float(right[part] @ one.turn_rad)
            accounts = left <= FAR**2 * 2 * sums.count
            turned[camera] = one if accounts else replace(one, log_evidence=min(0.0, one.log_evidence))
        if confirmed is not None:
            sums, square = confirmed, float(self._reduced(confirmed)[-1, -1])
        wider = [-2 * sums.count * math.log(times) + 0.5 * square * (1.0 - times**-2) for times in TIMES]
        log_wider = _log_mean(wider)
        log_evidence = _log_mean([log_wider, *(one.log_evidence for one in turned.values())])
        times = math.sqrt(max(square, 0.0) / max(2 * sums.count, 1))
        return Evidence(count, first_s, times, log_evidence, log_wider, turned)

    def _reduced(self, sums: Sums) -> FloatArray:
        """The sums of turns and residuals, without what the mast file's own covariance explains."""
        p, root, gram = self._size, self._root, sums.gram
        inner = np.eye(root.shape[1]) + root.T @ gram[:p, :p] @ root
        across = root.T @ gram[:p, p:]
        return np.asarray(gram[p:, p:] - across.T @ np.linalg.solve(inner, across))


def _turned(normal: FloatArray, right: FloatArray) -> Turned:
    """The likeliest turn of usual size, and the ratio of the likelihoods of any and none."""
    inner = normal + np.eye(3) / TURN_RAD**2
    covariance = np.linalg.inv(inner)
    turn = covariance @ right
    log_evidence = 0.5 * float(right @ turn) - 0.5 * float(np.linalg.slogdet(inner * TURN_RAD**2)[1])
    sigma = np.sqrt(np.diag(covariance))
    x, y, z = turn.tolist()
    sx, sy, sz = sigma.tolist()
    size = math.hypot(x, y, z)
    along = turn / max(size, 1e-12)
    return Turned((x, y, z), (sx, sy, sz), size, math.sqrt(float(along @ covariance @ along)), log_evidence)


def _log_mean(logs: list[float]) -> float:
    """Logarithm of the mean of numbers that are given by their logarithms."""
    top = max(logs)
    return top + math.log(sum(math.exp(one - top) for one in logs) / len(logs))


CLICK_SIGMA_PX = 0.1
"""One sigma of a match in each camera of the pair."""
UNMODELLED_PX = 0.1
"""What no camera model describes and no match knows of, one sigma: another at each place of an image."""


@dataclass(frozen=True, eq=False)
class Expected(ReadOnlyArrays):
    """A pointing's residual by what it depends on.

    ``noise_px2``: (2, 2) what differs from pointing to pointing, matches and counts. ``rates``: (2, p) by
    each requested parameter. ``turned``: (2, 3 c) px/rad by a turn of each requested camera about x, y and z
    of the frame that it is mounted on.
    """

    noise_px2: FloatArray
    rates: FloatArray
    turned: FloatArray


def expected(rig: Rig, parameters: Sequence[str], cameras: Sequence[str], one: Measured) -> Expected:
    """Return what a pointing's residual depends on.

    ``parameters`` (p,) are names as `calib.geometry.covariance` has them; ``cameras`` (c,) those whose turns
    are of interest. Raises CalibError if the rig lacks a camera of it, or cannot have seen the target so.
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
    position_rates = _rates_of_position(rig, pair, (from_pan, from_tilt), point)
    by_click = rig.camera_in_rover(one["camera"], to_pan, to_tilt).project_jacobian(point)[1] @ position_rates
    before = by_click @ click_rates(rig, names, pair, from_pan, from_tilt, point)
    after = pixel_rates(rig, names, one["camera"], to_pan, to_tilt, point[None]).to_rig[0]
    joints = np.concatenate([before[:, -2:], after[:, -2:]], axis=1)
    sigma_rad = np.array(2 * one["count_rad"]) / math.sqrt(12.0)
    noise = (
        np.diag(np.square(one["match_sigma_px"]) + UNMODELLED_PX**2)
        + CLICK_SIGMA_PX**2 * by_click @ by_click.T
    )
    noise = noise + (joints * sigma_rad) @ (joints * sigma_rad).T
    rates = before + after
    if not (np.isfinite(rates).all() and np.isfinite(noise).all()):
        raise CalibError("the target of the pointing is nowhere that its cameras see")
    at = {name: i for i, name in enumerate(names)}
    turned = np.zeros((2, 3 * len(cameras)))
    for number, camera in enumerate(cameras):
        if camera in involved:
            model = rig.cameras[camera].model
            mine = [at[f"cameras.{camera}.{part}"] for part in parameter_names(model.kind)]
            turned[:, 3 * number : 3 * number + 3] = rates[:, mine] @ _turn_rates(model)
    return Expected(noise, rates[:, : len(parameters)], turned)


def _rates_of_position(
    rig: Rig, pair: tuple[str, str], joints_rad: tuple[float, float], point_m: FloatArray
) -> FloatArray:
    """(3, 4) metres that a pair's point moves by for a pixel of each click."""
    views = [rig.camera_in_rover(name, *joints_rad).project_jacobian(point_m)[1] for name in pair]
    pixels = np.concatenate(views)
    if not np.isfinite(pixels).all():
        raise CalibError("the pair cannot have seen the target of the pointing")
    return np.asarray(np.linalg.pinv(pixels))


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
