"""Tasks of a moment, in a module that every process finds by one name."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Draw:
    """So many numbers of a generator."""

    seed: int
    count: int = 3
    scale: Any = 1.0


def drawn(task: Draw) -> np.ndarray:
    """Numbers, after a while that is another each time."""
    time.sleep(random.random() * 0.02)
    return np.random.default_rng(task.seed).standard_normal(task.count) * task.scale


def broken_when_odd(task: Draw) -> int:
    if task.seed % 2:
        raise ZeroDivisionError("no such luck")
    return task.seed


def drawn_or_stuck(task: Draw) -> int:
    if task.scale > 1:
        time.sleep(600)
    return task.seed
