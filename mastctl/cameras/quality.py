"""How a picture is exposed and how sharp it is: what one looks at when setting up a camera."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from drivers.interfaces import Image

BINS = 16
DARK, SATURATED = 5, 250


@dataclass(frozen=True)
class Quality:
    """Exposure and sharpness of one picture.

    Attributes
    ----------
    histogram
        Share of the pixels in 16 equal ranges of grey level, 0 to 255.
    mean, median
        Grey levels.
    dark_share, saturated_share
        Share of the pixels at or below 5, and at or above 250.
    sharpness
        Variance of the Laplacian: compare it only between pictures of the same scene and exposure.
    """

    histogram: tuple[float, ...]
    mean: float
    median: float
    dark_share: float
    saturated_share: float
    sharpness: float

    def told(self) -> dict[str, Any]:
        """Return it as JSON."""
        return asdict(self)


def quality_of(image: Image) -> Quality:
    """Return exposure and sharpness of a picture, uint8 (h, w) or (h, w, 3) BGR."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    counts = np.bincount(grey.ravel(), minlength=256)
    shares = counts / grey.size
    return Quality(
        histogram=tuple(float(share) for share in shares.reshape(BINS, -1).sum(axis=1)),
        mean=float(shares @ np.arange(256)),
        median=float(np.searchsorted(np.cumsum(counts), grey.size / 2)),
        dark_share=float(shares[: DARK + 1].sum()),
        saturated_share=float(shares[SATURATED:].sum()),
        sharpness=sharpness(image),
    )


def sharpness(image: Image, around_px: tuple[float, float] | None = None, half_px: int = 100) -> float:
    """Return the variance of the Laplacian, of the whole picture or of a square around a pixel (x, y)."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if around_px is not None:
        x, y = (round(value) for value in around_px)
        grey = grey[max(0, y - half_px) : y + half_px + 1, max(0, x - half_px) : x + half_px + 1]
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())
