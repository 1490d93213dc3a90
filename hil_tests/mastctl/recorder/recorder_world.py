"""What the recorder's tests share: a mast file, frames, and recordings read by the mcap library alone."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from calib.files.mast_file import parse_rig
from drivers.clock import SystemClock
from drivers.interfaces import Image
from mastctl.config import load_config
from mastctl.control.publisher import Publisher, Topic
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.errors import NotKnown
from mastctl.recorder.entries import AttachedMast
from mastctl.recorder.folder import RecordSettings
from mastctl.recorder.recorder import Recorder
from mastctl.recorder.writer import Attached
from mastctl.service.service import published_value

CONFIG = Attached("config.yaml", b"schema: mastctl/config/1\n")


def mast() -> AttachedMast:
    path = load_config().mast_file
    data = path.read_bytes()
    return AttachedMast(parse_rig(data, path).rig, Attached(path.name, data))


def picture(seed: int = 0, shape: tuple[int, ...] = (24, 32)) -> Image:
    image = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    image.setflags(write=False)
    return image


def frame(
    number: int, image: Image | None = None, jpeg: bytes = b"", camera: str = "navcam_left"
) -> StampedFrame:
    image = picture(number) if image is None else image
    facts = (
        f"{camera}-{number:06d}-aaaaaaaa-bbbb",
        camera,
        number,
        100.0 + number,
        0.01,
        0.25,
        -0.5,
        False,
        "ab",
    )
    return StampedFrame(*facts, image, jpeg=jpeg, true_pan_rad=0.25, true_tilt_rad=-0.5)


def reading(pan_rad: float, moving: bool = True) -> HeadReading:
    return HeadReading(pan_rad, 0.0, moving, 100.0, true_rad=(pan_rad, 0.0))


class Recording:
    """A recorder, and the publisher that it reads."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.publisher, self.mast = Publisher(), mast()
        wanted = RecordSettings.model_construct(**{"ring_s": 600.0, "free_mb": 0.0} | settings)
        facts, clock = {"hardware": "simulated"}, SystemClock()
        self.recorder = Recorder(
            wanted, folder, lambda: self.mast, [CONFIG], facts, self.publisher, _gone, as_published, clock
        )
        self.publish, self.summary = self.publisher.publish, self.recorder.summary

    def written(self) -> None:
        """Wait until what was published so far was handled."""
        with pytest.raises(NotKnown):
            self.recorder.delete("none")


def as_published(topic: Topic, value: Any) -> Any:
    """What is published in these tests is a record already, or what the daemon's head publishes."""
    return value if isinstance(value, dict) else published_value(topic, value, 100.0)


def _gone(frame_id: str) -> StampedFrame:
    raise NotKnown("frame_unknown", f"{frame_id} is not kept any more")


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.mcap"))


def messages(path: Path, topic: str | None = None) -> Iterator[tuple[Any, Any, Any]]:
    """What the library's own reader finds, by the index."""
    with path.open("rb") as file:
        yield from make_reader(file, validate_crcs=True).iter_messages(topic)


def records(path: Path, topic: str) -> list[Any]:
    return [json.loads(message.data) for _, _, message in messages(path, topic)]
