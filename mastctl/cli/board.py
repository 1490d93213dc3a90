"""``mastctl board``: boards to calibrate with, on paper; their measured bars; what a picture shows of one."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, WrongUse
from mastctl.packaged import NAMES_SCHEMA, name_schema

if TYPE_CHECKING:
    from calib.targets.boards import AnyBoard

USUAL_MM = 25.0
"""Of squares on A4; on other papers in proportion."""

DICTIONARIES = ("DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000")


@command(
    "board make",
    option("--kind charuco|aprilgrid|dots|checkerboard", "the pattern", required=True),
    option("--out FILE", "board.pdf; its BOARD.yaml is written beside it", required=True),
    option("--paper SIZE", "A4, A3, A2, letter, ..., or WxH in mm: 500x700", default="A4"),
    option("--landscape", "the paper lies on its longer side"),
    option("--columns N", "as many as fit, if left out"),
    option("--rows N", "as many as fit, if left out"),
    option("--square-mm MM", "a square of charuco and checkerboard"),
    option("--marker-mm MM", "a marker of charuco; three quarters of a square, if left out"),
    option("--tag-mm MM", "a tag of aprilgrid"),
    option("--gap-mm MM", "between tags; three tenths of a tag, if left out"),
    option("--spacing-mm MM", "between the middles of dots"),
    option("--dot-mm MM", "across a dot; half the spacing, if left out"),
    option("--dictionary NAME", "of charuco, OpenCV's name; 5x5 as large as is needed, if left out"),
    option("--family NAME", "of aprilgrid: tag36h11 (default), tag25h9, tag16h5"),
    option("--first-id N", "number of the first marker; a second board's differ", type=int),
    help="draw a board to print, and write its BOARD.yaml beside it",
    example="--kind charuco --paper A4 --out board.pdf",
)
def _make(args: argparse.Namespace) -> Answer:
    from calib.files import save_bytes
    from calib.targets.board_file import save_board
    from mastctl.setup.board_sheet import pdf_of, sheet_of

    out = args.out
    if out.suffix != ".pdf":
        raise WrongUse(f"--out: {args.out} where a file ending in .pdf is expected")
    paper_mm = _paper_mm(args)
    board = _board(args, paper_mm)
    sheet = sheet_of(board, paper_mm, out.stem)
    yaml = out.with_suffix(".yaml")
    _check_free(yaml)
    save_bytes(out, pdf_of(sheet))
    save_board(yaml, board, sheet.bar_m, out.stem)
    return _written(yaml, [out, yaml, name_schema(yaml, "board")], sheet.bar_m)


@command(
    "board measured",
    option("BOARD.yaml", "the board's file, which is rewritten"),
    option("--across-mm MM", "the printed bar across, as measured", required=True),
    option("--down-mm MM", "as across, if left out"),
    help="write the lengths of a print's bars into its BOARD.yaml",
    example="board.yaml --across-mm 149.6 --down-mm 149.8",
)
def _measured(args: argparse.Namespace) -> Answer:
    from calib.targets.board_file import measure

    board, down_mm = args.board, args.down_mm
    named = board.is_file() and board.read_bytes().startswith(NAMES_SCHEMA.encode())
    bar_m = measure(board, args.across_mm / 1000, None if down_mm is None else down_mm / 1000)
    if named:
        name_schema(board, "board")
    return _written(board, [board], bar_m)


@command(
    "board find",
    option("BOARD.yaml", "the board's file"),
    option("PICTURE...", "PNG or JPEG", dest="pictures"),
    option("--out FILE", "a CSV of all corners: picture,id,x_px,y_px,sigma_px"),
    help="find a board's corners in pictures, or say why there are none",
    example="board.yaml picture.png",
)
def _find(args: argparse.Namespace) -> Answer:
    import numpy as np

    from calib.files import save_bytes
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
            raise WrongUse(f"{name} has {image.dtype} where 8 or 16 bits a pixel are expected")
        corners = find_corners(board, image)
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
    return Answer({"pictures": found}, code=0 if any(one["corners"] for one in found) else 1)


def _paper_mm(args: argparse.Namespace) -> tuple[float, float]:
    from mastctl.setup.board_sheet import PAPERS_MM

    known = {name.lower(): size for name, size in PAPERS_MM.items()}
    sides = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)(?:_?mm)?", args.paper.lower(), re.ASCII)
    size = known.get(args.paper.lower()) or (0.0, 0.0)
    if sides is not None:
        size = float(sides[1]), float(sides[2])
    if not all(60.0 <= side <= 3000.0 for side in size):
        raise WrongUse(
            f"--paper: '{args.paper}' where one of {', '.join(PAPERS_MM)}, or WxH in mm from 60 to 3000, "
            "as 500x700, is expected"
        )
    return (max(size), min(size)) if args.landscape else size


def _board(args: argparse.Namespace, paper_mm: tuple[float, float]) -> AnyBoard:
    """The board of the options and the paper, read as its file will be."""
    from calib.errors import BadFile
    from calib.targets.board_file import board_of, dictionary_size
    from mastctl.setup.board_sheet import largest_mm

    wide_mm, high_mm = largest_mm(paper_mm)
    usual_mm = USUAL_MM * min(wide_mm, high_mm) / 174.0
    usual_mm = max(1.0, float(round(usual_mm / 5.0) * 5.0 if usual_mm > 10 else round(usual_mm)))
    names = {f"{name}_m": f"{name}_mm" for name in ("square", "marker", "tag", "gap", "spacing")}
    names |= {"dot_diameter_m": "dot_mm"}
    sizes_mm = {key: size for key, name in names.items() if (size := getattr(args, name)) is not None}
    # ``step`` is what one more column takes, ``edge`` what the first and the last need beside that.
    if args.kind in ("charuco", "checkerboard"):
        step, edge = sizes_mm.setdefault("square_m", usual_mm), 0.0
        if args.kind == "charuco":
            sizes_mm.setdefault("marker_m", 0.75 * step)
    elif args.kind == "aprilgrid":
        tag = sizes_mm.setdefault("tag_m", round(1.1 * usual_mm))
        edge = sizes_mm.setdefault("gap_m", 0.3 * tag)
        step = tag + edge
    else:
        step = sizes_mm.setdefault("spacing_m", round(0.8 * usual_mm))
        edge = sizes_mm.setdefault("dot_diameter_m", 0.5 * step) - step
    columns, rows = args.columns or int((wide_mm - edge) / step), args.rows or int((high_mm - edge) / step)
    document: dict[str, Any] = {"kind": args.kind, "columns": columns, "rows": rows}
    document |= {key: round(size_mm / 1000, 6) for key, size_mm in sizes_mm.items()}
    given = {name: getattr(args, name) for name in ("dictionary", "family", "first_id")}
    document |= {name: value for name, value in given.items() if value is not None}
    if args.kind == "charuco":
        enough = (name for name in DICTIONARIES if dictionary_size(name) >= columns * rows // 2)
        document.setdefault("dictionary", next(enough, DICTIONARIES[-1]))
    elif args.kind == "aprilgrid":
        document.setdefault("family", "tag36h11")
    try:
        return board_of(args.out, "", document)
    except BadFile as error:
        raise WrongUse(f"a board of kind {args.kind}, {error.place}: {error.reason}") from None


def _check_free(yaml: Path) -> None:
    """Refuse to write over a board that has been measured."""
    from calib.errors import BadFile
    from calib.files import read_bytes
    from calib.files.yaml_text import MAX_BYTES, parse_mapping

    try:
        measured = yaml.exists() and "measured" in parse_mapping(read_bytes(yaml, MAX_BYTES), yaml)
    except BadFile:
        return
    if measured:
        raise WrongUse(f"{yaml} has a measured board; another name for --out is expected")


def _written(yaml: Path, files: list[Path], bar_m: tuple[float, float]) -> Answer:
    from calib.targets.board_file import document_of, load_board
    from mastctl.setup.board_sheet import description

    board = load_board(yaml)
    document = {
        "board": document_of(board), "files": [str(one) for one in files],
        "bar_m": {"across": bar_m[0], "down": bar_m[1]}, "size_m": list(board.size_m),
    }  # fmt: skip
    width_mm, height_mm = (1000 * size for size in board.size_m)
    lines = (f"written: {one}" for one in files)
    return Answer(document, [f"{description(board)}; {width_mm:.1f} x {height_mm:.1f} mm", *lines])
