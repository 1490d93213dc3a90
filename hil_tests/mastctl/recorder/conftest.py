"""Nothing in this folder is lost because the machine is busy."""

from __future__ import annotations

import pytest

from hil_tests.waiting import NET_S
from mastctl.recorder import feed, recorder, writer


@pytest.fixture(autouse=True)
def disks_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bounds of real time within which a disk has to answer are nets here; who tests one sets it."""
    for module, name in (
        (recorder, "SLOW_S"), (recorder, "ANSWER_S"), (recorder, "CLOSE_S"), (writer, "FINISH_S"),
        (feed, "CLOSE_S"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, NET_S)
