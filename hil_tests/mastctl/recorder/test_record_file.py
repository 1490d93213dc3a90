"""One file: read by the mcap library and by protobuf, cut off at any byte, damaged, repaired."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

from drivers.recordings.mcap_file import BadRecording, McapContents, McapEntry, read_items
from hil_tests.mastctl.recorder.recorder_world import (
    CONFIG,
    Recording,
    files,
    frame,
    mast,
    messages,
    picture,
    reading,
    records,
)  # fmt: skip
from mastctl.recorder.recorded import repair
from mastctl.recorder.writer import RecordFile


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    one = Recording(folder)
    done, data = cv2.imencode(".jpg", picture(3))
    assert done
    one.publish("joints", "pan_tilt", reading(0.25))
    one.publish("frame", "navcam_left", frame(1))
    one.publish("frame", "navcam_left", frame(2, picture(2, (24, 32, 3))))
    one.publish("frame", "navcam_right", frame(3, picture(3), bytes(data), "navcam_right"))
    one.publish("command", "c1", {"what": "point", "who": "somebody"})
    one.recorder.close()
    (path,) = files(folder)
    return path


def small(path: Path) -> None:
    """A file of three chunks with nothing but numbers in it."""
    file = RecordFile(path, [CONFIG], {"hardware": "simulated"}, 0.0, 10**18)
    for number in range(30):
        file.add_json("/command", {"number": number}, 0.1 * number)
        if number % 10 == 9:
            file.flush()
    file.finish()


def numbers(path: Path, found: McapContents | None = None) -> list[int]:
    items = read_items(path, found)
    return [json.loads(item.message.data)["number"] for item in items if isinstance(item, McapEntry)]


def test_mast_file_and_configuration_stand_at_the_start_with_their_digests(recorded: Path) -> None:
    with recorded.open("rb") as file:
        reader = make_reader(file)
        (facts,) = [one.metadata for one in reader.iter_metadata()]
        attached = {one.name: bytes(one.data) for one in reader.iter_attachments()}
    known = mast().file
    assert attached == {known.name: known.data, CONFIG.name: CONFIG.data}
    for name, data in attached.items():
        assert facts[f"sha256 {name}"] == hashlib.sha256(data).hexdigest()
    first = recorded.read_bytes()[: 2000 + len(known.data) + len(CONFIG.data)]
    assert known.data in first and CONFIG.data in first


def test_a_foreign_reader_decodes_every_message_by_the_schema_in_the_file(recorded: Path) -> None:
    seen = set()
    for schema, channel, message in messages(recorded):
        seen.add(schema.name)
        if channel.message_encoding == "json":
            assert schema.encoding == "jsonschema" and json.loads(schema.data)["type"] == "object"
            assert isinstance(json.loads(message.data), dict)
            continue
        pool = descriptor_pool.DescriptorPool()
        for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
            pool.Add(one)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
        decoded = kind.FromString(message.data)
        assert decoded.SerializeToString() == message.data and decoded.ByteSize() > 0
    assert {"foxglove.RawImage", "foxglove.CompressedImage", "foxglove.CameraCalibration"} <= seen
    assert {"foxglove.FrameTransforms", "mastctl.frame", "mastctl.joints", "mastctl.cahvor"} <= seen


def test_pixels_come_back_to_the_last_bit_and_jpeg_byte_for_byte(recorded: Path) -> None:
    grey, colour = [
        RawImage.FromString(m.data) for _, _, m in messages(recorded, "/camera/navcam_left/image")
    ]
    assert (grey.encoding, grey.width, grey.height, grey.step) == ("mono8", 32, 24, 32)
    assert np.array_equal(np.frombuffer(grey.data, np.uint8).reshape(24, 32), picture(1))
    assert (colour.encoding, colour.step) == ("bgr8", 96)
    assert np.array_equal(np.frombuffer(colour.data, np.uint8).reshape(24, 32, 3), picture(2, (24, 32, 3)))
    ((_, _, last),) = messages(recorded, "/camera/navcam_right/image")
    jpeg = CompressedImage.FromString(last.data)
    assert jpeg.format == "jpeg"
    assert jpeg.data == bytes(cv2.imencode(".jpg", picture(3))[1])
    assert [one["frame_id"] for one in records(recorded, "/camera/navcam_right/frame")] == [
        frame(3, camera="navcam_right").frame_id
    ]


def test_the_tree_of_frames_puts_a_point_where_the_mast_file_sees_it(recorded: Path) -> None:
    rig = mast().rig
    (_, _, message), *_ = messages(recorded, "/tf")
    rover_from = {"rover": (np.eye(3), np.zeros(3))}
    for one in FrameTransforms.FromString(message.data).transforms:
        q, t = one.rotation, one.translation
        x, y, z, w = q.x, q.y, q.z, q.w
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        above, moved = rover_from[one.parent_frame_id]
        rover_from[one.child_frame_id] = above @ turn, above @ np.array([t.x, t.y, t.z]) + moved
    ((_, _, calibration),) = messages(recorded, "/camera/navcam_left/calibration")
    camera = CameraCalibration.FromString(calibration.data)
    turn, place = rover_from["navcam_left"]
    model = rig.camera_in_rover("navcam_left", 0.25, 0.0)
    for pixel in ([511.5, 383.5], [100.0, 700.0], [900.0, 50.0], [0.0, 0.0], [1023.0, 767.0]):
        ray = model.ray(np.array(pixel))
        point = ray.origins_m + 1e5 * ray.directions
        inside = turn.T @ (point - place)
        seen, _ = cv2.projectPoints(
            inside[None], np.zeros(3), np.zeros(3), np.array(camera.K).reshape(3, 3), np.array(camera.D)
        )
        assert np.linalg.norm(seen.ravel() - pixel) < 0.2  # the plumb_bob itself is 0.19 px off at worst


@pytest.mark.parametrize("seed", range(3))
def test_cut_off_at_any_byte_it_keeps_the_chunks_before_for_repair(tmp_path: Path, seed: int) -> None:
    whole = tmp_path / "whole.mcap"
    small(whole)
    data = whole.read_bytes()
    chance = np.random.default_rng(seed)
    counts = set()
    for length in sorted({0, 5, 9, *chance.integers(9, len(data), 40).tolist(), len(data) - 1}):
        cut = tmp_path / f"{length}.mcap"
        cut.write_bytes(data[:length] + b"\0" * int(chance.integers(0, 3) if length > 8 else 0))
        found = McapContents()
        there = numbers(cut, found)
        assert there == list(range(len(there))) and len(there) % 10 == 0, f"seed {seed}, {length} bytes"
        assert not found.complete and not found.damaged
        counts.add(len(there))
        out = tmp_path / f"{length}-whole.mcap"
        assert repair([cut], out)["messages"] == len(there)
        assert [one["number"] for one in records(out, "/command")] == there
    assert counts == {0, 10, 20, 30}


def test_a_chunk_that_was_damaged_is_passed_over_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "damaged.mcap"
    small(path)
    data = bytearray(path.read_bytes())
    second = [i for i in range(len(data)) if data[i : i + 4] == b"zstd"][1]
    data[second + 20] ^= 0xFF
    path.write_bytes(data)
    found = McapContents()
    assert numbers(path, found) == [*range(10), *range(20, 30)]
    assert found.damaged == 1
    repaired = repair([path], tmp_path / "out.mcap")
    assert (repaired["messages"], repaired["damaged"]) == (20, 1)


def test_segments_become_one_file_with_each_attached_file_once(tmp_path: Path) -> None:
    parts = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for part in parts:
        small(part)
    out = tmp_path / "both.mcap"
    assert repair(parts, out)["messages"] == 60
    with out.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [one.name for one in reader.iter_attachments()] == [CONFIG.name]
        summary = reader.get_summary()
        assert summary is not None and len(summary.channels) == 1 and len(summary.schemas) == 1


def test_what_is_no_recording_is_refused_in_a_sentence(tmp_path: Path) -> None:
    text = tmp_path / "a.mcap"
    text.write_text("no recording")
    with pytest.raises(BadRecording, match=r"a\.mcap: is no MCAP file"):
        numbers(text)
    with pytest.raises(BadRecording, match="cannot be read: No such file"):
        numbers(tmp_path / "none.mcap")
    small(tmp_path / "b.mcap")
    with pytest.raises(BadRecording, match=r"b\.mcap: is there already"):
        repair([tmp_path / "b.mcap"], tmp_path / "b.mcap")
    with pytest.raises(BadRecording, match="is no MCAP file"):
        repair([text], tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
