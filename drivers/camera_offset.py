"""A camera whose stamps are corrected by what was measured of them, whatever its driver."""

from __future__ import annotations

import dataclasses
from contextlib import AbstractContextManager
from typing import Any

from drivers.interfaces import Camera, Frame, FrameTime, HoldsExposure, KnowsSize, Paced

MOST_OFFSET_S = 1.0
"""No camera's stamps are further off than a fault of its driver."""


def corrected(camera: Camera, offset_s: float) -> Camera:
    """Return a camera whose frames' ``mid_exposure_s`` are later by ``offset_s``; itself for 0.

    It is `KnowsSize`, `HoldsExposure` and `Paced` if the camera is.
    """
    if offset_s == 0.0:
        return camera
    can = ((KnowsSize, _KnowingSize), (HoldsExposure, _HoldingExposure), (Paced, _Pacing))
    abilities = [ours for protocol, ours in can if isinstance(camera, protocol)]
    kind: type[CorrectedCamera] = type("CorrectedCamera", (*abilities, CorrectedCamera), {})
    return kind(camera, offset_s)


class CorrectedCamera:
    """Made by `corrected`. What it is asked beside pictures and their times goes to the camera."""

    def __init__(self, camera: Any, offset_s: float) -> None:
        self._camera = camera
        self._offset_s = offset_s
        self._narrower_s = 0.0  # by how much a frame's span was narrowed at either end

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        """Return the camera's next frame that by the corrected time began after ``exposed_after_s``.

        A driver that tells how uncertain its times are (``mid_uncertainty_s``) tells a span longer than the
        exposure. That mid-exposure is known by measurement takes as much off either end: the exposure lay
        in the driver's own span, and nothing becomes later than the frame's arrival.
        """
        frame: Frame = self._camera.next_frame(exposed_after_s - self._offset_s, timeout_s)
        try:
            uncertainty_s = float(getattr(frame, "mid_uncertainty_s", 0.0))
            widest_s = max(0.0, min(uncertainty_s, frame.exposure_s / 2))
            self._narrower_s = min(abs(self._offset_s), widest_s)
            changes: dict[str, Any] = {
                "mid_exposure_s": frame.mid_exposure_s + self._offset_s,
                "exposure_s": frame.exposure_s - 2 * self._narrower_s,
            }
            if isinstance(frame, Frame):
                if uncertainty_s > 0.0:
                    changes["mid_uncertainty_s"] = uncertainty_s - self._narrower_s
                return dataclasses.replace(frame, **changes)
            return Frame(frame.image, frame.sequence, **changes)
        except (AttributeError, TypeError, ValueError):
            return frame  # no frame at all: whoever asked refuses it in its own words

    def close(self) -> None:
        """Let go of the camera."""
        self._camera.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


class _KnowingSize(CorrectedCamera):
    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""
        size_px: tuple[int, int] = self._camera.size_px
        return size_px


class _HoldingExposure(CorrectedCamera):
    def exposure_held(self) -> AbstractContextManager[None]:
        """Return a context in which the exposure does not change."""
        held: AbstractContextManager[None] = self._camera.exposure_held()
        return held


class _Pacing(CorrectedCamera):
    @property
    def period_s(self) -> float:
        """From frame to frame, seconds."""
        return float(self._camera.period_s)

    @property
    def trigger(self) -> str:
        """The name of what exposes its frames."""
        return str(self._camera.trigger)

    def recent_times(self) -> list[FrameTime]:
        """Return the corrected times of the frames that came last, as `next_frame` tells them."""
        later_s = self._offset_s + self._narrower_s
        return [FrameTime(sequence, began_s + later_s) for sequence, began_s in self._camera.recent_times()]
