"""Boots the kernel on this machine's own files, read-only, and runs one command in it.

The command sees this machine's files as they are, with a file system in memory over /run and /dev/shm.
What it shall leave behind goes to the folder ``$VM_OUT``, the one place outside memory that it may write to.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

INIT = Path(__file__).resolve().parents[3] / "hil_tests" / "vm" / "init"

CAMERAS = {
    "webcams": "n_devs=2 node_types=0x20001,0x1 num_inputs=1,2 input_types=0x0,0xc multiplanar=1,2",
    "hdmi": "n_devs=2 node_types=0x101,0x101 num_inputs=1,1 input_types=0x3,0x3 "
    "num_outputs=1,1 output_types=0x1,0x1",
    "three": "n_devs=3 node_types=0x1,0x1,0x1 num_inputs=1,1,1 input_types=0x3,0x3,0x3",
    "vimc": "",
}
"""Layouts of the virtual cameras, as options of vivid: two webcams, the first with a metadata node, the
second multi-planar and with an HDMI input beside; two HDMI inputs, each with an output that can be looped
into it; or three HDMI inputs. Without options there is no vivid, but vimc: sensors behind a media
controller."""


class VmFailed(Exception):
    """The machine ended without running the command to its end: a panic, a hang, no result."""


@dataclass(frozen=True)
class Result:
    """How the command ended: its exit status, and all that it and the kernel wrote."""

    status: int
    console: str


def run(
    kernel: Path,
    command: Sequence[str],
    out: Path,
    folder: Path | None = None,
    cameras: str = CAMERAS["webcams"],
    timeout_s: float = 300.0,
    memory_mb: int = 1536,
    environment: Mapping[str, str] | None = None,
    show: bool = False,
    real_time: bool = False,
) -> Result:
    """Boot, run, power off.

    The machine's clock stands still while anything in it computes and jumps ahead while nothing does, so that
    no other program of this machine makes anything late in it, and nobody waits.

    Parameters
    ----------
    kernel
        From `hil_tests.support.virtual_machine.kernel`.
    command
        Program and arguments.
    out
        An existing folder, ``$VM_OUT`` in the machine.
    folder
        Where the command runs; the present folder when left out.
    cameras
        Options of vivid, separated by spaces; none: vimc in its place.
    timeout_s
        After which the machine is killed.
    environment
        Added to a small environment of its own.
    show
        Pass the console on to stdout while it runs.
    real_time
        Let the machine's clock run as this one's does, for who measures rates and loads.

    Raises
    ------
    VmFailed
        If the command did not come to its end.
    """
    (out / ".status").unlink(missing_ok=True)
    job = {
        "command": list(command),
        "folder": str(folder or Path.cwd()),
        "environment": dict(environment or {}),
    }
    (out / ".job.json").write_text(json.dumps(job))
    vivid = [f"vivid.{option}" for option in cameras.split()]
    vivid.append(f"initcall_blacklist={'vimc' if vivid else 'vivid'}_init")
    clock = [] if real_time else ["time-travel=inf-cpu"]
    with tempfile.TemporaryDirectory(prefix="mastctl-vm-") as name:
        arguments = [
            str(kernel), f"mem={memory_mb}M", "root=none", "rootfstype=hostfs", "rootflags=/", "ro",
            *clock, f"init={INIT}", "con=null", "con0=fd:0,fd:1", "quiet", "panic=-1", f"uml_dir={name}",
            *vivid, f"VM_OUT={out}",
        ]  # fmt: skip
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=None if show else subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={
                "PATH": os.environ.get("PATH", ""),
                "HOME": os.environ.get("HOME", "/"),
                "TMPDIR": _memory_folder(name, memory_mb),
            },
            text=True,
            errors="replace",
        )
        try:
            console = process.communicate(timeout=timeout_s)[0] or ""
        except subprocess.TimeoutExpired:
            raise VmFailed(f"the machine did not end within {timeout_s:g} s") from None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
    status_file = out / ".status"
    if not status_file.is_file():
        tail = "\n".join(console.splitlines()[-30:])
        raise VmFailed(f"the machine ended (with {process.returncode}) before the command did:\n{tail}")
    return Result(int(status_file.read_text()), console)


def _memory_folder(otherwise: str, memory_mb: int) -> str:
    """Where the machine's memory lives as a file: in memory if there is room, else on disk: slower."""
    shm = Path("/dev/shm")
    if shm.is_dir():
        room = os.statvfs(shm)
        if room.f_bavail * room.f_frsize > 1.1 * memory_mb * 2**20:
            return str(shm)
    return otherwise
