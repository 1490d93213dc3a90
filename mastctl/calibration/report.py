"""What a calibration leaves to read: one self-contained HTML page that says whether to trust it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.files.atomic import save_bytes
from calib.files.mast_file import StoredRig
from calib.fit.calibration import HELD_FIXED, Calibration
from calib.survey import Survey
from mastctl.calibration.maps import change_map, uncertainty_map
from mastctl.calibration.verdict import POINTING_RANGE_M, Verdict
from mastctl.report import html

NO_PLOTS = "No pictures: matplotlib is not installed (pip install 'mastctl[report]')."
WORST_IMAGES = 12


@dataclass(frozen=True, eq=False)
class Told:
    """All that the page is made of.

    ``warnings`` are the check's sentences, ``undetected`` (image, reason) of images without dots, ``in_use``
    the mast file to compare with, ``saved`` the new one.
    """

    survey: Survey
    calibration: Calibration
    verdict: Verdict
    warnings: Sequence[str]
    undetected: Sequence[tuple[str, str]]
    in_use: StoredRig | None
    saved: StoredRig


def write_report(told: Told, folder: Path) -> Path:
    """Write calibration.html into ``folder`` (made if need be) in one step and return it.

    A report that was there is kept as calibration.previous.html.

    Raises
    ------
    OSError, BadFile
        If it cannot be written; then the file is as it was.
    """
    page = html.page("Mast calibration", _parts(told)).encode()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "calibration.html"
    save_bytes(path, page)
    return path


def mast_rows(calibration: Calibration) -> list[list[str]]:
    """Return the mast's parameters with their sigmas, one row each: name, value, sigma."""
    mast, sigma = calibration.rig.mast, calibration.sigma["mast"]
    rows = []
    for key, unit, word in (("translation_m", "m", "t"), ("rotation_rad", "rad", "θ")):
        for index, axis in enumerate("xyz"):
            value, spread = getattr(mast, key)[index], sigma[key][index]
            rows.append([f"{word}{axis}", f"{value:+.5f} {unit}", _spread(spread, unit)])
    if calibration.mast_parameters == 8:
        for key, unit in (("axis_offset_m", "m"), ("axis_twist_rad", "rad")):
            rows.append([key, f"{getattr(mast, key):+.5f} {unit}", _spread(sigma[key], unit)])
    return rows


def camera_rows(calibration: Calibration) -> list[list[str]]:
    """Return per camera: images, dots, rms of the fit x and y, rms of check images x and y."""
    rows = []
    for name in calibration.rig.cameras:
        mine = [i for i in calibration.images if i.camera == name and i.purpose != "check" and i.used.any()]
        checks = [i for i in calibration.images if i.camera == name and i.purpose == "check"]
        fitted, check = calibration.rms_px.get(name), calibration.check_rms_px.get(name)
        rows.append(
            [
                name,
                f"{len(mine)}",
                f"{sum(int(i.used.sum()) for i in mine)}",
                _pair(fitted),
                f"{len(checks)}",
                _pair(check),
            ]
        )
    return rows


CAMERA_HEADINGS = ("camera", "images", "dots", "rms x, y px", "checks", "check rms x, y px")


def _spread(sigma: float, unit: str) -> str:
    if sigma == 0.0:
        return "not fitted"
    return f"± {1000 * sigma:.2f} m{unit}"


def _pair(value: tuple[float, float] | None) -> str:
    return "" if value is None else f"{value[0]:.3f}, {value[1]:.3f}"


def _parts(told: Told) -> Iterator[str]:
    calibration, survey, verdict = told.calibration, told.survey, told.verdict
    yield f"<h1>Mast calibration {html.badge(verdict.words.upper(), verdict.grade)}</h1>"
    facts = [
        ("survey", survey.folder.resolve().name),
        ("digest", survey.digest[:12]),
        ("method", f"{calibration.method}, {calibration.mast_parameters} mast parameters"),
        ("mast file", f"{told.saved.path.name} ({told.saved.digest[:12]})"),
        ("fitted in", f"{calibration.seconds:.1f} s"),
        (
            "made",
            f"{_when(told.saved)} by {told.saved.rig.provenance.get('program')}",
        ),
    ]
    yield "<p>" + " · ".join(f"{k} <b>{html.escape(v)}</b>" for k, v in facts) + "</p>"
    yield "<h2>Verdict and reasons</h2>"
    grades = {"good": "good", "care": "care", "bad": "bad"}
    rows = "".join(
        f'<tr><td style="font-size:1.4em">{html.badge(grades[r.grade], r.grade)}</td>'
        f"<td>{html.escape(r.sentence)}</td></tr>"
        for r in verdict.reasons
    )
    yield f"<table>{rows}</table>"
    yield "<h2>Mast</h2>"
    yield html.table(["parameter", "value", "sigma"], mast_rows(calibration))
    yield "<h2>Cameras</h2>"
    yield html.table(CAMERA_HEADINGS, camera_rows(calibration))
    yield (
        "<p>Check images were not fitted. Their boards stand where tapes and prisms put them, so errors of "
        "the total station show in them: 1 mm at 5 m is 0.7 px of a 16 mm lens.</p>"
    )
    yield from _words("Notes of the fit", calibration.notes)
    yield from _words("Held fixed, since no survey can tell it", HELD_FIXED)
    yield from _words("Warnings of the survey's check", told.warnings)
    yield from _words(
        f"Left out ({len(calibration.outliers)})", [outlier.sentence for outlier in calibration.outliers]
    )
    yield from _words("Images without dots", [f"{name}: {reason}" for name, reason in told.undetected])
    try:
        yield from _pictures(told)
    except ImportError:
        yield f"<p>{NO_PLOTS}</p>"
    yield "<h2>Tapes and prisms</h2>"
    yield _station_table(calibration)
    yield "<h2>Images with the largest residuals</h2>"
    yield _worst_images(calibration)


def _when(saved: StoredRig) -> str:
    """The date of the mast file as a person writes it."""
    date = str(saved.rig.provenance.get("date", ""))
    return date.replace("T", " ").replace("+00:00", " UTC")


def _words(title: str, sentences: Sequence[str]) -> Iterator[str]:
    if sentences:
        yield f"<h2>{html.escape(title)}</h2>" + html.bullets(sentences)


def _pictures(told: Told) -> Iterator[str]:
    """Every plot; ImportError before the first where matplotlib is missing."""
    import matplotlib.figure  # noqa: F401  so that nothing is begun that cannot be ended

    from mastctl.calibration import plots

    calibration = told.calibration
    yield "<h2>Residuals over the image (predicted less measured)</h2>"
    for name in calibration.rig.cameras:
        picture = html.plot_tag(plots.residuals(calibration, name), f"residuals of {name}")
        yield html.figure(picture, _mean(told, name))
    yield "<h2>Where the boards stood</h2>"
    yield html.plot_tag(plots.boards(calibration, told.survey.board), "boards in plan and side view")
    yield (
        "<p>In the rover frame, so boards that the rover saw while it was tilted back stand low. "
        "Boards for the mast and for checks are named where there is room.</p>"
    )
    yield "<h2>Error by distance and angle</h2>"
    yield html.plot_tag(plots.errors_by(calibration), "rms of images over range, angle, pan and tilt")
    yield "<p>Circles: fitted images. Triangles: check images.</p>"
    yield "<h2>Correlation of parameters</h2>"
    mast = calibration.part("mast.")
    names = calibration.parameter_names
    tags: list[str] = []
    if len(mast):
        mine = calibration.covariance[np.ix_(mast, mast)]
        one = plots.correlation([names[i] for i in mast], mine, "mast")
        tags.append(html.figure(html.plot_tag(one, "correlation of mast parameters"), "Mast parameters."))
    every = plots.correlation(names, calibration.covariance, "mast and cameras")
    caption = "All parameters. What the prisms leave open turns mast and cameras together."
    tags.append(html.figure(html.plot_tag(every, "correlation of all parameters"), caption))
    yield '<div class="row pairs">' + "".join(tags) + "</div>"
    pairs = [p for p, c in calibration.rig.stereo.items() if calibration.rig.cameras[c[0]].on == "head"]
    if pairs:
        yield "<h2>Predicted uncertainty of pointing</h2>"
        yield (
            "<p>One sigma an axis from the calibration alone. Clicked: found by stereo and pointed at with "
            "the same rig, so what prisms got wrong cancels. Position: a place in the rover frame, as "
            "another instrument would give it; what prisms got wrong counts in full. Dots: the survey's "
            "joint angles.</p>"
        )
        for pair in pairs:
            found = uncertainty_map(calibration, pair, POINTING_RANGE_M)
            yield html.plot_tag(plots.pointing_map(found, calibration, "sigma"), f"uncertainty of {pair}")
    if told.in_use is not None:
        yield from _comparison(told, told.in_use, pairs)


def _comparison(told: Told, in_use: StoredRig, pairs: Sequence[str]) -> Iterator[str]:
    """By how many pixels pointing would change."""
    from mastctl.calibration import plots

    yield f"<h2>Against the mast file in use: {html.escape(in_use.path.name)} ({in_use.digest[:12]})</h2>"
    rows, tags = [], []
    for pair in pairs:
        change = change_map(told.calibration.rig, in_use.rig, pair, POINTING_RANGE_M)
        if change is None:
            rows.append([pair, "", "", "the mast file in use lacks these cameras"])
            continue
        rows.append([pair, _typical(change.by_click), _typical(change.by_position), ""])
        tags.append(
            html.plot_tag(plots.pointing_map(change, told.calibration, "change"), f"change of {pair}")
        )
    yield "<p>By how many pixels pointing would change: median over the joints' range, and the most.</p>"
    yield html.table(["pair", "clicked, px", "position in the rover frame, px", ""], rows)
    yield from tags


def change_summary(calibration: Calibration, in_use: StoredRig) -> dict[str, dict[str, float]]:
    """Return by pair the median and largest change of pointing, px, against the mast file in use."""
    summary = {}
    for pair, names in calibration.rig.stereo.items():
        if calibration.rig.cameras[names[0]].on != "head":
            continue
        change = change_map(calibration.rig, in_use.rig, pair, POINTING_RANGE_M)
        if change is not None and np.isfinite(change.by_click).any():
            summary[pair] = {
                "median_px": float(np.nanmedian(change.by_click)),
                "most_px": float(np.nanmax(change.by_click)),
                "position_median_px": float(np.nanmedian(change.by_position)),
                "position_most_px": float(np.nanmax(change.by_position)),
            }
    return summary


def _typical(values: np.ndarray) -> str:
    if not np.isfinite(values).any():
        return "none"
    return f"{np.nanmedian(values):.2f}, at most {np.nanmax(values):.2f}"


def _mean(told: Told, camera: str) -> str:
    fitted = told.calibration.rms_px.get(camera)
    check = told.calibration.check_rms_px.get(camera)
    words = [f"fitted {_pair(fitted)} px rms"] if fitted else []
    words += [f"check {_pair(check)} px rms"] if check else []
    return f"{camera}: " + ", ".join(words)


def _station_table(calibration: Calibration) -> str:
    """Rms of the residuals of prisms by set-up and of tapes by placement, worst first."""
    groups: dict[tuple[str, str, str], list[float]] = {}
    for point in calibration.station:
        size = 1000 * float(np.linalg.norm(point.residual_m))
        groups.setdefault((point.kind, point.setup, point.placement), []).append(size)
    rows = [
        [
            kind,
            setup,
            placement,
            f"{len(sizes)}",
            f"{np.sqrt(np.mean(np.square(sizes))):.2f}",
            f"{max(sizes):.2f}",
        ]
        for (kind, setup, placement), sizes in groups.items()
    ]
    rows.sort(key=lambda row: (row[0], -float(row[5])))
    return html.table(["kind", "set-up", "placement", "points", "rms mm", "worst mm"], rows)


def _worst_images(calibration: Calibration) -> str:
    sizes = []
    for image in calibration.images:
        which = image.used if image.purpose != "check" else np.ones(len(image.used), dtype=bool)
        if which.any():
            rms_px = float(np.sqrt(np.mean(image.residuals_px[which] ** 2)))
            sizes.append((rms_px if np.isfinite(rms_px) else np.inf, image))
    sizes.sort(key=lambda pair: -pair[0])
    rows = [
        [
            f"{rms:.3f}",
            f"{image.range_m:.2f}",
            f"{np.degrees(image.incidence_rad):.0f}",
            f"{int((~image.used).sum()) if image.purpose != 'check' else 0}",
            image.purpose,
            f"{image.setup} / {image.placement}",
            image.name,
        ]
        for rms, image in sizes[:WORST_IMAGES]
    ]
    return html.table(
        ["rms px", "range m", "turned deg", "dots out", "purpose", "set-up / placement", "image"], rows
    )
