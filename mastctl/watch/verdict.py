"""Does the mast file still hold? One verdict of three kinds of evidence.

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
    """Return the verdict as ``GET /status`` tells it under ``calibration``.

    Parameters
    ----------
    residuals
        What pointings say.
    looks
        What the sentinel's looks say, as ``GET /sentinel`` tells it; None where nobody has read them.
    handoffs
        What hand-offs say, as ``GET /track`` tells it under ``self_check``.

    Returns
    -------
    CalibrationTold
        ``verdict``: ``drifts`` if any of the three says so, else that of the residuals; ``sentence``: what
        each says that speaks against the mast file; ``since``: when the first of these began, where one says.
    """
    told = residuals.told()
    against: list[tuple[str, str | None]] = []
    if residuals.word == "drifts":
        against.append((residuals.sentence, residuals.since))
    if looks is not None and looks["level"] == "bad":
        against.append((f"reference pictures: {looks['sentence']}", looks["since"]))
    against += [(f"hand-offs: {one['sentence']}", None) for one in handoffs["offsets"]]
    if not against:
        return cast(CalibrationTold, told)
    since = min((moment for _, moment in against if moment is not None), default=None)
    sentence = "; ".join(words for words, _ in against)
    return cast(CalibrationTold, {**told, "verdict": "drifts", "sentence": sentence, "since": since})
