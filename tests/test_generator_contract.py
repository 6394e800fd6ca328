"""The contract that every generator keeps: seeds, limits, saving, what it declares, what it costs."""

import functools
import itertools
import re

import pytest
import torch

from lidargrit import _discovery, configuration
from lidargrit.errors import ConfigError
from lidargrit.generators import CAPABILITIES, Generator, load, load_class
from lidargrit.loading import Provenance, RangeImages
from lidargrit.sensors import load_sensor
from lidargrit.structures import RangeImage

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
SIZES = {  # the smallest of each, and the quickest way to draw from it: a new generator names its own here
    "dusty": ("latent_dim=8 channels=4 max_channels=8", "search_steps=4"),
    "lidargrit": (
        "tokenizer.channels=32 tokenizer.channel_multipliers=[1,1,1,1] tokenizer.code_dim=8 tokenizer.num_codes=32 "
        "transformer.layers=1 transformer.heads=2 transformer.width=16",
        "",
    ),
    "marginal": ("bins=16", ""),
    "maskgit": (
        "tokenizer.channels=32 tokenizer.channel_multipliers=[1,1,1,1] tokenizer.code_dim=8 tokenizer.num_codes=32 "
        "transformer.layers=1 transformer.heads=2 transformer.width=16",
        "steps=4",
    ),
    "memorised": ("scans=8", ""),
    "r2dm": (
        "unet.channels=8 unet.channel_multipliers=[1,1] unet.residual_blocks=[1,1] unet.norm_groups=2 "
        "unet.attention_heads=2",
        "steps=3 resamples=2",
    ),
}
METHODS = {  # what a capability is called by
    "tokens": "get_tokenizer",
    "encode": "reconstruct",
    "complete": "complete",
    "invert": "invert",
    "likelihood": "log_likelihood",
}


class Store:
    """A few walls with holes, and reflectance."""

    provenance = Provenance()

    def __init__(self):
        rng = torch.Generator().manual_seed(0)
        self.mask = torch.rand(12, 64, 32, generator=rng) < 0.8
        self.range_m = (5 + 40 * torch.rand(12, 1, 32, generator=rng)).expand(12, 64, 32) * self.mask
        self.reflectance = torch.rand(12, 64, 32, generator=rng) * self.mask

    def __len__(self):
        return 12

    def read(self, index):
        return self.range_m[index].numpy(), self.reflectance[index].numpy()


IMAGES = RangeImages(SENSOR, [Store()])


@functools.cache
def made(name):
    """Return a small generator that has seen the images but was not trained, and how to draw from it quickly."""
    cls = load_class(name)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        generator = cls(configuration.override(cls.Config(), SIZES[name][0].split()), SENSOR)
        generator.fit_statistics(IMAGES)
    return generator.eval(), configuration.override(cls.Sampling(), SIZES[name][1].split())


def same(one: RangeImage, other: RangeImage) -> bool:
    """Tell whether two batches are equal; products over another batch may differ in their last bits."""
    close = torch.isclose(one.range_m, other.range_m, rtol=1e-4, atol=1e-4)
    return float(close.float().mean()) > 0.999


pytestmark = pytest.mark.parametrize("name", _discovery.names("generators"))


def test_a_seed_gives_the_same_scan_whatever_the_batch(name):
    generator, sampling = made(name)
    together = generator.sample([3, 4, 5], sampling)
    assert same(generator.sample([4], sampling), together[1:2])
    assert same(generator.sample([5, 3], sampling), RangeImage.stack([together[2], together[0]]))
    assert not torch.equal(together.range_m[0], together.range_m[1])


def test_streams_the_same_scans_without_end(name):
    generator, sampling = made(name)
    streamed = list(itertools.islice(generator.stream(itertools.count(3), sampling, batch_size=2), 3))
    assert same(RangeImage.stack(streamed), generator.sample([3, 4, 5], sampling))


def test_scans_are_those_of_its_sensor(name):
    generator, sampling = made(name)
    images = generator.sample([0, 1], sampling)
    assert images.range_m.shape == (2, 64, 32)
    assert images.sensor.same_rays(SENSOR)
    assert torch.equal(images.return_mask, images.range_m > 0)
    returned = images.range_m[images.return_mask]
    assert returned.numel()
    assert float(returned.min()) >= SENSOR.range_min_m
    assert float(returned.max()) <= SENSOR.range_max_m
    if images.reflectance is not None:
        assert bool(((images.reflectance >= 0) & (images.reflectance <= 1)).all())
        assert bool((images.reflectance[~images.return_mask] == 0).all())


def test_saved_and_loaded_it_draws_the_same(name, tmp_path):
    generator, sampling = made(name)
    generator.save(tmp_path)
    again = load(tmp_path)
    assert again.config == generator.config
    assert torch.equal(again.sample([7], sampling).range_m, generator.sample([7], sampling).range_m)


def test_leaves_the_global_random_state_alone(name):
    generator, sampling = made(name)
    before = torch.get_rng_state()
    generator.sample([0], sampling)
    generator.cost(sampling)
    assert torch.equal(torch.get_rng_state(), before)


def test_has_exactly_the_capabilities_that_it_declares(name):
    generator, _ = made(name)
    assert METHODS.keys() == CAPABILITIES.keys()
    for capability, method in METHODS.items():
        assert (getattr(type(generator), method) is not getattr(Generator, method)) == (
            capability in generator.capabilities
        ), capability


def test_what_it_cannot_do_is_told_with_who_can(name):
    generator, _ = made(name)
    images = IMAGES.batch([0, 1])
    arguments = {
        "tokens": (),
        "encode": (images,),
        "complete": (images, images.return_mask, [0, 1]),
        "invert": (images, [0, 1]),
        "likelihood": (images,),
    }
    for capability in CAPABILITIES.keys() - generator.capabilities:
        able = [other for other in SIZES if capability in load_class(other).capabilities]
        with pytest.raises(ConfigError) as told:
            getattr(generator, METHODS[capability])(*arguments[capability])
        assert re.match(rf"got a generator '{name}', which cannot .*; wanted one that can: ", str(told.value))
        assert all(other in told.value.wanted for other in able)
        assert "lidargrit list generators" in told.value.cure


def test_what_it_can_do_besides_keeps_to_the_seeds_and_the_sensor(name):
    generator, sampling = made(name)
    images = IMAGES.batch([0, 1])
    observed = torch.zeros(2, 64, 32, dtype=torch.bool)
    observed[:, ::4] = True
    if "encode" in generator.capabilities:
        assert generator.reconstruct(images).range_m.shape == (2, 64, 32)
    if "likelihood" in generator.capabilities:
        assert bool((generator.log_likelihood(images) < 0).all())
    for capability, arguments in (("complete", (observed,)), ("invert", ())):
        if capability in generator.capabilities:
            call = getattr(generator, capability)
            found = call(images, *arguments, [3, 4], sampling)
            alone = call(images[1:], *(each[1:] for each in arguments), [4], sampling)
            assert same(found[1:2], alone)


def test_an_objective_has_a_finite_loss_and_gradients(name):
    generator, _ = made(name)
    for stage in generator.stages:
        objective = generator.objective(stage).train()
        for player in objective.players or ("",):
            rng = torch.Generator().manual_seed(0)
            objective(IMAGES.batch([0, 1]), rng, player)["loss"].backward()
        gradients = [weight.grad for weight in objective.parameters() if weight.grad is not None]
        assert gradients
        assert all(bool(gradient.isfinite().all()) for gradient in gradients)
        objective.zero_grad()
    generator.eval().requires_grad_(True)  # a stage may have frozen another's weights


def test_tells_what_a_scan_costs(name):
    generator, sampling = made(name)
    cost = generator.cost(sampling)
    assert (cost.network_evaluations > 0) == (cost.flops > 0) == bool(generator.stages)
    assert cost == generator.cost(sampling)
