"""R2Flow's network: its published size, its program's numbers, its windows."""

import itertools
import json

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.nn.flops import flops_of
from lidargrit.systems.r2flow.hdit import Hdit, HditConfig, neighbourhood_attention
from reference_weights import seeded_weights

SIZES = {"tiny": HditConfig(16, 24, (2, 1, 1, 2), (1, 2, 2, 4)), "wide": HditConfig()}


def reference_network(golden, name):
    """Return a network with the reference's seeded weights, and the reference's numbers."""
    data = golden("rivals/r2flow")
    layout, kept = (json.loads(str(data[f"{name}_{part}"])) for part in ("layout", "kept"))
    sampled = {key: shape for key, shape in layout.items() if key not in kept}
    weights = seeded_weights({"layout": json.dumps(sampled), "weight_seed": data[f"{name}_weight_seed"]})
    network = Hdit(SIZES[name], 2, *torch.from_numpy(data["tiny_coords"])[0]).eval()
    own = network.state_dict()
    assert {key: list(tensor.shape) for key, tensor in own.items()} == layout
    network.load_state_dict(own | weights)
    return network, data


def test_the_published_size_has_the_published_parameters():
    with torch.device("meta"):
        network = Hdit(HditConfig(), 2, torch.zeros(64, 1024), torch.zeros(64, 1024))
    assert sum(weight.numel() for weight in network.parameters()) == 80_908_420
    # A product for every weight but the positions and the time's: what a count may not fall below.
    tokens = {"level_0": 2**14, "level_1": 2**12, "level_2": 2**10, "mid": 2**8}
    layers = {"level_0": 6 * 13 * 128**2, "level_1": 6 * 13 * 256**2, "level_2": 6 * 13 * 512**2, "mid": 3 * 13 * 2**20}
    least = sum(2 * tokens[level] * layers[level] for level in tokens)
    assert least < flops_of(network, (1, 2, 64, 1024), (1,)) < 1.4 * least


@pytest.mark.shared
@pytest.mark.parametrize("name", SIZES)
def test_velocities_and_rotary_tables_are_the_references(golden, name):
    network, data = reference_network(golden, name)
    assert sum(weight.numel() for weight in network.parameters()) == int(data[f"{name}_parameters"])
    with torch.no_grad():
        velocity = network(torch.from_numpy(data[f"{name}_x"]), torch.from_numpy(data[f"{name}_t"])).numpy()
    wanted = data[f"{name}_velocity"]
    assert np.abs(velocity - wanted).max() < 1e-4 * np.abs(wanted).max()
    tables = {key for key in data if key.startswith(f"{name}_freqs")}
    assert tables
    for key in tables:
        axis, _, where = key.removeprefix(f"{name}_freqs_").partition("_")
        modules = {"level_0": "down_levels.level_0.0", "down_levels_level_0_0": "down_levels.level_0.0"}
        module = modules.get(where, "mid_levels.0")
        assert np.array_equal(network.get_buffer(f"{module}.residual_attn.rope.freqs_{axis}").numpy(), data[key])


@pytest.mark.shared
def test_every_part_of_the_tiny_network_is_the_references(golden):
    network, data = reference_network(golden, "tiny")
    found = {}
    for module in ("timestep_pe", "timestep_pe.0", "tokenizer", "mid_levels.0", "down_levels.merge_0"):
        network.get_submodule(module).register_forward_hook(
            lambda _, __, output, module=module: found.setdefault(module, output)
        )
    with torch.no_grad():
        network(torch.from_numpy(data["tiny_x"][:1]), torch.from_numpy(data["tiny_t"][:1]))
    found["tokenizer"] = found["tokenizer"].permute(0, 2, 3, 1)
    for module, output in found.items():
        wanted = data[f"tiny_after_{module.replace('.', '_')}"]
        assert np.abs(output.numpy().reshape(wanted.shape) - wanted).max() < 1e-4 * np.abs(wanted).max(), module


@pytest.mark.parametrize(("rows", "columns"), [(5, 24), (3, 12), (2, 6), (4, 2), (1, 1)])
def test_attention_sees_the_window_of_each_token(rows, columns):
    rng = torch.Generator().manual_seed(0)
    q, k, v = torch.randn(3, 2, 3, rows, columns, 4, generator=rng)
    found = neighbourhood_attention(q, k, v)
    for row, column in itertools.product(range(rows), range(columns)):
        first = min(max(row - 1, 0), max(rows - 3, 0))
        seen = [(r, (column + shift) % columns) for r in range(first, min(first + 3, rows)) for shift in range(-4, 5)]
        keys, values = (torch.stack([each[:, :, r, c] for r, c in seen], dim=2) for each in (k, v))
        weights = (keys * q[:, :, row, column, None]).sum(-1).softmax(-1)
        assert torch.allclose(found[:, :, row, column], (weights[..., None] * values).sum(2), atol=1e-5)


@pytest.mark.shared
def test_windows_of_rows_begin_where_the_references_do(golden):
    """With equal keys and rows as values, a token finds the mean of the three rows that it sees."""
    values = torch.arange(16.0)[None, None, :, None, None].expand(1, 1, 16, 16, 1)
    nothing = torch.zeros_like(values)
    middle = neighbourhood_attention(nothing, nothing, values)[0, 0, :, 0, 0]
    assert (middle.round() - 1).tolist() == golden("rivals/r2flow")["window_starts_16_3"].tolist()


def test_a_turned_image_gives_a_turned_answer_but_for_positions():
    azimuth = torch.linspace(torch.pi, -torch.pi, 65)[:-1].expand(16, 64)
    torch.manual_seed(3)
    network = Hdit(SIZES["tiny"], 1, torch.linspace(0.1, -0.4, 16)[:, None].expand(16, 64), azimuth)
    with torch.no_grad():
        for weight in network.parameters():
            weight.copy_(0.2 * torch.randn(weight.shape))
        network.spatial_pe.embedding.zero_()
        noisy, time = torch.randn(1, 1, 16, 64), torch.tensor([0.3])
        straight, turned = network(noisy, time), network(noisy.roll(32, 3), time)
    assert float(straight.std()) > 0.01
    assert torch.allclose(turned, straight.roll(32, 3), atol=1e-4 * float(straight.abs().max()))


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"depths": (3, 3)}, r"depths=\(3, 3\), heads="),
        ({"depths": (0, 3, 3, 3)}, r"depths=\(0, 3, 3, 3\)"),
        ({"depths": (10**9, 1, 1, 1)}, "1000 blocks at most"),
        ({"channels": 12}, "channels=12"),
        ({"channels": 0}, "channels=0"),
        ({"time_channels": 3}, "time_channels=3"),
    ],
)
def test_sizes_that_cannot_be_are_refused(sizes, message):
    with pytest.raises(ConfigError, match=message):
        HditConfig(**sizes)


def test_images_that_cannot_be_halved_are_refused():
    with pytest.raises(ConfigError, match="range images of 64x48; wanted rows divisible by 8 and columns by 32"):
        Hdit(HditConfig(16, 8, (1,) * 4, (1,) * 4), 1, torch.zeros(64, 48), torch.zeros(64, 48))
