"""LidarGAN and its VAE: networks, losses and images against the program's numbers, completion."""

import json
import math
from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.generation.presets import load_preset
from lidargrit.nn.flops import flops_of
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.systems.lidargan.filled_rows import FilledRows, distance_and_height, fill_holes, in_box
from lidargrit.systems.lidargan.networks import Decoder, Encoder, kl_nats, relativistic_loss, vae_loss
from lidargrit.systems.lidargan.system import LidarGan, LidarGanConfig
from lidargrit.systems.lidarvae.system import LidarVae, LidarVaeConfig, VaeSampling
from lidargrit.training import compute
from reference_weights import seeded_weights
from tiny_runs import learn

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
SMALLEST = {"latent_dim": 4, "channels": 2, "rows": 24, "first_row": 40, "initial_std": 0.2}


def walls(count=4):
    rng = torch.Generator().manual_seed(0)
    mask = torch.rand(count, 64, 32, generator=rng) < 0.8
    range_m = (4 + 20 * torch.rand(count, 1, 32, generator=rng)).expand(-1, 64, -1)
    return RangeImage.masked(range_m, mask, SENSOR)


def made(cls):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return cls(cls.Config(**SMALLEST), SENSOR).eval()


@pytest.fixture(scope="module")
def numbers(golden):
    return golden("rivals/lidargan")


def seeded(numbers, part, module):
    """Return a network with the weights of a part, by the rule that the reference numbers were made with."""
    weights = seeded_weights({"layout": numbers[f"{part}_layout"], "weight_seed": numbers[f"{part}_weight_seed"]})
    counters = {name for name in json.loads(str(numbers[f"{part}_layout"])) if name.endswith("num_batches_tracked")}
    assert module.state_dict().keys() == weights.keys() | counters
    module.load_state_dict(weights, strict=False)
    return module.eval().requires_grad_(False)


def agree(ours, theirs, tolerance=1e-4):
    theirs = torch.as_tensor(theirs)
    assert ours.shape == theirs.shape
    assert float((ours - theirs).abs().max()) <= tolerance * float(theirs.abs().max())


def count(module):
    return sum(weight.numel() for weight in module.parameters())


@pytest.mark.parametrize(
    ("preset", "generator", "discriminator"),
    [
        ("lidargan_kitti_odometry", 3_870_592, 2_248_448),
        ("lidargan_small", 1_378_240, 567_168),
        ("lidarvae_kitti_odometry", 10_755_712, 0),
        ("lidarvae_small", 2_690_880, 0),
    ],
)
def test_presets_have_as_many_parameters_as_the_program(preset, generator, discriminator):
    preset = load_preset(preset)
    with torch.device("meta"):
        built = preset.build_generator()
        (stage,) = built.stages
        trained = built.objective(stage)
    assert count(built) == generator
    assert count(trained) == generator + discriminator
    assert built.full_rows == range(17, 57)


@pytest.mark.parametrize(("latent_dim", "parameters"), [(256, 17_047_168), (512, 29_630_080)])
def test_the_other_published_autoencoders_have_as_many_parameters_as_the_programs(latent_dim, parameters):
    with torch.device("meta"):
        built = LidarVae(LidarVaeConfig(latent_dim), load_sensor("hdl64e_kitti_odometry"))
    assert count(built) == parameters


@pytest.mark.shared
def test_the_networks_are_the_programs(numbers):
    decoder = seeded(numbers, "tiny_G", Decoder(16, 8, (40, 256)))
    latents = torch.from_numpy(numbers["tiny_z"])
    agree(decoder(latents), numbers["tiny_G_eval"])
    agree(decoder.train()(latents), numbers["tiny_G_train"])
    agree(decoder.main[1].running_mean, numbers["tiny_G_running_mean_after"])
    encoder = seeded(numbers, "tiny_D", Encoder(1, 8, (40, 256)))
    images = torch.from_numpy(numbers["tiny_D_x"]).float()
    agree(encoder(images)[:, 0], numbers["tiny_D_eval"])
    agree(encoder.main(images).mean(dim=(2, 3)), numbers["tiny_D_hidden_mean"])
    assert (count(decoder), count(encoder)) == (numbers["tiny_G_parameters"], numbers["tiny_D_parameters"])


@pytest.mark.shared
def test_the_networks_of_published_size_are_the_programs(numbers):
    decoder = seeded(numbers, "full_G", Decoder(100, 64, (40, 256)))
    images = decoder(torch.from_numpy(numbers["full_z"]))
    agree(images, numbers["full_G_eval"])
    encoder = seeded(numbers, "full_D", Encoder(1, 64, (40, 256)))
    seen = torch.from_numpy(numbers["full_G_eval"])
    agree(encoder(seen)[:, 0], numbers["full_D_eval"])
    agree(encoder.main(seen).mean(dim=(2, 3)), numbers["full_D_hidden_mean"])


@pytest.mark.shared
def test_the_autoencoder_and_its_objective_are_the_programs(numbers):
    generator = LidarVae(LidarVaeConfig(latent_dim=12), load_sensor("hdl64e_kitti_odometry"))
    wrapped = torch.nn.ModuleDict({"encode": generator.encode, "decode": generator.decode})
    seeded(numbers, "vae", wrapped)
    assert count(wrapped) == numbers["vae_parameters"]
    images = torch.from_numpy(numbers["vae_x"]).float()
    encoded = generator.encode(images)
    agree(encoded, numbers["vae_mu_logvar"])
    mean, log_variance = encoded.chunk(2, dim=1)
    reconstructed = generator.decode(mean)
    agree(reconstructed, numbers["vae_eval"])
    kl = kl_nats(mean, log_variance)
    agree(kl, numbers["vae_kl"])
    agree((reconstructed - images).abs().sum(dim=(1, 2, 3)), numbers["vae_l1_sum"])
    terms = vae_loss(images, reconstructed, kl, 10 / 100, 5.0)
    assert float(terms["loss"]) == pytest.approx(float(numbers["vae_objective_epoch_9_of_100"]), rel=1e-6)


@pytest.mark.shared
def test_both_losses_are_the_programs(numbers):
    of_real, of_generated = (torch.from_numpy(numbers[f"loss_{name}"]) for name in ("real", "fake"))
    losses = relativistic_loss(of_real, of_generated), relativistic_loss(of_generated, of_real)
    assert [float(loss) for loss in losses] == pytest.approx([float(numbers[f"loss0_{player}"]) for player in "DG"])


@pytest.mark.shared
def test_scans_are_boxed_scaled_and_filled_as_by_the_program(numbers):
    """The program loses the scan before one that it cannot fill; here the others stay as they are."""
    points = torch.from_numpy(numbers["preprocess_in"]).double()[:, 5:45]
    points = torch.where(in_box(points)[..., None], points, 0)
    filled = fill_holes(distance_and_height(points) / points.abs().max())[..., ::2]
    assert bool((filled[3] == 0).all())
    agree(filled[[0, 1, 4]], numbers["preprocess_out"], 1e-6)
    agree(filled[[0, 1, 2, 4]], numbers["preprocess_out_without_3"], 1e-6)
    assert bool((filled[[0, 1, 2, 4], 0] > 0).all())


@pytest.mark.shared
def test_rows_and_columns_are_in_the_programs_order(numbers):
    """The program averages the points of a slot, which we do not: no other order agrees as well."""
    points = torch.from_numpy(numbers["unravel_in"])
    sensor = replace(SENSOR, range_min_m=0.1)
    image = RangeImage.stack([project(Scan(points[:, :3].clone()), sensor)])
    theirs = torch.from_numpy(numbers["unravel_out"])[5:45, :, :3]
    known = in_box(theirs)
    distance = theirs[..., :2].norm(dim=-1)
    errors = {}
    for first_row in (15, 16, 17, 18, 19):
        rows = FilledRows(sensor, first_row, 40)
        ours = rows.encode(image)[0, 0] * rows.scale_m
        for axes in ((), (0,), (1,), (0, 1)):
            for turn in (0, 1, 2, 8, 16, 24, 30, 31):
                error = (ours.flip(axes).roll(turn, dims=1) - distance).abs() / distance
                errors[first_row, axes, turn] = float(error[known].mean())
    assert min(errors, key=errors.__getitem__) == (17, (), 0)
    assert sorted(errors.values())[1] > 1.3 * errors[17, (), 0]


def test_what_is_in_the_box_comes_back_and_other_rows_stay_empty():
    image = FilledRows(SENSOR, 17, 40)
    range_m = (4 + torch.rand(2, 64, 32, generator=torch.Generator().manual_seed(0))).clone()
    images = RangeImage(range_m, range_m > 0, SENSOR)
    back = image.decode(image.encode(images))
    rows = torch.zeros(64, dtype=torch.bool)
    rows[17:57] = True
    assert torch.equal(back.return_mask, rows[:, None].expand(2, 64, 32))
    assert torch.allclose(back.range_m[:, 17:57], range_m[:, 17:57], rtol=1e-5)
    far = image.decode(torch.full((1, 2, 40, 32), 1.0)).range_m[0, 17:57]
    assert torch.allclose(far, torch.tensor(41.1245 * math.sqrt(2)))
    near_m = image.decode(torch.zeros(1, 2, 40, 32)).range_m[0, 17:57]
    assert float(near_m.min()) >= SENSOR.range_min_m
    assert float(near_m.max()) == pytest.approx(SENSOR.range_min_m, rel=1e-5)


def test_holes_get_the_farthest_and_lowest_of_their_neighbours():
    image = torch.zeros(2, 2, 24, 16)
    image[0, :, 0, 0] = torch.tensor([0.5, -0.1])
    filled = fill_holes(image)
    assert bool((filled[0, 0] == 0.5).all())
    assert bool((filled[0, 1] == -0.1).all())
    assert bool((filled[1] == 0).all())


def images_of(batch):
    class Store:
        provenance = Provenance(tuple(f"scan {index}" for index in range(len(batch))))

        def __len__(self):
            return len(batch)

        def read(self, index):
            return Pixels(batch.range_m[index].numpy())

    return RangeImages(batch.sensor, [Store()])


def test_the_scale_is_the_largest_coordinate_of_the_training_scans_in_the_box():
    image, batch = FilledRows(SENSOR, 17, 40), walls()
    image.fit(images_of(batch))
    points = (batch.range_m[..., None] * SENSOR.ray_directions())[:, 17:57]
    assert float(image.scale_m) == pytest.approx(float(points[in_box(points)].abs().max()))
    assert float(image.scale_m) < 24
    empty = RangeImage.masked(
        torch.where(torch.arange(4)[:, None, None] == 2, 90.0, batch.range_m), batch.return_mask, SENSOR
    )
    with pytest.raises(
        DataError, match=r"no return near the car in scan 2; wanted one at least between rows 17 and 56"
    ):
        image.fit(images_of(empty))


@pytest.mark.parametrize("settings", [{"rows": 32}, {"rows": 8}, {"first_row": 25}, {"first_row": -1}])
def test_rows_that_cannot_be_are_refused(settings):
    with pytest.raises(ConfigError, match=r"got rows=.* of images of 64x32; wanted 24, 40, 56"):
        LidarGan(LidarGanConfig(**settings), SENSOR)


@pytest.mark.parametrize(
    ("cls", "settings"),
    [
        (LidarGanConfig, {"channels": 0}),
        (LidarGanConfig, {"initial_std": 0.0}),
        (LidarVaeConfig, {"latent_dim": 0}),
        (LidarVaeConfig, {"free_nats": math.nan}),
        (VaeSampling, {"spread": -1.0}),
    ],
)
def test_settings_that_cannot_be_are_refused(cls, settings):
    with pytest.raises(ConfigError, match=f"{next(iter(settings))}="):
        cls(**settings)


def test_each_player_moves_its_own_weights():
    generator, batch = made(LidarGan), walls()
    objective = generator.objective("adversarial").train()
    parts = {"discriminator": objective.discriminator, "generator": objective.decoder}
    for player, own in parts.items():
        objective.zero_grad()
        terms = objective(Example(batch), torch.Generator().manual_seed(0), player)
        terms["loss"].backward()
        for part in parts.values():
            assert all((weight.grad is not None) == (part is own) for weight in part.parameters())


def test_a_scan_is_learned_by_heart_and_given_back():
    generator, batch = made(LidarVae), walls(1)
    generator.fit_statistics(images_of(batch))
    images = RangeImage.cat([batch] * 4)
    objective = generator.objective("autoencoder").train()
    losses = [terms["absolute_error"] for terms in learn(objective, images, range(60), 1e-2)]
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])
    generator.eval()
    known = in_box(batch.range_m[..., None] * SENSOR.ray_directions())
    known[:, :40] = False
    spread_m = (batch.range_m - batch.range_m[known].mean()).abs()[known].mean()
    found = generator.reconstruct(batch)
    assert float((found.range_m - batch.range_m).abs()[known].mean()) < 0.6 * float(spread_m)


def test_the_weight_of_the_divergence_rises_over_the_first_scans():
    generator = LidarVae(LidarVaeConfig(**SMALLEST, warmup_scans=16, free_nats=50.0), SENSOR)
    objective, batch, found = generator.objective("autoencoder").train(), walls(), []
    for step in range(6):
        terms = objective(Example(batch), torch.Generator().manual_seed(step))
        found.append(float(terms["loss"].detach() - terms["absolute_error"]) / 50)
    assert found == pytest.approx([0.25, 0.5, 0.75, 1, 1, 1], rel=1e-3)
    assert float(terms["kl_nats"]) < 50  # so all of it is free


def test_a_scan_is_completed_from_its_observed_pixels_alone():
    generator, images = made(LidarVae), walls(2)
    generator.fit_statistics(images_of(images))
    observed = torch.zeros(2, 64, 32, dtype=torch.bool)
    observed[:, ::4] = True
    done = generator.complete(Observed.of_pixels(images, observed), [0, 1])
    assert torch.equal(done.range_m[observed], images.range_m[observed])
    hidden = RangeImage.masked(
        torch.where(observed, images.range_m, 9.0), images.return_mask | ~observed, SENSOR, images.planes
    )
    assert torch.equal(generator.complete(Observed.of_pixels(hidden, observed), [0, 1]).range_m, done.range_m)
    assert not torch.equal(generator.complete(Observed.of_pixels(images, observed), [2, 3]).range_m, done.range_m)
    mean = VaeSampling(spread=0.0)
    assert torch.equal(
        generator.complete(Observed.of_pixels(images, observed), [0, 1], mean).range_m,
        generator.complete(Observed.of_pixels(images, observed), [2, 3], mean).range_m,
    )
    nothing = generator.complete(Observed.nothing(SENSOR, 2), [0, 1])
    assert bool(nothing.return_mask[:, 40:].all())


def test_operations_of_training_are_those_of_its_passes():
    flops = compute.training_flops(load_preset("lidargan_small"))["adversarial"]
    assert flops / 60_000 / 1e9 == pytest.approx(1.0, abs=0.5)


def test_a_pass_of_the_small_networks_costs_what_the_programs_do():
    preset = load_preset("lidargan_small")
    generator = preset.build_generator()
    encoder = generator.objective("adversarial").discriminator
    assert generator.cost().network_evaluations == 1
    both = generator.cost().flops + flops_of(encoder, (1, 2, 40, 256))
    assert both / 1e9 == pytest.approx(0.23, abs=0.005)
