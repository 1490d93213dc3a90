"""The sentinel on a whole daemon: changes of the truth that it is not given, and other clients."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from hil_tests.mastctl.drift.histories import bumped
from hil_tests.mastctl.drift.small_rover import RESTS, small_rover, truly
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.daemon import RunningDaemon
from mastctl.drift.looks import LookEnded, look
from mastctl.drift.pictures import LOOKS, REFERENCE, read_looks, read_reference

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def daemon(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    with small_rover(repository, tmp_path_factory.mktemp("sentinel")) as made:
        folder = made.service.folder.path / "sentinel"
        rests = [word for rest in RESTS for word in ("--pose", *rest.split(","))]
        assert main(["rig", "sentinel", "reference", "--folder", str(folder), "--url", made.url, *rests]) == 0
        yield made


@pytest.fixture
def folder(daemon: RunningDaemon) -> Path:
    """The sentinel's folder in the daemon's state, without looks."""
    found = daemon.service.folder.path / "sentinel"
    (found / LOOKS).unlink(missing_ok=True)
    return found


@pytest.fixture
def run(daemon: RunningDaemon, folder: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*options: str, where: Path = folder) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main(["rig", "sentinel", *options, "--folder", str(where), "--url", daemon.url])
        out, log = capsys.readouterr()
        return code, out.strip(), log.strip()

    return call


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[Client]:
    with Client(daemon.url, name="ana") as client:
        yield client
        client.clear_faults()
        if client.status()["estop"] is not None:
            client.reset(reason="the test is over", name="ana")


def angles(client: Client) -> tuple[float, float]:
    joints = client.status()["joints"]
    assert joints is not None
    return joints["pan_rad"], joints["tilt_rad"]


def undated(sentence: str) -> str:
    """Return a finding without its age, which grows while the test runs."""
    return sentence.partition(", since ")[0]


def test_a_bumped_camera_is_seen_by_two_looks_and_reported_everywhere(
    daemon: RunningDaemon, run: Run, client: Client
) -> None:
    what = "the images moved by up to "
    rover = daemon.service.hardware.simulation
    assert rover is not None
    before = angles(client)
    with truly(daemon, bumped(rover.rig, "navcam_left", (0.0, 1.8e-3, 0.0))):
        code, shown, _ = run("look")
        assert (code, shown.startswith(what)) == (0, True), shown
        assert "seen once" in shown
        code, shown, _ = run("look")
    assert (code, shown.startswith(what)) == (1, True), shown
    assert " sigma" in shown and "since " in shown
    assert angles(client) == pytest.approx(before, abs=1e-3)
    until(
        lambda: undated(client.request("GET", "/sentinel")["sentence"]) == undated(shown),
        "the daemon has read the look",
    )
    answer = client.request("GET", "/sentinel")
    assert answer["level"] == "bad"
    assert client.status()["sentinel"]["sentence"] == answer["sentence"]
    assert client.status()["faults"] == [] and client.status()["state"] == "ready"
    health = client.request("GET", "/calibration/health")
    assert (health["verdict"], health["since"]) == ("drifts", answer["since"])
    assert health["sentence"].startswith(f"reference images: {what}")
    assert client.status()["calibration"] == {
        key: health[key] for key in client.status()["calibration"] or ()
    }
    assert health["sentinel"]["sentence"].startswith(what)
    text = daemon.service.metrics.text().decode()
    found = {one.name: one for one in text_string_to_metric_families(text)}
    assert found["mastctl_calibration_drifts"].samples[0].value == 1.0
    assert found["mastctl_sentinel_look_age_seconds"].samples[0].value >= 0.0


def changed(folder: Path, to: Path, change: dict[str, Any]) -> Path:
    shutil.copytree(folder, to)
    with np.load(to / REFERENCE) as stored:
        arrays: dict[str, Any] = {**stored, **change}
    np.savez(to / REFERENCE, **arrays)
    return to


@pytest.mark.parametrize(
    ("change", "phrase"),
    [
        ({"mast_digest": "0" * 64}, "another mast file is in use than when"),
        (
            {"cameras": 6 * ["pancam_left"]},
            "the reference is of pancam_left, the daemon has navcam_left, navcam_right; take a new one",
        ),
    ],
    ids=["mast file", "cameras"],
)
def test_a_reference_that_cannot_be_compared_moves_nothing(
    change: dict[str, Any],
    phrase: str,
    folder: Path,
    tmp_path: Path,
    run: Run,
    client: Client,
) -> None:
    where = changed(folder, tmp_path / "other", change)
    before = [one["id"] for one in client.operations()]
    got, _, log = run("look", where=where)
    assert got == 1
    assert phrase in log and len(log.splitlines()) == 1
    assert [one["id"] for one in client.operations()] == before


class Meddling(Client):
    """A client whose second image is the moment for another client."""

    def __init__(self, url: str, meddle: Callable[[], object]) -> None:
        super().__init__(url, name="the sentinel's process")
        self._meddle = meddle
        self._pictures = 0

    def snapshot(self, *args: Any, **options: Any) -> Any:
        self._pictures += 1
        if self._pictures == 2:
            self._meddle()
        return super().snapshot(*args, **options)


def looked(daemon: RunningDaemon, folder: Path, meddle: Callable[[], object], idle_s: float = 0.0) -> str:
    """A look with another client in the middle: why it ended, empty for one that is kept."""
    with Meddling(daemon.url, meddle) as client:
        try:
            look(client, folder, idle_s=idle_s)
        except LookEnded as ended:
            return str(ended)
    return ""


def test_a_look_lets_go_of_the_head_and_waits_for_one_that_is_in_use(
    daemon: RunningDaemon, folder: Path, client: Client
) -> None:
    assert looked(daemon, folder, lambda: None) == ""
    assert client.control() is None
    assert looked(daemon, folder, lambda: None, 3600.0).endswith("s ago; 3600 s are waited for")
    assert len(read_looks(folder, read_reference(folder))) == 1


def test_a_look_ends_where_another_takes_over_and_none_begins_meanwhile(
    daemon: RunningDaemon, folder: Path, client: Client
) -> None:
    lease = []
    meddle = lambda: lease.append(client.acquire_lease(for_s=60.0, take_over="mine"))  # noqa: E731
    assert looked(daemon, folder, meddle) == "ana took over: mine; nothing was kept"
    last = [one["id"] for one in client.operations()]
    assert "ana" in looked(daemon, folder, lambda: None)
    assert [one["id"] for one in client.operations()] == last
    client.use_lease(lease[0]["lease_id"])
    client.release_lease()
    client.use_lease(None)


@pytest.mark.parametrize("stop", ["stop", "estop"])
def test_after_a_stop_in_the_middle_looks_move_nothing_more(
    stop: str, daemon: RunningDaemon, folder: Path, client: Client
) -> None:
    at: list[tuple[float, float]] = []
    client.wait(client.point(pan_rad=0.0, tilt_rad=0.0))  # after a stop the head is held until a command

    def press() -> None:
        getattr(client, stop)()
        at.append(angles(client))

    by = {"stop": "ana", "estop": "an emergency stop (ana)"}[stop]
    assert looked(daemon, folder, press) == f"the head was stopped by {by}; nothing was kept"
    assert angles(client) == at[0]
    state = {"stop": "holding", "estop": "stopped"}[stop]
    assert looked(daemon, folder, lambda: None).startswith(f"no look now: the daemon's state is {state}")
    assert angles(client) == at[0]
