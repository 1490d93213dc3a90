"""A GigE Vision camera in memory: what Aravis's own fake lacks. Aravis itself judges every packet of it.

It has a clock of its own that can be read and set, chunk data, an input line, packets that can be lost and a
plug that can be pulled. Registers and packets are those of the GigE Vision standard, features GenICam's SFNC.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

GVCP_PORT = 3956
XML_AT = 0x10000
TICKS_HZ = 125_000_000  # 8 ns, as many cameras have
MONO8 = 0x01080001
CHUNK_IDS = {0: 0x1001, 1: 0x1002}  # by ChunkSelector
CCP, PORT, PACKET, DESTINATION = 0xA00, 0xD00, 0xD04, 0xD18
LATCH, LATCHED = 0x944, 0x948
(
    WIDTH, HEIGHT, FORMAT, RUNS, MODE, SELECTOR, TRIGGERED, SOURCE, SOFTWARE, CHUNKS, CHUNK_SELECTOR,
    CHUNK_ON, PAYLOAD, OFFSET_X, OFFSET_Y, FOCUS, WHITE, GAIN_AUTO, SENSOR_WIDTH, SENSOR_HEIGHT, BIN_X, BIN_Y,
    REVERSE_X, REVERSE_Y,
) = range(0x2000, 0x2000 + 24 * 4, 4)  # fmt: skip
EXPOSURE, RATE, GAIN = 0x3000, 0x3008, 0x3010
EXPOSURE_STEP_US = 20.0
WRITE_PROTECTED = 0x8005

_INTEGERS = {
    "Width": (WIDTH, 16, 2048), "Height": (HEIGHT, 16, 2048), "OffsetX": (OFFSET_X, 0, 2048),
    "OffsetY": (OFFSET_Y, 0, 2048), "PayloadSize": (PAYLOAD, 0, 2**31),
    "GevTimestampTickFrequency": (0x940, 0, 2**31),
}  # fmt: skip
_CHOICES = {
    "PixelFormat": (FORMAT, {"Mono8": MONO8}),
    "AcquisitionMode": (MODE, {"Continuous": 0}),
    "TriggerSelector": (SELECTOR, {"FrameStart": 0}),
    "TriggerMode": (TRIGGERED, {"Off": 0, "On": 1}),
    "TriggerSource": (SOURCE, {"Software": 0, "Line1": 1}),
    "ChunkSelector": (CHUNK_SELECTOR, {"ExposureTime": 0, "Gain": 1}),
}
_MORE_INTEGERS = {
    "Focus": (FOCUS, 0, 1023), "BalanceWhiteTemperature": (WHITE, 2500, 10000),
    "SensorWidth": (SENSOR_WIDTH, 1, 4096), "SensorHeight": (SENSOR_HEIGHT, 1, 4096),
    "BinningHorizontal": (BIN_X, 1, 4), "BinningVertical": (BIN_Y, 1, 4),
}  # fmt: skip
_MORE_FLAGS = {"ReverseX": REVERSE_X, "ReverseY": REVERSE_Y}
_MORE_CHOICES = {"GainAuto": (GAIN_AUTO, {"Off": 0, "Continuous": 1})}
_COMMANDS = {
    "AcquisitionStart": (RUNS, 1), "AcquisitionStop": (RUNS, 0), "TriggerSoftware": (SOFTWARE, 1),
    "GevTimestampControlLatch": (LATCH, 2),
}  # fmt: skip


def _register(kind: str, name: str, address: int, length: int, port: str = "Device", more: str = "") -> str:
    sign = "<Sign>Unsigned</Sign>" if kind == "IntReg" else ""
    return (
        f'<{kind} Name="{name}"><Address>0x{address:x}</Address><Length>{length}</Length>'
        f"<AccessMode>RW</AccessMode><pPort>{port}</pPort>{sign}<Endianess>BigEndian</Endianess>{more}</{kind}>"
    )


def _genicam(clock_readable: bool, more: bool) -> bytes:
    """The description of the features, in GenICam's XML."""
    integers, choices = (
        ({**_INTEGERS, **_MORE_INTEGERS}, {**_CHOICES, **_MORE_CHOICES}) if more else (_INTEGERS, _CHOICES)
    )
    floats = [("ExposureTime", EXPOSURE, 1e6), ("AcquisitionFrameRate", RATE, 200.0)]
    floats += [("Gain", GAIN, 24.0)] * more
    words, names = [], [*integers, *choices, *(name for name, _, _ in floats), "ChunkModeActive"]
    for name, (address, low, high) in integers.items():
        words.append(
            f'<Integer Name="{name}"><pValue>{name}Reg</pValue><Min>{low}</Min><Max>{high}</Max></Integer>'
        )
        words.append(_register("IntReg", f"{name}Reg", address, 4))
    for name, (address, entries) in choices.items():
        inside = "".join(
            f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>'
            for entry, value in entries.items()
        )
        words.append(f'<Enumeration Name="{name}">{inside}<pValue>{name}Reg</pValue></Enumeration>')
        words.append(_register("IntReg", f"{name}Reg", address, 4))
    for name, (address, value) in _COMMANDS.items():
        if name.startswith("GevTimestamp") and not clock_readable:
            continue
        words.append(
            f'<Command Name="{name}"><pValue>{name}Reg</pValue><CommandValue>{value}</CommandValue></Command>'
        )
        words.append(_register("IntReg", f"{name}Reg", address, 4))
        names.append(name)
    if clock_readable:
        words.append(_register("IntReg", "GevTimestampValue", LATCHED, 8))
        names.append("GevTimestampValue")
    for name, address, most in floats:
        words.append(
            f'<Float Name="{name}"><pValue>{name}Reg</pValue><Min>0.1</Min><Max>{most}</Max></Float>'
        )
        words.append(_register("FloatReg", f"{name}Reg", address, 8))
    flags = {"ChunkModeActive": CHUNKS, "ChunkEnable": CHUNK_ON} | (_MORE_FLAGS if more else {})
    names += _MORE_FLAGS if more else ()
    for name, address in flags.items():
        on = "<OnValue>1</OnValue><OffValue>0</OffValue>"
        words.append(f'<Boolean Name="{name}"><pValue>{name}Reg</pValue>{on}</Boolean>')
        words.append(_register("IntReg", f"{name}Reg", address, 4))
    for name, number in zip(("ExposureTime", "Gain"), CHUNK_IDS.values(), strict=True):
        words.append(_register("FloatReg", f"Chunk{name}", 0, 8, f"{name}Port"))
        words.append(f'<Port Name="{name}Port"><ChunkID>{number:x}</ChunkID></Port>')
    words.append('<Port Name="Device"/>')
    listed = "".join(f"<pFeature>{name}</pFeature>" for name in names)
    return (
        '<?xml version="1.0" encoding="utf-8"?><RegisterDescription ModelName="Memory" VendorName="mastctl" '
        'StandardNameSpace="None" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" '
        'MajorVersion="1" MinorVersion="0" SubMinorVersion="0" ProductGuid="0" VersionGuid="0" '
        'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
        f'<Category Name="Root">{listed}</Category>{"".join(words)}</RegisterDescription>'
    ).encode()


class GigeCamera:
    """One camera at an address of the loopback, from construction until `unplug`.

    Parameters
    ----------
    address
        Of the loopback; Aravis opens it by this address (the search goes to other places).
    clock_readable
        Whether the clock can be latched.
    clock_ahead_s
        How far the camera's clock is ahead of CLOCK_MONOTONIC; may be set anew at any time.
    more
        Whether it has gain with an automatic, white balance, focus, binning and flips beside its exposure
        time, and tells its sensor of 256x192 px.
    behind
        So many frames are exposed with the former settings after others were written.
    refuses
        Registers that it refuses to have written.
    sends_us
        The exposure time of the chunk data where it is to be another than the true one.
    delay_s
        From the middle of a frame's exposure to its first packet, beside half the exposure.
    """

    def __init__(
        self, address: str, *, clock_readable: bool = True, clock_ahead_s: float = 0.0, more: bool = False
    ) -> None:
        self.clock_ahead_s = clock_ahead_s
        self.delay_s = 0.001
        self.lose: Callable[[int, int], bool] = lambda frame, packet: False
        self.exposed_s: list[tuple[float, float]] = []  # begin and end by CLOCK_MONOTONIC, of every frame
        self.gains: list[float] = []  # of every frame
        self.behind = 0
        self.sends_us: float | None = None
        self.refuses: set[int] = set()
        self._chunks_on: dict[int, int] = {}
        self._written_settings: list[tuple[float, float]] = []  # exposure time and gain, not yet in force
        self.frames = 0
        self._memory = bytearray(XML_AT)
        xml = _genicam(clock_readable, more)
        for at, text in (
            (0x48, "mastctl"),
            (0x68, "Memory"),
            (0x88, "1"),
            (0xD8, f"M{address.split('.')[-1]}"),
        ):
            self._memory[at : at + len(text)] = text.encode()
        url = f"Local:camera.xml;{XML_AT:x};{len(xml):x}"
        self._memory[0x200 : 0x200 + len(url)] = url.encode()
        self._memory += xml + bytes(512)
        started = {
            0x0: 0x00010002, 0x24: struct.unpack(">I", socket.inet_aton(address))[0], 0x600: 1, 0x904: 1,
            0x934: 0x6, 0x938: 3000, 0x940: TICKS_HZ, WIDTH: 64, HEIGHT: 48, FORMAT: MONO8, PACKET: 1400,
            FOCUS: 40, WHITE: 5000, GAIN_AUTO: 1, SENSOR_WIDTH: 256, SENSOR_HEIGHT: 192, BIN_X: 1, BIN_Y: 1,
        }  # fmt: skip
        for at, value in started.items():
            self._set(at, value)
        self.set_float(EXPOSURE, 10_000.0)
        self.set_float(RATE, 50.0)
        self._over = threading.Event()
        self._exposing = threading.Lock()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((address, GVCP_PORT))
        self._socket.settimeout(0.05)
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._out.bind((address, 0))
        self._threads = [threading.Thread(target=one, daemon=True) for one in (self._obey, self._run)]
        for thread in self._threads:
            thread.start()

    def unplug(self) -> None:
        """End it at once, without a word to anybody."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        self._socket.close()
        self._out.close()

    def _ticks(self, moment_s: float) -> int:
        """What its clock tells at a moment of CLOCK_MONOTONIC."""
        return int((moment_s + self.clock_ahead_s) * TICKS_HZ)

    def pulse(self) -> None:
        """Raise the input line once."""
        if self._get(RUNS) and self._get(TRIGGERED) and self._get(SOURCE) == 1:
            self._expose()

    def picture(self, number: int) -> NDArray[np.uint8]:
        """What a frame shows: its number in every pixel, (h, w)."""
        return np.full((self._get(HEIGHT), self._get(WIDTH)), number % 251, np.uint8)

    def _get(self, at: int) -> int:
        return int(struct.unpack_from(">I", self._memory, at)[0])

    def _set(self, at: int, value: int) -> None:
        struct.pack_into(">I", self._memory, at, value & 0xFFFFFFFF)

    def set_float(self, at: int, value: float) -> None:
        struct.pack_into(">d", self._memory, at, value)

    def _exposure_s(self) -> float:
        return float(struct.unpack_from(">d", self._memory, EXPOSURE)[0]) / 1e6

    def _obey(self) -> None:
        """Answer commands (GVCP); one that is sent again is answered again, and not obeyed twice."""
        last: tuple[object, bytes] | None = None
        answered = b""
        while not self._over.is_set():
            try:
                packet, sender = self._socket.recvfrom(2048)
            except TimeoutError:
                continue
            if (sender, packet) == last:
                if answered:
                    self._socket.sendto(answered, sender)
                continue
            last, answered = (sender, packet), b""
            _, _, command, _, number = struct.unpack(">BBHHH", packet[:8])
            data = packet[8:]
            refused = command in (0x82, 0x86) and struct.unpack(">I", data[:4])[0] in self.refuses
            answer = struct.pack(">HH", 0, 0) if refused else self._answer(command, data)
            if answer is not None:
                status = WRITE_PROTECTED if refused else 0
                answered = struct.pack(">HHHH", status, command + 1, len(answer), number) + answer
                self._socket.sendto(answered, sender)

    def _answer(self, command: int, data: bytes) -> bytes | None:
        """The data of an acknowledge; None for a command that has none."""
        if command == 0x02:  # discovery
            return bytes(self._memory[:0xF8])
        if command == 0x80:  # read register
            addresses = struct.unpack(f">{len(data) // 4}I", data)
            return b"".join(self._memory[at : at + 4] for at in addresses)
        if command == 0x84:  # read memory
            at, count = struct.unpack(">IxxH", data)
            return data[:4] + bytes(self._memory[at : at + count])
        if command in (0x82, 0x86):  # write register, write memory
            at = struct.unpack(">I", data[:4])[0]
            self._memory[at : at + len(data) - 4] = data[4:]
            self._written(at)
            return struct.pack(">HH", 0, 1)
        return None  # a resend: this camera keeps no packets

    def _written(self, at: int) -> None:
        if at == LATCH:
            struct.pack_into(">Q", self._memory, LATCHED, self._ticks(time.monotonic()))
        if at == CHUNK_ON:
            self._chunks_on[self._get(CHUNK_SELECTOR)] = self._get(CHUNK_ON)
        if at == EXPOSURE:
            steps = round(1e6 * self._exposure_s() / EXPOSURE_STEP_US)
            self.set_float(EXPOSURE, EXPOSURE_STEP_US * max(1, steps))
        chunks = sum(self._chunks_on.values()) if self._get(CHUNKS) else 0
        self._set(PAYLOAD, self._get(WIDTH) * self._get(HEIGHT) + (8 + 16 * chunks if chunks else 0))

    def _run(self) -> None:
        """Expose freely, at the rate that is set."""
        next_s = time.monotonic()
        while not self._over.is_set():
            free = self._get(RUNS) and self._get(CCP) and not self._get(TRIGGERED)
            if not free:
                self._over.wait(0.005)
                next_s = time.monotonic()
                continue
            self._expose()
            next_s += 1 / float(struct.unpack_from(">d", self._memory, RATE)[0])
            self._over.wait(max(0.0, next_s - time.monotonic()))

    def _expose(self) -> None:
        """Expose one frame, stamp its beginning, and send it (GVSP); one after the other."""
        with self._exposing:
            self._expose_one()

    def _expose_one(self) -> None:
        gain = float(struct.unpack_from(">d", self._memory, GAIN)[0])
        self._written_settings = [*self._written_settings, (self._exposure_s(), gain)][-1 - self.behind :]
        exposure_s, gain = self._written_settings[0]
        began_s = time.monotonic()
        stamp = self._ticks(began_s)
        self.exposed_s.append((began_s, began_s + exposure_s))
        self.gains.append(gain)
        self._over.wait(exposure_s)
        self._over.wait(self.delay_s)
        self.frames += 1
        number = (self.frames - 1) % 65535 + 1
        image = self.picture(self.frames).tobytes()
        chunks = [one for one, on in self._chunks_on.items() if on] if self._get(CHUNKS) else []
        kind = 0x4001 if chunks else 1
        if chunks:
            image += struct.pack(">II", 0, len(image))
        sent_us = 1e6 * exposure_s if self.sends_us is None else self.sends_us
        for one in chunks:
            image += struct.pack(">dII", (sent_us, gain)[one], CHUNK_IDS[one], 8)
        leader = struct.pack(
            ">HHQIIIIIHH", 0, kind, stamp, MONO8, self._get(WIDTH), self._get(HEIGHT), 0, 0, 0, 0
        )
        step = (self._get(PACKET) & 0xFFFF) - 36
        parts = [(1, leader), *((3, image[at : at + step]) for at in range(0, len(image), step))]
        parts.append((2, struct.pack(">II", kind, self._get(HEIGHT))))
        target = socket.inet_ntoa(struct.pack(">I", self._get(DESTINATION))), self._get(PORT) & 0xFFFF
        for index, (content, data) in enumerate(parts):
            listens = target[1] and not self._over.is_set()  # a stream that ended set its port to 0
            if listens and not self.lose(self.frames, index):
                head = struct.pack(">HHI", 0, number, content << 24 | index)
                self._out.sendto(head + data, target)
