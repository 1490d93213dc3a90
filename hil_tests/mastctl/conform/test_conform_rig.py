"""Every check of a rig passes a true one, and finds the lie that it is meant for."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hil_tests.mastctl.conform.conform_world import CRAWLING_RAD_PER_S, Passing, Proxy, true_daemon
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.conform.rig import check_rig, rig_under_test
from mastctl.conform.rig_checks import RIG

Edit = Callable[[Any, Passing], Any]
NAMES = [check.name for check in RIG]
API = "/api/v1"


@pytest.fixture(scope="module")
def daemon_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with true_daemon(tmp_path_factory.mktemp("daemon")) as url:
        yield url


@pytest.fixture
def proxy(daemon_url: str) -> Iterator[Proxy]:
    with Client(daemon_url) as client:
        client.stop()
        until(lambda: client.status()["state"] != "stopping", "the stop is over")
        client.wait(client.point(pan_rad=0.0, tilt_rad=0.0))
        client.stop()
        until(lambda: client.status()["state"] != "stopping", "the stop is over")
    made = Proxy(daemon_url)
    yield made
    made.close()


def states(url: str, *names: str) -> dict[str, str]:
    """What became of some checks."""
    checks = [check for check in RIG if check.name in names]
    with rig_under_test(url, 0.3) as rig:
        return {outcome["name"]: outcome["state"] for outcome in check_rig(rig, checks, True)["checks"]}


def edited(
    path: str, edit: Edit, *, method: str = "GET", of: Callable[[Passing], bool] = lambda told: True
) -> Any:
    """A lie about JSON answers at a path."""

    def after(told: Passing) -> None:
        if told.method == method and told.path.startswith(API + path) and told.status < 300 and of(told):
            told.data = json.dumps(edit(json.loads(told.data), told)).encode()

    return {"after": after}


def changed(document: dict[str, Any], *path: Any, value: Any) -> dict[str, Any]:
    """The document with another value at a path."""
    here: Any = document
    for key in path[:-1]:
        here = here[key]
    here[path[-1]] = value(here[path[-1]]) if callable(value) else value
    return document


def status_says(*path: str, value: Any) -> Any:
    return edited("/status", lambda told, _: changed(told, *path, value=value))


def header_says(name: str, value: Any) -> Any:
    """A lie in a header of every picture."""

    def after(told: Passing) -> None:
        if "/snapshot/" in told.path and told.headers is not None and told.status == 200:
            key = next(k for k in told.headers if k.lower() == f"x-mastctl-{name}")
            told.headers[key] = value(told.headers[key]) if callable(value) else value

    return {"after": after}


def error(code: str, message: str = "not so") -> dict[str, Any]:
    return {"error": {"code": code, "message": message, "detail": None}}


def answers(status: int, body: Any, when: Callable[[Passing], bool]) -> Any:
    """A lie in the daemon's place."""

    def before(told: Passing) -> bool:
        if not when(told):
            return False
        told.status, told.headers = status, {"Content-Type": "application/json"}
        told.data = json.dumps(body).encode()
        return True

    return {"before": before}


def to(method: str, path: str, *words: str) -> Callable[[Passing], bool]:
    return lambda told: (
        told.method == method
        and told.path.startswith(API + path)
        and all(w.encode() in told.body for w in words)
    )


def half_size(told: Passing) -> None:
    if "/snapshot/" in told.path and told.status == 200:
        image = cv2.imdecode(np.frombuffer(told.data, np.uint8), cv2.IMREAD_UNCHANGED)
        told.data = cv2.imencode(".png", image[::2, ::2])[1].tobytes()


def old_picture() -> Any:
    """The first picture again and again."""
    kept: list[Passing] = []

    def after(told: Passing) -> None:
        if "/snapshot/navcam_left" in told.path and told.status == 200:
            kept.append(told)
            told.headers, told.data = kept[0].headers, kept[0].data

    return {"after": after}


def elsewhere(told: Passing) -> bool:
    """Points 0.05 rad beside what was asked."""
    if to("POST", "/point", "pan_rad")(told):
        body = json.loads(told.body)
        told.body = json.dumps(changed(body, "pan_rad", value=lambda pan: pan + 0.05)).encode()
    return False


def refuses_after_a_stop() -> Any:
    stopped: list[bool] = []

    def before(told: Passing) -> bool:
        if to("POST", "/stop")(told):
            stopped.append(True)
        if not (stopped and to("POST", "/point")(told)):
            return False
        told.status, told.headers = 409, {"Content-Type": "application/json"}
        told.data = json.dumps(error("stopped")).encode()
        return True

    return {"before": before}


def done_at_once(*words: str) -> Any:
    """Takes a pointing with these words in it and says that it is done, without doing anything."""
    fake = {"id": "fake", "state": "done", "steps": [], "residual_px": None, "residual_sigma_px": None}

    def before(told: Passing) -> bool:
        for when, status, body in (
            (to("POST", "/point", *words), 202, {"id": "fake"}), (to("GET", "/operations/fake"), 200, fake),
        ):  # fmt: skip
            if when(told):
                told.status, told.headers = status, {"Content-Type": "application/json"}
                told.data = json.dumps(body).encode()
                return True
        return False

    return {"before": before}


LIES: list[tuple[str, str, Any]] = [
    ("an angle beyond a turn", "status.joints", status_says("joints", "pan_rad", value=9.0)),
    ("a reading of before", "status.joints", status_says("joints", "age_s", value=5.0)),
    ("pictures of half the size", "pictures.facts", {"after": half_size}),
    ("pictures of another mast file", "pictures.facts", header_says("mast-digest", "0" * 64)),
    ("pictures of another camera", "pictures.facts", header_says("camera", "hazcam_left")),
    ("an exposure that is no number", "pictures.facts", header_says("exposure-s", "short")),
    ("an old picture", "pictures.fresh", old_picture()),
    ("a picture of the future", "pictures.fresh", header_says("mid-exposure-s", lambda s: str(float(s) + 9))),
    ("one id for all", "pictures.fresh", header_says("frame-id", "navcam_left-1")),
    ("a count that stands", "pictures.fresh", header_says("sequence", "7")),
    ("angles of another pose", "pictures.facts", header_says("pan-rad", "0.05")),
    ("motion at rest", "pictures.facts", header_says("moving", "true")),
    ("another goal", "motion.pointing", {"before": elsewhere}),
    ("limits not held", "motion.pointing",
     edited("/status", lambda s, _: changed(s, "joints", "tilt_rad", value=1.2) if s["moving"] else s)),
    ("too fast", "motion.pointing", status_says("joints", "pan_rad", value=lambda pan: 100 * pan)),
    ("a stop that does nothing", "motion.stop",
     answers(200, {"stopped": True, "operation": None}, to("POST", "/stop"))),
    ("a stop that is refused at rest", "motion.stop_at_rest",
     answers(409, error("busy"), to("POST", "/stop"))),
    ("a stop that latches", "motion.stop", refuses_after_a_stop()),
    ("an emergency stop that does not latch", "motion.estop",
     answers(200, {"stopped": True, "latched": True, "kept": True}, to("POST", "/estop"))),
    ("done without a residual", "clicks.pointed", done_at_once("pixel")),
    ("no way home", "motion.home",
     answers(409, error("busy"), to("POST", "/point"))),
]  # fmt: skip


@pytest.mark.parametrize(("name", "lie"), [lie[1:] for lie in LIES], ids=[lie[0] for lie in LIES])
def test_a_lie_is_found_by_the_check_meant_for_it(name: str, lie: dict[str, Any], proxy: Proxy) -> None:
    vars(proxy).update(lie)
    assert states(proxy.url, name)[name] == "failed"


def test_there_is_a_lie_for_every_check() -> None:
    assert {name for _, name, _ in LIES} == set(NAMES)


def test_a_true_daemon_conforms_and_the_report_says_so(
    proxy: Proxy, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["conform", proxy.url, "--motion", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["conforms"] and told["failed"] == 0 and told["may_move"] == ""
    assert [check["name"] for check in told["checks"]] == NAMES
    # Pictures of noise show nothing to point at; everything else can be asked here.
    assert [check["name"] for check in told["checks"] if check["state"] == "skipped"] == ["clicks.pointed"]


def test_without_motion_nothing_moves_and_the_rest_is_asked(proxy: Proxy, daemon_url: str) -> None:
    with Client(daemon_url) as client:
        before, known = client.status()["joints"]["pan_rad"], client.operations()
        with rig_under_test(proxy.url, 0.3) as daemon:
            outcomes = check_rig(daemon, RIG, False)["checks"]
        assert client.status()["joints"]["pan_rad"] == before and client.operations() == known
    moving = {check.name for check in RIG if check.moves}
    assert {outcome["name"] for outcome in outcomes if outcome["state"] == "skipped"} == moving
    assert not [outcome for outcome in outcomes if outcome["state"] == "failed"]


def moving_now(told: Passing) -> bool:
    return told.path == f"{API}/status" and told.status == 200 and json.loads(told.data)["moving"]


@pytest.fixture
def crawling(tmp_path: Path) -> Iterator[Proxy]:
    """Before a daemon whose head cannot arrive while a test runs."""
    with true_daemon(tmp_path, CRAWLING_RAD_PER_S) as url:
        made = Proxy(url)
        yield made
        made.close()


def stands_short_of(url: str, goal_rad: float) -> bool:
    with Client(url) as client:
        status = until(lambda: at_rest(client), "the head has come to rest")
        return bool(status["state"] == "holding" and abs(status["joints"]["pan_rad"] - goal_rad) > 0.01)


def at_rest(client: Client) -> Any:
    status = client.status()
    return None if status["moving"] or status["operation"] else status


def test_a_connection_that_is_lost_while_the_head_moves_ends_with_a_stop(crawling: Proxy) -> None:
    cut = threading.Event()

    def after(told: Passing) -> None:
        if moving_now(told):
            cut.set()
        if cut.is_set() and "/stop" not in told.path:
            told.status = 0

    crawling.after = after
    names = ("motion.pointing", "motion.home")
    assert states(crawling.url, *names) == dict(zip(names, ("failed", "skipped"), strict=True))
    crawling.honest()
    assert stands_short_of(crawling.url, 0.18)


def test_control_c_while_the_head_moves_stops_it(crawling: Proxy) -> None:
    def after(told: Passing) -> None:
        if moving_now(told):
            crawling.honest()
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    crawling.after = after
    with pytest.raises(KeyboardInterrupt):
        states(crawling.url, "motion.pointing")
    assert stands_short_of(crawling.url, 0.18)


def test_a_stop_at_the_end_that_is_not_confirmed_is_said(proxy: Proxy) -> None:
    vars(proxy).update(answers(504, error("no_reply", "the head did not confirm"), to("POST", "/stop")))
    checks = [check for check in RIG if check.name == "motion.home"]
    with rig_under_test(proxy.url, 0.3) as daemon:
        report = check_rig(daemon, checks, True)
    assert "did not confirm" in report["may_move"] and not report["conforms"]


def refusal(capsys: pytest.CaptureFixture[str]) -> str:
    return str(json.loads(capsys.readouterr().out)["error"]["code"])


def test_wrong_use_is_refused_before_anything_moves(
    proxy: Proxy, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", (tmp_path / "empty").open("w+"))
    for more, code, status in (
        ([], "wrong_use", 2),  # nobody to ask
        (["--motion", "--only", "motion.nothing"], "wrong_use", 2),
    ):
        assert main(["conform", proxy.url, "--json", *more]) == status
        assert refusal(capsys) == code
    assert main(["conform", "ftp://127.0.0.1", "--json"]) == 2
    assert refusal(capsys) == "bad_url"
    assert main(["conform", "http://127.0.0.1:9", "--json", "--no-motion"]) == 1
    assert refusal(capsys) == "no_daemon"


def test_a_daemon_at_work_is_left_alone(crawling: Proxy, capsys: pytest.CaptureFixture[str]) -> None:
    with Client(crawling.url) as client:
        name = client.point(pan_rad=0.6, tilt_rad=0.0)
        assert main(["conform", crawling.url, "--motion", "--json"]) == 1
        assert refusal(capsys) == "busy"
        assert client.operation(name)["state"] == "running"


@pytest.mark.parametrize("when", ["before", "meanwhile"])
def test_the_emergency_stop_of_a_person_stays_latched(
    when: str, proxy: Proxy, capsys: pytest.CaptureFixture[str]
) -> None:
    with Client(proxy.url) as client:

        def stop_too(passing: Passing) -> None:
            if passing.path == f"{API}/point":
                with Client(f"http://{proxy.target}") as person:
                    person.estop(reason="sparks", name="Ana")

        try:
            if when == "before":
                client.estop(reason="sparks", name="Ana")
            else:
                proxy.after = stop_too
            assert main(["conform", proxy.url, "--only", "motion.estop", "--motion", "--json"]) == 1
            assert "sparks" in capsys.readouterr().out
            assert client.status()["estop"] is not None
        finally:
            proxy.honest()
            client.reset(reason="the test is over", name="test")
