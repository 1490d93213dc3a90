"""Make all numbers of docs/evidence/validation.md from the flight data in hil_tests/data.

    python -m tools.flight.validation [--data FOLDER] [--write]

The tables go to stdout. With --write they also replace the CSV files of these tables in docs/evidence/data.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drivers.clock import ManualClock
from drivers.recordings.pds3 import PdsProduct
from tools.command import end
from tools.flight import mer, msl
from tools.flight.difference import ModelDifference, model_difference
from tools.page_tables import cells_of

REPOSITORY = Path(__file__).resolve().parents[2]
TABLES = REPOSITORY / "docs" / "evidence" / "data"
PRINTED_SEEDS = range(10)
PAIRS = {"3rd to 4th": (2, 3), "4th to 5th": (3, 4), "1st to 2nd": (0, 1)}


def main() -> int:
    """Run the whole comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=REPOSITORY / "hil_tests" / "data")
    parser.add_argument(
        "--write", action="store_true", help="renew the tables of docs/evidence/validation.md"
    )
    arguments = parser.parse_args()
    for name in ("msl_navcam", "mer_navcam"):
        if not (arguments.data / name).is_dir():
            parser.error(f"{arguments.data} has no folder {name}; --data names the folder that holds it")
    blocks = msl_blocks(arguments.data / "msl_navcam")
    blocks |= mer_blocks(arguments.data / "mer_navcam")
    for name, text in blocks.items():
        print(f"## {name}\n\n{text}\n")
    if arguments.write:
        for name, text in blocks.items():
            rows = [cells_of(line) for line in text.splitlines() if line.startswith("| ")]
            if rows:
                with (TABLES / f"validation-{name}.csv").open("w", newline="", encoding="utf-8") as file:
                    csv.writer(file, lineterminator="\n").writerows([rows[0], *rows[2:]])
    return 0


def msl_blocks(folder: Path) -> dict[str, str]:
    """Return the tables about the MSL labels."""
    training, others = msl.read_labels(folder, "A")
    fitted = msl.fit(training)
    printed = [
        msl.errors(
            msl.fit(msl.printed_labels(fitted, training, seed)),
            msl.printed_labels(fitted, others, 1000 + seed),
        )
        for seed in PRINTED_SEEDS
    ]
    b_training, b_others = msl.read_labels(folder, "B")
    lens = b_training[0].model
    final = msl.read_labels(folder, "A", angles="final")
    everything = training + others
    rows = [
        _errors_row("A, eight parameters", msl.errors(fitted, others)),
        _errors_row("A, one label a new pointing", msl.errors(fitted, msl.new_pointings(training, others))),
        _errors_row("A, six parameters", msl.errors(msl.fit(training, 6), others)),
        _errors_row("B, eight parameters", msl.errors(msl.fit(b_training), b_others)),
        _errors_row(
            "B, eight parameters, lens left out",
            msl.errors(msl.fit(msl.one_lens(b_training, lens)), msl.one_lens(b_others, lens)),
        ),
        _errors_row("A, eight parameters, FINAL angles", msl.errors(msl.fit(final[0]), final[1])),
        _errors_row("A, fitted to all 318, not predicted", msl.errors(msl.fit(everything), everything)),
    ]
    spread = {
        "position rms (mm)": [one.position_rms_mm for one in printed],
        "orientation rms (mrad)": [one.orientation_rms_mrad for one in printed],
        "shift rms (px)": [one.shift_rms_px for one in printed],
    }
    axes = msl.against_flight_software(fitted.mast, folder)
    (offset, their_offset), (twist, their_twist) = axes.offset_mm, axes.twist_mrad
    place = [fitted.parameter_names.index(f"mast.{name}") for name in ("axis_offset_m", "axis_twist_rad")]
    sigma = 1e3 * np.sqrt(np.diag(fitted.covariance)[place])
    return {
        "msl": _table(
            "camera | labels | position rms, worst (mm) | orientation rms, worst (mrad) "
            "| shift rms, worst (px)",
            rows,
        ),
        "msl-printed": _table(
            "of a perfect mast, ten draws | least | median | most",
            [
                f"{name} | {min(values):.4f} | {np.median(values):.4f} | {max(values):.4f}"
                for name, values in spread.items()
            ],
        ),
        "msl-axes": _table(
            "quantity | fitted to twelve labels, against the flight software",
            [
                f"direction of the pan axis | {axes.pan_axis_mrad:.4f} mrad apart",
                f"direction of the tilt axis | {axes.tilt_axis_mrad:.4f} mrad apart",
                f"mast origin from the pan axis | {axes.pan_line_mm:.4f} mm",
                f"head origin from the tilt axis | {axes.tilt_line_mm:.4f} mm",
                f"axis offset a | {offset:.4f} (sigma {sigma[0]:.4f}) mm, "
                f"flight software {their_offset:.4f} mm",
                f"axis twist k | {twist:.4f} (sigma {sigma[1]:.4f}) mrad, "
                f"flight software {their_twist:.4f} mrad",
            ],
        ),
    }


def mer_blocks(folder: Path) -> dict[str, str]:
    """Return the tables about the Opportunity frames."""
    products = mer.labels(folder)
    fitted = mer.fit(products)
    rover = mer.rig(fitted, products)
    clock = ManualClock()
    recording = mer.replay(folder, clock)
    views = mer.views(recording, clock, rover)
    found = {
        name: (views[a], views[b], *mer.carried_features(views[a], views[b]))
        for name, (a, b) in PAIRS.items()
    }
    rehearsals = {
        name: [mer.rehearse(pair[0], pair[1], pair[3], index, rover) for index in range(len(pair[3]))]
        for name, pair in found.items()
    }
    return {
        "mer-fit": _mer_fit(products),
        "mer-pairs": _table(
            "frames | features seen | matched | range (m) | across: median, rms, worst (px) | mean (px) "
            "| after a free turn: median, rms (px) | bound to the line: matched, median (px)",
            [f"{name} | {PAIR_ROW.format_map(mer.pair_result(*pair))}" for name, pair in found.items()],
        ),
        "mer-pointing": _table(
            "frames | pointings | residual median x, y (px) | rms x, y (px) | worst (px) "
            "| solved from recorded angles (rad)",
            [_rehearsal_row(name, some) for name, some in rehearsals.items()],
        ),
    }


def _below(value: float) -> str:
    """A tiny number, without pretending to know rounding's digits."""
    return "below 1e-9" if value < 1e-9 else f"{value:.1e}"


def _mer_fit(products: list[PdsProduct]) -> str:
    """The fit to the published models, and each model predicted from the other four."""
    rows = []
    for parameters in (6, 8):
        differences = mer.fit(products, parameters).residuals
        rows.append(f"{parameters} parameters, all five | {_worst(differences)}")
    left_out = []
    for index, product in enumerate(products):
        rest = mer.fit([one for other, one in enumerate(products) if other != index])
        assert product.camera_model is not None
        predicted = rest.camera_in_rover(
            product.azimuth_measured_rad or 0.0, product.elevation_measured_rad or 0.0
        )
        left_out.append(model_difference(product.camera_model, predicted))
    rows.append(f"6 parameters, each from the other four | {_worst(left_out)}")
    return _table("fit | position worst (mm) | orientation worst (mrad) | shift worst (px)", rows)


def _worst(differences: Sequence[ModelDifference]) -> str:
    position = max(float(np.linalg.norm(one.position_m)) for one in differences) * 1e3
    turn = max(float(np.linalg.norm(one.rotation_rad)) for one in differences) * 1e3
    shift = max(float(np.linalg.norm(one.shift_px, axis=-1).max()) for one in differences)
    return f"{position:.4f} | {turn:.4f} | {shift:.4f}"


def _errors_row(name: str, found: msl.LabelErrors) -> str:
    return (
        f"{name} | {found.labels} | {found.position_rms_mm:.4f}, {found.position_max_mm:.4f} "
        f"| {found.orientation_rms_mrad:.4f}, {found.orientation_max_mrad:.4f} "
        f"| {found.shift_rms_px:.4f}, {found.shift_max_px:.4f}"
    )


PAIR_ROW = (
    "{seen} | {matched} | {nearest_m:.1f}-{farthest_m:.1f} | {median_px:.2f}, {rms_px:.2f}, {worst_px:.2f} "
    "| {mean_px:+.2f} | {turned_median_px:.2f}, {turned_rms_px:.2f} "
    "| {on_line_matched}, {on_line_median_px:.2f}"
)


def _rehearsal_row(name: str, some: list[mer.Rehearsal]) -> str:
    off = np.array([one.residual_px for one in some])
    median, rms = np.median(np.abs(off), axis=0), np.sqrt((off**2).mean(axis=0))
    worst = float(np.linalg.norm(off, axis=1).max())
    return (
        f"{name} | {len(some)} | {median[0]:.2f}, {median[1]:.2f} | {rms[0]:.2f}, {rms[1]:.2f} | {worst:.2f} "
        f"| {_below(max(one.off_rad for one in some))}"
    )


def _table(header: str, rows: list[str]) -> str:
    """A table in Markdown."""
    rule = " | ".join("---" for _ in header.split(" | "))
    return "\n".join(f"| {line} |" for line in (header, rule, *rows))


if __name__ == "__main__":
    end(main)
