"""Follow the target of stored sequences with a tracker of opencv-contrib: a worker of `trackers`.

Runs in an environment of its own, which has NumPy and opencv-contrib and nothing of this project:

    python contrib_tracker.py CSRT 41 SEQUENCE.npz ...

prints one JSON object a sequence: found pixels (20, 2, 2), null where it said lost, and milliseconds of
processor time (20,) of an update of both eyes.
"""

from __future__ import annotations

import json
import sys
import time

import cv2
import numpy as np


def main() -> None:
    """Track and print."""
    kind, side, files = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
    cv2.setNumThreads(1)
    create = getattr(cv2, f"Tracker{kind}_create", None)
    if create is None:
        sys.exit(
            f"OpenCV {cv2.__version__} of {sys.executable} has no tracker {kind}; it wants opencv-contrib"
        )
    for file in files:
        with np.load(file) as data:
            images, truth = data["images"], data["truth_px"]
        # These trackers want colour, and boxes of whole pixels: what is cut off is kept and added again.
        corners = np.rint(truth[0] - side / 2).astype(int)
        offset = truth[0] - corners
        trackers = []
        for index in range(2):
            trackers.append(create())
            colour = cv2.cvtColor(images[0, index], cv2.COLOR_GRAY2BGR)
            trackers[index].init(colour, (*corners[index].tolist(), side, side))
        pixels, times = [], []
        for pair in images[1:]:
            start = time.process_time()
            found: list[list[float] | None] = []
            for index in range(2):
                ok, box = trackers[index].update(cv2.cvtColor(pair[index], cv2.COLOR_GRAY2BGR))
                scale = np.array(box[2:]) / side
                found.append((np.array(box[:2]) + scale * offset[index]).tolist() if ok else None)
            times.append(1e3 * (time.process_time() - start))
            pixels.append(found)
        print(json.dumps({"pixels": pixels, "milliseconds": times}), flush=True)


if __name__ == "__main__":
    main()
