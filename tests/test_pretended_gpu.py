"""What a GPU would be asked for, counted without one: kernels, waits of the host, and copies to the device."""

from dataclasses import replace
from functools import partial
from unittest.mock import patch

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.generator import load_class
from lidargrit.generation.pixel_decoder import pixel_decoder
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.settings import TrainingConfig
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.decoding import CachedDecoder
from lidargrit.nn.random import SeededNoise
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.scans.condition import NOTHING
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit, LidarGritConfig, TokenSampling, sample_token
from lidargrit.training.compute import uniform_images
from lidargrit.training.stage import begin_training
from pretended_gpu import DEVICE, Counts, PretendedGenerator, counted

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(64)
TOKEN_STEPS = ("nn/decoding.py", "nn/random.py")


def test_kernels_reads_and_uploads_are_told_apart() -> None:
    with counted() as counts:
        numbers = torch.tensor([1.0, -2.0, 3.0]).to(DEVICE)
        (numbers[None] * 2).sum()
    assert totals(counts) == (2, 0, 1), "a view is no kernel"
    with counted() as counts:
        positive = numbers[numbers > 0]
        assert positive.tolist() == [1.0, 3.0]
        assert bool(numbers[0] > 0)
        assert float(numbers.where(numbers > 0, torch.zeros((), device=DEVICE)).sum()) == 4.0
    assert counts.reads.total() == 4, "the size of a choice, a list, a truth value, and a number"
    with counted() as counts:
        numbers[[0, 2]] = torch.tensor([5.0, 6.0], device=DEVICE)
        assert numbers.tolist() == [5.0, -2.0, 6.0]
    assert (counts.uploads.total(), counts.reads.total()) == (2, 1)
    with counted(), pytest.raises(RuntimeError, match="tensors on two devices"):
        numbers.add(torch.ones(3))


def test_gradients_are_those_of_the_cpu() -> None:
    torch.manual_seed(0)
    layer, x = torch.nn.Conv2d(2, 3, 3), torch.randn(1, 2, 8, 8)
    layer(x).square().sum().backward()
    wanted = [weight.grad for weight in layer.parameters()]
    layer.zero_grad()
    with counted() as counts:
        on_gpu = layer.to(DEVICE)
        on_gpu(x.to(DEVICE)).square().sum().backward()
        found = [weight.grad.cpu() for weight in on_gpu.parameters() if weight.grad is not None]
    assert counts.kernels.total() > 4
    for one, other in zip(found, wanted, strict=True):
        assert other is not None
        assert torch.equal(one, other)


def totals(counts: Counts) -> tuple[int, int, int]:
    return counts.kernels.total(), counts.reads.total(), counts.uploads.total()


@pytest.fixture(scope="module")
def small() -> LidarGrit:
    """Return the networks of ``pretrained`` with few channels: as many phases and components, and 16 tokens."""
    config = LidarGritConfig(
        VqvaeConfig(channels=32, channel_multipliers=(1, 1, 1, 1, 1), code_dim=8, num_codes=32),
        TransformerConfig(layers=2, heads=2, width=16),
        PixelDecoderConfig(
            64, mask_width=4, range_width=4, coarse_range_width=8, surface_components=True, gravity_components=True
        ),
        guidance=1.15,
    )
    torch.manual_seed(0)
    generator = LidarGrit(config, SENSOR).eval()
    for weight in generator.pixels.parameters() if generator.pixels is not None else ():
        weight.data = 0.06 * torch.randn_like(weight)
    return generator


def sampled(generator: LidarGrit, count: int) -> tuple[RangeImage, Counts]:
    """Sample a batch of so many scans with networks that are laid out for it, and count."""
    seeds, sampling = BatchSeeds(range(count), count), TokenSampling(range_temperature=1.0)
    with torch.no_grad(), counted():
        generator.to(DEVICE)
        generator._prepare(count, sampling)
    with torch.no_grad(), counted() as counts:
        scans = generator._sample(seeds, NOTHING, sampling)
    with counted():
        return scans.to("cpu"), counts


def test_a_batch_of_any_size_takes_as_many_kernels_and_at_most_four_reads(small: LidarGrit) -> None:
    # Random networks have many components at one range, between which a temperature would choose by rounding.
    wanted = small.sample(range(8), sampling=TokenSampling(range_temperature=1.0))
    (one, of_one), (eight, of_eight) = sampled(small, 1), sampled(small, 8)
    behind_tokens = []
    for counts in (of_one, of_eight):
        tokens = sum(n for line, n in counts.kernels.items() if line.startswith(TOKEN_STEPS))
        assert tokens <= 16 * 82, "a step of two layers, and of the weaker one"
        behind_tokens.append(counts.kernels.total() - tokens)
        assert behind_tokens[-1] < 5000, str(counts)
        assert counts.reads.total() <= 3, str(counts)
        assert counts.uploads.total() <= 2, f"random numbers of tokens and of pixels:\n{counts}"
    assert behind_tokens[1] == pytest.approx(behind_tokens[0], rel=0.01)
    for found in (one, eight):
        part = wanted[: len(found)]
        both = found.return_mask & part.return_mask
        assert float((found.return_mask != part.return_mask).float().mean()) < 1e-3
        assert float(((found.range_m - part.range_m).abs()[both] > 0.01).float().mean()) < 1e-3


def test_no_recorded_step_of_tokens_waits_for_the_device(small: LidarGrit) -> None:
    with torch.no_grad(), counted():
        transformer = small.transformer.to(DEVICE)
        by_choices = partial(sample_token, sampling=TokenSampling())
        decoder = CachedDecoder(transformer, 2, by_choices, static=True, guidance=1.15)
        uniform = torch.rand(2, transformer.context_length).to(DEVICE)
        plain = CachedDecoder(transformer, 2, by_choices, static=False, guidance=1.15).generate(uniform)
    with counted() as counts:
        tokens = decoder.generate(uniform)
    assert (counts.reads.total(), counts.uploads.total()) == (0, 0), str(counts)
    with counted():
        assert tokens.tolist() == plain.tolist()


STEPS = {  # of each stage of the smallest networks, for two scans of 64x32: kernels, reads and uploads at most
    "completion/completion": (1030, 4, 3),
    "dusty/adversarial": (670, 1, 0),
    "lidargan/adversarial": (640, 4, 6),
    "lidargen/score": (2070, 0, 0),
    "lidargrit/tokenizer": (720, 0, 0),
    "lidargrit/transformer": (115, 0, 0),
    "lidargrit/pixels": (1110, 0, 0),
    "lidarvae/autoencoder": (310, 2, 3),
    "lidm/tokenizer": (690, 0, 0),
    "lidm/denoiser": (690, 0, 0),
    "maskgit/tokenizer": (720, 0, 0),
    "maskgit/transformer": (130, 0, 0),
    "multiscale/pixels": (1480, 0, 0),
    "r2dm/diffusion": (570, 0, 0),
    "r2flow/flow": (880, 0, 0),
}


def test_noise_is_made_on_the_device_and_is_that_of_the_cpu() -> None:
    here = SeededNoise([3, 7], (2, 8, 6), torch.device("cpu"))
    with counted() as counts:
        there = SeededNoise([3, 7], (2, 8, 6), DEVICE)
        images = [there(), there.uniform(), there()]
    assert totals(counts)[1:] == (0, 1), f"the seeds, once:\n{counts}"
    for image, wanted in zip(images, (here(), here.uniform(), here()), strict=True):
        with counted():
            assert torch.equal(image.cpu(), wanted)


def test_lattices_choose_their_phases_by_one_source_of_random_numbers() -> None:
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(32)
    cls = load_class("multiscale")
    objective = cls(cls.smallest_config(sensor), sensor).objective("pixels")
    with patch.object(pixel_decoder, "one_of_phases", wraps=pixel_decoder.one_of_phases) as choose, counted():
        objective.to(DEVICE)(Example(uniform_images(sensor, 8)).to(DEVICE), PretendedGenerator().manual_seed(0))
    sources = [call.args[1] for call in choose.call_args_list]
    assert len(sources) > 1
    assert all(source is sources[0] for source in sources), "lattices would choose alike"


@pytest.mark.parametrize("stage", STEPS)
def test_a_step_of_training_asks_no_more_of_the_device_than_is_known(stage: str) -> None:
    system, name = stage.split("/")
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(32)
    cls = load_class(system)
    config = cls.smallest_config(sensor)
    if name == "pixels" and system == "lidargrit":
        config = replace(config, pixels=PixelDecoderConfig(4, mask_width=4, range_width=4))
    torch.manual_seed(0)
    objective = cls(config, sensor).objective(name).train()
    example = Example(uniform_images(sensor, 2)).with_keys()
    with counted():
        objective.to(DEVICE)
        example = example.to(DEVICE)
        if objective.keeps_encodings:
            objective(example, PretendedGenerator().manual_seed(0))  # encodes the images
    with counted() as counts:
        for player in objective.players or ("",):
            objective(example, PretendedGenerator().manual_seed(0), player)["loss"].backward()
    assert totals(counts)[0] > 50
    for found, at_most in zip(totals(counts), STEPS[stage], strict=True):
        assert found <= at_most, str(counts)


def test_too_little_memory_is_told_in_one_line_with_a_setting_that_takes_less(small: LidarGrit) -> None:
    full = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total of 8 GiB.")
    cures = {32: "use sampling.batch_size=16", 1: "use another device"}
    for size, cure in cures.items():
        with patch.object(small, "_sample", side_effect=full), pytest.raises(ConfigError, match=cure) as error:
            small.sample([0], sampling=TokenSampling(batch_size=size))
        assert error.value.got.startswith(f"{size} scans at once (CUDA out of memory)")
    objective = load_class("r2dm")(load_class("r2dm").smallest_config(SENSOR), SENSOR).objective("diffusion")
    engine, _ = begin_training(objective, TrainingConfig(scans=4, batch_size=4, learning_rate=1e-3))
    for parts, cure in {2: "accumulate=4", 4: "recompute=true"}.items():
        with patch.object(type(objective), "forward", side_effect=full), pytest.raises(ConfigError, match=cure):
            engine.step(Example(uniform_images(SENSOR, 4)), 0, 1.0, parts)
