"""From pictures of boards that stand anywhere to a place where least squares can start.

Each camera by itself says where the board was in each of its images (``calib.calibrate.starts.views``). With
joint angles q, for boards p and images i,

    rover_from_board[p] = rover_from_head(q_i) · head_from_camera · camera_from_board[i],

which is linear in the two unknown rotations, then in the two unknown places (hand-eye and robot-world at
once; Shah 2013). Weights that fall with the misfit take the pull from bad images; of two poses of an image
that which fits is taken. The mast's frame is the rover's here, its axes taken to meet at a right angle,
joints to read true.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjust.gross import bounded, gross_limit
from calib.adjust.hypotheses import board_moved
from calib.adjust.terms import ImageTerm
from calib.adjust.uncertainty import SEEN_RAD
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.views import ViewPoses
from calib.errors import CalibError
from calib.geometry.rigid import FloatArray, Rigid, rot_y, rot_z

ROUNDS = 12
"""Of weights; they settle in some ten."""

SMALLEST = 2e-3
"""Misfits below this do not count as smaller, radians and metres."""

NEAR_RAD, NEAR_M = 0.1, 0.05
"""Poses of a board by single images that are the same place; what is nearer, least squares can tell apart."""

FEWEST_ELSEWHERE = 3
"""As many images that have a board at one other place are no blunders."""

TURNABOUTS = 0.34
"""A board stood at two places in turn if no cut divides its pictures but for this part of the fewer ones."""

FEWEST_ATTITUDES = 4
"""Standstills of the head with which a start is tried."""


class BenchNotFitted(CalibError):
    """The pictures do not determine a rig, or contradict each other; the sentence says how."""


class SomethingChanged(BenchNotFitted):
    """A joint slipped, a camera was knocked or refocused, or two boards have the same ids: more pictures do
    not help, a person has to."""


class BoardMoved(BenchNotFitted):
    """A board moved during a ``placement``: the others may be good."""

    def __init__(self, sentence: str, placement: str) -> None:
        super().__init__(sentence)
        self.placement = placement


class BenchStart(NamedTuple):
    """The state to begin with, images that do not agree with it, and sentences for a person."""

    estimate: Estimate
    doubtful: frozenset[str]
    notes: tuple[str, ...]


class _Tied(NamedTuple):
    """A camera tied to its boards: by image its board's place in the mast, and how far (angle and distance)
    that is from where the others have it."""

    mount_from_camera: Rigid
    mast_from_board: dict[tuple[str, str], Rigid]
    by_image: dict[str, Rigid]
    off: dict[str, FloatArray]


def bench_start(images: Sequence[ImageTerm], views: Mapping[str, ViewPoses], attitudes: int) -> BenchStart:
    """Return where to start the fit of a bench from what each camera says by itself.

    ``attitudes`` is how many of the head have angles of their own; 0 where readings are exact. Raises
    BenchNotFitted if the head moved too little, a board stood at two places, or a body camera sees no board
    that a head camera sees.
    """
    on_head = {t.camera for t in images if t.attitude is not None}
    elsewhere = {t.board: set[str]() for t in images}
    doubtful = {name for view in views.values() for name in view.doubtful}
    cameras, boards, weight = {}, {}, dict[tuple[str, str], int]()
    for name in sorted(on_head, key=lambda n: (-len(views[n].poses), n)):
        mine = [t for t in images if t.camera == name and t.name in views[name].poses]
        _refuse_still(name, mine)
        tied = _tie(mine, views[name])
        cameras[name] = views[name].model.moved(tied.mount_from_camera)
        for board, pose in tied.mast_from_board.items():
            count = sum(t.board == board for t in mine)
            if count > weight.get(board, 0):
                boards[board], weight[board] = pose, count
        off = _far_off(tied)
        doubtful |= off
        for board in tied.mast_from_board:
            elsewhere[board] |= _agreeing([t for t in mine if t.name in off and t.board == board], tied)
    for board, names in elsewhere.items():
        if len(names) >= FEWEST_ELSEWHERE:
            _refuse_two_places([t for t in images if t.board == board], names)
    for name in views:
        if name not in on_head:
            mine = [
                t for t in images if t.camera == name and t.name in views[name].poses and t.board in boards
            ]
            if not mine:
                raise BenchNotFitted(
                    f"camera {name} on the body sees no board that a head camera sees from where it stands: "
                    "put a board where both see it, or leave the camera out"
                )
            cameras[name] = views[name].model.moved(_body(mine, views[name], boards))
    notes = [
        f"placement {placement} of board {board} is not used: no head camera shows it well"
        for board, placement in sorted({t.board for t in images} - set(boards))
    ]
    estimate = Estimate(
        {n: cameras[n] for n in views}, rover_from_board=boards, joints_rad=np.zeros((attitudes, 2))
    )
    return BenchStart(estimate, frozenset(doubtful), tuple(notes))


def _refuse_two_places(shown: Sequence[ImageTerm], elsewhere: set[str]) -> None:
    """Raise for the images of a board of which some have it at another place."""
    there = np.array([t.name in elsewhere for t in shown])
    board, placement = shown[0].board
    # A picture that says nothing clear may lie on either side: the change is where it divides best.
    cut, wrong = best_cut(there)
    if wrong > TURNABOUTS * there.sum():
        first = [shown[i + 1].name for i in np.flatnonzero(there[1:] != there[:-1])[:3]]
        raise SomethingChanged(
            f"board {board} of placement {placement} stands at two places, now at one and now at the "
            f"other (pictures {', '.join(first)} and others). Two boards have the same ids, or it was "
            "moved and put back. Leave one board only, or print the other with other ids (first_id)"
        )
    raise BoardMoved(board_moved(board, placement, shown[cut - 1].name, shown[cut].name), placement)


def best_cut(there: np.ndarray) -> tuple[int, int]:
    """Return before which of a row (n,) it changes sides, and for how many of them that is wrong."""
    cuts = range(len(there) + 1)
    wrong = [min((~there[:k]).sum() + there[k:].sum(), there[:k].sum() + (~there[k:]).sum()) for k in cuts]
    return int(np.argmin(wrong)), int(min(wrong))


def _refuse_still(name: str, images: Sequence[ImageTerm]) -> None:
    """Raise if a camera's images do not show both axes."""
    attitudes = {t.attitude for t in images}
    if len(attitudes) < FEWEST_ATTITUDES:
        raise BenchNotFitted(
            f"camera {name} shows a board at {len(attitudes)} head positions where {FEWEST_ATTITUDES} at "
            "least, better 20, are expected: take more pictures, with pan and tilt both moved between them"
        )
    # A joint has to move while one placement is in view.
    for axis, key in (("pan", "pan_rad"), ("tilt", "tilt_rad")):
        by_board: dict[tuple[str, str], list[float]] = {}
        for t in images:
            by_board.setdefault(t.board, []).append(getattr(t, key))
        moved = max(float(np.ptp(angles)) for angles in by_board.values())
        if moved < SEEN_RAD:
            raise BenchNotFitted(
                f"{axis} moves by {np.degrees(moved):.1f}° at most while camera {name} sees one placement, "
                f"so that its axis cannot be determined. Take pictures with {axis} at least "
                f"{np.degrees(4 * SEEN_RAD):.0f}° apart in which the same placement is in view"
            )


def _tie(images: Sequence[ImageTerm], view: ViewPoses) -> _Tied:
    """One head camera's place in the head and its boards' places, by weighted linear least squares."""
    boards = list(dict.fromkeys(t.board for t in images))
    gimbals = np.array([rot_z(t.pan_rad) @ rot_y(t.tilt_rad) for t in images])
    at = np.array([boards.index(t.board) for t in images])
    chosen = [view.poses[t.name][0] for t in images]
    weight = np.ones(len(images))
    for _ in range(ROUNDS):
        seen = np.array([pose.rotation for pose in chosen])
        in_head, in_mast = _rotations(gimbals, seen, at, len(boards), weight)
        wanted = (gimbals @ in_head).transpose(0, 2, 1) @ in_mast[at]
        # Of the poses of an image that which is turned least from what the rest says.
        chosen = [
            view.poses[t.name][int(np.argmax([np.sum(p.rotation * turn) for p in view.poses[t.name]]))]
            for t, turn in zip(images, wanted, strict=True)
        ]
        seen = np.array([pose.rotation for pose in chosen])
        off = _angles(gimbals @ in_head @ seen, in_mast[at])
        typical = max(float(np.median(off)), SMALLEST)
        weight = bounded(off, 0.5 * typical)
    shifts = np.array([pose.translation_m for pose in chosen])
    place, places = _places(
        gimbals, gimbals @ in_head, shifts, at, len(boards), off < gross_limit(off, SMALLEST)
    )
    head_from_camera = Rigid(in_head, place)
    mast_from_board = {b: Rigid(in_mast[i], places[i]) for i, b in enumerate(boards)}
    by_image = {
        t.name: Rigid(gimbals[i], np.zeros(3)) @ head_from_camera @ chosen[i] for i, t in enumerate(images)
    }
    apart = {t.name: _apart(by_image[t.name], mast_from_board[t.board]) for t in images}
    return _Tied(head_from_camera, mast_from_board, by_image, apart)


def _rotations(
    gimbals: FloatArray, seen: FloatArray, at: np.ndarray, boards: int, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Head from camera (3, 3) and mast from board (b, 3, 3) with G X S = Z for all images, weighted."""
    size = 9 * (1 + boards)
    matrix = np.zeros((size, size))
    # Row by row, vec(G X S) = (G kron Sᵀ) vec(X); each is orthogonal, so that the squares are identities.
    known = np.einsum("nij,nlk->nikjl", gimbals, seen).reshape(-1, 9, 9)
    matrix[:9, :9] = np.sum(weight**2) * np.eye(9)
    for board in range(boards):
        mine, part = at == board, slice(9 * (1 + board), 9 * (2 + board))
        matrix[part, part] = np.sum(weight[mine] ** 2) * np.eye(9)
        matrix[part, :9] = -np.einsum("n,nij->ij", weight[mine] ** 2, known[mine])
        matrix[:9, part] = matrix[part, :9].T
    _, vectors = np.linalg.eigh(matrix)
    found = vectors[:, 0].reshape(-1, 3, 3)
    if np.linalg.det(found[0]) < 0:
        found = -found
    left, _, right = np.linalg.svd(found)
    turned = left @ right
    return turned[0], turned[1:]


def _places(
    gimbals: FloatArray,
    mast_from_camera: FloatArray,
    shifts: FloatArray,
    at: np.ndarray,
    boards: int,
    good: np.ndarray,
) -> tuple[FloatArray, FloatArray]:
    """The camera's place in the head (3,) and the boards' in the mast (b, 3), metres."""
    weight = good.astype(np.float64)
    for _ in range(ROUNDS):
        rows = np.zeros((len(gimbals), 3, 3 * (1 + boards)))
        rows[:, :, :3] = gimbals
        for i, board in enumerate(at):
            rows[i, :, 3 + 3 * board : 6 + 3 * board] = -np.eye(3)
        wanted = -np.einsum("nij,nj->ni", mast_from_camera, shifts)
        solved = np.linalg.lstsq(
            (weight[:, None, None] * rows).reshape(-1, rows.shape[2]),
            (weight[:, None] * wanted).ravel(),
            rcond=None,
        )[0]
        off = np.linalg.norm(rows @ solved - wanted, axis=1)
        typical = max(float(np.median(off[good])), SMALLEST)
        weight = np.where(good, np.sqrt(bounded(off, typical)), 0.0)
    return solved[:3], solved[3:].reshape(-1, 3)


def _angles(one: FloatArray, other: FloatArray) -> FloatArray:
    """Angles (n,) between rotations (n, 3, 3)."""
    between = np.einsum("nji,njk->nik", one, other)
    return np.asarray(Rotation.from_matrix(between).magnitude())


def _body(images: Sequence[ImageTerm], view: ViewPoses, boards: Mapping[tuple[str, str], Rigid]) -> Rigid:
    """A body camera's place by the boards it sees: the pose that most of its images agree with."""
    votes = [boards[t.board] @ pose.inverse for t in images for pose in view.poses[t.name]]
    turns = np.array([pose.rotation for pose in votes])
    apart = [np.median(_angles(np.broadcast_to(turn, turns.shape), turns)) for turn in turns]
    return votes[int(np.argmin(apart))]


def _far_off(tied: _Tied) -> set[str]:
    """Images whose board stands far from where the others have it."""
    apart = np.array(list(tied.off.values())).T
    limits = np.maximum([gross_limit(sizes) for sizes in apart], (NEAR_RAD, NEAR_M))
    return {name for name, off in tied.off.items() if (off > limits).any()}


def _agreeing(images: Sequence[ImageTerm], tied: _Tied) -> set[str]:
    """Of images that have a board elsewhere, those that most others of them agree with."""
    places = {t.name: tied.by_image[t.name] for t in images}
    near = (
        {name for name, place in places.items() if (_apart(place, one) < (NEAR_RAD, NEAR_M)).all()}
        for one in places.values()
    )
    return max(near, key=len, default=set())


def _apart(one: Rigid, other: Rigid) -> FloatArray:
    """Angle and distance between two poses, radians and metres."""
    turn = Rotation.from_matrix(one.rotation.T @ other.rotation).magnitude()
    return np.array([turn, np.linalg.norm(one.translation_m - other.translation_m)])
