"""Packets of protocol 2.0: instructions to bytes, bytes to status packets. No I/O.

An own codec, with ROBOTIS's SDK as the oracle of its tests: the SDK sends packets unstuffed, ends a wait at
the first noise or broken packet, reads an error reply's checksum as data, and spins while it waits.
The source of the format: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

from dataclasses import dataclass

HEADER = b"\xff\xff\xfd\x00"
START = b"\xff\xff\xfd"
STUFFED = b"\xff\xff\xfd\xfd"
BROADCAST_ID = 0xFE
LONGEST_PACKET = 1024
SHORTEST_STATUS = 11  # header 4, id, length 2, instruction, error, CRC 2
ALERT = 0x80

PING, READ, WRITE, REBOOT, STATUS = 0x01, 0x02, 0x03, 0x08, 0x55
SYNC_READ, SYNC_WRITE, BULK_READ, BULK_WRITE = 0x82, 0x83, 0x92, 0x93
FAST_SYNC_READ, FAST_BULK_READ = 0x8A, 0x9A

ERROR_WORDS = {
    1: "it could not process the instruction",
    2: "it does not know the instruction",
    3: "the instruction's checksum did not fit",
    4: "the value is out of range, or its bus watchdog has tripped",
    5: "the data has the wrong length",
    6: "the value is beyond one of its limits",
    7: "the register cannot be read or written now (torque on locks permanent registers)",
}


def _crc_table() -> tuple[int, ...]:
    """CRC-16 with the polynomial 0x8005, high bit first."""
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC = _crc_table()


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """Return the packet checksum of some bytes, going on from an earlier one."""
    table = _CRC
    for byte in data:
        crc = ((crc & 0xFF) << 8) ^ table[(crc >> 8) ^ byte]
    return crc


def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of an instruction, stuffed and with its checksum."""
    body = (bytes((instruction,)) + parameters).replace(START, STUFFED)
    packet = HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


@dataclass(frozen=True)
class Status:
    """A servo's reply: who sent it, its error byte (bit 7 is the hardware alert), its data, unstuffed."""

    servo_id: int
    error: int
    data: bytes

    @property
    def refused(self) -> int:
        """The error number, 0 for none; the alert bit is no refusal."""
        return self.error & 0x7F

    @property
    def alert(self) -> bool:
        """Whether the servo has a hardware error."""
        return bool(self.error & ALERT)


def take_status(buffer: bytearray, *, at_end: bool = False, fast: bool = False) -> Status | None:
    """Take the first whole status packet out of a buffer; None when there is none yet.

    What comes before it (noise, echoes of instructions, packets whose checksum does not fit) is dropped.

    Parameters
    ----------
    buffer
        Bytes as they came in; what was used or dropped is removed.
    at_end
        No more bytes will come: a header whose packet is not whole was noise, look behind it.
    fast
        Do not unstuff: replies to fast group reads are not stuffed.
    """
    while True:
        start = buffer.find(HEADER)
        if start < 0:
            del buffer[: max(0, len(buffer) - len(HEADER) + 1)]
            return None
        if start:
            del buffer[:start]
        if len(buffer) < 7:
            if not at_end:
                return None
            length = 0
        else:
            length = 7 + (buffer[5] | buffer[6] << 8)
        if 7 + 3 <= length <= LONGEST_PACKET and buffer[4] <= BROADCAST_ID:
            if len(buffer) >= length:
                crc = buffer[length - 2] | buffer[length - 1] << 8
                if crc16(buffer[: length - 2]) == crc:
                    packet = bytes(buffer[:length])
                    del buffer[:length]
                    if packet[7] == STATUS and length >= SHORTEST_STATUS:
                        body = packet[8 : length - 2]
                        if not fast:
                            body = body.replace(STUFFED, START)
                        return Status(packet[4], body[0], body[1:])
                    continue  # an instruction: the adapter's echo
            elif not at_end and (fast or buffer.find(HEADER, 1) < 0):
                return None  # a second header inside means that this one is noise
        del buffer[:1]
