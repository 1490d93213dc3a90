"""``python -m mastctl ...`` in a process that is forked from one where mastctl is imported already.

Starting Python and importing the daemon takes over a second of processor time, a fork hundredths. One server
a pytest process, single-threaded, which has opened nothing, forks on request; the new process takes over the
arguments, folder, environment and standard streams that it was asked for, runs ``mastctl`` as ``-m`` does and
ends as any interpreter ends. It is a child of the process that asked (the server forks twice, and the one who
asks is its orphans' reaper meanwhile), so that `Popen` is `subprocess.Popen` in all that is asked of it.

The server ends when its socket closes, that is also when pytest is killed, and kills what it started and what
still runs. A test that is about the start of the interpreter itself starts a process by `subprocess`.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import gc
import io
import json
import os
import runpy
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
MASTCTL = [sys.executable, "-m", "mastctl"]
PR_SET_CHILD_SUBREAPER = 36  # prctl(2)
_SIZE = struct.Struct("!I")


class Popen(subprocess.Popen[Any]):
    """`subprocess.Popen` of ``[*MASTCTL, ...]``; of its options the streams, text, cwd and env."""

    def _execute_child(self, args: list[str], *rest: Any) -> None:
        _, preexec_fn, _, pass_fds, cwd, env, _, _, shell, *pipes = rest[:15]
        assert args[:3] == MASTCTL and not (preexec_fn or pass_fds or shell), (
            "only a true process can do that"
        )
        given = (pipes[0], pipes[3], pipes[5])  # the new process's ends
        order = {
            "words": args[3:],
            "cwd": os.fspath(cwd or Path.cwd()),
            "env": dict(os.environ if env is None else env),
        }
        try:
            self.pid = _asked(order, [number if fd == -1 else fd for number, fd in enumerate(given)])
            self._child_created = True
        finally:
            self._close_pipe_fds(*pipes)


def run(command: list[str], **options: Any) -> subprocess.CompletedProcess[Any]:
    """As `subprocess.run` with ``capture_output`` and ``text``, on the same terms as `Popen`."""
    timeout_s = options.pop("timeout", None)
    with Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options) as made:
        try:
            out, log = made.communicate(timeout=timeout_s)
        except BaseException:
            made.kill()
            raise
    return subprocess.CompletedProcess(command, made.returncode, out, log)


@functools.cache
def _server() -> socket.socket:
    """The server's socket; it starts with the first use."""
    here, there = socket.socketpair()
    server = subprocess.Popen(
        [sys.executable, "-m", "hil_tests.forks"],
        stdin=there,
        stdout=subprocess.DEVNULL,
        cwd=REPOSITORY,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},  # a fork copies one thread
    )
    there.close()
    atexit.register(server.wait)
    atexit.register(here.close)  # before: its sign to end
    return here


def _asked(order: dict[str, Any], fds: list[int]) -> int:
    """Send an order and return the new process's id."""
    server, prctl = _server(), ctypes.CDLL(None).prctl
    data = json.dumps(order).encode()
    prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        socket.send_fds(server, [_SIZE.pack(len(data))], fds)
        server.sendall(data)
        return int(_SIZE.unpack(_exactly(server, _SIZE.size))[0])
    finally:
        prctl(PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)


def _exactly(line: socket.socket, size: int) -> bytes:
    """So many bytes. Raises EOFError."""
    data = line.recv(size, socket.MSG_WAITALL)
    if len(data) < size:
        raise EOFError("the server of forks has ended")
    return data


def _serve(line: socket.socket) -> dict[str, Any] | None:
    """Fork for each order. Returns its order in a new process, and None when the line closes."""
    running: list[int] = []  # pidfds
    while True:
        data, fds, _, _ = socket.recv_fds(line, _SIZE.size, 3)
        if len(data) < _SIZE.size:
            for running_fd in running:
                with contextlib.suppress(ProcessLookupError):
                    signal.pidfd_send_signal(running_fd, signal.SIGKILL)
            return None
        order: dict[str, Any] = json.loads(_exactly(line, _SIZE.unpack(data)[0]))
        told, telling = os.pipe()
        between = os.fork()
        if not between:
            between = os.getpid()
            made = os.fork()
            if made:
                os.write(telling, _SIZE.pack(made))
                os._exit(0)
            while os.getppid() == between:
                time.sleep(0.0005)
            for number, fd in enumerate(fds):
                os.dup2(fd, number)
            os.closerange(3, os.sysconf("SC_OPEN_MAX"))
            return order
        for fd in (telling, *fds):
            os.close(fd)
        pid = os.read(told, _SIZE.size)
        os.close(told)
        running.append(
            os.pidfd_open(_SIZE.unpack(pid)[0])
        )  # before it can be waited for: nobody else has its id
        os.waitpid(between, 0)
        for ended in select.select(running, [], [], 0)[0]:
            running.remove(ended)
            os.close(ended)
        line.sendall(pid)


def _become(order: dict[str, Any], path: list[str]) -> None:
    """Take over what was asked for, as the interpreter does when it starts."""
    env = order["env"]
    os.chdir(order["cwd"])
    os.environ.clear()
    os.environ.update(env)
    tempfile.tempdir = None  # may be another one
    sys.argv = ["mastctl", *order["words"]]
    sys.path[:] = [order["cwd"], *filter(None, env.get("PYTHONPATH", "").split(os.pathsep)), *path]
    unbuffered = bool(env.get("PYTHONUNBUFFERED"))
    sys.stdin = sys.__stdin__ = open(0, encoding=sys.stdin.encoding, closefd=False)  # noqa: SIM115
    for number, name in ((1, "stdout"), (2, "stderr")):
        plain = getattr(sys, name)
        stream = io.TextIOWrapper(
            open(number, "wb", buffering=0 if unbuffered else -1, closefd=False),  # noqa: SIM115
            encoding=plain.encoding,
            errors=plain.errors,
            line_buffering=number == 2 or os.isatty(number),
            write_through=unbuffered,
        )
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _main() -> bool:
    """Serve; True in a new process."""
    asked_by = socket.socket(fileno=os.dup(0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal's whole group: pytest decides
    own = len([where for where in os.environ.get("PYTHONPATH", "").split(os.pathsep) if where])
    path = sys.path[1 + own :]
    import mastctl.cli.main
    import mastctl.cli.service
    import mastctl.daemon  # noqa: F401
    from hil_tests.left_behind import live_in

    live_in(Path(tempfile.gettempdir()) / "home")  # the asking process's own folder

    gc.collect()
    gc.freeze()
    order = _serve(asked_by)
    if order is not None:
        _become(order, path)
    return order is not None


if __name__ == "__main__" and _main():
    runpy.run_module("mastctl", run_name="__main__", alter_sys=True)
