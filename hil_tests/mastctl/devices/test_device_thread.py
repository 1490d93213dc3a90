"""The thread of one device, at the very moment of a deadline."""

from __future__ import annotations

import pytest

from drivers.errors import NoReply
from hil_tests.mastctl.devices.turned import Hang, Turned
from mastctl.devices.thread import DeviceThread


def test_a_call_given_up_at_its_deadline_is_overdue_for_the_next() -> None:
    clock = Turned()
    hang = Hang(clock)
    with clock.at_work():
        thread = DeviceThread("pan_tilt", clock=clock)
        try:
            with pytest.raises(NoReply, match="did not end within its deadline"):
                thread.call("read", hang, 1.0)
            with pytest.raises(NoReply, match=r"read has been under way for 1\.0 s"):
                thread.submit("read", lambda: None, 1.0)
        finally:
            hang.let_go()
    assert thread.close(60.0)
