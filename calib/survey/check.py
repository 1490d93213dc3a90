"""The check of a survey before it is fitted: is all there, does it span enough, does it agree with itself.

Nothing here is fitted beyond rigid alignments, so it takes well under a second. The tests of the fit judge
each single image, tape and dot again, and finer.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calib.files.yaml_text import nearest
from calib.geometry.rigid import FloatArray
from calib.survey.diagnoses import (
    joint_mixups,
    mixups,
    sights,
    wrong_dots,
    wrong_grid,
    wrong_points,
    wrong_units,
)
from calib.survey.records import Survey, SurveyCamera, SurveyFinding, SurveyImage

FEWEST_BOARDS, ENOUGH_BOARDS = 3, 5
"""For a camera, and for the mast; the paper finds 5 to 8 positions adequate."""


def check_survey(survey: Survey, *, only_camera_images: bool = False) -> tuple[SurveyFinding, ...]:
    """Return what is missing, too little, or at odds with itself in a survey; errors first.

    Pictures are looked for in the survey's folder. With ``only_camera_images`` cameras will be fitted to
    images of purpose camera alone, as the paper does.
    """
    purposes = ("camera",) if only_camera_images else ("camera", "mast")
    angles = list(_angles(survey))
    findings = [*_of_cameras(survey), *angles]
    if survey.boards:
        findings += _bench_placements(survey)
        return tuple(sorted(findings, key=lambda finding: finding.severity))
    units = list(wrong_units(survey))
    findings += [*_set_ups(survey), *_placements(survey), *units, *wrong_grid(survey), *wrong_dots(survey)]
    if not units:
        findings += wrong_points(survey)
    if not units and not angles:
        findings += list(joint_mixups(survey)) or mixups(survey)
    for name, seen in sights(survey).items():
        fitted = [i for i in survey.images if i.camera == name and i.purpose in purposes]
        if any(image.camera == name for image in survey.images):
            at = {(s.image.setup, s.image.placement): s.range_m for s in seen if s.image in fitted}
            findings += _camera_spread(survey, name, purposes, fitted, [] if units else list(at.values()))
    if not angles:
        findings += _mast_spread(survey)
    if survey.images and not any(image.purpose == "check" for image in survey.images):
        findings.append(
            SurveyFinding(
                "warning",
                "images.csv",
                "there is no image of purpose check, so nothing independent shows how good the result is",
                "Photograph two to four more placements and mark those images check; they are never fitted",
            )
        )
    return tuple(sorted(findings, key=lambda finding: finding.severity))


def _of_cameras(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield cameras without images, and images without dots or corners and picture, or with few of them."""
    # With fewer an image's pose says little about the lens.
    what, fewest = ("corners", 8) if survey.boards else ("dots", 20)
    counts = {name: len(found) for name, found in (survey.corners or survey.dots).items()}
    clicked = {click.image for click in survey.clicks}
    for name in survey.cameras:
        mine = [image for image in survey.images if image.camera == name]
        if not mine:
            yield SurveyFinding(
                "error",
                f"camera {name}",
                "it has no image in images.csv",
                "Photograph five to eight placements with it, or take it out of survey.yaml",
            )
            continue
        without = [
            i for i in mine if not counts.get(i.name) and not (i.purpose == "check" and i.name in clicked)
        ]
        lost = [image for image in without if not (survey.folder / image.file).is_file()]
        if lost:
            first = lost[0]
            missing = (
                f"the file {first.file.as_posix()} is missing" if first.file.name else "no file is named"
            )
            yield SurveyFinding(
                "error",
                f"images.csv line {first.row}, camera {name}",
                f"{len(lost)} of {len(mine)} images have neither {what} in {what}.csv nor a picture "
                f"({_some(lost)}): {missing}",
                f"Put the picture there, add its {what}, or take out the row",
            )
        if survey.boards and len(without) == len(mine):
            yield SurveyFinding(
                "error",
                f"camera {name}",
                f"none of its {len(mine)} images shows corners of a board",
                "Find the corners of its pictures, or photograph a board with it",
            )
        few = [image for image in mine if 0 < counts.get(image.name, 0) < fewest]
        if few:
            yield SurveyFinding(
                "warning",
                f"camera {name}",
                f"{len(few)} of {len(mine)} images have fewer than {fewest} {what} ({_some(few)})",
                "Find more of them, or photograph these placements again with more of the board",
            )


def _bench_placements(survey: Survey) -> Iterator[SurveyFinding]:
    head = [image for image in survey.images if image.pan_rad is not None and image.purpose != "check"]
    placements = {(i.setup, i.placement, i.board) for i in head if len(survey.corners.get(i.name, ()))}
    if head and len(placements) < 2:
        yield SurveyFinding(
            "warning",
            "images.csv",
            "the board stood in one place only; its distance and the lenses can trade for each other",
            "Put the board elsewhere, nearer or further and at another slant, two to four placements in all",
        )


def _set_ups(survey: Survey) -> Iterator[SurveyFinding]:
    """Set-ups with too few prisms."""
    measured = survey.measured("prism")
    for setup in dict.fromkeys(image.setup for image in survey.images):
        prisms = list(measured.get((setup, ""), ()))
        if len(prisms) < 3:
            yield SurveyFinding(
                "error",
                f"set-up {setup}",
                f"{len(prisms)} prisms are measured ({', '.join(prisms) or 'none'}) where three are needed",
                "Measure at least three prisms, better four, from this standing of the station",
            )
        elif len(prisms) == 3:
            yield SurveyFinding(
                "warning",
                f"set-up {setup}",
                f"only three prisms are measured ({', '.join(prisms)}), so none can be left out if it is off",
                "Measure a fourth prism",
            )


def _placements(survey: Survey) -> Iterator[SurveyFinding]:
    """Images of placements not measured; placements with too few tapes."""
    tapes = survey.measured("tape")
    for image in survey.images:
        at = image.setup, image.placement
        if image.placement and at not in tapes:
            there = [placement for setup, placement in tapes if setup == image.setup]
            hint = f"; {nearest(image.placement, there)}" if there else ""
            yield SurveyFinding(
                "error",
                f"images.csv line {image.row}, image {image.name}",
                f"placement {image.placement} has no tapes in set-up {image.setup} of station.csv{hint}",
                "Correct the name, or measure the tapes of this placement",
            )
    for (setup, placement), names in tapes.items():
        place = f"set-up {setup}, placement {placement}"
        if len(names) < 3:
            yield SurveyFinding(
                "error",
                place,
                f"{len(names)} of three tapes are measured ({', '.join(names)})",
                "Measure the missing tapes, or take out the placement and its images",
            )


def _angles(survey: Survey) -> Iterator[SurveyFinding]:
    """Joint angles that no head has; many of them are degrees."""
    for joint, most in (("pan", np.pi), ("tilt", np.pi / 2)):
        angles = [(getattr(i, f"{joint}_rad"), i) for i in survey.images if i.pan_rad is not None]
        off = [(angle, image) for angle, image in angles if not abs(angle) <= most]
        if not off:
            continue
        worst, image = max(off, key=lambda entry: abs(entry[0]))
        advice = "Correct the angle"
        if abs(worst) > np.pi:
            advice = (
                f"If the angles are in degrees, write radians: {worst:g} degrees are "
                f"{np.radians(worst):.4f} rad, one radian is 57.3 degrees"
            )
        yield SurveyFinding(
            "error",
            f"images.csv line {image.row}, {joint}_rad",
            f"{joint} of {len(off)} of {len(angles)} images is outside {-most:.2f} to {most:.2f} rad, "
            f"the furthest {worst:g} (image {image.name})",
            advice,
        )


def _camera_spread(
    survey: Survey,
    name: str,
    purposes: Sequence[str],
    fitted: Sequence[SurveyImage],
    ranges_m: Sequence[float],
) -> Iterator[SurveyFinding]:
    """Yield too few boards, at one distance, or in one part of the picture."""
    count = len({(image.setup, image.placement) for image in fitted})
    if count < ENOUGH_BOARDS:
        of_purpose = "" if len(purposes) > 1 else f" of purpose {purposes[0]}"
        yield SurveyFinding(
            "error" if count < FEWEST_BOARDS else "warning",
            f"camera {name}",
            f"{count} placements{of_purpose} are there to fit it; {FEWEST_BOARDS} are the least and "
            f"{ENOUGH_BOARDS} to 8 adequate",
            "Photograph more placements, near and far, towards all corners of the picture",
        )
    if len(ranges_m) > 1 and max(ranges_m) < 1.3 * min(ranges_m):
        yield SurveyFinding(
            "warning",
            f"camera {name}",
            f"all its boards stand between {min(ranges_m):.1f} and {max(ranges_m):.1f} m, so focal length "
            "and place of the camera can trade for each other",
            f"Photograph boards at about {min(ranges_m) / 2:.1f} m or {2 * max(ranges_m):.0f} m as well",
        )
    pixels = [survey.dots[image.name].pixels_px for image in fitted if image.name in survey.dots]
    if pixels:
        yield from _area(survey.cameras[name], np.concatenate(pixels))


def _area(camera: SurveyCamera, pixels_px: FloatArray) -> Iterator[SurveyFinding]:
    """Say where in the picture there are no dots, if that is much of it: a fit's tests see nothing there."""
    cells = np.clip(((pixels_px + 0.5) / np.array(camera.size_px) * (4, 3)).astype(int), 0, (3, 2))
    reached = np.zeros((3, 4), dtype=bool)
    reached[cells[:, 1], cells[:, 0]] = True
    if reached.mean() >= 0.6:
        return
    sides = {
        "left": reached[:, :2].mean(),
        "right": reached[:, 2:].mean(),
        "upper": reached[0].mean(),
        "lower": reached[2].mean(),
    }
    emptiest = min(sides, key=sides.__getitem__)
    (left, top), (right, bottom) = pixels_px.min(axis=0), pixels_px.max(axis=0)
    yield SurveyFinding(
        "warning",
        f"camera {camera.name}",
        f"its dots reach {100 * reached.mean():.0f} % of the picture (x {left:.0f} to {right:.0f}, "
        f"y {top:.0f} to {bottom:.0f} of {camera.size_px[0]}x{camera.size_px[1]} px); "
        "the lens is not measured elsewhere",
        f"Photograph boards in the {emptiest} part of the picture",
    )


def _mast_spread(survey: Survey) -> Iterator[SurveyFinding]:
    """Too little turning of the head."""
    head = [i for i in survey.images if i.pan_rad is not None and i.purpose != "check"]
    if not head:
        return
    joints = np.array([(i.pan_rad, i.tilt_rad) for i in head])
    pan_rad, tilt_rad = np.ptp(joints, axis=0)
    if max(pan_rad, tilt_rad) < 0.02:
        yield SurveyFinding(
            "error",
            "the mast",
            f"the head did not move: pan changes by {pan_rad:.3f} rad and tilt by {tilt_rad:.3f} rad",
            "Turn the head to five to eight boards over the range of pan and tilt, with purpose mast",
        )
        return
    for joint, wanted, column in (("pan", 0.5, joints[:, 0]), ("tilt", 0.2, joints[:, 1])):
        if (found := float(np.ptp(column))) < wanted:
            yield SurveyFinding(
                "warning",
                "the mast",
                f"{joint} goes from {column.min():.2f} to {column.max():.2f} rad only, {found:.2f} rad where "
                f"{wanted:g} are wanted, which leaves parts of the mast unknown",
                f"Photograph boards at other angles of {joint}, best over the whole range of use",
            )
    boards = {(image.setup, image.placement) for image in head if image.purpose == "mast"}
    if len(boards) < ENOUGH_BOARDS:
        yield SurveyFinding(
            "warning",
            "the mast",
            f"{len(boards)} placements of purpose mast; {ENOUGH_BOARDS} to 8 are adequate",
            "Photograph more placements over the range of pan and tilt",
        )


def _some(images: Sequence[SurveyImage]) -> str:
    """The first few names."""
    names = ", ".join(image.name for image in images[:4])
    return names + (f" and {len(images) - 4} more" if len(images) > 4 else "")
