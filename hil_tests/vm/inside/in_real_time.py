"""What takes real time: vivid waits for its own lock without a pause, so that a turned clock stands still.

Named by `hil_tests/vm/test_slow_control.py`; its name keeps it out of the rest.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time

from drivers.v4l2 import find
from hil_tests.vm.inside.conftest import BUS

SLOW_MS = 1000
TURNS = 10  # one that holds up all others leaves it one or two
WRITER = """
import sys
from drivers.v4l2.controls import set_by_name
from drivers.v4l2.find import Address, open_node
with open_node(Address(bus=sys.argv[1]), "beside") as node:
    print("begins", flush=True)
    print(set_by_name(node, {"integer_32_bits": int(sys.argv[2])}))
"""
"""Writes a control that takes as many milliseconds as its value says, and with it the lock of the stream."""


def test_a_frame_request_behind_a_slow_control_stops_no_other_thread() -> None:
    with find.open_node(find.Address(bus=BUS[0]), "left") as node:
        node.set_format("YUYV", (640, 480))
        node.start(4)
        command = [sys.executable, "-c", WRITER, BUS[0], str(SLOW_MS)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None and writer.stdout.readline() == "begins\n"
            time.sleep(0.2)
            request = threading.Thread(target=node.dequeue)
            turns = 0
            request.start()
            while request.is_alive():
                turns += 1  # of any other thread
                time.sleep(0.005)
            assert writer.stdout.read() == "[]\n"
    print(f"{turns} turns")
    assert turns > TURNS, "the request, which waits for the control, held up the other thread"
