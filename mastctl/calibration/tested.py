"""What a fit was tested for, as tables and for programs: wider models, and each board by the others."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.adjust.result import Calibration
from mastctl.report.tables import Table


def wider_table(calibration: Calibration, most: int | None = None) -> Table | None:
    """Return the wider models with what they would gain, or None where none was tried."""
    if not calibration.wider:
        return None
    rows = [
        [
            model.name,
            f"{model.numbers}",
            f"{model.gain:.1f}",
            f"{model.chance:.2g}",
            model.sentence if model.significant else "no more than chance",
        ]
        for model in calibration.wider[:most]
    ]
    return Table(("wider model", "numbers", "gain in chi-square", "chance", ""), rows)


def board_table(calibration: Calibration, most: int | None = None) -> Table | None:
    """Return what the others say of each board, the least likely first, or None where nothing was tried."""
    if not calibration.left_out_boards:
        return None
    rows = [
        [
            f"{one.board[0]} / {one.board[1]}",
            f"{one.dots}",
            f"{one.fitted_px:.3f}",
            f"{one.predicted_px:.3f}",
            f"{one.mast_sigmas:.2f}",
            f"{one.least_chance:.2g}",
        ]
        for one in calibration.left_out_boards[:most]
    ]
    heads = (
        "set-up / placement",
        "dots",
        "fitted, rms px",
        "by the others, rms px",
        "moves the mast, sigmas",
    )
    return Table((*heads, "chance"), rows)


def wider_told(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the wider models as JSON or YAML."""
    return [
        {
            "name": model.name,
            "sentence": model.sentence,
            "numbers": model.numbers,
            "gain": model.gain,
            "chance": model.chance,
            "significant": model.significant,
            "size_px": _finite(model.size_px),
        }
        for model in calibration.wider
    ]


def cross_validation_told(calibration: Calibration) -> dict[str, Any] | None:
    """Return what the others say of each board as JSON or YAML; None where nothing was tried."""
    if not calibration.left_out_boards:
        return None
    fitted, predicted = cross_validation_px(calibration)
    return {
        "fitted_px": _finite(fitted),
        "predicted_px": _finite(predicted),
        "boards": [
            {
                "setup": one.board[0],
                "placement": one.board[1],
                "dots": one.dots,
                "fitted_px": _finite(one.fitted_px),
                "predicted_px": _finite(one.predicted_px),
                "chi2": _finite(one.chi2),
                "degrees_of_freedom": one.freedom,
                "mast_sigmas": _finite(one.mast_sigmas),
                "chance": one.least_chance,
            }
            for one in calibration.left_out_boards
        ],
    }


def cross_validation_px(calibration: Calibration) -> tuple[float, float]:
    """Return the rms of all dots as fitted and as the other boards predict them, pixels; nan without any."""
    known = [one for one in calibration.left_out_boards if np.isfinite(one.predicted_px)]
    if not known:
        return float("nan"), float("nan")
    dots = np.array([one.dots for one in known])
    sizes = np.array([(one.fitted_px, one.predicted_px) for one in known])
    fitted, predicted = np.sqrt(dots @ sizes**2 / dots.sum())
    return float(fitted), float(predicted)


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None
