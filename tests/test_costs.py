"""What a system of a comparison costs: measured once, of the weights and the reference of today, and read back."""

import json
from dataclasses import replace

import pytest

from lidargrit.core.errors import CheckpointError
from lidargrit.evaluation import costs
from lidargrit.evaluation.compare import as_table
from lidargrit.evaluation.compare import run as run_comparison
from lidargrit.evaluation.costs import COSTS, Costs
from test_compare import COMPARISON
from test_generator_contract import made


def test_bits_are_of_the_reference_of_today_and_a_time_once_measured_stays(tmp_path, monkeypatch):
    measured = iter((1.5, 2.5))
    monkeypatch.setattr(costs, "bits_per_return", lambda generator, scans: next(measured))
    run_comparison(["marginal"], tmp_path, COMPARISON)
    first = json.loads((tmp_path / "marginal" / "costs.json").read_text())
    run_comparison(["marginal"], tmp_path, COMPARISON)  # nothing new
    assert json.loads((tmp_path / "marginal" / "costs.json").read_text()) == first
    scores = run_comparison(["marginal"], tmp_path, replace(COMPARISON, reference="simulated:8:val"))
    second = json.loads((tmp_path / "marginal" / "costs.json").read_text())
    assert (first["bits_per_return"], second["bits_per_return"]) == (1.5, 2.5)
    assert first["seconds_per_scan"] == second["seconds_per_scan"]
    assert r"& 2.5 \\" in as_table(scores, "latex")


def test_the_time_of_many_scans_outlives_that_of_one(tmp_path):
    run_comparison(["marginal"], tmp_path, COMPARISON)
    path = tmp_path / "marginal" / COSTS
    before = json.loads(path.read_text())
    assert before["scans"] == 8
    (tmp_path / "marginal" / "samples" / "00000003.npz").unlink()
    run_comparison(["marginal"], tmp_path, COMPARISON)
    assert json.loads(path.read_text())["seconds_per_scan"] == before["seconds_per_scan"]


def test_a_time_that_is_lacking_is_added(tmp_path):
    generator, path = made("marginal")[0], tmp_path / COSTS
    for timed, seconds in ((None, None), ((1, 0.5), 0.5), (None, 0.5)):
        Costs(path, "aa").write(generator, generator.Sampling(), None, timed)
        assert json.loads(path.read_text())["seconds_per_scan"] == seconds


@pytest.mark.parametrize("change", [{"parameters": "many"}, {"training_flops": [1]}, {"scans": None}, None])
def test_damaged_costs_are_refused_in_one_line(change, tmp_path):
    costs = {"parameters": 3, "training_flops": None, "network_evaluations": 1, "flops_per_scan": 5.0}
    (tmp_path / "costs.json").write_text(json.dumps({**costs, "seconds_per_scan": 1, **change} if change else costs))
    with pytest.raises(CheckpointError, match="is no number; wanted what lidargrit compare wrote; remove"):
        as_table([tmp_path / "scores.json"])


def test_costs_of_other_weights_are_measured_again(tmp_path):
    """As after a run was trained anew in the same folder."""
    generator, path = made("marginal")[0], tmp_path / COSTS

    def written(weights, timed):
        Costs(path, weights).write(generator, generator.Sampling(), None, timed)
        return json.loads(path.read_text())

    first = written("aa", (8, 0.5))
    path.write_text(json.dumps({**first, "bits_per_return": 3.0, "reference": {}}))
    assert written("aa", (2, 0.25))["bits_per_return"] == 3.0, "of more scans, and of the same weights"
    second = written("bb", (2, 0.25))
    assert (second["seconds_per_scan"], second["weights_sha256"]) == (0.25, "bb")
    assert second["bits_per_return"] is None
    assert written("cc", None)["seconds_per_scan"] is None, "no time rather than that of other weights"
