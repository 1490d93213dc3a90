"""Cameras, axes and joints of a rig corrected by features of a still scene.

A feature's place is unknown: a bearing and an inverse range from the mast's origin. It is eliminated
feature by feature (what is left of 2 m coordinates of m pictures is 2 m - 3 numbers that no place can
explain), so the normal equations have only the rig's numbers, and each rest of the head its own two angle
errors, held by what a joint repeats to. Terms enter one after another, the most significant first, as long
as one is beyond three sigma; what pictures cannot tell (where the rover is, where pan is zero, the head's
zero of tilt) is held by a prior and comes out as not seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.camera.cahvor import CameraModel
from calib.errors import NoCorrection
from calib.fit.least_squares import Normal, covariance_of, minimise
from calib.fit.significance import THREE_SIGMAS, chance, sigmas
from calib.mast.joints import JOINTS_NAMES, joints_of
from calib.mast.joints import numbers_of as joint_numbers
from calib.mast.rig import Rig, RigCamera
from calib.rigid import FloatArray, Rigid, tangents
from calib.scene.features import Feature
from calib.scene.views import View

PRIOR = {"turn": 0.02, "scale": 0.01, "r1": 0.02, "mast": 0.005, "joints": 0.005}
"""Sigma of each kind of number beforehand: radians, part of the focal length, R1."""

LEAST_RESTS, LEAST_SPAN_RAD = 8, 1.0
"""How many rests over how wide an angle tell what an axis reads wrong in the course of a turn."""

FOLDS = 4

JOINT_SIGMA_RAD = 2e-4
"""What a rest of the head is off by chance, if nothing else is told."""

PRIOR_INVERSE_M = (0.2, 1.0)
"""Mean and sigma of a feature's inverse range: it holds what the pictures leave open, no more."""

LEAST_FEATURES = 12
OUTLIER_SIGMAS = 4.0
SEEN = 0.5
"""A number is seen by the pictures if they leave less than this part of its prior's sigma."""

_BIT = 1e-6
_POINT_STEPS = 4


@dataclass(frozen=True)
class Term:
    """Numbers of the rig that enter together: their names, and what they are in words."""

    names: tuple[str, ...]
    words: str


def terms_of(rig: Rig, views: Sequence[View]) -> tuple[Term, ...]:
    """Return what pictures at these angles may correct."""
    found = []
    for name in sorted({view.camera for view in views if rig.cameras[view.camera].on == "head"}):
        camera = f"cameras.{name}"
        found.append(Term(tuple(f"{camera}.turn.{axis}" for axis in "xyz"), f"{name} turned in the head"))
        found.append(Term((f"{camera}.scale",), f"{name} has another focal length"))
        if rig.cameras[name].model.kind != "CAHV":
            found.append(Term((f"{camera}.r1",), f"{name}'s lens bends otherwise"))
    found.append(Term(("mast.axis_twist_rad",), "the tilt axis leans against the pan axis"))
    rests = {view.pose: (view.pan_rad, view.tilt_rad) for view in views}
    for axis, read in zip(("pan", "tilt"), np.array(list(rests.values())).T, strict=True):
        if len(np.unique(read)) >= LEAST_RESTS and np.ptp(read) >= LEAST_SPAN_RAD:
            found.append(Term((f"joints.{axis}.c1", f"joints.{axis}.s1"), f"{axis} reads wrong once a turn"))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class SceneFit:
    """What a scene tells of a rig.

    Attributes
    ----------
    rig
        Corrected by the terms that are significant; ``fit`` and ``provenance`` as they were.
    names, values, covariance
        The numbers that were corrected (p,), in radians, and their covariance (p, p), widened by ``scale``.
    unseen
        Names of those of them that the pictures hardly tell.
    gains
        By term in the order they were taken, the rejected last: significance in sigmas.
    pose_rad
        By rest of the head (k, 2): what its pan and tilt were off by beyond the terms.
    rms_px, median_px
        Of what no place of the features explains, before and after the terms.
    features, outliers
        Those used, and sentences of those left out.
    scale
        Chi-square over degrees of freedom; the sigmas are widened by its root where it is above 1.
    predicted_px
        Rms, before and after, of features that had no part in the correction: each part of the pictures in
        turn predicted by the others.
    """

    rig: Rig
    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    unseen: tuple[str, ...]
    gains: Mapping[str, float]
    taken: tuple[str, ...]
    pose_rad: FloatArray
    rms_px: tuple[float, float]
    median_px: tuple[float, float]
    features: tuple[Feature, ...]
    outliers: tuple[str, ...]
    scale: float
    predicted_px: tuple[float, float]


def corrected(rig: Rig, names: Sequence[str], values: FloatArray) -> Rig:
    """Return a rig with numbers added: turns about C in the head frame, twist, harmonics; radians."""
    cameras = dict(rig.cameras)
    numbers = joint_numbers(rig.joints)
    twist = rig.mast.axis_twist_rad
    turns: dict[str, FloatArray] = {}
    lenses: dict[str, dict[str, float]] = {}
    for name, value in zip(names, values, strict=True):
        if name == "mast.axis_twist_rad":
            twist += float(value)
        elif name in JOINTS_NAMES:
            numbers[JOINTS_NAMES.index(name)] += value
        elif ".turn." not in name:
            _, camera, number = name.split(".")
            lenses.setdefault(camera, {})[number] = float(value)
        else:
            camera, axis = name.removeprefix("cameras.").split(".turn.")
            turns.setdefault(camera, np.zeros(3))["xyz".index(axis)] = value
    for camera, turn in turns.items():
        held = cameras[camera]
        cameras[camera] = RigCamera(held.on, turned(held.model, turn))
    for camera, numbers_of_lens in lenses.items():
        held = cameras[camera]
        cameras[camera] = RigCamera(held.on, lensed(held.model, **numbers_of_lens))
    mast = replace(rig.mast, axis_twist_rad=twist)
    return replace(rig, cameras=cameras, mast=mast, joints=joints_of(numbers))


def turned(model: CameraModel, turn_rad: FloatArray) -> CameraModel:
    """Return a camera turned about its C by a rotation vector (3,)."""
    rotation = Rotation.from_rotvec(turn_rad).as_matrix()
    return model.moved(Rigid(rotation, model.C - rotation @ model.C))


def lensed(model: CameraModel, scale: float = 0.0, r1: float = 0.0) -> CameraModel:
    """Return a camera of a focal length longer by a part ``scale`` of itself, and of R1 larger by ``r1``."""
    a = model.A
    h, v = (letter + scale * (letter - (letter @ a) * a) for letter in (model.H, model.V))
    return replace(model, H=h, V=v, R=model.R + np.array([0.0, r1, 0.0]))


@dataclass(frozen=True, eq=False)
class _State:
    """Numbers of the terms and of the poses (p + 2k,), and the features' places (n, 3)."""

    numbers: FloatArray
    places: FloatArray


@dataclass(eq=False)
class _Scene:
    """The problem: features of views, and which numbers are free."""

    rig: Rig
    views: Sequence[View]
    features: Sequence[Feature]
    names: tuple[str, ...]
    joint_sigma_rad: float
    free: np.ndarray = field(init=False)
    """(p + 2k,) which numbers move; the others stay what they are."""

    def __post_init__(self) -> None:
        self.poses = max(view.pose for view in self.views) + 1
        self.view_of = np.concatenate([feature.views for feature in self.features])
        self.feature_of = np.repeat(np.arange(len(self.features)), [len(f.views) for f in self.features])
        self.rows = [np.flatnonzero(self.view_of == number) for number in range(len(self.views))]
        self.pixels = np.concatenate([feature.pixels_px for feature in self.features])
        covariances = np.concatenate([feature.covariances_px2 for feature in self.features])
        self.whiten = np.linalg.inv(np.linalg.cholesky(covariances))
        self.origin = self.rig.mast.translation_m
        models = self.models(np.zeros(len(self.names) + 2 * self.poses))
        self.centers = [one.C for one in models if one is not None]
        rays = [models[f.views[0]].ray(f.pixels_px[0]) for f in self.features]  # type: ignore[union-attr]
        self.ahead = np.array([ray.directions for ray in rays])
        across = np.array([tangents(one) for one in self.ahead])
        self.basis = np.stack([across[:, 0], across[:, 1], self.ahead], axis=1)
        held = np.array([PRIOR[_kind(name)] for name in self.names])
        self.prior = np.concatenate([held, np.full(2 * self.poses, self.joint_sigma_rad)])
        self.free = np.arange(len(self.prior)) >= len(self.names)

    def touched(self, at: int) -> np.ndarray:
        """Numbers of the views that a number moves."""
        if at >= len(self.names):
            return np.array([view.pose == (at - len(self.names)) // 2 for view in self.views])
        name = self.names[at]
        return np.array(
            [not name.startswith("cameras.") or name.split(".")[1] == v.camera for v in self.views]
        )

    def models(self, numbers: FloatArray, only: np.ndarray | None = None) -> list[CameraModel | None]:
        """Each view's camera in the rover frame, None for those that are not asked for."""
        count = len(self.names)
        rig = corrected(self.rig, self.names, numbers[:count]) if count else self.rig
        poses = numbers[count:].reshape(-1, 2)
        found: list[CameraModel | None] = []
        for number, view in enumerate(self.views):
            if only is not None and not only[number]:
                found.append(None)
                continue
            pan, tilt = rig.joints.true_rad((view.pan_rad, view.tilt_rad), view.approach)
            found.append(
                rig.camera_in_rover(view.camera, pan + poses[view.pose, 0], tilt + poses[view.pose, 1])
            )
        return found

    def start(self) -> FloatArray:
        """Places of the features that fit best, inverse ranges tried one after another."""
        models = self.models(np.zeros(len(self.prior)))
        best, cost = np.zeros((len(self.features), 3)), np.full(len(self.features), np.inf)
        for inverse in np.linspace(0.001, 0.7, 60):
            places = np.zeros((len(self.features), 3))
            places[:, 2] = inverse
            # the ray begins at the camera: the bearing from the mast's origin is a little beside it
            for at, feature in enumerate(self.features):
                point = self.centers[feature.views[0]] + self.ahead[at] / inverse - self.origin
                local = self.basis[at] @ point
                places[at] = local[0] / local[2], local[1] / local[2], 1.0 / max(local[2], 1e-3)
            off = self.off(models, places)[0]
            now = np.bincount(self.feature_of, (off**2).sum(axis=1))
            better = now < cost
            best[better], cost[better] = places[better], now[better]
        return best

    def off(self, models: Sequence[CameraModel | None], places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened pixels off (o, 2) and their rates (o, 2, 3) by the features' places; 0 if no camera."""
        off = np.zeros((len(self.pixels), 2))
        rates = np.zeros((len(self.pixels), 2, 3))
        for number, model in enumerate(models):
            rows = self.rows[number]
            if model is None or not len(rows):
                continue
            which = self.feature_of[rows]
            inverse = places[which, 2]
            bearing = self.basis[which, 2] + np.einsum("ni,nij->nj", places[which, :2], self.basis[which, :2])
            stretch = 1.0 / np.maximum(inverse, 1e-3)
            shown = (self.origin - model.C) * inverse[:, None] + bearing
            pixels, by_point, _ = model.project_jacobian(model.C + stretch[:, None] * shown)
            by_point = by_point * stretch[:, None, None]
            per = np.concatenate(
                [
                    np.einsum("nij,nkj->nik", by_point, self.basis[which, :2]),
                    (by_point @ (self.origin - model.C))[..., None],
                ],
                axis=2,
            )
            white = self.whiten[rows]
            off[rows] = np.einsum("nij,nj->ni", white, np.nan_to_num(pixels - self.pixels[rows], nan=1e4))
            rates[rows] = white @ np.nan_to_num(per)
        return off, rates

    def settled_places(self, models: Sequence[CameraModel | None], places: FloatArray) -> FloatArray:
        """The features' places that fit given cameras best."""
        mean, sigma = PRIOR_INVERSE_M
        for _ in range(_POINT_STEPS):
            off, rates = self.off(models, places)
            matrix = np.zeros((len(places), 3, 3))
            gradient = np.zeros((len(places), 3))
            np.add.at(matrix, self.feature_of, np.einsum("nij,nik->njk", rates, rates))
            np.add.at(gradient, self.feature_of, np.einsum("nij,ni->nj", rates, off))
            matrix[:, 2, 2] += sigma**-2
            gradient[:, 2] += (places[:, 2] - mean) / sigma**2
            places = places - np.linalg.solve(matrix, gradient[..., None])[..., 0]
            places[:, 2] = np.clip(places[:, 2], -0.01, 2.0)
        return places

    def reduced(self, state: _State) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """What no place explains (q,), its rates (q, p) by the numbers, and whose feature it is (q,)."""
        models = self.models(state.numbers)
        off, by_place = self.off(models, state.places)
        by_number = np.zeros((*off.shape, len(state.numbers)))
        for at in range(len(state.numbers)):
            moved = state.numbers.copy()
            moved[at] += _BIT
            only = self.touched(at)
            rows = np.flatnonzero(only[self.view_of])
            by_number[rows, :, at] = (
                self.off(self.models(moved, only), state.places)[0][rows] - off[rows]
            ) / _BIT
        lengths = np.bincount(self.feature_of)
        rests, rates, owners = [], [], []
        for length in np.unique(lengths):
            which = np.flatnonzero(lengths == length)
            rows = np.flatnonzero(np.isin(self.feature_of, which))
            place = by_place[rows].reshape(len(which), 2 * length, 3)
            whole, _ = np.linalg.qr(place, mode="complete")
            left = whole[..., 3:].transpose(0, 2, 1)
            rest = np.einsum("nij,nj->ni", left, off[rows].reshape(len(which), -1))
            rests.append(rest.ravel())
            rates.append(
                (left @ by_number[rows].reshape(len(which), 2 * length, -1)).reshape(-1, len(state.numbers))
            )
            owners.append(np.repeat(which, rest.shape[1]))
        return np.concatenate(rests), np.concatenate(rates), np.concatenate(owners)

    def normal(self, state: _State) -> Normal:
        """Cost and normal equations of what no place explains, and of the priors."""
        matrix, gradient = self.whole(state)
        matrix[~self.free] = matrix[:, ~self.free] = 0.0
        matrix[~self.free, ~self.free] = 1.0
        gradient[~self.free] = 0.0
        return Normal(self.cost(state), matrix, gradient)

    def whole(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """Normal matrix and gradient of all numbers, also those that do not move."""
        rest, rates, _ = self.reduced(state)
        gradient = rates.T @ rest + state.numbers / self.prior**2
        return rates.T @ rates + np.diag(self.prior**-2), gradient

    def cost(self, state: _State) -> float:
        """The cost alone."""
        off, _ = self.off(self.models(state.numbers), state.places)
        held = state.numbers / self.prior
        mean, sigma = PRIOR_INVERSE_M
        return float((off**2).sum() + held @ held + np.sum(((state.places[:, 2] - mean) / sigma) ** 2))

    def stepped(self, state: _State, step: FloatArray) -> _State:
        """The numbers moved, and the places to where they then fit best."""
        numbers = state.numbers + step
        return _State(numbers, self.settled_places(self.models(numbers), state.places))


def fit_scene(
    rig: Rig, views: Sequence[View], features: Sequence[Feature], joint_sigma_rad: float = JOINT_SIGMA_RAD
) -> SceneFit:
    """Return what features of a still scene tell of a rig.

    Parameters
    ----------
    rig
        What is believed.
    views, features
        The pictures, and what they show together (`calib.scene.features.find_features`).
    joint_sigma_rad
        What a rest of the head is off by chance, one sigma.

    Raises
    ------
    NoCorrection
        ``too_few``: fewer than twelve features; ``not_significant``: nothing is beyond three sigma.
    """
    _enough(features)
    terms = list(terms_of(rig, views))
    kept, outliers = _without_outliers(rig, views, features, terms, joint_sigma_rad)
    scene = _scene(rig, views, kept, terms, joint_sigma_rad)
    state = _solved(scene)
    before = _rest(scene, np.zeros_like(state.numbers), state.places)
    taken: list[Term] = []
    gains: dict[str, float] = {}
    while terms:
        matrix, gradient = scene.whole(state)
        freedom = max(len(scene.reduced(state)[0]) - int(scene.free[: len(scene.names)].sum()), 1)
        tried = []
        for term in terms:
            with_it = scene.free | _where(scene, [term])
            gain = gradient[with_it] @ np.linalg.solve(matrix[np.ix_(with_it, with_it)], gradient[with_it])
            left = max((scene.cost(state) - gain) / freedom, 1.0)
            tried.append((chance(max(float(gain), 0.0), len(term.names), left, freedom), term))
        by_chance, term = min(tried, key=lambda one: one[0])
        gains |= {one.words: sigmas(p) for p, one in tried}
        if by_chance > THREE_SIGMAS:
            break
        taken.append(term)
        terms.remove(term)
        scene.free |= _where(scene, [term])
        state = minimise(scene, state, steps=20, gain=1e-6).state
    if not taken:
        most = max(gains.values(), default=0.0)
        raise NoCorrection(
            "not_significant",
            f"{len(kept)} features tell no correction: {most:.1f} sigma where 3 are asked for",
        )
    predicted = _predicted_px(rig, views, kept, taken, joint_sigma_rad)
    return _told(rig, scene, state, taken, gains, before, kept, outliers, predicted)


def left_px(rig: Rig, views: Sequence[View], features: Sequence[Feature]) -> FloatArray:
    """Return what no place of the features explains as the rig stands, its size in pixels (q,)."""
    scene = _Scene(rig, views, features, (), JOINT_SIGMA_RAD)
    return np.abs(_rest(scene, np.zeros(len(scene.prior)), scene.start())) * _white_px(features)


def _scene(
    rig: Rig,
    views: Sequence[View],
    features: Sequence[Feature],
    terms: Sequence[Term],
    joint_sigma_rad: float,
) -> _Scene:
    return _Scene(rig, views, features, tuple(n for term in terms for n in term.names), joint_sigma_rad)


def _where(scene: _Scene, terms: Sequence[Term]) -> np.ndarray:
    """Which of a scene's numbers these terms have."""
    wanted = {name for term in terms for name in term.names}
    return np.array([name in wanted for name in scene.names] + [False] * (2 * scene.poses))


def _rest(scene: _Scene, numbers: FloatArray, places: FloatArray) -> FloatArray:
    """What no place explains at given numbers."""
    return scene.reduced(_State(numbers, scene.settled_places(scene.models(numbers), places)))[0]


def _predicted_px(
    rig: Rig,
    views: Sequence[View],
    features: Sequence[Feature],
    taken: Sequence[Term],
    joint_sigma_rad: float,
) -> tuple[float, float]:
    """Rms, before and after, of features of rests that the correction was made without.

    Features are parted by the two rests that they join; where all join the same two nothing can be predicted.
    """
    joined = [tuple(sorted({views[number].pose for number in feature.views})) for feature in features]
    parts = sorted(set(joined))
    fold_of = {part: at % FOLDS for at, part in enumerate(parts)}
    before, after, lengths = [], [], []
    for fold in range(min(FOLDS, len(parts))):
        tested = [f for f, part in zip(features, joined, strict=True) if fold_of[part] == fold]
        others = [f for f, part in zip(features, joined, strict=True) if fold_of[part] != fold]
        if not tested or len(others) < LEAST_FEATURES:
            continue
        scene = _scene(rig, views, others, taken, joint_sigma_rad)
        scene.free[:] = True
        numbers = _solved(scene).numbers.copy()
        numbers[len(scene.names) :] = 0.0
        test = _scene(rig, views, tested, taken, joint_sigma_rad)
        start = test.start()
        before.append(_rest(test, np.zeros_like(numbers), start))
        after.append(_rest(test, numbers, start))
        lengths.append(_white_px(tested))
    if not before:
        return np.nan, np.nan
    rms = [
        float(np.sqrt(np.mean(np.concatenate(rests) ** 2))) * float(np.mean(lengths))
        for rests in (before, after)
    ]
    return rms[0], rms[1]


def _white_px(features: Sequence[Feature]) -> float:
    """How many pixels one sigma of the features is, per axis."""
    return float(np.mean([np.sqrt(np.trace(feature.covariances_px2[-1]) / 2) for feature in features]))


def _kind(name: str) -> str:
    """What kind of number it is, as `PRIOR` has them."""
    parts = name.split(".")
    return parts[2] if parts[0] == "cameras" else parts[0]


def _enough(features: Sequence[Feature]) -> None:
    if len(features) < LEAST_FEATURES:
        raise NoCorrection(
            "too_few",
            f"{len(features)} features are in two pictures or more where {LEAST_FEATURES} are expected: "
            "pictures that overlap by a fifth, of something with texture, have them",
        )


def _solved(scene: _Scene) -> _State:
    zero = np.zeros(len(scene.prior))
    start = _State(zero, scene.settled_places(scene.models(zero), scene.start()))
    return minimise(scene, start, steps=20, gain=1e-6).state


def _without_outliers(
    rig: Rig,
    views: Sequence[View],
    features: Sequence[Feature],
    terms: Sequence[Term],
    joint_sigma_rad: float,
) -> tuple[list[Feature], list[str]]:
    """Features that fit together when every term is free, and a sentence for each of the others."""
    kept = list(features)
    sentences: list[str] = []
    for _ in range(6):
        scene = _scene(rig, views, kept, terms, joint_sigma_rad)
        scene.free[:] = True
        state = _solved(scene)
        rest, _, owners = scene.reduced(state)
        spread = max(1.0, float(np.median(np.abs(rest)) / 0.6745))
        worst = np.zeros(len(kept))
        np.maximum.at(worst, owners, np.abs(rest) / spread)
        bad = np.flatnonzero(worst > OUTLIER_SIGMAS)
        if not len(bad):
            break
        for at in bad:
            feature = kept[at]
            x, y = feature.pixels_px[0]
            names_of = ", ".join(views[number].name for number in feature.views)
            sentences.append(f"the feature at ({x:.0f}, {y:.0f}) of {names_of}: {worst[at]:.1f} sigma off")
        kept = [feature for at, feature in enumerate(kept) if at not in set(bad.tolist())]
        _enough(kept)
    return kept, sentences


def _told(
    rig: Rig,
    scene: _Scene,
    state: _State,
    taken: Sequence[Term],
    gains: Mapping[str, float],
    before: FloatArray,
    kept: Sequence[Feature],
    outliers: Sequence[str],
    predicted_px: tuple[float, float],
) -> SceneFit:
    rest, rates, _ = scene.reduced(state)
    free = scene.free[: len(scene.names)]
    scale = max(1.0, float(rest @ rest) / max(len(rest) - int(free.sum()), 1))
    part = rates[:, scene.free]
    whole = covariance_of(part.T @ part / scale + np.diag(scene.prior[scene.free] ** -2))
    names = tuple(name for name, taken_in in zip(scene.names, free, strict=True) if taken_in)
    values = state.numbers[: len(scene.names)][free]
    covariance = whole[: len(names), : len(names)]
    spread, prior = np.sqrt(np.diag(covariance)), scene.prior[: len(scene.names)][free]
    white_px = _white_px(kept)
    sizes = [(np.sqrt(np.mean(one**2)), np.median(np.abs(one))) for one in (before, rest)]
    return SceneFit(
        rig=corrected(rig, names, values),
        names=names,
        values=values,
        covariance=covariance,
        unseen=tuple(name for name, one, held in zip(names, spread, prior, strict=True) if one > SEEN * held),
        gains=gains,
        taken=tuple(term.words for term in taken),
        pose_rad=state.numbers[len(scene.names) :].reshape(-1, 2),
        rms_px=(white_px * float(sizes[0][0]), white_px * float(sizes[1][0])),
        median_px=(white_px * float(sizes[0][1]), white_px * float(sizes[1][1])),
        features=tuple(kept),
        outliers=tuple(outliers),
        scale=scale,
        predicted_px=predicted_px,
    )
