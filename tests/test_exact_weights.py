"""Weights that would be loaded without a word, although no training made them."""

import re
from pathlib import Path

import pytest
import torch
from torch import nn

from lidargrit.core.errors import CheckpointError
from lidargrit.core.files import read_tensors, write_tensors
from lidargrit.data.images import RangeImages
from lidargrit.generation.generator import load, load_class
from lidargrit.nn.exact_weights import load_exactly
from lidargrit.scans.sensors import load_sensor
from seeded_images import SeededImages

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
FILE = Path("model.safetensors")


def module() -> nn.Module:
    norm = nn.BatchNorm1d(2)
    norm.register_buffer("unfitted", torch.tensor(torch.nan))
    norm.register_buffer("known", torch.ones(2, dtype=torch.bool))
    return norm


@pytest.mark.parametrize(
    ("name", "change", "got", "wanted"),
    [
        ("bias", lambda bias: bias.int(), "'bias' is of whole numbers", "real numbers"),
        ("bias", lambda bias: bias.to(torch.complex64), "'bias' is of complex numbers", "real numbers"),
        ("bias", lambda bias: bias > 0, "'bias' is of truth values", "real numbers"),
        ("known", lambda known: known.long(), "'known' is of whole numbers", "truth values"),
        ("num_batches_tracked", lambda count: count.float(), "is of real numbers", "whole numbers"),
        ("weight", lambda weight: weight / 0, "'weight' holds NaN or infinity", "finite numbers"),
        ("weight", lambda weight: weight * torch.tensor([1.0, torch.nan]), "'weight' holds NaN", "finite numbers"),
        ("weight", lambda weight: weight.double() * 1e300, "'weight' holds NaN or infinity", "finite numbers"),
    ],
)
def test_numbers_of_another_kind_and_parameters_that_are_none_are_refused(name, change, got, wanted):
    loaded = module()
    weights = {each: tensor.clone() for each, tensor in loaded.state_dict().items()}
    weights[name] = change(weights[name])
    message = rf"^got weights in {re.escape(str(FILE))}, of which .*{got}.*; wanted {wanted}; "
    with pytest.raises(CheckpointError, match=message):
        load_exactly(loaded, weights, FILE)
    assert torch.equal(loaded.weight, torch.ones(2)), "the module stays as it was"


def test_all_that_differs_in_names_and_sizes_is_counted():
    weights = {f"new{number}": torch.ones(1) for number in range(5)} | {"bias": torch.ones(3, 2)}
    with pytest.raises(CheckpointError) as refused:
        load_exactly(module(), weights, FILE)
    assert refused.value.got == (
        "weights in model.safetensors of another configuration (the file lacks 'known', 'num_batches_tracked', "
        "'running_mean' and 3 more; the file has besides 'new0', 'new1', 'new2' and 2 more; of another size 'bias' 3x2 "
        "in place of 2)"
    )
    assert refused.value.wanted == "the 7 of this model"


def test_other_sizes_of_the_same_kind_and_buffers_that_were_never_fitted_are_loaded():
    weights = {**module().state_dict(), "weight": torch.full((2,), 0.5, dtype=torch.float16)}
    loaded = module()
    load_exactly(loaded, weights, FILE)
    assert loaded.weight.tolist() == [0.5, 0.5]
    assert loaded.weight.dtype == torch.float32
    assert bool(loaded.unfitted.isnan())


@pytest.mark.parametrize(
    ("name", "change", "got"),
    [
        ("memorised", {"scans": lambda scans: scans + 1}, "which counts 4 scans and holds 3; wanted as many as"),
        ("memorised", {"scans": lambda scans: -scans}, "which counts -3 scans and holds 3; wanted as many as"),
        (
            "marginal",
            {"counts": lambda counts: counts - 1},
            "with pixels of less than 0 returns, or of more than its 3",
        ),
        ("marginal", {"scans": lambda scans: scans - 1}, "or of more than its 2 scans; wanted 0 to as many as"),
    ],
)
def test_counts_that_contradict_what_was_kept_are_refused(name, change, got, tmp_path):
    cls = load_class(name)
    generator = cls(cls.smallest_config(SENSOR), SENSOR)
    generator.fit_statistics(RangeImages(SENSOR, [SeededImages(SENSOR, 3)]))
    generator.save(tmp_path)
    assert load(tmp_path).sample([0]).return_mask.any()
    weights, _ = read_tensors(tmp_path / FILE)
    write_tensors(tmp_path / FILE, {each: change.get(each, lambda same: same)(of) for each, of in weights.items()})
    with pytest.raises(CheckpointError, match=rf"^got .*{FILE}, .*{got}"):
        load(tmp_path)
