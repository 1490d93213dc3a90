"""Curiosity: a mast fitted to twelve labels predicts the other 306 (docs/evidence/validation.md)."""

from __future__ import annotations

import csv
import gzip
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

WANTED_ORIENTATION_MRAD = 0.005
POSITION_MM = 0.0065
SHIFT_PX = 0.0015
FEWER = 6
"""Every so many of the labels where a rough number is enough."""


@pytest.fixture(scope="module")
def labels(msl: ModuleType, msl_folder: Path) -> tuple[list[Any], list[Any]]:
    return msl.read_labels(msl_folder, "A")


@pytest.fixture(scope="module")
def fitted(msl: ModuleType, labels: tuple[list[Any], list[Any]]) -> Any:
    return msl.fit(labels[0])


def test_twelve_labels_predict_the_other_306(
    msl: ModuleType, labels: tuple[list[Any], list[Any]], fitted: Any
) -> None:
    training, others = labels
    assert (len(training), len(others)) == (12, 306)
    found = msl.errors(fitted, others)
    assert found.orientation_rms_mrad <= WANTED_ORIENTATION_MRAD
    assert found.position_rms_mm <= POSITION_MM
    assert found.shift_rms_px <= SHIFT_PX
    fresh = msl.new_pointings(training, others)
    assert len(fresh) == 55
    assert msl.errors(fitted, fresh).orientation_rms_mrad <= WANTED_ORIENTATION_MRAD


def test_the_same_told_by_the_rows_themselves(msl_folder: Path, fitted: Any) -> None:
    """Read with csv alone; orientation from the printed A and H, without projecting anything."""
    training = set(json.loads((msl_folder / "train12_NAV_LEFT_A.json").read_text()))
    with gzip.open(msl_folder / "labels.csv.gz", "rt", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["serial"] == "216"]
    turns = []
    for row in rows:
        if row["product_id"] in training:
            continue
        predicted = fitted.camera_in_rover(float(row["az_measured_rad"]), float(row["el_measured_rad"]))
        printed = [np.array([float(row[f"{letter}_{axis}"]) for axis in "xyz"]) for letter in "AH"]
        turns.append((axes(predicted.A, predicted.H).inv() * axes(*printed)).magnitude() * 1e3)
    assert len(turns) == 306
    assert np.sqrt(np.mean(np.square(turns))) <= WANTED_ORIENTATION_MRAD
    assert max(turns) < 0.01


def axes(a: np.ndarray, h: np.ndarray) -> Rotation:
    a = a / np.linalg.norm(a)
    x = h - (h @ a) * a
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.stack([x, np.cross(a, x), a], axis=-1))


def test_the_fitted_head_turns_as_the_labels_head_frame_does(
    labels: tuple[list[Any], list[Any]], fitted: Any, msl_folder: Path
) -> None:
    """The head's own pose in the labels is a column that the fit never sees: turns between poses agree."""
    with gzip.open(msl_folder / "labels.csv.gz", "rt", newline="") as stream:
        rows = {row["product_id"]: row for row in csv.DictReader(stream)}
    ours, theirs = [], []
    for label in labels[1]:
        row = rows[label.product]
        ours.append(fitted.mast.rover_from_head(label.pan_rad, label.tilt_rad).rotation)
        theirs.append([float(row[f"head_q_{part}"]) for part in "xyzs"])
    our_turns = Rotation.from_matrix(ours) * Rotation.from_matrix(ours[0]).inv()
    their_turns = Rotation.from_quat(theirs) * Rotation.from_quat(theirs[0]).inv()
    apart_mrad = (our_turns * their_turns.inv()).magnitude() * 1e3
    assert their_turns.magnitude().max() > 0.5
    assert np.median(apart_mrad) < 0.008
    assert apart_mrad.max() < 0.02


def test_the_axes_are_those_of_the_flight_software(msl: ModuleType, msl_folder: Path, fitted: Any) -> None:
    found = msl.against_flight_software(fitted.mast, msl_folder)
    assert found.pan_axis_mrad < 0.003
    assert found.tilt_axis_mrad < 0.003
    assert found.pan_line_mm < 0.01
    assert found.tilt_line_mm < 0.01
    assert found.offset_mm[0] == pytest.approx(found.offset_mm[1], abs=0.01)
    assert found.twist_mrad[0] == pytest.approx(found.twist_mrad[1], abs=0.005)


@pytest.mark.parametrize(("change", "at_least_mrad"), [("six parameters", 0.02), ("final angles", 1.0)])
def test_the_wrong_mast_and_the_wrong_angles_are_seen(
    msl: ModuleType, msl_folder: Path, change: str, at_least_mrad: float
) -> None:
    angles = "final" if change == "final angles" else "measured"
    training, others = msl.read_labels(msl_folder, "A", angles)
    others = others[::FEWER]
    fitted = msl.fit(training, 6 if change == "six parameters" else 8)
    assert msl.errors(fitted, others).orientation_rms_mrad > at_least_mrad


def test_camera_b_is_predicted_once_its_lens_is_left_out(msl: ModuleType, msl_folder: Path) -> None:
    training, others = msl.read_labels(msl_folder, "B")
    others = others[::FEWER]
    lens = training[0].model
    with_lens = msl.errors(msl.fit(training), others)
    without = msl.errors(msl.fit(msl.one_lens(training, lens)), msl.one_lens(others, lens))
    assert without.orientation_rms_mrad < 0.007
    assert without.position_rms_mm < 0.03
    assert with_lens.orientation_rms_mrad > 0.1
