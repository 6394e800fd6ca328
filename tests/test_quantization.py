"""Weights in 8 bits: what a file of them holds, and what is read from it."""

import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import CheckpointError
from lidargrit.core.files import read_tensors, write_tensors
from lidargrit.data.run_folder import WEIGHTS_FILE
from lidargrit.generation.generator import load
from lidargrit.nn.quantization import quantize, with_quantized, without_quantized
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.dusty.system import Dusty
from tiny_runs import the_one_line

SENSOR = load_sensor("hdl64e_kitti_odometry")


def _weights() -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    sizes = {"kernel": (5, 3, 3, 3), "one": (1, 1), "block": (8, 8), "positions": (1, 10, 13)}
    spread = torch.logspace(-6, 6, 1000)
    found = {name: torch.randn(size, generator=rng) for name, size in sizes.items()}
    return {**found, "spread": torch.randn(1000, generator=rng) * spread, "zeros": torch.zeros(3, 70)}


@pytest.mark.parametrize(("name", "weight"), _weights().items())
def test_every_number_is_the_nearest_of_its_block_by_a_slow_loop(name, weight):
    whole, scales = quantize(weight)
    restored = without_quantized(with_quantized({name: weight}, [name]))[name].flatten().tolist()
    numbers = weight.flatten().tolist()
    assert len(scales) == -(-len(numbers) // 64)
    for first, scale in zip(range(0, len(numbers), 64), scales.tolist(), strict=True):
        largest = max(map(abs, numbers[first : first + 64]))
        assert scale == pytest.approx(largest / 127, rel=2**-8)
        for index in range(first, min(first + 64, len(numbers))):
            step = int(whole.flatten()[index])
            assert -127 <= step <= 127
            assert restored[index] == step * scale
            assert abs(restored[index] - numbers[index]) <= scale * 0.5001


@pytest.mark.parametrize(("name", "weight"), _weights().items())
def test_rounded_weights_are_stored_without_another_error(name, weight):
    once = without_quantized(with_quantized({name: weight}, [name]))
    assert torch.equal(without_quantized(with_quantized(once, [name]))[name], once[name])
    assert torch.equal(quantize(once[name])[0], quantize(weight)[0])


def test_a_file_has_a_quarter_of_the_bytes_and_lacks_or_repeats_nothing(tmp_path):
    model = Dusty(Dusty.smallest_config(SENSOR), SENSOR).eval()
    for bits in (8, 32):
        model.save_pretrained(tmp_path / str(bits), bits=bits)
    assert (tmp_path / "8" / WEIGHTS_FILE).stat().st_size < 0.35 * (tmp_path / "32" / WEIGHTS_FILE).stat().st_size
    again = load(tmp_path / "8")
    wanted = without_quantized(model.weights(8))
    assert again.state_dict().keys() == model.state_dict().keys() == wanted.keys()
    for name, parameter in again.state_dict().items():
        assert parameter.dtype == model.state_dict()[name].dtype
        assert torch.equal(parameter, wanted[name].to(parameter.dtype))


@pytest.mark.parametrize("lost", ["scales", "whole"])
def test_a_file_whose_scales_do_not_fit_is_refused(tmp_path, lost):
    model = Dusty(Dusty.smallest_config(SENSOR), SENSOR)
    model.save_pretrained(tmp_path / "run", bits=8)
    weights, _ = read_tensors(tmp_path / "run" / WEIGHTS_FILE)
    name = next(name for name, weight in weights.items() if weight.dtype == torch.int8)
    if lost == "scales":
        weights[f"{name}:scales"] = weights[f"{name}:scales"][:-1]
    else:
        del weights[name]
    write_tensors(tmp_path / "run" / WEIGHTS_FILE, weights)
    with pytest.raises(CheckpointError, match=name):
        load(tmp_path / "run")


def test_other_bits_are_refused(tmp_path, capsys):
    assert main(["publish", "pretrained", str(tmp_path / "out"), "--bits", "12"]) == 2
    line = the_one_line(capsys.readouterr().err, "publish")
    assert "12" in line
    assert "8, 16 or 32" in line
    assert not (tmp_path / "out").exists()
