"""A condition that scans tell, from the preset to the page: a toy whose scans have a class."""

from pathlib import Path

import pytest
import torch

import toy_of_class
from lidargrit.cli import main
from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, DataError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load, load_class
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.scans.condition import Observed
from lidargrit.training import train
from lidargrit.training.plan import check_stages, plan_training
from lidargrit.training.stage import StageTraining
from lidargrit.viewer.serve.requests import SampleRequest
from lidargrit.viewer.serve.worker import compute_result, describe_model
from toy_of_class import OfClass, ToyConfig

FIT = TrainingConfig(8 * 6, 4, 0.1, validate_every=8, validation_scans=2, checkpoint_every=8, average_over_scans=0)


@pytest.fixture(autouse=True)
def toys(monkeypatch):
    """Add the toy to the generators and to what scans tell."""
    toy = discovery._Place(Path(toy_of_class.__file__), "toy_of_class")
    find, file = discovery._places, {"toy_of_class": toy}
    kinds = ("generators", "conditions")
    monkeypatch.setattr(discovery, "_places", lambda kind: {**find(kind), **(file if kind in kinds else {})})


def preset(generator: str = "toy_of_class", condition: str = "toy_of_class") -> Preset:
    data = DataConfig(
        ("simulated:6:train",), ("simulated:2:val",), columns=256, column_stride=8, workers=1, condition=condition
    )
    return Preset("a toy", generator, ToyConfig(), data, {"means": FIT})


def test_a_class_of_scans_is_learned_resumed_sampled_scored_and_served(tmp_path, monkeypatch, capsys):
    def fails(*_):
        raise DataError("a validation scan that is gone", "one that is there", "restore it")

    run = tmp_path / "run"
    train(preset(), tmp_path / "unbroken")
    with monkeypatch.context() as patched:
        patched.setattr(StageTraining, "validate", fails)
        with pytest.raises(DataError, match="that is gone"):
            train(preset(), run)
    train(preset(), run)
    model = load(run)
    weights = [dict(one.named_parameters())["means"] for one in (model, load(tmp_path / "unbroken"))]
    assert torch.equal(*weights)
    assert len(weights[0].unique()) == 3
    told = OfClass(torch.tensor([0, 1, 1]))
    scans = model.sample([5, 5, 6], told)
    assert torch.equal(torch.stack([one.range_m for one in model.stream([5, 5, 6], condition=told)]), scans.range_m)
    assert not torch.equal(scans.range_m[0], scans.range_m[1])
    assert torch.equal(model.sample([6], OfClass(torch.tensor([1]))).range_m[0], scans.range_m[2])
    assert main(["sample", str(run), str(tmp_path / "samples"), "-n", "3"]) == 0
    few = ["--metrics", "bev_jsd", "--intervals", "0"]
    assert main(["evaluate", str(tmp_path / "samples"), "simulated:3:test", *few]) == 0
    assert "bev_jsd" in capsys.readouterr().out
    assert describe_model("toy", model)["tasks"] == []
    (made,) = compute_result(model, SampleRequest(0, 5, 1, {}))
    assert torch.equal(made.images.range_m, model.sample([5]).range_m)


def test_conditions_that_do_not_fit_are_refused():
    model = preset().build_generator()
    with pytest.raises(ConfigError, match="got 1 seeds for 2 images"):
        model.sample([5], OfClass(torch.tensor([0, 1])))
    with pytest.raises(ConfigError, match="a generator 'toy_of_class', which cannot fill in"):
        model.sample([5], Observed.nothing(model.sensor, 1))
    other = check_stages(preset(condition="nothing"))
    assert other.told.kind not in {OfClass}
    cls = load_class("marginal")
    plain = cls.smallest_config(model.sensor)
    with pytest.raises(ConfigError, match=r"got data\.condition=toy_of_class for 'marginal', which cannot be told it"):
        check_stages(Preset("a toy", "marginal", plain, preset().data, {}))
    with pytest.raises(ConfigError, match="a condition of type OfClass for 'marginal'; wanted one of type Nothing"):
        cls(plain, model.sensor).sample([5], OfClass(torch.tensor([0])))


def test_its_plan_counts_what_it_is_told():
    assert plan_training(preset()).stages[0].flops >= 0
