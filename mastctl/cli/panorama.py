"""``mastctl panorama``: take, compose, export panoramas, and the targets that are kept by a name."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli.daemon import DAEMON, client_of, followed, not_done
from mastctl.cli.options import GROUPS, command, finite_number, one_of, option
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, check_file

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.panorama.folder import Index

GROUPS["panorama"] = "panoramas that the mast takes, and any pixel of which points it"
FOLDER = option("FOLDER", "a panorama's folder")


@command(
    "panorama take",
    one_of(
        option("--pair NAME", "the stereo pair (default: the widest); the mosaic is of its left camera"),
        option("--camera NAME", "or one camera alone"),
        option("--resume FOLDER", "go on with one of which views are missing"),
    ),
    option("--pan FROM TO", "azimuths of the field, radians (default: the limits)", type=finite_number),
    option("--tilt FROM TO", "elevations of the field (default -0.7 0.2)", type=finite_number),
    option("--overlap PART", "of neighbours (default 0.2)", type=finite_number),
    option("--exposure first|auto-per-view", "fixed from the first view on (default), or each view's own"),
    option("--out FOLDER", "where the panorama goes"),
    option("--timeout S", "how long to wait (default 3600 s)", default=3600.0),
    *DAEMON,
    help="take a panorama and bring it into a folder",
    example="--pan -1 1 --tilt -0.6 0 --out panorama",
)
def _take(args: argparse.Namespace) -> Answer:
    if (args.out is None) == (args.resume is None):
        raise WrongUse("--out FOLDER is expected, or --resume FOLDER")
    wanted = {name: getattr(args, name) for name in ("pair", "camera", "overlap", "exposure")}
    out = args.out or args.resume
    if args.resume is not None:
        if any(one is not None for one in (*wanted.values(), args.pan, args.tilt)):
            raise WrongUse("--resume goes alone: a panorama goes on as it was begun")
        wanted = {"resume": _index(args.resume).id}
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CommandError("not_empty", f"{out}: is there already; another name is expected", 2)
    with client_of(args) as client:
        operation_id = client.take_panorama(**wanted, pan_rad=args.pan, tilt_rad=args.tilt)
        name = str(client.operation(operation_id)["request"]["panorama"])
        try:
            record = followed(client, operation_id, args.json, args.timeout)
        finally:
            _bring(client, name, out)
    index = _index(out)
    if record["state"] != "done":
        raise not_done(record, f"; what was taken is in {out}: 'panorama take --resume {out}' goes on")
    return Answer(_document(index), _shown(out, index))


def _bring(client: Client, name: str, out: Path) -> None:
    """Copy a panorama from the daemon: what is not there yet, the index last."""
    from calib.files import digest_of, is_plain_file
    from mastctl.panorama.folder import INDEX, MAST, MOSAIC, PREVIEW, Index

    index = Index.model_validate(client.panorama(name))
    frames = {one.file: one.sha256 for view in index.views for one in view.frames.values()}
    composed = [MOSAIC, PREVIEW] if index.mosaic is not None else []
    for file in (MAST, *frames, *composed, INDEX):
        path = out / file
        if file in frames and is_plain_file(path) and digest_of(path.read_bytes()) == frames[file]:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(client.panorama_file(name, file))


@command("panorama show", FOLDER, help="say what a panorama holds", example="panorama")
def _show(args: argparse.Namespace) -> Answer:
    index = _index(args.folder)
    return Answer(_document(index), _shown(args.folder, index))


@command(
    "panorama compose",
    FOLDER,
    option("--projection equirectangular|cylindrical", "of the mosaic", default="equirectangular"),
    option("--frame mast|rover", "whose axes azimuth and elevation are of", default="mast"),
    option("--surface SURFACE", "infinity, sphere:METRES, ground or ground:Z", default="ground"),
    option("--px-per-deg PX", "resolution (default: the lens' own in its middle)"),
    option("--raw", "leave the pictures' brightness as it is"),
    help="compose the mosaic anew and measure its seams",
    example="panorama --surface infinity",
)
def _compose(args: argparse.Namespace) -> Answer:
    from calib.geometry.mosaic import MosaicSurface
    from mastctl.panorama.compose import Composition, compose
    from mastctl.panorama.folder import Folder

    scale = None if args.px_per_deg is None else math.degrees(args.px_per_deg)
    wanted = Composition(args.projection, args.frame, MosaicSurface.of(args.surface), scale, args.raw)
    folder = Folder(args.folder)
    compose(folder, wanted)
    return Answer(_document(folder.index), _shown(args.folder, folder.index))


@command(
    "panorama export",
    FOLDER,
    one_of(
        option("--gpano FILE", "a JPEG or PNG that viewers open as a sphere"),
        option("--hugin FILE.pto", "a project of Hugin with the known angles, of things at infinity"),
        required=True,
    ),
    help="write a panorama for other programs",
    example="panorama --gpano sphere.jpg",
)
def _export(args: argparse.Namespace) -> Answer:
    from mastctl.panorama.exports import gpano, hugin
    from mastctl.panorama.folder import Folder

    folder = Folder(args.folder)
    if folder.index.mosaic is None:
        raise CommandError(
            "no_mosaic", f"{args.folder}: 'mastctl panorama compose' makes the mosaic first", 2
        )
    canvas, out = folder.index.mosaic.canvas, args.gpano or args.hugin
    check_file(out, "--gpano" if args.gpano else "--hugin")
    document: dict[str, Any] = {"file": str(out)}
    if args.gpano is not None:
        gpano(folder.mosaic(), canvas, out)
        return Answer(document, f"{out}: a sphere's part of {canvas.size_px[0]}x{canvas.size_px[1]} px")
    camera = folder.index.cameras[0]
    files = [str((args.folder / view.frames[camera].file).resolve()) for _, view in folder.index.taken()]
    worst_px = hugin(folder.cameras(), files, canvas, out)
    return Answer(
        document | {"lens_off_px": worst_px},
        f"{out}: {len(files)} pictures, Hugin's lens is {worst_px:.2f} px off",
    )


@command(
    "panorama targets",
    option("--out FILE", "write them too: a table as .csv, or as .json GeoJSON's features of points, metres"),
    *DAEMON,
    help="list the targets that are kept by a name",
)
def _targets(args: argparse.Namespace) -> Answer:
    from calib.files.tables import write_rows

    if args.out is not None:
        if args.out.suffix.lower() not in (".csv", ".json", ".geojson"):
            raise WrongUse(f"--out: {args.out} where a file ending in .csv, .json or .geojson is expected")
        check_file(args.out, "--out")
    with client_of(args) as client:
        found = client.targets()
    if args.out is not None:
        with args.out.open("w", encoding="utf-8") as file:
            if args.out.suffix.lower() == ".csv":
                rows = [
                    [name, one["frame"], *one["position_m"], json.dumps(one["covariance_m2"])]
                    for name, one in found.items()
                ]
                write_rows(file, ("name", "frame", "x_m", "y_m", "z_m", "covariance_m2"), rows)
            else:
                features = [
                    {
                        "type": "Feature",
                        "geometry": {"type": "Point", "coordinates": one["position_m"]},
                        "properties": {"name": name, **one},
                    }
                    for name, one in found.items()
                ]
                json.dump({"type": "FeatureCollection", "features": features}, file, indent=1)
    return Answer({"targets": found})


@command(
    "panorama keep",
    option("NAME", "of the target", dest="name"),
    one_of(
        option("--position X Y Z", "a point, metres"),
        option("--operation ID", "what this pointing measured"),
        required=True,
    ),
    option("--frame rover|site", "frame of --position", default="rover"),
    *DAEMON,
    help="keep a target by a name",
    example="rock --operation 000003-1a2b",
)
def _keep(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        found = client.keep_target(args.name, args.position, args.frame, operation=args.operation)
        return Answer({"targets": found})


def _index(folder: Path) -> Index:
    from mastctl.panorama.folder import Folder

    return Folder(folder).index


def _document(index: Index) -> dict[str, Any]:
    document: dict[str, Any] = index.model_dump(mode="json", by_alias=True, exclude_none=True)
    return document


def _shown(folder: Path, index: Index) -> list[str | Shown]:
    """What people see of a panorama: how many views, its mosaic, and what the seams say."""
    states = [view.state for view in index.views]
    counts = ", ".join(f"{states.count(state)} {state}" for state in sorted(set(states)))
    lines: list[str | Shown] = [f"{folder}: panorama {index.id} of {index.cameras[0]}, views: {counts}"]
    lines += [f"view {at}: {one.state}: {one.reason}" for at, one in enumerate(index.views) if one.reason]
    if index.mosaic is not None:
        width, height = index.mosaic.size_px
        lines.append(f"mosaic: {width}x{height} px, {index.mosaic.projection}, for {index.mosaic.surface}")
    if index.whole is not None:
        (x, y), (across, matched) = index.whole.rms_px, index.whole.across_px
        lines.append(
            f"seams: {x:.3f}, {y:.3f} px rms of {index.whole.count} patches; across the parallax "
            f"{across:.3f} px (the matches alone {matched:.3f} px)"
        )
    return lines + ([index.slip.sentence] if index.slip is not None else [])
