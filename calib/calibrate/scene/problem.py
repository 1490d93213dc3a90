"""The normal equations of a rig's numbers in features of a still scene.

Beside the rig's numbers each rest of the head has two angle errors of its own, held by what a joint repeats
to. The features' places are eliminated one by one, so that the equations have these numbers only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.adjust.solver import Normal, minimise
from calib.calibrate.scene.features import Feature
from calib.calibrate.scene.places import Sights
from calib.calibrate.scene.terms import SceneView, corrected, lensed, prior_of
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import AXIS_NAMES, Rig
from calib.geometry.rigid import FloatArray, rot_x, rot_y, rot_z

_R1_BIT = 1e-6


@dataclass(frozen=True, eq=False)
class SceneState:
    """Numbers of the terms and of the rests (p + 2k,), and the features' places (n, 3)."""

    numbers: FloatArray
    places: FloatArray


@dataclass(eq=False)
class SceneProblem:
    """Features of views, the numbers that may explain them, and which of these are free.

    Attributes
    ----------
    rig, views, features
        The assumed rig, the pictures, and what they show together.
    names
        Of the rig's numbers (p,), as `calib.calibrate.scene.terms` has them.
    joint_sigma_rad
        What a rest of the head is off by chance, one sigma.
    scale
        Factor of the features' stated variances.
    free
        (p + 2k,) which numbers move; the others stay what they are. At first: those of the rests.
    """

    rig: Rig
    views: Sequence[SceneView]
    features: Sequence[Feature]
    names: tuple[str, ...]
    joint_sigma_rad: float
    scale: float = 1.0
    free: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.terms = len(self.names)
        self.rests = max(view.pose for view in self.views) + 1
        self.free = np.arange(self.terms + 2 * self.rests) >= self.terms
        self.sights = Sights(self.features, self.models(self.nothing), self.rig.mast.translation_m)

    @property
    def nothing(self) -> FloatArray:
        """The numbers (p + 2k,) of a rig that is as believed."""
        return np.zeros(self.terms + 2 * self.rests)

    @property
    def prior(self) -> FloatArray:
        """Sigma beforehand of each number (p + 2k,)."""
        held = [prior_of(name) for name in self.names]
        return np.array([*held, *[self.joint_sigma_rad] * (2 * self.rests)])

    def models(self, numbers: FloatArray) -> list[CameraModel]:
        """Return each view's camera in the rover frame."""
        rig, angles = self._rig_and_angles(numbers)
        return [rig.camera_in_rover(view.camera, *at) for view, at in zip(self.views, angles, strict=True)]

    def _rig_and_angles(self, numbers: FloatArray) -> tuple[Rig, list[tuple[float, float]]]:
        """The corrected rig, and where each view's joints truly stand."""
        rig = corrected(self.rig, self.names, numbers[: self.terms]) if self.terms else self.rig
        off = numbers[self.terms :].reshape(-1, 2)
        angles = []
        for view in self.views:
            pan, tilt = rig.joints.true_rad((view.pan_rad, view.tilt_rad), view.approach)
            angles.append((float(pan + off[view.pose, 0]), float(tilt + off[view.pose, 1])))
        return rig, angles

    def start(self, places: FloatArray | None = None) -> SceneState:
        """Return the state of a rig that is as believed; places (n, 3) are near those given."""
        models = self.models(self.nothing)
        if places is None:
            return SceneState(self.nothing, self.sights.start(models))
        return SceneState(self.nothing, self.sights.settled(models, places))

    def rates(self, state: SceneState) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return whitened pixels off (o, 2), their rates by places (o, 2, 3), by numbers (o, 2, p + 2k)."""
        rig, angles = self._rig_and_angles(state.numbers)
        models = [rig.camera_in_rover(view.camera, *at) for view, at in zip(self.views, angles, strict=True)]
        off, by_place, (by_point, arm) = self.sights.off(models, state.places)
        by_number = np.zeros((*off.shape, len(state.numbers)))
        at = {name: number for number, name in enumerate(self.names)}
        for number, (view, model, angle) in enumerate(zip(self.views, models, angles, strict=True)):
            rows = self.sights.rows[number]
            if not len(rows):
                continue
            seen = _Seen(rig, view, model, angle, by_point[rows], arm[rows])
            rest = self.terms + 2 * view.pose
            by_number[rows, :, rest], by_number[rows, :, rest + 1] = (
                seen.by_joint("pan"),
                seen.by_joint("tilt"),
            )
            for name, rate in seen.by_name(self.names).items():
                by_number[rows, :, at[name]] = rate
            for part, rate in self._by_lens(view, model, number, off[rows], arm[rows]).items():
                by_number[rows, :, at[part]] = rate
        return off, by_place, by_number

    def _by_lens(
        self, view: SceneView, model: CameraModel, number: int, off: FloatArray, arm: FloatArray
    ) -> dict[str, FloatArray]:
        """By number of a view's lens: whitened rates (m, 2)."""
        scale, r1 = (f"cameras.{view.camera}.{part}" for part in ("scale", "r1"))
        if scale not in self.names:
            return {}
        rows = self.sights.rows[number]
        white = self.sights.whiten[rows]
        pixels = np.linalg.solve(white, off[..., None])[..., 0] + self.sights.pixels[rows]
        middle = np.array([model.H @ model.A, model.V @ model.A])
        found = {scale: np.einsum("nij,nj->ni", white, pixels - middle)}
        if r1 in self.names:
            bent, _ = lensed(model, r1=_R1_BIT).project(model.C + arm)
            found[r1] = np.einsum("nij,nj->ni", white, np.nan_to_num(bent - pixels) / _R1_BIT)
        return found

    def linear(self, state: SceneState) -> Linear:
        """Return the equations about a state, places eliminated, without the numbers' priors."""
        off, by_place, by_number = self.rates(state)
        return Linear(self.sights, state, off, by_place, by_number, self.scale)

    def normal(self, state: SceneState) -> Normal:
        """Cost and normal equations of the free numbers, priors among them."""
        cost, prior = self.cost(state), self.prior
        if not np.isfinite(cost):
            return Normal(cost, np.eye(len(prior)), np.zeros(len(prior)))
        linear = self.linear(state)
        matrix = linear.matrix + np.diag(prior**-2)
        gradient = linear.gradient + state.numbers / prior**2
        matrix[~self.free] = matrix[:, ~self.free] = 0.0
        matrix[~self.free, ~self.free] = 1.0
        gradient[~self.free] = 0.0
        return Normal(cost, matrix, gradient)

    def cost(self, state: SceneState) -> float:
        """The cost alone; infinite where a camera has a feature behind it."""
        off, _, _ = self.sights.off(self.models(state.numbers), state.places)
        held = state.numbers / self.prior
        return float(((off**2).sum() + self.sights.prior_cost(state.places)) / self.scale + held @ held)

    def stepped(self, state: SceneState, step: FloatArray) -> SceneState:
        """The numbers moved, and the places to where they then fit best."""
        numbers = state.numbers + step
        return SceneState(numbers, self.sights.settled(self.models(numbers), state.places))

    def solved(self, state: SceneState) -> SceneState:
        """Return the state of least cost, near a given one."""
        return minimise(self, state, steps=20, gain=1e-6).state

    def rest(self, numbers: FloatArray, places: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """Return what no place explains at given numbers (q,), in sigmas, and whose feature it is (q,)."""
        models = self.models(numbers)
        return self.sights.rest(models, self.sights.settled(models, places))


class Linear:
    """Linear equations of numbers about a state, the places eliminated.

    ``matrix`` (p, p) and ``gradient`` (p,) are of the pictures alone. Rates by other numbers are set beside
    them with `beside`.
    """

    def __init__(
        self,
        sights: Sights,
        state: SceneState,
        off: FloatArray,
        by_place: FloatArray,
        by_number: FloatArray,
        scale: float,
    ) -> None:
        self._sights, self._by_place, self._scale = sights, by_place, scale
        self._off = off.ravel()
        self._normal, self._place_gradient = sights.normal(off, by_place, state.places)
        self._flat = by_number.reshape(2 * len(off), -1)
        self._solved, mixed = self._eliminated(by_number)
        self.matrix = (self._flat.T @ self._flat - mixed.T @ self._solved) / scale
        self.gradient = self._down(self._flat, self._solved)

    def beside(self, other: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what whitened rates (o, 2, s) by other numbers add: (p, s), (s, s), and gradient (s,)."""
        flat = other.reshape(len(self._off), -1)
        solved, mixed = self._eliminated(other)
        across = (self._flat.T @ flat - self._solved.T @ mixed) / self._scale
        return across, (flat.T @ flat - mixed.T @ solved) / self._scale, self._down(flat, solved)

    def _eliminated(self, rates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mixed equations of places and numbers (3n, p), by the places' own ones and as they are."""
        mixed = self._sights.sums(self._by_place.transpose(0, 2, 1) @ rates)
        solved = np.linalg.solve(self._normal, mixed)
        size = -1, rates.shape[2]
        return np.asarray(solved, dtype=np.float64).reshape(size), mixed.reshape(size)

    def _down(self, flat: FloatArray, solved: FloatArray) -> FloatArray:
        """The gradient by numbers."""
        return np.asarray((flat.T @ self._off - solved.T @ self._place_gradient.ravel()) / self._scale)


class _Seen:
    """How one view's whitened pixels (m, 2) follow turns of its camera."""

    def __init__(
        self,
        rig: Rig,
        view: SceneView,
        model: CameraModel,
        angles: tuple[float, float],
        by_point: FloatArray,
        arm: FloatArray,
    ) -> None:
        self.rig, self.view, self.model, self.by_point, self.arm = rig, view, model, by_point, arm
        mast = rig.mast
        self.on_head = rig.cameras[view.camera].on == "head"
        still = mast.rover_from_mast
        panned = still.rotation @ rot_z(angles[0])
        twisted = panned @ rot_x(mast.axis_twist_rad)
        self.axes = {
            "pan": (still.rotation[:, 2], still.translation_m),
            "twist": (panned[:, 0], still.translation_m),
            "tilt": (twisted[:, 1], still.translation_m + mast.axis_offset_m * panned[:, 0]),
        }
        self.head = twisted @ rot_y(angles[1])

    def turned(self, axis: FloatArray, through_m: FloatArray) -> FloatArray:
        """Rates by a turn of the camera about an axis through a point: the point of the scene goes back."""
        back = np.cross(self.arm + self.model.C - through_m, axis)
        return np.asarray(np.einsum("nij,nj->ni", self.by_point, back))

    def by_joint(self, which: str) -> FloatArray:
        """Rates by a joint's true angle, or by the twist of the axes."""
        if not self.on_head:
            return np.zeros((*self.arm.shape[:1], 2))
        return self.turned(*self.axes[which])

    def by_name(self, names: Sequence[str]) -> dict[str, FloatArray]:
        """Rates by those of the rig's numbers that turn this view's camera."""
        found: dict[str, FloatArray] = {}
        if not self.on_head:
            return found
        view = self.view
        for name in names:
            parts = name.split(".")
            if parts[0] == "mast":
                found[name] = self.by_joint("twist")
            elif parts[0] == "joints":
                axis = ("pan", "tilt").index(parts[1])
                joint = (self.rig.joints.pan, self.rig.joints.tilt)[axis]
                read = (view.pan_rad, view.tilt_rad)[axis]
                rate = joint.rates(read, view.approach[axis])[AXIS_NAMES.index(parts[2])]
                found[name] = float(rate) * self.by_joint(parts[1])
            elif parts[1] == view.camera and parts[2] == "turn":
                found[name] = self.turned(self.head[:, "xyz".index(parts[3])], self.model.C)
        return found
