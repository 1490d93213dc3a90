"""Can the mast file be read, does it fit the configuration, how old is it, what did its fit say?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

from calib.errors import BadFile
from calib.files.mast_file import load_rig
from mastctl.config import Config, check_cameras
from mastctl.doctor.findings import Finding, Level

OLD_DAYS = 180


def examine_mast_file(
    config: Config, now: Callable[[], datetime] = lambda: datetime.now(UTC)
) -> Iterator[Finding]:
    """Look at the mast file of a configuration."""
    try:
        stored = load_rig(config.mast_file)
        check_cameras(config, stored.rig)
    except BadFile as error:
        yield Finding("mast file", "bad", str(error), "name another, or calibrate: mastctl calibrate")
        return
    about = f"{config.mast_file.name} ({stored.digest[:8]}...), {len(stored.rig.cameras)} cameras"
    yield Finding("mast file", "good", about)
    for note in stored.notes:
        yield Finding("mast file", "unsure", note, "see docs/reference/configuration.md")
    yield _age(stored.rig.provenance, now())
    yield _verdict(stored.rig.fit)


def _age(provenance: Mapping[str, Any], now: datetime) -> Finding:
    what, advice = "mast file's age", "calibrate again: mastctl calibrate"
    try:
        made = datetime.fromisoformat(str(provenance.get("date", "")))
        made = made if made.tzinfo else made.replace(tzinfo=UTC)
    except ValueError:
        return Finding(what, "unsure", "it does not say when it was made", advice)
    days = (now - made).days
    if days < 0:
        return Finding(
            what,
            "unsure",
            f"it was made on {made:%Y-%m-%d}, in the future",
            "look at this machine's clock, or at the one that made it",
        )
    told = f"made on {made:%Y-%m-%d}, {days} days ago"
    if days > OLD_DAYS:
        return Finding(what, "unsure", told, f"look whether residuals have grown, or {advice}")
    return Finding(what, "good", told)


def _verdict(fit: Mapping[str, Any]) -> Finding:
    what = "calibration's verdict"
    verdict = fit.get("verdict")
    words = verdict.get("words") if isinstance(verdict, Mapping) else None
    if not isinstance(words, str):
        return Finding(what, "unsure", "it does not say how well it fits", "calibrate with mastctl calibrate")
    levels: dict[object, Level] = {"good": "good", "bad": "bad"}
    level = levels.get(verdict.get("grade") if isinstance(verdict, Mapping) else None, "unsure")
    return Finding(what, level, words, "" if level == "good" else "the calibration's report says why")
