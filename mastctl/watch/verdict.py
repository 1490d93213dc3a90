"""Whether the mast file is still valid: one verdict of three kinds of evidence.

Residuals of pointings (`mastctl.watch.residuals`), the drift sentinel's looks at its reference pictures
(`mastctl.watch.sentinel`), and hand-offs from pair to pair (`mastctl.watch.handoffs`) each judge by
themselves. The mast file holds as long as none of them speaks against it.
"""

from __future__ import annotations

from mastctl.answers import CalibrationTold, ResidualsTold, SelfCheck, SentinelTold


def mast_verdict(
    residuals: ResidualsTold, looks: SentinelTold | None, handoffs: SelfCheck
) -> CalibrationTold:
    """Return the verdict as ``GET /status`` has it under ``calibration``.

    ``drifts`` if any of the three says so, else that of the residuals; ``sentence``: of each that speaks
    against the mast file; ``since``: when the first of these began, where one says.
    """
    against: list[tuple[str, str | None]] = []
    if residuals["verdict"] == "drifts":
        against.append((residuals["sentence"], residuals["since"]))
    if looks is not None and looks["level"] == "bad":
        against.append((f"reference pictures: {looks['sentence']}", looks["since"]))
    against += [(f"hand-offs: {one['sentence']}", None) for one in handoffs["offsets"]]
    return {
        "verdict": "drifts" if against else residuals["verdict"],
        "sentence": "; ".join(reason for reason, _ in against) or residuals["sentence"],
        "pointings": residuals["pointings"],
        "since": min((moment for _, moment in against if moment is not None), default=None),
    }
