"""Whether the mast file is still valid: one verdict of three kinds of evidence.

Residuals of pointings (`mastctl.watch.residuals`), the drift sentinel's reference pictures looked at again
(`mastctl.watch.sentinel`), and hand-offs from pair to pair (`mastctl.watch.handoffs`) each judge by
themselves. The mast file holds as long as none of them speaks against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from mastctl.answers import CalibrationTold
from mastctl.watch.residuals import ResidualVerdict


def mast_verdict(
    residuals: ResidualVerdict, looks: Mapping[str, Any] | None, handoffs: Mapping[str, Any]
) -> CalibrationTold:
    """Return the verdict as ``GET /status`` has it under ``calibration``.

    Parameters
    ----------
    residuals
        What pointings say.
    looks
        The sentinel's result, as ``GET /sentinel`` has it; None before it was read.
    handoffs
        What hand-offs say, as ``GET /track`` has it under ``self_check``.

    Returns
    -------
    CalibrationTold
        ``verdict``: ``drifts`` if any of the three says so, else that of the residuals; ``sentence``: what
        each says that speaks against the mast file; ``since``: when the first of these began, where one says.
    """
    short = residuals.short()
    against: list[tuple[str, str | None]] = []
    if residuals.word == "drifts":
        against.append((residuals.sentence, residuals.since))
    if looks is not None and looks["level"] == "bad":
        against.append((f"reference pictures: {looks['sentence']}", looks["since"]))
    against += [(f"hand-offs: {one['sentence']}", None) for one in handoffs["offsets"]]
    if not against:
        return cast(CalibrationTold, short)
    since = min((moment for _, moment in against if moment is not None), default=None)
    sentence = "; ".join(reason for reason, _ in against)
    return cast(CalibrationTold, {**short, "verdict": "drifts", "sentence": sentence, "since": since})
