"""Live pictures: the newest only, at the pace of who shows them, with their facts, clickable while shown."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

import cv2
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.waiting import NET_S
from mastctl.daemon import RunningDaemon
from mastctl.web import pictures

BOTH = tuple[RunningDaemon, FakeHardware]
LEFT, RIGHT = "navcam_left", "navcam_right"


def watching(url: str, *cameras: str, **options: Any) -> ClientConnection:
    query = "&".join(f"camera={name}" for name in cameras)
    address = f"ws{url.removeprefix('http')}/api/v1/images?{query}"
    return connect(address, open_timeout=NET_S, close_timeout=2.0, proxy=None, **options)


def received(line: ClientConnection) -> tuple[dict[str, Any], Any]:
    """The facts and the pixels of the next picture."""
    message = line.recv(timeout=NET_S)
    assert isinstance(message, bytes)
    length = int.from_bytes(message[:4], "little")
    data = np.frombuffer(message[4 + length :], np.uint8)
    return json.loads(message[4 : 4 + length]), cv2.imdecode(data, cv2.IMREAD_UNCHANGED)


def test_a_picture_comes_with_its_facts_and_uncompressed(pair: BOTH) -> None:
    daemon, _ = pair
    with watching(daemon.url, LEFT) as line:
        facts, image = received(line)
        assert line.protocol.extensions == []
    frame = daemon.service.devices.store.by_id(facts["frame_id"])
    assert facts["camera"] == LEFT
    for name in ("mid_exposure_s", "pan_rad", "tilt_rad", "mast_digest", "moving", "exposure_s"):
        assert facts[name] == getattr(frame, name)
    assert facts["size_px"] == [64, 48] and image.shape == frame.image.shape
    assert 0.0 <= facts["age_s"] < NET_S, "by the clock of its exposure"
    assert not facts["reduced"]


def test_a_slow_link_asks_for_the_time_first_and_then_for_small_pictures(pair: BOTH) -> None:
    daemon, hardware = pair
    with watching(f"{daemon.url}", f"{LEFT}&on_request=true") as line:
        before_s = time.monotonic()
        line.send("? 12.5")
        answer = json.loads(line.recv(timeout=NET_S))
        assert answer["asked"] == "12.5" and before_s <= answer["now_s"] <= time.monotonic()
        assert not hardware.fake_cameras[LEFT].asked, "no picture was asked for"
        sizes = []
        for most in ("", " 2000", " 900", " 1"):
            line.send(LEFT + most)
            message = line.recv(timeout=NET_S, decode=False)
            length = int.from_bytes(message[:4], "little")
            facts = json.loads(message[4 : 4 + length])
            assert facts["reduced"] == bool(most) and facts["size_px"] == [64, 48]
            assert before_s <= facts["sent_s"] - facts["age_s"] <= time.monotonic(), "when it was exposed"
            sizes.append(len(message) - 4 - length)
        assert sizes[0] > 2000 >= sizes[1] > 900 >= sizes[2] > sizes[3], "the smallest there is, at least"


def test_a_camera_that_fails_holds_no_other_up_and_comes_back(
    pair: BOTH, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, hardware = pair
    monkeypatch.setattr(pictures, "FAILING_S", 0.01)
    failed = threading.Event()

    def hook() -> None:
        failed.set()
        raise NoReply("no answer", device=RIGHT)

    hardware.fake_cameras[RIGHT].hook = hook
    with watching(daemon.url, LEFT, RIGHT) as line:
        for _ in range(4):
            assert received(line)[0]["camera"] == LEFT
            line.send(LEFT)
        assert failed.wait(NET_S)
        hardware.fake_cameras[RIGHT].hook = lambda: None
        seen = set[str]()
        while RIGHT not in seen:
            name = received(line)[0]["camera"]
            seen.add(name)
            line.send(name)


@pytest.mark.parametrize("query, status", [("", 422), ("?camera=nobody", 404), ("?camera=a&quality=3", 422)])
def test_what_makes_no_sense_is_refused_before_it_is_opened(standing: BOTH, query: str, status: int) -> None:
    address = f"ws{standing[0].url.removeprefix('http')}/api/v1/images{query}"
    with pytest.raises(InvalidStatus) as refused, connect(address, proxy=None):
        pass
    assert refused.value.response.status_code == status
    assert b'"error"' in (refused.value.response.body or b"")
