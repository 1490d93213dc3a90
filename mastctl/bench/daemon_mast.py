"""The head and cameras of a daemon, as a bench looks through them."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import Any, cast

import numpy as np

from calib.calibrate.bench import FEWEST_CORNERS
from calib.files.mast_file import parse_rig
from calib.geometry.mode import FLIPS, SensorMode
from calib.geometry.rig import Rig
from calib.targets.boards import AnyBoard, CornersNotFound
from calib.targets.corners import find_corners
from mastctl.bench.mast import BenchHead, BenchInterrupted, BenchLook, NoLight, NotThere, SeenBoard
from mastctl.client import Client, ClientError, Snapshot

TURN_TIMEOUT_S = 90.0
PATIENCE_S = 30.0
"""How long to wait for a camera or head that fails: a cable is put back, a driver opens it again."""

AGAIN_S = 1.0
ADJUSTING_S = 1.0
"""How long pictures without light are taken again: an automatic exposure needs some frames."""

COME_FROM_RAD = 0.06
"""How far beside an attitude the head goes first to come to it from the other side: more than any play."""

SIDE = 0.9
"""An approach of less than this has not gone through all of the play, and counts as unknown."""

DARK_DN, BRIGHT_DN = 12.0, 245.0
"""Mean grey level at which a picture without a board is said to be too dark, or too bright."""

LASTING = frozenset(
    {
        "leased", "lease_over", "lease_unknown", "estopped", "stopping", "no_daemon", "forbidden", "no_token",
        "bad_token", "bad_url", "busy", "closing",
    }
)  # fmt: skip
"""What waiting does not mend: an operator has to act."""


class DaemonMast:
    """Looks for a board through some cameras of a daemon, whose lease ``client`` should have; see
    `mastctl.bench.mast.BenchMast`."""

    def __init__(self, client: Client, cameras: Sequence[str], board: AnyBoard) -> None:
        self._client, self._cameras, self._board = client, tuple(cameras), board
        self._pool = ThreadPoolExecutor(2, "bench-corners")
        status = client.status()
        rig = served_rig(parse_rig(client.mast_file(), "the daemon's mast file").rig, cameras)
        modes = {name: _sensor_mode(client, name) for name in rig.cameras}
        rig = replace(rig, cameras={n: replace(c, sensor_mode=modes[n]) for n, c in rig.cameras.items()})
        axes = status["axes"]
        limits = status["limits"]
        self._head = BenchHead(
            rig,
            (float(limits["pan_rad"][0]), float(limits["pan_rad"][1])),
            (float(limits["tilt_rad"][0]), float(limits["tilt_rad"][1])),
            one_sided=bool(axes) and all(axis["one_sided"] for axis in axes.values()),
            count_rad=max((float(axis["count_rad"] or 0.0) for axis in axes.values()), default=0.0),
        )

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
        """See `mastctl.bench.mast.BenchMast`.

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
        one = next(iter(shots.values()))
        seen = [
            found[name].result()
            if name in found
            else SeenBoard(name, one.pan_rad, one.tilt_rad, None, _without_picture(name, failed[name]))
            for name in names
        ]
        return BenchLook(tuple(seen), _side(one, "pan_approach"), _side(one, "tilt_approach"), seconds)

    def _turn(self, pan_rad: float, tilt_rad: float, approach: tuple[int, int]) -> None:
        """Go to readings, by way of ones beside them where an axis would come from the other side.

        A head that comes from either side goes through all of its play, so that it is known where in it it
        rests.
        """
        if not self._head.one_sided:
            joints: Mapping[str, Any] = self._client.status()["joints"] or {}
            here = float(joints.get("pan_rad", pan_rad)), float(joints.get("tilt_rad", tilt_rad))
            beside = [
                beside_goal(wanted, now, side, limits)
                for wanted, now, side, limits in zip(
                    (pan_rad, tilt_rad), here, approach,
                    (self._head.pan_limits_rad, self._head.tilt_limits_rad), strict=True,
                )
            ]  # fmt: skip
            if any(a != b for a, b in zip(beside, (pan_rad, tilt_rad), strict=True)):
                self._go(beside[0], beside[1])
        self._go(pan_rad, tilt_rad)

    def _go(self, pan_rad: float, tilt_rad: float) -> None:
        """Have the daemon turn to readings, as its commanded angles are."""
        operation = self._client.turn(pan_rad, tilt_rad, TURN_TIMEOUT_S)
        error: Mapping[str, Any] = operation.get("error") or {}
        why = str(error.get("message", "the move failed"))
        if operation["state"] == "stopped":
            raise BenchInterrupted(
                f"the head was stopped in the middle of a move: {why}{self._how_to_go_on()}"
            )
        if operation["state"] != "done":
            raise ClientError(str(error.get("code", "failed")), why)

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
        pan_rad, tilt_rad = shot.pan_rad, shot.tilt_rad
        corners = find_corners(self._board, shot.image)
        if isinstance(corners, CornersNotFound):
            return SeenBoard(
                shot.camera, pan_rad, tilt_rad, None, _why(shot.image, corners.reason), shot.data
            )
        if len(corners) < FEWEST_CORNERS:
            few = f"{len(corners)} corners of the board where {FEWEST_CORNERS} at least are expected"
            return SeenBoard(shot.camera, pan_rad, tilt_rad, None, few, shot.data)
        return SeenBoard(shot.camera, pan_rad, tilt_rad, corners, "", shot.data)

    def _now_s(self) -> float:
        return float(self._client.status()["now_s"])


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


def served_rig(rig: Rig, cameras: Sequence[str]) -> Rig:
    """Return the rig with these cameras only, and without what a former fit left."""
    pairs = {name: pair for name, pair in rig.stereo.items() if all(one in cameras for one in pair)}
    return replace(
        rig, cameras={name: rig.cameras[name] for name in cameras}, stereo=pairs, fit={}, provenance={}
    )


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


def _side(shot: Snapshot, name: str) -> int:
    approach = float(getattr(shot, name, 0.0))
    return 1 if approach > SIDE else -1 if approach < -SIDE else 0


def _unlit(error: ClientError) -> bool:
    """Whether a daemon refused a picture for its light."""
    return (error.detail or {}).get("light") is not None


def _without_picture(camera: str, error: ClientError) -> str:
    """Why there is no picture of a camera beside another one's."""
    return str(error).removeprefix(f"{camera}: ") if _unlit(error) else f"camera {camera} gave no picture"


def _why(image: Any, reason: str) -> str:
    """Why a picture shows no board: its light, if that is to blame."""
    mean = float(np.mean(image))
    if mean < DARK_DN:
        return f"too dark, mean grey level {mean:.0f} of 255"
    if mean > BRIGHT_DN:
        return f"too bright, mean grey level {mean:.0f} of 255"
    return reason
