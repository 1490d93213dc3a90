"""MSL Navcam labels: a mast fitted to twelve of them predicts the others."""

from __future__ import annotations

import csv
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast
from calib.geometry.rigid import unit_vector
from tools.command import rms
from tools.flight.difference import model_difference, with_one_lens
from tools.flight.poses import PoseFit, fit_poses

CAMERAS = {"A": ("216", "4"), "B": ("215", "6")}
"""Serial number and calibration source of the two left Navcams' labels."""


@dataclass(frozen=True, eq=False)
class Label:
    """One label: the camera model in the rover frame and the measured joint angles."""

    product: str
    model: CameraModel
    pan_rad: float
    tilt_rad: float


@dataclass(frozen=True)
class LabelErrors:
    """Predicted against published models.

    rms and worst of position (mm), orientation (mrad) and of the shift of a grid of pixels (px of the label's
    image).
    """

    labels: int
    position_rms_mm: float
    position_max_mm: float
    orientation_rms_mrad: float
    orientation_max_mrad: float
    shift_rms_px: float
    shift_max_px: float


def read_labels(folder: Path, camera: str, angles: str = "measured") -> tuple[list[Label], list[Label]]:
    """Return the twelve training labels of camera A or B and its other labels of the same calibration.

    ``angles``: ``measured``, which go with the camera models, or ``final``, which do not.
    """
    serial, source = CAMERAS[camera]
    training = json.loads((folder / f"train12_NAV_LEFT_{camera}.json").read_text())
    with gzip.open(folder / "labels.csv.gz", "rt", newline="") as rows:
        labels = [
            _label(row, angles)
            for row in csv.DictReader(rows)
            if row["serial"] == serial and row["calibration_source_id"] == source
        ]
    return (
        [label for label in labels if label.product in training],
        [label for label in labels if label.product not in training],
    )


def _label(row: dict[str, str], angles: str) -> Label:
    def vector(letter: str, names: str = "xyz") -> np.ndarray:
        return np.array([float(row[f"{letter}_{name}"]) for name in names])

    size_px = (int(row["line_samples"]), int(row["lines"]))
    c, a, h, v, o = (vector(letter) for letter in "CAHVO")
    model = CameraModel("CAHVOR", size_px, c, unit_vector(a), h, v, unit_vector(o), vector("R", "012"))
    return Label(row["product_id"], model, float(row[f"az_{angles}_rad"]), float(row[f"el_{angles}_rad"]))


def new_pointings(training: Sequence[Label], others: Sequence[Label]) -> list[Label]:
    """Return one label for each pair of angles that training does not have; many labels repeat angles."""
    known = {(label.pan_rad, label.tilt_rad) for label in training}
    first: dict[tuple[float, float], Label] = {}
    for label in others:
        first.setdefault((label.pan_rad, label.tilt_rad), label)
    return [label for angles, label in first.items() if angles not in known]


def fit(labels: Sequence[Label], parameters: int = 8) -> PoseFit:
    """Fit a mast to labels."""
    models, pan_rad, tilt_rad = zip(*((one.model, one.pan_rad, one.tilt_rad) for one in labels), strict=True)
    return fit_poses(models, pan_rad, tilt_rad, parameters=8 if parameters == 8 else 6)


def one_lens(labels: Sequence[Label], lens: CameraModel) -> list[Label]:
    """Return the labels with their lens replaced: only position and orientation stay their own."""
    models = with_one_lens([label.model for label in labels], lens)
    return [replace(label, model=model) for label, model in zip(labels, models, strict=True)]


def errors(fitted: PoseFit, labels: Sequence[Label]) -> LabelErrors:
    """Compare what a fit predicts with what labels say."""
    position, orientation, shift = [], [], []
    for label in labels:
        predicted = fitted.camera_in_rover(label.pan_rad, label.tilt_rad)
        found = model_difference(label.model, predicted)
        position.append(np.linalg.norm(found.position_m) * 1e3)
        orientation.append(np.linalg.norm(found.rotation_rad) * 1e3)
        shift.append(np.linalg.norm(found.shift_px, axis=-1))
    sizes = (f(values) for values in (position, orientation, shift) for f in (rms, np.max))
    return LabelErrors(len(labels), *map(float, sizes))


def printed_labels(fitted: PoseFit, labels: Sequence[Label], seed: int) -> list[Label]:
    """Return the labels of a perfect mast: the fit's models, printed with six digits as in the labels.

    The printed angles stay; the true ones, from which the models come, lie anywhere within their last digit.
    """
    random = np.random.default_rng(seed)
    made = []
    for label in labels:
        pan, tilt = (
            angle + random.uniform(-0.5, 0.5) * 10.0 ** (np.floor(np.log10(abs(angle))) - 5)
            for angle in (label.pan_rad, label.tilt_rad)
        )
        true = fitted.camera_in_rover(pan, tilt)
        if label.model.size_px != true.size_px:
            true = _resized(true, label.model.size_px)
        c, a, h, v, o = (np.array([float(f"{x:.6g}") for x in getattr(true, letter)]) for letter in "CAHVO")
        model = CameraModel(true.kind, true.size_px, c, unit_vector(a), h, v, unit_vector(o), true.R)
        made.append(replace(label, model=model))
    return made


def _resized(model: CameraModel, size_px: tuple[int, int]) -> CameraModel:
    """Return the model of the same view with more or fewer pixels: (x + 1/2) / w stays."""
    scale = size_px[0] / model.size_px[0]
    move = 0.5 * scale - 0.5
    h, v = model.H * scale + move * model.A, model.V * scale + move * model.A
    return replace(model, size_px=size_px, H=h, V=v)


@dataclass(frozen=True)
class AxisComparison:
    """Fitted axes against the constants of the flight software."""

    pan_axis_mrad: float
    tilt_axis_mrad: float
    pan_line_mm: float
    tilt_line_mm: float
    offset_mm: tuple[float, float]
    twist_mrad: tuple[float, float]


def against_flight_software(mast: Mast, folder: Path) -> AxisComparison:
    """Compare the fitted axes with those that the flight software turns about (rsm_kinematics.json, MSL).

    Its elevation axis is given at azimuth ``el_azimuth`` = 0, where the contract's pan is zero too. Lines are
    compared where the head is: the fitted head origin's distance from each. ``offset`` and ``twist`` are
    (fitted, flight software).
    """
    constants = json.loads((folder / "rsm_kinematics.json").read_text())["MSL"]
    shift = np.array(constants["rmech_to_rnav"])
    pan_point, tilt_point = (np.array(constants[key]) + shift for key in ("az_point_rmech", "el_point_rmech"))
    pan_axis, tilt_axis = (np.array(constants[key], float) for key in ("az_axis", "el_axis"))
    pan_axis, tilt_axis = pan_axis / np.linalg.norm(pan_axis), tilt_axis / np.linalg.norm(tilt_axis)
    across = np.cross(tilt_axis, pan_axis)
    across /= np.linalg.norm(across)
    head = mast.rover_from_head(0.0, 0.0)
    rotation = mast.rover_from_mast.rotation

    def angle_mrad(one: np.ndarray, other: np.ndarray) -> float:
        return float(np.arcsin(np.linalg.norm(np.cross(one, other))) * 1e3)

    def distance_mm(point: np.ndarray, on_line: np.ndarray, axis: np.ndarray) -> float:
        return float(np.linalg.norm(np.cross(point - on_line, axis)) * 1e3)

    return AxisComparison(
        angle_mrad(rotation[:, 2], pan_axis),
        angle_mrad(head.rotation[:, 1], tilt_axis),
        distance_mm(mast.translation_m, pan_point, pan_axis),
        distance_mm(head.translation_m, tilt_point, tilt_axis),
        (mast.axis_offset_m * 1e3, float((tilt_point - pan_point) @ across) * 1e3),
        (mast.axis_twist_rad * 1e3, float(np.arcsin(pan_axis @ tilt_axis)) * 1e3),
    )
