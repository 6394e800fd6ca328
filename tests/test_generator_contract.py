"""The contract that every generator keeps: seeds, limits, saving, what it declares, what it costs."""

import dataclasses
import functools
import itertools
import re
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import torch

from lidargrit.cli import build_parser
from lidargrit.core import configuration, discovery
from lidargrit.core.errors import ConfigError
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.generation.facts import CAPABILITIES
from lidargrit.generation.generator import Generator, load, load_class
from lidargrit.inference.segment import label_images
from lidargrit.scans.condition import Nothing, Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
HOOKS = {  # what a generator with a capability overrides
    "tokens": "get_tokenizer",
    "encode": "_reconstruct",
    "complete": "_complete",
    "likelihood": "_bits",
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
        return Pixels(self.range_m[index].numpy(), {"reflectance": self.reflectance[index].numpy()})


IMAGES = RangeImages(SENSOR, [Store()])


@functools.cache
def made(name):
    """Return a small generator that has seen the images but was not trained, and settings to sample quickly."""
    cls = load_class(name)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        generator = cls(cls.smallest_config(SENSOR), SENSOR)
        generator.fit_statistics(IMAGES)
    return generator.eval(), cls.quickest_sampling()


def known_of(generator, images):
    """Return what is known of scans, of a kind that the generator takes: every fourth row, or all surfaces."""
    if "pixels" not in generator.conditions:
        return Observed.of_surfaces(images)
    observed = torch.zeros(images.range_m.shape, dtype=torch.bool)
    observed[:, ::4] = True
    return Observed.of_pixels(images, observed)


def scans_of(generator, seeds, sampling):
    """Return new scans, or one scan that is completed or labelled by a generator that has no new ones."""
    if Nothing in generator.takes:
        return generator.sample(seeds, sampling=sampling)
    if not generator.takes:  # it has no scans at all, and labels them
        return label_images(generator, IMAGES.batch([0] * len(seeds)))
    return generator.complete(known_of(generator, IMAGES.batch([0] * len(seeds))), seeds, sampling)


@functools.cache
def sampled_together(name):
    """Return the scans of seeds 3 to 11, which are more than a batch that is computed at once."""
    generator, sampling = made(name)
    return scans_of(generator, range(3, 12), sampling)


def same(one: RangeImage, other: RangeImage) -> bool:
    """Tell whether two batches are equal, bit for bit."""
    pairs = [(one.range_m, other.range_m), (one.return_mask, other.return_mask)]
    if one.reflectance is not None:
        pairs.append((one.reflectance, other.reflectance))
    if one.label is not None:
        pairs.append((one.label, other.label))
    return all(torch.equal(*pair) for pair in pairs)


def calls(images, condition, seeds, sampling):
    """Return the arguments of every public method besides ``sample``, by capability."""
    return {
        "tokens": ("get_tokenizer",),
        "encode": ("reconstruct", images),
        "complete": ("complete", condition, seeds, sampling),
        "likelihood": ("bits", images),
    }


class Counted:
    """A function of images that keeps how many it got each time."""

    def __init__(self, function):
        self.function, self.sizes = function, []

    def __call__(self, images, *more):
        self.sizes.append(len(images))
        return self.function(images, *more)


def call(generator, name_and_arguments):
    name, *arguments = name_and_arguments
    return getattr(generator, name)(*arguments)


NAMES = discovery.names("generators")
pytestmark = pytest.mark.parametrize("name", NAMES)


def test_a_seed_gives_the_same_scan_bit_for_bit_whatever_the_batch(name):
    generator, sampling = made(name)
    seeds, together = list(range(3, 12)), sampled_together(name)
    for index in (0, 7):  # first and last of the first batch; below, each scan has another place in another batch
        assert same(scans_of(generator, [seeds[index]], sampling), together[index : index + 1]), seeds[index]
    assert same(scans_of(generator, seeds[::-1], sampling), RangeImage.stack([together[i] for i in range(8, -1, -1)]))
    assert torch.equal(together.range_m[0], together.range_m[1]) != generator.is_random


def test_batches_of_another_size_change_last_digits_alone(name):
    generator, sampling = made(name)
    if not generator.takes:
        return  # it labels scans one by one
    threes = dataclasses.replace(sampling, batch_size=3)
    assert generator.batch_size(threes) == 3
    assert generator.batch_size(sampling) == generator.own_batches[0]
    found, usual = scans_of(generator, range(3, 8), threes), sampled_together(name)[:5]
    assert (found.return_mask == usual.return_mask).float().mean() > 0.999
    both = found.return_mask & usual.return_mask
    assert ((found.range_m - usual.range_m)[both].abs() < 1e-3).float().mean() > 0.999


def test_threads_and_inference_mode_change_no_scan(name):
    generator, sampling = made(name)
    together = sampled_together(name)
    with torch.inference_mode():
        assert same(scans_of(generator, [3], sampling), together[:1])
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda seed: scans_of(generator, [seed], sampling), range(3, 5)))
    assert same(RangeImage.cat(found), together[:2])


def test_streams_the_same_scans_without_end(name):
    generator, sampling = made(name)
    if Nothing not in generator.takes:
        return
    streamed = list(itertools.islice(generator.stream(itertools.count(3), sampling), 9))
    assert same(RangeImage.stack(streamed), sampled_together(name))


def test_seeds_and_settings_that_cannot_be_are_refused(name):
    generator, sampling = made(name)
    if Nothing not in generator.takes:
        return
    for seeds, message in (
        ([], "no seeds"),
        ([0, -1], "the seed -1"),
        ([1 << 32], "the seed 4294967296"),
        ([True], "the seed True"),
        ([10**99], "the seed 1000"),
    ):
        with pytest.raises(ConfigError, match=f"^got {message}.*"):
            generator.sample(seeds, sampling=sampling)
    assert generator.sample([(1 << 32) - 1], sampling=sampling).range_m.shape == (1, 64, 32)
    with pytest.raises(ConfigError, match=r"^got settings of type SensorModel; wanted \w+; "):
        generator.sample([0], sampling=SENSOR)


@pytest.mark.usefixtures("untyped")
def test_seeds_without_an_order_are_refused(name):
    generator, sampling = made(name)
    if Nothing not in generator.takes:
        return
    for seeds, kind in (({3, 4}, "set"), ({3: 4}.keys(), "dict_keys"), (3, "int"), (iter([3]), "list_iterator")):
        with pytest.raises(ConfigError, match=rf"^got seeds of type {kind}; wanted a sequence, such as \[0\]; "):
            generator.sample(seeds, sampling=sampling)
    assert same(generator.sample(np.array([3]), sampling=sampling), sampled_together(name)[:1])


@pytest.mark.usefixtures("untyped")
def test_a_setting_of_another_type_and_a_word_that_is_no_choice_are_refused(name):
    """From Python, where no parser looks at them: a misspelt word once was another method without a word about it."""
    sampling = load_class(name).Sampling
    for setting, hint in get_type_hints(sampling).items():
        wrong, wanted = [], ""
        if get_origin(hint) is Literal:
            wrong, wanted = [f"{get_args(hint)[0]}s", get_args(hint)[0].upper(), None], get_args(hint)[0]
        elif hint in (int, int | None):
            wrong, wanted = [1.5, "a", True], "whole number"
        elif hint in (float, float | None):
            wrong, wanted = ["1", [1.0]], "number"
        elif hint is bool:
            wrong, wanted = [1, "true", None], "true or false"
        assert wrong, f"no wrong value of {setting} is known here"
        for value in wrong:
            with pytest.raises(ConfigError, match=rf"^got {setting}={re.escape(repr(value))}; wanted .*{wanted}"):
                sampling(**{setting: value})


def test_images_and_masks_of_others_are_refused(name):
    """By whatever the generator can do with them; DUSty once took another sensor's scans for its own."""
    generator, sampling = made(name)
    images, seeds = IMAGES.batch([0, 1]), [3, 4]
    observed = torch.ones(2, 64, 32, dtype=torch.bool)
    condition = known_of(generator, images) if "complete" in generator.capabilities else None
    other = RangeImage(images.range_m, images.return_mask, load_sensor("hdl64e_kitti_360").with_columns(32))
    for capability in sorted(generator.capabilities - {"tokens"}):
        with pytest.raises(ConfigError, match=r"^got range images of the sensor 'hdl64e_kitti_360', 64x32; wanted "):
            call(generator, calls(other, Observed.of_pixels(other, observed), seeds, sampling)[capability])
        if capability != "complete":
            with pytest.raises(ConfigError, match=r"^got range images of shape \(64, 32\); wanted a batch"):
                call(generator, calls(images[0], None, seeds, sampling)[capability])
        if capability == "complete":
            with pytest.raises(ConfigError, match=r"^got 3 seeds for 2 images; wanted one seed for each image"):
                call(generator, calls(images, condition, [0, 1, 2], sampling)[capability])
            with pytest.raises(ConfigError, match=r"^got the seed -2; "):
                call(generator, calls(images, condition, [0, -2], sampling)[capability])
        if capability == "complete" and "surfaces" not in generator.conditions:
            with pytest.raises(ConfigError, match=r"^got ranges of surfaces .*; wanted pixels of which range and "):
                generator.complete(Observed.of_surfaces(images), seeds, sampling)


def test_scans_are_those_of_its_sensor(name):
    generator, sampling = made(name)
    images = scans_of(generator, [0, 1], sampling)
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


def test_saved_and_loaded_it_samples_the_same(name, tmp_path):
    generator, sampling = made(name)
    generator.save(tmp_path)
    again = load(tmp_path)
    assert again.config == generator.config
    assert same(scans_of(again, [7], sampling), sampled_together(name)[4:5])


def test_leaves_the_global_random_state_alone(name):
    generator, sampling = made(name)
    before = torch.get_rng_state()
    scans_of(generator, [0], sampling)
    assert torch.equal(torch.get_rng_state(), before)


def test_has_exactly_the_capabilities_that_it_declares(name):
    generator, _ = made(name)
    assert HOOKS.keys() == CAPABILITIES.keys()
    for capability, hook in HOOKS.items():
        assert (getattr(type(generator), hook) is not getattr(Generator, hook)) == (
            capability in generator.capabilities
        ), capability


def test_settings_that_only_completion_reads_are_no_settings_of_sampling(name):
    cls = load_class(name)
    settings = configuration.leaves(cls.Sampling())
    assert cls.not_of_sampling <= settings.keys()
    for setting in cls.not_of_sampling:
        with pytest.raises(ConfigError, match=f"'{setting}', which sampling does not have"):
            configuration.override(cls.Sampling(), [f"{setting}=1"], "sampling", fixed=cls.not_of_sampling)
        assert any(
            line.startswith("complete --set sampling.NAME besides: ") and setting in line for line in cls.about()
        )
        assert not any(
            line.startswith("sample --set sampling.NAME: ") and f"{setting}=" in line for line in cls.about()
        )


def test_what_it_cannot_do_is_told_with_who_can(name):
    generator, sampling = made(name)
    images = IMAGES.batch([0, 1])
    condition = Observed.of_pixels(images, images.return_mask)
    for capability, arguments in calls(images, condition, [0, 1], sampling).items():
        if capability in generator.capabilities:
            continue
        able = [other for other in NAMES if capability in load_class(other).capabilities]
        with pytest.raises(ConfigError) as refusal:
            call(generator, arguments)
        assert re.match(rf"got a generator '{name}', which cannot .*; wanted one that can: ", str(refusal.value))
        assert all(other in refusal.value.wanted for other in able)
        assert "lidargrit list generators" in refusal.value.cure


def test_scans_of_which_nothing_is_known_are_generated(name):
    generator, sampling = made(name)
    if "complete" not in generator.capabilities or Nothing not in generator.takes:
        return
    generated = generator.complete(Observed.nothing(SENSOR, 2), [0, 1], sampling)
    assert generated.range_m.shape == (2, 64, 32)
    assert generated.return_mask.any()


def test_what_it_can_do_besides_keeps_to_the_seeds_and_the_sensor(name):
    generator, sampling = made(name)
    images = IMAGES.batch([0, 1])
    if "encode" in generator.capabilities:
        together = generator.reconstruct(images)
        assert together.range_m.shape == (2, 64, 32)
        assert same(generator.reconstruct(images[1:]), together[1:2])
    if "likelihood" in generator.capabilities:
        bits, alone = generator.bits(images), generator.bits(images[1:])
        assert torch.equal(alone.total(), bits.total()[1:])
        assert bits.per_scan().keys() == ({"tokens", "mask", "range"} if bits.is_whole else {"tokens"})
        assert bool((bits.total() > 0).all())
        assert float(bits.per_pixel().double().sum()) == pytest.approx(float(bits.total().sum()), rel=1e-5)
        with pytest.raises(ConfigError, match="got a step of 0 mm; wanted a whole number of millimetres"):
            generator.bits(images, step_mm=0)
    if "complete" in generator.capabilities:
        known = known_of(generator, images)
        found = generator.complete(known, [3, 4], sampling)
        assert same(found[1:2], generator.complete(known[1:], [4], sampling))


def test_images_without_seeds_are_computed_one_by_one(name):
    """So that memory is bounded, and that no scan's result depends on the batch that it came in."""
    generator, _ = made(name)
    for capability in generator.capabilities & {"encode", "likelihood"}:
        counted = Counted(getattr(generator, HOOKS[capability]))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(generator, HOOKS[capability], counted)
            call(generator, calls(IMAGES.batch([0, 1, 2]), None, [], None)[capability])
        assert counted.sizes == [1, 1, 1]


def test_an_objective_has_a_finite_loss_and_gradients(name):
    generator, _ = made(name)
    for stage in generator.stages:
        objective = generator.objective(stage).train()
        for player in objective.players or ("",):
            rng = torch.Generator().manual_seed(0)
            images = IMAGES.batch([0, 1])
            labelled = images.with_planes(label=torch.where(images.return_mask, 40, 0))
            objective(Example(labelled), rng, player)["loss"].backward()
        gradients = [weight.grad for weight in objective.parameters() if weight.grad is not None]
        assert gradients
        assert all(bool(gradient.isfinite().all()) for gradient in gradients)
        objective.zero_grad()
    assert all(weight.requires_grad for weight in generator.parameters()), "an objective froze weights"
    generator.eval()


def test_names_a_command_that_shows_what_a_run_has_learned(name):
    words = load_class(name).facts.first_command.split()
    assert "RUN" in words
    assert build_parser().parse_args(words).verb == words[0]


def test_tells_what_it_generates_and_where_it_comes_from(name):
    cls = load_class(name)
    assert cls.facts is not Generator.facts, "the class names no facts of its own"
    lines = cls.about()
    assert lines[0] == f"generates {cls.facts.generates}"
    assert any(line == "from: this project" or cls.facts.paper in line for line in lines)
    assert bool(cls.facts.weights_licence) or not cls.published_files, (
        "weights can be imported, their licence is not told"
    )


def test_tells_what_a_scan_costs(name):
    generator, sampling = made(name)
    before = torch.get_rng_state()
    cost = generator.cost(sampling)
    assert torch.equal(torch.get_rng_state(), before)
    assert (cost.network_evaluations > 0) == (cost.flops > 0) == bool(generator.stages)
    assert cost == generator.cost(sampling)
