"""Activations computed twice, compiled networks, and columns that wrap: the same gradients as by the plain way."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from lidargrit.core.errors import ConfigError, OutputError
from lidargrit.generation.generator import load_class
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import TrainingConfig
from lidargrit.nn.blocks import Block, Network, prepare_for_training
from lidargrit.nn.convolution import wrapped
from lidargrit.scans.example import Example
from lidargrit.training import train
from lidargrit.training.compute import uniform_images
from tiny_runs import MODEL, SHORT, SIMULATED

SETTINGS = (
    *MODEL,
    "model.tokenizer.dropout=0.2",
    *[f"model.transformer.{part}_dropout=0.2" for part in ("embedding", "residual")],
)


def gradients(objective: nn.Module) -> tuple[list[torch.Tensor], int]:
    """Take one step and return the gradients, and the bytes that were kept for them."""
    kept: dict[int, int] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    torch.manual_seed(1)
    images = uniform_images(objective.sensor, 2)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        loss = objective.train()(Example(images), torch.Generator().manual_seed(2))["loss"]
        bytes_kept = sum(kept.values())
    loss.backward()
    found = [parameter.grad for parameter in objective.parameters() if parameter.grad is not None]
    objective.zero_grad()
    return found, bytes_kept


def objective_of(preset: str, stage: str, *settings: str) -> nn.Module:
    torch.manual_seed(0)
    loaded = load_preset(preset, settings)
    return load_class(loaded.generator)(loaded.model, loaded.data.load_sensor()).objective(stage)


OBJECTIVES = [
    ("lidargrit_demo", "tokenizer", *SETTINGS),
    ("lidargrit_demo", "transformer", *SETTINGS, "model.transformer.layers=3"),
    ("r2dm_small", "diffusion", *MODEL[:2], "model.unet.channel_multipliers=[1,2]", "model.unet.residual_blocks=[1,1]"),
]


@pytest.mark.parametrize("words", OBJECTIVES, ids=lambda words: words[1])
def test_recomputed_gradients_are_the_same_and_take_less_memory(words):
    plain, recomputed = objective_of(*words), objective_of(*words)
    prepare_for_training(recomputed, recompute=True, compiled=False)
    assert plain.state_dict().keys() == recomputed.state_dict().keys()
    prepare_for_training(plain, recompute=True, compiled=False)  # as a stage before may have
    prepare_for_training(plain, recompute=False, compiled=False)
    (wanted, kept), (got, kept_less) = gradients(plain), gradients(recomputed)
    assert len(wanted) == len(got) > 10
    assert all(torch.equal(one, other) for one, other in zip(wanted, got, strict=True))
    assert kept_less < 0.8 * kept


def test_what_has_no_blocks_says_so():
    preset = load_preset("dusty_small")
    objective = load_class("dusty")(preset.model, preset.data.load_sensor()).objective("adversarial")
    for choice in ((True, False), (False, True)):
        with pytest.raises(ConfigError, match=r"=true for \w+, which has no (Block|Network)"):
            prepare_for_training(objective, *choice)


def trace_in_place_of_compiling() -> list[str]:
    """Trace networks as the compiler does, and run the trace, which is noted: no C++ compiler, no minutes."""
    ran = []

    def compile_(module: nn.Module) -> None:
        traced = torch.compile(module._call_impl, backend="eager")

        def call(*inputs: object) -> object:
            ran.append(type(module).__name__)
            return traced(*inputs)

        module._compiled_call_impl = call

    nn.Module.compile = compile_
    return ran


def check_traces() -> None:
    """Every network is one that the compiler takes as a whole, and its gradients are the same."""
    ran = trace_in_place_of_compiling()
    tokenizer, _, unet = OBJECTIVES
    for words in (tokenizer, unet, ("lidargrit_fine_wide", "transformer", "model.transformer.layers=1")):
        plain, traced = objective_of(*words), objective_of(*words)
        before = len(ran)
        prepare_for_training(traced, recompute=False, compiled=True)
        (wanted, _), (got, _) = gradients(plain), gradients(traced)
        assert len(ran) > before
        for one, other in zip(wanted, got, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
        assert not torch._dynamo.utils.counters["graph_break"], torch._dynamo.utils.counters["graph_break"]


def test_compiled_networks_have_the_same_gradients():
    """In a process of its own: the type checks of tests are nothing for the compiler."""
    script = "import test_blocks; test_blocks.check_traces()"
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    command = [sys.executable, "-c", script]
    ended = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}, check=False)
    assert ended.returncode == 0, ended.stderr[-3000:]


def test_a_run_of_the_other_choice_is_refused(tmp_path):
    preset = load_preset("lidargrit_demo", (*MODEL, *SIMULATED, *SHORT))
    train(preset, tmp_path)
    on = replace(preset.training["tokenizer"], recompute=True)
    with pytest.raises(OutputError, match=r"recompute=False, here True"):
        train(replace(preset, training={**preset.training, "tokenizer": on}), tmp_path)
    with pytest.raises(OutputError, match=r"data.projection_variant=exact, here reference"):
        train(replace(preset, data=replace(preset.data, projection_variant="reference")), tmp_path)


def test_both_are_off_unless_asked_for():
    config = TrainingConfig(scans=1, batch_size=1, learning_rate=1.0)
    assert not config.recompute
    assert not config.compile
    assert not Block().recomputed
    assert Network()._compiled_call_impl is None


@pytest.mark.parametrize(("left", "right"), [(1, 1), (0, 1), (2, 3), (0, 0), (4, 4)])
def test_the_gradient_of_wrapped_columns_is_that_of_their_copies(left, right):
    x = torch.rand(2, 3, 4, dtype=torch.float64, requires_grad=True)
    copies = (torch.arange(-left, 4 + right) % 4).tolist()
    assert torch.equal(wrapped(x, left, right), x[..., copies])
    (got,) = torch.autograd.grad((wrapped(x, left, right) ** 3).sum(), x)
    (wanted,) = torch.autograd.grad((x[..., copies] ** 3).sum(), x)
    assert torch.allclose(got, wanted, rtol=1e-12)
    assert torch.autograd.gradgradcheck(lambda x: wrapped(x, left, right) ** 3, (x,))
