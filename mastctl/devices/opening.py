"""Opening a head: nothing else in this program does (checked by the import contracts).

The program that opens one locks its folder (`mastctl.safety.state_folder`), so that no other program drives
it; knows its latch; and moves it within limits, around keep-outs and off the sun (`mastctl.devices.judge`).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from calib.files.mast_file import StoredRig
from drivers.clock import Clock
from drivers.hardware import Hardware, HardwareSettings, head_name, says_simulated
from drivers.interfaces import Camera, HeadInfo, PanTilt, Reading
from drivers.open_hardware import open_hardware
from drivers.open_hardware import open_one_camera as open_one_camera
from drivers.serial_line import stable_name
from mastctl.control.machine import latched_sentence
from mastctl.devices.cameras import HEAD
from mastctl.devices.devices import Devices
from mastctl.devices.judge import KeepOutJudge, Limits, SunDirection
from mastctl.errors import Stopped
from mastctl.safety.latch import Estopped, latched_at
from mastctl.safety.state_folder import StateFolder, head_folders, take_head

STILL = "this program moves no head"


@dataclass(frozen=True)
class Bounds:
    """What bounds the moves of a head that is opened beside a daemon.

    The sun is judged by the cameras of the mast file ``stored``. A stop that is latched in ``state``, the
    state folder of the head's daemon, holds too.
    """

    limits: Limits
    stored: StoredRig | None = None
    sun: SunDirection | None = None
    state: Path | None = None


def open_rig(settings: HardwareSettings, clock: Clock) -> tuple[Hardware, StateFolder | None]:
    """Take the place of the head, then open all devices; return both, to be closed by the caller.

    The place is None for a head in memory, and for one that says it is simulated: it is as good as in memory.
    Raises StateInUse if another program drives the head; DriverError.
    """
    with ExitStack() as undo:
        name = head_name(settings)
        place = None if name is None else take_head(name)
        if place is not None:
            undo.callback(place.close)
        hardware = open_hardware(settings, clock)
        if place is None or not says_simulated(hardware.pan_tilt):
            undo.pop_all()
            return hardware, place
    return hardware, None


@contextmanager
def devices_beside(
    settings: HardwareSettings, bounds: Bounds, clock: Clock, *, moves: bool, own_cameras: bool = False
) -> Iterator[tuple[Devices, Mapping[str, Camera]]]:
    """Open a rig for a program beside the daemon; leaving stops and closes it.

    ``moves``: whether the head is to be moved; if not, no move is let out. Yields the devices, whose moves
    are judged, and the cameras; with ``own_cameras`` the caller alone takes images.

    Raises Estopped if the head is to be moved and its emergency stop is latched (nothing was opened);
    StateInUse if another program drives the head; DriverError.
    """
    stored = bounds.stored
    assert stored is not None
    place = _locked(head_name(settings), moves, bounds.state)
    with place, open_hardware(settings, clock) as hardware:
        head, cameras = hardware.pan_tilt, {} if own_cameras else hardware.cameras
        devices = Devices(head, cameras, bounds.limits, stored.digest, clock, stored.rig, sun=bounds.sun)
        if not moves:
            devices.block_moves(STILL, STILL)
        try:
            yield devices, hardware.cameras
        finally:
            devices.close()


@contextmanager
def head_beside(
    settings: HardwareSettings, bounds: Bounds, clock: Clock, *, moves: bool
) -> Iterator[Callable[[], GuardedHead]]:
    """Lock a head's place for a test of its driver; yields what opens the head, as often as it is called.

    Parameters and errors are those of `devices_beside`; no camera is opened. Leaving closes what was opened.
    """
    with _locked(head_name(settings), moves, bounds.state), ExitStack() as stack:

        def opened() -> GuardedHead:
            head = stack.enter_context(open_hardware(replace(settings, cameras={}), clock)).pan_tilt
            rig = None if bounds.stored is None else bounds.stored.rig
            return GuardedHead(head, KeepOutJudge(bounds.limits, head, clock, HEAD, rig, bounds.sun), moves)

        yield opened


@contextmanager
def line_locked(port: str) -> Iterator[None]:
    """Lock the place of the head at a line, for a program that moves what is on it without a configuration.

    Limits and keep-outs are not known then. Raises Estopped, StateInUse.
    """
    with _locked(stable_name(port), True):
        yield


class GuardedHead(PanTilt):
    """A head whose every move is judged before it goes out; safe as far as the driver is."""

    def __init__(self, head: PanTilt, judge: KeepOutJudge, moves: bool) -> None:
        self._head = head
        self.judge = judge
        self._moves = moves
        self._moving = threading.Lock()  # what was judged goes out before the next is judged

    @property
    def info(self) -> HeadInfo:
        return self._head.info

    def read(self) -> Reading:
        return self._head.read()

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start the head towards a goal, or send one that the driver has to refuse.

        What is judged is where a driver that takes it could go: to the limits, or nowhere for what is no
        number. Raises KeptOut, Stopped; nothing was sent then.
        """
        if not self._moves:
            raise Stopped(STILL)
        limits, cap = self.judge.limits, self.judge.limits.speed_rad_per_s
        too_fast = speed_rad_per_s is None or speed_rad_per_s > cap
        with self._moving:
            now = self._head.read()
            pan, tilt = (
                at if math.isnan(goal) else min(max(goal, low), high)
                for goal, at, (low, high) in (
                    (pan_rad, now.pan_rad, limits.pan_rad),
                    (tilt_rad, now.tilt_rad, limits.tilt_rad),
                )
            )
            start = self.judge.check_move((pan, tilt), lambda: now)
            self.judge.sent(start, (pan, tilt), cap)
            self._head.move(pan_rad, tilt_rad, cap if too_fast else speed_rad_per_s)

    def stop(self) -> None:
        """As the driver; never waits for a move."""
        self._head.stop()

    def close(self) -> None:
        self._head.close()


@contextmanager
def _locked(name: str | None, moves: bool, state: Path | None = None) -> Iterator[None]:
    """Lock a head's place, which one in memory has not; one that is to be moved has no stop latched."""
    place = None if name is None else take_head(name)
    try:
        if name is not None and moves:
            causes = latched_at([*head_folders(name), *([] if state is None else [state])])
            if causes:
                until = "at the head's daemon; until then nothing moves the head"
                raise Estopped(f"{latched_sentence(causes)} {until}")
        yield
    finally:
        if place is not None:
            place.close()
