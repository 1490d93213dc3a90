"""The track over HTTP, with looks that find what a test tells them: poses, refusals, stops, the stream."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.matching.track import KeyPicture, Track
from calib.matching.warp import PosedImage
from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import (
    CONFIG,
    FakeHardware,
    Hang,
    ScriptedLoop,
    asked_plainly,
    fake_daemon,
    rig,
)
from hil_tests.waiting import NET_S, until
from mastctl.answers import CameraPixel
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.motion import track as track_module
from mastctl.motion.search import TrackSighting
from mastctl.motion.steps import Steps

TARGET_M = (5.0, 0.5, 0.0)
SIGMA = (0.01, 0.005)
LOGGED = "tracking: {{handoff_log: handed/over.jsonl}}\n"


class ScriptedSearch(Steps):
    """Stands for `TargetSearch`: a start is at `TARGET_M`; a look is what ``script(track)`` makes of it."""

    script: Callable[[Track], tuple[Track, TrackSighting]]
    begin: Callable[[], None] = lambda: None
    looks: list[Track]

    def __init__(self, rig: Any, devices: Any, clock: Any, settings: Any, *others: Any) -> None:
        super().__init__(rig, devices, clock, *others)

    def begin_at_pixel(self, target: Any) -> tuple[Track, TrackSighting]:
        with self.step("start"):
            type(self).begin()
        camera = rig().cameras["navcam_left"].model
        key = KeyPicture(
            PosedImage(np.zeros((48, 64), np.float32), camera), np.array([32.0, 24.0]), np.array([0.0, 0, -1])
        )
        track = Track("tracked", np.array(TARGET_M), 1e-4 * np.eye(3), key)
        return track, seen(track)

    def begin_at_position(self, position_m: Any) -> tuple[Track, TrackSighting]:
        track, told = self.begin_at_pixel(None)
        track = replace(track, position_m=position_m)
        return track, replace(told, position_m=position_m)

    def find(self, track: Track, found_by: str = "") -> tuple[Track, TrackSighting]:
        with self.step("find"):
            type(self).looks.append(track)
        return type(self).script(track)


def seen(track: Track, pair: str = "navcam", reason: str = "") -> TrackSighting:
    """A look that leaves the track where it is."""
    pixel = CameraPixel(
        frame_id="navcam_left-000001-x", verdict="good", reason="", x_px=31.5, y_px=20.0, sigma_px=[0.1, 0.1],
        correlation=0.95,
    )  # fmt: skip
    return TrackSighting(track.state, reason, pair, track.position_m, 5.0, {"navcam_left": pixel}, 1.0)


def found(track: Track) -> tuple[Track, TrackSighting]:
    after = replace(track, state="tracked", misses=0)
    return after, seen(after)


def lost(track: Track) -> tuple[Track, TrackSighting]:
    after = replace(track, state="lost", misses=track.misses + 1)
    return after, seen(after, reason="navcam_left: a stone is in the way")


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[tuple[RunningDaemon, FakeHardware]]:
    monkeypatch.setattr(track_module, "TargetSearch", ScriptedSearch)
    monkeypatch.setattr(ScriptedSearch, "script", staticmethod(found), raising=False)
    monkeypatch.setattr(ScriptedSearch, "begin", staticmethod(lambda: None))
    monkeypatch.setattr(ScriptedSearch, "looks", [], raising=False)
    with fake_daemon(monkeypatch, tmp_path, config=CONFIG + LOGGED) as made:
        yield made


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[Client]:
    with Client(daemon.url, 20.0) as made:
        yield made


def click(client: Client, x_px: float = 30.0, y_px: float = 20.0) -> tuple[str, str, float, float]:
    return "navcam_left", client.snapshot("navcam_left").frame_id, x_px, y_px


def started(client: Client, first_pose: bool = True) -> Any:
    """A track, after a pose at the site's origin at 1 s."""
    if first_pose:
        client.pose([0, 0, 0], [1, 0, 0, 0], time_s=1.0)
    return client.wait_track(client.start_track(pixel=click(client)))


def drive(client: Client, x_m: float, time_s: float, **more: Any) -> Any:
    """A pose ``x_m`` ahead of the first, and the track when its look has ended."""
    answer = client.pose([x_m, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=time_s, **more)
    return client.wait_track(answer["operation"])


def refusal(call: Callable[[], Any], code: str) -> str:
    with pytest.raises(ClientError) as refused:
        call()
    assert refused.value.code == code, refused.value
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_a_track_is_carried_over_each_pose_and_looked_for(client: Client) -> None:
    track = started(client)
    assert (track["state"], track["pair"], track["looks"]) == ("tracking", "navcam", 0)
    assert track["position_m"] == pytest.approx(TARGET_M)
    assert track["pixels"]["navcam_left"]["verdict"] == "good"
    track = drive(client, 0.5, 2.0)
    assert (track["state"], track["looks"], track["predicted"]) == ("tracking", 1, False)
    assert track["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    assert track["position_in_site_m"] == pytest.approx(TARGET_M)
    # The lever of the rotation, 4.5 m, and the translation: by hand, on top of the 1 cm of the start.
    assert track["covariance_m2"][1][1] == pytest.approx(1e-4 + (4.5 * 0.005) ** 2 + 0.01**2)
    assert track["pose"]["position_m"] == [0.5, 0.0, 0.0]
    assert track["pose"]["age_s"] >= 0.0
    assert client.status()["pose"]["time_s"] == 2.0


def test_the_suns_keep_out_knows_a_pose_before_the_look_from_it_begins(
    daemon: RunningDaemon, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    called: list[str] = []
    judge, operations = daemon.service.devices.judge, daemon.service.operations
    stands, start = judge.rover_stands, operations.start

    def rover_stands(rover_from_site: Any) -> None:
        called.append("stands")
        stands(rover_from_site)

    def begin(*work: Any) -> Any:
        called.append("look")
        return start(*work)

    monkeypatch.setattr(judge, "rover_stands", rover_stands)
    monkeypatch.setattr(operations, "start", begin)
    drive(client, 0.5, 2.0)
    assert called == ["stands", "look"]
    refusal(lambda: drive(client, 1.0, 1.5), "pose_runs_backwards")
    assert called == ["stands", "look"], "a refused pose turns no sun"


def test_a_lost_target_stays_lost_with_its_reason_until_a_look_finds_it(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    monkeypatch.setattr(ScriptedSearch, "script", staticmethod(lost))
    track = drive(client, 0.5, 2.0)
    assert (track["state"], track["misses"]) == ("lost", 1)
    assert track["reason"] == "navcam_left: a stone is in the way"
    assert drive(client, 0.9, 3.0)["misses"] == 2
    monkeypatch.setattr(ScriptedSearch, "script", staticmethod(found))
    track = client.wait_track(client.look())
    assert (track["state"], track["reason"], track["misses"]) == ("tracking", "", 0)


def test_a_pose_that_jumps_ends_the_track_and_looks_nowhere(client: Client) -> None:
    started(client)
    drive(client, 0.5, 2.0)
    track = drive(client, 3.0, 3.0)
    assert track["state"] == "stopped"
    assert "the pose jumped by 2.50 m" in track["reason"]
    assert "at most 0.3 of the range" in track["reason"]
    assert len(ScriptedSearch.looks) == 1
    refusal(client.look, "no_track")
    assert client.track()["position_in_site_m"] == pytest.approx(TARGET_M)
    assert client.track()["position_m"] == pytest.approx([2.0, 0.5, 0.0])


def test_poses_that_run_backwards_or_say_too_little_are_refused(client: Client) -> None:
    started(client)
    before = client.track()
    sentence = refusal(lambda: drive(client, 0.1, 0.5), "pose_runs_backwards")
    assert "0.5 s" in sentence
    assert "1 s" in sentence
    sentence = refusal(lambda: client.pose([0, 0, 0], [1, 0, 0, 0], time_s=2.0), "pose_without_covariance")
    assert "covariance (6 rows of 6) or sigma" in sentence
    assert client.track()["sequence"] == before["sequence"], "a refused pose changes nothing"
    refusal(lambda: client.pose([0.1, 0, 0], [1, 0, 0, 0], time_s=2.0), "pose_without_covariance")
    track = client.track()
    assert track["state"] == "stopped", "but what stood still is not where the rover was said to go"
    assert "it had no covariance" in track["reason"]


def test_a_first_pose_while_a_track_begins_ends_it_and_its_motion(
    client: Client, pair: tuple[RunningDaemon, FakeHardware], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, goes_on = threading.Event(), threading.Event()
    monkeypatch.setattr(ScriptedSearch, "begin", staticmethod(lambda: (begun.set(), goes_on.wait(NET_S))))  # type: ignore[func-returns-value]
    operation = client.start_track(pixel=click(client))
    assert begun.wait(NET_S)
    assert client.pose([0.1, 0, 0], [1, 0, 0, 0])["track"]["state"] == "stopped"
    assert ("stop",) in pair[1].head.calls, "nothing turns for a track that has ended"
    goes_on.set()
    client.wait(operation)
    assert client.track()["state"] == "stopped"


COUPLED = np.zeros((6, 6))
COUPLED[4, 5] = COUPLED[5, 4] = 1.0  # two turns, coupled more than their variances allow


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"quaternion": [0.5, 0, 0, 0]}, "length 0.5 where 1 is expected"),
        ({"covariance": (np.diag([1e6] * 3 + [1e-6] * 3) + 1e-5 * COUPLED).tolist()}, "negative variance"),
        ({"covariance": np.triu(np.ones((6, 6))).tolist()}, "not symmetric"),
        (
            {"covariance": np.eye(6).tolist(), "sigma": {"position_m": 0.1, "rotation_rad": 0.1}},
            "one of them",
        ),
        ({"attitude": [1, 0, 0, 0]}, "unknown key"),
    ],
)
def test_bodies_of_poses_that_make_no_sense_are_refused(
    client: Client, change: dict[str, Any], words: str
) -> None:
    body = {"position_m": [0, 0, 0], "quaternion": [1, 0, 0, 0], **change}
    with pytest.raises(ClientError) as refused:
        asked_plainly(client, "POST", "/pose", json=body)
    assert (refused.value.code, refused.value.exit_code) == ("bad_request", 2)
    assert words in str(refused.value)
    assert client.track()["pose"] is None


def test_one_track_at_a_time(client: Client) -> None:
    track = started(client)
    assert track["id"] in refusal(lambda: client.start_track(pixel=click(client)), "busy")
    assert client.stop_track()["state"] == "stopped"
    assert started(client, first_pose=False)["id"] != track["id"]


def test_a_frame_from_before_the_rover_moved_is_no_start_and_no_aim(client: Client) -> None:
    client.pose([0, 0, 0], [1, 0, 0, 0])
    pixel = click(client)
    client.pose([0.001, 0, 0], [1, 0, 0, 0])
    client.wait_track(client.start_track(pixel=pixel))
    client.stop_track()
    client.pose([0.5, 0, 0], [1, 0, 0, 0])
    refusal(lambda: client.start_track(pixel=pixel), "rover_moved")
    refusal(lambda: client.point(pixel=pixel), "rover_moved")


def test_a_position_of_the_site_is_carried_to_the_rover(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    quarter = math.sqrt(0.5)  # facing east, 2 m north of the origin
    client.pose([2, 0, 0], [quarter, 0, 0, quarter])
    track = client.wait_track(client.start_track(position_m=[2.0, 4.0, 0.5], frame="site"))
    assert track["position_m"] == pytest.approx([4.0, 0.0, 0.5])
    assert track["position_in_site_m"] == pytest.approx([2.0, 4.0, 0.5])
    client.stop_track()
    asked: list[Any] = []
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(lambda request, *any: asked.append(request)))
    client.wait(client.point(position_m=[2.0, 4.0, 0.5], frame="site"))
    assert asked[0].position_m == pytest.approx([4.0, 0.0, 0.5])
    assert client.operations()[0]["request"]["position_m"] == [2.0, 4.0, 0.5], "the record has it as it came"


def test_poses_that_come_during_a_look_make_its_pictures_worthless(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    hang = Hang()

    def slow(track: Track) -> tuple[Track, TrackSighting]:
        hang()
        return found(replace(track, position_m=track.position_m + 1.0))

    monkeypatch.setattr(ScriptedSearch, "script", staticmethod(slow))
    first = client.pose([0.3, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=2.0)["operation"]
    assert hang.entered.wait(60.0)
    answer = client.pose([0.5, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=3.0)
    assert answer["operation"] == first
    assert answer["track"]["predicted"]
    assert answer["track"]["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    refusal(lambda: drive(client, 0.6, 2.5), "pose_runs_backwards")
    monkeypatch.setattr(ScriptedSearch, "script", staticmethod(found))
    hang.let_go()
    until(lambda: client.track()["looks"] == 1, "the look from the second pose")
    track = client.track()
    assert track["position_m"] == pytest.approx([4.5, 0.5, 0.0]), "the first look counts for nothing"
    assert (track["state"], track["predicted"], track["reason"]) == ("tracking", False, "")


def test_a_stop_ends_look_and_track(
    client: Client, pair: tuple[RunningDaemon, FakeHardware], monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    hang = Hang()
    monkeypatch.setattr(ScriptedSearch, "script", staticmethod(lambda track: (hang(), found(track))[1]))  # type: ignore[func-returns-value]
    operation = client.pose([0.5, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=2.0)["operation"]
    assert hang.entered.wait(60.0)
    assert client.stop()["operation"] == operation
    track = client.track()
    assert (track["state"], track["reason"], track["operation"]) == ("stopped", "a stop was requested", None)
    hang.let_go()
    client.wait(operation)
    assert client.track()["state"] == "stopped"
    assert ("stop",) in pair[1].head.calls
    assert drive(client, 0.7, 3.0)["state"] == "stopped", "poses go on, the track does not"
    assert len(ScriptedSearch.looks) == 1


def test_stopping_the_track_stops_its_look_and_no_other_operation(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    hang = Hang()
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(lambda *any: hang()))
    pointing = client.point(pan_rad=0.1, tilt_rad=0.1)
    assert hang.entered.wait(60.0)
    answer = client.pose([0.5, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=2.0)
    assert answer["operation"] is None
    assert pointing in answer["track"]["reason"]
    assert answer["track"]["predicted"]
    assert client.stop_track()["state"] == "stopped"
    hang.let_go()
    assert client.wait(pointing)["state"] == "done"


def test_a_device_that_fails_makes_the_target_lost_not_the_daemon(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)

    def fail(track: Track) -> tuple[Track, TrackSighting]:
        raise NoReply("no answer on the bus", device="pan_tilt")

    monkeypatch.setattr(ScriptedSearch, "script", staticmethod(fail))
    track = drive(client, 0.5, 2.0)
    assert (track["state"], track["misses"]) == ("lost", 1)
    assert track["reason"] == "pan_tilt: no answer on the bus"
    assert track["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    monkeypatch.setattr(ScriptedSearch, "script", staticmethod(found))
    drive(client, 0.6, 3.0)
    assert ScriptedSearch.looks[-1].state == "lost", "both eyes must find it again"
    assert client.track()["state"] == "tracking"


def run(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main(["track", *words, "--url", daemon.url])
    out, log = capsys.readouterr()
    return code, out, log


def test_the_commands_follow_a_target(
    daemon: RunningDaemon, client: Client, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(daemon, capsys, "pose", "--position", "0", "0", "0", "--time", "1")
    assert code == 0 and out.startswith("state idle")
    code, out, _ = run(daemon, capsys, "start", "--camera", "navcam_left", "--at", "30", "20")
    assert code == 0 and out.startswith("state tracking, pair navcam, range m 5, position m 5, 0.5, 0,")
    words = ("--position", "0.5", "0", "0", "--sigma", "0.01", "0.005", "--time", "2", "--json")
    code, out, _ = run(daemon, capsys, "pose", *words)
    assert code == 0
    assert json.loads(out)["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    assert run(daemon, capsys, "look")[0] == 0
    code, out, _ = run(daemon, capsys, "status", "--json")
    assert (code, json.loads(out)["state"], json.loads(out)["looks"]) == (0, "tracking", 2)
    far = ("--position", "9", "0", "0", "--sigma", "0.01", "0.005", "--time", "3")
    code, out, _ = run(daemon, capsys, "pose", *far)
    shown = "state stopped, pair navcam, range m 5, position m -4, 0.5, 0, predicted yes"
    assert (code, out.partition(", reason")[0]) == (0, shown)
    code, out, log = run(daemon, capsys, "pose", "--position", "0.5", "0", "0", "--time", "1")
    assert (code, out) == (1, "")
    assert "not later than the pose before" in log
    assert "stopped" in run(daemon, capsys, "stop")[1]
    main(["status", "--url", daemon.url])
    assert "the pose jumped" in capsys.readouterr().out
