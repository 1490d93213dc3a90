"""Live pictures: the newest only, at the pace of who shows them, with their facts, clickable while shown."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import HTTP, PLAIN, FakeHardware, fake_daemon
from hil_tests.mastctl.web.network import network_daemon
from hil_tests.waiting import NET_S, until
from mastctl.daemon import RunningDaemon
from mastctl.web import pictures

BOTH = tuple[RunningDaemon, FakeHardware]
LEFT, RIGHT = "navcam_left", "navcam_right"


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[BOTH]:
    with fake_daemon(monkeypatch, tmp_path) as made:
        yield made


def watching(url: str, *cameras: str, **options: Any) -> connect:
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
    frame = daemon.service.devices.frame_by_id(facts["frame_id"])
    assert facts["camera"] == LEFT
    for name in ("mid_exposure_s", "pan_rad", "tilt_rad", "mast_digest", "moving", "exposure_s"):
        assert facts[name] == getattr(frame, name)
    assert facts["size_px"] == [64, 48] and image.shape == frame.image.shape
    assert 0.0 <= facts["age_s"] < NET_S, "by the clock of its exposure"
    assert not facts["reduced"]


def test_who_shows_none_is_sent_one_and_then_none_until_it_says_so(pair: BOTH) -> None:
    daemon, hardware = pair
    with watching(daemon.url, LEFT) as line:
        first = received(line)[0]
        with pytest.raises(TimeoutError):
            line.recv(timeout=0.2)
        asked = len(hardware.fake_cameras[LEFT].asked)
        with pytest.raises(TimeoutError):
            line.recv(timeout=0.2)
        assert len(hardware.fake_cameras[LEFT].asked) == asked, "nobody is ready, so the camera is not asked"
        line.send(LEFT)
        second = received(line)[0]
    assert first["sequence"] < second["sequence"]
    assert second["mid_exposure_s"] - first["mid_exposure_s"] > 0.2, "the newest, not the next in a queue"


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
            message = line.recv(timeout=NET_S)
            length = int.from_bytes(message[:4], "little")
            facts = json.loads(message[4 : 4 + length])
            assert facts["reduced"] == bool(most) and facts["size_px"] == [64, 48]
            assert before_s <= facts["sent_s"] - facts["age_s"] <= time.monotonic(), "when it was exposed"
            sizes.append(len(message) - 4 - length)
        assert sizes[0] > 2000 >= sizes[1] > 900 >= sizes[2] > sizes[3], "the smallest there is, at least"


def test_the_clicked_picture_stays_known_while_it_is_shown_however_many_another_page_takes(
    pair: BOTH,
) -> None:
    daemon, _ = pair
    before = set(threading.enumerate())
    with watching(daemon.url, LEFT) as slow, watching(daemon.url, LEFT) as quick:
        shown = received(slow)[0]["frame_id"]
        for _ in range(20):
            received(quick)
            quick.send(LEFT)
        assert daemon.service.devices.frame_by_id(shown).frame_id == shown
    until(lambda: nobody_watches(before), "both have left")
    assert not [key for key in daemon.service.devices._store._held if key[0] != "asked"]


def test_a_snapshot_stays_known_while_somebody_watches(pair: BOTH) -> None:
    daemon, _ = pair
    with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as http:
        taken = http.get(f"/snapshot/{LEFT}").headers["X-Mastctl-Frame-Id"]
        with watching(daemon.url, LEFT) as line:
            for _ in range(20):
                received(line)
                line.send(LEFT)
        answer = http.get(f"/snapshot/{LEFT}?frame_id={taken}")
    assert answer.status_code == 200, answer.text


def test_what_is_only_watched_is_not_published_until_somebody_takes_it(pair: BOTH) -> None:
    daemon, _ = pair
    with (
        daemon.service.machine.publisher.subscribe("frame", known=False) as news,
        watching(daemon.url, LEFT) as line,
    ):
        facts = received(line)[0]
        assert news.wait(0.0) == []
        daemon.service.devices.hold(daemon.service.devices.frame_by_id(facts["frame_id"]))
        daemon.service.devices.hold(daemon.service.devices.frame_by_id(facts["frame_id"]))
        assert [one.value.frame_id for one in news.wait(NET_S)] == [facts["frame_id"]]


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


def nobody_watches(before: set[threading.Thread]) -> bool:
    """Whether no thread but those of before, which are other daemons', asks a camera for pictures."""
    now = set(threading.enumerate()) - before
    return not any(thread.name.startswith("pictures of ") for thread in now)


def test_nobody_watching_asks_no_camera(pair: BOTH) -> None:
    daemon, hardware = pair
    before = set(threading.enumerate())
    with watching(daemon.url, LEFT) as line:
        received(line)
    until(lambda: nobody_watches(before), "the camera's thread has ended")
    asked = len(hardware.fake_cameras[LEFT].asked)
    with watching(daemon.url, RIGHT) as line:
        received(line)
    assert len(hardware.fake_cameras[LEFT].asked) == asked


@pytest.mark.parametrize("query, status", [("", 422), ("?camera=nobody", 404), ("?camera=a&quality=3", 422)])
def test_what_makes_no_sense_is_refused_before_it_is_opened(standing: BOTH, query: str, status: int) -> None:
    address = f"ws{standing[0].url.removeprefix('http')}/api/v1/images{query}"
    with pytest.raises(InvalidStatus) as refused, connect(address, proxy=None):
        pass
    assert refused.value.response.status_code == status
    assert b'"error"' in (refused.value.response.body or b"")


@pytest.mark.parametrize(
    "words, code", [("x" * 101, 1003), (b"navcam_left", 1003), ("é", 1003), ("navcam_left -1", 1003)]
)
def test_what_is_no_camera_s_name_ends_it(pair: BOTH, words: str | bytes, code: int) -> None:
    with watching(pair[0].url, LEFT) as line:
        line.send(words)
        with pytest.raises(ConnectionClosed) as ended:
            while True:
                line.recv(timeout=NET_S)
    assert ended.value.rcvd is not None and ended.value.rcvd.code == code


def test_too_many_words_end_it_and_a_stop_comes_through_meanwhile(pair: BOTH) -> None:
    daemon, _ = pair
    with watching(daemon.url, LEFT) as line, pytest.raises(ConnectionClosed) as ended:
        for _ in range(2000):
            line.send("nobody")
        assert HTTP.post(f"{daemon.url}/api/v1/stop").status_code == 200
        while True:
            line.recv(timeout=NET_S)
    assert ended.value.rcvd is None or ended.value.rcvd.code == 1008


def test_the_daemon_s_end_ends_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        line = watching(daemon.url, LEFT).__enter__()
        received(line)
    with pytest.raises(ConnectionClosed) as ended:
        while True:
            line.recv(timeout=NET_S)
    assert ended.value.rcvd is not None and ended.value.rcvd.code in (1001, 1012)


def test_a_token_is_asked_for_where_one_is_needed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with network_daemon(monkeypatch, tmp_path) as net:
        address = f"ws://127.0.0.1:{net.port}/api/v1/images?camera={LEFT}"
        for headers in ({}, {"Authorization": f"Bearer {net.token('view')}", "Origin": "http://evil.test"}):
            with (
                pytest.raises(InvalidStatus) as refused,
                connect(address, proxy=None, additional_headers=headers),
            ):
                pass
            assert refused.value.response.status_code in (401, 403)
        shown = {"Authorization": f"Bearer {net.token('view')}"}
        with connect(address, proxy=None, additional_headers=shown) as line:
            assert received(line)[0]["camera"] == LEFT
