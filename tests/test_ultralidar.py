"""UltraLiDAR: its sizes, training, sampling, own voxels, and its program's checkpoints."""

from dataclasses import replace

import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.generation.presets import load_preset
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.ultralidar import system
from lidargrit.systems.ultralidar.swin import SwinConfig
from lidargrit.systems.ultralidar.system import CodebookRestart, UltraLidar, UltraLidarConfig, VoxelSampling
from lidargrit.systems.ultralidar.voxel_autoencoder import VoxelAutoencoderConfig
from lidargrit.systems.ultralidar.voxel_prior import FillSampling, forbid, generate_tokens, likeliest_codes
from lidargrit.systems.ultralidar.voxels import VoxelGrid, images_of_voxels, voxels_of_images
from lidargrit.training.compute import training_flops
from tiny_runs import learn

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
TINY = UltraLidar.smallest_config(SENSOR)
QUICK = UltraLidar.quickest_sampling()


def walls(count=2):
    rng = torch.Generator().manual_seed(0)
    range_m = (5 + 30 * torch.rand(count, 1, 32, generator=rng)).expand(-1, 64, -1)
    return RangeImage.masked(range_m, torch.rand(count, 64, 32, generator=rng) < 0.8, SENSOR)


def made(config=TINY):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return UltraLidar(config, SENSOR).eval()


@pytest.mark.parametrize(
    ("preset", "autoencoder", "prior"),
    [("ultralidar_kitti_360", 81_521_536, 76_795_776), ("ultralidar_small", 1_182_752, 707_768)],
)
def test_presets_have_the_published_sizes(preset, autoencoder, prior):
    preset = load_preset(preset)
    sensor = preset.data.load_sensor()
    with torch.device("meta"):
        generator = UltraLidar(preset.model, sensor)
    assert sum(weight.numel() for weight in generator.autoencoder.parameters()) == autoencoder
    assert sum(weight.numel() for weight in generator.prior.parameters()) == prior


def test_passes_are_counted_as_the_program_makes_them():
    generator = made()
    assert generator.cost().network_evaluations == 30 + 8 + 9 + 8
    one, two, three = (generator.cost(VoxelSampling(steps=steps, rounds=0)) for steps in (1, 2, 3))
    assert [of.network_evaluations for of in (one, two, three)] == [2, 3, 4]
    assert three.flops - two.flops == two.flops - one.flops > 0
    assert generator.cost().flops > 38 * (two.flops - one.flops)


def test_the_operations_of_training_are_three_times_those_of_its_passes():
    preset = load_preset("ultralidar_small", ("training.autoencoder.scans=10", "training.prior.scans=20"))
    counted = training_flops(preset)
    assert counted["autoencoder"] / 30e9 == pytest.approx(2.55, rel=0.04)  # as the program's networks were counted
    assert counted["prior"] / 60e9 == pytest.approx(1.57 + 1.24 / 3, rel=0.03)  # the encoder is not trained


def test_both_stages_learn():
    generator, images = made(), walls()
    for stage, name, factor in (("autoencoder", "voxel_loss", 0.5), ("prior", "loss", 0.8)):
        objective = generator.objective(stage).train()
        found = [terms[name] for terms in learn(objective, images, range(40), 0.01)]
        assert sum(found[-5:]) < factor * sum(found[:5]), stage
        generator.load_stage(stage, objective)
    assert objective.warnings() == []


def test_flips_mirror_the_voxels_of_some_scans():
    images = walls(8)
    plain = voxels_of_images(images, TINY.autoencoder.grid)
    seen = []
    generator = made(replace(TINY, flips=True))
    generator.autoencoder.encoder.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    generator.objective("autoencoder")(Example(images), torch.Generator().manual_seed(0))
    ways = [plain, plain.flip(-1), plain.flip(-2), plain.flip(-1, -2)]
    found = [[torch.equal(scan, way[index].float()) for way in ways] for index, scan in enumerate(seen[0])]
    assert all(any(one) for one in found)
    assert sum(one[0] for one in found) < 8
    assert sum(one[1] or one[3] for one in found) > 0
    assert sum(one[2] or one[3] for one in found) > 0


def test_codes_that_lie_idle_are_moved_to_where_latents_are(monkeypatch):
    monkeypatch.setattr(system, "_IDLE_STEPS", 8)
    rng = torch.Generator().manual_seed(0)
    centres = 5 * torch.randn(16, 4, generator=rng)
    codes, care = torch.zeros(16, 4), CodebookRestart(16, 4)
    codes[0] = 1.0

    def step():
        latents = centres[torch.randint(16, (200,), generator=rng)] + 0.01 * torch.randn(200, 4, generator=rng)
        tokens = torch.cdist(latents, codes).argmin(dim=1)
        care.update(codes, latents, tokens, rng)
        return float((latents - codes[tokens]).norm(dim=1).mean()), len(tokens.unique())

    before = [step() for _ in range(8)]
    assert max(used for _, used in before) <= 2
    after = [step() for _ in range(4)]
    assert min(used for _, used in after) >= 8
    assert max(error for error, _ in after) < 0.5 * before[0][0]
    moved = codes.clone()
    care.idle_steps.fill_(1000)
    step()
    assert torch.equal(codes, moved)  # it rests before it moves them again


def test_codes_of_empty_space_are_not_sampled_at_first():
    """Each token is likeliest empty, so that without the rule a scan comes out empty."""
    logits = torch.zeros(1, 64, 10)
    logits[..., 3] = 6.0
    rng = torch.Generator().manual_seed(0)

    def generated(**settings):
        return generate_tokens(
            lambda tokens, hidden: logits,
            torch.zeros(1, 64, dtype=torch.long),
            lambda found: torch.multinomial(found.softmax(-1)[0], 1, generator=rng).T,
            lambda: torch.rand(1, 64, generator=rng),
            FillSampling(steps=8, blank_share=0.1, **settings),
        )

    assert likeliest_codes(logits, 0.1).tolist() == [[3]]
    assert float(forbid(logits, torch.tensor([[3]])).softmax(-1)[..., 3].max()) == 0
    assert float((generated(blank_steps=0) == 3).float().mean()) > 0.9
    some = float((generated(blank_steps=3) == 3).float().mean())
    assert 0.5 < some < 0.95
    assert not bool((generated(blank_steps=8) == 3).any())


def test_a_single_token_is_sampled_too():
    whole = replace(TINY, autoencoder=replace(TINY.autoencoder, patch=32))
    assert UltraLidar(whole, SENSOR).sample([0], sampling=QUICK).range_m.shape == (1, SENSOR.height, SENSOR.width)


def test_its_own_voxels_are_those_of_its_images():
    generator = made()
    voxels = generator.sample_voxels([3, 4], QUICK)
    assert voxels.shape == (2, 6, 32, 32)
    assert voxels.dtype == torch.bool
    grid = TINY.autoencoder.grid
    for points in ("exact", "reference"):
        images = generator.sample([3, 4], sampling=replace(QUICK, points=points))
        assert torch.equal(images.range_m, images_of_voxels(voxels, grid, SENSOR, points).range_m)
    with pytest.raises(ConfigError, match="no seeds"):
        generator.sample_voxels([])


@pytest.mark.parametrize(
    "settings",
    [
        {"steps": 0},
        {"steps": 10**6},
        {"order_temperature": -1.0},
        {"blank_share": 1.0},
        {"blank_steps": -1},
        {"rounds": -1},
    ],
)
def test_sampling_settings_that_cannot_be_are_refused(settings):
    with pytest.raises(ConfigError, match=f"{next(iter(settings))}="):
        VoxelSampling(**settings)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: VoxelAutoencoderConfig(patch=7), "patch=7"),
        (lambda: VoxelAutoencoderConfig(num_codes=1), "num_codes=1"),
        (lambda: SwinConfig(width=30, heads=4), "width=30"),
        (lambda: SwinConfig(blocks=0), "blocks=0"),
        (
            lambda: made(
                UltraLidarConfig(VoxelAutoencoderConfig(VoxelGrid(cells=(648, 648, 40))), SwinConfig(16, 1, 1))
            ),
            "81x81",
        ),
    ],
)
def test_models_that_cannot_be_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


def checkpoint(config):
    """Return what the program saves with mmcv, with seeded weights: networks, their tables, the codebook's care."""
    rng = torch.Generator().manual_seed(5)
    theirs = (
        ("autoencoder.encoder.blocks.", "lidar_encoder.blocks.0.blocks."),
        ("autoencoder.encoder.", "lidar_encoder."),
        ("autoencoder.decoder.blocks.", "lidar_decoder.blocks.blocks."),
        ("autoencoder.decoder.", "lidar_decoder."),
        ("autoencoder.quantiser.", "vector_quantizer."),
        ("autoencoder.pre_quant.", "pre_quant."),
        ("prior.blocks.", "maskgit_transformer.blocks.blocks."),
        ("prior.", "maskgit_transformer."),
    )
    weights = {}
    for name, weight in made(config).named_parameters():
        ours, prefix = next(pair for pair in theirs if name.startswith(pair[0]))
        weights[prefix + name.removeprefix(ours)] = torch.randn(weight.shape, generator=rng)
    tokens = config.autoencoder.tokens[0] * config.autoencoder.tokens[1]
    for network in ("lidar_encoder", "lidar_decoder", "maskgit_transformer"):
        weights[f"{network}.pos_embed"] = torch.zeros(1, tokens, config.prior.width)
    weights["lidar_encoder.blocks.0.blocks.0.attn.relative_position_index"] = torch.zeros(16, 16, dtype=torch.long)
    weights["lidar_decoder.blocks.blocks.1.attn_mask"] = torch.zeros(4, 16, 16)
    codes = {"reservoir": torch.zeros(320, 8), "global_iter": torch.zeros(1), "num_iter": torch.zeros(1)}
    weights |= {f"vector_quantizer.{name}": of for name, of in codes.items()}
    weights |= {"code_age": torch.zeros(32), "code_usage": torch.zeros(32)}
    meta = {"mmcv_version": "1.4.0", "time": "Mon Jan 22 10:00:00 2024", "seed": 0, "epoch": 200, "iter": 100}
    return {"meta": meta, "state_dict": weights, "optimizer": {"state": {}, "param_groups": [{"lr": 8e-4}]}}


PATCHES = "lidar_encoder.patch_embed.proj.weight"
CELLS = ("--set", "model.autoencoder.grid.cells=[32,32,6]", "model.autoencoder.grid.cell_m=[3.125,3.125,1.0]")


def test_a_checkpoint_of_the_program_becomes_a_run(tmp_path):
    saved, path = checkpoint(TINY), tmp_path / "epoch_200.pth"
    torch.save(saved, path)
    assert main(["import-weights", "ultralidar_kitti_360", str(tmp_path / "run"), str(path), *CELLS]) == 0
    generator = lidargrit.load(tmp_path / "run")
    assert generator.config == TINY
    assert generator.sensor.name == "hdl64e_kitti_360"
    found, theirs = dict(generator.named_parameters()), saved["state_dict"]
    for ours, name in (
        ("autoencoder.encoder.blocks.0.attn.qkv.weight", "lidar_encoder.blocks.0.blocks.0.attn.qkv.weight"),
        ("autoencoder.quantiser.embedding.weight", "vector_quantizer.embedding.weight"),
        ("prior.mask_token", "maskgit_transformer.mask_token"),
        ("prior.blocks.0.mlp.fc2.bias", "maskgit_transformer.blocks.blocks.0.mlp.fc2.bias"),
    ):
        assert torch.equal(found[ours], theirs[name])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("state_dict"), "holds no 'state_dict'"),
        (lambda c: c["state_dict"].pop("vector_quantizer.embedding.weight"), r"holds no 'autoencoder\.quantiser"),
        (lambda c: c["state_dict"].pop("lidar_encoder.norm.0.weight"), r"holds no 'autoencoder\.encoder\.norm"),
        (lambda c: c["state_dict"].pop("maskgit_transformer.pred.bias"), r"lacks 'prior\.pred\.bias'"),
        (lambda c: c["state_dict"].update({"more": torch.ones(1)}), "has besides 'more'"),
        (lambda c: c["state_dict"].update({"code_age.x": torch.ones(1).half()}), "'code_age.x' is no float32 tensor"),
        (lambda c: c["state_dict"].pop("lidar_encoder.pos_embed"), "0 tokens of 6 layers"),
        (lambda c: c["state_dict"].update({"lidar_encoder.pos_embed": torch.ones(1, 64, 16)}), "64 tokens of 6 layers"),
        (
            lambda c: c["state_dict"].update({"lidar_encoder.patch_embed.proj.weight": torch.ones(16, 6, 7, 7)}),
            "patch=7",
        ),
    ],
)
def test_checkpoints_of_another_form_are_refused(change, message, tmp_path):
    saved, path = checkpoint(TINY), tmp_path / "epoch_200.pth"
    change(saved)
    torch.save(saved, path)
    with pytest.raises((CheckpointError, ConfigError), match=message):
        UltraLidar.from_published([path], TINY, SENSOR)
