"""The check of a bench before it is fitted: is all there, and does it span enough."""

from __future__ import annotations

from collections.abc import Iterator

from calib.survey.records import Finding, Survey, SurveyImage

FEWEST_CORNERS = 8
"""Of an image, for a pose that says something about the lens."""

FEWEST_PLACEMENTS = 2


def bench_findings(survey: Survey) -> Iterator[Finding]:
    """Yield what is missing of a bench: corners of images, images of cameras, placements."""
    for name in survey.cameras:
        yield from _of_camera(survey, name)
    head = [image for image in survey.images if image.pan_rad is not None and image.purpose != "check"]
    placements = {(image.setup, image.placement, image.board) for image in head if _seen(survey, image)}
    if head and len(placements) < FEWEST_PLACEMENTS:
        yield Finding(
            "warning",
            "images.csv",
            "the board stood in one place only; its distance and the lenses can trade for each other",
            "Put the board elsewhere, nearer or further and at another slant, two to four placements in all",
        )


def _of_camera(survey: Survey, name: str) -> Iterator[Finding]:
    mine = [image for image in survey.images if image.camera == name]
    if not mine:
        yield Finding(
            "error",
            f"camera {name}",
            "it has no image in images.csv",
            "Photograph a board with it, or take it out of survey.yaml",
        )
        return
    without = [image for image in mine if not _seen(survey, image)]
    lost = [image for image in without if not (survey.folder / image.file).is_file()]
    if lost:
        yield Finding(
            "error",
            f"images.csv line {lost[0].row}, camera {name}",
            f"{len(lost)} of {len(mine)} images have neither corners in corners.csv nor a picture "
            f"({_some(lost)})",
            "Put the picture there, add its corners, or take out the row",
        )
    if len(without) == len(mine):
        yield Finding(
            "error",
            f"camera {name}",
            f"none of its {len(mine)} images shows corners of a board",
            "Find the corners of its pictures, or photograph a board with it",
        )
    few = [image for image in mine if 0 < _count(survey, image) < FEWEST_CORNERS]
    if few:
        yield Finding(
            "warning",
            f"camera {name}",
            f"{len(few)} images show fewer than {FEWEST_CORNERS} corners ({_some(few)})",
            "Have more of the board in the picture",
        )


def _count(survey: Survey, image: SurveyImage) -> int:
    return len(survey.corners[image.name]) if image.name in survey.corners else 0


def _seen(survey: Survey, image: SurveyImage) -> bool:
    return _count(survey, image) > 0


def _some(images: list[SurveyImage]) -> str:
    """The first few names."""
    names = ", ".join(image.name for image in images[:4])
    return names + (f" and {len(images) - 4} more" if len(images) > 4 else "")
