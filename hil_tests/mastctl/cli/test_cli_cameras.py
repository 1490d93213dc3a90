"""camera check and focus on a machine without the named camera, and the quality of a picture."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage

from mastctl.cli.main import main
from mastctl.conform.device_checks import quality_of, sharpness
from mastctl.report.pictures import with_text

PICTURE = np.random.default_rng(2).integers(0, 256, (48, 64), dtype=np.uint8)
TEXTS = {"time_utc": "2026-01-02T03:04:05.678+00:00", "pan_rad": "0.1", "name": "mât, 日本"}


def test_another_reader_finds_the_texts_and_the_picture() -> None:
    png = bytes(cv2.imencode(".png", PICTURE)[1])
    with PillowImage.open(io.BytesIO(with_text(png, TEXTS))) as opened:
        opened.load()
        assert opened.text == TEXTS  # type: ignore[attr-defined]
        assert np.array_equal(np.asarray(opened), PICTURE)


def test_the_quality_of_a_picture_is_plain_arithmetic() -> None:
    quality = quality_of(PICTURE)
    assert quality["mean"] == pytest.approx(PICTURE.mean())
    assert quality["saturated_share"] == pytest.approx((PICTURE >= 250).mean())
    assert quality["dark_share"] == pytest.approx((PICTURE <= 5).mean())
    assert sharpness(PICTURE) > 10 * sharpness(np.asarray(cv2.GaussianBlur(PICTURE, (9, 9), 3)))


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = main(words)
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and captured.err.startswith("mastctl: ")
    return code, captured.err


def test_a_camera_that_is_not_there_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    code, words = refused(["camera", "check", "/dev/v4l/by-id/none"], capsys)
    assert code == 1 and "there is no /dev/v4l/by-id/none; is the camera connected?" in words
    code, words = refused(["camera", "focus", "No such card"], capsys)
    assert code == 1 and "no camera of this card or bus is connected" in words


def test_what_is_no_camera_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    code, words = refused(["camera", "check", "/dev/null"], capsys)
    assert code == 2 and "/dev/null is no video device" in words
