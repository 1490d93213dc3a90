"""The recorder of one daemon: what it records, where, and how news and mast files reach it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from calib.matching.handed_over import MatchedHandoff
from drivers.clock import Clock
from mastctl.answers import Recordings
from mastctl.config import Config
from mastctl.control.publisher import Publisher
from mastctl.control.standing import StandingFault
from mastctl.devices.frames import StampedFrame
from mastctl.recorder.feed import Feed
from mastctl.recorder.recorder import AttachedMast, Recorder
from mastctl.recorder.writer import Attached
from mastctl.service.masts import MastInUse
from mastctl.watch.handoffs import line_of

FOLDER = "records"


class DaemonRecorder:
    """A recorder that hears what the daemon publishes.

    Parameters
    ----------
    config
        Says how much is recorded, and is attached as it was read.
    mast
        The mast file in use.
    facts
        ``hardware``, of which kind it is (of real hardware there is a ring unless the configuration says
        otherwise), and ``version``, the program's.
    state_folder
        Where recordings lie, if the configuration names no other place.
    publisher, frame_by_id
        What is heard, and where the pictures are.
    clock
        The daemon's.

    Attributes
    ----------
    recorder
        Begins and ends runs.
    """

    def __init__(
        self,
        config: Config,
        mast: MastInUse,
        facts: dict[str, str],
        state_folder: Path,
        publisher: Publisher,
        frame_by_id: Callable[[str], StampedFrame],
        clock: Clock,
    ) -> None:
        settings = replace(config.record, ring_s=config.record.ring_of(facts["hardware"]))
        self.recorder = Recorder(
            settings,
            config.record.folder or state_folder / FOLDER,
            _told(mast),
            [Attached(config.path.name, config.data)],
            facts,
            clock,
        )
        self._hardware = facts["hardware"]
        self._feed = Feed(publisher, self.recorder, frame_by_id)

    def handed_over(self, handoff: MatchedHandoff) -> None:
        """Record a hand-off, as the record of hand-offs has it."""
        self.recorder.tell("handoff", handoff.time, line_of(handoff))

    def use_mast(self, mast: MastInUse) -> None:
        """Attach another mast file, for what comes from now on."""
        self.recorder.use_mast(_told(mast))

    def use_config(self, config: Config) -> None:
        """Keep as much as another configuration says, and attach that, from the next file on."""
        settings = replace(config.record, ring_s=config.record.ring_of(self._hardware))
        self.recorder.use_settings(settings, [Attached(config.path.name, config.data)])

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what keeps it from recording."""
        return self.recorder.faults()

    def told(self) -> Recordings:
        """Return every recording, and what is recorded now, as ``GET /recordings`` has it. Raises Unable."""
        return {
            "recordings": self.recorder.recordings(),
            "recorder": self.recorder.told(),
            "free_mb": self.recorder.free_mb(),
        }

    def close(self) -> None:
        """Hear nothing more and end the file; bounded."""
        self._feed.close()
        self.recorder.close()


def _told(mast: MastInUse) -> AttachedMast:
    return AttachedMast(mast.stored.rig, Attached(mast.path.name, mast.data))
