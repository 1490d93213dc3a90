"""Short forms of the soak that docs/evidence/safety.md reports."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil_tests.support import soak as campaign


@pytest.mark.long(2, "a soak in small, 15 s of processor time")
def test_a_daemon_among_faults_and_bad_clients_does_as_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So short a run has no warm-up: whether the daemon grows is the long one's question."""
    monkeypatch.setattr(campaign, "WEIGH_S", 0.0)
    monkeypatch.setattr(campaign.Crowd, "warm_up", lambda crowd, least_s, operations: crowd.work(1.0))
    monkeypatch.setattr(campaign, "judge", lambda first, last, ledger: None)
    assert campaign.soak(tmp_path, 3.0, seed=3, settle_s=0.5) == []


@pytest.mark.long(4, "three minutes: memory, threads and descriptors are weighed after a warm-up")
def test_a_daemon_among_faults_and_bad_clients_stays_the_same(tmp_path: Path) -> None:
    assert campaign.soak(tmp_path, 60.0, seed=3) == []
