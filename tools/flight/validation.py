"""Make all numbers and pictures of docs/evidence/validation.md from the flight data beside the checkout.

    python -m tools.flight.validation [--data FOLDER] [--write] [--mast-file OUT.yaml]

The tables go to stdout. With --write they also replace the text between the marks
``<!-- numbers: NAME -->`` and ``<!-- end -->`` of docs/evidence/validation.md, and the pictures are renewed.
--mast-file writes the mast file of the replayed rover, for a configuration with the driver ``replay``.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.files.mast_file import save_rig
from calib.files.pds3 import PdsProduct
from calib.geometry.maps import ModelDifference, model_difference
from drivers.clock import ManualClock
from drivers.errors import DriverError
from tools.command import end
from tools.flight import mer, msl
from tools.flight.poses import PoseFit

REPOSITORY = Path(__file__).resolve().parents[2]
DOCUMENT = REPOSITORY / "docs" / "evidence" / "validation.md"
PICTURES = REPOSITORY / "docs" / "img"
PRINTED_SEEDS = range(10)
PAIRS = {"3rd to 4th": (2, 3), "4th to 5th": (3, 4), "1st to 2nd": (0, 1)}


def main() -> int:
    """Run the whole comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=REPOSITORY.parent / "shared" / "data")
    parser.add_argument(
        "--write", action="store_true", help="renew docs/evidence/validation.md and its pictures"
    )
    parser.add_argument("--mast-file", type=Path, help="write the mast file of the replayed rover here")
    arguments = parser.parse_args()
    for name in ("msl_navcam", "mer_navcam"):
        if not (arguments.data / name).is_dir():
            parser.error(f"{arguments.data} has no folder {name}; --data names the folder that holds it")
    blocks = msl_blocks(arguments.data / "msl_navcam", arguments.write)
    blocks |= mer_blocks(arguments.data / "mer_navcam", arguments.write, arguments.mast_file)
    for name, text in blocks.items():
        print(f"## {name}\n\n{text}\n")
    if arguments.write:
        document = DOCUMENT.read_text(encoding="utf-8")
        for name, text in blocks.items():
            document, count = re.subn(
                rf"(<!-- numbers: {name} -->\n).*?(<!-- end -->)",
                lambda found, text=text: f"{found[1]}\n{text}\n\n{found[2]}",
                document,
                flags=re.DOTALL,
            )
            if count != 1:
                print(f"{DOCUMENT}: {count} places for the numbers {name}, one is expected", file=sys.stderr)
                return 1
        DOCUMENT.write_text(document, encoding="utf-8")
    return 0


def msl_blocks(folder: Path, pictures: bool) -> dict[str, str]:
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
    spread = [
        (min(values), float(np.median(values)), max(values))
        for values in (
            [one.position_rms_mm for one in printed],
            [one.orientation_rms_mrad for one in printed],
            [one.shift_rms_px for one in printed],
        )
    ]
    axes = msl.against_flight_software(fitted.mast, folder)
    offset, twist = axes.offset_mm, axes.twist_mrad
    place = [fitted.parameter_names.index(f"mast.{name}") for name in ("axis_offset_m", "axis_twist_rad")]
    sigma = 1e3 * np.sqrt(np.diag(fitted.covariance)[place])
    if pictures:
        from flight_pictures import prediction

        perfect = [
            turns_mrad(
                msl.fit(msl.printed_labels(fitted, training, seed)),
                msl.printed_labels(fitted, others, 1000 + seed),
            )
            for seed in PRINTED_SEEDS
        ]
        path = PICTURES / "msl_prediction.png"
        prediction(turns_mrad(fitted, others), np.concatenate(perfect), path)
    return {
        "msl": _table(
            "camera | labels | position rms, worst (mm) | orientation rms, worst (mrad) "
            "| shift rms, worst (px)",
            rows,
        ),
        "msl-printed": _table(
            "of a perfect mast, ten draws | least | median | most",
            [
                f"position rms (mm) | {spread[0][0]:.4f} | {spread[0][1]:.4f} | {spread[0][2]:.4f}",
                f"orientation rms (mrad) | {spread[1][0]:.4f} | {spread[1][1]:.4f} | {spread[1][2]:.4f}",
                f"shift rms (px) | {spread[2][0]:.4f} | {spread[2][1]:.4f} | {spread[2][2]:.4f}",
            ],
        ),
        "msl-axes": _table(
            "quantity | fitted to twelve labels, against the flight software",
            [
                f"direction of the pan axis | {axes.pan_axis_mrad:.4f} mrad apart",
                f"direction of the tilt axis | {axes.tilt_axis_mrad:.4f} mrad apart",
                f"mast origin from the pan axis | {axes.pan_line_mm:.4f} mm",
                f"head origin from the tilt axis | {axes.tilt_line_mm:.4f} mm",
                f"axis offset a | {told(offset[0], sigma[0])} mm, flight software {offset[1]:.4f} mm",
                f"axis twist k | {told(twist[0], sigma[1])} mrad, flight software {twist[1]:.4f} mrad",
            ],
        ),
    }


def told(value: float, sigma: float) -> str:
    """Return a number with its sigma."""
    return f"{value:.4f} (sigma {sigma:.4f})"


def turns_mrad(fitted: PoseFit, labels: list[msl.Label]) -> np.ndarray:
    """Return the orientation errors of predicted labels."""
    return np.array(
        [
            np.linalg.norm(
                model_difference(x.model, fitted.camera_in_rover(x.pan_rad, x.tilt_rad)).rotation_rad
            )
            * 1e3
            for x in labels
        ]
    )


def mer_blocks(folder: Path, pictures: bool, mast_file: Path | None) -> dict[str, str]:
    """Return the tables about the Opportunity frames."""
    products = mer.labels(folder)
    fitted = mer.fit(products)
    rover = mer.rig(fitted, products)
    if mast_file is not None:
        save_rig(rover, mast_file)
    clock = ManualClock()
    recording = mer.replay(folder, clock)
    views = mer.views(recording, clock, rover)
    found = {
        name: (views[a], views[b], *mer.carried_features(views[a], views[b]))
        for name, (a, b) in PAIRS.items()
    }
    results = {name: mer.pair_result(*pair) for name, pair in found.items()}
    first, second, _, carried = found["3rd to 4th"]
    best = max(range(len(carried)), key=lambda index: carried[index].correlation)
    done = mer.rehearse(first, second, carried, best, rover)
    try:
        recording.pan_tilt.move(done.centre.pan_rad, done.centre.tilt_rad)
        refusal = "none"
    except DriverError as error:
        refusal = str(error)
    rehearsals = {
        name: [mer.rehearse(pair[0], pair[1], pair[3], index, rover) for index in range(len(pair[3]))]
        for name, pair in found.items()
    }
    if pictures:
        from tools.flight import pictures as flight_pictures

        flight_pictures.pointing(first, second, done, PICTURES / "opportunity_pointing.jpg")
        pairs = [
            flight_pictures.PicturePair(
                f"{name} frame", one, other, features, mer.turned(one, other, features)[1]
            )
            for name, (one, other, _, features) in found.items()
            if name != "1st to 2nd"
        ]
        flight_pictures.residuals(pairs, PICTURES / "opportunity_residuals.jpg")
    return {
        "mer-fit": _mer_fit(products),
        "mer-pairs": _table(
            "frames | features seen | matched | range (m) | across: median, rms, worst (px) | mean (px) "
            "| after a free turn: median, rms (px) | bound to the line: matched, median (px)",
            [_pair_row(name, one) for name, one in results.items()],
        ),
        "mer-pointing": _table(
            "frames | pointings | residual median x, y (px) | rms x, y (px) | worst (px) "
            "| solved from recorded angles (rad)",
            [_rehearsal_row(name, some) for name, some in rehearsals.items()],
        ),
        "mer-one": _one_pointing(done, refusal),
    }


def _one_pointing(done: mer.Rehearsal, refusal: str) -> str:
    """The pointing of the picture, step by step."""
    (x, y), target = done.carried.pixel_px, ", ".join(f"{value:.3f}" for value in done.position_m)
    centre, best = done.centre, done.solution
    (ax, ay), (fx, fy), (dx, dy) = done.aim_px, done.carried.found_px, done.residual_px
    to_centre = f"pan {centre.pan_rad:.6f}, tilt {centre.tilt_rad:.6f} rad"
    to_aim = f"pan {best.pan_rad:.6f}, tilt {best.tilt_rad:.6f} rad"
    return "\n".join(
        [
            f"- Feature at ({x:.0f}, {y:.0f}) px of the 3rd frame, in the rover frame ({target}) m.",
            f"- To put it in the image centre: {to_centre}. Replay refuses to go there:",
            f"  `{refusal}`.",
            f"- To put it on pixel ({ax:.2f}, {ay:.2f}): {to_aim}. These are",
            f"  the 4th frame's recorded angles, {_below(done.off_rad)} rad off.",
            f"- Found there at ({fx:.2f}, {fy:.2f}) px: residual ({dx:+.2f}, {dy:+.2f}) px.",
        ]
    )


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


def _pair_row(name: str, found: mer.PairResult) -> str:
    return (
        f"{name} | {found.seen} | {found.matched} | {found.nearest_m:.1f}-{found.farthest_m:.1f} "
        f"| {found.median_px:.2f}, {found.rms_px:.2f}, {found.worst_px:.2f} | {found.mean_px:+.2f} "
        f"| {found.turned_median_px:.2f}, {found.turned_rms_px:.2f} "
        f"| {found.on_line_matched}, {found.on_line_median_px:.2f}"
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
