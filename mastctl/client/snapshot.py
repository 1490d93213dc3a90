"""A picture of a daemon's camera, with its facts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

from mastctl.frame_facts import FrameFacts, facts_in

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Snapshot(FrameFacts):
    """A picture and its facts; ``data`` is the file as it came."""

    data: bytes

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        """The decoded picture, uint8 of (h, w) or (h, w, 3) in the order blue, green, red.

        Raises ImportError without OpenCV, which ``mastctl-client`` leaves to you, ValueError if it cannot be
        decoded.
        """
        try:
            import cv2
            import numpy as np
        except ImportError as missing:
            raise ImportError(
                "decoding a picture needs opencv-python-headless (pip install opencv-python-headless); "
                "`data` has the picture's file without it",
                name=missing.name,
            ) from None
        image = cv2.imdecode(np.frombuffer(self.data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError("the picture cannot be decoded")
        return np.asarray(image, dtype=np.uint8)

    @property
    def facts(self) -> dict[str, Any]:
        """Everything but the picture, as JSON."""
        height, width = self.image.shape[:2]
        names = (one.name for one in fields(FrameFacts))
        return {name: getattr(self, name) for name in names} | {"size_px": [width, height]}


def read_snapshot(data: bytes, told: Mapping[str, str]) -> Snapshot:
    """Return a picture from a file's bytes and the headers that came with it. Raises ValueError."""
    try:
        return Snapshot(data=data, **facts_in(told))
    except (KeyError, ValueError) as reason:
        raise ValueError(f"the picture's facts are wrong: {reason}") from None
