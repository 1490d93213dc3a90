"""Inside the virtual machine: brings loopback up, runs the job, and leaves its exit status in $VM_OUT."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import struct
import subprocess
from pathlib import Path

SIOCGIFFLAGS, SIOCSIFFLAGS, IFF_UP = 0x8913, 0x8914, 0x1


def loopback_up() -> None:
    """Do what `ip link set lo up` does, without needing ip."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        answer = fcntl.ioctl(udp, SIOCGIFFLAGS, struct.pack("16sh14x", b"lo", 0))
        flags = struct.unpack("16sh14x", answer)[1]
        fcntl.ioctl(udp, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", flags | IFF_UP))


def main() -> None:
    out = Path(os.environ["VM_OUT"])
    job = json.loads((out / ".job.json").read_text())
    loopback_up()
    environment = {**os.environ, **job["environment"]}
    done = subprocess.run(job["command"], cwd=job["folder"], env=environment, stdin=subprocess.DEVNULL)
    partial = out / ".status.partial"
    partial.write_text(str(done.returncode))
    partial.rename(out / ".status")


if __name__ == "__main__":
    main()
