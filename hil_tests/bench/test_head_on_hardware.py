"""The acceptance of heads on a real one: ``pytest hil_tests/bench --hardware FILE``.

FILE is a configuration with narrow limits and a low speed; the head moves over all of them
(docs/how-to/hardware.md). Each test ends with a look at the device's own error registers. The tests are
those of `mastctl.testing.drivers`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hil_tests.bench.hardware_rig import CHOSEN, error_registers, hardware_trial
from mastctl.config import load_config
from mastctl.conform.device_checks import NotTried
from mastctl.testing.drivers import test_head as suite
from mastctl.testing.drivers.test_head import HeadTrial

if CHOSEN is None:
    pytest.skip("moves a real head; name its configuration with --hardware FILE", allow_module_level=True)


@pytest.fixture
def trial() -> Iterator[HeadTrial]:
    """The real head, sent to the middle of its limits before each test."""
    assert CHOSEN is not None
    settings = load_config(CHOSEN).hardware.pan_tilt
    with hardware_trial(Path(CHOSEN)) as made:
        yield made
        assert tuple(made.read().faults) == ()
        made.stop()
    assert error_registers(settings) == {}, "the device has noted a hardware error"


@pytest.mark.parametrize("promise", [name for name in vars(suite) if name.startswith("test_")])
def test_a_head_keeps_its_promise(trial: HeadTrial, promise: str) -> None:
    try:
        getattr(suite, promise)(trial)
    except NotTried as reason:
        pytest.skip(str(reason))
