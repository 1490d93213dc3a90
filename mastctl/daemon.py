"""The daemon: a socket, a service, a web server, and an orderly end.

It takes the address, opens the service, serves, and at its end stops the mast before anything else. A part
that hangs at the end is left behind after some seconds, and logged. Every signal that would end the process
ends it so.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import gc
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from types import TracebackType

import uvicorn
from starlette.types import ASGIApp

from drivers.clock import Clock
from drivers.hardware import Hardware
from mastctl import signals
from mastctl.config import Config, Listen
from mastctl.errors import MastctlError, Unable, one_line
from mastctl.http.guard import EntryRules
from mastctl.http.tokens import Access, TokenList
from mastctl.http.waiting import SilentConnections, Streams, Waiting
from mastctl.safety.state_folder import StateFolder
from mastctl.service.service import Service
from mastctl.service.stopping import StopsHang
from mastctl.web.app import create_app
from mastctl.web.commands import Parts
from mastctl.web.pictures import CameraFeeds

log = logging.getLogger(__name__)

GRACE_S = 2  # for answers under way, when the daemon ends; what waits for a device is refused at once
ACCEPTED_AT_ONCE = 4  # connections taken in one turn of the event loop
WAITING_IN_KERNEL = 128  # connections that the kernel keeps for us meanwhile
IDLE_S = 10  # how long a connection is kept for its next request
UNREAD_S = 10.0  # after that the kernel ends a connection whose client takes no bytes
LARGEST_HEADERS_BYTES = 16384
LARGEST_MESSAGE_BYTES = 1024  # of a WebSocket's client
PING_S = 20.0
REREAD_S = 0.5  # how late a new or a revoked token may be known
SWITCH_S = 0.0005  # a stop goes through five threads and may wait so long for each; 5 ms by default
START_TIMEOUT_S = 600.0  # the first start compiles the simulator's kernels
END_TIMEOUT_S = 20.0
BEATS = 4  # signs of life in the time that the service manager allows; it asks for two


class AddressInUse(MastctlError):
    """Another program listens there already."""

    code = "address_in_use"


def run(
    config: Config,
    on_ready: Callable[[str], object],
    clock: Clock | None = None,
    *,
    draws_ahead: bool = False,
) -> None:
    """Run a daemon in the main thread until a signal ends it; returns after the mast was stopped.

    The signals are those of `mastctl.signals.wanted`. After a second one no client is waited for; SIGTSTP
    (Ctrl-Z) does nothing. ``on_ready`` gets the address when requests are answered; a simulated rover that
    ``draws_ahead`` then draws its cameras' first pictures.

    Raises AddressInUse, StateInUse before the hardware is touched; BadFile, DriverError.
    """
    sys.setswitchinterval(SWITCH_S)
    with _opened(config, clock, own_process=True) as opened:

        def ready(_: Callable[[], None]) -> None:
            on_ready(opened.url)
            prepare = partial(_prepare, opened.service, draws_ahead)
            threading.Thread(target=prepare, name="first pointing", daemon=True).start()

        asyncio.run(_serve(opened, ready))


class RunningDaemon:
    """A daemon in a thread of this process, for the demo and for tests. A context manager."""

    def __init__(self, config: Config, clock: Clock | None = None) -> None:
        self._exit = contextlib.ExitStack()
        opened = self._exit.enter_context(_opened(config, clock, own_process=False))
        self.service, self.url = opened.service, opened.url
        self._end: Future[Callable[[], None]] = Future()  # what ends it, from the moment that it answers
        self._thread = threading.Thread(target=self._work, args=(opened,), name="daemon", daemon=True)
        self._thread.start()
        try:
            self._end.result(START_TIMEOUT_S)
        except BaseException as error:
            self.close()
            message = f"the daemon did not start: {one_line(error, 200) or type(error).__name__}"
            raise MastctlError(f"{message}; its log states more") from None

    @property
    def hardware(self) -> Hardware:
        """The opened drivers; ``hardware.simulation`` knows the truth."""
        return self.service.hardware

    def close(self) -> None:
        """Stop the mast, end the daemon, let go of everything; bounded. Does nothing the second time."""
        self._end.add_done_callback(lambda end: None if end.exception() else end.result()())
        self._thread.join(END_TIMEOUT_S)
        self._exit.close()

    def __enter__(self) -> RunningDaemon:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _work(self, opened: _Opened) -> None:
        try:
            asyncio.run(_serve(opened, self._end.set_result))
        except Exception as error:
            log.exception("the daemon ended")
            if not self._end.done():
                self._end.set_exception(error)


class ServiceManager:
    """The program that started this process and watches it, as systemd does (sd_notify(3)), or none.

    It gets lines of text as datagrams at ``NOTIFY_SOCKET``. No call waits: a manager that reads nothing loses
    messages, no more. ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` request signs of life. Two threads give one, one
    after the other: a turn of the head's thread requests it, and the event loop sends it, by ``in_loop``. If
    either hangs, nothing is sent: the manager ends the process and runs the command of its unit that stops
    the head.
    """

    def __init__(
        self,
        environ: Mapping[str, str],
        in_loop: Callable[[Callable[[], None]], object],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._address = environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # of the kernel, without a file
            self._address = f"\0{self._address[1:]}"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        self._in_loop = in_loop
        self._now_s = now_s
        microseconds, process = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
        watched = microseconds.isdecimal() and process in ("", str(os.getpid()))
        self._every_s = int(microseconds) / 1e6 / BEATS if watched else 0.0
        self._next_s = float("-inf")
        self._requested = False  # the loop has not sent the last one yet

    def send(self, text: str) -> None:
        """Send a line: ``READY=1``, ``STOPPING=1``, ``STATUS=...`` as ``systemctl status`` shows it."""
        if self._address:
            with contextlib.suppress(OSError):  # a manager that is gone, or reads nothing
                self._socket.sendto(" ".join(text.split()).encode(), self._address)

    def turn(self) -> None:
        """Take note that the calling thread goes on, at any rate; waits for nothing."""
        if not self._every_s or self._requested or self._now_s() < self._next_s:
            return
        self._next_s = self._now_s() + self._every_s
        self._requested = True
        with contextlib.suppress(RuntimeError):  # the loop has ended: so does the process
            self._in_loop(self._beat)

    def _beat(self) -> None:
        self._requested = False
        self.send("WATCHDOG=1")

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()


@dataclass(frozen=True)
class _Opened:
    """A service that listens at an address, with the rules for its clients."""

    service: Service
    listener: socket.socket
    url: str
    rules: EntryRules
    own_process: bool


@contextlib.contextmanager
def _opened(config: Config, clock: Clock | None, *, own_process: bool) -> Iterator[_Opened]:
    """Take the address, open the service and its socket for stops; leaving stops the mast and closes all.

    Inside another program state is kept in the configuration's folder, or in a temporary one.
    """
    listen, folder = config.listen, None
    with contextlib.ExitStack() as stack:
        listener, url = stack.enter_context(_listening(listen))
        if own_process or config.state_folder is not None:
            any_port = listen.socket is None and listen.port == 0  # it is not found there again
            folder = StateFolder.of(config.state_folder, config.path, None if any_port else listen.url)
            stack.callback(folder.close)
        service = Service.open(config, clock, folder)
        stack.callback(service.close)
        stop_path = service.open_stop_socket()
        for kept in (service.folder, service.head_folder):  # a stop finds the daemon of a head by either
            if kept is not None:
                kept.note_daemon(config.path, url, stop_path)
        yield _Opened(service, listener, url, _entry_rules(service, url), own_process)


def _prepare(service: Service, draws_ahead: bool) -> None:
    """Load the modules of a first pointing, and have a simulated rover draw its first pictures."""
    from scipy import ndimage, special  # noqa: F401

    rover = service.hardware.simulation
    if rover is not None and draws_ahead:
        rover.draw_ahead(service.clock.now_s())


async def _serve(opened: _Opened, on_ready: Callable[[Callable[[], None]], object]) -> None:
    """Serve until the end is requested; ``on_ready`` gets a function that requests it, from any thread.

    With a process of its own the signals are the daemon's, and the service is closed under their rule too.
    """
    loop = asyncio.get_running_loop()
    service, own_process, access = opened.service, opened.own_process, opened.rules.access
    waiting = Waiting(service.clock)
    streams = Streams(service.machine.publisher)
    feeds = CameraFeeds(service.devices, service.clock)
    silent = SilentConnections()
    app = create_app(Parts(service, waiting, streams, opened.rules, feeds))
    server = uvicorn.Server(_settings(app, silent))
    ending = asyncio.Event()

    def end() -> None:
        if ending.is_set():
            server.force_exit = True  # requested twice: wait for no client
        ending.set()

    def end_from_anywhere() -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended already
            loop.call_soon_threadsafe(end)

    manager = ServiceManager(os.environ if own_process else {}, loop.call_soon_threadsafe)
    service.devices.on_turn = manager.turn
    if own_process:
        for number in signals.wanted():
            loop.add_signal_handler(number, end)
        signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # a suspended daemon would watch no head under way
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    serving = asyncio.create_task(server.serve(sockets=[opened.listener]))
    while not server.started and not serving.done():
        await asyncio.sleep(0.005)
    if serving.done():  # an address that does not answer is not announced; the caller closes the service
        await serving
        raise MastctlError("the web server ended before it answered a request")
    opened.listener.listen(
        WAITING_IN_KERNEL
    )  # asyncio has one number for this and for how many it takes at once
    beside = [asyncio.create_task(_report_state(service, manager)), asyncio.create_task(silent.watch())]
    if access is not None:
        beside.append(asyncio.create_task(_reread_tokens(access, waiting, streams)))
    if own_process:
        for number, handler in handlers.items():  # uvicorn has set its own: the mast is stopped first
            signal.signal(number, handler)
        # Objects of the start stay. Each full collection of them stopped every thread for some 80 ms.
        gc.collect()
        gc.freeze()
    on_ready(end_from_anywhere)
    manager.send("READY=1")
    requested = asyncio.create_task(ending.wait())
    await asyncio.wait({serving, requested}, return_when=asyncio.FIRST_COMPLETED)
    requested.cancel()
    manager.send("STOPPING=1")
    try:
        stopped = asyncio.wrap_future(service.stop_threads.submit(service.operations.close))
    except StopsHang:
        stopped = asyncio.ensure_future(asyncio.to_thread(service.operations.close))
    waiting.end()
    log.info("ending: the mast is stopped first")
    await stopped
    await streams.end()
    feeds.close()
    server.should_exit = True
    await serving
    for task in beside:
        task.cancel()
    if own_process:
        await asyncio.to_thread(service.close)
    manager.close()


async def _reread_tokens(access: Access, waiting: Waiting, streams: Streams) -> None:
    """Read the tokens again when they change, and end the streams of those that are gone, until the end."""
    with contextlib.suppress(Unable):
        while True:
            await asyncio.sleep(REREAD_S)
            await waiting.run(access.reread)
            streams.end_revoked(access.is_valid)


async def _report_state(service: Service, manager: ServiceManager) -> None:
    """Report each change of the state to the service manager, as text."""
    with service.machine.publisher.subscribe_here("state") as changes:
        while not changes.closed:
            for change in await changes.wait():
                now = change.value
                manager.send(f"STATUS={now.state}: {now.reason}" if now.reason else f"STATUS={now.state}")


def _settings(app: ASGIApp, silent: SilentConnections) -> uvicorn.Config:
    """How uvicorn serves. Its limit of concurrent requests would refuse stops too, and is not set."""
    return uvicorn.Config(
        app,
        http=silent.protocol,  # type: ignore[arg-type]
        h11_max_incomplete_event_size=LARGEST_HEADERS_BYTES,
        backlog=ACCEPTED_AT_ONCE,
        timeout_keep_alive=IDLE_S,
        ws_max_size=LARGEST_MESSAGE_BYTES,
        ws_ping_interval=PING_S,
        ws_ping_timeout=PING_S,
        ws_per_message_deflate=False,
        lifespan="off",
        proxy_headers=False,
        server_header=False,
        access_log=False,
        log_config=None,
        log_level="critical",  # what strangers send is no error; the guard logs defects
        timeout_graceful_shutdown=GRACE_S,
    )


def _entry_rules(service: Service, url: str) -> EntryRules:
    """Return the rules for clients, by the address that the daemon listens at. Raises BadFile."""
    listen = service.config.listen
    service.bench.serve(url)
    if not listen.needs_token:
        return EntryRules(via="loopback" if listen.socket is None else "unix")
    tokens = TokenList(service.folder.path)
    access = Access(tokens)
    service.bench.serve(url, access.temporary)
    service.leases.token_is_valid = access.is_valid
    log.warning("%s requires a token, except for a stop; the tokens are in %s", url, tokens.folder)
    if listen.socket is None:
        log.warning("%s speaks plain HTTP: others can read tokens and images unless a proxy encrypts", url)
    return EntryRules(frozenset(listen.hosts), True, access, "token")


@contextlib.contextmanager
def _listening(listen: Listen) -> Iterator[tuple[socket.socket, str]]:
    """Listen; yield the socket, and the address as it is (port 0 has become a number)."""
    url, path = listen.url, listen.socket
    family = socket.AF_UNIX if path else socket.AF_INET6 if ":" in listen.host else socket.AF_INET
    # The protocol is named because asyncio switches Nagle's delay off only where it stands: 40 ms an answer.
    with socket.socket(family, socket.SOCK_STREAM, 0 if path else socket.IPPROTO_TCP) as listener:
        try:
            if path is None:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                # Inherited by each connection, which a client that reads nothing would keep for ever.
                listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * UNREAD_S))
                listener.bind((listen.host, listen.port))
                url = listen.model_copy(update={"port": listener.getsockname()[1]}).url
            else:
                with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                    if path.is_socket() and probe.connect_ex(str(path)) == errno.ECONNREFUSED:
                        path.unlink()  # a dead daemon has left it
                os.fchmod(listener.fileno(), 0o600)  # bind takes it over; a umask would be every thread's
                listener.bind(str(path))
            # Listening at once: SO_REUSEADDR lets two sockets bind as long as neither of them listens.
            listener.listen()
        except OSError as error:
            raise _no_address(url if path is None else str(path), error) from None
        try:
            yield listener, url
        finally:
            if path is not None:
                path.unlink(missing_ok=True)


def _no_address(where: str, error: OSError) -> MastctlError:
    """Why an address cannot be listened to, as one sentence."""
    if error.errno == errno.EADDRINUSE:
        return AddressInUse(
            f"{where} is in use already, perhaps by another daemon; choose another port or end it"
        )
    return MastctlError(f"cannot listen at {where}: {error.strerror or error}")
