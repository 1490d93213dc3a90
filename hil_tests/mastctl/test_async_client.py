"""The client for asyncio: has the questions of the one that waits, and does the same."""

from __future__ import annotations

import asyncio
import inspect
from pathlib import Path

import pytest

from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.mastctl.web.network import network_daemon
from hil_tests.waiting import NET_S, until
from mastctl.client import AsyncClient, Client, ClientError
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]


def test_both_clients_have_the_same_methods_with_the_same_parameters() -> None:
    def methods(kind: type) -> dict[str, list[str]]:
        found = inspect.getmembers(kind, inspect.isfunction)
        return {name: list(inspect.signature(one).parameters) for name, one in found if name[0] != "_"}

    assert methods(AsyncClient) == methods(Client)
    assert len(methods(Client)) > 30


def test_a_whole_visit(pair: BOTH) -> None:
    daemon, _ = pair
    publisher = daemon.service.machine.publisher
    with Client(daemon.url) as other:
        other.status()  # the daemon's own listeners are there by then
    before = publisher.listeners
    steps: list[str] = []

    async def visit() -> None:
        async with AsyncClient(daemon.url) as client:
            assert (await client.status())["state"] == "ready"
            shot = await client.snapshot("navcam_left")
            assert shot.image.shape == (48, 64)
            async with client.lease() as held:
                assert (await client.control() or {})["holder"] == held.holder
                operation = await client.point(pan_rad=0.1, tilt_rad=0.0)
                record, again = await asyncio.gather(
                    client.wait(operation, NET_S, lambda step: steps.append(step["name"])),
                    client.wait(operation, NET_S),
                )
                assert record["state"] == again["state"] == "done"
            assert await client.control() is None
            assert (await client.wait_state("ready", timeout_s=NET_S))["state"] == "ready"
            async for event in client.events("mast"):
                assert event["topic"] == "mast"
                break
            async with client.jog() as jog:
                jog.rates(0.0, 0.0)
            assert (await client.stop())["stopped"] is True

    asyncio.run(visit())
    assert steps == ["look", "measure"]
    until(lambda: publisher.listeners == before, "nobody listens any more")


def test_its_refusals_are_those_of_the_other(pair: BOTH) -> None:
    async def refused(url: str) -> ClientError:
        async with AsyncClient(url) as client:
            with pytest.raises(ClientError) as caught:
                await client.point(pan_rad=0.0, tilt_rad=1.5)
            return caught.value

    beyond = asyncio.run(refused(pair[0].url))
    assert (beyond.code, beyond.exit_code) == ("outside_limits", 2)
    assert asyncio.run(refused("http://127.0.0.1:1")).code == "no_daemon"
    with pytest.raises(ClientError, match="is no address of a daemon"):
        AsyncClient("rover")


def test_a_wait_that_takes_too_long_says_so(pair: BOTH) -> None:
    async def wait() -> None:
        async with AsyncClient(pair[0].url) as client:
            await client.wait_state("stopped", timeout_s=0.2)

    with pytest.raises(ClientError, match=r"not stopped after 0\.2 s"):
        asyncio.run(wait())


def test_a_lease_keeps_the_token_that_its_client_was_given(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("MASTCTL_TOKEN", raising=False)
    with network_daemon(monkeypatch, tmp_path) as net:
        url = f"http://127.0.0.1:{net.port}"
        with Client(url, token=net.token("operate")) as client:
            with client.lease(for_s=1.0) as held:
                until(lambda: held.lost is None, "it is held")
                assert client.control() is not None
            assert client.control() is None, "it was released, with the token"
