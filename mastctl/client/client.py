"""The two clients of a running daemon: one whose caller waits, and one for asyncio."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator
from contextlib import AbstractAsyncContextManager, AbstractContextManager
from functools import update_wrapper
from types import MethodType, TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, TypeVar, cast, overload

from mastctl.client.calls import Calls
from mastctl.client.connection import AsyncDaemonHttp, DaemonHttp, finished, iterated
from mastctl.client.jog import Jog

if TYPE_CHECKING:
    from mastctl.client.pictures import LivePictures

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")
DEFAULT_URL = "http://127.0.0.1:8420"


class waits(Generic[P, R]):
    """A question of `Calls` as a method of `Client`: the calling thread waits where asyncio would go on.

    A coroutine becomes a function, what yields asynchronously an iterator, and so with a context manager.
    """

    def __init__(self, call: Callable[Concatenate[Calls, P], R]) -> None:
        def asked(client: Client, *args: P.args, **options: P.kwargs) -> Any:
            work = call(client._calls, *args, **options)
            if isinstance(work, AsyncGenerator):
                return iterated(work)
            if isinstance(work, AbstractAsyncContextManager):
                return _Held(work)
            return finished(cast(Coroutine[Any, Any, Any], work))

        self._asked = update_wrapper(asked, call)

    @overload
    def __get__(
        self: waits[P, Coroutine[Any, Any, T]], client: Client | None, owner: object = None
    ) -> Callable[P, T]: ...
    @overload
    def __get__(
        self: waits[P, AsyncGenerator[T]], client: Client | None, owner: object = None
    ) -> Callable[P, Iterator[T]]: ...
    @overload
    def __get__(
        self: waits[P, AbstractAsyncContextManager[T]], client: Client | None, owner: object = None
    ) -> Callable[P, AbstractContextManager[T]]: ...
    def __get__(self, client: Client | None, owner: object = None) -> Any:
        return self._asked if client is None else MethodType(self._asked, client)


class _Held(AbstractContextManager[T]):
    """A context manager that waits where an asynchronous one would."""

    def __init__(self, held: AbstractAsyncContextManager[T]) -> None:
        self._held = held

    def __enter__(self) -> T:
        return finished(self._held.__aenter__())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return finished(self._held.__aexit__(kind, error, trace))


class Client:
    """A connection to one daemon. A context manager; usable from one thread at a time.

    Parameters
    ----------
    url
        ``http://127.0.0.1:8420``, or ``unix:/path/of/socket``.
    timeout_s
        Longest time of each request, seconds.
    name
        The name of this program, for the daemon's record and for other clients that want to steer; by default
        ``program@host:pid``. Clients of one name are one party.
    token
        The token that a daemon expects from other machines; by default that of ``$MASTCTL_TOKEN``. Others
        can read it on the way without TLS. The file ``$MASTCTL_CA_FILE`` may name further certificates.

    Where the connection breaks, the client sends a command again; its key lets the daemon execute it once.

    Raises
    ------
    ClientError
        ``bad_url``, if the address is of neither form. Every method raises it for whatever goes wrong.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        timeout_s: float = 30.0,
        name: str | None = None,
        token: str | None = None,
    ) -> None:
        self.url = url
        self._calls = Calls(DaemonHttp(url, timeout_s, name, token))

    lease = waits(Calls.lease)
    control = waits(Calls.control)
    acquire_lease = waits(Calls.acquire_lease)
    renew_lease = waits(Calls.renew_lease)
    release_lease = waits(Calls.release_lease)
    status = waits(Calls.status)
    point = waits(Calls.point)
    preview = waits(Calls.preview)
    operation = waits(Calls.operation)
    operations = waits(Calls.operations)
    wait = waits(Calls.wait)
    wait_state = waits(Calls.wait_state)
    events = waits(Calls.events)
    stop = waits(Calls.stop)
    estop = waits(Calls.estop)
    reset = waits(Calls.reset)
    pose = waits(Calls.pose)
    track = waits(Calls.track)
    start_track = waits(Calls.start_track)
    look = waits(Calls.look)
    wait_track = waits(Calls.wait_track)
    watch_track = waits(Calls.watch_track)
    stop_track = waits(Calls.stop_track)
    snapshot = waits(Calls.snapshot)

    reload = waits(Calls.reload)
    calibration_health = waits(Calls.calibration_health)
    sentinel = waits(Calls.sentinel)
    rig = waits(Calls.rig)
    camera_settings = waits(Calls.camera_settings)
    set_camera = waits(Calls.set_camera)
    bench = waits(Calls.bench)
    begin_bench = waits(Calls.begin_bench)
    board_stands = waits(Calls.board_stands)
    leave_bench = waits(Calls.leave_bench)
    forget_bench = waits(Calls.forget_bench)
    reports = waits(Calls.reports)
    report = waits(Calls.report)
    history = waits(Calls.history)
    recordings = waits(Calls.recordings)
    start_recording = waits(Calls.start_recording)
    stop_recording = waits(Calls.stop_recording)
    recording = waits(Calls.recording)
    delete_recording = waits(Calls.delete_recording)
    mast_file = waits(Calls.mast_file)
    use_mast = waits(Calls.use_mast)
    use_former_mast = waits(Calls.use_former_mast)
    places = waits(Calls.places)
    keep_place = waits(Calls.keep_place)
    forget_place = waits(Calls.forget_place)
    sun = waits(Calls.sun)
    keep_off_sun = waits(Calls.keep_off_sun)
    forget_sun = waits(Calls.forget_sun)
    session = waits(Calls.session)
    login = waits(Calls.login)
    logout = waits(Calls.logout)

    true_pose = waits(Calls.true_pose)
    stand = waits(Calls.stand)
    boards = waits(Calls.boards)
    put_board = waits(Calls.put_board)
    take_board = waits(Calls.take_board)
    simulation_time = waits(Calls.simulation_time)
    advance = waits(Calls.advance)
    truth = waits(Calls.truth)
    fault_words = waits(Calls.fault_words)
    faults = waits(Calls.faults)
    set_fault = waits(Calls.set_fault)
    clear_faults = waits(Calls.clear_faults)

    def use_lease(self, lease_id: str | None) -> None:
        """Have each command carry a lease from now on, or none."""
        self._calls.use_lease(lease_id)

    def jog(self) -> Jog:
        """Return a context in which the head turns at rates; it sends the heartbeats itself.

        Examples
        --------
        ::

            with client.jog() as jog:
                jog.rates(0.2, 0.0)      # rad/s
                time.sleep(1.5)
        """
        return self._calls.jog()

    def live_pictures(self, *cameras: str) -> AbstractContextManager[LivePictures]:
        """Return a context in which pictures of some cameras come, as JPEG at the cameras' own rate.

        Examples
        --------
        ::

            with client.live_pictures("navcam_left") as pictures:
                pictures.wanted("navcam_left")
                picture = pictures.next(timeout_s=1.0)     # facts, jpeg; None if there was none
        """
        return self._calls.live_pictures(*cameras)

    close = waits(Calls.close)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *ignored: object) -> None:
        self.close()


class AsyncClient(Calls):
    """A connection to one daemon for asyncio; parameters, methods and errors as `Client` has them."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        timeout_s: float = 30.0,
        name: str | None = None,
        token: str | None = None,
    ) -> None:
        self.url = url
        super().__init__(AsyncDaemonHttp(url, timeout_s, name, token))

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *ignored: object) -> None:
        await self.close()
