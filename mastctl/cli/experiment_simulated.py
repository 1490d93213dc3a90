"""The pointing and hand-off experiments on simulated rovers of their own: a fresh one for each task.

A task's rover, its daemon and its draw begin anew, and time passes only on demand, so that a target comes to
the same to the last bit whatever was done before it, here or elsewhere.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.sim.rover import SimulatedRover
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.demo import SimulationTruth, demo_config, head_note
from mastctl.experiment.handoff import run_handoff_experiment
from mastctl.experiment.handoff_record import HandoffExperiment, summarise_handoffs
from mastctl.experiment.known_points import BrickPoints
from mastctl.experiment.pointing import head_pair, run_pointing_experiment
from mastctl.experiment.pointing_record import PointingExperiment, summarise_distance


@dataclass(frozen=True)
class Rover:
    """The packaged simulated rover; ``mast_file`` is what another mast file than the packaged one holds."""

    head: str
    seed: int
    bricks: int = 0
    mast_file: bytes | None = None


@dataclass(frozen=True)
class PointingTask:
    """One target of the pointing experiment."""

    rover: Rover
    distance_m: float
    index: int
    pictures: bool = False


@dataclass(frozen=True)
class HandoffTask:
    """One target of a hand-off from a pair; with bricks, all of them, ``targets`` at most."""

    rover: Rover
    source: str
    index: int
    click_px: float
    targets: int = 1
    pictures: int = 0


@contextmanager
def _running(rover: Rover) -> Iterator[tuple[RunningDaemon, Client, SimulatedRover]]:
    """The rover behind a daemon of its own."""
    config = demo_config(load_config(None), head=rover.head, seed=rover.seed, bricks=rover.bricks)
    with tempfile.TemporaryDirectory() as folder:
        if rover.mast_file is not None:
            config = replace(config, mast_file=Path(folder) / "mast.yaml")
            config.mast_file.write_bytes(rover.mast_file)
        with RunningDaemon(config) as daemon, Client(daemon.url) as client:
            assert daemon.hardware.simulation is not None  # the packaged configuration is a simulated rover
            yield daemon, client, daemon.hardware.simulation


def one_pointing(task: PointingTask) -> PointingExperiment:
    """Point at one target, on a rover of its own."""
    with _running(task.rover) as (daemon, client, rover):
        rig = daemon.service.stored.rig
        camera = head_pair(rig, set(client.status()["cameras"]))[0]
        return run_pointing_experiment(
            client,
            targets=1,
            distances_m=(task.distance_m,),
            seed=task.rover.seed,
            truth=SimulationTruth(rover),
            notes=(head_note(rover, rig, camera),),
            pictures=int(task.pictures),
            first=task.index,
        )


def joined_pointings(parts: Sequence[PointingExperiment]) -> PointingExperiment:
    """Return one experiment of many with a target each; its time is that of all targets one after another."""
    records = [record for part in parts for record in part.records]
    seconds = dict.fromkeys(dict.fromkeys(record.distance_m for record in records), 0.0)
    for part in parts:
        seconds[part.records[0].distance_m] += part.seconds
    summaries = [
        summarise_distance(distance, [r for r in records if r.distance_m == distance], spent)
        for distance, spent in seconds.items()
    ]
    return replace(
        parts[0], records=tuple(records), summaries=tuple(summaries), seconds=sum(seconds.values())
    )


def one_handoff(task: HandoffTask) -> HandoffExperiment:
    """Hand over one target, or all bricks of a step, on a rover of its own."""
    with _running(task.rover) as (_, client, rover):
        return run_handoff_experiment(
            client,
            targets=task.targets,
            seed=task.rover.seed,
            click_px=task.click_px,
            truth=SimulationTruth(rover),
            points=BrickPoints(rover) if task.rover.bricks else None,
            pictures=task.pictures,
            first=task.index,
            chosen=(task.source,),
        )


def joined_handoffs(parts: Sequence[HandoffExperiment]) -> HandoffExperiment:
    """Return one experiment of many; its time is that of all targets one after another."""
    records = [record for part in parts for record in part.records]
    cameras = dict.fromkeys((row.step, row.camera) for part in parts for row in part.summaries)
    kinds = dict.fromkeys(record.kind for record in records)
    summaries = [
        summarise_handoffs(step, kind, camera, records)
        for step in dict.fromkeys(step for step, _ in cameras)
        for kind in kinds
        for of_step, camera in cameras
        if of_step == step
    ]
    return replace(
        parts[0],
        records=tuple(records),
        summaries=tuple(summaries),
        seconds=sum(part.seconds for part in parts),
    )
