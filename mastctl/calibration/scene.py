"""From pictures of a still scene to a corrected mast file: read, judged, saved."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.calibrate.scene.features import find_features
from calib.calibrate.scene.fit import SceneFit, fit_scene
from calib.calibrate.scene.terms import SceneView, corrected, overlapping
from calib.errors import NoCorrection
from calib.files.mast_file import StoredRig
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import RigCovariance, stored_covariance
from calib.geometry.parameters import parameter_names
from calib.geometry.rig import UNKNOWN, Approach, Rig
from calib.geometry.rigid import FloatArray, tangents
from calib.matching.warp import grey
from drivers.errors import BadOptions
from drivers.recordings.frames import (
    SUFFIX,
    McapFrame,
    RecordedPointing,
    read_folder,
    read_products,
    read_recording,
)
from mastctl.calibration.mast_file import rounded_matrix, with_correction
from mastctl.calibration.run import save_new

CSV_NAME = "frames.csv"
PRODUCT_SUFFIXES = (".img", ".lbl")


@dataclass(frozen=True, eq=False)
class SceneProposal:
    """What pictures of a scene say of a mast file: the mast, the record, its views by camera, and the fit.

    ``other_mast`` is how many of the pictures were taken while another mast file was in use: what the joints
    read counts all the same.
    """

    mast: StoredRig
    record: Path
    digest: str
    views: tuple[SceneView, ...]
    fit: SceneFit
    other_mast: int


def scene_views(rig: Rig, record: Path, camera: str | None = None) -> list[SceneView]:
    """Return the pictures of a record with the angles they were taken at; of cameras that the rig has.

    Parameters
    ----------
    rig
        Whose cameras count.
    record
        A recording (.mcap, or a folder of its segments), a CSV ``camera,pan_rad,tilt_rad,file`` (or a folder
        with ``frames.csv``), or a folder of PDS3 products, whose camera is ``camera``.
    camera
        Only this camera's pictures.

    Raises
    ------
    NoCorrection
        ``too_few``: fewer than two pictures of the rig's cameras.
    BadOptions
        If the record cannot be read.
    """
    views = []
    pointings = _pointings(rig, record, camera)
    for pose, pointing in enumerate(pointings):
        for name, frame in pointing.frames.items():
            if name not in rig.cameras or (camera is not None and name != camera):
                continue
            image = grey(frame.image())
            if image.shape[::-1] != rig.cameras[name].model.size_px:
                size = "{} x {}".format(*rig.cameras[name].model.size_px)
                found = f"a picture of {name} has {image.shape[1]} x {image.shape[0]} px"
                raise BadOptions(f"{record}: {found} where {size} is expected", device=name)
            label = f"{name} at pan {pointing.pan_rad:.3f}, tilt {pointing.tilt_rad:.3f}"
            views.append(
                SceneView(label, name, image, pointing.pan_rad, pointing.tilt_rad, pose, _approach(frame))
            )
    if len(views) < 2:
        wanted = camera or ", ".join(rig.cameras)
        has = sorted({name for one in pointings for name in one.frames})
        found = f"{len(views)} pictures of {wanted} in a record of {', '.join(has) or 'none'}"
        raise NoCorrection("too_few", f"{record}: {found}; two at least are expected")
    return views


def _other_mast(mast: StoredRig, pointings: Sequence[RecordedPointing]) -> int:
    """How many pictures were taken while another mast file was in use, where the record says."""
    frames = [frame for pointing in pointings for frame in pointing.frames.values()]
    told = [frame.facts.get("mast_digest") for frame in frames if isinstance(frame, McapFrame)]
    return sum(digest not in (None, "", mast.digest) for digest in told)


def _approach(frame: object) -> Approach:
    if not isinstance(frame, McapFrame):
        return UNKNOWN
    pan, tilt = (float(frame.facts.get(f"{axis}_approach") or 0.0) for axis in ("pan", "tilt"))
    return pan, tilt


def _pointings(rig: Rig, record: Path, camera: str | None) -> Sequence[RecordedPointing]:
    """Where the head rested, and what its cameras took there."""
    if record.is_dir():
        if (record / CSV_NAME).is_file():
            return read_folder(record / CSV_NAME)
        products = sorted(one for one in record.iterdir() if one.suffix.lower() in PRODUCT_SUFFIXES)
        if products:
            if camera is None and len(rig.cameras) != 1:
                names = ", ".join(rig.cameras)
                raise BadOptions(
                    f"{record} holds PDS3 products: --camera with one of {names} is expected", device="record"
                )
            return read_products(products, camera or next(iter(rig.cameras)))
        return read_recording(record)
    return read_recording(record) if record.suffix == SUFFIX else read_folder(record)


def propose_scene(
    mast: StoredRig, record: Path, joint_sigma_rad: float, camera: str | None = None
) -> SceneProposal:
    """Return what a record says of a mast file.

    Raises
    ------
    NoCorrection
        If it tells no correction: ``too_few`` features, ``not_significant``, ``changed_halfway``,
        ``errs_by_reading``, or ``not_predictive``: what explains some of the pictures does not hold for the
        others.
    """
    views = scene_views(mast.rig, record, camera)
    other = _other_mast(mast, _pointings(mast.rig, record, camera))
    if not overlapping([view.model(mast.rig) for view in views]):
        raise NoCorrection(
            "too_few",
            f"{record}: no two of {len(views)} pictures overlap, as {mast.path.name} has the head; a fifth "
            "or more is expected",
        )
    try:
        fit = fit_scene(mast.rig, views, find_features(mast.rig, views), joint_sigma_rad)
    except NoCorrection as why:
        if why.code == "too_few" and other:
            raise NoCorrection(why.code, f"{why}; {other} were taken with another mast file") from None
        raise
    before, after = fit.predicted_px
    if not after < before:
        reason = f"{before:.2f} px become {after:.2f} px rms"
        if np.isnan(after):
            reason = "all join the same two rests"
        gain = f"would explain {fit.rms_px[0]:.2f} px down to {fit.rms_px[1]:.2f} px rms"
        raise NoCorrection(
            "not_predictive",
            f"{', '.join(fit.taken)}: that {gain}, but pictures that had no part in it are not "
            f"predicted better ({reason}): rests of the head err each by itself",
        )
    return SceneProposal(mast, record, _digest(views), tuple(views), fit, other)


def save_scene(proposal: SceneProposal, out: Path) -> tuple[StoredRig, Path | None]:
    """Save the corrected mast file; return it, and where ``out``'s former one is. Raises BadFile."""
    rig, fit = proposal.mast.rig, proposal.fit
    known = stored_covariance(rig)
    known = None if known is None else _widened(rig, known, fit)
    by = {
        "scene": proposal.record.name,
        "pictures_digest": proposal.digest,
        "corrected": list(fit.taken),
    }
    return save_new(
        with_correction(proposal.mast, fit.rig, known, {"refined_scene": scene_told(fit)}, by), out
    )


def scene_told(fit: SceneFit) -> dict[str, Any]:
    """Return a correction as JSON or YAML."""
    sigma = np.sqrt(np.diag(fit.covariance))
    return {
        "corrected": list(fit.taken),
        "significance_sigmas": dict(fit.gains),
        "parameters": list(fit.names),
        "values": fit.values.tolist(),
        "sigma": sigma.tolist(),
        "covariance": rounded_matrix(fit.covariance).tolist(),
        "unseen": list(fit.unseen),
        "features": len(fit.features),
        "outliers": list(fit.outliers),
        "rms_px": dict(zip(("before", "after", "with_rests"), fit.rms_px, strict=True)),
        "median_px": dict(zip(("before", "after", "with_rests"), fit.median_px, strict=True)),
        "joint_sigma_rad": fit.joint_sigma_rad,
        "predicted_rms_px": {"before": fit.predicted_px[0], "after": fit.predicted_px[1]},
        "chi2_per_freedom": fit.scale,
    }


def _widened(rig: Rig, known: RigCovariance, fit: SceneFit) -> RigCovariance:
    """The mast file's covariance and the correction's, added: too much rather than too little.

    The correction was measured against cameras and axes as the file has them, so both errors stay.
    """
    rates = np.zeros((len(known.names), len(fit.names)))
    at = {name: i for i, name in enumerate(known.names)}
    bit = 1e-6
    for column in range(len(fit.names)):
        step = np.zeros(len(fit.names))
        step[column] = bit
        moved = corrected(rig, fit.names, step)
        for name, camera in rig.cameras.items():
            model = camera.model
            change = _parameter_change(model, moved.cameras[name].model) / bit
            for part, value in zip(parameter_names(model.kind), change, strict=True):
                if (full := f"cameras.{name}.{part}") in at:
                    rates[at[full], column] = value
        if fit.names[column] in at:
            rates[at[fit.names[column]], column] = 1.0
    total = known.covariance + rates @ fit.covariance @ rates.T
    return RigCovariance(known.names, (total + total.T) / 2)


def _parameter_change(model: CameraModel, moved: CameraModel) -> FloatArray:
    """How a camera's parameters changed, in the order of a step."""
    change = [
        moved.C - model.C,
        tangents(model.A) @ (moved.A - model.A),
        moved.H - model.H,
        moved.V - model.V,
    ]
    if "O" in model.letters:
        change += [tangents(model.O) @ (moved.O - model.O), (moved.R - model.R)[1:]]
    if "E" in model.letters:
        change.append(moved.E - model.E)
    change.append(moved.distortion - model.distortion)
    return np.concatenate(change)


def _digest(views: Sequence[SceneView]) -> str:
    """SHA-256 of the pictures and their angles."""
    digest = hashlib.sha256()
    for view in views:
        digest.update(f"{view.camera} {view.pan_rad!r} {view.tilt_rad!r}".encode())
        digest.update(view.image.tobytes())
    return digest.hexdigest()
