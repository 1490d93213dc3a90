"""What the status says, and that its times are true."""

from __future__ import annotations

import hashlib
import math
import re
import time
from itertools import pairwise

from mastctl.conform.checks import NotTried, Suite, expect
from mastctl.conform.daemon import WORDS_OF_NOW, Daemon, field, number

STATES: Suite[Daemon] = Suite()

SAME_S = 0.002  # ages are told from one moment; rounding only
RATE_PART, RATE_S = 0.02, 0.05
READ_EVERY_S = 1.0  # the head at rest is read 20 times a second; a reading this old is none
SAMPLES = 6


@STATES.check(
    "status.keys", "the status tells state, hardware, joints, limits, mast file, cameras and faults"
)
def _keys(daemon: Daemon) -> str:
    status = daemon.status()
    word = field(status, "state")
    expect(word in WORDS_OF_NOW, f"state is {word!r} where one of {', '.join(WORDS_OF_NOW)} is expected")
    kind = field(status, "hardware")
    kinds = ("real", "simulated", "replayed", "mixed")
    expect(kind in kinds, f"hardware is {kind!r} where one of {', '.join(kinds)} is expected")
    expect(
        isinstance(field(status, "moving"), bool), f"moving is {status['moving']!r}, neither true nor false"
    )
    for key in ("operation", "target", "last_residual", "control", "pose", "cameras", "version"):
        field(status, key)
    faults = field(status, "faults")
    expect(isinstance(faults, list), "faults is no list")
    for fault in faults:
        for key in ("device", "code", "message"):
            expect(isinstance(field(fault, key), str) and fault[key], f"faults: a fault has no {key}")
    expect(
        (word == "fault") <= bool(faults or status["joints"] is None), "state is fault, and no fault is told"
    )
    return f"{kind}, {word}, {len(faults)} faults"


@STATES.check("status.joints", "measured joint angles are finite, within a turn, and fresh")
def _joints(daemon: Daemon) -> str:
    status = daemon.status()
    pan, tilt = daemon.joints()
    for name, angle in (("pan_rad", pan), ("tilt_rad", tilt)):
        expect(
            math.isfinite(angle) and abs(angle) <= math.tau, f"joints.{name} is {angle}, beyond a full turn"
        )
    age_s = number(status, "joints", "age_s")
    expect(0 <= age_s < READ_EVERY_S, f"joints.age_s is {age_s:.3f} s: no reading came for so long")
    return f"pan {pan:.4f} rad, tilt {tilt:.4f} rad, {age_s:.3f} s old"


@STATES.check("status.limits", "limits are finite, the lower end below the upper one, and the speed above 0")
def _limits(daemon: Daemon) -> str:
    pan, tilt, speed = daemon.limits
    for end in (*pan, *tilt, speed):
        expect(math.isfinite(end), f"a limit is {end}")
    return f"pan {pan[0]:g} to {pan[1]:g}, tilt {tilt[0]:g} to {tilt[1]:g} rad, {speed:g} rad/s"


@STATES.check("status.mast_digest", "the told digest is the SHA-256 of the mast file that GET /mast gives")
def _digest(daemon: Daemon) -> str:
    told = field(daemon.status(), "mast", "digest")
    expect(isinstance(told, str) and re.fullmatch("[0-9a-f]{64}", told), f"mast.digest is {told!r}")
    made = hashlib.sha256(daemon.mast).hexdigest()
    expect(told == made, f"mast.digest begins with {told[:12]}, that of the file's bytes with {made[:12]}")
    return f"{told[:12]}..., {len(daemon.mast)} bytes"


@STATES.check("times.now", "now_s and uptime_s grow together, from answer to answer")
def _now(daemon: Daemon) -> None:
    found = [daemon.status() for _ in range(SAMPLES)]
    started = [number(status, "now_s") - number(status, "uptime_s") for status in found]
    nows = [number(status, "now_s") for status in found]
    still = field(found[0], "hardware") != "real"  # a simulated rover's time may wait for who asks
    for before, after in pairwise(nows):
        expect(after > before or (still and after == before), f"now_s went from {before:.6f} to {after:.6f}")
    drift_s = max(started) - min(started)
    expect(drift_s < SAME_S, f"now_s less uptime_s, the moment of the start, changed by {drift_s:.4f} s")


@STATES.check("times.rate", "a second of real hardware is a second of this machine")
def _rate(daemon: Daemon) -> str:
    first, first_answer = daemon.status(), daemon.wire.answers[-1]
    if field(first, "hardware") != "real":
        raise NotTried("a simulated rover may live faster")
    time.sleep(1.0)
    last, last_answer = daemon.status(), daemon.wire.answers[-1]
    told_s = number(last, "now_s") - number(first, "now_s")
    least_s = last_answer.began_s - first_answer.ended_s
    most_s = last_answer.ended_s - first_answer.began_s
    expect(
        least_s * (1 - RATE_PART) - RATE_S <= told_s <= most_s * (1 + RATE_PART) + RATE_S,
        f"now_s grew by {told_s:.3f} s in {least_s:.3f} to {most_s:.3f} s",
    )
    return f"{told_s:.3f} s in {least_s:.3f} to {most_s:.3f} s"


@STATES.check("times.ages", "the age of a reading is now_s less its stamp, and its stamps grow")
def _ages(daemon: Daemon) -> None:
    measured_s = -math.inf
    for _ in range(SAMPLES):
        status = daemon.status()
        stamp_s, age_s = number(status, "joints", "measured_s"), number(status, "joints", "age_s")
        true_s = max(0.0, number(status, "now_s") - stamp_s)
        expect(
            abs(age_s - true_s) < SAME_S,
            f"joints.age_s is {age_s:.4f} s, now_s less measured_s is {true_s:.4f} s",
        )
        expect(stamp_s >= measured_s, f"joints.measured_s went back from {measured_s:.6f} to {stamp_s:.6f}")
        measured_s = stamp_s
        daemon.let_pass(0.06)
