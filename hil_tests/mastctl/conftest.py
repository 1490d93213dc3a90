"""What every test of the service is asked for beside its own question."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hil_tests.described_answers import answers_checked


@pytest.fixture(scope="session")
def complaints() -> Iterator[list[str]]:
    """What daemons of this process have answered and not described."""
    with answers_checked() as found:
        yield found


@pytest.fixture(autouse=True)
def _every_answer_is_described(complaints: list[str]) -> Iterator[None]:
    complaints.clear()
    yield
    assert not complaints, "answers that /openapi.json does not describe"
