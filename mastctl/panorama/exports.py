"""A panorama for other programs: a picture that viewers open as a sphere, and a project of Hugin."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.errors import BadFile
from calib.geometry.cahvor import CameraModel
from calib.geometry.mosaic import Canvas
from calib.geometry.rigid import FloatArray
from calib.matching.mosaic import Picture
from mastctl.panorama.folder import write_whole
from mastctl.report.pictures import encoded, with_text

XMP = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"
 GPano:UsePanoramaViewer="True" GPano:ProjectionType="{projection}"{facts}/>
</rdf:RDF></x:xmpmeta>
<?xpacket end="w"?>"""
FIT_STEPS, FIT_ROUNDS = 15, 6
"""Pixels across and down of which a lens is fitted, and how often its focal length is."""


def gpano(mosaic: Picture, canvas: Canvas, path: Path) -> None:
    """Write a mosaic as JPEG or PNG (by the suffix) with GPano XMP: which part of the sphere it is.

    The middle of the sphere is straight ahead, azimuth and elevation 0. Raises BadFile.
    """
    height, width = mosaic.shape[:2]
    full, full_height, left, top = _sphere(canvas)
    facts = {
        "FullPanoWidthPixels": full,
        "FullPanoHeightPixels": full_height,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
        "CroppedAreaLeftPixels": left,
        "CroppedAreaTopPixels": top,
    }
    text = "".join(f'\n GPano:{name}="{value}"' for name, value in facts.items())
    xmp = XMP.format(projection=canvas.projection, facts=text)
    if path.suffix.lower() == ".png":
        data = with_text(encoded(mosaic, "png"), {"XML:com.adobe.xmp": xmp})
    elif path.suffix.lower() in (".jpg", ".jpeg"):
        body = b"http://ns.adobe.com/xap/1.0/\x00" + xmp.encode()
        picture = encoded(mosaic, "jpeg")  # two bytes start it, then come its segments
        data = picture[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + picture[2:]
    else:
        raise BadFile(path, "", "a name that ends with .jpg or .png is expected")
    write_whole(path, data)


def hugin(cameras: Sequence[CameraModel], files: Sequence[str], canvas: Canvas, path: Path) -> float:
    """Write a project of Hugin with the known angles; return how far its lens is off at most, px.

    ``cameras``: in the rover frame, all of one lens. Hugin has one centre for all pictures, so the project is
    of things at infinity. Its lens is fitted to the rays of the first camera. Raises BadFile.
    """
    width, height = cameras[0].size_px
    lens, worst_px = _hugin_lens(cameras[0])
    names = "vabcde"
    fov = " ".join(f"{name}{value!r}" for name, value in zip(names, lens.tolist(), strict=True))
    w, h = canvas.size_px
    whole, tall, left, top = _sphere(canvas)
    field = f"w{whole} h{tall} v{math.degrees(whole / canvas.px_per_rad)!r}"
    crop = f"S{left},{left + w},{top},{top + h}"
    lines = [
        f'p f{1 if canvas.projection == "cylindrical" else 2} {field} E0 R0 {crop} n"TIFF_m c:LZW"',
        "m g1 i0 m2 p0.00784314",
    ]
    mosaic_from_rover = canvas.rover_from_mosaic.inverse
    for number, (camera, file) in enumerate(zip(cameras, files, strict=True)):
        yaw, pitch, roll = _angles_deg(mosaic_from_rover.rotation @ _axes(camera))
        own = fov if not number else " ".join(f"{name}=0" for name in names)
        lines.append(
            f"i w{width} h{height} f0 {own} r{roll!r} p{pitch!r} y{yaw!r} "
            f'TrX0 TrY0 TrZ0 j0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n"{file}"'
        )
    write_whole(path, ("# hugin project file\n#hugin_ptoversion 2\n" + "\n".join(lines) + "\n").encode())
    return worst_px


def _sphere(canvas: Canvas) -> tuple[int, int, int, int]:
    """Width and height of the whole picture around a mosaic, column and row of its top-left pixel in that.

    The middle is straight ahead. Of a cylinder it is as high as the mosaic needs.
    """
    full, rise = 4 * round(math.pi / 2.0 * canvas.px_per_rad), canvas.elevation_rad
    above = (math.tan(rise) if canvas.projection == "cylindrical" else rise) * canvas.px_per_rad
    height = full // 2
    if canvas.projection == "cylindrical":
        height = 2 * math.ceil(max(above, canvas.size_px[1] - 1 - above) + 1.0)
    left = canvas.azimuth_rad * canvas.px_per_rad + (full - 1) / 2.0
    return full, height, round(left), round((height - 1) / 2.0 - above)


def _hugin_lens(camera: CameraModel) -> tuple[FloatArray, float]:
    """Hugin's (v deg, a, b, c, d, e) of a camera, and the worst misfit, px: its wiki's polynomial and shift.

    All but the focal length are linear, and that is the scale by which the rest comes out.
    """
    width, height = camera.size_px
    axes = (np.linspace(0, side - 1, FIT_STEPS) for side in (width, height))
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    rays = camera.ray(grid).directions @ _axes(camera)
    off, focal = (grid - np.array(camera.image_center_px)).ravel(), camera.focal_px[0]
    found = columns = np.empty(0)
    for _ in range(FIT_ROUNDS):
        ideal = focal * rays[:, :2] / rays[:, 2:]
        part = np.linalg.norm(ideal, axis=1, keepdims=True) / (min(width, height) / 2.0)
        radial = [*(ideal * (part**power - 1.0) for power in (3, 2, 1)), ideal]
        shift = np.tile(np.eye(2), (len(grid), 1))
        columns = np.column_stack([*(one.ravel() for one in radial), shift])
        found = np.linalg.lstsq(columns, off, rcond=None)[0]
        focal *= found[3]
    fov_deg = math.degrees(2.0 * math.atan(width / 2.0 / focal))
    lens = np.concatenate([[fov_deg], found[:3], found[4:]])
    return lens, float(np.abs(columns @ found - off).max())


def _axes(camera: CameraModel) -> FloatArray:
    """(3, 3) of a camera's frame in the one of the model: x right, y down, z along A, as columns."""
    return np.asarray(camera.pose.rotation)


def _angles_deg(mosaic_from_camera: FloatArray) -> tuple[float, float, float]:
    """Hugin's yaw (to the right), pitch (up), roll (clockwise) of camera axes in a frame x ahead, z down."""
    right, _, ahead = mosaic_from_camera.T
    yaw = math.atan2(ahead[1], ahead[0])
    pitch = math.asin(max(-1.0, min(1.0, -float(ahead[2]))))
    level = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    down = np.cross(ahead, level)
    roll = math.atan2(float(right @ down), float(right @ level))
    return math.degrees(yaw), math.degrees(pitch), math.degrees(roll)
