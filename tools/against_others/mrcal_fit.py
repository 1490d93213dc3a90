"""The mrcal side of compare_calibration.py: run by it under an interpreter that has mrcal, not by hand.

Reads one JSON request from standard input: {"lens": mrcal's name, "size_px", "intrinsics": the start's,
"pixels": [image][corner][2], "rounds": N} and either "boards": poses of camera_from_board (rotation vector
and shift) with "columns", "rows", "spacing_m", which are fitted too; or "points": [n][3] fixed points with
"camera_from_points", which is fitted, and "probe": more points to predict. Answers one JSON line:
{"pixels": fitted, "probe": predicted, "seconds": processor time of one fit} or {"refused": why}.
Needs nothing of this project. mrcal's own weak regularization stays on, its outlier rejection is off.
"""

from __future__ import annotations

import json
import statistics
import sys
import time

import mrcal
import numpy as np


def fit(request: dict) -> dict:
    """Fit as often as asked, each time from the same start."""
    times = []
    for _ in range(request["rounds"]):
        intrinsics = np.array([request["intrinsics"]], dtype=float)
        given = boards(request) if "boards" in request else fixed_points(request)
        start = time.thread_time()
        try:
            mrcal.optimize(
                intrinsics,
                given["camera"],
                given["boards"],
                given["points"],
                given["corners"],
                given["corner_indices"],
                given["pixels"],
                given["pixel_indices"],
                request["lens"],
                imagersizes=np.array([request["size_px"]], dtype=np.int32),
                do_apply_outlier_rejection=False,
                do_optimize_calobject_warp=False,
                **given["options"],
            )
        except Exception as error:
            return {"refused": str(error)}
        times.append(time.thread_time() - start)
    if "boards" in request:
        plane = mrcal.ref_calibration_object(request["columns"], request["rows"], request["spacing_m"])
        seen = [mrcal.transform_point_rt(pose, plane.reshape(-1, 3)) for pose in given["boards"]]
        probe = np.zeros((0, 3))
    else:
        seen = [mrcal.transform_point_rt(given["camera"][0], given["points"])]
        probe = np.array(request["probe"], dtype=float).reshape(-1, 3)
        probe = mrcal.transform_point_rt(given["camera"][0], probe) if len(probe) else probe
    return {
        "pixels": mrcal.project(np.concatenate(seen), request["lens"], intrinsics[0]).tolist(),
        "probe": mrcal.project(probe, request["lens"], intrinsics[0]).tolist() if len(probe) else [],
        "seconds": statistics.median(times),
    }


def boards(request: dict) -> dict:
    """Boards whose poses are free, seen by a camera at the reference."""
    pixels = np.array(request["pixels"], dtype=float).reshape(-1, request["rows"], request["columns"], 2)
    frames = np.arange(len(pixels), dtype=np.int32)
    return {
        "camera": None,
        "boards": np.array(request["boards"], dtype=float),
        "points": None,
        "corners": np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1),
        "corner_indices": np.stack([frames, 0 * frames, 0 * frames - 1], axis=-1),
        "pixels": None,
        "pixel_indices": None,
        "options": {"calibration_object_spacing": request["spacing_m"]},
    }


def fixed_points(request: dict) -> dict:
    """Points that are known, seen by a camera whose pose is free."""
    points = np.array(request["points"], dtype=float)
    pixels = np.array(request["pixels"], dtype=float).reshape(-1, 2)
    numbers = np.arange(len(points), dtype=np.int32)
    return {
        "camera": np.array([request["camera_from_points"]], dtype=float),
        "boards": None,
        "points": points,
        "corners": None,
        "corner_indices": None,
        "pixels": np.concatenate([pixels, np.ones((len(pixels), 1))], axis=-1),
        "pixel_indices": np.stack([numbers, 0 * numbers, 0 * numbers], axis=-1),
        "options": {
            "Npoints_fixed": len(points),
            "do_optimize_frames": False,
            "point_min_range": 1e-3,
            "point_max_range": 1e3,
        },
    }


if __name__ == "__main__":
    print(json.dumps(fit(json.load(sys.stdin))), flush=True)
