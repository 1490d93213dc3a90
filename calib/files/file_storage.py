"""What OpenCV's FileStorage wrote, read by cv2 itself: YAML, XML and JSON, as plain data.

cv2 refuses some YAML that others write with OpenCV's tags (lists at the margin, comments in lists). Such a
file is read as plain YAML. Two things end the process inside cv2 or never return, so they are refused before:
deep nesting, and matrices in base64 with a broken head.
"""

from __future__ import annotations

import gzip
import io
import re
import zlib
from pathlib import Path
from typing import Any

import cv2

from calib.errors import BadFile
from calib.files.yaml_text import MAX_BYTES, parse_mapping

MAX_DEPTH = 100
LONGEST_LIST = 64
"""Of a longer list only the length is read; no part of a camera is one."""

_XML = re.compile(r"\s*<(?:\?xml|opencv_storage)")
_HEAD = re.compile(r"\A\ufeff?(?:[ \t]*(?:#[^\n]*|%YAML[^\n]*|---[^\n]*)?\n)*")
_MARK = re.compile(rb"\A(?:\s|\xef\xbb\xbf|#[^\n]*\n)*(?:%YAML:|<opencv_storage|<\?xml)|!!opencv-|\"opencv-")
_TAG = re.compile(rb"!!opencv-[a-z-]+")
_BASE64 = re.compile(r"!!binary|\$base64\$|type_id\s*=\s*[\"']?binary")
_NEST = re.compile(r"(?P<open>[\[{]|<(?=[A-Za-z_]))|(?P<close>[\]}]|</)|\n")
_REASON = re.compile(r"error: \(-\d+:[^)]*\) \w+ in function '(.*)\((\d+)\): (.*?)'\s*\Z", re.DOTALL)
_KEY = re.compile(r"^<?([A-Za-z_]\w*)\b(?=\s*:|\s+type_id|>)", re.MULTILINE)


def unzipped(data: bytes, limit_bytes: int, path: str | Path) -> bytes:
    """Return the bytes, a gzip file unpacked. Raises BadFile if it is cut or larger than the limit."""
    if not data.startswith(b"\x1f\x8b"):
        return data
    try:
        with gzip.open(io.BytesIO(data)) as file:
            found = file.read(limit_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise BadFile(path, "", f"is no whole gzip file: {error}") from None
    if len(found) > limit_bytes:
        raise BadFile(path, "", f"unpacks to more than {limit_bytes} bytes, the most that is read")
    return found


def looks_like_storage(data: bytes) -> bool:
    """Return whether the bytes have a mark of OpenCV's FileStorage: its head, a tag, or XML."""
    return _MARK.search(data) is not None


def parse_storage(data: bytes, path: str | Path) -> dict[str, Any]:
    """Return the keys of a FileStorage; of a list longer than ``LONGEST_LIST`` only its length.

    Raises BadFile if cv2 refuses it and it is no plain YAML either: the line, and cv2's reason.
    """
    if len(data) > MAX_BYTES:
        raise BadFile(path, "", f"is larger than {MAX_BYTES} bytes, the most that is read")
    text = data.decode("utf-8-sig", "replace").replace("\r\n", "\n")
    if "\0" in text:
        raise BadFile(
            path, f"line {text[: text.index(chr(0))].count(chr(10)) + 1}", "a NUL, which is no text"
        )
    if (found := _BASE64.search(text)) is not None:
        line = text.count("\n", 0, found.start()) + 1
        raise BadFile(
            path, f"line {line}", "a matrix in base64; write it as text (FileStorage without BASE64)"
        )
    _refuse_deep(text, path)
    is_yaml = not _XML.match(text) and not text.lstrip().startswith("{")
    lines_before = 0
    if is_yaml:
        head = _HEAD.match(text)
        assert head is not None
        lines_before = head[0].count("\n") - 2
        text = "%YAML:1.0\n---\n" + text[head.end() :]
    try:
        # Only a FileStorage that opened may be looked into: cv2 reports the reason as this error's cause.
        storage = cv2.FileStorage(text.lstrip(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        found_keys = {key: _plain(root.getNode(key)) for key in root.keys()}  # noqa: SIM118 - a FileNode
    except (cv2.error, SystemError) as error:
        if is_yaml:
            try:
                return parse_mapping(_TAG.sub(b"", _HEAD.sub("", text).encode()), path)
            except BadFile:
                pass
        raise _refusal(error, lines_before, path) from None
    keys = _KEY.findall(text)
    for key in found_keys:
        if keys.count(key) > 1:
            raise BadFile(path, key, "the key is there twice; cv2 reads the first")
    return found_keys


def _refuse_deep(text: str, path: str | Path) -> None:
    """Refuse nesting at which cv2's recursion would end the process."""
    depth, line = 0, 1
    for found in _NEST.finditer(text):
        if found["open"]:
            depth += 1
        elif found["close"]:
            depth = max(depth - 1, 0)
        else:
            line += 1
        if depth > MAX_DEPTH:
            raise BadFile(path, f"line {line}", f"is nested deeper than {MAX_DEPTH} levels")
    for at, one in enumerate(text.split("\n"), 1):
        if one.count(": ") + one.count("- ") > MAX_DEPTH or len(one) - len(one.lstrip()) > 10 * MAX_DEPTH:
            raise BadFile(path, f"line {at}", f"is nested deeper than {MAX_DEPTH} levels")


def _plain(node: Any) -> Any:
    """Return a node as dict, list, str, int, float or None."""
    if node.isMap():
        return {key: _plain(node.getNode(key)) for key in node.keys()}  # noqa: SIM118 - a FileNode
    if node.isSeq():
        if node.size() > LONGEST_LIST:
            return [None] * node.size()
        return [_plain(node.at(at)) for at in range(node.size())]
    if node.isInt():
        return int(node.real())
    if node.isReal():
        return float(node.real())
    return node.string() if node.isString() else None


def _refusal(error: BaseException, lines_before: int, path: str | Path) -> BadFile:
    reason = str(error.__cause__ or error)
    found = _REASON.search(reason)
    if found is None:
        return BadFile(path, "", "OpenCV's FileStorage cannot read it")
    line = max(int(found[2]) + lines_before, 1)
    return BadFile(path, f"line {line}", f"OpenCV's FileStorage cannot read it: {found[3].strip()}")
