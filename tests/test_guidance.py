"""Guidance of a whole model: which one counts, what it costs, and what samples say of it."""

from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import ConfigError, OutputError
from lidargrit.data.sources.samples import read_samples
from lidargrit.generation.generator import load
from lidargrit.inference.samples import write_samples
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.lidargrit.system import LidarGrit, LidarGritConfig, TokenSampling

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(512, stride=8)  # 64x64 pixels


@pytest.fixture(scope="module")
def plain():
    torch.manual_seed(0)
    config = replace(LidarGrit.smallest_config(SENSOR), transformer=TransformerConfig(layers=3, heads=2, width=16))
    model = LidarGrit(config, SENSOR).eval()
    for parameter in model.transformer.parameters():  # so that attention tells something
        torch.nn.init.normal_(parameter, std=0.3)
    return model


@pytest.fixture(scope="module")
def guided(plain):
    model = LidarGrit(replace(plain.config, guidance=3.0), SENSOR).eval()
    model.load_state_dict(plain.state_dict())
    return model


def test_the_model_s_own_is_taken_unless_another_is_named(plain, guided):
    own, wanted = guided.sample([0, 1]).range_m, plain.sample([0, 1], sampling=TokenSampling(guidance=3.0)).range_m
    assert torch.equal(own, wanted)
    assert not torch.equal(plain.sample([0, 1]).range_m, wanted)
    assert torch.equal(
        guided.sample([0, 1], sampling=TokenSampling(guidance=1.0)).range_m, plain.sample([0, 1]).range_m
    )
    assert guided.cost() == plain.cost(TokenSampling(guidance=3.0))
    assert guided.cost().flops > plain.cost().flops


def test_a_seed_gives_the_same_scan_whatever_its_batch(guided):
    assert torch.equal(guided.sample([0, 1, 2]).range_m[2], guided.sample([2]).range_m[0])


def test_samples_of_another_guidance_of_the_model_are_not_taken_for_the_same(plain, guided, tmp_path):
    for name, model in (("plain", plain), ("guided", guided)):
        model.save(tmp_path / name)
        again = load(tmp_path / name)
        assert again.config.guidance == model.config.guidance
        write_samples(again, tmp_path / name, tmp_path / f"of_{name}", [0])
    of_plain, of_guided = (read_samples(tmp_path / f"of_{name}").provenance.names for name in ("plain", "guided"))
    assert of_plain != of_guided
    with pytest.raises(OutputError, match="another model"):
        write_samples(guided, tmp_path / "guided", tmp_path / "of_plain", [1])


@pytest.mark.parametrize("guidance", [0.5, -1.0, 1e9, float("nan")])
def test_one_out_of_bounds_is_refused(guidance):
    with pytest.raises(ConfigError, match="guidance="):
        TokenSampling(guidance=guidance)
    with pytest.raises(ConfigError, match="guidance="):
        LidarGritConfig(guidance=guidance)
