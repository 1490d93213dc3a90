"""Aravis's own fake GigE Vision camera as a process: aravis_fake.py SERIAL.

It is the library's, with ctypes declarations of its own: nothing of the driver is in it. It sends packets
over the loopback, stamps frames by the wall clock, and draws a ramp that moves with the frame's number.
"""

from __future__ import annotations

import ctypes
import sys

INTERFACE = "127.0.0.1"


def main() -> None:
    """Serve until the standard input ends."""
    serial = sys.argv[1]
    arv = ctypes.CDLL("libaravis-0.8.so.0")
    arv.arv_gv_fake_camera_new_full.restype = ctypes.c_void_p
    arv.arv_gv_fake_camera_new_full.argtypes = [ctypes.c_char_p] * 3
    arv.arv_gv_fake_camera_is_running.argtypes = [ctypes.c_void_p]
    camera = arv.arv_gv_fake_camera_new_full(INTERFACE.encode(), serial.encode(), None)
    print("ready" if arv.arv_gv_fake_camera_is_running(camera) else "cannot run", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
