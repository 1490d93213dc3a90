"""What the study of calibration varies, one thing at a time from the paper's survey (III, Table II).

How many placements the mast is calibrated with, how many boards the cameras, how well the station measures,
how many prisms there are, which pairs see which boards, whether the mast is taken as upright.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from calib.survey import Sigma
from drivers.sim_survey.survey import SurveyPlan
from mastctl.calibration.run import Method

METHODS: tuple[Method, ...] = ("paper", "joint")
PAPER_STATION_M = 0.002


@dataclass(frozen=True)
class Variant:
    """One point of a study: what the survey is like and how it is fitted."""

    study: str
    label: str
    value: float
    method: Method = "joint"
    mast_parameters: int = 6
    plan: SurveyPlan = field(default_factory=SurveyPlan)


def variants() -> tuple[Variant, ...]:
    """Return everything that is varied, one thing at a time from the paper's survey."""
    base = SurveyPlan()
    found: list[Variant] = []
    for method in METHODS:
        for count in (2, 3, 4, 5, 6, 8, 12, 18):
            plan = replace(base, mast_boards=count)
            found.append(Variant(f"placements, {method}", f"{count}", count, method, 6, plan))
    for method in METHODS:
        for count in (2, 4, 8, 12):
            plan = replace(base, rings=tuple(replace(ring, boards=count) for ring in base.rings))
            found.append(Variant(f"boards, {method}", f"{count}", count, method, 6, plan))
    for method in METHODS:
        for station_m in (0.0005, 0.001, 0.002, 0.004):
            plan = replace(base, sigma=Sigma(station_m, 0.1))
            label = f"{1000 * station_m:g} mm"
            found.append(Variant(f"station, {method}", label, 1000 * station_m, method, 6, plan))
    for prisms in (3, 4):
        found.append(Variant("prisms", f"{prisms}", prisms, "joint", 6, replace(base, prisms=prisms)))
    for also in ("", "navcam"):
        rings = tuple(replace(r, also=also) if r.pair == "hazcam" else r for r in base.rings)
        label = f"seen by {also} too" if also else "seen by hazcam"
        found.append(Variant("hazcam boards", label, float(bool(also)), plan=replace(base, rings=rings)))
    paper = replace(base, sigma=Sigma(PAPER_STATION_M, 0.1))
    for parameters in (4, 6, 8):
        found.append(Variant("mast parameters", f"{parameters}", parameters, "paper", parameters, paper))
    return tuple(found)
