"""A picture of a daemon's camera, with its facts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np

from drivers.interfaces import Image
from mastctl.frame_facts import FrameFacts, facts_in


@dataclass(frozen=True, eq=False)
class Snapshot(FrameFacts):
    """A picture and its facts; ``data`` is the file as it came."""

    image: Image
    data: bytes

    @property
    def facts(self) -> dict[str, Any]:
        """Everything but the picture, as JSON."""
        height, width = self.image.shape[:2]
        names = (one.name for one in fields(FrameFacts))
        return {name: getattr(self, name) for name in names} | {"size_px": [width, height]}


def read_snapshot(data: bytes, told: Mapping[str, str]) -> Snapshot:
    """Return a picture from a file's bytes and the headers that came with it.

    Raises
    ------
    ValueError
        If the picture cannot be decoded or a fact is missing or wrong.
    """
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("the picture cannot be decoded")
    try:
        return Snapshot(image=np.asarray(image, dtype=np.uint8), data=data, **facts_in(told))
    except (KeyError, ValueError) as reason:
        raise ValueError(f"the picture's facts are wrong: {reason}") from None
