"""Recordings of ROS that leave out what their formats leave open, were cut short, or hold more than one topic."""

import sqlite3

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ScanError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.formats import count_scans, read_scan
from street_corner import corner, rows_of, xyz_of

typesys = pytest.importorskip("rosbags.typesys")
mcap_writer = pytest.importorskip("mcap.writer")
zstandard = pytest.importorskip("zstandard")

TYPE = "sensor_msgs/msg/PointCloud2"
KINDS = {"f4": 7, "u2": 4, "f8": 8}
TABLE = corner()


def message(table=None, fields=None, data=None, **changed):
    """Return a cloud in CDR; its header may say anything."""
    store = typesys.get_typestore(typesys.Stores.ROS2_FOXY)
    types = store.types
    columns = dict(TABLE if table is None else table)
    columns["intensity"] = columns["intensity"].astype(np.float32)
    rows = rows_of(columns)
    field = types["sensor_msgs/msg/PointField"]
    described = [field(name, rows.dtype.fields[name][1], KINDS[rows.dtype[name].str[1:]], 1) for name in columns]
    described = [*described, *(field(*each) for each in fields or ())] if changed.get("step", 1) else []
    data = np.frombuffer(rows.tobytes() if data is None else data, np.uint8)
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "lidar")
    size = rows.dtype.itemsize
    said = {"height": 1, "width": len(rows), "big": False, "step": size, "row_step": size * len(rows), **changed}
    cloud = types[TYPE](
        header, said["height"], said["width"], described, said["big"], said["step"], said["row_step"], data, True
    )
    return bytes(store.serialize_cdr(cloud, TYPE))


def mcap(path, messages, kind=TYPE, **options):
    """Write (topic, message) into a recording."""
    with path.open("wb") as file:
        writer = mcap_writer.Writer(file, **options)
        writer.start()
        schema, channels = writer.register_schema(kind, "ros2msg", b""), {}
        for at, (topic, raw) in enumerate(messages):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], 10 + at, raw, 10 + at)
        writer.finish()
    return path


def db3(path, messages):
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        columns = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB"
        database.execute(f"CREATE TABLE messages({columns})")
        names = list(dict.fromkeys(topic for topic, _ in messages))
        database.executemany(
            "INSERT INTO topics VALUES (?, ?, ?, 'cdr')", [(at, n, TYPE) for at, n in enumerate(names)]
        )
        sent = [(names.index(topic), at, raw) for at, (topic, raw) in enumerate(messages)]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", sent)
    database.close()
    return path


def is_right(scan, table=TABLE):
    return torch.equal(scan.points_xyz_m, xyz_of(table)) and torch.equal(
        scan.reflectance, torch.from_numpy((table["intensity"] / np.float32(255)).astype(np.float32))
    )


@pytest.mark.parametrize(
    "changed",
    [
        {"row_step": 0},
        {"row_step": 7},
        {"row_step": 10**9},
        {"height": len(TABLE["x"]), "width": 1, "row_step": 0},
        {"fields": [("x", 4, 7, 1)]},
        {"fields": [("time", 5000, 8, 1)]},
        {"big": True},
    ],
    ids=["none", "too small", "too large", "of columns", "a field twice", "a field beyond", "other byte order"],
)
def test_clouds_whose_header_errs_are_read(tmp_path, changed):
    scan = read_scan(mcap(tmp_path / "a.mcap", [("/top", message(**changed))]))
    assert is_right(scan)
    assert len(scan.notes) == ("big" in changed or changed.get("fields", [("x",)])[0][0] == "time")


@pytest.mark.parametrize("gap_of_last", [5, 0], ids=["after each row", "not after the last"])
def test_gaps_between_rows_are_no_points(tmp_path, gap_of_last):
    rows = rows_of(TABLE | {"intensity": TABLE["intensity"].astype(np.float32)})
    width = len(rows) // 2
    data = (b"\xaa" * 5).join([rows[:width].tobytes(), rows[width : 2 * width].tobytes()]) + b"\xaa" * gap_of_last
    changed = {"height": 2, "width": width, "row_step": width * rows.dtype.itemsize + 5}
    scan = read_scan(mcap(tmp_path / "a.mcap", [("/top", message(data=data, **changed))]))
    assert is_right(scan, {name: column[: 2 * width] for name, column in TABLE.items()})


def test_fewer_bytes_than_points_are_damage(tmp_path):
    path = mcap(tmp_path / "a.mcap", [("/top", message(width=len(TABLE["x"]) + 1))])
    with pytest.raises(ScanError, match="damaged file"):
        read_scan(path)


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"use_statistics": False},
        {"index_types": mcap_writer.IndexType.NONE},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"use_summary_offsets": False},
        {"use_chunking": False, "use_statistics": False, "repeat_channels": False, "repeat_schemas": False},
        {"enable_crcs": False},
        {"chunk_size": 1},
    ],
    ids=", ".join,
)
def test_what_mcap_leaves_open_may_be_missing(tmp_path, options):
    tables = [corner(seed) for seed in range(3)]
    sent = [(topic, message(table)) for table in tables for topic in ("/top", "/rear")][:-1]
    path = mcap(tmp_path / "a.mcap", sent, **options)
    assert count_scans(path) == 3
    for index, table in enumerate(tables):
        assert is_right(read_scan(path, index), table)
    assert open_dataset(f"{path}:/rear").scan(1).notes == ()
    assert len(open_dataset(f"{path}:/rear")) == 2


def test_a_recording_that_was_cut_off_is_read_up_to_there(tmp_path):
    sent = [("/top", message()), ("/top", message(corner(1)))]
    path = mcap(tmp_path / "a.mcap", sent, chunk_size=1000)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 7 // 10])
    assert count_scans(path) == 1
    scan = read_scan(path)
    assert is_right(scan)
    assert scan.notes[0].startswith("cut off or damaged from byte ")
    assert "mcap recover a.mcap" in scan.notes[0]
    path.write_bytes(data[:500])
    with pytest.raises(ScanError, match=r"before its first point cloud.*mcap recover a\.mcap"):
        read_scan(path)


def flipped(path, packing):
    """Change two bytes in the middle of a message, or of a compressed chunk."""
    data = bytearray(path.read_bytes())
    at = len(data) // 3 if packing else bytes(data).index(xyz_of(TABLE).numpy()[0].tobytes()) + 200
    data[at] ^= 0x40
    data[at + 1] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("packing", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("has_index", [True, False])
def test_a_wrong_checksum_is_damage(tmp_path, packing, has_index):
    more = {"compression": mcap_writer.CompressionType[packing], "use_statistics": has_index}
    path = mcap(tmp_path / "a.mcap", [("/top", message())], **more)
    flipped(path, packing != "NONE")
    with pytest.raises(ScanError, match="damaged file"):
        read_scan(path, 0, "drop")


def test_no_checksum_is_no_damage(tmp_path):
    more = {"compression": mcap_writer.CompressionType.NONE, "enable_crcs": False}
    path = mcap(tmp_path / "a.mcap", [("/top", message())], **more)
    flipped(path, False)
    assert len(read_scan(path)) == len(TABLE["x"])


@pytest.mark.parametrize("with_size", [True, False])
def test_messages_that_rosbag2_compressed_are_read(tmp_path, with_size):
    packed = zstandard.ZstdCompressor(write_content_size=with_size).compress(message())
    assert is_right(read_scan(db3(tmp_path / "a.db3", [("/top", packed)])))


@pytest.mark.parametrize("write", [mcap, db3])
def test_a_topic_is_named_and_can_be_chosen(tmp_path, write, capsys):
    path = write(tmp_path / f"a.{write.__name__}", [("/top", message())] + [("/rear", message(corner(5)))] * 2)
    scan = read_scan(path)
    assert is_right(scan, corner(5))
    assert scan.notes == (f"topic /rear taken (2 clouds), not /top (1); choose by {path.name}:/top",)
    chosen = open_dataset(f"{path}:/top")
    assert len(chosen) == 1
    assert chosen.name(0) == "a@top"
    assert is_right(chosen.scan(0))
    assert chosen.scan(0).notes == ()
    assert main(["inspect", f"{path}:/top", "--sensor", "vlp16"]) == 0
    with pytest.raises(ScanError, match="one with point clouds: /rear, /top"):
        open_dataset(f"{path}:/left").scan(0)
    capsys.readouterr()


def test_a_recording_of_packets_is_told(tmp_path):
    path = mcap(tmp_path / "a.mcap", [("/packets", b"\0\1\0\0")], kind="velodyne_msgs/msg/VelodyneScan")
    with pytest.raises(
        ScanError, match=r"no topic of PointCloud2 \(velodyne_msgs/msg/VelodyneScan\).*through the lidar's driver"
    ):
        read_scan(path)


@pytest.mark.parametrize("has_fields", [True, False])
def test_an_empty_cloud_is_left_out_by_the_option_that_its_message_names(has_fields, tmp_path, capsys):
    empty = message(data=b"", width=0, **({} if has_fields else {"step": 0}))
    path = str(mcap(tmp_path / "a.mcap", [("/top", empty)] + [("/top", message(corner(at))) for at in range(3)]))
    for words in (["inspect", path, "--sensor", "vlp16"], ["fit-sensor", path, "-o", str(tmp_path / "f.json")]):
        assert main(words) == 2
        assert "take another scan, or of several leave it out by --bad-scans skip" in capsys.readouterr().err
        assert main([*words, "--bad-scans", "skip"]) == 0
        output = capsys.readouterr().out
        assert f"note: left out: got no point in {path}#0" in output
    with pytest.raises(ScanError, match="no point"):
        read_scan(mcap(tmp_path / "b.mcap", [("/top", empty)]))
