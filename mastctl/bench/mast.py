"""The head and cameras of a daemon in front of a board, and the board of a simulated bench."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol, cast

import numpy as np
from scipy.spatial.transform import Rotation

from calib.calibrate.bench import FEWEST_CORNERS
from calib.files.mast_file import parse_rig
from calib.geometry.mode import FLIPS, SensorMode
from calib.geometry.rig import Rig
from calib.plan.placements import Placement
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

DARK_DN, BRIGHT_DN = 12.0, 245.0
"""Mean grey level at which a picture without a board is said to be too dark, or too bright."""

LASTING = frozenset(
    {
        "leased", "lease_over", "lease_unknown", "estopped", "stopping", "no_daemon", "forbidden", "no_token",
        "bad_token", "bad_url", "busy", "closing",
    }
)  # fmt: skip
"""What waiting does not mend: an operator has to act."""

BOARD = "bench"
"""The board's name in the simulation."""


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

    code = "interrupted"


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

    Each joint came from smaller angles (1), from larger (-1), or it is unknown (0). It took ``seconds`` of
    the rover's clock.
    """

    seen: tuple[SeenBoard, ...]
    pan_rad: float
    tilt_rad: float
    pan_approach: int = 0
    tilt_approach: int = 0
    seconds: float = 0.0

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that were to take an image."""
        return tuple(one.camera for one in self.seen)

    @property
    def found(self) -> tuple[SeenBoard, ...]:
        """The images that show the board."""
        return tuple(one for one in self.seen if one.corners is not None)


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
        MastctlError if the head does not get there, or no camera gives an image.
        """
        ...


class DaemonMast:
    """Looks for a board through some cameras of a daemon, whose lease ``client`` should have; see
    `BenchMast`."""

    def __init__(self, client: Client, cameras: Sequence[str], board: AnyBoard) -> None:
        self._client, self._cameras, self._board = client, tuple(cameras), board
        self._pool = ThreadPoolExecutor(2, "bench-corners")
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
            (float(limits[key][0]), float(limits[key][1])) for key in ("pan_rad", "tilt_rad")
        )
        one_sided = bool(axes) and all(axis["one_sided"] for axis in axes.values())
        count_rad = max((float(axis["count_rad"] or 0.0) for axis in axes.values()), default=0.0)
        self._head = BenchHead(rig, pan_rad, tilt_rad, one_sided, count_rad)

    @property
    def head(self) -> BenchHead:
        """What is known of it."""
        return self._head

    def look(
        self,
        pan_rad: float,
        tilt_rad: float,
        approach: tuple[int, int] = (0, 0),
        cameras: Collection[str] | None = None,
    ) -> BenchLook:
        """See `BenchMast`.

        Raises BenchInterrupted if another client steers, a stop was pressed, the daemon is gone, or head or
        cameras fail for longer than a cable takes to be put back.
        """
        begun = time.monotonic()
        while True:
            try:
                return self._look(pan_rad, tilt_rad, approach, cameras)
            except ClientError as error:
                if error.code in ("outside_limits", "keep_out", "sun", "unreachable"):
                    raise NotThere(str(error)) from None
                waited_s = time.monotonic() - begun
                if _unlit(error) and waited_s > min(ADJUSTING_S, PATIENCE_S):
                    raise NoLight(self._reason(error)) from None
                if error.code in LASTING or waited_s > PATIENCE_S:
                    raise BenchInterrupted(self._reason(error)) from None
                time.sleep(AGAIN_S)

    def _look(
        self, pan_rad: float, tilt_rad: float, approach: tuple[int, int], cameras: Collection[str] | None
    ) -> BenchLook:
        names = [name for name in self._cameras if cameras is None or name in cameras]
        begun_s = self._now_s()
        self._turn(pan_rad, tilt_rad, approach)
        shots: dict[str, Snapshot] = {}
        failed: dict[str, ClientError] = {}
        found: dict[str, Future[SeenBoard]] = {}
        for name in names:
            try:
                shots[name] = self._client.snapshot(name)
            except ClientError as error:
                failed[name] = error
                if error.code in LASTING:
                    raise
            else:  # its corners are found while the next one is taken
                found[name] = self._pool.submit(self._seen, shots[name])
        if not shots:
            raise max(failed.values(), key=_unlit)
        seconds = self._now_s() - begun_s
        if any(shot.moving for shot in shots.values()):
            raise ClientError("moving", "the head moved while the pictures were taken")
        seen = tuple(
            found[name].result() if name in found else SeenBoard(name, None, _no_picture(name, failed[name]))
            for name in names
        )
        pan_rad, tilt_rad = np.mean([(one.pan_rad, one.tilt_rad) for one in shots.values()], axis=0).tolist()
        one = next(iter(shots.values()))
        sides = _side(one.pan_approach), _side(one.tilt_approach)
        return BenchLook(seen, pan_rad, tilt_rad, *sides, seconds)

    def _turn(self, pan_rad: float, tilt_rad: float, approach: tuple[int, int]) -> None:
        """Go to readings, by way of ones beside them where an axis would come from the other side.

        A head that comes from either side goes through all of its play, so that it is known where in it it
        rests.
        """
        wanted, head = (pan_rad, tilt_rad), self._head
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
            raise BenchInterrupted(
                f"the head was stopped in the middle of a move: {reason}{self._how_to_go_on()}"
            )
        if operation["state"] != "done":
            raise ClientError(str(error.get("code", "failed")), reason)

    def _how_to_go_on(self) -> str:
        """What releases the head, as the end of a sentence; empty if no emergency stop is latched."""
        with suppress(ClientError):
            if self._client.status()["estop"] is not None:
                return "; 'mastctl reset' releases it"
        return ""

    def _reason(self, error: ClientError) -> str:
        """A daemon's refusal as what a person has to do about it."""
        detail = error.detail or {}
        if error.code == "leased":
            return f"another client steers the head: {error}"
        if error.code == "estopped":
            return f"the emergency stop is latched ('mastctl reset' releases it): {error}"
        if error.code == "lease_over" and "how" in detail:
            return f"{detail['how']}{self._how_to_go_on()}"
        if detail.get("light") == "dark":
            return f"{error}; turn on a light, or let the camera expose longer"
        return str(error)

    def _seen(self, shot: Snapshot) -> SeenBoard:
        found = find_corners(self._board, shot.image)
        if isinstance(found, CornersNotFound):
            corners, reason = None, _why(shot.image, found.reason)
        elif len(found) < FEWEST_CORNERS:
            reason = f"{len(found)} corners of the board where {FEWEST_CORNERS} at least are expected"
            corners = None
        else:
            corners, reason = found, ""
        return SeenBoard(shot.camera, corners, reason, shot.data)

    def _now_s(self) -> float:
        return float(self._client.status()["now_s"])


class SimulatedBoard:
    """The board of a simulated rover; ``rig`` says where its head is believed to be."""

    def __init__(self, client: Client, board: AnyBoard, rig: Rig) -> None:
        self._client, self._board, self._rig = client, board, rig

    @property
    def is_there(self) -> bool:
        """Whether the simulation knows the board: a daemon that ended has forgotten it."""
        return BOARD in self._client.boards()

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


def _no_picture(camera: str, error: ClientError) -> str:
    """Why there is no picture of a camera beside another one's."""
    return str(error).removeprefix(f"{camera}: ") if _unlit(error) else f"camera {camera} gave no picture"


def _why(image: Any, reason: str) -> str:
    """Why a picture shows no board: its light, if that is to blame."""
    mean = float(np.mean(image))
    if DARK_DN <= mean <= BRIGHT_DN:
        return reason
    return f"too {'dark' if mean < DARK_DN else 'bright'}, mean grey level {mean:.0f} of 255"
