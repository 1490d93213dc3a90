"""What survey.yaml says: board, prisms, sigmas and cameras, each value refused with its place."""

from __future__ import annotations

from typing import Any, Literal, cast

import numpy as np

from calib.camera.cahvor import Kind
from calib.files import LARGEST_IMAGE_PX
from calib.files.mast_file import CAMERA_NAME, CAMERA_NAME_WORDS
from calib.files.strict import Section
from calib.rigid import FloatArray
from calib.survey.records import (
    Board,
    Sigma,
    SurveyCamera,
)

FURTHEST_M = 1e5

BOARD_KEYS = ("rows", "columns", "spacing_m", "dot_diameter_m", "tapes_in_board_m")


def board_of(section: Section) -> Board:
    spacing_m, dot_m = _positive(section, "spacing_m"), _positive(section, "dot_diameter_m")
    if dot_m >= spacing_m:
        raise section.bad("dot_diameter_m", f"{dot_m:g} where less than spacing_m {spacing_m:g} is expected")
    return Board(
        section.integer("rows", 2, 200),
        section.integer("columns", 2, 200),
        spacing_m,
        dot_m,
        places_of(section, "tapes_in_board_m", "tape"),
    )


def _positive(section: Section, key: str) -> float:
    value = section.number(key, FURTHEST_M)
    if value <= 0:
        raise section.bad(key, f"{value:g} where a number above 0 is expected")
    return value


def places_of(section: Section, key: str, what: str) -> dict[str, FloatArray]:
    """Read at least three named points that no two share and that are not on one line."""
    names = section.mapping(key)
    for name in names:
        if not name.strip() or not name.isprintable():
            raise section.bad(key, f"{name[:40]!r} where the name of a {what} is expected")
    if len(names) < 3:
        raise section.bad(key, f"{len(names)} {what}s where at least three are expected")
    inner = section.section(key, tuple(names))
    places = {name: inner.vector(name, FURTHEST_M) for name in names}
    table = np.array(list(places.values()))
    across = np.linalg.svd(table - table.mean(axis=0), compute_uv=False)
    if across[1] < 1e-3 * max(across[0], 1e-3):
        raise section.bad(key, f"the {what}s stand on one line; no pose follows from them")
    for place in places.values():
        place.setflags(write=False)
    return places


def sigma_of(section: Section) -> Sigma:
    optional = {
        key: section.number(key, 10.0) if key in section else 0.0 for key in ("joint_rad", "prism_cad_m")
    }
    for key, value in optional.items():
        if value < 0:
            raise section.bad(key, f"{value:g} where 0 or more is expected")
    return Sigma(_positive(section, "station_m"), _positive(section, "dot_px"), **optional)


def bench_sigma_of(section: Section) -> Sigma:
    joint_rad = section.number("joint_rad", 10.0) if "joint_rad" in section else 0.0
    if joint_rad < 0:
        raise section.bad("joint_rad", f"{joint_rad:g} where 0 or more is expected")
    return Sigma(0.0, 0.0, joint_rad, corner_px=_positive(section, "corner_px"))


def cameras_of(top: Section) -> dict[str, SurveyCamera]:
    cameras: dict[str, SurveyCamera] = {}
    for name in top.mapping("cameras"):
        if not CAMERA_NAME.fullmatch(name):
            raise top.bad(f"cameras.{name}", CAMERA_NAME_WORDS)
        value: Any = top.mapping("cameras")[name]
        place = f"cameras.{name}"
        section = Section(top.path, place, value, ("on", "size_px", "model", "focal_px"), ("rough",))
        width, height = section.integers("size_px", 2, 1, LARGEST_IMAGE_PX)
        camera: dict[str, Any] = {}
        if "rough" in section:
            rough = section.section("rough", ("C", "A"))
            camera["rough_C_m"], axis = rough.vector("C", FURTHEST_M), rough.vector("A")
            length = float(np.linalg.norm(axis))
            if length < 1e-6:
                raise rough.bad("A", "is zero where a direction is expected")
            camera["rough_A"] = axis / length
        cameras[name] = SurveyCamera(
            name=name,
            on=cast(Literal["head", "rover"], section.choice("on", ("head", "rover"))),
            size_px=(width, height),
            kind=cast(Kind, section.choice("model", ("CAHV", "CAHVOR", "CAHVORE"))),
            focal_px=_positive(section, "focal_px"),
            **camera,
        )
    if not cameras:
        raise top.bad("cameras", "holds no camera; at least one is expected")
    return cameras
