"""Ask a daemon what its /openapi.json allows and much that it does not, and hold each answer against it.

    .venv/bin/python -m tools.campaigns.fuzz_http --minutes 10

A daemon of its own with the simulated rover is asked by schemathesis: all its checks (no 5xx; status, kind,
form and headers as described; what is wrong is refused) but one. That every body which fits the form is
accepted cannot hold: which keys go together (exactly one target), what is in reach and which ids there are
stands in no form. Left out are the two endless event streams (/events, /track/stream) and /health/ready,
whose 503 is an answer. What is asked at random latches emergency stops, takes leases and sets faults, for
which nearly all that follows would be refused: they are taken back twice a second. For a third of the time
it asks as who holds the lease, with bodies that fit the form, so that commands are carried out too. Exit
code 1 if anything was found.
"""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from mastctl.cli.output import positive_number
from mastctl.client import Client, ClientError
from mastctl.commands.lease import LONGEST_S
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.web import PREFIX
from tools.arguments import end

LEFT_OUT = ("positive_data_acceptance",)
UNASKED = f"^{PREFIX}/(events|track/stream|health/ready)$"
UNASKED_AS_HOLDER = f"^{PREFIX}/(events|track/stream|health/ready|stop|estop|lease.*)$"
DEADLINE_S = 20.0
TAKEN_BACK_EACH_S = 0.5


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(
        description="Ask a daemon everything and hold its answers against /openapi.json."
    )
    parser.add_argument("--minutes", type=positive_number, default=10.0, help="how long (default 10)")
    parser.add_argument("--examples", type=int, default=100000, help="at most for each route")
    parser.add_argument("--seed", type=int, help="of an earlier run, to ask the same again")
    args = parser.parse_args()
    with simulated_daemon() as url:
        return ask(url, 60.0 * args.minutes, args.examples, args.seed)


@contextlib.contextmanager
def simulated_daemon() -> Iterator[str]:
    """A daemon with the simulated rover on a free port; its address."""
    config = replace(load_config(), listen=Listen(port=0))
    with RunningDaemon(config) as daemon:
        yield daemon.url


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


if __name__ == "__main__":
    end(main)
