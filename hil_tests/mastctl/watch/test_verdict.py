"""One verdict of residuals, reference pictures and hand-offs."""

from __future__ import annotations

from typing import Any

import pytest

from mastctl.answers import ResidualVerdict
from mastctl.watch.residuals import mast_verdict, residual_verdict

NOTHING_YET = residual_verdict("few", "few pointings")
DRIFTS = residual_verdict("drifts", "navcam_left looks 2 mrad beside", 9, "2026-05-02T00:00:00+00:00")
SLIPPED = {"level": "bad", "sentence": "pan slipped by 4 mrad", "since": "2026-05-01T00:00:00+00:00"}
OFFSET = {"sentence": "hazcam_left sees targets 2 px right"}


@pytest.mark.parametrize(
    ("residuals", "looks", "offsets", "verdict", "sentence", "since"),
    [
        (NOTHING_YET, None, [], "few", NOTHING_YET["sentence"], None),
        (NOTHING_YET, {**SLIPPED, "level": "unsure"}, [], "few", NOTHING_YET["sentence"], None),
        (DRIFTS, None, [], "drifts", DRIFTS["sentence"], DRIFTS["since"]),
        (NOTHING_YET, SLIPPED, [], "drifts", f"reference pictures: {SLIPPED['sentence']}", SLIPPED["since"]),
        (NOTHING_YET, None, [OFFSET], "drifts", f"hand-offs: {OFFSET['sentence']}", None),
        (
            DRIFTS, SLIPPED, [OFFSET], "drifts",
            f"{DRIFTS['sentence']}; reference pictures: {SLIPPED['sentence']}; "
            f"hand-offs: {OFFSET['sentence']}",
            SLIPPED["since"],
        ),
    ],
)  # fmt: skip
def test_the_mast_file_holds_as_long_as_nothing_speaks_against_it(
    residuals: ResidualVerdict, looks: Any, offsets: Any, verdict: str, sentence: str, since: str | None
) -> None:
    told = mast_verdict(residuals, looks, {"handoffs": 3, "offsets": offsets})
    assert told == {
        "verdict": verdict, "sentence": sentence, "pointings": residuals["pointings"], "since": since
    }  # fmt: skip
