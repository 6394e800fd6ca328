"""Reflectance in the tokens: off as in the paper, or learned, sampled, completed, written and scored."""

from dataclasses import replace

import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.tokenizers.vqvae import Vqvae, VqvaeConfig
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit, LidarGritConfig, TokenSampling
from tiny_runs import the_one_line, train_words

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
PLAIN = VqvaeConfig(channels=32, channel_multipliers=(1, 1, 1, 1), code_dim=8, num_codes=32, dropout=0.0)
BOTH = replace(PLAIN, reflectance=True)
PIXELS = PixelDecoderConfig(mask_features=2, range_features=2, mask_width=4, range_width=4, blocks=1)


def scans(count: int) -> RangeImage:
    """Return walls with drops, as bright on the left as they are dark on the right."""
    rng = torch.Generator().manual_seed(1)
    range_m = (20 + 10 * SENSOR.azimuth_rad.cos()).expand(count, 64, 32)
    mask = torch.rand(count, 64, 32, generator=rng) < 0.8
    bright = torch.linspace(0.9, 0.1, 32).expand(count, 64, 32)
    return RangeImage.masked(range_m, mask, SENSOR, {"reflectance": bright})


def test_without_it_nothing_differs_and_with_it_two_layers_grow():
    plain, both = (dict(Vqvae(config, SENSOR).state_dict()) for config in (PLAIN, BOTH))
    grown = {name for name in plain if plain[name].shape != both[name].shape}
    assert plain.keys() == both.keys()
    assert grown == {"encoder.conv_in.weight", "decoder.conv_out.weight", "decoder.conv_out.bias"}


@pytest.mark.parametrize("raydrop", [True, False])
def test_it_is_learned(raydrop):
    torch.manual_seed(0)
    vqvae, images = Vqvae(replace(BOTH, raydrop_loss=raydrop), SENSOR).train(), scans(2)
    optimiser = torch.optim.Adam(vqvae.parameters(), lr=3e-3)
    errors = []
    for step in range(12):
        terms = vqvae(Example(images), torch.Generator().manual_seed(step))
        optimiser.zero_grad()
        terms["loss"].backward()
        optimiser.step()
        errors.append(float(terms["reflectance_mae"]))
    assert errors[0] > 0.15
    assert errors[-1] < 0.7 * errors[0]
    decoded = vqvae.eval().reconstruct(images).reflectance
    assert decoded is not None
    assert 0 <= float(decoded.min()) <= float(decoded.max()) <= 1


def test_scans_without_it_are_refused():
    vqvae, without = Vqvae(BOTH, SENSOR).eval(), scans(1).with_planes(reflectance=None)
    for work in (lambda: vqvae.encode(without), lambda: vqvae(Example(without), torch.Generator())):
        with pytest.raises(
            ConfigError, match=r"without reflectance, for a model of model\.tokenizer\.reflectance=true"
        ):
            work()


def test_samples_and_completions_have_it():
    torch.manual_seed(0)
    model = LidarGrit(LidarGritConfig(BOTH, TransformerConfig(layers=1, heads=2, width=16), PIXELS), SENSOR).eval()
    for mask in ("pixels", "bernoulli"):
        image = model.sample([3], sampling=TokenSampling(mask=mask))
        assert image.reflectance is not None
        assert bool((image.reflectance[image.return_mask] > 0).all())
        assert not bool(image.reflectance[~image.return_mask].any())
    observed = torch.zeros(1, 64, 32, dtype=torch.bool)
    observed[:, :, :16] = True
    scan = scans(1)
    completed = model.complete(Observed.of_pixels(scan, observed), [5]).reflectance
    assert completed is not None
    assert scan.reflectance is not None
    assert torch.equal(completed[observed], scan.reflectance[observed])
    assert bool((completed[..., 16:] > 0).any())


def test_a_run_with_it_from_training_to_scores(tmp_path, capsys):
    assert main(train_words(tmp_path / "run", "model.tokenizer.reflectance=true")) == 0
    run, samples = str(tmp_path / "run"), str(tmp_path / "samples")
    assert main(["sample", run, samples, "-n", "2"]) == 0
    words = [samples, "simulated:2:val", "--metrics", "reflectance_histogram"]
    assert main(["evaluate", *words]) == 0
    assert "reflectance_histogram" in capsys.readouterr().out
    assert main(["export", samples, str(tmp_path / "points"), "--format", "kitti_bin"]) == 0
    scan = KittiBin.read(next((tmp_path / "points").rglob("*.bin")))
    assert scan.reflectance is not None
    assert bool(scan.reflectance.any())
    capsys.readouterr()
    assert main(["train", "lidargrit_demo", str(tmp_path / "no"), "--set", "model.tokenizer.reflectance=perhaps"]) == 2
    the_one_line(capsys.readouterr().err, "train")
