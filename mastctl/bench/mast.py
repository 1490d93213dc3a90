"""The head and cameras of a daemon in front of a board, the search for it, and a simulated bench's board."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Protocol, cast

import numpy as np
from scipy.spatial.transform import Rotation

from calib.calibrate.bench import FEWEST_CORNERS
from calib.errors import CalibError, Unreachable
from calib.files.mast_file import parse_rig
from calib.geometry.mode import FLIPS, SensorMode
from calib.geometry.rig import Rig
from calib.plan.knowledge import Knowledge
from calib.plan.placements import Placement
from calib.plan.poses import Sought, readings
from calib.targets.board_file import document_of
from calib.targets.boards import AnyBoard, Corners, CornersNotFound
from calib.targets.corners import find_corners
from mastctl.client import Client, ClientError, Snapshot
from mastctl.errors import MastctlError

TURN_TIMEOUT_S = 90.0
PATIENCE_S = 30.0
"""How long to wait for a camera or head that fails: a cable is put back, a driver opens it again."""

AGAIN_S = 1.0
ADJUSTING_S = 1.0
"""How long pictures without light are taken again: an automatic exposure needs some frames."""

COME_FROM_RAD = 0.06
"""How far beside an attitude the head goes first to come to it from the other side: more than any play."""

SIDE = 0.9
"""An approach of less than this has not gone through all of the play, and is treated as unknown."""

LASTING = frozenset(
    {
        "leased", "lease_over", "lease_unknown", "estopped", "stopping", "no_daemon", "forbidden", "no_token",
        "bad_token", "bad_url", "busy", "closing",
    }
)  # fmt: skip
"""What waiting does not mend: an operator has to act."""

BOARD = "bench"
"""The board's name in the simulation."""

OVERLAP = 0.7
"""Of a picture's view: how far apart the looks of a search are."""

ANOTHER = ("another board", "mirrored", "two boards")
"""What `calib.targets.corners` says of a board in view that is not the one that is looked for."""

MOST_LOOKS = 100
"""A narrow view would take hundreds, a quarter of an hour: the operator is consulted before."""

LOOKS_BESIDE = 8
"""Looks after such a one: the right board may hang beside it."""

MOST_KINDS = 4
"""So many things that were seen instead are reported, the most frequent."""


class NotThere(MastctlError):
    """An attitude that the head does not turn to, such as one in a keep-out."""

    code = "not_there"


class BenchInterrupted(MastctlError):
    """The bench cannot go on just now; nothing is lost."""

    code = "interrupted"

    def __init__(self, message: str, code: str = code) -> None:
        self.code = code
        super().__init__(message)


class NoLight(BenchInterrupted):
    """Every camera's image at an attitude is too dark, or too bright, to be used; elsewhere it may do."""

    code = BenchInterrupted.code


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """One camera's image of a look: ``corners`` of the board, or None and ``why`` there are none.

    ``data``: the image's file, PNG, empty where only corners are simulated.
    """

    camera: str
    corners: Corners | None
    why: str = ""
    data: bytes = b""


@dataclass(frozen=True, eq=False)
class BenchLook:
    """Cameras' images at one attitude at rest: what the joints read, radians, the cameras' mean.

    Each joint came from smaller angles (1), from larger (-1), or it is unknown (0).
    """

    seen: tuple[SeenBoard, ...]
    pan_rad: float
    tilt_rad: float
    pan_approach: int = 0
    tilt_approach: int = 0

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that were to take an image."""
        return tuple(one.camera for one in self.seen)

    @property
    def found(self) -> tuple[SeenBoard, ...]:
        """The images that show the board."""
        return tuple(one for one in self.seen if one.corners is not None)

    @property
    def corners(self) -> dict[str, Corners]:
        """The board's corners by camera."""
        return {one.camera: one.corners for one in self.seen if one.corners is not None}


@dataclass(frozen=True, eq=False)
class BenchHead:
    """What is known of a head before it is calibrated.

    ``rig`` is the mast file in use: rough is enough. ``one_sided``: whether it approaches every goal from one
    side by itself. ``count_rad``: one count of its encoders, the coarser of both; 0 where it is unknown.
    """

    rig: Rig
    pan_limits_rad: tuple[float, float]
    tilt_limits_rad: tuple[float, float]
    one_sided: bool = False
    count_rad: float = 0.0


class BenchMast(Protocol):
    """A head with cameras in front of a board."""

    @property
    def head(self) -> BenchHead:
        """What is known of it."""
        ...

    def look(
        self,
        pan_rad: float,
        tilt_rad: float,
        approach: tuple[int, int] = (0, 0),
        cameras: Collection[str] | None = None,
    ) -> BenchLook:
        """Turn to joint readings, from the sides given (0: any), and take some cameras' images at rest, by
        default of all.

        Raises NotThere if the head must not go there; NoLight if the images are too dark or too bright;
        BenchInterrupted if another client steers, a stop was pressed, the daemon is gone, or head or cameras
        fail for longer than a cable takes to be put back.
        """
        ...


class DaemonMast:
    """The head and some cameras of a daemon, whose lease ``client`` should have; see `BenchMast`."""

    def __init__(self, client: Client, cameras: Sequence[str], board: AnyBoard) -> None:
        self._client, self._cameras, self._board = client, tuple(cameras), board
        status = client.status()
        rig = parse_rig(client.mast_file(), "the daemon's mast file").rig
        rig = replace(
            rig,
            cameras={n: replace(rig.cameras[n], sensor_mode=_sensor_mode(client, n)) for n in cameras},
            stereo={name: pair for name, pair in rig.stereo.items() if set(pair) <= set(cameras)},
            fit={},
            provenance={},
        )
        axes, limits = status["axes"], status["limits"]
        pan_rad, tilt_rad = (
            (float(one[0]), float(one[1])) for one in (limits["pan_rad"], limits["tilt_rad"])
        )
        one_sided = bool(axes) and all(axis["one_sided"] for axis in axes.values())
        count_rad = max((float(axis["count_rad"] or 0.0) for axis in axes.values()), default=0.0)
        self.head = BenchHead(rig, pan_rad, tilt_rad, one_sided, count_rad)

    def look(
        self,
        pan_rad: float,
        tilt_rad: float,
        approach: tuple[int, int] = (0, 0),
        cameras: Collection[str] | None = None,
    ) -> BenchLook:
        """See `BenchMast`."""
        begun = time.monotonic()
        while True:
            try:
                return self._look(pan_rad, tilt_rad, approach, cameras)
            except ClientError as error:
                if error.code in ("outside_limits", "keep_out", "sun", "unreachable"):
                    raise NotThere(str(error)) from None
                detail, waited_s = error.detail or {}, time.monotonic() - begun
                if _unlit(error) and waited_s > min(ADJUSTING_S, PATIENCE_S):
                    more = "; turn on a light, or let the camera expose longer"
                    raise NoLight(f"{error}{more if detail['light'] == 'dark' else ''}") from None
                if error.code in LASTING or waited_s > PATIENCE_S:
                    raise BenchInterrupted(str(detail.get("how", error))) from None
                time.sleep(AGAIN_S)

    def _look(
        self, pan_rad: float, tilt_rad: float, approach: tuple[int, int], cameras: Collection[str] | None
    ) -> BenchLook:
        self._turn(pan_rad, tilt_rad, approach)
        shots: list[Snapshot] = []
        failed: list[ClientError] = []
        seen: list[SeenBoard] = []
        for name in self._cameras:
            if cameras is not None and name not in cameras:
                continue
            try:
                shots.append(self._client.snapshot(name))
                seen.append(self._seen(shots[-1]))
            except ClientError as error:
                if error.code in LASTING:
                    raise
                failed.append(error)
                reason = str(error).removeprefix(f"{name}: ") if _unlit(error) else ""
                seen.append(SeenBoard(name, None, reason or f"camera {name} gave no picture"))
        if not shots:
            raise max(failed, key=_unlit)
        if any(shot.moving for shot in shots):
            raise ClientError("moving", "the head moved while the pictures were taken")
        pan_rad, tilt_rad = np.mean([(one.pan_rad, one.tilt_rad) for one in shots], axis=0).tolist()
        sides = _side(shots[0].pan_approach), _side(shots[0].tilt_approach)
        return BenchLook(tuple(seen), pan_rad, tilt_rad, *sides)

    def _turn(self, pan_rad: float, tilt_rad: float, approach: tuple[int, int]) -> None:
        """Go to readings, by way of ones beside them where an axis would come from the other side.

        A head that comes from either side goes through all of its play, so that it is known where in it it
        rests.
        """
        wanted, head = (pan_rad, tilt_rad), self.head
        if not head.one_sided:
            joints: Mapping[str, Any] = self._client.status()["joints"] or {}
            now = (float(joints.get("pan_rad", pan_rad)), float(joints.get("tilt_rad", tilt_rad)))
            limits = head.pan_limits_rad, head.tilt_limits_rad
            beside = tuple(map(beside_goal, wanted, now, approach, limits))
            if beside != wanted:
                self._go(*beside)
        self._go(*wanted)

    def _go(self, pan_rad: float, tilt_rad: float) -> None:
        """Have the daemon turn to readings, as its commanded angles are."""
        operation = self._client.turn(pan_rad, tilt_rad, TURN_TIMEOUT_S)
        error: Mapping[str, Any] = operation.get("error") or {}
        reason = str(error.get("message", "the move failed"))
        if operation["state"] == "stopped":
            raise BenchInterrupted(f"the head was stopped in the middle of a move: {reason}")
        if operation["state"] != "done":
            raise ClientError(str(error.get("code", "failed")), reason)

    def _seen(self, shot: Snapshot) -> SeenBoard:
        found = find_corners(self._board, shot.image)
        if isinstance(found, CornersNotFound):
            return SeenBoard(shot.camera, None, found.reason)
        if len(found) < FEWEST_CORNERS:
            reason = f"{len(found)} corners of the board where {FEWEST_CORNERS} at least are expected"
            return SeenBoard(shot.camera, None, reason)
        return SeenBoard(shot.camera, found, "", shot.data)


def find_board(
    mast: BenchMast, known: Knowledge, sought: Sought, say: Callable[[str], None], placement: Placement
) -> BenchLook:
    """Return the first look that shows the board: where it should stand, then ever further around it.

    Views without light or with nothing in them end nothing: the board may stand beside them. Raises
    BenchInterrupted ``board_not_found`` with what the images showed instead, and where.
    """
    on_head = {name for name, camera in known.rig.cameras.items() if camera.on == "head"}
    attitudes = list(_attitudes(known.rig, sought, placement))
    instead: dict[str, list[str]] = {}
    looks, most, where = 0, min(len(attitudes), MOST_LOOKS), "all over the head's limits"
    for at_rad in attitudes:
        try:
            look = mast.look(*at_rad)
        except NotThere as error:
            reasons = [str(error)]
        except NoLight as error:
            reasons, looks = [str(error).partition("; ")[0]], looks + 1
        else:
            if any(one.camera in on_head for one in look.found):
                return look
            reasons, looks = [one.why for one in look.seen if one.why], looks + 1
        pan, tilt = map(math.degrees, at_rad)
        for reason in dict.fromkeys(reasons):
            # The same with other numbers is the same.
            first = next((one for one in instead if _plain(one) == _plain(reason)), reason)
            instead.setdefault(first, []).append(f"pan {pan:+.0f}, tilt {tilt:+.0f} degrees")
        if most > looks + LOOKS_BESIDE and any(part in reason for part in ANOTHER for reason in reasons):
            most = looks + LOOKS_BESIDE
        if looks == 1:
            say(
                f"the board is not where it was requested ({_summary(instead)}); looking around, {most - 1} "
                "looks at most"
            )
        if looks == most < len(attitudes):
            where = "around where it was requested"
            break
    raise BenchInterrupted(
        f"the board was not found in {looks} look{'s' * (looks != 1)} {where} ({_summary(instead)}); place "
        "it as requested, in the light, facing the head, and go on with the run",
        "board_not_found",
    )


def _attitudes(rig: Rig, sought: Sought, placement: Placement) -> Iterator[tuple[float, float]]:
    """Where the board should be, then a grid of the limits from there outwards."""
    model = next(c.model for c in rig.cameras.values() if c.on == "head")
    limits = sought.pan_limits_rad, sought.tilt_limits_rad
    middle = placement.rover_from_board(rig.mast.rover_from_head(0.0, 0.0)).translation_m
    try:
        start = readings(rig, sought, model, middle)
    except (Unreachable, CalibError, ValueError):
        towards = math.radians(placement.bearing_deg), math.radians(placement.height_deg)
        pan_rad, tilt_rad = (float(np.clip(one, *limit)) for one, limit in zip(towards, limits, strict=True))
        start = pan_rad, tilt_rad
    yield start
    halves = np.array(model.size_px) / (2.0 * np.linalg.norm((model.H, model.V), axis=1))
    steps = 2.0 * OVERLAP * np.arctan(halves)
    pans, tilts = (
        np.clip(
            at + np.arange(-math.ceil((at - low) / step), math.ceil((high - at) / step) + 1) * step, low, high
        )
        for at, step, (low, high) in zip(start, steps, limits, strict=True)
    )
    grid = sorted(set(product(pans.tolist(), tilts.tolist())) - {start})
    away = (np.abs(np.reshape(grid, (-1, 2)) - start) / steps).max(axis=1)
    yield from (grid[k] for k in np.argsort(away, kind="stable"))


def _summary(instead: Mapping[str, Sequence[str]]) -> str:
    """What was seen, how often and where first: another board first, then what most views showed."""
    found = sorted(instead.items(), key=lambda one: (not any(p in one[0] for p in ANOTHER), -len(one[1])))
    more = [f"{len(found) - MOST_KINDS} other reasons"] if len(found) > MOST_KINDS else []
    shown = [
        f"{reason}, {len(places)} time{'s' * (len(places) > 1)}, first at {places[0]}"
        for reason, places in found[:MOST_KINDS]
    ]
    return "; ".join([*shown, *more]) or "no corners were found"


def _plain(reason: str) -> str:
    """A reason without its numbers."""
    return re.sub(r"[-+]?[0-9][0-9.]*", "", reason)


class SimulatedBoard:
    """The board of a simulated rover; ``rig`` says where its head is believed to be."""

    def __init__(self, client: Client, board: AnyBoard, rig: Rig) -> None:
        self._client, self._board, self._rig = client, board, rig

    def stand(self, placement: Placement) -> None:
        """Put the board where it is requested."""
        pose = placement.rover_from_board(self._rig.mast.rover_from_head(0.0, 0.0))
        quaternion = Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True).tolist()
        board = document_of(self._board)
        self._client.put_board(BOARD, pose.translation_m.tolist(), board, quaternion=quaternion)


def _sensor_mode(client: Client, camera: str) -> SensorMode | None:
    """Which pixels of its sensor a camera's images show, by the daemon."""
    mode: Any = None
    with suppress(ClientError):  # a camera that does not answer now may do later
        mode = client.camera_settings(camera).get("sensor_mode")
    if mode is None:
        return None
    keys = "size_px", "crop_px", "sensor_px"
    size, crop, sensor = (None if mode[key] is None else tuple(mode[key]) for key in keys)
    return SensorMode(cast(Any, size), cast(Any, crop), cast(Any, sensor), FLIPS[mode["flip"]])


def beside_goal(wanted: float, now: float, side: int, limits: tuple[float, float]) -> float:
    """Where to go first to come from a side; where it is wanted if it comes from there anyway.

    0 is the side that is on the way. Where a limit leaves no room on one side, it comes from the other.
    """
    side = side or (1 if wanted > now else -1)
    if not limits[0] <= wanted - side * COME_FROM_RAD <= limits[1]:
        side = -side
    if (wanted - now) * side >= COME_FROM_RAD:
        return wanted
    return min(max(wanted - side * COME_FROM_RAD, limits[0]), limits[1])


def _side(approach: float) -> int:
    return 1 if approach > SIDE else -1 if approach < -SIDE else 0


def _unlit(error: ClientError) -> bool:
    """Whether a daemon refused a picture for its light."""
    return (error.detail or {}).get("light") is not None
