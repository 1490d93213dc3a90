"""Requests that schemathesis makes of a daemon from its /openapi.json: as any client, then with the lease.

Schemathesis makes all its checks but one: not every body of the described form is accepted, since no schema
states which keys go together, what is in reach, or which ids exist. Left out are the endless stream
/events and /health/ready, whose 503 is an answer. Random requests latch emergency stops,
take leases and set faults, for which most later ones would be refused: these are undone twice a second.
Then the holder of the lease sends bodies of the described form, so that commands are carried out.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from mastctl.client import Client, ClientError
from mastctl.control.lease import LONGEST_S
from mastctl.http import PREFIX

LEFT_OUT = ("positive_data_acceptance",)
ANY_HEADER = """[[operations]]
include-path = "/api/v1/track/stop"
generation.allow-extra-parameters = false
"""  # it has headers alone, of which HTTP allows any, and is always carried out
UNASKED = f"^{PREFIX}/(events|health/ready)$"
UNASKED_AS_HOLDER = f"^{PREFIX}/(events|health/ready|stop|estop|lease.*)$"
DEADLINE_S = 20.0
TAKEN_BACK_EACH_S = 0.5


def ask(url: str, seconds: float | None, examples: int, seed: int | None = None) -> int:
    """Have schemathesis ask, as anybody and as who steers; return its exit code, its words go to stdout.

    With ``seconds`` None each route is asked ``examples`` times as anybody and as who steers, and no more.
    """
    common = ["--max-examples", str(examples), *(() if seed is None else ("--seed", str(seed)))]
    phases = "examples,fuzzing" if seconds is None else "examples,coverage,fuzzing"
    with taken_back(url):
        anybody = ["--exclude-path-regex", UNASKED, "--phases", phases]
        code = _asked(url, None if seconds is None else 2.0 / 3.0 * seconds, [*anybody, *common])
    if code != 0:
        return code
    with Client(url, name="holder") as client:
        lease = client.acquire_lease(for_s=LONGEST_S, take_over="the campaign goes on")["lease_id"]
    holder = ["--exclude-path-regex", UNASKED_AS_HOLDER, "--phases", "fuzzing", "--mode", "positive"]
    headers = ["--header", f"Mastctl-Lease: {lease}", "--header", f"Deadline-S: {DEADLINE_S:g}"]
    return _asked(url, None if seconds is None else seconds / 3.0, [*holder, *headers, *common])


def _asked(url: str, seconds: float | None, options: Sequence[str]) -> int:
    command = [
        *(str(Path(sys.executable).with_name("schemathesis")), "run", f"{url}/openapi.json", "--no-color"),
        *("--checks", "all", "--exclude-checks", ",".join(LEFT_OUT)),
        *(() if seconds is None else ("--max-time", f"{seconds:.0f}")),
        *("--request-timeout", "60", "--warnings", "off", *options),
    ]
    with tempfile.TemporaryDirectory() as folder:  # it leaves a folder where it runs
        Path(folder, "schemathesis.toml").write_text(ANY_HEADER)
        return subprocess.run(command, cwd=folder, text=True, check=False).returncode


@contextlib.contextmanager
def taken_back(url: str) -> Iterator[None]:
    """Take back again and again, inside the block, what has commands refused."""
    over = threading.Event()

    def work() -> None:
        with Client(url, name="taken-back") as client:
            while not over.wait(TAKEN_BACK_EACH_S):
                for take_back in (
                    lambda: client.reset(reason="the campaign goes on", name="taken-back"),
                    lambda: client.use_lease(client.acquire_lease(take_over="it goes on")["lease_id"]),
                    client.release_lease,
                    client.clear_faults,
                ):
                    with contextlib.suppress(ClientError):  # nothing was latched; no simulated rover
                        take_back()

    thread = threading.Thread(target=work, name="taken back", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
