"""Images are encoded once, whatever the batch and the precision of training around it."""

import copy

import torch
from torch import nn

from lidargrit.generation.encoding_cache import EncodingCache
from lidargrit.generation.presets import load_preset
from lidargrit.scans.example import Example, keys_of
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.training.measure import measure
from tiny_runs import MODEL, SHORT, SIMULATED

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(16)


class Half(nn.Module):
    """Half of the ranges; keeps the size of every batch that it is given, and whether it was in training mode."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(16, 16, bias=False)
        self.linear.weight.data = torch.eye(16) / 2
        self.batches: list[int] = []

    def forward(self, images: RangeImage) -> torch.Tensor:
        assert not self.training
        self.batches.append(len(images))
        return self.linear(images.range_m)


def scans(count: int) -> RangeImage:
    rng = torch.Generator().manual_seed(0)
    size = (count, SENSOR.height, SENSOR.width)
    return RangeImage.masked(2 + 40 * torch.rand(size, generator=rng), torch.rand(size, generator=rng) < 0.8, SENSOR)


def test_each_image_is_encoded_once_and_alone():
    network, images = Half().train(), scans(4)
    cache = EncodingCache(network, Half.forward, bytes_at_most=3 * 4 * SENSOR.height * SENSOR.width)
    with torch.autocast("cpu", torch.bfloat16):
        together = cache(images)
    assert torch.equal(together, images.range_m / 2), "in 32 bits, though training rounds to 16"
    assert not together.requires_grad
    assert network.batches == [1, 1, 1, 1]
    assert torch.equal(cache(images[[2, 0, 2]]), together[[2, 0, 2]])
    assert len(network.batches) == 4
    assert torch.equal(cache(images[[3, 0]]), together[[3, 0]])
    assert len(network.batches) == 5, "the bound has room for three; the fourth is encoded anew"
    flipped = RangeImage(images.range_m.flip(-1), images.return_mask.flip(-1), SENSOR)
    assert torch.equal(cache(flipped[:1]), together[:1].flip(-1)), "an augmented image is another"


def test_a_copy_of_what_holds_it_shares_network_and_results():
    cache = EncodingCache(Half(), Half.forward)
    assert copy.deepcopy([cache])[0] is cache


def test_images_of_other_reflectance_are_others():
    image = scans(1)
    dark, bright = (
        RangeImage(
            image.range_m, image.return_mask, SENSOR, {"reflectance": torch.where(image.return_mask, value, 0.0)}
        )
        for value in (0.1, 0.9)
    )

    def reflectance(_: nn.Module, images: RangeImage) -> torch.Tensor:
        assert images.reflectance is not None
        return images.reflectance

    cache = EncodingCache(nn.Identity(), reflectance)
    for image in (dark, bright, dark):
        assert torch.equal(cache(image), reflectance(nn.Identity(), image))


def test_a_measured_stage_encodes_other_images_in_every_step(monkeypatch):
    encoded, encode = [], EncodingCache._encoded
    monkeypatch.setattr(EncodingCache, "_encoded", lambda cache, some: encoded.append(some) or encode(cache, some))
    preset = load_preset("lidargrit_demo", [*MODEL, *SIMULATED, *SHORT])
    batch = preset.settings_of("transformer").batch_size
    measure(preset)
    new = [some for some in encoded if not some.range_m.is_meta]  # the others are of counted operations
    assert len(new) == 4 * batch, "one to warm up, and three timed steps"


def test_a_key_that_comes_with_an_image_is_trusted():
    network, images = Half(), scans(2)
    cache, example = EncodingCache(network, Half.forward), Example(images).with_keys()
    assert example.keys == keys_of(images)
    assert example[[1]].keys == example[1:].keys == keys_of(images[1:])
    together = cache(example.images, example.keys)
    assert torch.equal(cache(images), together), "by the hashes of the same pixels"
    assert torch.equal(cache(images[[1, 0]], example.keys), together), "by the keys, whatever the pixels"
    assert network.batches == [1, 1]
