"""Wider models of a survey that was fitted: which further numbers would its residuals ask for?

Each model holds the fitted one as a special case (all further numbers 0), so that the gain in chi-square is
tested (``calib.adjust.score``): the axes of the mast, errors of the joints around the turn, a joint that
slips or is read wrong once, lenses, a camera that changes between two pictures, joints and cameras that drift
from the first picture to the last, the board's shape, a board that moved between tapes and pictures. Sigmas
are those of the fit, as residuals show them. Where one defect shows in several models, that which gains most
for its numbers is the likeliest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from calib.adjust.adjustment import Adjustment
from calib.adjust.score import Beside, Gain, Score, scored
from calib.adjust.significance import chance
from calib.adjust.terms import DRAWING, ImageTerm
from calib.adjust.unknowns import Estimate, ResidualBlock
from calib.geometry.rig import MAST_NAMES, Gimbal, gimbal_rates
from calib.geometry.rigid import FloatArray, rigid_rates

FALSE_ALARMS = 0.0003
"""The chance that a survey that is as modelled is said to ask for any wider model."""

EXPLAINS = 0.5
"""A model explains an excess of chi-square if it would take away this part of it."""

FEWEST = 4
"""Of images or attitudes, for a change among them to be looked for."""

DRAWING_ALARMS = 0.01
"""The same of the prisms' drawing alone: few prisms check one another, and the rover frame hangs on them."""

BEND_DEGREE = 4
"""Of the polynomials of the place in the picture by which a lens may be bent otherwise than modelled."""

PAN, TILT = 8, 9
"""Places of the joints among a gimbal's ten numbers."""

FURTHER_MAST = {4: (3, 4), 6: (6, 7)}
"""Which numbers of the mast a fit of so many parameters leaves out that the next wider one has."""

_POWERS = tuple((i, j) for i in range(BEND_DEGREE + 1) for j in range(BEND_DEGREE + 1 - i))


@dataclass(frozen=True)
class WiderModel:
    """A model with more numbers than the one that was fitted, and what they would gain.

    Attributes
    ----------
    name
        ``mast``, ``harmonics of pan``, ``slip of tilt``, ``drift of tilt``, ``attitude``,
        ``joint readings``, ``lens of CAMERA``, ``change of CAMERA``, ``drift of CAMERA``,
        ``bow of the board``, ``spacing of the board``,
        ``board moved`` or ``drawing`` (of the prisms); ``images left out for a change of`` a camera or joint.
    sentence
        What it says.
    numbers, gain
        How many further numbers there are, and by how much the sum of squares would fall.
    chance
        Of such a gain without any such effect, all alternatives of the model (images, placements) counted.
    significant
        Whether chance does not explain it, all models counted.
    size_px
        By how much the further numbers move the dots that depend on them, rms, pixels; not-a-number for what
        moves points of the station.
    """

    name: str
    sentence: str
    numbers: int
    gain: float
    chance: float
    significant: bool
    size_px: float


def wider_models(
    problem: Adjustment, state: Estimate, covariance: FloatArray, gradient: FloatArray
) -> tuple[WiderModel, ...]:
    """Return every wider model that can be tested, the likeliest first.

    Parameters
    ----------
    problem, state
        A fit at its minimum, with the sigmas that count.
    covariance, gradient
        (p, p) and (p,) of its unknowns there.
    """
    images = [image for image in problem.images if image.keep.any()]
    blocks = problem.image_blocks(state, images)
    views = [_View.of(problem, state, *one) for one in zip(images, blocks, strict=True)]
    if not views:
        return ()
    tests = _Tests(problem, state, covariance, gradient, views)
    found = [
        *tests.mast(),
        *tests.harmonics(),
        *tests.attitudes(),
        *tests.lenses(),
        *tests.changes(),
        *tests.board(),
        *tests.tapes(),
        *tests.drawing(),
    ]
    limit = FALSE_ALARMS / max(len(found), 1)
    found = [
        replace(model, significant=model.chance < (DRAWING_ALARMS if model.name == DRAWING else limit))
        for model in found
    ]
    return tuple(sorted(found, key=lambda model: (not model.significant, 2 * model.numbers - model.gain)))


def explaining(models: Sequence[WiderModel], excess: float) -> tuple[WiderModel, ...]:
    """Return the models that make up for most of an excess of chi-square: not the sigmas were wrong then.

    ``models`` are those of a fit with the stated sigmas, ``excess`` by how much its sum of squares is larger
    than they allow. A fit with sigmas widened for that excess no longer asks for them.
    """
    return tuple(m for m in models if m.significant and m.gain - m.numbers > EXPLAINS * excess)


@dataclass(frozen=True, eq=False)
class _View:
    """An image as it was fitted: its block, and rates of pixels (in sigmas) to points (n, 3), rover frame."""

    image: ImageTerm
    block: ResidualBlock
    per_point: FloatArray
    points_m: FloatArray
    rotation: FloatArray
    in_board_m: FloatArray
    head: Gimbal | None

    @classmethod
    def of(cls, problem: Adjustment, state: Estimate, image: ImageTerm, block: ResidualBlock) -> _View:
        board = state.rover_from_board[image.board]
        in_board = image.in_board_m[image.keep]
        head = None
        if image.attitude is not None:
            head = Gimbal(*(part[0] for part in problem.head(state, [image])))
        # A board's shift, after its turn, moves every point alike.
        per_point = block.rates(("board", image.board))[:, 3:].reshape(len(in_board), 2, 3)
        return cls(image, block, per_point, board.points(in_board), board.rotation, in_board, head)

    def gimbal_columns(self, wanted: Sequence[int]) -> FloatArray:
        """(2n, k): pixels in sigmas as numbers of a gimbal move."""
        assert self.head is not None
        rates = -gimbal_rates(self.per_point, self.points_m, self.head, np.array(wanted, dtype=int))
        return np.asarray(rates.reshape(-1, len(wanted)))

    def board_columns(self, moves_m: FloatArray) -> FloatArray:
        """(2n, k): pixels in sigmas as points move by (n, 3, k), metres, in the board."""
        moved = np.einsum("nij,jk,nkl->nil", self.per_point, self.rotation, moves_m)
        return np.asarray(moved.reshape(-1, moves_m.shape[2]))

    def picture_columns(self, size_px: tuple[int, int], powers: Sequence[tuple[int, int]]) -> FloatArray:
        """(2n, 2k): pixels in sigmas as polynomials of the place in the picture are added, x then y."""
        middle, sigma = (np.array(size_px) - 1) / 2, self.image.sigma_px[self.image.keep, None]
        # Where the fit sees them: places as measured hold the very noise that is left over.
        seen_px = self.image.pixels_px[self.image.keep] + self.block.residual.reshape(-1, 2) * sigma
        u, v = ((seen_px - middle) / middle[0]).T
        terms = np.stack([u**i * v**j for i, j in powers], axis=1) / sigma
        columns = np.zeros((len(u), 2, 2 * len(powers)))
        columns[:, 0, : len(powers)] = terms
        columns[:, 1, len(powers) :] = terms
        return np.asarray(columns.reshape(2 * len(u), -1))


class _Tests:
    """The wider models of one fit; each method yields those of one kind, not yet called significant."""

    def __init__(
        self,
        problem: Adjustment,
        state: Estimate,
        covariance: FloatArray,
        gradient: FloatArray,
        views: Sequence[_View],
    ) -> None:
        self.problem, self.state = problem, state
        self.covariance, self.gradient = covariance, gradient
        self.views, self.on_head = views, [view for view in views if view.head is not None]
        self.dot_px = float(np.median(np.concatenate([v.image.sigma_px for v in views])))

    def scored(self, views: Sequence[_View], columns: Callable[[_View], FloatArray]) -> Beside:
        """The equations of numbers that all of some images depend on."""
        return scored(((view.block, columns(view)) for view in views), self.covariance, self.gradient)

    def each(self, groups: Sequence[Sequence[_View]], columns: Callable[[_View], FloatArray]) -> Beside:
        """The equations of numbers that every group of images has for itself."""
        count = columns(groups[0][0]).shape[1]
        score = Score(count * len(groups), len(self.gradient))
        for index, group in enumerate(groups):
            for view in group:
                score.add(view.block, columns(view), index * count + np.arange(count))
        return score.beside(self.covariance, self.gradient)

    def model(self, name: str, gain: Gain, sentence: str, alternatives: int = 1) -> WiderModel:
        probability = min(1.0, alternatives * chance(gain.chi2, gain.freedom))
        size_px = gain.rms * self.dot_px
        return WiderModel(name, sentence, gain.freedom, gain.chi2, probability, False, size_px)

    def mast(self) -> Iterator[WiderModel]:
        """The axes of the mast."""
        fitted = len(self.problem.mast_free)
        further = FURTHER_MAST.get(fitted)
        if further is None or not self.on_head:
            return
        gain = self.scored(self.on_head, lambda view: view.gimbal_columns(further)).gain()
        named = []
        for index, value, sigma in zip(further, gain.values, gain.sigma, strict=True):
            words = (
                MAST_NAMES[index].replace("_rad", "").replace("_m", "").replace("_", " ").replace(".", " ")
            )
            unit = "mm" if MAST_NAMES[index].endswith("_m") else "mrad"
            named.append(f"{words} {1e3 * value:+.2f} ± {1e3 * sigma:.2f} {unit}")
        yield self.model("mast", gain, f"{' and '.join(named)}: fit with --mast {fitted + 2}")

    def harmonics(self) -> Iterator[WiderModel]:
        """Readings that are off around the turn."""
        for joint, name in ((PAN, "pan"), (TILT, "tilt")):
            if not self.on_head:
                return

            def columns(view: _View, joint: int = joint) -> FloatArray:
                angle = view.image.pan_rad if joint == PAN else view.image.tilt_rad
                waves = [np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]
                return np.asarray(view.gimbal_columns([joint]) * np.array(waves))

            gain = self.scored(self.on_head, columns).gain()
            words = f"{name} is read wrong around the turn (a magnet off centre, an arm that sags): its mast "
            yield self.model(f"harmonics of {name}", gain, words + "file needs joint terms")

    def attitudes(self) -> Iterator[WiderModel]:
        """Readings that are off once, from one picture on, or all."""
        groups: dict[int, list[_View]] = {}
        for view in self.on_head:
            groups.setdefault(int(view.image.attitude or 0), []).append(view)
        if len(groups) < FEWEST:
            return
        order = list(groups.values())
        beside = self.each(order, lambda view: view.gimbal_columns([PAN, TILT]))
        every = beside.gain()
        rms = 1e3 * float(np.sqrt(np.mean(every.values**2)))
        words = f"joint readings scatter by some {rms:.2g} mrad more than joint_rad in survey.yaml says"
        yield self.model("joint readings", every, words)
        eye = np.eye(2 * len(order))
        gains = [beside.gain(eye[:, 2 * i : 2 * i + 2]) for i in range(len(order))]
        worst = int(np.argmax([gain.chi2 for gain in gains]))
        pan, tilt = 1e3 * gains[worst].values
        words = (
            f"at image {order[worst][0].image.name} the head stood elsewhere than read, by {pan:+.2f} mrad "
        )
        yield self.model("attitude", gains[worst], words + f"in pan and {tilt:+.2f} in tilt", len(order))
        for joint, name in enumerate(("pan", "tilt")):
            steps = np.stack([eye[:, joint + 2 * k :: 2].sum(axis=1) for k in range(1, len(order))])
            gains = [beside.gain(step[:, None]) for step in steps]
            worst = int(np.argmax([gain.chi2 for gain in gains]))
            value, sigma = 1e3 * gains[worst].values[0], 1e3 * gains[worst].sigma[0]
            words = (
                f"from image {order[worst + 1][0].image.name} on {name} is {value:+.2f} ± {sigma:.2f} mrad "
                "off its reading: an encoder or a horn slipped there"
            )
            yield self.model(f"slip of {name}", gains[worst], words, len(steps))
            gain = beside.gain((eye[:, joint::2] @ self.passed([mine[0] for mine in order]))[:, None])
            value, sigma = 1e3 * gain.values[0], 1e3 * gain.sigma[0]
            words = f"{name} drifts off its reading, by {value:+.2f} ± {sigma:.2f} mrad from the first image "
            yield self.model(f"drift of {name}", gain, words + "to the last: a mount or an encoder creeps")

    def lenses(self) -> Iterator[WiderModel]:
        """Lenses that bend otherwise than their models."""
        for name, mine in self.by_camera().items():
            model = self.state.cameras[name]
            gain = self.scored(
                mine, lambda v: v.picture_columns(self.state.cameras[v.image.camera].size_px, _POWERS)
            ).gain()
            words = (
                f"the rest over {name}'s image is not noise: its lens is bent otherwise than {model.kind} "
            )
            yield self.model(f"lens of {name}", gain, words + "can be, or its dots are off in a pattern")

    def changes(self) -> Iterator[WiderModel]:
        """Cameras that are others from one picture on: refocused, or moved on their mount."""
        for name, mine in self.by_camera().items():
            if len(mine) < FEWEST:
                continue
            size_px = self.state.cameras[name].size_px

            def columns(view: _View, size_px: tuple[int, int] = size_px) -> FloatArray:
                x, xu, xv, y, yu, yv = view.picture_columns(size_px, ((0, 0), (1, 0), (0, 1))).T
                return np.stack([x, y, xu + yv, yu - xv], axis=1)

            beside = self.each([[view] for view in mine], columns)
            eye = np.eye(4 * len(mine))
            steps = [sum(eye[:, 4 * i : 4 * i + 4] for i in range(k, len(mine))) for k in range(1, len(mine))]
            gains = [beside.gain(np.asarray(step)) for step in steps]
            worst = int(np.argmax([gain.chi2 for gain in gains]))
            x, y, scale, turn = gains[worst].values
            half = (size_px[0] - 1) / 2
            words = (
                f"from image {mine[worst + 1].image.name} on {name} is another camera (scale "
                f"{100 * scale / half:+.2f} %, shifted by {x:+.1f}, {y:+.1f} px, turned by "
                f"{1e3 * turn / half:+.1f} mrad): it was refocused or bumped there"
            )
            yield self.model(f"change of {name}", gains[worst], words, len(steps))
            gain = beside.gain(np.asarray(np.kron(self.passed(mine)[:, None], np.eye(4)), dtype=np.float64))
            x, y, scale, turn = gain.values
            words = (
                f"{name} drifts from the first image to the last (scale {100 * scale / half:+.2f} %, shifted "
                f"by {x:+.1f}, {y:+.1f} px, turned by {1e3 * turn / half:+.1f} mrad): it creeps, or warms up"
            )
            yield self.model(f"drift of {name}", gain, words)

    def board(self) -> Iterator[WiderModel]:
        """The board's shape."""
        half_m = float(max(np.abs(view.in_board_m).max() for view in self.views))

        def bow(view: _View) -> FloatArray:
            x, y, _ = view.in_board_m.T / half_m
            moves = np.zeros((len(x), 3, 3))
            moves[:, 2] = np.stack([x * x, x * y, y * y], axis=1)
            return view.board_columns(moves)

        gain = self.scored(self.views, bow).gain()
        bend = 1e3 * float(np.abs(gain.values).max())
        yield self.model(
            "bow of the board", gain, f"the board is not flat: bent by some {bend:.2g} mm at its edges"
        )

        def stretch(view: _View) -> FloatArray:
            x, y, _ = view.in_board_m.T
            moves = np.zeros((len(x), 3, 3))
            moves[:, 0, 0], moves[:, 1, 1], moves[:, 0, 2] = x, y, y
            return view.board_columns(moves)

        gain = self.scored(self.views, stretch).gain()
        wide, high, aslant = 1e3 * gain.values
        words = (
            f"the board's dots are not spaced as stated: {wide:+.2f} per mille along rows, {high:+.2f} along"
        )
        yield self.model("spacing of the board", gain, f"{words} columns, {aslant:+.2f} aslant")

    def tapes(self) -> Iterator[WiderModel]:
        """Boards that moved between their tapes and their pictures."""
        gains = {}
        eye = np.eye(3)[None]
        for key, pose in self.state.rover_from_board.items():
            mine = [p for p in self.problem.station if p.board == key and p.keep]
            if len(mine) < 2 or not any(view.image.board == key for view in self.views):
                continue
            score = Score(6, len(self.gradient))
            for point in mine:
                rates = rigid_rates(eye, pose.points(point.in_board_m)[None], pose.translation_m)[0]
                block = self.problem.station_blocks(self.state, [point])[0]
                score.add(block, -rates / point.sigma_m)
            gains[key] = score.beside(self.covariance, self.gradient).gain()
        if not gains:
            return
        chances = {key: chance(gain.chi2, gain.freedom) for key, gain in gains.items()}
        worst = min(chances, key=lambda key: (chances[key], -gains[key].chi2))
        turn, shift = 1e3 * gains[worst].values[:3], 1e3 * gains[worst].values[3:]
        words = (
            f"the tapes of placement {worst[1]} (set-up {worst[0]}) stand {np.linalg.norm(shift):.1f} mm and "
            f"{np.linalg.norm(turn):.1f} mrad from where its pictures show the board: it moved between them"
        )
        model = self.model("board moved", gains[worst], words, len(gains))
        yield replace(model, size_px=float("nan"))

    def drawing(self) -> Iterator[WiderModel]:
        """Prisms that stand elsewhere on the rover than drawn, the same in every set-up."""
        mine = [p for p in self.problem.station if p.board is None and p.keep]
        if self.problem.prism_cad_m > 0 or not mine:
            return
        names = list(dict.fromkeys(point.point for point in mine))
        score = Score(3 * len(names), len(self.gradient))
        for point in mine:
            block = self.problem.station_blocks(self.state, [point])[0]
            score.add(block, -np.eye(3) / point.sigma_m, 3 * names.index(point.point) + np.arange(3))
        # All prisms moved as one body are another rover frame, which no survey tells.
        places = np.array([self.state.prisms_in_rover_m[name] for name in names])
        as_one = rigid_rates(np.eye(3)[None], places, places.mean(axis=0)).reshape(-1, 6)
        gain = score.beside(self.covariance, self.gradient).gain(null_space(as_one.T))
        off_mm = 1e3 * float(np.sqrt(np.sum(gain.values**2) / len(names)))
        words = (
            f"the prisms stand elsewhere than drawn, by some {off_mm:.1f} mm: measure them on the rover "
            "again, or state prism_cad_m and measure them from several set-ups"
        )
        model = self.model(DRAWING, gain, words)
        yield replace(model, size_px=float("nan"))

    def passed(self, views: Sequence[_View]) -> FloatArray:
        """What part of the survey's images had been taken before each view's, 0 to 1."""
        place = {image.name: k for k, image in enumerate(self.problem.images)}
        last = max(len(place) - 1, 1)
        return np.array([place[view.image.name] / last for view in views])

    def by_camera(self) -> dict[str, list[_View]]:
        """The images of each camera, in their order."""
        found: dict[str, list[_View]] = {}
        for view in self.views:
            found.setdefault(view.image.camera, []).append(view)
        return found
