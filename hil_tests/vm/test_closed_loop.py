"""The mast points through real devices: capture nodes of a kernel and servos on a serial line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil_tests.support.closed_loop.run import through_devices

TIMEOUT_S = 900.0
TOLD = "target_not_found"
"""How one target may fail: the sensor's noise chose a pixel at a rock's edge, whose match stays undecided.
No device may: the machine's clock stands while it computes, so that no load makes a reply or a frame late."""


@pytest.mark.long(4, "computes for 37 s on the kernel; its cameras are tried there in the quick run")
def test_targets_land_where_they_should_through_real_devices(vm_kernel: Path, tmp_path: Path) -> None:
    options = ["--targets", "3", "--distances", "6", "--seed", "1"]
    record = through_devices(vm_kernel, tmp_path, options, TIMEOUT_S)
    assert record["hardware"] == "real" and len(record["records"]) == 3
    landed = [target for target in record["records"] if not target["error"]]
    refused = [target["error"] for target in record["records"] if target["error"]]
    assert len(refused) <= 1 and all(error.startswith(TOLD) for error in refused), refused
    for target in landed:
        assert len(target["residuals_px"]) == 2
        measured, true = np.array(target["residuals_px"]), np.array(target["true_px"])
        # In memory the first pointing is off by 0.05 to 0.15 px here, the second by 0.01 to 0.04.
        assert np.abs(true[0]).max() < 0.4 and np.abs(true[1]).max() < 0.15, target
        assert np.abs(measured - true).max() < 0.15, target
