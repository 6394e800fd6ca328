"""Samples in which every ray returns: metrics of raydrop say "not applicable" wherever scores are told."""

import json
from dataclasses import replace

import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import CheckpointError
from lidargrit.core.files import write_json
from lidargrit.core.table import render
from lidargrit.data.images import Provenance
from lidargrit.data.sources.samples import MANIFEST, read_facts
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_sources
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, Scorecard
from lidargrit.evaluation.tables import side_by_side
from lidargrit.inference.samples import write_samples
from lidargrit.publishing.card import model_card
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.dusty.system import Dusty
from lidargrit.systems.lidargan.system import LidarGan
from lidargrit.viewer.report import page

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
RAYDROP = ("return_rate_per_ring", "return_rate_per_range", "return_rate_by_incidence", "drop_run_lengths")
RAYDROP += ("drop_correlation",)
SETTINGS = EvalConfig(metrics=(*RAYDROP, "range_histogram_per_ring"), resampling=Resampling(halves=0))


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """Return folders of samples of LidarGAN and of DUSty, untrained."""
    folder = tmp_path_factory.mktemp("sets")
    for cls in (LidarGan, Dusty):
        with torch.random.fork_rng():
            torch.manual_seed(0)
            generator = cls(cls.smallest_config(SENSOR), SENSOR).eval()
        name = generator.public_name()
        generator.save(folder / f"{name}_run")
        write_samples(generator, folder / f"{name}_run", folder / name, range(4))
    return folder


@pytest.fixture(scope="module")
def compared(sets):
    return evaluate_sources(str(sets / "lidargan"), str(sets / "dusty"), SETTINGS)


def test_samples_tell_which_rows_are_full(sets):
    assert read_facts(sets / "lidargan").full_rows == range(40, 64)
    assert read_facts(sets / "dusty").full_rows is None


def test_a_manifest_with_other_rows_is_refused(sets, tmp_path):
    manifest = json.loads((sets / "lidargan" / MANIFEST).read_text())
    write_json(tmp_path / MANIFEST, {**manifest, "full_rows": "all"})
    with pytest.raises(CheckpointError, match="whose full_rows are no two rows"):
        read_facts(tmp_path)


def test_the_scorecard_says_so_in_words(compared, tmp_path):
    card, _ = compared
    assert {each.metric: each.verdict for each in card.left_out} == dict.fromkeys(RAYDROP, NOT_APPLICABLE)
    assert [score.result.metric for score in card.scores] == ["range_histogram_per_ring"]
    table = card.as_table()
    assert f"not applicable: {', '.join(RAYDROP)}: " in table
    assert table.count("has no raydrop: its generator fills rows 40 to 63 of 64 with returns") == 1
    assert "metrics of pixels and points count the empty rows as missing" in card.warnings[0]
    write_json(tmp_path / "card.json", card.to_json())
    assert Scorecard.read(tmp_path / "card.json").left_out == card.left_out


def test_it_does_not_matter_which_set_has_no_raydrop(sets):
    card, _ = evaluate_sources(str(sets / "dusty"), str(sets / "lidargan"), SETTINGS)
    assert {each.metric for each in card.left_out} == set(RAYDROP)


def test_metrics_of_raydrop_alone_give_a_table_and_no_error(sets, capsys):
    words = ["evaluate", str(sets / "lidargan"), str(sets / "dusty"), "--metrics", "drop_correlation"]
    assert main(words) == 0
    output = capsys.readouterr().out
    assert ["drop_correlation", "exact", "not", "applicable"] in [line.split()[:4] for line in output.splitlines()]


def test_tables_and_pages_say_so_too(compared, sets, tmp_path):
    card, pair = compared
    other, _ = evaluate_sources(str(sets / "dusty"), str(sets / "dusty"), SETTINGS)
    write_json(tmp_path / "lidargan.json", card.to_json())
    write_json(tmp_path / "dusty.json", replace(other, reference=card.reference).to_json())
    for order in (("lidargan", "dusty"), ("dusty", "lidargan"), ("lidargan",)):
        text = render(side_by_side([tmp_path / f"{name}.json" for name in order]))
        row, *_ = [line for line in text.splitlines() if line.startswith("lidargan  ")]
        assert row.count(NOT_APPLICABLE) == len(RAYDROP)
    shown = page(card, pair)
    assert shown.count(f">{NOT_APPLICABLE}<") == len(RAYDROP)
    assert "Not applicable: " in shown.partition("Return rate by ring")[2]
    generator = LidarGan(LidarGan.smallest_config(SENSOR), SENSOR)
    assert model_card(generator, {}, Provenance(), card).count(NOT_APPLICABLE) == len(RAYDROP)
