"""The two baselines of every table: scans of pixel statistics alone, and training scans given back."""

import pytest
import torch

from lidargrit.core.errors import CheckpointError
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.generation.facts import SamplingSettings
from lidargrit.generation.generator import load
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.marginal.system import Marginal, MarginalConfig
from lidargrit.systems.memorised.system import Memorised, MemorisedConfig

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)


class Store:
    """Images whose columns all move together, so that pixels hang together."""

    def __init__(self, count):
        rng = torch.Generator().manual_seed(0)
        mask = torch.rand(count, 64, 32, generator=rng) < torch.linspace(0.1, 0.9, 32)
        range_m = (5 + 20 * torch.rand(count, 1, 1, generator=rng)).expand(count, 64, 32)
        self.range_m = torch.where(mask, range_m, 0)
        self.provenance = Provenance()

    def __len__(self):
        return len(self.range_m)

    def read(self, index):
        return Pixels(self.range_m[index].numpy())


@pytest.fixture(scope="module")
def store():
    return Store(200)


@pytest.fixture(scope="module")
def marginal(store):
    generator = Marginal(MarginalConfig(), SENSOR)
    generator.fit_statistics(RangeImages(SENSOR, [store]))
    return generator


def test_marginal_knows_pixels_one_by_one(store, marginal):
    drawn = marginal.sample(range(300))
    mask, real = drawn.return_mask.double(), (store.range_m > 0).double()
    # 300 and 200 draws of a coin: its standard error is below 0.046, so four of them for 2048 pixels
    assert float((mask.mean(0) - real.mean(0)).abs().max()) < 4.5 * 0.046
    mean = drawn.range_m.sum((0, 1)) / mask.sum((0, 1))
    wanted = store.range_m.sum((0, 1)) / real.sum((0, 1))
    assert torch.allclose(mean.double(), wanted.double(), rtol=0.05)
    returned = drawn.range_m[drawn.return_mask]
    assert float(returned.min()) >= 5 * 0.96
    assert float(returned.max()) <= 25 * 1.04
    # Neighbours agree in every real scan and are strangers here.
    both = drawn.return_mask[:, 20, 30] & drawn.return_mask[:, 20, 31]
    pair = torch.stack((drawn.range_m[both, 20, 30], drawn.range_m[both, 20, 31]))
    assert abs(float(torch.corrcoef(pair)[0, 1])) < 0.25


def test_memorised_gives_every_scan_once(store):
    generator = Memorised(MemorisedConfig(scans=200), SENSOR)
    generator.fit_statistics(RangeImages(SENSOR, [store]))
    drawn = generator.sample(range(1000, 1200)).range_m
    assert sorted(drawn.sum((1, 2)).tolist()) == pytest.approx(sorted(store.range_m.sum((1, 2)).tolist()))
    assert not torch.equal(generator.sample(range(200)).range_m, store.range_m), "neighbours in time are not together"
    few = Memorised(MemorisedConfig(scans=3), SENSOR)
    few.fit_statistics(RangeImages(SENSOR, [store]))
    assert torch.equal(few.sample([1]).range_m, few.sample([4]).range_m)


@pytest.mark.parametrize("make", [Marginal, Memorised])
def test_they_are_saved_and_loaded_and_obey_seeds(make, store, tmp_path):
    generator = make(make.Config(), SENSOR)
    with pytest.raises(CheckpointError, match="no scan"):
        generator.sample([0])
    generator.fit_statistics(RangeImages(SENSOR, [store]))
    generator.save(tmp_path)
    again = load(tmp_path)
    alone, together = again.sample([7], sampling=SamplingSettings()), generator.sample([5, 7])
    assert torch.equal(alone.range_m[0], together.range_m[1])
    assert torch.equal(alone.return_mask, alone.range_m > 0)
    assert not generator.stages
