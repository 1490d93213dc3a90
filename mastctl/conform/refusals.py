"""That what cannot be is refused: with a code, in the one form, with a fitting status, and nothing moves."""

from __future__ import annotations

import json

from mastctl.conform.checks import Suite, expect
from mastctl.conform.daemon import Daemon, field

REFUSALS: Suite[Daemon] = Suite()

JSON = {"Content-Type": "application/json"}
AT_REST_RAD = 0.005  # a servo dithers at rest by a count or two
NAN = '{"pan_rad": NaN, "tilt_rad": 0.0}'
HUGE = '{"pan_rad": 1e400, "tilt_rad": 0.0}'


@REFUSALS.check("refusals.paths", "what is not there is 404, what cannot be done there 405")
def _paths(daemon: Daemon) -> None:
    daemon.refused((404,), ("not_found",), "GET", "/no-such-thing")
    daemon.refused((405,), ("method_not_allowed",), "DELETE", "/status")
    daemon.refused((404,), ("operation_unknown",), "GET", "/operations/no-such-operation")
    daemon.refused((404,), ("unknown_camera",), "GET", "/snapshot/no_such_camera")


@REFUSALS.check("refusals.bodies", "a body that is not JSON, is too large or says nothing is refused")
def _bodies(daemon: Daemon) -> None:
    daemon.refused((400,), ("not_json",), "POST", "/point", content="{", headers=JSON)
    daemon.refused(
        (415,), ("not_json",), "POST", "/point", content="{}", headers={"Content-Type": "text/plain"}
    )
    daemon.refused((413,), ("too_large",), "POST", "/point", content=" " * 70_000, headers=JSON)
    daemon.refused((422,), ("bad_request",), "POST", "/point", json={})
    daemon.refused((422,), ("bad_request",), "POST", "/point", json={"no_such_key": 1})
    daemon.refused(
        (422,), ("bad_request",), "GET", "/snapshot/" + _any_camera(daemon), params={"format": "bmp"}
    )


@REFUSALS.check("refusals.strangers", "requests of another host's name or another site's page are refused")
def _strangers(daemon: Daemon) -> None:
    daemon.refused((403,), ("foreign_host",), "GET", "/status", headers={"Host": "mast.example"})
    foreign = {"Origin": "http://mast.example"}
    daemon.refused((403,), ("foreign_origin",), "POST", "/point", json={}, headers=foreign)


@REFUSALS.check(
    "refusals.targets",
    "targets that are none are refused: two, half of one, no number, a wrong type",
    moves=True,
)
def _targets(daemon: Daemon) -> None:
    pan, tilt = daemon.joints()
    here = {"pan_rad": pan, "tilt_rad": tilt}
    for body in (
        {**here, "position_m": [5.0, 0.0, 0.0]},
        {"pan_rad": pan},
        {"pan_rad": str(pan), "tilt_rad": tilt},
        {"pan_rad": None, "tilt_rad": tilt},
        {"position_m": [5.0, 0.0]},
        {**here, "speed": 1.0},
    ):
        daemon.refused((422,), ("bad_request",), "POST", "/point", json=body)
    for text in (NAN, HUGE, NAN.replace("NaN", "-Infinity")):
        daemon.refused((400, 422), ("not_json", "bad_request"), "POST", "/point", content=text, headers=JSON)


@REFUSALS.check("refusals.limits", "joint angles beyond a limit are refused by its name", moves=True)
def _limits(daemon: Daemon) -> str:
    pan, tilt, _ = daemon.limits
    at = daemon.joints()
    for axis, ends in enumerate((pan, tilt)):
        for end, sign in ((ends[0], -1), (ends[1], 1)):
            for beyond in (1e-6, 0.05, 1.0):
                goal = list(at)
                goal[axis] = end + sign * beyond
                body = {"pan_rad": goal[0], "tilt_rad": goal[1]}
                answer = daemon.refused(
                    (422,), ("outside_limits", "bad_request"), "POST", "/point", json=body
                )
                word = ("pan", "tilt")[axis]
                expect(
                    word in answer.refusal[1], f"the refusal of a {word} beyond its limit does not name it"
                )
    return "12 goals, from 1e-6 rad beyond"


@REFUSALS.check("refusals.head", "refusals leave the head where it is, and start no operation")
def _head(daemon: Daemon) -> str:
    known = _operations(daemon)
    before = daemon.joints()
    for body in ("{", "{}", '{"no_such_key": 1}', '{"pan_rad": 0.1}', '{"pan_rad": "right", "tilt_rad": 0}'):
        daemon.refused((400, 422), (), "POST", "/point", content=body, headers=JSON)
    after = daemon.rest()
    now = daemon.joints()
    off_rad = max(abs(a - b) for a, b in zip(now, before, strict=True))
    expect(off_rad <= AT_REST_RAD, f"the head stands {off_rad:.4f} rad from where it stood before")
    expect(after["operation"] is None, f"operation {after['operation']} runs")
    new = _operations(daemon) - known
    expect(not new, f"a refused request left an operation: {', '.join(sorted(new))}")
    return f"within {off_rad:.1e} rad"


@REFUSALS.check("refusals.form", "every refusal so far: 4xx or 5xx, JSON, a code and one plain sentence")
def _form(daemon: Daemon) -> str:
    refused = [answer for answer in daemon.wire.answers if answer.status >= 400]
    for answer in refused:
        where = f"{answer.asked}: {answer.status}"
        expect(answer.status < 600, where)
        expect(
            answer.media_type == "application/json", f"{where} as {answer.media_type or 'nothing'}, not JSON"
        )
        error = field(answer.json(), "error")
        code, message = field(error, "code"), field(error, "message")
        field(error, "detail")
        expect(isinstance(code, str) and code.isidentifier() and code.islower(), f"{where}: code {code!r}")
        expect(isinstance(message, str) and " " in message and "\n" not in message, f"{where}: {message!r}")
        expect("Traceback" not in message, f"{where}: its message is a traceback")
    for answer in daemon.wire.answers:
        if answer.status < 400 and answer.media_type == "application/json":
            told = answer.json()
            refusal = isinstance(told, dict) and set(told) == {"error"}
            expect(not refusal, f"{answer.asked}: an error that says {answer.status}")
    return f"{len(refused)} refusals"


def _operations(daemon: Daemon) -> set[str]:
    """The ids of the operations that are told."""
    told = field(daemon.wire.ask("GET", "/operations").document(), "operations")
    return {str(field(one, "id")) for one in told}


def _any_camera(daemon: Daemon) -> str:
    """A configured camera's name; any name where there is none."""
    names = field(daemon.began, "cameras")
    return next(iter(names), "navcam_left") if isinstance(names, dict) else json.dumps(names)
