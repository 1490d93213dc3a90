"""Protocol 2.0 packets: the SDK's packet layer with right stuffing, honest errors and partial results.

What it changes of ``dynamixel_sdk.Protocol2PacketHandler``: packets are really stuffed when sent; unstuffing
is exact; noise, broken packets and false headers before a reply are stepped over until the deadline instead
of ending the wait; an error reply without data is never read as data; nothing spins.
The source of the format: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dynamixel_sdk import (
    BROADCAST_ID,
    COMM_NOT_AVAILABLE,
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    INST_BULK_READ,
    INST_PING,
    INST_STATUS,
    INST_SYNC_READ,
    Protocol2PacketHandler,
)

from drivers.dynamixel.port import Port

HEADER = b"\xff\xff\xfd\x00"
START = b"\xff\xff\xfd"
STUFFED = b"\xff\xff\xfd\xfd"
HIGHEST_ID = 252
LONGEST_PACKET = 1024
SHORTEST_STATUS = 11  # header 4, id, length 2, instruction, error, CRC 2
ALERT = 0x80

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
                    if packet[7] == INST_STATUS and length >= SHORTEST_STATUS:
                        body = packet[8 : length - 2]
                        if not fast:
                            body = body.replace(STUFFED, START)
                        return Status(packet[4], body[0], body[1:])
                    continue  # an instruction: the adapter's echo
            elif not at_end and (fast or buffer.find(HEADER, 1) < 0):
                return None  # a second header inside means that this one is noise
        del buffer[:1]


class PacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's packet layer over the hardened port.

    Every method of the SDK that goes through these (ping, read, write, the group classes) gets their cure.
    """

    def updateCRC(self, crc_accum: int, data_blk_ptr: Any, data_blk_size: int) -> int:
        """Return the checksum of the first ``data_blk_size`` bytes."""
        return crc16(bytes(data_blk_ptr[:data_blk_size]), crc_accum)

    def addStuffing(self, packet: list[int]) -> list[int]:
        """Return a packet (with room for its checksum) whose body is stuffed and whose length says so."""
        length = packet[5] | packet[6] << 8
        body = bytes(packet[7 : 7 + length - 2]).replace(START, STUFFED)
        total = len(body) + 2
        return [*packet[:5], total & 0xFF, total >> 8, *body, *packet[5 + length : 7 + length]]

    def removeStuffing(self, packet: list[int]) -> list[int]:
        """Return a packet whose body is unstuffed and whose length says so."""
        length = packet[5] | packet[6] << 8
        body = bytes(packet[7 : 7 + length - 2]).replace(STUFFED, START)
        total = len(body) + 2
        return [*packet[:5], total & 0xFF, total >> 8, *body, *packet[5 + length : 7 + length]]

    def txPacket(self, port: Port, txpacket: list[int]) -> int:
        """Send an instruction that the SDK has laid out; its room for the checksum is ignored.

        Raises
        ------
        LineLost
            If the line is gone.
        """
        length = txpacket[5] | txpacket[6] << 8
        self.send(port, txpacket[4], txpacket[7], bytes(txpacket[8 : 7 + length - 2]))
        return int(COMM_SUCCESS)

    def send(self, port: Port, servo_id: int, instruction: int, parameters: bytes = b"") -> None:
        """Send an instruction after what came in unasked was dropped. Raises LineLost, BadReply."""
        self.send_packet(port, instruction_packet(servo_id, instruction, parameters))

    def send_packet(self, port: Port, packet: bytes) -> None:
        """Send the bytes of an instruction. Raises LineLost, BadReply."""
        port.clearPort()
        port.writePort(packet)

    def receive(self, port: Port, *, fast: bool = False) -> Status | None:
        """Return the next status packet, or None when the port's deadline passes first.

        After a None the port counts as suspect: the reply may still come. Raises LineLost.
        """
        while True:
            status = take_status(port.buffer, fast=fast)
            if status is not None:
                return status
            if not port.fill():
                status = take_status(port.buffer, at_end=True, fast=fast)
                port.suspect = port.suspect or status is None
                return status

    def rxPacket(self, port: Port, fast_option: bool) -> tuple[list[int], int]:
        """Return the next status packet as the SDK lays it out, and its result code. Raises LineLost."""
        had_noise = bool(port.buffer)
        status = self.receive(port, fast=fast_option)
        if status is None:
            return [], int(COMM_RX_CORRUPT if had_noise or port.buffer else COMM_RX_TIMEOUT)
        body = [INST_STATUS, status.error, *status.data]
        packet = [*HEADER, status.servo_id, (len(body) + 2) & 0xFF, (len(body) + 2) >> 8, *body]
        crc = crc16(bytes(packet))
        return [*packet, crc & 0xFF, crc >> 8], int(COMM_SUCCESS)

    def txRxPacket(self, port: Port, txpacket: list[int]) -> tuple[list[int] | None, int, int]:
        """Send an instruction and return the addressed servo's reply. Raises LineLost."""
        if txpacket[7] in (INST_BULK_READ, INST_SYNC_READ):
            return None, int(COMM_NOT_AVAILABLE), 0
        asked = (txpacket[10] | txpacket[11] << 8) if txpacket[7] == 2 else 0
        packet, result, error = super().txRxPacket(port, txpacket)
        if result == COMM_SUCCESS and packet and asked and len(packet) != SHORTEST_STATUS + asked:
            port.suspect = True  # an error without data, or the reply to another question
            return packet, int(COMM_RX_CORRUPT), error
        if (
            result == COMM_SUCCESS
            and packet
            and txpacket[7] == INST_PING
            and len(packet) < SHORTEST_STATUS + 3
        ):
            port.suspect = True
            return packet, int(COMM_RX_CORRUPT), error
        return packet, int(result), error

    def readRx(self, port: Port, dxl_id: int, length: int) -> tuple[list[int], int, int]:
        """Return a servo's reply of ``length`` bytes to a group read. Raises LineLost."""
        data, result, error = super().readRx(port, dxl_id, length)
        if result == COMM_SUCCESS and len(data) < length:
            port.suspect = True
            return [], int(COMM_RX_CORRUPT), error
        return data, int(result), error

    def broadcastPing(self, port: Port) -> tuple[dict[int, list[int]], int]:
        """Return model number and firmware of every servo that answers, by id. Raises LineLost."""
        self.send(port, BROADCAST_ID, INST_PING)
        slots_s = (HIGHEST_ID + 1) * (0.003 + 14 * port.byte_s)
        port.setPacketTimeoutMillis(1000 * (slots_s + port.reply_timeout_s))
        found: dict[int, list[int]] = {}
        while (status := self.receive(port)) is not None:
            if len(status.data) == 3:
                found[status.servo_id] = [status.data[0] | status.data[1] << 8, status.data[2]]
        return found, int(COMM_SUCCESS if found else COMM_RX_TIMEOUT)
