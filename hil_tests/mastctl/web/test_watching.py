"""Metrics and health of a daemon, asked over HTTP."""

from __future__ import annotations

from prometheus_client.parser import text_string_to_metric_families

from hil_tests.mastctl.service_fakes import HTTP, FakeHardware
from hil_tests.waiting import until
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]


def test_metrics_are_read_by_prometheus_own_parser(pair: BOTH) -> None:
    answer = HTTP.get(f"{pair[0].url}/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    found = {family.name for family in text_string_to_metric_families(answer.text)}
    assert {"mastctl_info", "mastctl_state", "mastctl_uptime_seconds", "process_open_fds"} <= found


def test_a_daemon_is_ready_when_its_head_is_read_and_not_stopped(pair: BOTH) -> None:
    url = f"{pair[0].url}/api/v1"
    assert HTTP.get(f"{url}/health/live").json() == {"live": True}
    until(lambda: HTTP.get(f"{url}/health/ready").status_code == 200, "the first reading")
    HTTP.post(f"{url}/estop", json={"reason": "a dog is near the mast", "name": "Ida"})
    answer = HTTP.get(f"{url}/health/ready")
    assert answer.status_code == 503
    error = answer.json()["error"]
    assert error["code"] == "not_ready"
    assert error["message"].startswith("stopped: ") and "a dog is near the mast" in error["message"]
