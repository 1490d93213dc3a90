"""Where features are: unknown places, settled for given cameras, and what no place can explain.

A place is a bearing and an inverse range from the mast's origin, so that what is far away stays finite. A
rig that is still wrong may see lines of sight diverge; the inverse range is below 0 then. Its only bound is
that each camera has the feature before it. Where one has not, the feature is *lost*: infinite numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.calibrate.scene.features import Feature
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray, tangents

PRIOR_INVERSE_M = (0.2, 1.0)
"""Mean and sigma of a feature's inverse range: it holds what the pictures leave open, no more."""

NEAREST_INVERSE_M, TRIED = 0.7, 24
LEAST_INVERSE_M = 1e-3
_STEPS = 3
_HELD = 1e-9  # of a bearing: a lost feature has no rates, and its normal matrix stays solvable


class Sights:
    """What pictures show of features: n features, o sights of them, in the order of the features.

    Parameters
    ----------
    features
        Each seen by two pictures or more.
    models
        The believed camera of each picture, in the rover frame.
    origin_m
        (3,) from where places are counted.
    """

    def __init__(
        self, features: Sequence[Feature], models: Sequence[CameraModel], origin_m: FloatArray
    ) -> None:
        lengths = np.array([len(feature.views) for feature in features])
        self.count = len(features)
        self.view_of = np.concatenate([feature.views for feature in features]).astype(np.intp)
        self.feature_of = np.repeat(np.arange(len(features)), lengths)
        self.first = np.concatenate([[0], np.cumsum(lengths)[:-1]])
        self.lengths = lengths
        self.rows = [np.flatnonzero(self.view_of == number) for number in range(len(models))]
        self.pixels = np.concatenate([feature.pixels_px for feature in features])
        covariances = np.concatenate([feature.covariances_px2 for feature in features])
        self.whiten = np.linalg.inv(np.linalg.cholesky(covariances))
        self.origin = origin_m
        self._centers = np.array([models[feature.views[0]].C for feature in features])
        ahead = np.zeros((self.count, 3))
        anchors = self.view_of[self.first]
        for number in np.unique(anchors):
            which = np.flatnonzero(anchors == number)
            ahead[which] = models[number].ray(self.pixels[self.first[which]]).directions
        across = np.array([tangents(one) for one in ahead])
        self.basis = np.stack([across[:, 0], across[:, 1], ahead], axis=1)

    def start(self, models: Sequence[CameraModel]) -> FloatArray:
        """Return places (n, 3) that fit best, inverse ranges tried one after another.

        A feature that no place puts before all its cameras stays lost.
        """
        best, cost = np.zeros((self.count, 3)), np.full(self.count, np.inf)
        for inverse in np.linspace(LEAST_INVERSE_M, NEAREST_INVERSE_M, TRIED):
            # the ray begins at the camera: the bearing from the mast's origin is a little beside it
            points = self._centers + self.basis[:, 2] / inverse - self.origin
            local = np.einsum("nij,nj->ni", self.basis, points)
            depth = np.maximum(local[:, 2], 1e-3)
            places = np.stack([local[:, 0] / depth, local[:, 1] / depth, 1.0 / depth], axis=1)
            off, _, _ = self.off(models, places)
            now = self.sums((off**2).sum(axis=1))
            better = now < cost
            best[better], cost[better] = places[better], now[better]
        return self.settled(models, best)

    def off(
        self, models: Sequence[CameraModel], places: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[FloatArray, FloatArray]]:
        """Return whitened pixels off (o, 2), their rates by the places (o, 2, 3), and how they come about.

        The last are the whitened rates by the point itself (o, 2, 3), and the point from C (o, 3), metres. A
        sight whose camera has no pixel for its place is infinitely off, with rates of 0.
        """
        count = len(self.pixels)
        lost = np.zeros(count, dtype=bool)
        off, by_point, arm = np.empty((count, 2)), np.empty((count, 2, 3)), np.empty((count, 3))
        by_inverse = np.empty((count, 3))
        bearing = self.basis[:, 2] + np.einsum("ni,nij->nj", places[:, :2], self.basis[:, :2])
        stretch = 1.0 / np.maximum(places[:, 2], LEAST_INVERSE_M)
        for number, model in enumerate(models):
            rows = self.rows[number]
            if not len(rows):
                continue
            which = self.feature_of[rows]
            from_center = self.origin - model.C
            by_inverse[rows] = from_center
            arm[rows] = stretch[which, None] * (from_center * places[which, 2, None] + bearing[which])
            pixels, by_point[rows], valid = model.project_jacobian(model.C + arm[rows])
            off[rows], lost[rows] = pixels - self.pixels[rows], ~valid
        by_point[lost] = 0.0
        off = np.where(lost[:, None], np.inf, np.einsum("nij,nj->ni", self.whiten, off))
        by_point = self.whiten @ by_point
        by_place = by_point @ np.concatenate(
            [self.basis[self.feature_of, :2].transpose(0, 2, 1), by_inverse[:, :, None]], axis=2
        )
        by_place *= stretch[self.feature_of, None, None]
        return off, by_place, (by_point, arm)

    def normal(
        self, off: FloatArray, by_place: FloatArray, places: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return each place's normal matrix (n, 3, 3) and gradient (n, 3)."""
        matrix = self.sums(by_place.transpose(0, 2, 1) @ by_place)
        gradient = self.sums(np.einsum("nij,ni->nj", by_place, off))
        matrix[:, [0, 1, 2], [0, 1, 2]] += [_HELD, _HELD, PRIOR_INVERSE_M[1] ** -2]
        gradient[:, 2] += _off_prior(places) / PRIOR_INVERSE_M[1]
        return matrix, gradient

    def sums(self, by_sight: FloatArray) -> FloatArray:
        """Return what is told by sight (o, ...) added up by feature (n, ...)."""
        return np.asarray(np.add.reduceat(by_sight, self.first, axis=0), dtype=np.float64)

    def settled(self, models: Sequence[CameraModel], places: FloatArray) -> FloatArray:
        """Return the places that fit given cameras best: never worse, a feature each, than those given.

        A step that leads behind a camera, or to a worse place, is taken again by a quarter.
        """
        share = np.ones(self.count)
        off, by_place, _ = self.off(models, places)
        cost = self._cost(off, places)
        for _ in range(_STEPS):
            matrix, gradient = self.normal(np.where(np.isfinite(off), off, 0.0), by_place, places)
            step = np.linalg.solve(matrix, gradient[..., None])[..., 0]
            tried = places - share[:, None] * step
            off_there, by_place_there, _ = self.off(models, tried)
            cost_there = self._cost(off_there, tried)
            better = cost_there < cost
            share = np.where(better, 1.0, share / 4.0)
            places, cost = np.where(better[:, None], tried, places), np.where(better, cost_there, cost)
            sights = better[self.feature_of]
            off = np.where(sights[:, None], off_there, off)
            by_place = np.where(sights[:, None, None], by_place_there, by_place)
        return places

    def _cost(self, off: FloatArray, places: FloatArray) -> FloatArray:
        """What each feature (n,) costs at its place, its prior among it; infinite where it is lost."""
        return self.sums((off**2).sum(axis=1)) + _off_prior(places) ** 2

    def rest(self, models: Sequence[CameraModel], places: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """Return what no place explains (q,), 2 m - 3 numbers of a feature in m pictures, and whose (q,).

        Those of a lost feature are infinite.
        """
        off, by_place, _ = self.off(models, places)
        lost = ~np.isfinite(self.sums(off.sum(axis=1)))
        off = np.where(lost[self.feature_of][:, None], 0.0, off)
        rests, owners = [], []
        for length in np.unique(self.lengths):
            which = np.flatnonzero(self.lengths == length)
            rows = (self.first[which, None] + np.arange(length)).ravel()
            whole, _ = np.linalg.qr(by_place[rows].reshape(len(which), 2 * length, 3), mode="complete")
            rest = np.einsum("nij,ni->nj", whole[..., 3:], off[rows].reshape(len(which), -1))
            rest[lost[which]] = np.inf
            rests.append(rest.ravel())
            owners.append(np.repeat(which, rest.shape[1]))
        return np.concatenate(rests), np.concatenate(owners)

    def prior_cost(self, places: FloatArray) -> float:
        """Return what the places' priors cost."""
        return float(np.sum(_off_prior(places) ** 2))


def _off_prior(places: FloatArray) -> FloatArray:
    """How far each inverse range (n,) is off the mean of its prior, sigmas."""
    mean, sigma = PRIOR_INVERSE_M
    return (places[:, 2] - mean) / sigma
