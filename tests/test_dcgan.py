"""The networks of DUSty and of the GAN beneath it, with the published layout, against a slow re-statement."""

import json
import math

import numpy as np
import pytest
import torch

from lidargrit.core.errors import CheckpointError
from lidargrit.nn.flops import flops_of
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.dusty.dcgan import Discriminator, Synthesis, Widths
from lidargrit.systems.dusty.system import AdversarialObjective, Dusty, DustyConfig
from reference_weights import seeded_weights

SENSOR = load_sensor("hdl64e_kitti_odometry")
SIZE = (32, 32)


@pytest.mark.parametrize(
    ("variant", "parameters"), [("dusty_1", 19_532_738), ("dusty_2", 19_533_763), ("baseline", 19_531_713)]
)
def test_networks_have_the_published_sizes(variant, parameters):
    with torch.device("meta"):
        generator = Dusty(DustyConfig(variant=variant), SENSOR)
        game = generator.objective("adversarial")
    assert isinstance(game, AdversarialObjective)
    assert sum(weight.numel() for weight in generator.parameters()) == parameters
    assert sum(weight.numel() for weight in game.discriminator.parameters()) == 2_788_289
    assert generator.cost().network_evaluations == 1
    assert generator.cost().flops == pytest.approx(1.17e9, rel=0.01)
    assert flops_of(game.discriminator, (1, 1, 64, 256)) == pytest.approx(0.82e9, rel=0.01)


# --- the networks again, pixel by pixel


def slow_pad(x):
    height, width = x.shape[1:]
    rows, columns = [1, *range(height), height - 2], [column % width for column in range(-1, width + 1)]
    return x[:, rows][:, :, columns]


def slow_transposed(x, weight, stride):
    """(C, H, W), each pixel painting its kernel."""
    height, width = x.shape[1:]
    down, along = weight.shape[2:]
    out = np.zeros((weight.shape[1], (height - 1) * stride + down, (width - 1) * stride + along))
    for i in range(height):
        for j in range(width):
            window = np.s_[:, i * stride : i * stride + down, j * stride : j * stride + along]
            out[window] += np.einsum("c,cdkl->dkl", x[:, i, j], weight)
    return out / math.sqrt(weight[0].size)


def slow_convolution(x, weight, stride):
    down, along = weight.shape[2:]
    rows, columns = range(0, x.shape[1] - down + 1, stride), range(0, x.shape[2] - along + 1, stride)
    out = [[np.einsum("ckl,dckl->d", x[:, i : i + down, j : j + along], weight) for j in columns] for i in rows]
    return np.moveaxis(np.array(out), -1, 0) / math.sqrt(weight[0].size)


def slow_rectify(x, bias):
    x = x + bias[:, None, None]
    return np.where(x > 0, x, 0.2 * x) * 2**0.5


def slow_synthesis(theirs, latent):
    h = slow_rectify(slow_transposed(latent[:, None, None], theirs["0.0.module.weight"], 1), theirs["0.1.bias"])
    for layer in (1, 2, 3):
        h = slow_transposed(slow_pad(h), theirs[f"{layer}.1.module.weight"], 2)[:, 3:-3, 3:-3]
        h = slow_rectify(h, theirs[f"{layer}.2.bias"])
    maps = {}
    for head in ("depth", "confidence"):
        if f"4.heads.{head}.1.module.weight" in theirs:
            drawn = slow_transposed(slow_pad(h), theirs[f"4.heads.{head}.1.module.weight"], 2)[:, 3:-3, 3:-3]
            maps[head] = drawn + theirs[f"4.heads.{head}.1.module.bias"][:, None, None]
    return np.tanh(maps["depth"]), maps.get("confidence")


def slow_discriminator(weights, image):
    h = slow_pad(image[None])[0]
    down = (h[:-2, 1:-1] + 2 * h[1:-1, 1:-1] + h[2:, 1:-1]) / 4
    along = (h[1:-1, :-2] + 2 * h[1:-1, 1:-1] + h[1:-1, 2:]) / 4
    h = np.stack((down, along))
    for level in range(4):
        h = slow_rectify(
            slow_convolution(slow_pad(h), weights[f"down.{level}.weight"], 2), weights[f"down.{level}.bias"]
        )
    return float(slow_convolution(h, weights["verdict.weight"], 1)[0, 0, 0] + weights["verdict.bias"][0])


def published(logits, size=SIZE):
    """Make weights as the program names and shapes them: latents of 6, 3 channels at the finest level, at most 10."""
    widths = [3, 6, 10, 10]
    layout = {"0.0.module.weight": [6, 10, size[0] // 16, size[1] // 16], "0.1.bias": [10]}
    for layer in (1, 2, 3):
        layout[f"{layer}.1.module.weight"] = [widths[4 - layer], widths[3 - layer], 4, 4]
        layout[f"{layer}.2.bias"] = [widths[3 - layer]]
    for head, outputs in (("depth", 1), ("confidence", logits)):
        if outputs:
            layout[f"4.heads.{head}.1.module.weight"] = [3, outputs, 4, 4]
            layout[f"4.heads.{head}.1.module.bias"] = [outputs]
    drawn = seeded_weights({"layout": json.dumps(layout), "weight_seed": 7})
    return {name: value * 4 for name, value in drawn.items()}  # large enough for tanh and rectifiers to matter


@pytest.mark.parametrize("logits", [0, 1, 2])
def test_published_weights_draw_what_a_slow_network_draws(logits, tmp_path):
    theirs = published(logits, (64, 256))
    named = {f"backbone.{name}": value for name, value in theirs.items()} | {"drop_const": torch.tensor(-1.0)}
    other = {
        "step": 1,
        "G_ema": named if logits else theirs,
        "optim_G": {"state": {0: {"step": 3}}, "param_groups": []},
    }
    torch.save(other, tmp_path / "checkpoint.pth")
    generator = Dusty.from_published([tmp_path / "checkpoint.pth"], DustyConfig(), load_sensor("hdl64e_kitti_odometry"))
    assert generator.config.variant == ("baseline", "dusty_1", "dusty_2")[logits]
    latents = torch.randn(1, 6, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        ranges, confidence = generator.synthesis(latents)
    slow = {name: value.double().numpy() for name, value in theirs.items()}
    for number, latent in enumerate(latents.double().numpy()):
        depth, wanted = slow_synthesis(slow, latent)
        assert 0.1 < np.abs(depth).mean() < 0.98  # the comparison means something
        np.testing.assert_allclose(ranges[number].numpy(), depth, atol=2e-5)
        if confidence is not None:
            np.testing.assert_allclose(confidence[number].numpy(), wanted, atol=2e-4, rtol=1e-4)
    assert (confidence is None) == (logits == 0)


def test_the_discriminator_judges_as_a_slow_one():
    judge = Discriminator(Widths(3, 10), SIZE).double()
    layout = {name: list(value.shape) for name, value in judge.state_dict().items()}
    drawn = {
        name: 4 * w.double() for name, w in seeded_weights({"layout": json.dumps(layout), "weight_seed": 5}).items()
    }
    judge.load_state_dict(drawn)
    seen = torch.rand(2, 1, *SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 2 - 1
    with torch.no_grad():
        found = judge(seen)
    weights = {name: value.numpy() for name, value in drawn.items()}
    assert found.tolist() == pytest.approx([slow_discriminator(weights, one[0].numpy()) for one in seen], rel=1e-9)


def test_a_synthesis_wraps_around_the_circle():
    """Columns of the coarsest map moved by one move the image by sixteen: no seam."""
    network = Synthesis(4, Widths(4, 8), (32, 64), 1)
    weight = network.project.weight.data
    latents = torch.randn(1, 4)
    with torch.no_grad():
        before = network(latents)
        network.project.weight.data = weight.roll(1, dims=3)
        after = network(latents)
    for one, other in zip(before, after, strict=True):
        assert torch.allclose(one.roll(16, dims=3), other, atol=1e-5)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ({"G": {}}, "which holds no 'G_ema'"),
        ({"G_ema": {"0.0.module.weight": torch.zeros(3)}}, "whose 'G_ema' is no generator of DUSty v1"),
        ({"G_ema": published(1)}, r"of another configuration \(of another size 'project.weight'"),  # of smaller images
        ({"G_ema": {**published(1, (64, 256)), "more": torch.zeros(1)}}, "has besides 'more'"),
        ({"G_ema": {"a": torch.zeros(1, dtype=torch.float64)}}, "no float32 tensor"),
        ({"G_ema": [1, 2]}, "which holds no tensors by name"),
    ],
)
def test_other_checkpoints_are_refused_in_one_line(content, match, tmp_path):
    torch.save(content, tmp_path / "checkpoint.pth")
    with pytest.raises(CheckpointError, match=match) as refusal:
        Dusty.from_published([tmp_path / "checkpoint.pth"], DustyConfig(), load_sensor("hdl64e_kitti_odometry"))
    assert "\n" not in str(refusal.value)


def test_what_is_no_checkpoint_is_refused(tmp_path):
    (tmp_path / "words").write_text("no weights")
    for path in (tmp_path / "words", tmp_path, tmp_path / "nowhere"):
        with pytest.raises(CheckpointError, match=r"wanted a checkpoint with weights at 'G_ema'"):
            Dusty.from_published([path], DustyConfig(), load_sensor("hdl64e_kitti_odometry"))
