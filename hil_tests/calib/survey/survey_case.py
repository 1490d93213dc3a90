"""A small survey folder as a person would write it, for tests that spoil it."""

from __future__ import annotations

from pathlib import Path

SURVEY_YAML = """\
schema: mastctl/survey/1
board:
  rows: 3
  columns: 4
  spacing_m: 0.08
  dot_diameter_m: 0.04
  tapes_in_board_m: {a: [-0.2, -0.2, 0], b: [0.2, -0.2, 0], c: [-0.2, 0.2, 0]}
prisms_in_rover_m:   # from the drawing
  p1: [0.1, -0.25, -0.75]
  p2: [0.1, 0.25, -0.8]
  p3: [-0.3, -0.25, -0.9]
  p4: [-0.3, 0.25, -0.7]
sigma: {station_m: 0.001, dot_px: 0.1}
cameras:
  navcam_left: {on: head, size_px: [1024, 768], model: CAHVOR, focal_px: 1290}
  navcam_right:
    on: head
    size_px: [1024, 768]
    model: CAHVOR
    focal_px: 1290
    rough: {C: [0.4, 0.1, -1.4], A: [2, 0, 0]}
  hazcam_left: {on: rover, size_px: [640, 480], model: CAHVORE, focal_px: 309}
stereo: {navcam: [navcam_left, navcam_right]}
"""

STATION = """\
setup,kind,placement,point,x_m,y_m,z_m
level,prism,,p1,1.10,-0.25,-0.75
level,prism,,p2,1.10,0.25,-0.80
level,prism,,p3,0.70,-0.25,-0.90
level,prism,,p4,0.70,0.25,-0.70
level,tape,near,a,4,-0.2,-0.2
level,tape,near,b,4,0.2,-0.2
level,tape,near,c,4,-0.2,0.2
level,check,,brick,3,0.5,0.1
"""

IMAGES = """\
image,camera,setup,placement,purpose,pan_rad,tilt_rad,file
one,navcam_left,level,near,camera,0.0,-0.1745,one.png
two,navcam_right,level,near,mast,0.25,-0.3,
three,hazcam_left,level,near,camera,,,
four,navcam_left,level,,check,0.5,-0.2,
"""

DOTS = """\
image,row,column,x_px,y_px
one,0,0,400.5,300.25
one,0,1,434.5,300.5
one,2,3,502.0,368.0
three,1,1,320,240
"""

CLICKS = """\
image,point,x_px,y_px
four,brick,612,401
"""

FILES = {
    "survey.yaml": SURVEY_YAML,
    "station.csv": STATION,
    "images.csv": IMAGES,
    "dots.csv": DOTS,
    "clicks.csv": CLICKS,
}


def write_files(folder: Path, **other: str | None) -> Path:
    """Write the survey; ``other`` replaces a file by its name without suffix, None leaves it out."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in FILES.items():
        text_or_none = other.get(name.partition(".")[0], text)
        if text_or_none is not None:
            (folder / name).write_text(text_or_none)
    return folder
