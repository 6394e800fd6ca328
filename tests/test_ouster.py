"""Recordings of Ouster sensors: what is refused, and the real one, packet for packet."""

import builtins
import json
import struct

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ScanError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.formats import count_scans, ouster_pcap, read_scan
from lidargrit.data.formats.shared.packets import check_packets
from lidargrit.scans.sensors import load_sensor


def one_line(refusal) -> str:
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


@pytest.fixture
def capture(real, tmp_path):
    """A writable copy of the real recording: its packets and its metadata."""
    pytest.importorskip("ouster.sdk")
    (source,) = (real / "other_sensors" / "ouster").glob("*.pcap")
    for ending in (".pcap", ".json"):
        (tmp_path / f"a{ending}").write_bytes(source.with_suffix(ending).read_bytes())
    return tmp_path / "a.pcap"


# Packets, which are looked at before the library that unpacks them, since some of them end its process.


def ip4(content: bytes, protocol: int = 17, total: int | None = None, fragment: int = 0) -> bytes:
    total = 20 + len(content) if total is None else total
    return struct.pack(">BBHHHBB10x", 0x45, 0, total, 1, fragment, 64, protocol) + content


def ip6(content: bytes) -> bytes:
    return struct.pack(">IHBB32x", 6 << 28, len(content), 17, 64) + content


def udp(content: bytes) -> bytes:
    return struct.pack(">HHHH", 7502, 7502, 8 + len(content), 0) + content


ETHERNET, TAGGED, ETHERNET_6 = bytes(12) + b"\x08\0", bytes(12) + b"\x81\0\0\1\x08\0", bytes(12) + b"\x86\xdd"
HEADS = {"<": "d4c3b2a1", ">": "a1b2c3d4"}
GOOD = {
    "content": ETHERNET + ip4(udp(b"a")),
    "content of IPv6": ETHERNET_6 + ip6(udp(b"a")),
    "no UDP": ETHERNET + ip4(bytes(8), protocol=6),
    "the last fragment": ETHERNET + ip4(bytes(8), fragment=0x0B9),
    "no IP": bytes(12) + b"\x08\x06" + bytes(28),
    "a header that is cut short": ETHERNET + ip4(udp(b"")[:5]),
    "one byte": b"\x11",
}
EMPTY = {
    "Ethernet": ETHERNET + ip4(udp(b"")),
    "padded": ETHERNET + ip4(udp(b"")) + bytes(18),
    "tagged": TAGGED + ip4(udp(b"")),
    "no length": ETHERNET + ip4(udp(b""), total=0),
    "IPv6": ETHERNET_6 + ip6(udp(b"")),
    "IPv6 in IPv4": ETHERNET + ip4(ip6(udp(b"")), protocol=41),
    "no Ethernet": ip4(udp(b"")),
}


def pcap(*packets: bytes, order: str = "<", version: tuple[int, int] = (2, 4), longest: int = 65535) -> bytes:
    head = bytes.fromhex(HEADS[order]) + struct.pack(f"{order}HHIIII", *version, 0, 0, longest, 1)
    return head + b"".join(struct.pack(f"{order}IIII", 0, 0, len(one), len(one)) + one for one in packets)


def pcapng(*packets: bytes, order: str = "<", simple: bool = False, longest: int = 65535) -> bytes:
    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        return struct.pack(f"{order}II", kind, len(body) + 12) + body + struct.pack(f"{order}I", len(body) + 12)

    start = block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1))
    start += block(1, struct.pack(f"{order}HHI", 1, 0, longest))
    for one in packets:
        head = (
            struct.pack(f"{order}I", len(one)) if simple else struct.pack(f"{order}IIIII", 0, 0, 0, len(one), len(one))
        )
        start += block(3 if simple else 6, head + one)
    return start


WRITERS = [
    *(lambda *packets, order=order, **more: pcap(*packets, order=order, **more) for order in "<>"),
    *(lambda *packets, order=order, **more: pcapng(*packets, order=order, **more) for order in "<>"),
    lambda *packets, **more: pcapng(*packets, simple=True, **more),
]


@pytest.mark.parametrize("write", WRITERS)
def test_a_recording_with_an_empty_datagram_is_refused(tmp_path, write):
    path, good = tmp_path / "a.pcap", [*GOOD.values()] * 3

    def refusal() -> str:
        with pytest.raises(ScanError) as refused:
            check_packets(path, "packets", "try again")
        assert str(path) in one_line(refused)
        return str(refused.value)

    path.write_bytes(write(*good))
    check_packets(path, "packets", "try again")
    for packet in EMPTY.values():
        path.write_bytes(write(*good, packet, *good))
        assert f"whose packet {len(good) + 1} is of UDP without content" in refusal()
    path.write_bytes(write(good[0], longest=42))
    assert "whose packet 1 is" in refusal(), "cut to its headers as it is read"


def test_recordings_whose_headers_do_not_add_up_are_refused_and_cut_ones_are_not(tmp_path):
    path, whole = tmp_path / "a.pcap", pcap(*GOOD.values())
    for content, text in (
        (whole[:20], "its header is cut short"),
        (pcap(*GOOD.values(), version=(2, 3)), r"version 2\.3 of the file format"),
        (whole + bytes(1000), r"a packet of 0 bytes at byte \d+"),
        (whole + b"\xff" * 16, "a packet of 4,294,967,295 bytes"),
        (pcapng(*GOOD.values()) + bytes(40), "a block of 0 bytes"),
    ):
        path.write_bytes(content)
        with pytest.raises(ScanError, match=f"a damaged file .{text}.*; try again"):
            check_packets(path, "packets", "try again")
    for content in (whole, pcapng(*GOOD.values())):
        for length in range(24, len(content), 7):
            path.write_bytes(content[:length])
            check_packets(path, "packets", "try again")


@pytest.mark.shared
def test_ouster_recording_with_an_empty_datagram_is_refused_before_the_library_reads_it(capture):
    whole, packet = capture.read_bytes(), EMPTY["Ethernet"]
    capture.write_bytes(whole + struct.pack("<IIII", 0, 0, len(packet), len(packet)) + packet)
    with pytest.raises(ScanError, match=r"whose packet 223 is of UDP without content.*tcpdump") as refusal:
        read_scan(capture)
    one_line(refusal)


@pytest.mark.shared
def test_ouster_recordings_that_are_refused_in_one_line(capture):
    whole, text = capture.read_bytes(), capture.with_suffix(".json").read_text()
    metadata = json.loads(text)

    def refused(packets, beside, pattern):
        capture.write_bytes(packets)
        capture.with_suffix(".json").write_text(beside)
        with pytest.raises(ScanError, match=pattern) as refusal:
            read_scan(capture)
        one_line(refusal)
        assert count_scans(capture) == 1

    refused(b"", text, "a.pcap, which is no recording of packets")
    refused(bytes(100), text, "a.pcap, which is no recording of packets")
    refused(whole[:24], text, "a.pcap, which cannot be used|no revolution of the sensor in a.json")
    refused(whole, "", r"a\.json, which cannot be read \(an empty file\)")
    refused(whole, "{", "a.json, which cannot be used")
    refused(whole, "[]", "a.json, which cannot be used .a list in place of an object")
    refused(whole, "{}", "a.json, which cannot be used")
    refused(
        whole,
        json.dumps(metadata | {"data_format": {**metadata["data_format"], "columns_per_frame": 10**9}}),
        "1000000000 columns",
    )
    refused(whole, json.dumps(metadata | {"beam_altitude_angles": [1.0]}), "a.json, which cannot be used")
    capture.with_suffix(".json").rename(capture.with_name("b.json"))
    with pytest.raises(ScanError, match=r"a\.pcap without a\.json; .*; if it is b\.json, give it that name"):
        read_scan(capture)
    (capture.with_name("b.json")).unlink()
    dataset = open_dataset(str(capture.parent))
    with pytest.raises(
        ScanError, match=r"a\.pcap without a\.json; .*; if an Ouster sent it, record it again"
    ) as refusal:
        dataset.scan(0)
    one_line(refusal)


@pytest.mark.shared
def test_ouster_recording_that_was_cut_short_keeps_what_it_has(capture):
    capture.write_bytes(capture.read_bytes()[:700_000])
    assert count_scans(capture) == 2
    assert len(read_scan(capture, 0)) == 107647
    with pytest.raises(ScanError, match=r"scan number 2 of .*a\.pcap; wanted one of its 2"):
        read_scan(capture, 2)


@pytest.mark.shared
def test_sensor_of_ouster_reads_new_metadata_too(capture):
    path = capture.with_suffix(".json")
    old, data = ouster_pcap.sensor_of(capture), json.loads(path.read_text())
    beams = {key: data.pop(key) for key in ("beam_altitude_angles", "beam_azimuth_angles")}
    new = {"beam_intrinsics": beams, "lidar_data_format": data.pop("data_format"), "sensor_info": data}
    path.write_text(json.dumps(new))
    assert ouster_pcap.sensor_of(path).same_rays(old)
    for wrong in ({}, {"beam_intrinsics": 3}, {**new, "beam_intrinsics": {**beams, "beam_azimuth_angles": ["a"]}}):
        path.write_text(json.dumps(wrong))
        with pytest.raises(ScanError, match="which is no metadata of an Ouster sensor"):
            ouster_pcap.sensor_of(path)


@pytest.mark.shared
def test_real_ouster_unit_is_the_one_of_our_model(real):
    (path,) = (real / "other_sensors" / "ouster").glob("*.pcap")
    assert count_scans(path) == 3
    sensor, ours = ouster_pcap.sensor_of(path), load_sensor("os1_128")
    assert sensor.same_rays(ours)
    assert (sensor.azimuth_offset_rad - ours.azimuth_offset_rad).abs().max().rad2deg() < 0.031
    scan = read_scan(path, 0)
    azimuth = (
        torch.atan2(scan.points_xyz_m[:, 1], scan.points_xyz_m[:, 0]).double() - sensor.azimuth_offset_rad[scan.ring]
    )
    column = (np.pi - azimuth) / (2 * np.pi / 1024)
    assert (column - column.round()).abs().quantile(0.99) < 0.1, "each beam fires aside as its metadata says"


@pytest.mark.parametrize(
    ("module", "file", "text"),
    [
        ("pyarrow", "1.feather", r"pip install 'lidargrit\[argoverse\]'"),
        ("ouster", "a.pcap", r"pip install 'lidargrit\[ouster\]'"),
    ],
)
def test_without_the_optional_part_one_line_names_it(tmp_path, monkeypatch, module, file, text):
    (tmp_path / file).write_bytes(b"ARROW1\0\0" if module == "pyarrow" else bytes.fromhex("d4c3b2a1") + bytes(40))
    (tmp_path / "a.json").write_text("{}")
    real_import = builtins.__import__

    def no_such(name, *rest, **named):
        if name.partition(".")[0] == module:
            raise ImportError(name)
        return real_import(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", no_such)
    with pytest.raises(ScanError, match=text) as refusal:
        read_scan(tmp_path / file)
    one_line(refusal)
