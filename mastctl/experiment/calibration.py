"""How good a survey must be: simulated surveys, fitted, and judged by the pointing and hand-off they give.

The paper's Tables IV and V come from the same runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.mast.rig import Rig
from mastctl.experiment.calibration_survey import Handoff, SurveyOutcome, SurveyTask, rms_px
from mastctl.experiment.calibration_variants import Variant, variants

PAPER_TABLE_V: Mapping[int, Mapping[str, tuple[float, float]]] = {
    6: {"pancam": (0.854, 1.102), "navcam": (1.129, 1.002)},
    4: {"pancam": (2.871, 22.294), "navcam": (2.784, 7.934)},
}


@dataclass(frozen=True, eq=False)
class VariantSummary:
    """All surveys of one variant together."""

    variant: Variant
    surveys: int
    failed: int
    pointing_rms_px: Mapping[float, tuple[float, float]]
    exact_rms_px: Mapping[float, tuple[float, float]]
    handoff_rms_px: Mapping[Handoff, tuple[float, float]]
    handoff_worst_px: Mapping[Handoff, float]
    seconds: float

    @property
    def exact_px(self) -> float:
        """Rms an axis of pointing after exact clicks, over all distances."""
        return _together(self.exact_rms_px)

    def handoff_px(self, name: str) -> float:
        """Rms an axis of a hand-off, over all its distances; not-a-number where there was none."""
        return _together({d: xy for (n, d), xy in self.handoff_rms_px.items() if n == name})

    def handoff_most_px(self, name: str) -> float:
        """Worst of a hand-off, over all its distances; not-a-number where there was none."""
        return max((worst for (n, _), worst in self.handoff_worst_px.items() if n == name), default=np.nan)

    @property
    def pointing_px(self) -> float:
        """Rms an axis of pointing after clicks with noise, over all distances."""
        return _together(self.pointing_rms_px)


@dataclass(frozen=True, eq=False)
class CalibrationExperiment:
    """The whole study."""

    rig: Rig
    seed: int
    surveys: int
    outcomes: tuple[SurveyOutcome, ...]
    seconds: float

    @property
    def summaries(self) -> tuple[VariantSummary, ...]:
        """One a variant, in the order of the study."""
        variants = dict.fromkeys(outcome.variant for outcome in self.outcomes)
        return tuple(
            _summarise(variant, [o for o in self.outcomes if o.variant == variant]) for variant in variants
        )

    def of(self, study: str) -> tuple[SurveyOutcome, ...]:
        """Return the outcomes of one study."""
        return tuple(outcome for outcome in self.outcomes if outcome.variant.study == study)


def survey_tasks(
    rig: Rig, *, surveys: int, targets: int, seed: int, chosen: Sequence[Variant] | None = None
) -> list[SurveyTask]:
    """Return the tasks of a study, for `mastctl.experiment.calibration_survey.one_survey`.

    Parameters
    ----------
    rig
        The true one.
    surveys
        Of each variant.
    targets
        Of each survey, at each distance, and for each hand-off.
    seed
        The same seed gives the same numbers, wherever the tasks run.
    chosen
        Variants; all of `variants` by default.
    """
    every = variants() if chosen is None else tuple(chosen)
    # Every variant has the same seeds: what differs between two is then the variant rather than the draw.
    return [
        SurveyTask(rig, variant, (seed, number), targets) for variant in every for number in range(surveys)
    ]


def _summarise(variant: Variant, outcomes: Sequence[SurveyOutcome]) -> VariantSummary:
    good = [outcome for outcome in outcomes if not outcome.failure]

    def rms(name: str) -> dict[Any, tuple[float, float]]:
        keys = dict.fromkeys(key for outcome in good for key in getattr(outcome, name))
        return {key: rms_px(np.concatenate([getattr(o, name)[key] for o in good])) for key in keys}

    handoffs = dict.fromkeys(key for outcome in good for key in outcome.handoff_px)
    worst = {
        key: float(np.nanmax(np.linalg.norm(np.concatenate([o.handoff_px[key] for o in good]), axis=1)))
        for key in handoffs
    }
    return VariantSummary(
        variant,
        len(outcomes),
        len(outcomes) - len(good),
        rms("pointing_px"),
        rms("exact_px"),
        rms("handoff_px"),
        worst,
        float(np.mean([o.seconds for o in good])) if good else 0.0,
    )


def _together(by_distance: Mapping[float, tuple[float, float]]) -> float:
    """Rms an axis over all distances; not-a-number where there are none."""
    values = np.array(list(by_distance.values()))
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
