"""Measure the V4L2 cameras: gaps, the age of frames, processor time beside OpenCV, memory, descriptors.

    tools/vm run --timeout 3000 .venv/bin/python -m tools.benchmarks.camera
    tools/vm run --cameras three .venv/bin/python -m tools.benchmarks.camera --only gaps --hdmi-rate 40
    .venv/bin/python -m tools.benchmarks.camera --device /dev/v4l/by-id/...   (once to three times)

Without --device the cameras that are connected are taken, three at most; in the virtual machine these are
vivid's. Two are ours; a third one is read by v4l2-ctl at the same time, for what the computer itself loses.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2

from drivers.errors import DriverError
from drivers.v4l2 import find
from drivers.v4l2.camera import V4l2Camera, open_camera
from drivers.v4l2.controls import set_by_name
from drivers.v4l2.find import open_node, options_for
from drivers.v4l2.options import CameraOptions, parse_options
from drivers.v4l2.stream import set_format
from mastctl.cli.output import at_least, positive_number
from tools.command import end

PARTS = ("gaps", "age", "cpu", "memory", "unplugged", "opens")
CONSUMERS = ("sleeps", "computes", "is stopped for 2 s")
STOPPED_S = 2.0
SLICE_FRAMES = 3
WARM_S = 2.0  # so long the first touch of every buffer costs more than its frame
VIVID = Path("/sys/bus/platform/drivers/vivid")
VIVID_CONTROLS = {"timestamp_source": 1, "osd_text_mode": 2}


def main() -> None:
    """Print the tables, and with --json one document."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--device", action="append", default=[], help="link, card or bus; give two for stereo"
    )
    parser.add_argument("--size", nargs=2, type=at_least(1), default=[640, 480], metavar=("W", "H"))
    parser.add_argument(
        "--rate", type=positive_number, metavar="HZ", help="default: the highest the camera has"
    )
    parser.add_argument("--format", metavar="CODE", help="default: YUYV where the camera has it")
    parser.add_argument(
        "--hdmi-rate", type=positive_number, metavar="HZ", help="first set HDMI inputs to --size and this"
    )
    parser.add_argument(
        "--seconds", type=positive_number, default=60.0, help="of each of the three runs for gaps"
    )
    parser.add_argument("--pauses", type=at_least(1), default=30, help="for the age of frames")
    parser.add_argument("--repeats", type=at_least(1), default=3, help="of the processor time")
    parser.add_argument("--frames", type=at_least(1), default=100_000, help="for the memory")
    parser.add_argument("--opens", type=at_least(1), default=1000, help="for the descriptors")
    parser.add_argument("--unplugs", type=at_least(1), default=10, help="vivid only, as root")
    parser.add_argument(
        "--only", choices=PARTS, nargs="+", default=list(PARTS), metavar="PART", help=", ".join(PARTS)
    )
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    devices = args.device or [camera.bus for camera in find.list_cameras()[:3]]
    if not devices:
        sys.exit("no camera is connected")
    if args.hdmi_rate:
        for device in devices:
            set_timings(device, args.size, args.hdmi_rate)
    options = [chosen(device, tuple(args.size), args.rate, args.format) for device in devices]
    options, beside = options[:2], options[2:]
    say = (lambda *words: None) if args.json else print
    say(
        f"{len(options)} cameras, {args.size} px, {options[0]['rate_hz']:g} Hz, load {os.getloadavg()[0]:.1f}"
    )
    told: dict[str, Any] = {"rate_hz": options[0]["rate_hz"], "size_px": args.size, "cameras": len(options)}
    if "gaps" in args.only:
        told["gaps"] = [gaps(options, beside, what, args.seconds, say) for what in CONSUMERS]
        told["opencv_gaps"] = opencv_gaps(options[0], args.seconds, say)
    if "age" in args.only:
        told["age"] = age_after_pause(options[0], args.pauses, say)
    if "cpu" in args.only:
        told["cpu"] = [cpu_per_frame(options[0], say) for _ in range(args.repeats)]
    if "memory" in args.only:
        told["memory"] = memory(options, args.frames, say)
    if "unplugged" in args.only and VIVID.exists():
        told["unplugged"] = unplugged(options, args.unplugs, say)
    if "opens" in args.only:
        told["opens"] = descriptors(options[0], args.opens, say)
    if args.json:
        print(json.dumps(told))


def chosen(
    device: str, size_px: tuple[int, int], rate_hz: float | None, code: str | None = None
) -> dict[str, Any]:
    """Options for a device at YUYV if it has that, at its highest rate unless others are given."""
    options = options_for(device, code, size_px, rate_hz, {})
    with open_node(parse_options(options, device).address, device) as node:
        if code is None and "YUYV" in node.formats():
            options["format"] = "YUYV"
        if node.identity.driver == "vivid":
            options["controls"] = dict(VIVID_CONTROLS)
        if rate_hz is None:
            options["rate_hz"] = max(node.rates_hz(options["format"], size_px), default=30.0)
    return options


def set_timings(device: str, size_px: list[int], rate_hz: float) -> None:
    """Make an HDMI input expect a signal of this size and rate (VESA CVT)."""
    path = node_path(parse_options(options_for(device, None, tuple(size_px), None, {}), device))
    signal_words = f"cvt,width={size_px[0]},height={size_px[1]},fps={rate_hz:g}"
    subprocess.run(
        ["v4l2-ctl", "-d", path, "--set-dv-bt-timings", signal_words], check=True, capture_output=True
    )


def node_path(options: CameraOptions) -> str:
    """The node of a camera, for programs that want that."""
    with open_node(options.address, "node") as node:
        return str(node.path)


@contextmanager
def opened(options: list[dict[str, Any]]) -> Iterator[list[V4l2Camera]]:
    """All cameras, each with a first frame."""
    with ExitStack() as stack:
        cameras = [
            stack.enter_context(closing(open_camera(o, name=f"camera {i}"))) for i, o in enumerate(options)
        ]
        for camera in cameras:
            camera.next_frame(time.monotonic(), 10.0)
        yield cameras


def gaps(
    options: list[dict[str, Any]],
    beside: list[dict[str, Any]],
    what: str,
    seconds: float,
    say: Callable[..., None],
) -> dict[str, Any]:
    """Drops while the consumer does something else than take frames; and those of v4l2-ctl beside."""
    reads = "import sys\nwhile sys.stdin.buffer.read(65536): pass"
    with (
        subprocess.Popen([sys.executable, "-c", reads], stdin=subprocess.PIPE) as consumer,
        opened(options) as cameras,
        other_reader(beside, seconds + 2) as other,
    ):
        over = threading.Event()
        full = [0 for _ in cameras]
        helpers = [threading.Thread(target=watch, args=(cameras, over, full))]
        if what.startswith("is stopped"):
            helpers.append(threading.Thread(target=stop_and_go, args=(consumer, over)))
        for helper in helpers:
            helper.start()
        before = [camera.counters for camera in cameras]
        began_s = time.monotonic()
        until_s = began_s + seconds
        while time.monotonic() < until_s:
            after_s = time.monotonic()
            for camera in cameras:
                camera.next_frame(after_s, 10.0)
            if what == "sleeps":
                time.sleep(0.7)
            elif what == "computes":
                busy_until_s = time.monotonic() + 0.7
                while time.monotonic() < busy_until_s:
                    sum(i * i for i in range(20_000))  # Python's lock held nearly all the time
            else:
                hand_over(consumer, cameras)
        span_s = time.monotonic() - began_s
        counted = [camera.counters for camera in cameras]
        over.set()
        for helper in helpers:
            helper.join()
    row = {
        "consumer": what,
        "seconds": span_s,
        "frames": [now.good - then.good for now, then in zip(counted, before, strict=True)],
        "dropped": [now.dropped - then.dropped for now, then in zip(counted, before, strict=True)],
        "damaged": [now.damaged - then.damaged for now, then in zip(counted, before, strict=True)],
        "late": [now.late - then.late for now, then in zip(counted, before, strict=True)],
        "buffers_full": full,
        "v4l2-ctl": other,
    }
    rates = ", ".join(f"{frames / span_s:.2f}" for frames in row["frames"])
    say(
        f"consumer {what}: {rates} Hz over {span_s:.0f} s, "
        f"missed {row['dropped']}, of these for want of a buffer {full}, "
        f"damaged {row['damaged']}, late {row['late']}"
        + "".join(f"; v4l2-ctl beside missed {their['missed']} of {their['frames']}" for their in other)
    )
    return row


def opencv_gaps(options: dict[str, Any], seconds: float, say: Callable[..., None]) -> dict[str, Any]:
    """Frames that OpenCV misses while it does nothing but read: what the machine loses by itself."""
    with opencv(options) as reader:
        until_s, stamps_s = time.monotonic() + seconds, []
        while time.monotonic() < until_s:
            reader.grab()
            stamps_s.append(reader.get(cv2.CAP_PROP_POS_MSEC) / 1e3)
    period_s = 1 / options["rate_hz"]
    missed = sum(round((b - a) / period_s) - 1 for a, b in pairwise(stamps_s))
    say(f"OpenCV that only reads: {len(stamps_s)} frames in {seconds:.0f} s, missed {missed}")
    return {"frames": len(stamps_s), "missed": missed}


def watch(cameras: list[V4l2Camera], over: threading.Event, full: list[int]) -> None:
    """Count the missing frames for which the driver had no buffer, because none had come back from us.

    These are the missing ones that were due while all others, but for the one that we hold and one to spare,
    lay filled and not taken. For any other missing frame the driver had a buffer and did not fill it.
    """
    last = [-1 for _ in cameras]
    ended = False
    while not ended:
        ended = over.wait(0.2)
        for index, camera in enumerate(cameras):
            frames = camera.capture.newest.recent()
            for before, frame in pairwise(frames):
                missed = frame.sequence - before.sequence - 1
                if frame.sequence > last[index] >= 0 and missed:
                    due_s = before.buffer.stamp_s + camera.period_s
                    lying = sum(f.sequence <= before.sequence and f.received_s > due_s for f in frames)
                    full[index] += missed if lying >= CameraOptions.buffers - 2 else 0
            last[index] = frames[-1].sequence if frames else last[index]


@contextmanager
def other_reader(beside: list[dict[str, Any]], seconds: float) -> Iterator[list[dict[str, Any]]]:
    """v4l2-ctl, written in C, reads another camera meanwhile; afterwards the list says what it missed."""
    found: list[dict[str, Any]] = []
    with ExitStack() as stack:
        running = []
        for options in beside if shutil.which("v4l2-ctl") else []:
            with open_node(parse_options(options, "beside").address, "beside") as node:
                path = str(node.path)
                set_format(node, options["format"], tuple(options["size_px"]), "beside")
                node.set_rate(options["rate_hz"])
            count = round(seconds * options["rate_hz"])
            command = [
                "v4l2-ctl",
                "-d",
                path,
                "--verbose",
                f"--stream-mmap={CameraOptions.buffers}",
                f"--stream-count={count}",
            ]
            told = stack.enter_context(tempfile.TemporaryFile("w+"))  # a full pipe would hold it up
            reader = subprocess.Popen(command, stdout=told, stderr=told)
            running.append((stack.enter_context(reader), told))
        if running:
            time.sleep(1.0)  # so that it reads already when we begin to count
        yield found
        for reader, told in running:
            reader.wait()
            told.seek(0)
            dropped = re.findall(r"cap dqbuf:.*?(?: dropped: (\d+))?(?: \(.*)?\n", told.read())
            found.append({"frames": len(dropped), "missed": sum(int(number or 0) for number in dropped)})


def stop_and_go(consumer: subprocess.Popen[bytes], over: threading.Event) -> None:
    """Stop a process for two seconds, again and again."""
    while not over.wait(0.5):
        consumer.send_signal(signal.SIGSTOP)
        over.wait(STOPPED_S)
        consumer.send_signal(signal.SIGCONT)


def hand_over(consumer: subprocess.Popen[bytes], cameras: list[V4l2Camera]) -> None:
    """Hand frames to another process; while it is stopped this hangs, since a pipe does not hold a frame."""
    assert consumer.stdin is not None
    for camera in cameras:
        consumer.stdin.write(camera.next_frame(time.monotonic(), 10.0).image.tobytes())


def age_after_pause(options: dict[str, Any], pauses: int, say: Callable[..., None]) -> dict[str, Any]:
    """How old a frame is when it is returned after a pause of a second: stamp to return.

    A frame beyond the bound is old either because a newer one was there and had not been taken from the
    kernel, or because the driver had made none: then nobody could have returned a newer one.
    """
    ages: dict[str, list[float]] = {"next_frame": [], "next_frame, exposed after the call": [], "OpenCV": []}
    bound_s = 1 / options["rate_hz"] + 0.005
    kept_back = 0
    with opened([options]) as (camera,):
        for _ in range(pauses):
            time.sleep(1.0)
            frame = camera.next_frame(0.0, 10.0)
            returned_s = time.monotonic()
            ages["next_frame"].append(returned_s - frame.stamp_s)
            frame_after = camera.next_frame(time.monotonic(), 10.0)
            ages["next_frame, exposed after the call"].append(time.monotonic() - frame_after.stamp_s)
            if ages["next_frame"][-1] > bound_s:
                stamps_s = [arrived.buffer.stamp_s for arrived in camera.capture.newest.recent()]
                kept_back += any(frame.stamp_s < stamp_s < returned_s - 0.005 for stamp_s in stamps_s)
    with opencv(options) as reader:
        for _ in range(min(pauses, 10)):
            time.sleep(1.0)
            reader.read()
            ages["OpenCV"].append(time.monotonic() - reader.get(cv2.CAP_PROP_POS_MSEC) / 1e3)
    table: dict[str, Any] = {}
    for who, values in ages.items():
        table[who] = {"median_s": statistics.median(values), "most_s": max(values)}
        say(
            f"age after a pause, {who}: "
            f"median {1e3 * table[who]['median_s']:.1f} ms, most {1e3 * max(values):.1f} ms"
        )
    beyond = sum(age_s > bound_s for age_s in ages["next_frame"])
    table |= {"bound_s": bound_s, "beyond": beyond, "beyond_and_kept_back": kept_back}
    say(
        f"  bound (a period and 5 ms): {1e3 * bound_s:.1f} ms; beyond it {beyond} of {pauses}, "
        f"and in {kept_back} of these the driver had made a newer frame"
    )
    return table


def cpu_per_frame(options: dict[str, Any], say: Callable[..., None], slices: int = 50) -> dict[str, float]:
    """Processor time of this process for each frame, of the quiet slices: a busy machine disturbs most.

    OpenCV gives BGR only; for grey its picture is converted, as its users do.
    """
    table = {}
    for who, colour in (("ours, grey", False), ("ours, BGR", True)):
        with opened([{**options, "colour": colour}]) as (camera,):
            newest_s = [0.0]

            def take(camera: V4l2Camera = camera, newest_s: list[float] = newest_s) -> int:
                frame = camera.next_frame(newest_s[0], 10.0)
                newest_s[0] = frame.mid_exposure_s
                return frame.sequence

            table[who] = per_frame(take, slices)
    with opened([options]) as (camera,):

        def sleep(camera: V4l2Camera = camera) -> int:
            time.sleep(SLICE_FRAMES / options["rate_hz"])
            return camera.counters.good

        table["ours, nobody asks"] = per_frame(sleep, slices, 1)
    with opencv(options) as reader:
        table["OpenCV, BGR"] = per_frame(reader.read, slices)
        table["OpenCV, grey"] = per_frame(
            lambda: cv2.cvtColor(reader.read()[1], cv2.COLOR_BGR2GRAY).shape, slices
        )
        table["OpenCV, grab alone"] = per_frame(reader.grab, slices)
    for who, cpu_s in table.items():
        ratio = cpu_s / table[f"OpenCV, {'grey' if who.endswith('grey') else 'BGR'}"]
        say(f"processor time a frame, {who}: {1e3 * cpu_s:.2f} ms ({ratio:.2f} of OpenCV)")
    return table


def per_frame(take: Callable[[], Any], slices: int, steps: int = SLICE_FRAMES) -> float:
    """Processor time for a frame, in the quietest tenth of slices; ``take`` takes one or counts them."""
    warm_until_s = time.monotonic() + WARM_S
    while time.monotonic() < warm_until_s:
        count = take()
    found = []
    for _ in range(slices):
        began_s, first = time.process_time(), count
        for _ in range(steps):
            count = take()
        frames = count - first if isinstance(count, int) and not isinstance(count, bool) else steps
        found.append((time.process_time() - began_s) / max(frames, 1))
    return statistics.quantiles(found, n=10)[0]


@contextmanager
def opencv(options: dict[str, Any]) -> Iterator[cv2.VideoCapture]:
    """The same camera at the same settings, read by OpenCV."""
    with open_node(parse_options(options, "opencv").address, "opencv") as node:
        path = str(node.path)
        set_by_name(node, options["controls"])
    reader = cv2.VideoCapture(path, cv2.CAP_V4L2)
    width, height = options["size_px"]
    reader.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*options["format"].ljust(4)))
    reader.set(cv2.CAP_PROP_FRAME_WIDTH, width)
    reader.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    reader.set(cv2.CAP_PROP_FPS, options["rate_hz"])
    try:
        yield reader
    finally:
        reader.release()


def memory(options: list[dict[str, Any]], frames: int, say: Callable[..., None]) -> dict[str, Any]:
    """Resident memory over many frames, every one converted; sampled twenty times."""
    samples = []
    with opened(options) as cameras:
        taken = [0] * len(cameras)

        def take(index: int) -> None:
            after_s = 0.0
            while sum(taken) < frames:
                frame = cameras[index].next_frame(after_s, 10.0)
                after_s = frame.mid_exposure_s
                taken[index] += 1

        threads = [threading.Thread(target=take, args=(i,)) for i in range(len(cameras))]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            if sum(taken) >= frames * (len(samples) + 1) / 20:
                samples.append(resident_bytes())
            time.sleep(0.05)
    growth = samples[-1] - samples[len(samples) // 4] if samples else 0
    say(
        f"memory: {sum(taken)} frames, {[round(s / 2**20, 1) for s in samples]} MB; "
        f"grew by {growth / 2**20:.2f} MB over the last three quarters"
    )
    return {"frames": sum(taken), "samples_bytes": samples, "growth_bytes": growth}


def resident_bytes() -> int:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def unplugged(options: list[dict[str, Any]], times: int, say: Callable[..., None]) -> dict[str, Any]:
    """From the driver letting the camera go until it is known, and from its return to a frame."""
    noticed_s, back_s = [], []
    with opened(options) as cameras:
        camera = cameras[0]
        for _ in range(times):
            began_s = time.monotonic()
            unbind = threading.Thread(target=(VIVID / "unbind").write_text, args=("vivid.0",))
            unbind.start()
            while not camera.capture.lost:
                time.sleep(0.0005)
            noticed_s.append(time.monotonic() - began_s)
            unbind.join()
            time.sleep(0.5)
            (VIVID / "bind").write_text("vivid.0")
            began_s = time.monotonic()
            while camera.capture.lost:
                time.sleep(0.0005)
            camera.next_frame(time.monotonic(), 10.0)
            back_s.append(time.monotonic() - began_s)
            for other in cameras:
                while other.capture.lost:
                    time.sleep(0.01)
    period_s = 1 / options[0]["rate_hz"]
    say(
        f"unplugged {times} times: noticed after at most {1e3 * max(noticed_s):.0f} ms "
        f"({max(noticed_s) / period_s:.1f} periods), frames at most {1e3 * max(back_s):.0f} ms after return"
    )
    return {"noticed_s": noticed_s, "back_s": back_s, "period_s": period_s}


def descriptors(options: dict[str, Any], opens: int, say: Callable[..., None]) -> dict[str, Any]:
    """Descriptors, threads, mappings left after many opens; with vivid a third of them fail."""
    address = parse_options(options, "opens").address
    with open_node(address, "opens") as node:
        is_vivid = node.identity.driver == "vivid"

    def held() -> tuple[int, int, int]:
        maps = Path("/proc/self/maps").read_text().count("/dev/video")
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count(), maps

    open_camera(options, name="opens").close()
    before, refused = held(), 0
    for index in range(opens):
        if is_vivid and index % 3 == 1:
            control = (
                "inject_vidioc_reqbufs_error",
                "inject_vidioc_streamon_error",
                "inject_vidioc_qbuf_error",
            )
            with open_node(address, "opens") as node:
                set_by_name(node, {control[index // 3 % 3]: 1})
        try:
            open_camera(options, name="opens").close()
        except DriverError:
            refused += 1
    after = held()
    say(
        f"{opens} opens, {refused} of them refused: "
        f"descriptors, threads, mappings {before} before, {after} after"
    )
    return {"opens": opens, "refused": refused, "before": before, "after": after}


if __name__ == "__main__":
    end(main)
