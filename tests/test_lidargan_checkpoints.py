"""Weights of LidarGAN and its VAE in the layout of the authors' files: read as tensors only, or refused."""

import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import CheckpointError
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.lidargan.system import LidarGan
from lidargrit.systems.lidarvae.system import LidarVae


def checkpoint(cls):
    """Return what the program saves; programs of its time kept no counters of batches."""
    rng = torch.Generator().manual_seed(5)
    generator = cls(cls.Config(latent_dim=5, channels=2), load_sensor("hdl64e_kitti_odometry"))
    part = (
        generator.decoder
        if cls is LidarGan
        else torch.nn.ModuleDict({"encode": generator.encode, "decode": generator.decode})
    )
    return {
        name: torch.rand(of.shape, generator=rng) for name, of in part.state_dict().items() if of.dtype == torch.float32
    }


@pytest.mark.parametrize(
    ("cls", "preset"), [(LidarGan, "lidargan_kitti_odometry"), (LidarVae, "lidarvae_kitti_odometry")]
)
def test_a_checkpoint_of_the_program_becomes_a_run(cls, preset, tmp_path):
    saved = checkpoint(cls)
    torch.save(saved, tmp_path / "gen_999.pth", _use_new_zipfile_serialization=False)
    assert main(["import-weights", preset, str(tmp_path / "run"), str(tmp_path / "gen_999.pth")]) == 0
    generator = lidargrit.load(tmp_path / "run")
    assert (generator.config.latent_dim, generator.config.channels) == (5, 2)
    assert generator.sensor.width == 256
    weights = (generator.decoder if cls is LidarGan else generator).state_dict()
    assert all(torch.equal(weights[name], of) for name, of in saved.items())
    assert float(generator.image.scale_m) == pytest.approx(41.1245)
    assert bool(generator.sample([0]).return_mask[0, 17:57].all())


@pytest.mark.parametrize(
    ("cls", "change", "message"),
    [
        (LidarGan, lambda c: c.pop("main.12.weight"), "holds no generator of LidarGAN"),
        (LidarGan, lambda c: c.update({"main.12.weight": torch.ones(2, 3, 4, 4)}), "whose images have 3 coordinates"),
        (
            LidarGan,
            lambda c: c.update({"main.0.weight": torch.ones(5, 16, 2, 32)}),
            r"'main\.0\.weight' 5x16x2x32 in place of 5x16x2x16",
        ),
        (LidarGan, lambda c: c.pop("main.1.bias"), r"lacks 'main\.1\.bias'"),
        (LidarVae, lambda c: c.pop("encode.main.0.weight"), "holds no autoencoder"),
        (
            LidarVae,
            lambda c: c.update({"encode.main.0.weight": torch.ones(2, 3, 4, 4)}),
            "whose images have 3 coordinates",
        ),
        (LidarVae, lambda c: c.update({"more": torch.ones(1)}), "has besides 'more'"),
        (LidarVae, lambda c: c.update({"encode.out.weight": torch.ones(1).half()}), "is no float32 tensor"),
    ],
)
def test_checkpoints_of_another_form_are_refused(cls, change, message, tmp_path):
    saved, path = checkpoint(cls), tmp_path / "gen_999.pth"
    change(saved)
    torch.save(saved, path)
    with pytest.raises(CheckpointError, match=message):
        cls.from_published([path], cls.Config(), load_sensor("hdl64e_kitti_odometry"))
