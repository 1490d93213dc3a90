"""How pointing and tracking are set: times and tolerances, with the reasons for their values."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from calib.files.records import ABSENT, PathInFile, Record


class PairBounds(Record):
    """For which targets a pair serves; its range is that from the middle between its cameras."""

    nearest_m: Annotated[float, Field(ge=0.0, le=1000.0)] = Field(
        default=0.0, description="least range of the target"
    )
    steepest_rad: Annotated[float, Field(ge=0.0, le=math.pi / 2)] = Field(
        default=math.pi / 2, description="how far below the horizontal it looks at most"
    )


USUAL_BOUNDS = {"pancam": PairBounds(nearest_m=6.0), "navcam": PairBounds(nearest_m=2.0)}
"""The paper's ranges, of pairs that no configuration names."""


class HandoffRules(Record):
    """What decides between the pairs; at a range error of 0.2 a 640x480 Hazcam serves up to some 6 m."""

    pairs: dict[str, PairBounds] = Field(default={}, description="the pair for each range (Tracking)")
    margin_px: Annotated[float, Field(ge=0.0, le=1000.0)] = Field(
        default=30.0, description="the target lies so far inside both pictures"
    )
    disparity_error_px: Annotated[float, Field(ge=0.001, le=100.0)] = Field(
        default=1.0, description="of the paper's eq. (1)"
    )
    range_error: Annotated[float, Field(ge=0.001, le=10.0)] = Field(
        default=0.2, description="largest range error that a pair may have"
    )

    def bounds(self, pair: str) -> PairBounds:
        """Return for which targets a pair serves."""
        return self.pairs.get(pair) or USUAL_BOUNDS.get(pair, PairBounds())


class TrackingSettings(Record):
    """What may be set about tracking.

    A tenth of the range is a usual step between two poses; with three tenths the target is seen so
    differently that a longer step is treated as a pose that jumped.
    """

    handoff: HandoffRules = HandoffRules()
    most_step: Annotated[float, Field(ge=0.01, le=1.0)] = Field(
        default=0.3, description="longest way between two poses"
    )
    start_error: Annotated[float, Field(ge=0.001, le=1.0)] = Field(
        default=0.1, description="greatest distance of the target from a given position"
    )
    handoff_log: PathInFile = Field(default=ABSENT, description="record of hand-offs")
