"""Two webcams of the kernel's vivid driver, and ways to make them misbehave."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.v4l2.camera import V4l2Camera, open_camera
from drivers.v4l2.controls import set_by_name
from drivers.v4l2.find import Address, open_node
from drivers.v4l2.node import Node

BUS = ("platform:vivid-000", "platform:vivid-001")
RATE_HZ = 25.0
TURNED_CLOCK = "time-travel" in Path("/proc/cmdline").read_text()
"""Nothing takes time here but waiting (support/virtual_machine/boot.py); in real time everything does."""

STEADY = {
    "timestamp_source": "start_of_exposure",
    "osd_text_mode": "none",
    "horizontal_movement": "no movement",
    "vertical_movement": "no movement",
    "percentage_of_dropped_buffers": 0,
    "test_pattern": 0,
}
VIVID = Path("/sys/bus/platform/drivers/vivid")


def options(index: int = 0, **more: Any) -> dict[str, Any]:
    """Options of one of the two cameras, a steady picture."""
    controls = {**STEADY, **more.pop("controls", {})}
    return {"bus": BUS[index], "rate_hz": RATE_HZ, "controls": controls, **more}


def inject(index: int, control: str, value: int = 1) -> None:
    """Set a control of a camera, from beside."""
    with open_node(Address(bus=BUS[index]), "beside") as node:
        assert set_by_name(node, {control: value}) == []


@pytest.fixture
def camera() -> Iterator[V4l2Camera]:
    """The first camera, streaming."""
    made = open_camera(options(), name="left")
    yield made
    made.close()


@pytest.fixture(autouse=True)
def healthy() -> Iterator[None]:
    """After each test the driver is bound and its faults are off."""
    yield
    if not (VIVID / "vivid.0").exists():
        (VIVID / "bind").write_text("vivid.0")
    for index in range(2):
        with open_node(Address(bus=BUS[index]), "after") as node:
            reset(node)


def reset(node: Node) -> None:
    """Bring the controls that tests turn back to their defaults."""
    set_by_name(node, {"percentage_of_dropped_buffers": 0, "wrap_timestamp": 0, "test_pattern": 0})
