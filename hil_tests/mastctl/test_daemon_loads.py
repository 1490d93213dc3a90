"""What a daemon has loaded when it answers, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys

ASKS = """
import http.client, json, sys
from pathlib import Path
import pytest
from hil_tests.mastctl.service_fakes import fake_daemon

loaded = {}
with pytest.MonkeyPatch.context() as patch, fake_daemon(patch, Path(sys.argv[1])) as (daemon, _):
    port = daemon.url.rpartition(":")[2]
    loaded["scipy"] = [name for name in sys.modules if name.startswith("scipy")]
    for path in ("stop", "estop", "track/stop"):
        before = set(sys.modules)
        line = http.client.HTTPConnection("127.0.0.1", int(port), timeout=60)
        line.request("POST", "/api/v1/" + path)
        assert line.getresponse().status == 200
        loaded[path] = sorted(set(sys.modules) - before - {"encodings.idna", "stringprep"})  # the client's
print(json.dumps(loaded))
"""


def test_a_stop_waits_for_no_module_and_a_start_for_no_scipy(tmp_path: object) -> None:
    outcome = subprocess.run(
        [sys.executable, "-c", ASKS, str(tmp_path)], capture_output=True, text=True, timeout=120.0, check=True
    )
    assert json.loads(outcome.stdout) == {"scipy": [], "stop": [], "estop": [], "track/stop": []}
