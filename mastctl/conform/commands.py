"""That two programs never steer at once, and that what is sent twice is done once."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Any

from mastctl.conform.checks import Suite, expect
from mastctl.conform.daemon import Daemon, field
from mastctl.conform.wire import Answer

COMMANDS: Suite[Daemon] = Suite()

HOLDER, OTHER = {"Mastctl-Client": "conform"}, {"Mastctl-Client": "conform, another"}
LEASE_S = 60.0
UNKNOWN = "0" * 32


@COMMANDS.check("lease.alone", "one holds the lease; another is refused, and told by whom")
def _alone(daemon: Daemon) -> str:
    with _Held(daemon) as held:
        answer = daemon.refused((409,), ("leased",), "POST", "/lease", json={}, headers=OTHER)
        detail = field(field(answer.json(), "error"), "detail")
        expect(field(detail, "holder") == "conform", f"the refusal says that {detail['holder']} steers")
        control = field(daemon.status(), "control")
        expect(
            isinstance(control, dict) and control.get("holder") == "conform",
            f"GET /status: control is {control!r} while conform holds the lease",
        )
        left_s = field(control, "for_s")
        expect(0 < left_s <= LEASE_S, f"GET /status: control.for_s is {left_s} of {LEASE_S:g} s")
        for told in (answer.data, daemon.wire.ask("GET", "/status").data):
            expect(held.id.encode() not in told, "the lease's id is told to who does not hold it")
        return f"{left_s:.1f} s left of {LEASE_S:g}"


@COMMANDS.check(
    "lease.steers", "who holds no lease moves nothing while another does; with it the head moves", moves=True
)
def _steers(daemon: Daemon) -> str:
    pan, tilt = daemon.goal(0.2, 0.0)
    body = {"pan_rad": pan, "tilt_rad": tilt}
    with _Held(daemon) as held:
        for headers in (OTHER, HOLDER, {}):
            daemon.refused((409,), ("leased",), "POST", "/point", json=body, headers=headers)
        wrong = HOLDER | {"Mastctl-Lease": UNKNOWN}
        daemon.refused((409,), ("lease_unknown",), "POST", "/point", json=body, headers=wrong)
        accepted = daemon.wire.ask("POST", "/point", json=body, headers=held.headers)
        record = daemon.ended(str(field(accepted.document(), "id")))
        expect(record["state"] == "done", f"the holder's pointing ended {record['state']}")
    return "four refused, the holder's carried out"


@COMMANDS.check("lease.ends", "a lease that was released or taken over holds no more, and nobody steers")
def _ends(daemon: Daemon) -> None:
    with _Held(daemon) as held, _Held(daemon, OTHER, taken=True) as other:
        daemon.refused((409,), ("lease_over",), "POST", "/lease/renew", json={}, headers=held.headers)
        daemon.wire.ask("POST", "/lease/renew", json={}, headers=other.headers).document()
        daemon.wire.ask("DELETE", "/lease", headers=other.headers).document()
        daemon.refused((409,), ("lease_over",), "DELETE", "/lease", headers=other.headers)
    control = field(daemon.status(), "control")
    expect(control is None, f"GET /status: control is {control!r} after the release")


@COMMANDS.check("lease.bounds", "a lease without end, of no time, or taken without a reason is refused")
def _bounds(daemon: Daemon) -> None:
    for body in ({"for_s": 0}, {"for_s": -1}, {"for_s": 1e9}, {"for_s": "long"}, {"no_such_key": 1}):
        daemon.refused((422,), ("bad_request",), "POST", "/lease", json=body)
    daemon.refused((422,), ("bad_request",), "POST", "/lease/take", json={})
    daemon.refused((422,), ("bad_request",), "POST", "/lease/renew", json={})


@COMMANDS.check("keys.once", "a command sent twice with one key is carried out once", moves=True)
def _once(daemon: Daemon) -> str:
    pan, tilt = daemon.goal(-0.2, 0.0)
    body, headers = {"pan_rad": pan, "tilt_rad": tilt}, HOLDER | {"Idempotency-Key": secrets.token_hex(16)}
    ids = []
    for _ in range(2):
        ids.append(field(daemon.wire.ask("POST", "/point", json=body, headers=headers).document(), "id"))
        daemon.ended(str(ids[-1]))  # once it has ended, nothing stands against a second one
    expect(ids[0] == ids[1], f"the second try began operation {ids[1]} beside {ids[0]}")
    other = body | {"pan_rad": pan + 1e-3}
    daemon.refused((422,), ("key_reused",), "POST", "/point", json=other, headers=headers)
    return f"operation {ids[0]} both times"


@COMMANDS.check(
    "deadline.ends", "an operation that is given no time to arrive ends with deadline_passed", moves=True
)
def _deadline(daemon: Daemon) -> str:
    pan, tilt = daemon.goal(0.9, 0.0)
    answer = daemon.wire.ask(
        "POST",
        "/point",
        json={"pan_rad": pan, "tilt_rad": tilt},
        headers=HOLDER | {"Deadline-S": "0.02"},  # less than a head needs to be read twice at rest
    )
    if answer.status == 409 and answer.refusal[0] == "deadline_passed":
        return "before it began"
    record = daemon.ended(str(field(answer.document(), "id")))
    code = (record.get("error") or {}).get("code")
    expect(code == "deadline_passed", f"it ended {record['state']} with code {code}")
    return "while it ran"


class _Held:
    """A lease inside a block, given back whatever happens."""

    def __init__(self, daemon: Daemon, who: Mapping[str, str] = HOLDER, *, taken: bool = False) -> None:
        self._daemon = daemon
        self._who = who
        self._taken = taken

    def __enter__(self) -> _Held:
        path, why = ("/lease/take", {"reason": "a check"}) if self._taken else ("/lease", {})
        answer = self._daemon.wire.ask("POST", path, json={"for_s": LEASE_S, **why}, headers=self._who)
        self.id = _acquired(answer)
        self.headers = {**self._who, "Mastctl-Lease": self.id}
        return self

    def __exit__(self, *ignored: object) -> None:
        self._daemon.wire.ask("DELETE", "/lease", headers=self.headers)


def _acquired(answer: Answer) -> str:
    """The id of the lease that an answer gives. Raises PromiseBroken."""
    told: dict[str, Any] = answer.document()
    found = field(told, "lease_id")
    expect(isinstance(found, str) and len(found) >= 16, f"{answer.asked}: lease_id is {found!r}")
    return str(found)
