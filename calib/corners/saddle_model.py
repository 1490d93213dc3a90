"""The grey levels about a corner where black and white meet crosswise, and their derivatives.

Light p0 + p·u, u in pixels from the corner, plus c times what is left of sign(d1) sign(d2) behind a lens and
square pixels, d1 and d2 being the distances from the two edges. A lens blurs by a normal distribution, wider
one way than the other where the camera moved; so the two distances have a correlation, which is not nil
where the edges are slanted against each other. In the white squares markers may begin not far away.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import erf

from calib.rigid import FloatArray

PARAMETERS = 11
X, Y, SLANTS, BLURS, LIGHT, SLOPES, CONTRAST, TOGETHER = 0, 1, slice(2, 4), slice(4, 6), 6, slice(7, 9), 9, 10
"""Where each is among the parameters. BLURS is the lens's part, TOGETHER the correlation."""

NODES = ((0.2113248654, 0.5), (0.7886751346, 0.5))
"""Places and weights of Gauss and Legendre on 0 to 1."""

ROOT_2, ROOT_2_PI = np.sqrt(2.0), np.sqrt(2.0 * np.pi)


class Edge(NamedTuple):
    """An edge through the corner, from -1 to 1.

    normal: its cosine and sine (n, 1); then (n, p): along it, pixels; z, distance over ``wide``; wide (n,
    1), the standard deviation of all that blurs it; step, its profile; slope and by_blur, the profile's
    derivatives.
    """

    normal: tuple[FloatArray, FloatArray]
    along: FloatArray
    z: FloatArray
    wide: FloatArray
    step: FloatArray
    slope: FloatArray
    by_blur: FloatArray


def residuals(
    state: FloatArray, u: FloatArray, levels: FloatArray, weights: FloatArray, insets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what the model leaves of grey levels (n, p), and the model's derivatives (n, p, 11).

    Parameters
    ----------
    state
        (n, 11) parameters.
    u, levels, weights
        (n, p, 2) pixels from where the corners were expected; (n, p) grey levels; (n, p) weights of both
        answers.
    insets
        (n, 3): so far from either edge, pixels, a marker begins (infinite: none), and the sign of the quarter
        right of and below the corner, +1 where it is white.
    """
    away = u - state[:, None, :2]
    J = np.empty((*levels.shape, PARAMETERS))
    edges = [edge(away, state[:, 2 + k, None], state[:, 4 + k, None]) for k in (0, 1)]
    crossed, by_z, by_together = _crossed(edges[0].z, edges[1].z, state[:, TOGETHER, None])
    contrast = state[:, CONTRAST, None]
    for k, one in enumerate(edges):
        other = edges[1 - k].step
        by_distance = contrast * (one.slope * other + by_z[k] / one.wide)
        blur_part = state[:, 4 + k, None] / one.wide**2
        J[..., 2 + k] = by_distance * one.along
        J[..., 4 + k] = contrast * (one.by_blur * other - blur_part * by_z[k] * one.z)
        for axis, part in enumerate(one.normal):
            J[..., axis] = (J[..., axis] if k else 0.0) - by_distance * part
    J[..., LIGHT] = 1.0
    J[..., SLOPES] = away
    J[..., CONTRAST] = edges[0].step * edges[1].step + crossed
    if np.isfinite(insets).all():
        J[..., CONTRAST] -= _markers(edges, insets)
    J[..., TOGETHER] = contrast * by_together
    slopes = state[:, None, SLOPES]
    fitted = state[:, LIGHT, None] + (away * slopes).sum(axis=2) + contrast * J[..., CONTRAST]
    J[..., :2] -= slopes
    J *= weights[..., None]
    return (levels - fitted) * weights, J


def edge(away: FloatArray, slant: FloatArray, blur: FloatArray) -> Edge:
    """Return a step seen through a lens (normal distribution, ``blur``) and through square pixels.

    A pixel's square is drawn as two lines along the edge, ``apart`` from its middle, with the blur's rest;
    together they have the first four moments of the square.
    """
    cosine, sine = np.cos(slant), np.sin(slant)
    apart = _apart(slant)
    distance = cosine * away[..., 0] + sine * away[..., 1]
    near, far = (distance + apart) / blur, (distance - apart) / blur
    bells = [np.exp(-0.5 * z * z) / (ROOT_2_PI * blur) for z in (near, far)]
    step = 0.5 * (erf(near / ROOT_2) + erf(far / ROOT_2))
    wide = np.hypot(blur, apart)
    along = cosine * away[..., 1] - sine * away[..., 0]
    by_blur = -(near * bells[0] + far * bells[1])
    return Edge((cosine, sine), along, distance / wide, wide, step, bells[0] + bells[1], by_blur)


def wide_px(state: FloatArray) -> FloatArray:
    """Return the standard deviation (n, 2) of all that blurs each edge, lens and pixels."""
    return np.asarray(np.hypot(state[:, BLURS], _apart(state[:, SLANTS])))


def _apart(slant: FloatArray) -> FloatArray:
    """Half the distance of two lines whose fourth cumulant is that of a square seen at a slant."""
    return np.asarray(((np.cos(slant) ** 4 + np.sin(slant) ** 4) / 240.0) ** 0.25)


def _crossed(
    z1: FloatArray, z2: FloatArray, together: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], FloatArray]:
    """Return what two crossing edges have on top of their product, and its derivatives by z1, z2, together.

    Four times the normal distribution of both, integrated over the correlation (Plackett, Biometrika 1954).
    """
    value, by_1, by_2 = np.zeros_like(z1), np.zeros_like(z1), np.zeros_like(z1)
    squares, product = 0.5 * (z1 * z1 + z2 * z2), z1 * z2
    for node, weight in NODES:
        r = together * node
        rest = 1.0 - r * r
        part = (2.0 / np.pi * weight * together / np.sqrt(rest)) * np.exp((r * product - squares) / rest)
        value += part
        part /= rest
        by_1 += part * (r * z2 - z1)
        by_2 += part * (r * z1 - z2)
    rest = 1.0 - together * together
    by_together = (2.0 / np.pi / np.sqrt(rest)) * np.exp((together * product - squares) / rest)
    return value, (by_1, by_2), by_together


def _markers(edges: list[Edge], insets: FloatArray) -> FloatArray:
    """Return twice the part of each pixel that the corners of markers cover in the white quarters.

    They take no part in the derivatives: where they are tells nothing of the corner.
    """
    sign = insets[:, 2, None]
    covered = np.zeros_like(edges[0].z)
    for side in (1.0, -1.0):
        beyond = [
            way * one.z - insets[:, k, None] / one.wide
            for k, (one, way) in enumerate(zip(edges, (np.full_like(sign, side), side * sign), strict=True))
        ]
        covered += 0.5 * (1.0 + erf(beyond[0] / ROOT_2)) * (1.0 + erf(beyond[1] / ROOT_2))
    return np.asarray(covered * sign)
