"""What every data set promises; of a new file in datasets/, dataset_examples.py has to say where its scans lie."""

from pathlib import Path

import pytest
import torch

from dataset_examples import write_example
from lidargrit.core import discovery
from lidargrit.core.errors import DataError, UnknownNameError
from lidargrit.data.datasets import ScanDataset, load, open_dataset, recognise
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor

NAMES = discovery.names("datasets")
READ_ONLY, WITHOUT_FILES = {"ncore", "ouster", "pandaset", "py123d"}, {"simulated", "simulated_surfaces"}
ROOT = Path("4")  # a folder for those that read files, a count for the simulated one


@pytest.fixture(scope="module", params=NAMES)
def cls(request) -> type[ScanDataset]:
    return load(request.param)


@pytest.fixture(scope="module")
def example(cls, tmp_path_factory) -> Path:
    """The folder below which ROOT holds four scans."""
    folder = tmp_path_factory.mktemp(cls.public_name())
    if cls.public_name() in READ_ONLY:
        pytest.skip(f"{cls.title} are read, not written; other tests read real ones")
    if cls.public_name() not in WITHOUT_FILES:
        write_example(cls.public_name(), folder / ROOT, 4)
    return folder


@pytest.fixture
def dataset(cls, example, monkeypatch) -> ScanDataset:
    monkeypatch.chdir(example)
    return cls(ROOT)


def test_says_what_it_is(cls):
    said = (cls.title, cls.licence, cls.tree, cls.sensor, cls.citation)
    assert all(said), cls
    assert "\n" not in "".join(said)
    for scheme in cls.schemes.values():
        assert scheme.source
        assert scheme.leak.endswith("."), "a sentence on what the parts share"
        assert all(scheme.parts.values())
    assert discovery.summary("datasets", cls.public_name()), "a line for `lidargrit list`"
    assert load_sensor(cls.sensor).name == cls.sensor


def test_reads_what_it_wrote(cls, dataset):
    assert len(dataset) == 4
    scan = dataset.scan(0)
    assert len(scan) > 1000
    assert torch.equal(scan.points_xyz_m, dataset.scan(0).points_xyz_m), "a scan is the same each time"
    assert not torch.equal(dataset.scan(0).points_xyz_m[:1000], dataset.scan(1).points_xyz_m[:1000])


def test_every_scan_projects_with_the_sensor(dataset):
    sensor = load_sensor(dataset.sensor)
    for index in range(len(dataset)):
        image = project(dataset.scan(index), sensor)
        assert image.return_mask.any(dim=1).float().mean() > 0.5, "most rows have returns"


def test_order_is_sorted_and_stable_and_names_are_unique(cls, dataset):
    again = cls(ROOT)
    paths, paths_again = ([one.path(index) for index in range(len(one))] for one in (dataset, again))
    assert paths == paths_again
    assert None in paths or paths in (sorted(paths, key=str), sorted(paths, key=lambda path: path.name))
    names = [dataset.name(index) for index in range(len(dataset))]
    assert names == [again.name(index) for index in range(len(again))]
    assert len(set(names)) == len(names)


def test_an_index_past_the_end_is_an_index_error(dataset):
    for read in (dataset.scan, dataset.name, dataset.recording):
        with pytest.raises(IndexError):
            read(len(dataset))


def test_complementary_shares_cover_all_and_share_nothing(cls, dataset):
    for percent in ("25", "50", "62.5"):
        first, second = cls(ROOT, f"all[:{percent}%]"), cls(ROOT, f"all[{percent}%:]")
        names = [part.name(index) for part in (first, second) for index in range(len(part))]
        assert names == [dataset.name(index) for index in range(4)]


def test_names_do_not_depend_on_the_split(cls, dataset):
    last = cls(ROOT, "all[75%:]")
    assert (last.name(0), len(last)) == (dataset.name(3), 1)


def test_refuses_an_unknown_split_and_names_the_nearest(cls, dataset):
    known = next(iter(cls.splits()), "all")
    with pytest.raises(DataError, match=rf"'{known}x'.*wanted one such as .*{known}"):
        cls(ROOT, known + "x")


def test_refuses_a_share_that_is_none(cls, dataset):
    for share in ("[90]", "[90%:10%]", "[:]x", "[:101%]", "[a%:]", "[50%:50%]"):
        with pytest.raises(DataError, match=r"wanted a block of the scans such as \[:90%\]"):
            cls(ROOT, "all" + share)


def test_refuses_a_share_that_holds_no_scan(cls, dataset):
    with pytest.raises(DataError, match="leaves none"):
        cls(ROOT, "all[:1%]")


def test_refuses_a_wrong_root_with_the_tree_it_wants(cls, tmp_path):
    (tmp_path / "notes.txt").write_text("no scan")
    for root in (tmp_path, tmp_path / "missing", tmp_path / "notes.txt"):
        with pytest.raises(DataError) as refusal:
            cls(root)
        assert cls.tree in refusal.value.wanted
        assert str(root) in refusal.value.got
        assert "\n" not in str(refusal.value)


def test_a_root_that_is_one_folder_off_is_answered_with_the_right_one(cls, example, dataset):
    if dataset.path(0) is None or cls.public_name() == "folder":
        return  # a count is no folder, and any folder is a folder of scans
    right = (example / ROOT).resolve()
    inside = next(path for path in right.iterdir() if path.is_dir())
    for wrong in (right.parent, inside):
        if not cls.matches(wrong):
            with pytest.raises(DataError) as refusal:
                cls(wrong)
            assert f"try {cls.public_name()}:{right}" in refusal.value.cure
    with pytest.raises(DataError, match=str(right)):
        cls(right.parent)


def test_scans_of_one_sequence_are_of_one_recording(cls, dataset):
    recordings = {}
    for index in range(len(dataset)):
        recordings.setdefault(dataset.name(index).rpartition("/")[0], set()).add(dataset.recording(index))
    assert all(len(ones) == 1 for sequence, ones in recordings.items() if sequence), recordings
    assert [dataset.recording(i) for i in range(4)] == [cls(ROOT).recording(i) for i in range(4)]


def test_is_recognised_by_its_files_and_by_its_name(cls, dataset):
    if dataset.path(0):
        assert recognise(ROOT) == cls.public_name()
        assert type(open_dataset(str(ROOT))) is cls
        assert type(open_dataset(f"{ROOT}/:all[:50%]")) is cls
    named = open_dataset(f"{cls.public_name()}:{ROOT}:all[50%:]")
    assert type(named) is cls
    assert [named.name(index) for index in range(2)] == [dataset.name(2), dataset.name(3)]


def test_a_name_without_a_place_is_answered_with_the_tree(cls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for source in (cls.public_name(), cls.public_name() + ":"):
        with pytest.raises(DataError) as refusal:
            open_dataset(source)
        assert cls.tree in refusal.value.wanted


def test_a_misspelt_name_is_answered_with_the_nearest(cls):
    name = cls.public_name()
    with pytest.raises(UnknownNameError, match=name):
        open_dataset(f"{name}s:/data")
