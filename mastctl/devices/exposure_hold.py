"""A camera's exposure, kept as it is while an operation compares its pictures."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

from drivers.errors import DriverError
from drivers.interfaces import Camera, HoldsExposure
from mastctl.devices.thread import DeviceThread

HOLD_TIMEOUT_S = 1.0


class ExposureHold:
    """One hold of one camera.

    Both ends are queued in the camera's own thread and waited for by nobody: the beginning comes before every
    picture that is asked for after it, the end after the beginning, however late that is. So a camera that
    hangs or refuses keeps no operation waiting; its fault says so.

    Parameters
    ----------
    thread
        The camera's own thread.
    camera
        Returns the camera; one that has no exposure to hold is left alone.
    """

    def __init__(self, thread: DeviceThread, camera: Callable[[], Camera]) -> None:
        self._thread = thread
        self._camera = camera
        self._context: AbstractContextManager[None] | None = None

    def begin(self) -> bool:
        """Ask for the hold; return whether there is something to `end`."""
        try:
            self._thread.submit("hold_exposure", self._enter, HOLD_TIMEOUT_S)
        except DriverError:  # overdue or closed: its fault says so already, and it takes no pictures
            return False
        return True

    def end(self) -> None:
        """Ask for the release."""
        try:
            self._thread.submit("release_exposure", self._leave, HOLD_TIMEOUT_S, anyway=True)
        except DriverError:  # closed, and with it the camera
            return

    def _enter(self) -> None:
        camera = self._camera()
        if isinstance(camera, HoldsExposure):
            context = camera.exposure_held()
            context.__enter__()
            self._context = context

    def _leave(self) -> None:
        if self._context is not None:
            self._context.__exit__(None, None, None)
