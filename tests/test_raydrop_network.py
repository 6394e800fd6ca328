"""The network of raydrop: what it learns from, its masks by seed, its place in a bundle, and its scores."""

from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.data.datasets import open_dataset
from lidargrit.evaluation.realism import simulate_pair
from lidargrit.generation.generator import load
from lidargrit.scans import fills
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.fills import ranges_from_others
from lidargrit.scans.marks import read_marks
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.raydrop.network import RaydropNetwork, RaydropNetworkConfig
from lidargrit.systems.raydrop.system import RaydropObjective
from tiny_runs import learn, save_bundle

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
TINY = RaydropNetworkConfig(widths=(8, 8, 8), blocks=1, features=4, mask_width=4, row_channels=1)


def pairs(count: int) -> RangeImage:
    """Return walls of which the upper rows see the sky, and whose far side never returns, as marked by reflectance."""
    rng = torch.Generator().manual_seed(1)
    angle = SENSOR.azimuth_rad + 6 * torch.rand(count, 1, 1, generator=rng)
    range_m = (20 + 15 * angle.cos()).expand(count, 64, 32)
    surface = torch.ones_like(range_m, dtype=torch.bool)
    surface[:, :8] = False
    return RangeImage.masked(range_m, surface, SENSOR, {"reflectance": (range_m < 20).float()})


def made(config: RaydropNetworkConfig = TINY) -> RaydropNetwork:
    torch.manual_seed(0)
    return RaydropNetwork(config, SENSOR).eval()


def test_surfaces_of_a_simulated_scan_mark_what_it_returned():
    sensor = load_sensor("hdl64e_kitti_odometry")
    surfaces = project(open_dataset("simulated_surfaces:1:test").scan(0), sensor)
    measured = project(open_dataset("simulated:1:test").scan(0), sensor)
    clean, returned = simulate_pair(2_000_000, sensor)
    assert surfaces.reflectance is not None
    assert measured.reflectance is not None
    marked = read_marks(surfaces.reflectance)
    assert torch.equal(marked.returned, measured.return_mask)
    assert torch.allclose(marked.reflectance, measured.reflectance, atol=1e-6)
    assert marked.is_clear
    assert marked.has_reflectance
    assert torch.equal(measured.return_mask, returned.return_mask)
    assert torch.equal(surfaces.return_mask, clean.return_mask)
    lost = surfaces.return_mask & ~measured.return_mask
    assert torch.allclose(surfaces.range_m[lost], clean.range_m[lost], atol=1e-3)


@torch.no_grad()
def test_a_scan_depends_on_its_seed_alone_and_only_surfaces_return():
    network, known = made(), Observed.of_surfaces(pairs(3))
    assert known.has_all_surfaces
    seeds = [torch.Generator().manual_seed(seed) for seed in (5, 6, 5)]
    together = network.sample(known, seeds)
    alone = network.sample(known[1:2], [torch.Generator().manual_seed(6)])
    assert torch.equal(together.range_m[1], alone.range_m[0])
    assert not torch.equal(together.return_mask[0], together.return_mask[1])
    assert not (together.return_mask & ~known.range_observed).any()
    assert 0.5 < float(together.return_mask[known.range_observed].float().mean()) < 1
    unknown = torch.zeros_like(known.range_observed)
    unknown[:, 40] = True
    assert not Observed.of_surfaces(pairs(3), unknown).has_all_surfaces


def test_it_learns_which_surfaces_return():
    objective, images = RaydropObjective(made(), SENSOR).train(), pairs(2)
    bits = [terms["mask_bits"] for terms in learn(objective, images, range(16), 1e-2)]
    assert sum(bits[-3:]) < 0.6 * sum(bits[:3])


@torch.no_grad()
def test_ordinary_scans_are_refused_unless_surfaces_are_estimated():
    images, rng = pairs(2), torch.Generator().manual_seed(0)
    for reflectance in (None, torch.where(images.return_mask, 0.3, 0.0)):
        with pytest.raises(ConfigError, match="scans that do not mark which of their surfaces return"):
            RaydropObjective(made(), SENSOR)(Example(images.with_planes(reflectance=reflectance)), rng)
    terms = RaydropObjective(made(replace(TINY, surfaces="estimated")), SENSOR)(Example(images), rng)
    assert float(terms["loss"]) > 0


def test_an_estimated_range_owes_nothing_to_its_own_ray(monkeypatch):
    monkeypatch.setattr(fills, "_BLOCKS", (1,))
    images = pairs(1)
    first = ranges_from_others(images, torch.Generator().manual_seed(3))
    moved = images.range_m.clone()
    moved[0, 30, 7] += 9
    second = ranges_from_others(replace(images, range_m=moved), torch.Generator().manual_seed(3))
    changed = (first.range_m != second.range_m)[0]
    assert changed.any()
    assert not changed[30, 7]
    assert first.return_mask.all()
    near = images.return_mask.clone()
    near[:, 8:12] = False  # beside the sky there is nothing to go by
    assert float((first.range_m - images.range_m)[near].abs().mean()) < 1


def test_a_bundle_with_it_drops_by_it(tmp_path):
    torch.manual_seed(0)
    save_bundle(tmp_path, SENSOR, raydrop=TINY)
    bundle, alone, tokens = load(tmp_path), load(tmp_path, "raydrop"), load(tmp_path / "lidargrit")
    known = Observed.of_surfaces(pairs(2))
    dropped = bundle.complete(known, [3, 4])
    assert torch.equal(dropped.return_mask, alone.complete(known, [3, 4]).return_mask)
    assert not torch.equal(dropped.return_mask, tokens.complete(known, [3, 4]).return_mask)
    assert torch.equal(dropped.range_m[dropped.return_mask], known.range_m[dropped.return_mask])


@torch.no_grad()
def test_rays_of_which_nothing_is_known_are_none_of_its_business(tmp_path):
    torch.manual_seed(0)
    save_bundle(tmp_path, SENSOR, raydrop=TINY)
    bundle, alone, tokens = load(tmp_path), load(tmp_path, "raydrop"), load(tmp_path / "lidargrit")
    unknown = torch.zeros(3, 64, 32, dtype=torch.bool)
    unknown[1, 20, 5] = True  # so the second one is completed by tokens
    conditions, seeds = Observed.of_surfaces(pairs(3), unknown), [3, 4, 5]
    together, by_tokens = bundle.complete(conditions, seeds), tokens.complete(conditions, seeds)
    pairs_of_masks = zip(together.return_mask, by_tokens.return_mask, strict=True)
    assert [torch.equal(one, other) for one, other in pairs_of_masks] == [False, True, False]
    with pytest.raises(ConfigError, match="scans with rays of which nothing is known"):
        alone.complete(conditions, seeds)
    with pytest.raises(ConfigError, match="wanted ranges of surfaces"):
        alone.complete(Observed.of_pixels(pairs(1), torch.ones_like(unknown[:1])), [3])
