"""``mastctl board``: boards to calibrate with, on paper; their measured bars; what a picture shows of one."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import WrongUse, finite_number
from mastctl.packaged import NAMES_SCHEMA, name_schema

if TYPE_CHECKING:
    from calib.targets.boards import AnyBoard

USUAL_MM = 25.0
"""Of squares on A4; on other papers in proportion."""

KINDS = ("charuco", "aprilgrid", "dots", "checkerboard")
DICTIONARIES = ("DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000")


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add board make, measured and find."""
    board = subparsers.add_parser("board", help="a board to calibrate with: make one, measure it, find it")
    acts = board.add_subparsers(dest="act", required=True, metavar="ACT")
    make = acts.add_parser("make", help="draw a board to print, and write its BOARD.yaml beside it")
    make.add_argument("--kind", required=True, choices=KINDS, help="the pattern")
    make.add_argument("--out", required=True, metavar="FILE", help="board.pdf or board.svg")
    make.add_argument(
        "--paper", default="A4", help="A4 (default), A3, A2, letter, ..., or WxH in mm: 500x700"
    )
    make.add_argument("--landscape", action="store_true", help="the paper lies on its longer side")
    make.add_argument("--columns", type=int, metavar="N", help="as many as fit, if left out")
    make.add_argument("--rows", type=int, metavar="N", help="as many as fit, if left out")
    for name, what in (
        ("square", "a square of charuco and checkerboard"),
        ("marker", "a marker of charuco; three quarters of a square, if left out"),
        ("tag", "a tag of aprilgrid"),
        ("gap", "between tags; three tenths of a tag, if left out"),
        ("spacing", "between the middles of dots"),
        ("dot", "across a dot; half the spacing, if left out"),
    ):
        make.add_argument(f"--{name}-mm", type=finite_number, metavar="MM", help=what)
    make.add_argument(
        "--dictionary", help="of charuco, OpenCV's name; 5x5 as large as is needed, if left out"
    )
    make.add_argument("--family", help="of aprilgrid: tag36h11 (default), tag25h9, tag16h5")
    make.add_argument(
        "--first-id", type=int, metavar="N", help="number of the first marker; a second board's differ"
    )
    make.add_argument(
        "--measured-bar-mm",
        nargs="+",
        type=finite_number,
        metavar="MM",
        help="the bars of the print: across, down",
    )
    make.set_defaults(run=_make)
    measured = acts.add_parser("measured", help="write the lengths of a print's bars into its BOARD.yaml")
    measured.add_argument("board", metavar="BOARD.yaml", help="the board's file, which is rewritten")
    measured.add_argument(
        "--across-mm",
        required=True,
        type=finite_number,
        metavar="MM",
        help="the printed bar across, as measured",
    )
    measured.add_argument("--down-mm", type=finite_number, metavar="MM", help="as across, if left out")
    measured.set_defaults(run=_measured)
    find = acts.add_parser("find", help="find a board's corners in pictures, or say why there are none")
    find.add_argument("board", metavar="BOARD.yaml", help="the board's file")
    find.add_argument("pictures", nargs="+", metavar="PICTURE", help="PNG or JPEG")
    find.add_argument("--out", metavar="FILE", help="a CSV of all corners: picture,id,x_px,y_px,sigma_px")
    find.set_defaults(run=_find)


def _make(args: argparse.Namespace) -> int:
    from calib.files.atomic import save_bytes
    from calib.targets.board_file import save_board
    from mastctl.setup.board_sheet import pdf_of, sheet_of, svg_of

    out = Path(args.out)
    if out.suffix not in (".pdf", ".svg"):
        raise WrongUse(f"--out: {args.out} where a file ending in .pdf or .svg is expected")
    paper_mm = _paper_mm(args)
    board = _board(args, paper_mm)
    sheet = sheet_of(board, paper_mm, out.stem)
    measured = _bars_m(args.measured_bar_mm, sheet.bar_m, ("--measured-bar-mm", "--measured-bar-mm"))
    yaml = out.with_suffix(".yaml")
    _check_free(yaml, measured is not None)
    save_bytes(out, pdf_of(sheet) if out.suffix == ".pdf" else svg_of(sheet))
    save_board(yaml, board, sheet.bar_m, out.stem, measured)
    _tell(args, yaml, [out, yaml, name_schema(yaml, "board")], sheet.bar_m)
    return 0


def _measured(args: argparse.Namespace) -> int:
    from calib.targets.board_file import bars_of, measure

    board = Path(args.board)
    bars_mm = [one for one in (args.across_mm, args.down_mm) if one is not None]
    across_m, down_m = _bars_m(bars_mm, bars_of(board), ("--across-mm", "--down-mm")) or (0.0, None)
    named = board.is_file() and board.read_bytes().startswith(NAMES_SCHEMA.encode())
    bar_m = measure(board, across_m, down_m)
    if named:
        name_schema(board, "board")
    _tell(args, board, [board], bar_m)
    return 0


def _find(args: argparse.Namespace) -> int:
    import numpy as np

    from calib.files.atomic import save_bytes
    from calib.files.pictures import decode_picture
    from calib.targets.board_file import load_board
    from calib.targets.boards import CornersNotFound
    from calib.targets.corners import find_corners
    from mastctl.as_json import readable

    board = load_board(args.board)
    rows, found = ["picture,id,x_px,y_px,sigma_px\n"], []
    for name in args.pictures:
        try:
            image = decode_picture(Path(name).read_bytes() if Path(name).is_file() else b"")
        except ValueError as reason:
            raise WrongUse(f"{name} is no picture that can be read: {reason}") from None
        if image.dtype not in (np.uint8, np.uint16):
            raise WrongUse(f"{name} holds {image.dtype} where 8 or 16 bits a pixel are expected")
        corners = find_corners(
            board, image.astype(np.uint8) if image.dtype == np.uint8 else image.astype(np.uint16)
        )
        if isinstance(corners, CornersNotFound):
            found.append({"picture": name, "corners": 0, "of": len(board.ids), "reason": corners.reason})
            continue
        usual_px = float(np.median(corners.sigma_px))
        found.append({"picture": name, "corners": len(corners), "of": len(board.ids), "sigma_px": usual_px})
        for number, (x, y), sigma in zip(
            corners.ids.tolist(), corners.pixels_px.tolist(), corners.sigma_px.tolist(), strict=True
        ):
            rows.append(f"{readable(name)},{number},{x!r},{y!r},{sigma!r}\n")
    if args.out is not None:
        save_bytes(args.out, "".join(rows).encode())
    if args.json:
        output.print_json({"pictures": found})
    else:
        for one in found:
            seen = f"{one['corners']} of {one['of']} corners"
            told = f"{seen}, sigma {one['sigma_px']:.3f} px" if one["corners"] else str(one["reason"])
            sys.stdout.write(output.one_line(f"{one['picture']}: {told}") + "\n")
    return 0 if any(one["corners"] for one in found) else 1


def _paper_mm(args: argparse.Namespace) -> tuple[float, float]:
    from mastctl.setup.board_sheet import PAPERS_MM

    known = {name.lower(): size for name, size in PAPERS_MM.items()}
    size = known.get(args.paper.lower())
    if size is None:
        width, by, height = args.paper.lower().removesuffix("mm").removesuffix("_").partition("x")
        try:
            size = float(width), float(height)
        except ValueError:
            size = 0.0, 0.0
        if not by or not all(60.0 <= side <= 3000.0 for side in size):
            raise WrongUse(
                f"--paper: '{args.paper}' where one of {', '.join(PAPERS_MM)}, or WxH in mm from 60 to 3000, "
                "as 500x700, is expected"
            )
    return (max(size), min(size)) if args.landscape else size


def _board(args: argparse.Namespace, paper_mm: tuple[float, float]) -> AnyBoard:
    """The board that the options and the paper ask for, read as its file will be."""
    from calib.errors import BadFile
    from calib.targets.board_file import board_of, dictionary_size
    from mastctl.setup.board_sheet import room_mm

    wide_mm, high_mm = room_mm(paper_mm)
    usual_mm = USUAL_MM * min(wide_mm, high_mm) / 174.0
    usual_mm = max(1.0, float(round(usual_mm / 5.0) * 5.0 if usual_mm > 10 else round(usual_mm)))
    document: dict[str, Any] = {"kind": args.kind}
    _refuse_others(args)
    if args.kind in ("charuco", "checkerboard"):
        step = args.square_mm or usual_mm
        columns, rows = args.columns or int(wide_mm / step), args.rows or int(high_mm / step)
        document["square_m"] = step / 1000
        if args.kind == "charuco":
            document["marker_m"] = (args.marker_mm or 0.75 * step) / 1000
            enough = (name for name in DICTIONARIES if dictionary_size(name) >= columns * rows // 2)
            document["dictionary"] = args.dictionary or next(enough, DICTIONARIES[-1])
    elif args.kind == "aprilgrid":
        tag = args.tag_mm or round(1.1 * usual_mm)
        gap = args.gap_mm or 0.3 * tag
        columns = args.columns or int((wide_mm - gap) / (tag + gap))
        rows = args.rows or int((high_mm - gap) / (tag + gap))
        document |= {"tag_m": tag / 1000, "gap_m": round(gap / 1000, 6), "family": args.family or "tag36h11"}
    else:
        step = args.spacing_mm or round(0.8 * usual_mm)
        dot = args.dot_mm or 0.5 * step
        columns = args.columns or int((wide_mm - dot) / step) + 1
        rows = args.rows or int((high_mm - dot) / step) + 1
        document |= {"spacing_m": step / 1000, "dot_diameter_m": dot / 1000}
    document |= {"columns": columns, "rows": rows}
    if args.first_id is not None:
        document["first_id"] = args.first_id
    try:
        return board_of(args.out, "", document)
    except BadFile as error:
        raise WrongUse(f"the board's {error.place}: {error.reason}") from None


def _refuse_others(args: argparse.Namespace) -> None:
    """Refuse options of another kind of board."""
    mine = {
        "charuco": ("square_mm", "marker_mm", "dictionary", "first_id"),
        "checkerboard": ("square_mm",),
        "aprilgrid": ("tag_mm", "gap_mm", "family", "first_id"),
        "dots": ("spacing_mm", "dot_mm"),
    }
    every = {name for names in mine.values() for name in names}
    for name in sorted(every):
        value = getattr(args, name)
        if value is not None and name not in mine[args.kind]:
            known = ", ".join(f"--{one.replace('_', '-')}" for one in mine[args.kind])
            raise WrongUse(
                f"--{name.replace('_', '-')} says nothing of a board of kind {args.kind}; known are {known}"
            )
        if name.endswith("_mm") and value is not None and not 0.0 < value <= 1000.0:
            raise WrongUse(
                f"--{name.replace('_', '-')}: {value:g} where more than 0 and at most 1000 is expected"
            )


def _bars_m(
    bars_mm: list[float] | None, drawn_m: tuple[float, float] | None, options: tuple[str, str]
) -> tuple[float, float | None] | None:
    """The measured bars, if they can be those that were drawn. Raises WrongUse, in millimetres."""
    from calib.targets.board_file import WORST_ASPECT, WORST_SCALE

    if not bars_mm:
        return None
    if len(bars_mm) > 2:
        raise WrongUse(
            f"--measured-bar-mm: {len(bars_mm)} numbers where one or two are expected: across, down"
        )
    scale = 1.0
    for option, bar_mm, bar_m, part in zip(
        options, bars_mm, drawn_m or (), (WORST_SCALE, WORST_ASPECT), strict=False
    ):
        wanted_mm = 1000 * bar_m * scale
        if not wanted_mm * (1 - part) <= bar_mm <= wanted_mm * (1 + part):
            metres = f"; {bar_mm:g} m is {1000 * bar_mm:g} mm" if abs(bar_mm) < 10 else ""
            raise WrongUse(
                f"{option} is {bar_mm:g} where {wanted_mm * (1 - part):.4g} to {wanted_mm * (1 + part):.4g} "
                f"millimetres are expected, {1000 * bar_m:.4g} as drawn{metres}"
            )
        scale *= bar_mm / wanted_mm
    return bars_mm[0] / 1000, bars_mm[1] / 1000 if len(bars_mm) > 1 else None


def _check_free(yaml: Path, measured: bool) -> None:
    """Refuse to write over a board that somebody has measured."""
    from calib.errors import BadFile
    from calib.files import read_bytes
    from calib.files.yaml_text import MAX_BYTES, parse_mapping

    if measured or not yaml.exists():
        return
    try:
        there = parse_mapping(read_bytes(yaml, MAX_BYTES), yaml)
    except BadFile:
        return
    if "measured" in there:
        raise WrongUse(
            f"{yaml} holds a measured board; another name for --out, or the bars again (--measured-bar-mm), "
            "is expected"
        )


def _tell(args: argparse.Namespace, yaml: Path, files: list[Path], bar_m: tuple[float, float]) -> None:
    from calib.targets.board_file import document_of, load_board
    from mastctl.setup.board_sheet import drawn

    board = load_board(yaml)
    if args.json:
        bars = {"across": bar_m[0], "down": bar_m[1]}
        told = {"board": document_of(board), "files": [str(one) for one in files], "bar_m": bars}
        output.print_json({**told, "size_m": list(board.size_m)})
        return
    width_mm, height_mm = (1000 * size for size in board.size_m)
    sys.stdout.write(output.one_line(f"{drawn(board)}; {width_mm:.1f} x {height_mm:.1f} mm") + "\n")
    for one in files:
        sys.stdout.write(output.one_line(f"written: {one}") + "\n")
