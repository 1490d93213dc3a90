"""Nothing in this folder is lost because the machine is busy."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hil_tests.waiting import NET_S
from mastctl.recorder import recorder, writer


@pytest.fixture(scope="module", autouse=True)
def disks_are_waited_for() -> Iterator[None]:
    """The bounds of real time within which a disk has to answer are nets; a test of one sets it itself."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            (recorder, "SLOW_S"), (recorder, "ANSWER_S"), (recorder, "CLOSE_S"), (writer, "FINISH_S"),
        ):  # fmt: skip
            patch.setattr(module, name, NET_S)
        yield
