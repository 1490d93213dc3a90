"""Every check of a daemon passes a true one, and finds the lie that it is meant for."""

from __future__ import annotations

import json
import signal
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hil_tests.mastctl.conform.conform_world import CRAWLING_RAD_PER_S, Passing, Proxy, true_daemon
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
from mastctl.conform.daemon_run import CHECKS, check_daemon, daemon_under_test

Edit = Callable[[Any, Passing], Any]
NAMES = [check.name for check in CHECKS]
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
    checks = [check for check in CHECKS if check.name in names]
    with daemon_under_test(url, 0.3) as daemon:
        return {outcome.name: outcome.state for outcome in check_daemon(daemon, checks, True).outcomes}


def edited(
    path: str, edit: Edit, *, method: str = "GET", of: Callable[[Passing], bool] = lambda told: True
) -> Any:
    """A lie about JSON answers at a path."""

    def after(told: Passing) -> None:
        if told.method == method and told.path.startswith(API + path) and told.status < 300 and of(told):
            told.data = json.dumps(edit(json.loads(told.data), told)).encode()

    return {"after": after}


def changed(document: dict[str, Any], *path: str, value: Any) -> dict[str, Any]:
    """The document with another value at a path."""
    here = document
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


def says_instead(status: int, body: Any, when: Callable[[Passing], bool]) -> Any:
    """A lie after the daemon has done what was asked, or refused it."""

    def after(told: Passing) -> None:
        if when(told):
            told.status, told.data = status, json.dumps(body).encode()

    return {"after": after}


def to(method: str, path: str, *words: str) -> Callable[[Passing], bool]:
    return lambda told: (
        told.method == method
        and told.path.startswith(API + path)
        and all(w.encode() in told.body for w in words)
    )


def refused(told: Passing) -> bool:
    return told.status >= 400


def backwards() -> Any:
    came = iter(range(10_000))
    return status_says("now_s", value=lambda now_s: now_s - next(came) % 2)


def half_size(told: Passing) -> None:
    if "/snapshot/" in told.path and told.status == 200:
        image = cv2.imdecode(np.frombuffer(told.data, np.uint8), cv2.IMREAD_UNCHANGED)
        told.data = cv2.imencode(".png", image[::2, ::2])[1].tobytes()


def png_called_jpeg() -> Any:
    def after(told: Passing) -> None:
        if "format=jpeg" in told.path:
            told.data = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()

    return {"after": after}


def old_picture() -> Any:
    """The first picture again and again."""
    kept: list[Passing] = []

    def after(told: Passing) -> None:
        if "/snapshot/navcam_left" in told.path and told.status == 200:
            kept.append(told)
            told.headers, told.data = kept[0].headers, kept[0].data

    return {"after": after}


def other_pixels(told: Passing) -> None:
    if "frame_id=" in told.path and told.status == 200:
        image = cv2.imdecode(np.frombuffer(told.data, np.uint8), cv2.IMREAD_UNCHANGED)
        told.data = cv2.imencode(".png", np.flipud(image))[1].tobytes()


def elsewhere(told: Passing) -> bool:
    """Points 0.05 rad beside what was asked."""
    if to("POST", "/point", "pan_rad")(told):
        body = json.loads(told.body)
        told.body = json.dumps(changed(body, "pan_rad", value=lambda pan: pan + 0.05)).encode()
    return False


def second_taken() -> Any:
    first: list[bytes] = []

    def after(told: Passing) -> None:
        if told.status == 202:
            first.append(told.data)
        elif told.status == 409 and first:
            told.status, told.data = 202, first[-1]

    return {"after": after}


def moved_by_a_refusal(daemon_url: str) -> Any:
    def after(told: Passing) -> None:
        if told.status >= 400 and told.path == f"{API}/point":
            with Client(daemon_url) as client, suppress(ClientError):
                client.point(pan_rad=0.1, tilt_rad=0.0)

    return {"after": after}


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


def steps_reversed(record: dict[str, Any], told: Passing) -> Any:
    return changed(record, "steps", value=lambda steps: steps[::-1]) if "steps" in record else record


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


def error_without(key: str, value: Any = None) -> Any:
    def after(told: Passing) -> None:
        if refused(told):
            error = json.loads(told.data)["error"]
            error.pop(key) if value is None else error.update({key: value})
            told.data = json.dumps({"error": error}).encode()

    return {"after": after}


def described_without(*keys: str) -> Any:
    def after(told: Passing) -> None:
        if told.path == "/openapi.json":
            document = json.loads(told.data)
            for key in keys:
                document["paths"].pop(key, None)
                for path in document["paths"].values():
                    for method in path.values():
                        method["responses"].pop(key, None)
            told.data = json.dumps(document).encode()

    return {"after": after}


LIES: list[tuple[str, str, Any]] = [
    ("a state that is no word", "status.keys", status_says("state", value="resting")),
    ("a fault without a code", "status.keys", status_says("faults", value=[{"device": "x", "message": "y"}])),
    ("an angle beyond a turn", "status.joints", status_says("joints", "pan_rad", value=9.0)),
    ("a reading of before", "status.joints", status_says("joints", "age_s", value=5.0)),
    ("limits turned round", "status.limits", status_says("limits", "pan_rad", value=lambda ends: ends[::-1])),
    ("another digest", "status.mast_digest", status_says("mast", "digest", value="0" * 64)),
    ("times backwards", "times.now", backwards()),
    ("a clock too fast", "times.rate", status_says("now_s", value=lambda now_s: 50 * now_s)),
    ("an age that stands", "times.ages", status_says("joints", "age_s", value=0.0)),
    ("pictures of half the size", "pictures.facts", {"after": half_size}),
    ("pictures of another mast file", "pictures.facts", header_says("mast-digest", "0" * 64)),
    ("pictures of another camera", "pictures.facts", header_says("camera", "hazcam_left")),
    ("an exposure that is no number", "pictures.facts", header_says("exposure-s", "short")),
    ("a PNG as JPEG", "pictures.jpeg", png_called_jpeg()),
    ("an old picture", "pictures.fresh", old_picture()),
    ("a picture of the future", "pictures.fresh", header_says("mid-exposure-s", lambda s: str(float(s) + 9))),
    ("one id for all", "pictures.ids", header_says("frame-id", "navcam_left-1")),
    ("a count that stands", "pictures.ids", header_says("sequence", "7")),
    ("other pixels by one id", "pictures.again", {"after": other_pixels}),
    ("cameras without age", "pictures.ages",
     status_says("cameras", value=lambda all_: {n: {**c, "age_s": 0.0} for n, c in all_.items()})),
    ("angles of another pose", "pictures.joints", header_says("pan-rad", "0.05")),
    ("motion at rest", "pictures.joints", header_says("moving", "true")),
    ("clicks on any frame", "clicks.unknown", answers(202, {"id": "x"}, to("POST", "/point", "no-such"))),
    ("clicks on old frames", "clicks.old",
     says_instead(202, {"id": "x"}, lambda told: told.status == 410 and told.method == "POST")),
    ("nobody steers", "lease.alone", status_says("control", value=None)),
    ("anybody steers", "lease.steers",
     says_instead(202, {"id": "x"}, lambda told: b'"leased"' in told.data and "/point" in told.path)),
    ("a lease that was taken over holds", "lease.ends",
     says_instead(200, {"lease_id": "x" * 32}, lambda told: b"lease_over" in told.data)),
    ("a lease of any length", "lease.bounds",
     says_instead(200, {"lease_id": "x" * 32}, lambda told: told.status == 422)),
    ("one key for anything", "keys.once",
     says_instead(202, {"id": "x"}, lambda told: b"key_reused" in told.data)),
    ("a deadline that ends nothing", "deadline.ends", done_at_once()),
    ("another goal", "motion.pointing", {"before": elsewhere}),
    ("limits not held", "motion.pointing",
     edited("/status", lambda s, _: changed(s, "joints", "tilt_rad", value=1.2) if s["moving"] else s)),
    ("too fast", "motion.speed", status_says("joints", "pan_rad", value=lambda pan: 100 * pan)),
    ("two at once", "motion.busy", second_taken()),
    ("a stop that does nothing", "motion.stop",
     answers(200, {"stopped": True, "operation": None}, to("POST", "/stop"))),
    ("a stop that wants JSON", "motion.stop_at_rest",
     answers(415, error("not_json"), to("POST", "/stop", "JSON"))),
    ("a stop that latches", "motion.after_stop", refuses_after_a_stop()),
    ("an emergency stop that does not latch", "motion.estop",
     answers(200, {"stopped": True, "latched": True, "kept": True}, to("POST", "/estop"))),
    ("a reset without a name", "motion.estop",
     says_instead(200, {}, lambda told: told.status == 422 and "/reset" in told.path)),
    ("steps out of order", "times.operations", edited("/operations/", steps_reversed)),
    ("an end before the begin", "times.operations",
     edited("/operations/", lambda record, _: {**record, "ended_s": record["created_s"]})),
    ("done without a residual", "clicks.pointed", done_at_once("pixel")),
    ("no way home", "motion.home",
     answers(409, error("busy"), to("POST", "/point"))),
    ("everything is there", "refusals.paths", says_instead(200, {}, to("GET", "/no-such-thing"))),
    ("a refusal as a defect", "refusals.bodies",
     says_instead(500, error("internal"), refused)),
    ("anybody may ask", "refusals.strangers", says_instead(200, {}, lambda told: told.status == 403)),
    ("no number is a number", "refusals.targets", answers(202, {"id": "x"}, to("POST", "/point", "NaN"))),
    ("no limits", "refusals.limits", says_instead(202, {"id": "x"}, lambda t: b"outside_limits" in t.data)),
    ("a refusal without a code", "refusals.form", error_without("code")),
    ("a message of two lines", "refusals.form", error_without("message", "no\nway")),
    ("an error that says 200", "refusals.form",
     says_instead(200, error("x"), to("GET", "/operations/no"))),
    ("a path not described", "openapi.paths", described_without(f"{API}/stop")),
    ("refusals not described", "openapi.answers", described_without("4XX", "422")),
    ("a path asked, not described", "openapi.answers", described_without(API + "/operations/{operation_id}")),
]  # fmt: skip


@pytest.mark.parametrize(("name", "lie"), [lie[1:] for lie in LIES], ids=[lie[0] for lie in LIES])
def test_a_lie_is_found_by_the_check_meant_for_it(name: str, lie: dict[str, Any], proxy: Proxy) -> None:
    asks_first = ["refusals.paths", "refusals.bodies"] if name in ("refusals.form", "openapi.answers") else []
    vars(proxy).update(lie)
    assert states(proxy.url, name, *asks_first)[name] == "failed"


def test_a_head_that_a_refusal_moves_is_found(proxy: Proxy, daemon_url: str) -> None:
    vars(proxy).update(moved_by_a_refusal(daemon_url))
    assert states(proxy.url, "refusals.head") == {"refusals.head": "failed"}


def test_there_is_a_lie_for_every_check() -> None:
    assert {name for _, name, _ in LIES} | {"refusals.head"} == set(NAMES)


def test_a_true_daemon_conforms_and_the_reports_say_so(
    proxy: Proxy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junit = tmp_path / "report.xml"
    assert main(["conform", proxy.url, "--motion", "--junit", str(junit), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["conforms"] and told["failed"] == 0 and told["may_move"] == ""
    assert [check["name"] for check in told["checks"]] == NAMES
    # Pictures of noise show nothing to point at; everything else can be asked here.
    assert [check["name"] for check in told["checks"] if check["state"] == "skipped"] == ["clicks.pointed"]
    suite = ET.parse(junit).getroot().find("testsuite")
    assert suite is not None and len(suite.findall("testcase")) == len(NAMES)
    assert suite.get("failures") == "0" and suite.get("skipped") == "1"


def test_a_lie_is_a_line_a_failure_in_the_report_and_exit_1(
    proxy: Proxy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junit = tmp_path / "report.xml"
    vars(proxy).update(status_says("mast", "digest", value="0" * 64))
    assert main(["conform", proxy.url, "--no-motion", "--only", "status", "--junit", str(junit)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5 and lines[-1].endswith("does not conform: 3 passed, 1 failed, 0 skipped")
    assert lines[3].startswith("FAILED status.mast_digest") and "000000000000" in lines[3]
    failure = ET.parse(junit).getroot().find("testsuite/testcase/failure")
    assert failure is not None and "000000000000" in str(failure.get("message"))


def test_without_motion_nothing_moves_and_the_rest_is_asked(proxy: Proxy, daemon_url: str) -> None:
    with Client(daemon_url) as client:
        before, known = client.status()["joints"]["pan_rad"], client.operations()
        with daemon_under_test(proxy.url, 0.3) as daemon:
            outcomes = check_daemon(daemon, CHECKS, False).outcomes
        assert client.status()["joints"]["pan_rad"] == before and client.operations() == known
    moving = {check.name for check in CHECKS if check.moves}
    assert {outcome.name for outcome in outcomes if outcome.state == "skipped"} == moving
    assert not [outcome for outcome in outcomes if outcome.state == "failed"]


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


def at_rest(client: Client) -> dict[str, Any] | None:
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
    checks = [check for check in CHECKS if check.name == "times.operations"]
    with daemon_under_test(proxy.url, 0.3) as daemon:
        report = check_daemon(daemon, checks, True)
    assert "did not confirm" in report.may_move and not report.conforms


def refusal(capsys: pytest.CaptureFixture[str]) -> str:
    return str(json.loads(capsys.readouterr().out)["error"]["code"])


def test_wrong_use_is_refused_before_anything_moves(
    proxy: Proxy, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", (tmp_path / "empty").open("w+"))
    for more, code, status in (
        ([], "wrong_use", 2),  # nobody to ask
        (["--motion", "--only", "status.nothing"], "wrong_use", 2),
        (["--motion", "--junit", str(tmp_path / "no" / "x.xml")], "wrong_use", 2),
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
