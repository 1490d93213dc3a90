"""Dots of the images that dots.csv does not name, found in their files by one process for each processor."""

from __future__ import annotations

import os
import threading
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from pathlib import Path

import cv2

from calib.survey.find_dots import Progress, detect_survey
from calib.survey.records import Survey
from mastctl.errors import MastctlError


class SearchCutShort(MastctlError):
    """A process that searched pictures for dots was ended from outside."""

    code = "search_cut_short"


def missing(survey: Survey) -> tuple[str, ...]:
    """Return the names of images with a file whose dots are not known."""
    return tuple(
        image.name for image in survey.images if image.name not in survey.dots and image.file != Path()
    )


def with_dots(
    survey: Survey, progress: Progress | None = None, executor: Executor | None = None
) -> tuple[Survey, tuple[tuple[str, str], ...]]:
    """Return the survey with the dots of every image that shows them, and (image, reason) of the others.

    ``progress`` is called after each image: how many are done, of how many, and its name. Images are searched
    by ``executor``; by default one process for each processor.

    Raises
    ------
    SearchCutShort
        If such a process ends before its work does.
    """
    clicked = {click.image for click in survey.clicks}  # a picture of a check point need not show a board
    if executor is not None:
        found = detect_survey(survey, executor, progress)
    else:
        workers = max(1, min(len(missing(survey)), os.cpu_count() or 1))
        # Started afresh: a progress bar's thread runs here already, which a fork would copy half.
        with ProcessPoolExecutor(workers, get_context("spawn"), _worker) as pool:
            try:
                found = detect_survey(survey, pool, progress)
            except BrokenProcessPool:
                raise SearchCutShort(
                    "a process that searched the pictures for dots was ended from outside, as happens where "
                    "memory runs out; nothing is written: close other programs and try again"
                ) from None
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    failures = [(name, reason) for name, reason in found.failures.items() if name not in clicked]
    return replace(survey, dots=found.dots), tuple(failures)


def _worker() -> None:
    """One process a processor is enough; and none outlives a command that was killed."""
    cv2.setNumThreads(1)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
