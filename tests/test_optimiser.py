"""Learning rate, decay, clipping and the sum of the loss: what a silent slip would leave untested."""

import math

import pytest
import torch
from torch import nn

from lidargrit.loading import DataConfig
from lidargrit.nn.objective import Objective
from lidargrit.recipes import load_recipe
from lidargrit.sources import load_range_images
from lidargrit.tokenizers.vqvae import Vqvae
from lidargrit.training import FitConfig
from lidargrit.training.engine import Engine
from lidargrit.training.optimiser import learning_rate_at, make_optimiser


def config(**settings):
    return FitConfig(**{"scans": 1000, "batch_size": 10, "learning_rate": 0.1, **settings})


def test_learning_rates():
    cosine, second_half = config(schedule="cosine"), config(schedule="linear_second_half")
    for seen in (0, 250, 500, 900):
        assert learning_rate_at(config(), seen) == 0.1
        assert learning_rate_at(cosine, seen) == pytest.approx(0.05 * (1 + math.cos(math.pi * seen / 1000)))
        assert learning_rate_at(second_half, seen) == pytest.approx(0.1 if seen <= 500 else 0.2 * (1 - seen / 1000))
    warm = config(warmup_scans=100)
    assert [learning_rate_at(warm, seen) for seen in (0, 40, 90, 200)] == pytest.approx([0.01, 0.05, 0.1, 0.1])


def test_only_weights_of_linear_layers_decay():
    module = nn.Sequential(nn.Embedding(3, 4), nn.Linear(4, 4), nn.LayerNorm(4), nn.Conv2d(1, 1, 3))
    optimiser = make_optimiser(module, config(weight_decay=0.3))
    decaying = [p for group in optimiser.param_groups if group["weight_decay"] for p in group["params"]]
    assert len(decaying) == 1
    assert decaying[0] is module[1].weight
    assert {group["weight_decay"] for group in optimiser.param_groups} == {0.3, 0.0}


@pytest.fixture
def images(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    data = DataConfig(train=("simulated:2:train",), columns=256, column_stride=8)
    return load_range_images(data.train, data).batch([0, 1])


@pytest.mark.parametrize("weight", [0.0, 0.1, 3.0])
def test_the_loss_is_the_papers_sum(images, weight):
    model = load_recipe("demo", [f"model.tokenizer.raydrop_weight={weight}"]).model.tokenizer
    torch.manual_seed(0)
    vqvae = Vqvae(model, images.sensor).eval()
    with torch.no_grad():
        terms = vqvae(images, torch.Generator())
        tokens = vqvae.encode(images)
        logits = vqvae.decode(tokens).return_logits
    log_likelihood = torch.where(images.return_mask, logits.sigmoid().log(), (1 - logits.sigmoid()).log())
    assert float(terms["raydrop"]) == pytest.approx(-float(log_likelihood.mean()), rel=1e-4)
    total = terms["reconstruction"] + weight * terms["raydrop"] + terms["commitment"]
    assert float(terms["loss"]) == pytest.approx(float(total), rel=1e-6)


def test_gradients_are_clipped_and_infinite_ones_change_nothing(images):
    class Steep(Objective):
        def __init__(self):
            super().__init__(images.sensor)
            self.weight, self.slope = nn.Parameter(torch.zeros(2)), 1e6

        def forward(self, images, rng, player):
            return {"loss": (self.weight * self.slope).sum()}

    steep = Steep()
    engine, optimiser = Engine("fp32"), torch.optim.SGD(steep.parameters(), lr=1.0)
    engine.set_up(steep, optimiser)
    engine.step(images, 0, gradient_clip=0.5)
    assert float(steep.weight.detach().norm()) == pytest.approx(0.5, rel=1e-4)
    before, steep.slope = steep.weight.detach().clone(), math.inf
    steep.weight.data.fill_(0.0)
    assert not bool(engine.step(images, 0, gradient_clip=0.5)["loss"].isfinite())
    assert steep.weight.tolist() == [0.0, 0.0]
    assert before.numel() == 2


def test_ranges_reach_the_objective_unrounded(images):
    class Listening(Objective):
        def __init__(self):
            super().__init__(images.sensor)
            self.weight, self.heard = nn.Parameter(torch.zeros(1)), None

        def forward(self, images, rng, player):
            self.heard = images.range_m
            return {"loss": self.weight.sum()}

    listening = Listening()
    engine = Engine("bf16")
    engine.set_up(listening, torch.optim.SGD(listening.parameters(), lr=1.0))
    engine.step(images, 0, gradient_clip=0.5)
    assert torch.equal(listening.heard, images.range_m)


def test_tokens_do_not_depend_on_the_precision_around_them(images):
    torch.manual_seed(0)
    vqvae = Vqvae(load_recipe("demo").model.tokenizer, images.sensor).eval()
    vqvae.quantize.embedding.weight.data.normal_(mean=5)
    z = torch.randn(2, 64, 8, 8) + 5
    with torch.no_grad():
        plain = vqvae.quantize(z).tokens
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(vqvae.quantize(z).tokens, plain)
