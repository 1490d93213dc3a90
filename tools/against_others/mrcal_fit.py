"""The mrcal side of `families`: run by it under an interpreter that has mrcal, not by hand.

Reads one JSON request from standard input: {"lens": mrcal's name, "size_px", "intrinsics": the start's,
"pixels": [image][corner][2], "boards": poses of camera_from_board (rotation vector and shift) with "columns",
"rows", "spacing_m"}; camera and poses are fitted. Answers one JSON line: {"pixels": fitted} or
{"refused": why}. Needs nothing of this project. mrcal's own weak regularization stays on, its outlier
rejection is off.
"""

from __future__ import annotations

import json
import sys

import mrcal
import numpy as np


def fit(request: dict) -> dict:
    """Fit the camera, and the boards whose poses are free."""
    intrinsics = np.array([request["intrinsics"]], dtype=float)
    boards = np.array(request["boards"], dtype=float)
    pixels = np.array(request["pixels"], dtype=float).reshape(-1, request["rows"], request["columns"], 2)
    frames = np.arange(len(pixels), dtype=np.int32)
    try:
        mrcal.optimize(
            intrinsics, None, boards, None,
            np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1),
            np.stack([frames, 0 * frames, 0 * frames - 1], axis=-1),
            None, None, request["lens"],
            imagersizes=np.array([request["size_px"]], dtype=np.int32),
            calibration_object_spacing=request["spacing_m"],
            do_apply_outlier_rejection=False,
            do_optimize_calobject_warp=False,
        )  # fmt: skip
    except Exception as error:
        return {"refused": str(error)}
    plane = mrcal.ref_calibration_object(request["columns"], request["rows"], request["spacing_m"])
    seen = [mrcal.transform_point_rt(pose, plane.reshape(-1, 3)) for pose in boards]
    return {"pixels": mrcal.project(np.concatenate(seen), request["lens"], intrinsics[0]).tolist()}


if __name__ == "__main__":
    print(json.dumps(fit(json.load(sys.stdin))), flush=True)
