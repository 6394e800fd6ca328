"""Learning rate, decay, clipping and the sum of the loss: what a silent slip would leave untested."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from lidargrit.core.errors import ConfigError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.generation.objective import Objective
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import TrainingConfig
from lidargrit.generation.tokenizers.vqvae import Vqvae
from lidargrit.nn.convolution import Residual
from lidargrit.nn.transformer import CausalTransformer, TransformerConfig
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.training.checkpoint import load_checkpoint, save_checkpoint
from lidargrit.training.engine import Engine
from lidargrit.training.optimiser import Muon, WeightAverage, learning_rate_at, make_optimiser


def config(**settings):
    return TrainingConfig(**{"scans": 1000, "batch_size": 10, "learning_rate": 0.1, **settings})


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


def small_transformer():
    torch.manual_seed(0)
    return CausalTransformer(TransformerConfig(layers=2, heads=2, width=8), num_tokens=5, grid_size=(1, 4))


class Wrapped(Objective):
    """A network as an objective that is never computed."""

    def __init__(self, network):
        super().__init__(load_sensor("hdl64e_kitti_odometry"))
        self.network = network

    def forward(self, example, rng, player):
        raise NotImplementedError


def muon_step(optimiser, model, seed):
    tokens = torch.randint(0, 5, (3, 4), generator=torch.Generator().manual_seed(seed))
    optimiser.zero_grad()
    model.eval()(tokens).logsumexp(-1).mean().backward()
    optimiser.step()


def test_muon_moves_the_matrices_of_blocks_and_adamw_all_else(monkeypatch):
    monkeypatch.setattr(
        "lidargrit.training.optimiser.dtype_of", lambda _precision: torch.bfloat16
    )  # as torch always does
    ours, theirs = small_transformer(), small_transformer()
    matrices = [p for name, p in theirs.named_parameters() if name.startswith("blocks.") and p.ndim == 2]
    others = [p for name, p in theirs.named_parameters() if not (name.startswith("blocks.") and p.ndim == 2)]
    assert len(matrices) == 12
    muon = torch.optim.Muon(matrices, lr=0.1, weight_decay=0.3, adjust_lr_fn="match_rms_adamw")
    head = [p for p in others if p is theirs.head.weight]
    rest = [p for p in others if p is not theirs.head.weight]
    groups = [{"params": head, "weight_decay": 0.3}, {"params": rest, "weight_decay": 0.0}]
    adamw = torch.optim.AdamW(groups, lr=0.1, betas=(0.9, 0.95), fused=True)
    together = make_optimiser(ours, config(optimiser="muon", weight_decay=0.3))
    for seed in range(3):
        muon_step(together, ours, seed)
        muon.zero_grad()
        muon_step(adamw, theirs, seed)
        muon.step()
    for (name, got), wanted in zip(ours.named_parameters(), theirs.parameters(), strict=True):
        assert torch.equal(got, wanted), name


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_muon_takes_the_kernels_of_blocks_as_matrices_of_one_row_a_channel(layout):
    torch.manual_seed(0)
    ours = Residual(4).to(memory_format=layout)
    before = {name: weight.detach().clone() for name, weight in ours.named_parameters()}
    gradients = {name: torch.randn(weight.shape) for name, weight in ours.named_parameters()}
    together = make_optimiser(ours, config(optimiser="muon", weight_decay=0.0))
    for name, weight in ours.named_parameters():
        weight.grad = gradients[name].clone(memory_format=layout) if weight.ndim == 4 else gradients[name].clone()
    together.step()
    for name, weight in ours.named_parameters():
        assert weight.shape == before[name].shape
        assert weight.grad is not None
        assert torch.equal(weight.grad, gradients[name])
        if weight.ndim == 4:
            matrix = nn.Parameter(before[name].flatten(1).clone())
            matrix.grad = gradients[name].flatten(1)
            Muon([matrix], lr=0.1, weight_decay=0.0).step()
            step = (matrix - before[name].flatten(1)).abs().max()
            assert step > 0
            assert torch.equal(weight.flatten(1), matrix)


@pytest.mark.parametrize("shape", [(3, 7), (7, 3), (5, 5)])
def test_a_step_of_muon_is_that_of_a_loop_over_singular_values(shape, monkeypatch):
    monkeypatch.setattr("lidargrit.training.optimiser.dtype_of", lambda _precision: torch.float32)
    rng = np.random.default_rng(0)
    start, gradients = rng.normal(size=shape), rng.normal(size=(3, *shape))
    weight, wanted, average = nn.Parameter(torch.tensor(start).float()), start.copy(), np.zeros(shape)
    optimiser = Muon([weight], lr=0.1, weight_decay=0.3)
    for gradient in gradients:
        weight.grad = torch.tensor(gradient).float()
        optimiser.step()
        average = 0.95 * average + 0.05 * gradient
        left, values, right = np.linalg.svd(0.05 * gradient + 0.95 * average, full_matrices=False)
        values /= np.linalg.norm(values)
        for _ in range(5):  # the polynomial acts on each singular value by itself
            values = 3.4445 * values - 4.7750 * values**3 + 2.0315 * values**5
        wanted = wanted * (1 - 0.1 * 0.3) - 0.1 * 0.2 * math.sqrt(max(shape)) * (left * values) @ right
    assert weight.detach().numpy() == pytest.approx(wanted, abs=1e-5)


def test_muon_goes_on_from_its_checkpoint(tmp_path):
    whole, cut = small_transformer(), small_transformer()
    optimiser = make_optimiser(whole, config(optimiser="muon"))
    first = make_optimiser(cut, config(optimiser="muon"))
    for seed in range(4):
        muon_step(optimiser, whole, seed)
    for seed in range(2):
        muon_step(first, cut, seed)
    average = WeightAverage(Wrapped(cut), 0)
    save_checkpoint(tmp_path / "c", cut, average, first, 20, "")
    resumed = small_transformer()
    again = make_optimiser(resumed, config(optimiser="muon"))
    assert load_checkpoint(tmp_path / "c", resumed, average, again, "") == 20
    for group in again.param_groups:
        group["lr"] = 0.1  # as the training sets it before every step
    for seed in (2, 3):
        muon_step(again, resumed, seed)
    for got, wanted in zip(resumed.parameters(), whole.parameters(), strict=True):
        assert torch.equal(got, wanted)


def test_muon_is_refused_where_no_block_has_a_matrix():
    with pytest.raises(ConfigError, match="optimiser=muon"):
        make_optimiser(nn.Linear(4, 4), config(optimiser="muon"))


@pytest.fixture
def images():
    data = DataConfig(train=("simulated:2:train",), columns=256, column_stride=8)
    return load_range_images(data.train, data).batch([0, 1])


@pytest.mark.parametrize("weight", [0.0, 0.1, 3.0])
def test_the_loss_is_the_papers_sum(images, weight):
    model = load_preset("lidargrit_demo", [f"model.tokenizer.raydrop_weight={weight}"]).model.tokenizer
    torch.manual_seed(0)
    vqvae = Vqvae(model, images.sensor).eval()
    with torch.no_grad():
        terms = vqvae(Example(images), torch.Generator())
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

        def forward(self, example, rng, player):
            return {"loss": (self.weight * self.slope).sum()}

    steep = Steep()
    engine, optimiser = Engine("fp32"), torch.optim.SGD(steep.parameters(), lr=1.0)
    engine.set_up(steep, optimiser)
    engine.step(Example(images), 0, gradient_clip=0.5)
    assert float(steep.weight.detach().norm()) == pytest.approx(0.5, rel=1e-4)
    before, steep.slope = steep.weight.detach().clone(), math.inf
    steep.weight.data.fill_(0.0)
    assert not bool(engine.step(Example(images), 0, gradient_clip=0.5)["loss"].isfinite())
    assert steep.weight.tolist() == [0.0, 0.0]
    assert before.numel() == 2


def test_a_gradient_that_is_no_number_moves_nothing_without_a_limit_either(images):
    class Cornered(Objective):
        def __init__(self):
            super().__init__(images.sensor)
            self.weight = nn.Parameter(torch.zeros(2))

        def forward(self, example, rng, player):
            return {"loss": self.weight.sqrt().sum()}  # 0, with a slope of infinity

    cornered = Cornered()
    engine = Engine("fp32")
    engine.set_up(cornered, torch.optim.SGD(cornered.parameters(), lr=1.0))
    assert not bool(engine.step(Example(images), 0, gradient_clip=0.0)["loss"].isfinite())
    assert cornered.weight.tolist() == [0.0, 0.0]


def test_ranges_reach_the_objective_unrounded(images):
    class Listening(Objective):
        def __init__(self):
            super().__init__(images.sensor)
            self.weight, self.heard = nn.Parameter(torch.zeros(1)), None

        def forward(self, example, rng, player):
            self.heard = example.images.range_m
            return {"loss": self.weight.sum()}

    listening = Listening()
    engine = Engine("bf16")
    engine.set_up(listening, torch.optim.SGD(listening.parameters(), lr=1.0))
    engine.step(Example(images), 0, gradient_clip=0.5)
    assert torch.equal(listening.heard, images.range_m)


def test_tokens_do_not_depend_on_the_precision_around_them(images):
    torch.manual_seed(0)
    vqvae = Vqvae(load_preset("lidargrit_demo").model.tokenizer, images.sensor).eval()
    vqvae.quantize.embedding.weight.data.normal_(mean=5)
    z = torch.randn(2, 64, 8, 8) + 5
    with torch.no_grad():
        plain = vqvae.quantize(z).tokens
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(vqvae.quantize(z).tokens, plain)
