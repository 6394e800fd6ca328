"""Files that a scan is read from beside its own: prepared images are stale when one comes, goes or changes."""

import json
import os

import numpy as np
import pytest

from dataset_examples import write_example
from lidargrit.core.discovery import names
from lidargrit.core.errors import OutputError
from lidargrit.core.files import remembered
from lidargrit.data import formats
from lidargrit.data.datasets import open_dataset
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.formats import ouster_pcap, read_scan
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare

CONFIG = DataConfig(workers=1)


def test_every_format_that_tells_of_a_companion_names_its_file(tmp_path):
    for name in names("formats"):
        form = formats.load(name)
        assert bool(form.companion) <= bool(form.sidecar_files(tmp_path / f"a{form.suffixes[0]}"))


def test_labels_that_come_later_make_prepared_scans_stale(tmp_path):
    tree = tmp_path / "tree"
    write_example("kitti_odometry", tree, 1)
    source, out = f"kitti_odometry:{tree}", tmp_path / "out"
    cached = prepare(source, CONFIG)
    prepare(source, CONFIG, out)
    dataset = KittiOdometry(tree)
    *_, labels = dataset.sidecar_files(0)
    labels.parent.mkdir()
    np.full(len(dataset.scan(0)), 40, "<u4").tofile(labels)
    with pytest.raises(OutputError, match="stale"):
        prepare(source, CONFIG, out)
    labelled = prepare(source, CONFIG)
    assert labelled != cached
    assert prepare(source, CONFIG) == labelled
    os.utime(labels, ns=(0, 0))
    assert prepare(source, CONFIG) not in {cached, labelled}
    labels.unlink()
    assert prepare(source, CONFIG) == cached


@pytest.mark.parametrize("named", ["argoverse2", "folder"])
def test_a_calibration_belongs_to_the_scans_of_its_log(named, tmp_path):
    pytest.importorskip("pyarrow")
    write_example("argoverse2", tmp_path / "tree", 1)
    dataset = open_dataset(f"{named}:{tmp_path / 'tree'}")
    (calibration,) = dataset.sidecar_files(0)
    assert calibration.parent.name == "calibration"
    assert calibration.parent.parent == dataset.path(0).parents[2]


def test_what_was_read_is_kept_until_one_of_its_files_changes(tmp_path):
    read = []

    @remembered(lambda path: [path, path.with_suffix(".json")])
    def opened(path):
        read.append(path.with_suffix(".json").read_text() if path.with_suffix(".json").exists() else "")
        return read[-1]

    recording, metadata = tmp_path / "a.pcap", tmp_path / "a.json"
    assert ouster_pcap.OusterPcap.sidecar_files(recording) == (metadata,)
    assert [opened(recording), opened(recording)] == ["", ""]
    metadata.write_text("1")
    assert [opened(recording), opened(recording)] == ["1", "1"]
    metadata.write_text("10")
    assert opened(recording) == "10"
    assert read == ["", "1", "10"]


def test_elevations_that_change_move_the_points(real, tmp_path):
    pytest.importorskip("ouster.sdk")
    (source,) = (real / "other_sensors" / "ouster").glob("*.pcap")
    for ending in (".pcap", ".json"):
        (tmp_path / f"a{ending}").write_bytes(source.with_suffix(ending).read_bytes())
    before = read_scan(tmp_path / "a.pcap").points_xyz_m
    metadata = json.loads((tmp_path / "a.json").read_text())
    beams = metadata.get("beam_intrinsics", metadata)
    beams["beam_altitude_angles"] = [angle + 3 for angle in beams["beam_altitude_angles"]]
    (tmp_path / "a.json").write_text(json.dumps(metadata))
    after = read_scan(tmp_path / "a.pcap").points_xyz_m
    assert float((after - before)[:, 2].median()) > 0.05
