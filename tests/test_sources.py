"""A source is recognised once, by one function, and the object that it returns is passed on."""

import ast
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from lidargrit.cli import main
from lidargrit.core.errors import CheckpointError, ConfigError, DataError, ScanError, UnknownNameError
from lidargrit.data import sources
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
from lidargrit.data.prepared.prepared import PreparedImages
from lidargrit.data.sources import (
    DatasetSource,
    PreparedSource,
    RunSource,
    SampleSource,
    data_set_of,
    load_range_images,
    open_source,
)
from lidargrit.data.sources.image_files import ImageFileSource
from lidargrit.evaluation.compare import CompareConfig
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_sources
from lidargrit.evaluation.intervals import Resampling
from lidargrit.inference.samples import write_samples
from lidargrit.scans.sensors import load_sensor
from test_generator_contract import made

ONE = DataConfig(workers=1)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a folder of every kind that a source may be."""
    root = tmp_path_factory.mktemp("sources")
    generator, _ = made("marginal")
    generator.save(root / "run")
    write_samples(generator, root / "run", root / "samples", range(2))
    for split in ("train", "test"):
        prepare(f"simulated:4:{split}", ONE, root / split)
    return root


def test_every_kind_is_told_from_its_name(folders):
    kinds = {"run": RunSource, "samples": SampleSource, "train": PreparedSource}
    for name, kind in kinds.items():
        assert type(open_source(str(folders / name))) is kind
    assert type(open_source("simulated:4:test")) is DatasetSource
    assert type(open_source("pretrained")) is RunSource
    prepared = open_source(str(folders / "test"))
    assert (prepared.data_set, prepared.split) == ("simulated", "test")
    as_projected = prepared.as_projected(DataConfig(projection_variant="reference"))
    assert as_projected.projection_variant == "exact", "as they were prepared"
    samples = open_source(str(folders / "samples"))
    assert (samples.data_set, len(samples.images())) == ("samples", 2)
    assert samples.sensor.same_rays(open_source(str(folders / "run")).sensor)


def test_range_images_in_npy_files_are_a_set_of_a_named_sensor(tmp_path, capsys):
    sensor, folder = load_sensor("vlp16").with_columns(90), tmp_path / "images"
    folder.mkdir()
    for index in range(4):
        range_m = np.full((16, 90), 10.0 + index, np.float64)
        range_m[:, :30], range_m[0, 40], range_m[1, 41] = 0, np.nan, np.inf
        np.save(folder / f"{index}.npy", range_m)
    source = open_source(str(folder))
    assert type(source) is ImageFileSource
    images = source.images(sensor, DataConfig(max_scans=2))
    assert images.batch([1]).return_mask.sum() == 16 * 60 - 2
    assert images.batch([1]).range_m.max() == 12, "two of four, evenly spaced"
    words = ["evaluate", str(folder), str(folder), "--metrics", "bev_jsd", "--intervals", "0", "--json", "scores.json"]
    assert main([*words, "--overwrite"]) == 2
    assert "got range images of 16x90 in" in (told := capsys.readouterr().err)
    assert "name it with --sensor NAME or FILE.json, which may have other columns" in told
    assert main(["export", str(folder), str(tmp_path / "points")]) == 2
    assert "--set" not in capsys.readouterr().err, "which export does not have"
    (tmp_path / "narrow.json").write_text(json.dumps(sensor.to_json()))
    assert main(["export", str(folder), str(tmp_path / "points"), "--sensor", str(tmp_path / "narrow.json")]) == 0
    out = tmp_path / "scores.json"
    named = ["--sensor", "vlp16", "--set", "data.columns=90"]
    assert main([*words[:-1], str(out), *named]) == 0
    assert {score["value"] for score in json.loads(out.read_text())["scores"]} == {0.0}
    assert main(["view", str(folder), "-o", str(tmp_path / "view.png"), "-n", "1", *named]) == 0
    np.save(folder / "4.npy", np.ones((16, 91), np.float32))
    with pytest.raises(ScanError, match=r"4.npy, a range image of 16x91; wanted 16x90, as the sensor 'vlp16' has"):
        open_source(str(folder)).images(sensor).batch([4])
    np.save(folder / "4.npy", np.ones((16, 90), bool))
    with pytest.raises(ScanError, match=r"4.npy, an array of truth values; wanted a range image"):
        open_source(str(folder)).images(sensor).batch([4])
    (folder / "log.csv").write_text("step,loss\n1,2\n")
    with pytest.raises(DataError, match=r"with range images and log\.csv; .*alone; move that file elsewhere"):
        open_source(str(folder))
    (folder / "log.csv").unlink()
    np.save(folder / "0.npy", np.ones((16, 90), bool))
    with pytest.raises(ScanError, match=r"0\.npy, an array of truth values; .*move masks to another folder"):
        open_source(str(folder))
    (tmp_path / "scans").mkdir()
    np.save(tmp_path / "scans" / "poses.npy", np.ones((5, 12)))
    (tmp_path / "scans" / "a.csv").write_text("x,y,z\n1,2,3\n")
    assert type(open_source(str(tmp_path / "scans"))) is DatasetSource, "with a table beside its scans"
    np.save(tmp_path / "points.npy", np.ones((100, 4), np.float32))
    assert type(open_source(str(tmp_path / "points.npy"))) is DatasetSource


def test_two_prepared_folders_are_opened_once_each(folders, monkeypatch):
    opened: Counter[str] = Counter()
    plain = PreparedImages.__init__

    def counted(self, location):
        opened[Path(location).name] += 1
        plain(self, location)

    monkeypatch.setattr(PreparedImages, "__init__", counted)
    quick = EvalConfig(metrics=("return_rate_per_ring",), resampling=Resampling(halves=0), data=ONE)
    card, pair = evaluate_sources(str(folders / "train"), str(folders / "test"), quick)
    assert opened == {"train": 1, "test": 1}
    assert (card.samples.split, card.reference.split) == ("train", "test")
    assert len(pair.samples) == 4


def test_a_part_of_a_prepared_folder_is_the_same_as_of_its_scans(folders):
    some = DataConfig(workers=1, max_scans=2)
    prepared = open_source(str(folders / "train")).images(None, some)
    names = open_source(str(folders / "train")).images().provenance.names
    assert prepared.provenance.names == (names[0], names[2])
    assert len(prepared) == 2


def test_what_a_kind_cannot_give_is_refused_in_one_line(folders):
    with pytest.raises(DataError, match="which holds a trained model; wanted scans or samples; generate some first"):
        open_source(str(folders / "run")).images()
    with pytest.raises(DataError, match="which holds generated range images; wanted the points of scans"):
        open_source(str(folders / "samples")).scans()
    with pytest.raises(DataError, match="which holds generated range images; wanted scans, or scans that were prepare"):
        load_range_images((str(folders / "samples"),), ONE)


def test_numbers_too_large_are_refused_before_any_work():
    with pytest.raises(ConfigError, match=r"-n 100000000000000000000, --seed 0; wanted at most 10,000,000 scans"):
        EvalConfig(max_scans=10**20)
    with pytest.raises(ConfigError, match="a seed from 0 to"):
        EvalConfig(seed=2**64)
    with pytest.raises(ConfigError, match="100000000000000000000 samples"):
        CompareConfig("simulated:2:test", 10**20)


@pytest.mark.parametrize("name", ["~nobody-of-that-name/x", "x" * 5000, "x/" * 3000, "no such folder"])
def test_names_that_no_folder_can_have(name):
    with pytest.raises((DataError, UnknownNameError)):
        open_source(name)


def test_the_data_set_of_prepared_scans_is_told_when_the_scans_are_gone(tmp_path):
    prepare("simulated:1", ONE, tmp_path / "prepared")
    plan = json.loads((tmp_path / "prepared" / "plan.json").read_text())
    plan["source"] = "kitti_360:/nowhere/kitti_360:test"
    (tmp_path / "prepared" / "plan.json").write_text(json.dumps(plan))
    source = open_source(str(tmp_path / "prepared"))
    assert (source.data_set, source.split) == data_set_of(str(tmp_path / "prepared")) == ("kitti_360", "test")


def test_nobody_else_asks_what_a_source_is():
    """Only ``data`` recognises: its sources, by what data sets and prepared scans define."""
    asking = {"is_prepared", "is_sample_folder", "is_tensor_folder", "open_dataset", "PreparedFolder"}
    root = Path(sources.__file__).parents[2]
    found = {}
    for path in root.rglob("*.py"):
        place = path.relative_to(root)
        if place.parts[0] != "data" and place != Path("inference/samples.py"):  # which writes such a folder
            names = {node.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Name)}
            if asked := sorted(names & asking):
                found[place.as_posix()] = asked
    assert found == {}


@pytest.mark.parametrize("verb", ["prepare", "inspect", "fit-sensor"])
def test_a_verb_that_wants_points_says_what_a_source_holds_instead(verb, capsys):
    assert main([verb, "pretrained"]) == 2
    assert "pretrained, which holds a trained model; wanted the points of scans" in capsys.readouterr().err


@pytest.mark.parametrize("begun", ["run.json", "checkpoint.safetensors"])
def test_an_unfinished_run_is_told_as_such(tmp_path, begun):
    (tmp_path / begun).write_text("{}")
    with pytest.raises(CheckpointError, match=r"holds no finished model.*finish the training"):
        open_source(str(tmp_path))
