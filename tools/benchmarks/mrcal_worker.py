"""The mrcal side of bench_geometry.py: run by it under an interpreter that has mrcal, not by hand.

Reads one JSON request a line: {"task": forward | gradient | inverse, "lens": mrcal's name,
"intrinsics": [...], "input": FILE.npy, "repeats": N, "output": FILE.npy or null}. Answers one JSON line:
{"seconds": processor time a call} or {"refused": why}. Needs nothing of this project.
"""

from __future__ import annotations

import json
import sys
import time

import mrcal
import numpy as np


def timed(request: dict) -> dict:
    """Carry out one request."""
    points = np.load(request["input"])
    intrinsics = np.array(request["intrinsics"])
    task, lens = request["task"], request["lens"]

    def once() -> np.ndarray:
        if task == "inverse":
            return mrcal.unproject(points, lens, intrinsics, normalize=True)
        if task == "gradient":
            return mrcal.project(points, lens, intrinsics, get_gradients=True)[1]
        return mrcal.project(points, lens, intrinsics)

    if request["output"]:
        start = time.thread_time()
        try:
            result = once()
        except Exception as error:
            return {"refused": str(error)}
        np.save(request["output"], result)
        return {"seconds": time.thread_time() - start}
    start = time.thread_time()
    for _ in range(request["repeats"]):
        once()
    return {"seconds": (time.thread_time() - start) / request["repeats"]}


if __name__ == "__main__":
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        print(json.dumps(timed(json.loads(line))), flush=True)
