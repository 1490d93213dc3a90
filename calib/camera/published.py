"""How a camera model projects with its vectors exactly as a label prints them.

Labels print six digits, so A and O are not unit vectors to the last. JPL's library uses them as they are;
here they are normalised on load. These plain formulas are the library's, and serve only to say by how much
that moves a pixel.
"""

from __future__ import annotations

import numpy as np

from calib.rigid import FloatArray


def project_as_published(
    points_m: FloatArray,
    C: FloatArray,
    A: FloatArray,
    H: FloatArray,
    V: FloatArray,
    O: FloatArray,  # noqa: E741  the model's own letter
    R: FloatArray,
    E: FloatArray,
    linearity: float | None,
) -> FloatArray:
    """Return pixels (n, 2) of points (n, 3) by the vectors as they are; ``linearity`` None means CAHVOR.

    Source: ``cmod_cahvor_3d_to_2d`` and ``cmod_cahvore_3d_to_2d_general``; here nothing is refused.
    """
    with np.errstate(all="ignore"):
        p = points_m - C
        zeta = p @ O
        across = p - zeta[:, None] * O
        lam = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
        if linearity is None:
            chi = lam / zeta
        else:
            theta = np.arctan2(lam, zeta)
            for _ in range(20):
                sine, cosine, lag = np.sin(theta), np.cos(theta), theta - np.sin(theta)
                e = E[0] + E[1] * theta**2 + E[2] * theta**4
                e_rate = 2.0 * E[1] * theta + 4.0 * E[2] * theta**3
                rate = zeta * cosine + lam * sine - (1.0 - cosine) * e - lag * e_rate
                step = (zeta * sine - lam * cosine - lag * e) / rate
                theta = theta - step
            theta[~(np.abs(step) < 1e-9)] = np.nan  # no ray was found, or none that is sure
            angle = linearity * theta
            chi = theta if linearity == 0.0 else (np.tan if linearity > 0.0 else np.sin)(angle) / linearity
        mu = R[0] + R[1] * chi**2 + R[2] * chi**4
        bent = (lam / chi)[:, None] * O + (1.0 + mu)[:, None] * across
        return np.asarray(np.stack([bent @ H, bent @ V], axis=-1) / (bent @ A)[:, None])
