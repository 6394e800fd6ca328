"""The paper's tables from scans to rows: which rows, killed and taken up again, told beforehand."""

import sys
from pathlib import Path

import pytest

from dataset_examples import write_example
from lidargrit.cli import main
from lidargrit.core import configuration
from lidargrit.core.errors import ConfigError
from lidargrit.evaluation.protocols import load_protocol
from lidargrit.evaluation.reproduction import TABLES, Reproduction, prepare
from lidargrit.evaluation.tables import published
from lidargrit.generation.presets import load_preset
from tiny_runs import MODEL, SIMULATED, the_one_line

STEPS = [  # 4 and 2 of them, a checkpoint after each
    *[f"training.{stage}.scans=16" for stage in ("tokenizer", "transformer")],
    "training.tokenizer.checkpoint_every=4",
    "training.transformer.checkpoint_every=8",
]


def words_for(folder: Path, *more: str) -> list[str]:
    few = ["-n", "4", "--flops", "0"]
    table = ["compare", str(folder), "--paper-table", "3", "--data", "simulated", "--small"]
    return [*table, *few, *more, "--set", *MODEL, *SIMULATED, *STEPS]


def reproduction_of(folder: Path) -> Reproduction:
    return Reproduction(3, "simulated", small=True, count=4, flops=0.0, settings=(*MODEL, *SIMULATED, *STEPS))


@pytest.mark.parametrize("number", TABLES)
def test_every_row_of_the_paper_is_measured(number):
    found, table = published()[number - 1], TABLES[number]
    assert f"table {number}" in found["source"]
    assert found["protocol"] == table.protocol
    assert {row["system"] for row in found["rows"]} == {*table.rows}
    for preset, small in table.rows.values():
        assert "simulated" in load_preset(small).data.train[0]
        assert load_preset(preset).published


@pytest.mark.parametrize("number", TABLES)
def test_images_are_those_that_the_protocol_wants(number):
    protocol = load_protocol(TABLES[number].protocol)
    wanted = Reproduction(number, "root")
    for system in wanted.systems().values():
        data = load_preset(system, wanted.comparison().preset_settings).data
        assert data.load_sensor().same_rays(protocol.load_sensor())
        assert data.projection_variant == protocol.variant
    assert wanted.comparison().num_samples == protocol.num_scans
    assert wanted.comparison().settings.metrics == ()


def test_a_plan_tells_scans_and_cost(tmp_path, capsys, monkeypatch):
    told_at_once = lambda preset: dict.fromkeys(preset.training, 10**18)  # noqa: E731
    monkeypatch.setattr(sys.modules["lidargrit.training.plan"], "training_flops", told_at_once)
    write_example("kitti_360", tmp_path / "root", 1)
    (scan,) = (tmp_path / "root").rglob("*.bin")
    for drive in ("0003", "0005"):
        other = Path(str(scan).replace("drive_0000", f"drive_{drive}"))
        other.parent.mkdir(parents=True)
        other.write_bytes(scan.read_bytes())
    assert (
        main(["compare", str(tmp_path / "out"), "--paper-table", "1", "--data", str(tmp_path / "root"), "--dry-run"])
        == 0
    )
    output = capsys.readouterr().out
    for split in ("train_without_val", "val", "test"):
        assert f"prepare kitti_360:{tmp_path / 'root'}:{split}: 1 scans" in output
    assert "train r2dm_kitti_360 (to do)" in output
    assert "1.00e+18 floating-point operations, by estimate" in output
    assert "sample 5,000 scans" in output
    assert "train lidargen_kitti_360 (to do)" in output
    assert "train ultralidar_kitti_360 (to do)" in output
    assert not (tmp_path / "out").exists()


def test_settings_that_a_stage_cannot_follow_are_told_before_any_scan(monkeypatch):
    monkeypatch.delattr("lidargrit.evaluation.reproduction.load_range_images")
    wrong = Reproduction(3, "simulated", small=True, flops=0.0, settings=("training.tokenizer.accumulate=3",))
    with pytest.raises(ConfigError, match="on 1 processes in 3 parts"):
        prepare(wrong.comparison(), [*wrong.systems().values()])


def test_another_number_and_another_place_are_refused(tmp_path, capsys):
    with pytest.raises(ConfigError, match="one of 1, 2, 3"):
        Reproduction(4, "simulated")
    table = ["compare", str(tmp_path / "out"), "--paper-table", "2"]
    for words, got in (
        ([*table, "--data", str(tmp_path), "--dry-run"], "KITTI odometry"),
        (table, "got --paper-table 2 without --data"),
        ([*table, "--data", "simulated", "--protocol", "exact"], "got --protocol with --paper-table 2"),
        ([*table[:2], "marginal", *table[2:], "--data", "simulated"], "got marginal with --paper-table 2"),
        (["compare", str(tmp_path / "out"), "marginal", "--small"], "got --small without --paper-table"),
    ):
        assert main(words) == 2
        assert got in the_one_line(capsys.readouterr().err, "compare")


def differing(first: str, second: str) -> set[str]:
    one, other = (configuration.leaves(load_preset(name)) for name in (first, second))
    assert one.keys() == other.keys()
    return {name for name in one if one[name] != other[name]} - {"title", "published"}


@pytest.mark.parametrize("small", [False, True])
def test_rows_of_the_ablation_differ_in_nothing_but_what_is_ablated(small):
    neither, raydrop, both = (presets[small] for presets in TABLES[3].rows.values())
    assert differing(neither, raydrop) == {"model.tokenizer.raydrop_loss"}
    assert differing(raydrop, both) == {"training.tokenizer.augmentations"}
    assert load_preset(raydrop).training["tokenizer"].augmentations == ()
    assert load_preset(both).training["tokenizer"].augmentations == ("geometric",)
    assert load_preset(both).training["transformer"].augmentations == ()


def test_released_configurations_differ_in_what_their_files_say():
    losses = {"model.tokenizer.reconstruction", "model.tokenizer.codebook_loss", "data.projection_variant"}
    training = {"training.tokenizer.augmentations"}
    training |= {f"training.{stage}.average_over_scans" for stage in ("tokenizer", "transformer")}
    columns = {"data.columns", "data.column_stride"}
    assert differing("lidargrit_kitti_360", "lidargrit_kitti_360_reference") == losses | training | columns
    weight = {"model.tokenizer.raydrop_weight"}
    assert differing("lidargrit_kitti_odometry", "lidargrit_kitti_odometry_reference") == losses | training | weight
