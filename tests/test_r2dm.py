"""R2DM: its network against a slow one, its published layout, raydrop, completion, learning."""

import copy
import math

import pytest
import torch

from lidargrit.core import discovery
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.data.sources.samples import read_samples
from lidargrit.generation.range_values import encode
from lidargrit.inference.samples import write_samples
from lidargrit.nn.flops import flops_of
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.r2dm.system import DiffusionSampling, R2dm, R2dmConfig
from lidargrit.systems.r2dm.unet import EfficientUnet, UnetConfig
from reference_unet import SlowUnet
from tiny_runs import learn

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
TINY = UnetConfig(8, (1, 2), (1, 1), norm_groups=2, attention_heads=2)
FIRST = {  # ``cfg`` as the program of 1c5963d writes it, small sizes but for the image's
    "dataset": "kitti_360",
    "image_format": "log_depth",
    "lidar_projection": "spherical-1024",
    "train_depth": True,
    "train_reflectance": True,
    "resolution": (64, 1024),
    "num_steps": 300_000,
    "criterion": "l2",
    "ema_decay": 0.995,
    "mixed_precision": "fp16",
    "model_name": "efficient_unet",
    "model_base_channels": 4,
    "model_temb_channels": None,
    "model_channel_multiplier": (1, 2, 1, 2),
    "model_num_residual_blocks": 1,
    "model_gn_num_groups": 2,
    "model_gn_eps": 1e-6,
    "model_attn_num_heads": 2,
    "model_coords_embedding": "fourier_features",
    "model_dropout": 0.0,
    "diffusion_num_training_steps": 1024,
    "diffusion_objective": "eps",
    "diffusion_beta_schedule": "cosine",
    "diffusion_timesteps_type": "continuous",
}
SECOND = {  # the same as the program of 6ce7cc2 writes it
    "data": {
        "dataset": "kitti_360",
        "depth_format": "log_depth",
        "projection": "spherical-1024",
        "train_depth": True,
        "train_reflectance": True,
        "resolution": (64, 1024),
    },
    "model": {
        "architecture": "efficient_unet",
        "base_channels": 4,
        "temb_channels": None,
        "channel_multiplier": (1, 2, 1, 2),
        "num_residual_blocks": (1, 1, 1, 1),
        "gn_num_groups": 2,
        "gn_eps": 1e-6,
        "attn_num_heads": 2,
        "coords_encoding": "fourier_features",
        "dropout": 0.0,
    },
    "diffusion": {
        "num_training_steps": None,
        "num_sampling_steps": 1024,
        "prediction_type": "eps",
        "loss_type": "l2",
        "noise_schedule": "cosine",
        "timestep_type": "continuous",
    },
    "training": {
        "batch_size_train": 8,
        "num_steps": 300_000,
        "mixed_precision": "fp16",
        "output_dir": "logs/diffusion",
    },
}


def walls(count=2, reflectance=True):
    rng = torch.Generator().manual_seed(0)
    mask = torch.rand(count, 64, 32, generator=rng) < 0.8
    range_m = torch.where(mask, (2 + 90 * torch.rand(count, 1, 32, generator=rng)).expand(-1, 64, -1), 0)
    planes = {"reflectance": torch.rand(count, 64, 32, generator=rng) * mask} if reflectance else {}
    return RangeImage(range_m, mask, SENSOR, planes)


def made(sensor=SENSOR, **settings):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return R2dm(R2dmConfig(TINY, **settings), sensor).eval()


def seeded_checkpoint(layout_of_2024=False):
    """Sample the weights of a small whole network, and return them as the program saves them, in either layout."""
    prefix, angles_of, cfg = "denoiser", "coords_embedding", FIRST
    if layout_of_2024:
        prefix, angles_of, cfg = "model", "coords_encoding", SECOND
    with torch.device("meta"):
        angles = torch.zeros(64, 1024)
        layout = EfficientUnet(UnetConfig(4, (1, 2, 1, 2), (1,) * 4, 2, 2), 2, angles, angles).state_dict()
    rng = torch.Generator().manual_seed(5)
    weights = {
        f"{prefix}.{name}": torch.randn(of.shape, generator=rng) * (0.3 if of.ndim > 1 else 1.0)
        for name, of in layout.items()
    }
    weights |= {
        f"{prefix}.{angles_of}.freqs": torch.ones(16, 2, 1, 1),
        f"{prefix}.{angles_of}.phase": torch.zeros(16),
        f"{prefix}.d_block1.residual_blocks.0.scale": torch.tensor(math.sqrt(0.5)),
        f"{prefix}.d_block2.downsample.1.kernel": torch.tensor([1, 3, 3, 1]) / 8,
        "_dummy": torch.tensor([]),
    }
    state = {
        "state": {0: {"step": torch.tensor(5.0), "exp_avg": torch.ones(2)}},
        "param_groups": [{"betas": (0.9, 0.99)}],
    }
    others = {"optimizer": state, "lr_scheduler": {"last_epoch": 3, "lr_lambdas": [None]}, "global_step": 300_000}
    return {"cfg": copy.deepcopy(cfg), "weights": dict(weights), "ema_weights": weights, **others}


def test_the_published_size_has_the_published_parameters_and_operations():
    with torch.device("meta"):
        angles = torch.zeros(64, 1024)
        network = EfficientUnet(UnetConfig(), 2, angles, angles)
    assert sum(weight.numel() for weight in network.parameters()) == 31_099_650
    # Measured in the reference: 229 GFLOP, by a counter that does not see into torch's own attention.
    products = sum(2 * 1024 * (4 * width**2 + 2 * 1024 * width) for width in (512, 256))
    assert (flops_of(network, (1, 2, 64, 1024), (1,)) - products) / 1e9 == pytest.approx(229, abs=0.5)


def test_published_weights_give_what_a_slow_network_gives(tmp_path):
    checkpoint = seeded_checkpoint()
    torch.save(checkpoint, tmp_path / "weights.pth")
    generator = R2dm.from_published([tmp_path / "weights.pth"], R2dmConfig(), load_sensor("hdl64e_kitti_360"))
    rng = torch.Generator().manual_seed(1)
    noisy = torch.randn(2, 2, 64, 1024, generator=rng)
    log_snr = torch.tensor([-7.5, 2.25])
    with torch.no_grad():
        ours = generator.network(noisy, log_snr)
    slow = SlowUnet(checkpoint["ema_weights"], blocks=1, groups=2, heads=2)
    theirs = torch.from_numpy(slow(noisy[1].double().numpy(), 2.25)).float()
    assert float(theirs.std()) > 0.1
    assert torch.allclose(ours[1], theirs, atol=2e-3 * float(theirs.abs().max()))
    assert not torch.allclose(ours[0], theirs, atol=0.1)
    assert generator.config.reflectance
    assert torch.equal(generator.network.coords, checkpoint["ema_weights"]["denoiser.coords"])


def test_a_turned_image_gives_a_turned_answer_but_for_the_rays():
    generator = made()
    with torch.no_grad(), torch.random.fork_rng():
        torch.manual_seed(3)
        for weight in generator.parameters():
            weight.copy_(0.2 * torch.randn(weight.shape))
        generator.network.coords.zero_()
        noisy = torch.randn(1, 2, 64, 32)
        straight = generator.network(noisy, torch.tensor([0.0]))
        turned = generator.network(noisy.roll(6, 3), torch.tensor([0.0]))
    assert torch.allclose(turned, straight.roll(6, 3), atol=1e-4)


def test_both_layouts_that_the_program_has_written_are_read(tmp_path):
    generators = []
    for layout_of_2024 in (False, True):
        torch.save(seeded_checkpoint(layout_of_2024), tmp_path / "weights.pth")
        generators.append(
            R2dm.from_published([tmp_path / "weights.pth"], R2dmConfig(), load_sensor("hdl64e_kitti_360"))
        )
    first, second = (generator.state_dict() for generator in generators)
    assert generators[0].config == generators[1].config
    assert all(torch.equal(first[name], second[name]) for name in first if name.startswith("network."))


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("data", "depth_format", "inverse_depth"),
        ("data", "train_depth", False),
        ("model", "architecture", "refinenet"),
        ("model", "coords_encoding", "spherical_harmonics"),
        ("model", "gn_eps", 1e-5),
        ("model", "temb_channels", 32),
        ("diffusion", "prediction_type", "v"),
        ("diffusion", "noise_schedule", "linear"),
        ("diffusion", "timestep_type", "discrete"),
    ],
)
def test_settings_of_the_later_layout_are_checked_under_their_names(tmp_path, part, name, value):
    checkpoint = seeded_checkpoint(layout_of_2024=True)
    checkpoint["cfg"][part][name] = value
    torch.save(checkpoint, tmp_path / "weights.pth")
    with pytest.raises(CheckpointError, match=rf"with {part}\.{name}={value!r}; wanted {part}\.{name}="):
        R2dm.from_published([tmp_path / "weights.pth"], R2dmConfig(), load_sensor("hdl64e_kitti_360"))


def test_sizes_that_the_weights_do_not_have_are_refused_before_a_network_is_built(tmp_path):
    for name, value in (("base_channels", 1 << 30), ("num_residual_blocks", 10**9), ("channel_multiplier", 10**6)):
        checkpoint = seeded_checkpoint(layout_of_2024=True)
        checkpoint["cfg"]["model"][name] = value
        torch.save(checkpoint, tmp_path / "weights.pth")
        with pytest.raises(CheckpointError, match=r"whose level 1 is not of |wanted 1000 at most"):
            R2dm.from_published([tmp_path / "weights.pth"], R2dmConfig(), load_sensor("hdl64e_kitti_360"))


@pytest.mark.parametrize("name", discovery.names("sensors"))
def test_a_value_beyond_the_far_limit_is_cut_to_it_and_keeps_its_return(name):
    """The program cuts values to [-1, 1]; in 32 bits the limit of 80 m decodes to just below 80 m, so it is kept."""
    sensor = load_sensor(name).with_columns(32)
    generator = R2dm(R2dmConfig(TINY, reflectance=False), sensor)
    values = torch.full((1, 1, sensor.height, 32), 1.0)
    values[0, 0, 0], values[0, 0, 1] = 1.01, -1.01
    images = generator._decoded(values, DiffusionSampling())
    assert bool(images.return_mask[0, 0].all())
    assert bool(images.return_mask[0, 2:].all())
    assert not bool(images.return_mask[0, 1].any())
    assert float(images.range_m[0, 0].min()) == pytest.approx(sensor.range_max_m, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            lambda c: c["cfg"].update(diffusion_objective="v"),
            "diffusion_objective='v'; wanted diffusion_objective='eps'",
        ),
        (lambda c: c["cfg"].update(model_coords_embedding=None), "model_coords_embedding=None"),
        (lambda c: c["cfg"].update(model_channel_multiplier=(1, 2)), "channel_multipliers"),
        (lambda c: c["cfg"].update(model_gn_eps=1e-5), "model_gn_eps=1e-05; wanted model_gn_eps=1e-06"),
        (lambda c: c["ema_weights"].pop("denoiser.in_conv.bias"), "lacks 'in_conv.bias'"),
        (lambda c: c["ema_weights"].update({"denoiser.new": torch.ones(1)}), "has besides 'new'"),
        (lambda c: c.pop("ema_weights"), r"cannot be read \(KeyError: 'ema_weights'\)"),
        (lambda c: c["cfg"].update(model_base_channels=torch.inf), r"cannot be read \(OverflowError: "),
        (lambda c: c["cfg"].update(train_reflectance=torch.ones(2)), r"cannot be read \(RuntimeError: "),
    ],
)
def test_weights_of_another_form_are_refused(tmp_path, change, text):
    checkpoint = seeded_checkpoint()
    change(checkpoint)
    torch.save(checkpoint, tmp_path / "weights.pth")
    with pytest.raises((CheckpointError, ConfigError), match=text):
        R2dm.from_published([tmp_path / "weights.pth"], R2dmConfig(), load_sensor("hdl64e_kitti_360"))


@pytest.mark.parametrize(
    "content", [b"", b"PK\x03\x04 cut", b"\x80\x04cos\nsystem\n.", b"\x80\x02cposix\nsystem\n.", b"words"]
)
def test_a_file_that_is_no_checkpoint_is_refused_and_never_run(tmp_path, content):
    (tmp_path / "weights.pth").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"weights\.pth, which (is no|does not hold)"):
        R2dm.from_published([tmp_path / "weights.pth"], R2dmConfig(), load_sensor("hdl64e_kitti_360"))


def test_ranges_are_encoded_as_published_and_come_back():
    sensor, images = load_sensor("hdl64e_kitti_360").with_columns(32), walls()
    images = RangeImage(images.range_m.clamp(max=79.9), images.return_mask, sensor, images.planes)
    encoded = encode(images, with_reflectance=True)
    assert bool((encoded[:, 0][~images.return_mask] == -1).all())
    near = RangeImage(torch.full((1, 64, 32), 1.45), torch.ones(1, 64, 32, dtype=torch.bool), sensor)
    assert float(encode(near, with_reflectance=False)[0, 0, 0, 0]) == pytest.approx(-0.592, abs=1e-3)
    back = R2dm(R2dmConfig(TINY), sensor)._decoded(encoded, DiffusionSampling())
    assert torch.equal(back.return_mask, images.return_mask)
    assert torch.allclose(back.range_m, images.range_m, rtol=1e-4)
    assert torch.allclose(back.reflectance, images.reflectance, atol=1e-6)


def test_calibrated_raydrop_returns_as_many_rays_as_the_training_scans():
    generator = made(reflectance=False, calibration_scans=4)
    with pytest.raises(ConfigError, match=r"raydrop=calibrated.*never fitted"):
        generator.sample([0], sampling=DiffusionSampling(steps=2, raydrop="calibrated"))
    generator.return_share.fill_(0.7)
    generator.after_training()
    sampling = DiffusionSampling(steps=32, raydrop="calibrated")
    share = generator.sample(range(4), sampling=sampling).return_mask.float().mean()
    assert float(share) == pytest.approx(0.7, abs=0.03)


def test_scans_without_reflectance_train_the_range_only():
    images = walls(reflectance=False)
    with pytest.raises(ConfigError, match=r"without reflectance.*model\.reflectance=false"):
        made().objective("diffusion")(Example(images), torch.Generator().manual_seed(0))
    generator = made(reflectance=False)
    assert bool(generator.objective("diffusion")(Example(images), torch.Generator().manual_seed(0))["loss"].isfinite())
    assert generator.sample([0], sampling=DiffusionSampling(steps=2)).reflectance is None


def test_a_completed_scan_keeps_what_was_observed():
    generator, images = made(), walls()
    observed = torch.zeros(2, 64, 32, dtype=torch.bool)
    observed[:, ::4] = True
    done = generator.complete(Observed.of_pixels(images, observed), [0, 1], DiffusionSampling(steps=3, resamples=2))
    for name in ("range_m", "return_mask", "reflectance"):
        assert torch.equal(getattr(done, name)[observed], getattr(images, name)[observed])
    assert not torch.equal(done.range_m[~observed], images.range_m[~observed])
    other = RangeImage.masked(torch.full((2, 64, 32), 9.0), observed, SENSOR)  # nothing is known where not observed
    hidden = RangeImage(
        torch.where(observed, images.range_m, other.range_m),
        torch.where(observed, images.return_mask, other.return_mask),
        SENSOR,
        {"reflectance": torch.where(observed, images.reflectance, 0)},
    )
    again = generator.complete(Observed.of_pixels(hidden, observed), [0, 1], DiffusionSampling(steps=3, resamples=2))
    assert torch.equal(again.range_m, done.range_m)
    with pytest.raises(ConfigError, match="1 seeds for 2 images"):
        generator.complete(Observed.of_pixels(images, observed), [0])
    with pytest.raises(ConfigError, match="1 seeds for 2 images"):
        list(generator.stream([0], condition=Observed.of_pixels(images, observed)))
    with pytest.raises(ConfigError, match="sampler=ddim for completion"):
        generator.complete(Observed.of_pixels(images, observed), [0, 1], DiffusionSampling(sampler="ddim"))
    with pytest.raises(ConfigError, match="observed pixels of shape"):
        generator.complete(Observed.of_pixels(images, observed[:1]), [0, 1])


def test_reflectance_is_saved_with_samples_and_read_back(tmp_path):
    generator = made()
    generator.save(tmp_path / "run")
    write_samples(generator, tmp_path / "run", tmp_path / "out", [0, 1], DiffusionSampling(steps=2))
    drawn, read = (
        generator.sample([0, 1], sampling=DiffusionSampling(steps=2)),
        read_samples(tmp_path / "out").batch([0, 1]),
    )
    assert torch.allclose(read.range_m, drawn.range_m)
    assert torch.allclose(read.reflectance, drawn.reflectance)


def test_settings_that_a_model_cannot_take_leave_the_folder_to_corrected_ones(tmp_path):
    generator, run, ours = made(), tmp_path / "run", tmp_path / "ours"
    generator.save(run)
    (run / "trained_on.json").write_text("{}")
    ours.mkdir()
    for out in (tmp_path / "new", ours):
        calibrated = DiffusionSampling(steps=2, raydrop="calibrated")
        with pytest.raises(ConfigError, match="threshold was never fitted"):
            write_samples(generator, run, out, [0], calibrated)
        write_samples(generator, run, out, [], calibrated)  # as a process of many does that gets no seed
        assert out.exists() == (out == ours)
        write_samples(generator, run, out, [0], DiffusionSampling(steps=2))
        assert {path.name for path in out.iterdir()} == {"00000000.npz", "samples.json", "trained_on.json"}


def test_an_image_is_learned_by_heart():
    sensor, high = load_sensor("vlp16").with_columns(32), walls(1, reflectance=False)
    images = RangeImage(high.range_m[:, ::4], high.return_mask[:, ::4], sensor)
    generator = made(sensor, reflectance=False)
    objective = generator.objective("diffusion").train()
    batch = RangeImage.stack([images[0]] * 2)
    losses = [terms["loss"] for terms in learn(objective, batch, range(100), 5e-3)]
    assert sum(losses[-20:]) < 0.7 * sum(losses[:20])
    drawn = generator.sample([0], sampling=DiffusionSampling(steps=12))
    unlearned = made(sensor, reflectance=False).sample([0], sampling=DiffusionSampling(steps=12))
    error, before = (float((each.range_m - images.range_m).abs().mean()) for each in (drawn, unlearned))
    assert error < 0.8 * before
