"""How good a survey must be: the paper's Tables IV and V, and pointing by other surveys.

    .venv/bin/python -m tools.studies.calibration --cases 10 --seed 1 [--study NAME]

Simulated surveys, larger and smaller, better and worse, each fitted and judged by pointings and hand-offs
with the result. One thing is varied at a time from the paper's survey. Errors are rms an axis, in pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from mastctl.cli.options import at_least
from mastctl.packaged import config_folder
from tools.command import end, options, results_of, show
from tools.studies.calibration_survey import (
    DISTANCES_M,
    HANDOFFS,
    NAVCAM_TO_HAZCAM,
    PANCAM_TO_NAVCAM,
    SurveyOutcome,
    one_survey,
    rms_px,
    survey_tasks,
    variants,
)

SIX = ("txm, m", "tym, m", "tzm, m", "θxm, rad", "θym, rad", "θzm, rad")
PAPER_TABLE_V: Mapping[int, Mapping[str, tuple[float, float]]] = {
    6: {"pancam": (0.854, 1.102), "navcam": (1.129, 1.002)},
    4: {"pancam": (2.871, 22.294), "navcam": (2.784, 7.934)},
}


def _x_y(key: str, digits: int) -> str:
    """A column's format of two numbers."""
    return f"{{{key}[0]:.{digits}f}}, {{{key}[1]:.{digits}f}}"


COLUMNS = {
    "study": "{study}", "": "{label}", "failed": "{failed}",
    "pointing": "{pointing_px:.2f}", "exact": "{exact_px:.2f}",
    **{f"{d:g} m": _x_y(f"pointing_rms_px[{d:g}]", 2) for d in DISTANCES_M},
    PANCAM_TO_NAVCAM: "{to_navcam_px:.2f}", "worst": "{to_navcam_worst_px:.2f}",
    NAVCAM_TO_HAZCAM: "{to_hazcam_px:.2f}", "its worst": "{to_hazcam_worst_px:.2f}",
}  # fmt: skip
TABLE_IV = {"Table IV": "{name}", **{name: f"{{numbers[{index}]:+.4f}}" for index, name in enumerate(SIX)}}
TABLE_V = {
    "Table V, px": "{mast_parameters} parameters",
    **{f"{pair} x, y": _x_y(f"mast_rms_px[{pair}]", 3) for pair in PAPER_TABLE_V[6]},
    **{f"paper: {pair}": _x_y(f"paper_rms_px[{pair}]", 3) for pair in PAPER_TABLE_V[6]},
}  # fmt: skip


def variant_rows(rig: Rig, outcomes: Sequence[SurveyOutcome]) -> list[dict[str, Any]]:
    """Return a row for each variant, in the order of the study.

    ``mast_first``, ``mast_error`` and ``mast_sigma`` are of the six mast parameters: the first survey's, the
    rms error, and the stated sigma.
    """
    rows = []
    for variant in dict.fromkeys(outcome.variant for outcome in outcomes):
        mine = [outcome for outcome in outcomes if outcome.variant == variant]
        good = [outcome for outcome in mine if not outcome.failure]
        row: dict[str, Any] = {
            "study": variant.study,
            "label": variant.label,
            "mast_parameters": variant.mast_parameters,
            "surveys": len(mine),
            "failed": len(mine) - len(good),
            "failures": [outcome.failure for outcome in mine if outcome.failure],
        }
        rows.append(row | (_measured(rig, good) if good else {}))
    return rows


def _measured(rig: Rig, good: Sequence[SurveyOutcome]) -> dict[str, Any]:
    """The numbers of one variant's surveys together."""
    pointing, exact = ({d: _all(good, name, d) for d in DISTANCES_M} for name in ("pointing_px", "exact_px"))
    found: dict[str, Any] = {
        "pointing_px": _rms(pointing.values()),
        "exact_px": _rms(exact.values()),
        "pointing_rms_px": {f"{d:g}": rms_px(errors) for d, errors in pointing.items()},
    }
    for name, key in ((PANCAM_TO_NAVCAM, "to_navcam"), (NAVCAM_TO_HAZCAM, "to_hazcam")):
        handed = [_all(good, "handoff_px", hand) for hand in HANDOFFS if hand[0] == name]
        handed = [errors for errors in handed if errors.size]
        if handed:
            found[f"{key}_px"] = _rms(handed)
            found[f"{key}_worst_px"] = float(np.nanmax(np.linalg.norm(np.concatenate(handed), axis=1)))
    mast = np.array([outcome.mast[:6] for outcome in good])
    sigma = np.array([outcome.sigma[:6] for outcome in good])
    pairs = dict.fromkeys(pair for outcome in good for pair in outcome.mast_rms_px)
    return found | {
        "mast_first": mast[0].tolist(),
        "mast_error": np.sqrt(np.mean((mast - _six(rig)) ** 2, axis=0)).tolist(),
        "mast_sigma": np.sqrt(np.mean(sigma**2, axis=0)).tolist(),
        "mast_rms_px": {
            pair: rms_px(np.array([o.mast_rms_px[pair] for o in good if pair in o.mast_rms_px]))
            for pair in pairs
        },
    }


def _all(good: Sequence[SurveyOutcome], name: str, key: Any) -> FloatArray:
    """The errors (n, 2) of all surveys under one key."""
    return np.concatenate(
        [np.zeros((0, 2)), *(getattr(o, name)[key] for o in good if key in getattr(o, name))]
    )


def _rms(by_distance: Any) -> float:
    """Rms an axis over distances that have equal weight."""
    return float(np.sqrt(np.mean(np.square([rms_px(errors) for errors in by_distance]))))


def _six(rig: Rig) -> FloatArray:
    return np.array([*rig.mast.translation_m, *rig.mast.rotation_rad])


def table_iv_rows(rig: Rig, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the paper's Table IV: the mast's six parameters, true and by the surveys."""
    found = [{"name": "true", "numbers": _six(rig).tolist()}]
    for row in rows:
        of = row["mast_parameters"]
        found += [
            {"name": f"{of}: first survey", "numbers": row["mast_first"]},
            {"name": f"{of}: rms error of {row['surveys'] - row['failed']}", "numbers": row["mast_error"]},
            {"name": f"{of}: stated sigma", "numbers": row["mast_sigma"]},
        ]
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Run the study; 1 if no survey at all could be fitted."""
    parser = options(__doc__, 10, "surveys of each kind, some 6 minutes on two processors", as_json=True)
    parser.add_argument(
        "--targets", type=at_least(1), default=20, metavar="N",
        help="targets of each survey at each distance (default 20)",
    )  # fmt: skip
    parser.add_argument(
        "--study", action="append", metavar="NAME",
        choices=("placements", "boards", "station", "prisms", "hazcam", "mast"),
        help="placements, boards, station, prisms, hazcam or mast; may be given several times (default: all)",
    )  # fmt: skip
    args = parser.parse_args(words)
    rig = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
    chosen = [v for v in variants() if args.study is None or v.study.startswith(tuple(args.study))]
    outcomes = results_of(
        args,
        "surveys",
        one_survey,
        survey_tasks(rig, surveys=args.cases, targets=args.targets, seed=args.seed, chosen=chosen),
        lambda task: f"{task.variant.study} {task.variant.label}, survey {task.seed[1]}",
        failure=lambda outcome: outcome.failure,
    )
    rows = variant_rows(rig, outcomes)
    masts = [
        row | {"paper_rms_px": PAPER_TABLE_V[row["mast_parameters"]]}
        for row in rows
        if row["study"] == "mast parameters"
        and row["mast_parameters"] in PAPER_TABLE_V
        and "mast_first" in row
    ]
    if masts and not args.json:
        show(args, table_iv_rows(rig, masts), TABLE_IV)
        show(args, masts, TABLE_V)
    show(args, rows, COLUMNS, "failures")
    return 0 if any(not outcome.failure for outcome in outcomes) else 1


if __name__ == "__main__":
    end(main)
