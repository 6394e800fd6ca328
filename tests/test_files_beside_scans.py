"""Files beside scans: pictures are no scans, what is not read is told, and ``sensor.json`` names the sensor."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lidargrit.cli import main
from lidargrit.core.errors import DataError, ScanError
from lidargrit.data.datasets import load, open_dataset
from lidargrit.data.datasets.shared.files import SENSOR_FILE
from lidargrit.data.export import export_scans
from lidargrit.data.formats import cure_of_ending, is_of_other_program, read_scan
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_source
from lidargrit.data.sources.named import PointScans, named_scans
from lidargrit.scans.sensors import load_sensor
from street_corner import corner, xyz_of

TABLE = corner()


def write_bin(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.c_[xyz_of(TABLE).numpy(), TABLE["intensity"] / 255].astype("<f4")
    path.write_bytes(rows.tobytes())


def picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((48, 64, 3), 128, np.uint8)).save(path)


def test_hidden_folders_are_not_looked_into_and_a_name_may_be_as_long_as_names_can_be(tmp_path):
    write_bin(tmp_path / f"sequences/00/velodyne/{'a' * 251}.bin")
    (tmp_path / ".git").mkdir()
    (tmp_path / ".git/objects.zip").write_bytes(b"PK")
    for source in (f"folder:{tmp_path}", f"kitti_odometry:{tmp_path}"):
        dataset = open_dataset(source)
        assert dataset.notes == ()
        assert len(dataset.scan(0)) == len(TABLE["x"])


def test_pictures_poses_and_labels_beside_scans_are_none(tmp_path, capsys):
    write_bin(tmp_path / "scans/b.bin")
    picture(tmp_path / "scans/a.png")
    (tmp_path / "scans/poses.csv").write_text("time,tx,ty,tz\n0,1,2,3\n")
    np.save(tmp_path / "scans/labels.npy", np.zeros(len(TABLE["x"]), np.uint32))
    found = open_dataset(str(tmp_path / "scans"))
    assert [found.name(index) for index in range(len(found))] == ["b"]
    assert found.notes[0].startswith("3 files .csv, .npy, .png beside the scans left out, such as ")
    more = ["--sensor", "vlp16", "--set", "data.columns=90"]
    for words in (
        ["prepare", str(tmp_path / "scans"), "-o", str(tmp_path / "p")],
        ["inspect", str(tmp_path / "scans")],
    ):
        assert main([*words, *more]) == 0
        output = capsys.readouterr()
        assert "3 files .csv, .npy, .png beside the scans left out" in output.out + output.err


def test_pictures_alone_are_refused_as_such(tmp_path):
    picture(tmp_path / "a.png")
    with pytest.raises(ScanError, match="48 rows and 64 columns"):
        open_dataset(str(tmp_path)).scan(0)


def test_a_sequence_given_itself_has_its_scans_alone(tmp_path):
    for at in range(2):
        write_bin(tmp_path / f"00/velodyne/{at:06d}.bin")
        picture(tmp_path / f"00/image_2/{at:06d}.png")
        (tmp_path / "00/voxels").mkdir(exist_ok=True)
        (tmp_path / f"00/voxels/{at:06d}.bin").write_bytes(bytes(4096))
    found = open_dataset(f"folder:{tmp_path}/00")
    assert [found.name(index) for index in range(len(found))] == ["velodyne/000000", "velodyne/000001"]
    assert "4 files .bin, .png beside the scans left out" in found.notes[0]


@pytest.mark.parametrize("root", ["00", "00/velodyne"])
def test_a_sequence_given_itself_has_its_labels(tmp_path, root):
    write_bin(tmp_path / "00/velodyne/000000.bin")
    wanted = np.arange(len(xyz_of(TABLE)), dtype="<u4") % 3 + 10
    (tmp_path / "00/labels").mkdir()
    (tmp_path / "00/labels/000000.label").write_bytes(wanted.tobytes())
    found = open_dataset(f"folder:{tmp_path}/{root}")
    assert np.array_equal(found.scan(0).label, wanted)
    assert tmp_path / "00/labels/000000.label" in found.sidecar_files(0)
    (tmp_path / "00/labels/000000.label").write_bytes(bytes(4))
    with pytest.raises(ScanError, match="4 bytes of labels"):
        found.scan(0)


def test_range_images_beside_scans_stay_scans(tmp_path):
    write_bin(tmp_path / "a.bin")
    Image.fromarray(np.full((64, 90), 500, np.uint16)).save(tmp_path / "b.png")
    np.save(tmp_path / "c.npy", xyz_of(TABLE).numpy())
    found = open_dataset(str(tmp_path))
    assert len(found) == 3
    assert found.notes == ()


CURES = {
    "a.txt": "put a line of names such as x y z intensity first, and end its name in .csv",
    "a.xyz": "put a line of names such as x y z intensity first, and end its name in .csv",
    "a.laz": "unpack it to .las",
    "a.bin.gz": "unpack it first",
    "a.mcap.zstd": "unpack it with: zstd -d",
    "a.e57": "convert it to .pcd or .ply",
    "a.bag.active": "rosbag reindex",
}


@pytest.mark.parametrize("name", CURES)
def test_scans_of_other_endings_are_named_with_a_cure(tmp_path, name):
    (tmp_path / "drive").mkdir()
    np.savetxt(tmp_path / "drive" / name, xyz_of(TABLE).numpy())
    ending = name[1:]
    with pytest.raises(DataError, match=rf"no scan that we read but 1 file \{ending}; .*{CURES[name]}"):
        open_dataset(str(tmp_path))
    with pytest.raises(ScanError, match=f"whose ending we do not know.*{CURES[name]}"):
        read_scan(tmp_path / "drive" / name)
    write_bin(tmp_path / "drive" / "b.bin")
    assert open_dataset(str(tmp_path)).notes == (
        f"1 file {ending} beside 1 that are read left out; {cure_of_ending(Path(name))}",
    )


def test_poses_times_and_remarks_beside_scans_are_not_called_scans(tmp_path):
    write_bin(tmp_path / "a.bin")
    for name, text in {
        "poses": "1 0 0 0 0 1 0 0 0 0 1 0\n",
        "times": "0.1\n",
        "calib": "Tr: 1 0 0\n",
        "README": "8 scans of a drive\n",
        "timestamps": "2011-09-26 13:02:25.964389445\n",
        "tum": "".join(f"{at / 10} {at} 0 0 0 0 0 1\n" for at in range(9)),
        "gps": "".join(f"{1326030975.7 + at} 42.29 -83.71 270.1\n" for at in range(9)),
        "gps_from_0": "".join(f"{at / 10:.1f},42.29,-83.71,270.1\n" for at in range(9)),
    }.items():
        (tmp_path / f"{name}.txt").write_text(text)
    assert open_dataset(str(tmp_path)).notes == ()
    for first in ("0 0 0 0\n0 1 2 3\n", "4571234.5 1 2\n4571235.5 1 2\n", "-1.5e+00, 2, 0.3 , 17\n1 2 3 4\n"):
        (tmp_path / "cloud.txt").write_text(first)
        assert is_of_other_program(tmp_path / "cloud.txt")
    assert open_dataset(str(tmp_path)).notes[0].startswith("1 file .txt beside 1 that are read left out; put a line")
    for name in ("b.laz", "c.laz"):
        (tmp_path / name).write_bytes(b"LASF")
    told = "2 files .laz, 1 file .txt beside 1 that are read left out; of .laz: unpack it to .las"
    assert open_dataset(str(tmp_path)).notes[0].startswith(told)


def test_the_cure_for_text_works(tmp_path):
    np.savetxt(tmp_path / "a.csv", xyz_of(TABLE).numpy(), header="x y z", comments="")
    assert len(read_scan(tmp_path / "a.csv")) == len(TABLE["x"])


def packets(port):
    payload = b"\xff\xee" + bytes(1204)
    ip = b"\x45\0" + struct.pack(">H", 28 + len(payload)) + bytes(5) + b"\x11\0\0" + bytes(8)
    packet = bytes(12) + b"\x08\0" + ip + struct.pack(">HHHH", port, port, 8 + len(payload), 0) + payload
    record = struct.pack("<IIII", 1, 0, len(packet), len(packet)) + packet
    return b"\xd4\xc3\xb2\xa1" + struct.pack("<HHiIII", 2, 4, 0, 0, 65535, 1) + 5 * record


@pytest.mark.parametrize(("port", "maker"), [(2368, "Velodyne and Hesai"), (6699, "RoboSense's")])
@pytest.mark.parametrize("with_json", [False, True])
def test_packets_of_other_makers_are_told(tmp_path, port, maker, with_json):
    (tmp_path / "a.pcap").write_bytes(packets(port))
    if with_json:
        (tmp_path / "my_sensor.json").write_text("{}")
    with pytest.raises(
        ScanError, match=f"no recording of an Ouster .UDP port {port} is .*{maker}.; .*convert it by the"
    ):
        read_scan(tmp_path / "a.pcap")


def test_packets_of_an_ouster_lack_its_metadata(tmp_path):
    (tmp_path / "a.pcap").write_bytes(packets(7502))
    with pytest.raises(
        ScanError, match=r"without a\.json; .*if an Ouster sent it, .*else convert it by the maker's tool"
    ):
        read_scan(tmp_path / "a.pcap")


def test_a_link_in_place_of_a_file_is_not_taken_as_written(tmp_path, capsys):
    write_bin(tmp_path / "a.bin")
    words = ["export", str(tmp_path / "a.bin"), str(tmp_path / "out"), "--format", "pcd"]
    assert main(words) == 0
    (tmp_path / "out" / "a.pcd").unlink()
    (tmp_path / "out" / "a.pcd").symlink_to(tmp_path / "a.bin")
    assert main(words) == 2
    assert "a.pcd, which is a link; wanted a file of this command, or none; remove the link" in capsys.readouterr().err


def test_points_tell_their_sensor_to_who_reads_them_back_unless_it_is_that_of_the_tree(tmp_path):
    for kind in ("ply", "kitti_odometry"):
        assert export_scans("simulated:1@vlp16", tmp_path / kind, kind) == 1
    assert open_source(str(tmp_path / "ply")).sensor.height == 16
    assert open_source(f"kitti_odometry:{tmp_path / 'kitti_odometry'}").sensor.height == 16
    for kind, told in (("ply", True), ("kitti_odometry", False)):
        export_scans("simulated:1", tmp_path / "of_kitti" / kind, kind)
        assert (tmp_path / "of_kitti" / kind / SENSOR_FILE).exists() == told
        assert open_source(str(tmp_path / "of_kitti" / kind)).sensor.name == "hdl64e_kitti_odometry"


def test_a_sensor_that_is_not_known_is_not_told_and_a_foreign_file_of_that_name_does_not_stop_an_export(tmp_path):
    export_scans("simulated:1", tmp_path / "scans", "bin")
    (tmp_path / "scans" / SENSOR_FILE).write_text('{"token": 1}', encoding="utf-8")
    assert export_scans(str(tmp_path / "scans"), tmp_path / "foreign", "ply") == 1
    assert not (tmp_path / "foreign" / SENSOR_FILE).exists()
    assert named_scans(open_source("simulated:1@vlp16"), DataConfig()).sensor() == load_sensor("vlp16")
    of_several = open_source("simulated:1@vlp16").scans()
    of_several.sensors_differ = True
    assert PointScans(of_several, 1).sensor() is None
    assert all(load(name).sensors_differ for name in ("ncore", "py123d", "ouster"))


def test_files_of_a_format_with_a_sensor_of_its_own_tell_another(tmp_path):
    for name, told in (("vlp16", True), ("hdl32e", False)):
        export_scans(f"simulated:1@{name}", tmp_path / name, "nuscenes_bin")
        assert (tmp_path / name / "sensor.json").exists() == told
        assert load_sensor(open_source(str(tmp_path / name)).scans().sensor).name == name
