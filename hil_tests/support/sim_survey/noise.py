"""Noise that differs from camera to camera and from picture to picture, as that of real ones does.

Focus, light, contrast and slant differ, and a detector is not as sure in one picture as in another. What is
added to a survey's pixels makes their noise a drawn number of times the stated one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calib.survey.records import Survey

CAMERAS, PICTURES = 0.15, 0.2
"""Spread of the logarithm of the noise, by camera and by picture; never below what is stated."""


def with_noise(survey: Survey, times: Mapping[str, float], rng: np.random.Generator) -> Survey:
    """Return the survey with the noise of some images so many times (1 or more) what their sigma says.

    Images whose noise was made larger before have what both make together.
    """
    dots, corners = dict(survey.dots), dict(survey.corners)
    for image in survey.images:
        more = float(np.sqrt(max(times.get(image.name, 1.0) ** 2 - 1.0, 0.0)))
        if image.name in corners:
            found = corners[image.name]
            added = more * found.sigma_px[:, None] * rng.standard_normal(found.pixels_px.shape)
            corners[image.name] = replace(found, pixels_px=found.pixels_px + added)
        elif image.name in dots:
            seen = dots[image.name]
            own = survey.sigma.dot_px if seen.sigma_px is None else seen.sigma_px[:, None]
            added = more * own * rng.standard_normal(seen.pixels_px.shape)
            dots[image.name] = replace(seen, pixels_px=seen.pixels_px + added)
    return replace(survey, dots=dots, corners=corners)


def with_uneven_noise(survey: Survey, seed: int) -> Survey:
    """Return the survey with noise that differs by camera and by picture; same arguments, same survey."""
    rng = np.random.default_rng([seed, 29])
    by_camera = {name: rng.normal(0.0, CAMERAS) for name in survey.cameras}
    times = {
        image.name: max(1.0, float(np.exp(by_camera[image.camera] + rng.normal(0.0, PICTURES))))
        for image in survey.images
    }
    return with_noise(survey, times, rng)
