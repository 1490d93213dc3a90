"""What a bench needs of a head with cameras: to look somewhere, and to report what it saw there."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol

from calib.geometry.rig import Rig
from calib.targets.boards import Corners
from mastctl.errors import MastctlError


class NotThere(MastctlError):
    """An attitude that the head does not turn to, such as one in a keep-out."""

    code = "not_there"


class BenchInterrupted(MastctlError):
    """The bench cannot go on just now; nothing is lost."""

    code = "interrupted"


class NoLight(BenchInterrupted):
    """Every camera's image at an attitude is too dark, or too bright, to be used; elsewhere it may do."""

    code = "interrupted"


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """One camera's image of a look.

    ``pan_rad``, ``tilt_rad``: what the joints read at mid-exposure; ``corners`` of the board, or None and
    ``why`` there are none; ``data``: the image's file, PNG, empty where only corners are simulated.
    """

    camera: str
    pan_rad: float
    tilt_rad: float
    corners: Corners | None
    why: str = ""
    data: bytes = b""


@dataclass(frozen=True, eq=False)
class BenchLook:
    """Cameras' images at one attitude, from which side each joint came (1, -1, 0 unknown), and how long it
    took, seconds of the rover's clock."""

    seen: tuple[SeenBoard, ...]
    pan_approach: int
    tilt_approach: int
    seconds: float

    @property
    def pan_rad(self) -> float:
        """What pan read, the cameras' mean."""
        return sum(one.pan_rad for one in self.seen) / len(self.seen)

    @property
    def tilt_rad(self) -> float:
        """What tilt read, the cameras' mean."""
        return sum(one.tilt_rad for one in self.seen) / len(self.seen)

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

        Raises
        ------
        NotThere
            If the head must not go there.
        NoLight
            If the images are too dark or too bright.
        MastctlError
            If the head does not get there, or no camera gives an image.
        """
        ...
