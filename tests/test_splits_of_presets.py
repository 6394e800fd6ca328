"""No preset watches or is tested on what it learns from: told by the files that its sources find."""

from pathlib import Path

import pytest

from lidargrit.core import discovery
from lidargrit.data.datasets import load, open_dataset
from lidargrit.evaluation.protocols import load_protocol
from lidargrit.evaluation.reproduction import TABLES, Reproduction
from lidargrit.generation.presets import load_preset

TREES = {  # every drive that was released
    "kitti_360": ("data_3d_raw/2013_05_28_drive_{:04d}_sync/velodyne_points/data", (0, *range(2, 8), 9, 10)),
    "kitti_odometry": ("sequences/{:02d}/velodyne", range(22)),
}
PROTOCOLS = {"kitti_360": "lidargrit_kitti_360", "kitti_odometry": "lidargrit_kitti_odometry"}
ON_KITTI = {  # preset → its data set
    name: source.partition(":")[0]
    for name in discovery.names("presets")
    for source in load_preset(name).data.train
    if source.partition(":")[0] in TREES and source.split(":")[1].startswith("data/")  # others are simulated drives
}


@pytest.fixture(scope="module")
def roots(tmp_path_factory) -> dict[str, Path]:
    roots = {}
    for name, (folder, drives) in TREES.items():
        roots[name] = tmp_path_factory.mktemp(name)
        for drive in drives:
            drive_folder = roots[name] / folder.format(drive)
            drive_folder.mkdir(parents=True)
            (drive_folder / f"{0:010d}.bin").touch()
    return roots


def found(source: str, root: Path) -> tuple[set[str], set[str]]:
    """Return the scans and the recordings that a source finds below another root."""
    name, _, rest = source.partition(":")
    dataset = open_dataset(f"{name}:{root}:{rest.rpartition(':')[2]}")
    everything = range(len(dataset))
    return {str(dataset.path(index)) for index in everything}, {dataset.recording(index) for index in everything}


def test_there_are_such_presets():
    assert {
        "lidargrit_kitti_360",
        "lidargen_kitti_360",
        "r2dm_kitti_360",
        "lidargrit_kitti_odometry_neither",
    } <= ON_KITTI.keys()
    assert len(ON_KITTI) >= 8


@pytest.mark.parametrize("preset", ON_KITTI)
def test_train_val_and_test_share_no_scan_and_no_drive(preset, roots):
    data_set, data = ON_KITTI[preset], load_preset(preset).data
    tested = [f"{data_set}::{split}" for split in load_protocol(PROTOCOLS[data_set]).splits]
    for first, second in ((data.train, data.val), (data.train, tested), (data.val, tested)):
        for one in first:
            for other in second:
                for mine, theirs in zip(found(one, roots[data_set]), found(other, roots[data_set]), strict=True):
                    assert mine
                    assert theirs
                    assert not mine & theirs


@pytest.mark.parametrize("number", TABLES)
def test_a_reproduction_takes_the_very_splits_of_its_presets(number):
    wanted = Reproduction(number, "ROOT")
    assert wanted.comparison().reference == f"{TABLES[number].data_set}:ROOT:test"
    assert "test" in load_protocol(TABLES[number].protocol).splits
    for preset in wanted.systems().values():
        own, taken = load_preset(preset).data, load_preset(preset, wanted.comparison().preset_settings).data
        for mine, theirs in ((own.train, taken.train), (own.val, taken.val)):
            assert [source.rpartition(":")[2] for source in mine] == [s.rpartition(":")[2] for s in theirs]


def test_the_reference_program_s_splits_do_share_drives():
    """The mistakes that our presets do not repeat are told as splits, too, and this test would see them."""
    parts = load("kitti_360").splits()
    train, test = set(parts["lidargrit-code/train"]), set(parts["lidargrit-code/test"])
    assert set(parts["lidargrit-code/val_tokenizer"]) <= train
    assert set(parts["lidargrit-code/val_transformer"]) <= test
