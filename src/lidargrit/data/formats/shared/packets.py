"""Recordings of packets, .pcap and .pcapng → checked record by record, before a library of C++ is given them."""

import struct
from collections.abc import Iterator
from io import BufferedReader
from itertools import islice
from pathlib import Path

from lidargrit.core.errors import ScanError
from lidargrit.data.formats import open_file

PCAPNG = b"\x0a\x0d\x0d\x0a"
PCAP = tuple(bytes.fromhex(mark) for mark in ("a1b2c3d4", "d4c3b2a1", "a1b23c4d", "4d3cb2a1"))
"""How files begin: of both byte orders, in micro- and nanoseconds."""
_LITTLE = (0xD4, 0x4D)  # first bytes of the marks in little-endian order
_BYTES_AT_MOST = 262_144  # of a packet; libpcap takes no longer ones
_BLOCK_AT_MOST = 16 << 20  # bytes of a block of pcapng; libpcap takes no longer ones
_LOOK = 48  # bytes of a packet in which its IP header begins, whatever it is wrapped in
_UDP = b"\x11"  # the number of its protocol
_UDP_HEADER = 8  # bytes
_PACKETS_TO_LOOK_AT = 200
_OUSTER = {7502, 7503}
_PORTS = {
    2368: "that of Velodyne and Hesai",
    2369: "that of Velodyne and Hesai",
    6699: "RoboSense's",
    7788: "RoboSense's",
}
_PORTS |= {2370: "Hesai's", 56301: "Livox's", 57000: "Livox's", 57001: "Livox's"}
_EMPTY = "take such packets out: tcpdump -r OLD.pcap -w NEW.pcap 'not udp[4:2] = 8'"


class _DamagedError(Exception):
    """What a header says cannot be."""


def check_packets(path: Path, wanted: str, cure: str) -> None:
    """Refuse a recording that would end the whole process: ouster-sdk 1.0 reads past a UDP packet without content.

    Only headers are looked at, once, a few microseconds for each record. A last record that was cut short is fine.

    Source:
        Files: libpcap, pcap-savefile(5); IETF draft-ietf-opsawg-pcapng, sections 4.1 to 4.4.
        IP: RFC 791, section 3.1; RFC 8200, section 3.
    """
    with open_file(path, wanted) as file:
        try:
            for number, (head, size) in enumerate(_packets(file), 1):
                if _is_empty_udp(head, size):
                    raise ScanError(f"{path}, whose packet {number} is of UDP without content", wanted, _EMPTY)
        except _DamagedError as error:
            raise ScanError(f"{path}, a damaged file ({error})", wanted, cure) from None
        except OSError as error:
            raise ScanError(f"{path}, which cannot be read ({error.strerror})", wanted, "check the disk") from None


def other_maker(path: Path) -> str:
    """Return whose packets a recording holds, by the UDP ports in its beginning; "" if they may be an Ouster's.

    Source:
        The makers' manuals: factory settings of the port that a sensor sends its points to.
    """
    seen = set[int]()
    try:
        with path.open("rb") as file:
            for head, _ in islice(_packets(file), _PACKETS_TO_LOOK_AT):
                seen |= _udp_ports(head)
    except (OSError, _DamagedError):
        pass  # told when the recording is read
    ports = sorted(_PORTS.keys() & seen)
    return "" if seen & _OUSTER or not ports else f"UDP port {ports[0]} is {_PORTS[ports[0]]}"


def _udp_ports(head: bytes) -> set[int]:
    """Return the ports that the beginning of a packet of IP 4 or 6 is sent to, wherever its IP header begins."""
    ports, found = set[int](), head.find(_UDP, 6, _LOOK)
    while found >= 0:
        starts = [found - 9 + 4 * (head[found - 9] & 15)] if found >= 9 and head[found - 9] >> 4 == 4 else []
        starts += [found + 34] if head[found - 6] >> 4 == 6 else []
        ports |= {int.from_bytes(head[at + 2 : at + 4]) for at in starts if at + 4 <= len(head)}
        found = head.find(_UDP, found + 1, _LOOK)
    return ports


def _packets(file: BufferedReader) -> Iterator[tuple[bytes, int]]:
    """Return the first bytes of each packet, and how many libpcap takes of it."""
    start = file.read(24)
    return _packets_of_blocks(file) if start[:4] == PCAPNG else _packets_of_records(file, start)


def _packets_of_records(file: BufferedReader, start: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield the packets of a .pcap; see :func:`_packets`."""
    if len(start) < 24:
        raise _DamagedError("its header is cut short")
    order = "<" if start[0] in _LITTLE else ">"
    major, minor, longest = struct.unpack(f"{order}4xHH8xI4x", start)
    if (major, minor) != (2, 4):  # older ones have their lengths in another order
        raise _DamagedError(f"version {major}.{minor} of the file format, not 2.4")
    longest = longest if 0 < longest < 1 << 31 else _BYTES_AT_MOST
    lengths, offset = struct.Struct(f"{order}8xI4x"), len(start)
    while len(record := _read(file, offset, lengths.size + _LOOK)) >= lengths.size:
        (size,) = lengths.unpack_from(record)
        if not 0 < size <= _BYTES_AT_MOST:
            raise _DamagedError(f"a packet of {size:,} bytes at byte {offset:,}")
        taken = min(size, longest)
        yield record[lengths.size :][:taken], taken
        offset += lengths.size + size


def _packets_of_blocks(file: BufferedReader) -> Iterator[tuple[bytes, int]]:
    """Yield the packets of a .pcapng; see :func:`_packets`."""
    order, longest, offset = "<", _BYTES_AT_MOST, 0
    while len(block := _read(file, offset, 28 + _LOOK)) >= 28:  # the shortest packet, and an end that is cut short
        if block[:4] == PCAPNG:  # each section has its own byte order
            order = "<" if block[8:12] == b"\x4d\x3c\x2b\x1a" else ">"
        kind, length = struct.unpack_from(f"{order}II", block)
        if not 12 <= length <= _BLOCK_AT_MOST:
            raise _DamagedError(f"a block of {length:,} bytes at byte {offset:,}")
        if kind == 1:  # an interface
            (stated,) = struct.unpack_from(f"{order}I", block, 12)
            longest = stated if 0 < stated < 1 << 31 else _BYTES_AT_MOST
        if kind in (2, 3, 6):  # packets: the old way, the simple way, and the usual one
            (size,) = struct.unpack_from(f"{order}I", block, 8 if kind == 3 else 20)
            taken = min(size, longest)
            yield block[12 if kind == 3 else 28 :][:taken], taken
        offset += length


def _read(file: BufferedReader, offset: int, size: int) -> bytes:
    file.seek(offset)
    return file.read(size)


def _is_empty_udp(head: bytes, size: int) -> bool:
    """Return whether a packet of some bytes holds, anywhere near its beginning, the IP header of an empty UDP packet.

    It is found by the number of its protocol, so that it does not matter what stands before it: Ethernet, with tags or
    without, or another IP. Fragments are put together first, and an empty packet is none.
    """
    found = head.find(_UDP, 6, _LOOK)
    while found >= 0:
        ip = found - 9
        if ip >= 0 and head[ip] >> 4 == 4 and not int.from_bytes(head[ip + 6 : ip + 8]) & 0x3FFF:
            header, total = 4 * (head[ip] & 15), int.from_bytes(head[ip + 2 : ip + 4])
            here = size - ip - header
            if (min(here, total - header) if total >= header else here) == _UDP_HEADER:
                return True
        ip = found - 6
        if head[ip] >> 4 == 6 and int.from_bytes(head[ip + 4 : ip + 6]) == _UDP_HEADER <= size - ip - 40:
            return True
        found = head.find(_UDP, found + 1, _LOOK)
    return False
