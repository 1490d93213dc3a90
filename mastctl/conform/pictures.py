"""Pictures with their facts, and clicks that are bound to one of them."""

from __future__ import annotations

import hashlib
import itertools
import math
import time
from urllib.parse import quote

import numpy as np

from mastctl.conform.checks import NotTried, Suite, expect
from mastctl.conform.daemon import Daemon, field, number

PICTURES: Suite[Daemon] = Suite()

KEPT = 16
OLD_WITHIN_S = 60.0
AGE_S = 0.002
SAME_RAD = 0.006  # of a head at rest, read at two moments
MAGIC = {"png": b"\x89PNG\r\n", "jpeg": b"\xff\xd8\xff"}


@PICTURES.check(
    "pictures.facts", "every camera gives a PNG of the mast file's size with its facts in headers"
)
def _facts(daemon: Daemon) -> str:
    digest = hashlib.sha256(daemon.mast).hexdigest()
    for camera in daemon.cameras:
        answer, shot = daemon.picture(camera, format="png")
        expect(answer.media_type == "image/png", f"{camera}: the picture is told to be {answer.media_type}")
        expect(answer.data.startswith(MAGIC["png"]), f"{camera}: the picture is told to be PNG and is not")
        height, width = shot.image.shape[:2]
        size = field(daemon.mast_cameras, camera, "size_px")
        expect(
            list(size) == [width, height],
            f"{camera}: {width}x{height} px where the mast file has {'x'.join(map(str, size))} px",
        )
        expect(shot.camera == camera, f"{camera}: its picture says that it is of {shot.camera}")
        expect(shot.mast_digest == digest, f"{camera}: the digest is not that of the mast file in use")
        expect(shot.exposure_s >= 0, f"{camera}: exposure {shot.exposure_s} s")
        for angle in (shot.pan_rad, shot.tilt_rad):
            expect(math.isfinite(angle) and abs(angle) <= math.tau, f"{camera}: a joint angle is {angle} rad")
    return f"{len(daemon.cameras)} cameras"


@PICTURES.check("pictures.jpeg", "format=jpeg gives a JPEG of the same size")
def _jpeg(daemon: Daemon) -> None:
    camera = daemon.cameras[0]
    answer, shot = daemon.picture(camera, format="jpeg")
    expect(answer.media_type == "image/jpeg", f"{camera}: the picture is told to be {answer.media_type}")
    expect(answer.data.startswith(MAGIC["jpeg"]), f"{camera}: the picture is told to be JPEG and is not")
    height, width = shot.image.shape[:2]
    size = list(field(daemon.mast_cameras, camera, "size_px"))
    expect(size == [width, height], f"{camera}: {width}x{height} px where the mast file has {size}")


@PICTURES.check("pictures.fresh", "with fresh=true the exposure begins and ends within the request")
def _fresh(daemon: Daemon) -> str:
    longest_s = 0.0
    for camera in daemon.cameras:
        for _ in range(2):
            before_s = number(daemon.status(), "now_s")
            _, shot = daemon.picture(camera, fresh="true")
            after_s = number(daemon.status(), "now_s")
            began_s = shot.mid_exposure_s - shot.exposure_s / 2
            ended_s = shot.mid_exposure_s + shot.exposure_s / 2
            expect(
                began_s >= before_s,
                f"{camera}: the exposure began {before_s - began_s:.4f} s before the request",
            )
            expect(
                ended_s <= after_s, f"{camera}: the exposure ends {ended_s - after_s:.4f} s after the answer"
            )
            longest_s = max(longest_s, after_s - before_s)
    return f"at most {longest_s:.2f} s a picture"


@PICTURES.check("pictures.ids", "ids are unique; counts and mid-exposures grow together")
def _ids(daemon: Daemon) -> str:
    seen: set[str] = set()
    for camera in daemon.cameras:
        shots = [daemon.picture(camera, fresh="true")[1] for _ in range(3)]
        for before, shot in itertools.pairwise(shots):
            expect(
                shot.sequence > before.sequence and shot.mid_exposure_s > before.mid_exposure_s,
                f"{camera}: frame {shot.sequence} of {shot.mid_exposure_s:.4f} s came after frame "
                f"{before.sequence} of {before.mid_exposure_s:.4f} s",
            )
        names = [shot.frame_id for shot in shots]
        expect(
            len(seen | set(names)) == len(seen) + len(names),
            f"{camera}: two pictures bear one id of {', '.join(names)}",
        )
        seen |= set(names)
    return f"{len(seen)} pictures"


@PICTURES.check("pictures.again", "a picture asked for by its id is the same one, to the last bit and fact")
def _again(daemon: Daemon) -> None:
    camera = daemon.cameras[0]
    _, first = daemon.picture(camera, fresh="true")
    _, again = daemon.picture(camera, frame_id=first.frame_id)
    for key, value in first.facts.items():
        expect(again.facts[key] == value, f"{camera}: {key} was {value!r}, and is {again.facts[key]!r} now")
    expect(np.array_equal(first.image, again.image), f"{camera}: other pixels came for {first.frame_id}")


@PICTURES.check("pictures.ages", "the age of a camera's newest frame is now_s less its mid-exposure")
def _ages(daemon: Daemon) -> None:
    for camera in daemon.cameras:
        for _ in range(5):
            _, shot = daemon.picture(camera, fresh="true")
            status = daemon.status()
            newest = field(status, "cameras", camera)
            if field(newest, "frame_id") == shot.frame_id:
                break
        else:
            raise NotTried(f"{camera}: a newer frame came each time")
        age_s, true_s = number(newest, "age_s"), number(status, "now_s") - shot.mid_exposure_s
        expect(abs(age_s - true_s) < AGE_S, f"{camera}: age_s is {age_s:.4f} s, by its stamp {true_s:.4f} s")


@PICTURES.check("pictures.joints", "at rest a picture bears the measured angles, and says that nothing moved")
def _joints(daemon: Daemon) -> None:
    daemon.rest()
    pan, tilt = daemon.joints()
    camera = daemon.cameras[0]
    _, shot = daemon.picture(camera, fresh="true")
    expect(not shot.moving, f"{camera}: a picture of the head at rest says that it moved")
    off_rad = max(abs(shot.pan_rad - pan), abs(shot.tilt_rad - tilt))
    expect(off_rad <= SAME_RAD, f"{camera}: its angles are {off_rad:.4f} rad from the measured ones")


@PICTURES.check("clicks.unknown", "a click on a frame that never was, or outside the picture, is refused")
def _unknown(daemon: Daemon) -> None:
    camera = daemon.cameras[0]
    _, shot = daemon.picture(camera, fresh="true")
    height, width = shot.image.shape[:2]
    click = {"camera": camera, "frame_id": shot.frame_id, "x_px": width / 2, "y_px": height / 2}
    for changed, statuses, codes in (
        ({"frame_id": "no-such-frame"}, (404,), ("frame_unknown",)),
        ({"frame_id": f"x{shot.frame_id}"}, (404, 409, 422), ("frame_unknown", "wrong_camera")),
        ({"x_px": width + 10.0}, (422,), ("outside_image",)),
        ({"y_px": -10.0}, (422,), ("outside_image",)),
        ({"camera": "no_such_camera"}, (404, 422), ("unknown_camera", "wrong_camera")),
    ):
        daemon.refused(statuses, codes, "POST", "/point", json={"pixel": {**click, **changed}})
    missing = {key: value for key, value in click.items() if key != "frame_id"}
    daemon.refused((422,), ("bad_request",), "POST", "/point", json={"pixel": missing})


@PICTURES.check(
    "clicks.old", "a click on a frame that is no longer kept is refused by name, as is the picture"
)
def _old(daemon: Daemon) -> str:
    camera = daemon.cameras[0]
    _, old = daemon.picture(camera, fresh="true")
    until_s = time.monotonic() + OLD_WITHIN_S
    path = f"/snapshot/{quote(camera)}"
    newer = 0
    while daemon.wire.ask("GET", path, params={"frame_id": old.frame_id}).status == 200:
        if time.monotonic() > until_s:
            raise NotTried(f"the frame is still kept after {newer} newer ones in {OLD_WITHIN_S:g} s")
        for _ in range(KEPT if newer == 0 else 2):
            daemon.picture(camera, fresh="true")
            newer += 1
    daemon.refused((410,), ("frame_too_old",), "GET", path, params={"frame_id": old.frame_id})
    click = {"camera": camera, "frame_id": old.frame_id, "x_px": 10.0, "y_px": 10.0}
    daemon.refused((410,), ("frame_too_old",), "POST", "/point", json={"pixel": click})
    return f"after {newer} newer frames"
