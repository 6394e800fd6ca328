"""LiDARGen: its network, loss and sampler against the program's numbers, its checkpoints, raydrop, completion."""

import json
from dataclasses import replace

import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.generation.presets import load_preset
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.systems.lidargen.ncsn import InstanceNormPlus, Ncsn
from lidargrit.systems.lidargen.score_matching import (
    langevin,
    noise_left,
    pull_towards,
    score_matching_errors,
    sigma_table,
)
from lidargrit.systems.lidargen.system import LangevinSampling, LidarGen, LidarGenConfig, encode
from reference_weights import seeded_weights
from tiny_runs import learn

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
STAGES = ("begin_conv", "res1.1", "res2.0", "res2.1", "res3.1", "res4.1", "refine1", "refine2", "refine3", "refine4")


def walls(count=2, reflectance=True):
    rng = torch.Generator().manual_seed(0)
    mask = torch.rand(count, 64, 32, generator=rng) < 0.8
    range_m = torch.where(mask, (2 + 50 * torch.rand(count, 1, 32, generator=rng)).expand(-1, 64, -1), 0)
    bright = torch.rand(count, 64, 32, generator=rng) * mask
    return RangeImage(range_m, mask, SENSOR, {"reflectance": bright} if reflectance else {})


def made(**settings):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return LidarGen(LidarGenConfig(**({"channels": 4, "levels": 4, "steps_each": 1} | settings)), SENSOR).eval()


@pytest.fixture(scope="module")
def numbers(golden):
    return golden("rivals/lidargen")


def seeded(numbers, part):
    """Return the weights of a part, by the rule that the reference numbers were made with; sigmas are no weights."""
    layout = {name: shape for name, shape in json.loads(str(numbers[f"{part}_layout"])).items() if name != "sigmas"}
    return seeded_weights({"layout": json.dumps(layout), "weight_seed": numbers[f"{part}_weight_seed"]})


def network(numbers, part, channels):
    made = Ncsn(2, channels)
    made.load_state_dict(seeded(numbers, part))
    return made.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def tiny(numbers):
    return network(numbers, "tiny", 8)


def agree(ours, theirs, tolerance=1e-4):
    theirs = torch.as_tensor(theirs)
    assert ours.shape == theirs.shape
    assert float((ours - theirs).abs().max()) <= tolerance * float(theirs.abs().max())


@pytest.mark.parametrize(
    ("channels", "parameters"),
    [(8, 117_322), (16, 466_450), (24, 1_047_386), (32, 1_860_130), (40, 2_904_682), (128, 29_694_082)],
)
def test_networks_have_as_many_parameters_as_the_programs(channels, parameters):
    with torch.device("meta"):
        made = Ncsn(2, channels)
    assert sum(weight.numel() for weight in made.parameters()) == parameters


def test_the_published_preset_has_the_published_size():
    preset = load_preset("lidargen_kitti_360")
    sensor = preset.data.load_sensor()
    with torch.device("meta"):
        generator = LidarGen(preset.model, sensor)
    assert generator.shape == (2, 64, 1024)
    assert sum(weight.numel() for weight in generator.parameters()) == 29_694_082


@pytest.mark.shared
def test_no_preset_of_it_trains_in_16_bits():
    for name in ("lidargen", "lidargen_small", "lidargen_kitti_360"):
        assert {fit.precision for fit in load_preset(name).training.values()} == {"fp32"}


def test_noise_levels_and_the_norm_are_the_programs(numbers):
    agree(sigma_table(50.0, 0.01, 232), numbers["sigmas_232"], 1e-6)
    agree(sigma_table(50.0, 0.01, 232) / torch.from_numpy(numbers["sigmas_232"]), torch.ones(232), 1e-6)
    agree(sigma_table(8.0, 0.05, 20), numbers["sigmas_20"], 1e-6)
    (norm := InstanceNormPlus(6)).load_state_dict(seeded(numbers, "norm"))
    agree(norm(torch.from_numpy(numbers["norm_x"])).detach(), numbers["norm_y"])


@pytest.mark.shared
def test_the_network_and_all_its_stages_are_the_programs(numbers, tiny):
    found = {}
    hooks = [
        tiny.get_submodule(name).register_forward_hook(lambda _, __, out, name=name: found.update({name: out}))
        for name in STAGES
    ]
    sigma = torch.from_numpy(numbers["sigmas_20"])[numbers["tiny_labels"]]
    agree(tiny(torch.from_numpy(numbers["tiny_x"]), sigma), numbers["tiny_score"])
    for name in STAGES:
        agree(found[name][:1], numbers[f"tiny_after_{name}"])
    for hook in hooks:
        hook.remove()


@pytest.mark.shared
def test_the_network_of_published_width_is_the_programs(numbers):
    sigma = torch.from_numpy(numbers["sigmas_232"])[numbers["wide_labels"]]
    agree(network(numbers, "wide", 128)(torch.from_numpy(numbers["wide_x"]), sigma), numbers["wide_score"])


@pytest.mark.shared
def test_the_loss_is_the_programs(numbers, tiny):
    clean, noise = (torch.from_numpy(numbers[f"loss_{name}"]) for name in ("x", "noise"))
    sigma = torch.from_numpy(numbers["sigmas_20"])[numbers["loss_labels"]]
    errors = score_matching_errors(tiny, clean, sigma, noise)
    agree(errors, numbers["loss_per_scan"], 1e-5)
    agree(errors.mean(), numbers["loss_value"], 1e-5)


def walked(numbers, part, network, pull=None):
    """Return every image that the network saw, and the last."""
    seen, noise = [], iter(torch.from_numpy(numbers[f"{part}_noise"]))

    def watched(image, sigma):
        seen.append(image)
        return network(image, sigma)

    start, sigmas = (torch.from_numpy(numbers[f"{part}_{name}"]) for name in ("x0", "sigmas"))
    last = langevin(watched, start, lambda: next(noise), sigmas, 2, 6.2e-6, pull)
    return [*seen[1:], last]


@pytest.mark.shared
def test_langevin_dynamics_take_the_programs_steps(numbers, tiny):
    for ours, theirs in zip(walked(numbers, "langevin", tiny), numbers["langevin_states"], strict=True):
        agree(ours, theirs, 1e-3)


@pytest.mark.shared
def test_sparse_rows_are_made_dense_by_the_programs_steps(numbers, tiny):
    observed = torch.zeros(1, 1, 64, 16, dtype=torch.bool)
    observed[:, :, ::4] = True
    pull = pull_towards(observed, torch.from_numpy(numbers["densify_reference"]), 1.0)
    ours, theirs = walked(numbers, "densify", tiny, pull), numbers["densify_states"]
    for one, other in zip(ours[:4], theirs[:4], strict=True):
        agree(one, other, 1e-3)
    agree(ours[4], theirs[5], 1e-3)  # the one between them is the same before the last pull


@pytest.mark.shared
def test_a_scan_is_encoded_as_by_the_program(numbers):
    points = torch.from_numpy(numbers["item_points"])
    sensor = replace(load_sensor("hdl64e_kitti_360"), range_min_m=1e-3, range_max_m=1e3)  # the program has no limits
    image = project(Scan(points[:, :3].clone(), reflectance=points[:, 3].clamp(0, 1)), sensor)
    assert int(image.return_mask.sum()) > 5000
    agree(encode(RangeImage.stack([image]), LidarGenConfig())[0], numbers["item"], 1e-6)


def test_only_values_in_the_chosen_window_are_returns():
    sensor = load_sensor("hdl64e_kitti_360").with_columns(32)
    generator = LidarGen(LidarGenConfig(channels=4), sensor)
    range_m = torch.tensor([0.0, 0.4, 1.0, 2.0, 5.0, 62.0, 63.0, 75.0])
    values = torch.full((1, 2, 64, 32), 0.5)
    values[0, 0, 0, :8] = torch.log2(range_m + 1) / 6
    values[0, 1, 0, :8] = torch.tensor([1.5, -1.0, 0.5, 2.0, -0.5, 0.25, 0.5, 0.5])
    wanted = {"frd": [2.0, 5.0, 62.0], "bev": [5.0, 62.0, 63.0, 63.0], "sensor": [2.0, 5.0, 62.0, 63.0, 63.0]}
    for raydrop, kept in wanted.items():
        image = generator._decoded(values, LangevinSampling(raydrop=raydrop))
        found = image.range_m[0, 0, :8]
        assert found[found > 0].tolist() == pytest.approx(kept, rel=1e-5)
        assert float(image.reflectance.min()) >= 0
        assert float(image.reflectance.max()) <= 1
        assert image.reflectance[0, 0, 5] == 0.25
        assert bool((image.reflectance[~image.return_mask] == 0).all())


def test_levels_steps_and_their_size_are_choices_and_are_counted():
    small, published = load_preset("lidargen_small").model, LidarGenConfig(channels=4)
    assert LidarGen(published, SENSOR).cost().network_evaluations == 1161
    assert LidarGen(replace(small, channels=4), SENSOR).cost().network_evaluations == 175
    generator = made(reflectance=False)
    assert generator.cost(LangevinSampling(levels=3, steps_each=2)).network_evaluations == 7
    passes = []
    hook = generator.network.register_forward_hook(lambda *_: passes.append(1))
    settings = LangevinSampling(levels=3, steps_each=2, step_lr=1e-9)
    first = generator.sample([0], sampling=settings)
    assert len(passes) == 7
    hook.remove()
    for other in ({"levels": 4}, {"steps_each": 3}, {"step_lr": 2e-9}):
        assert not torch.equal(generator.sample([0], sampling=replace(settings, **other)).range_m, first.range_m)
    one, two = (generator.cost(LangevinSampling(levels=levels, steps_each=1)).flops for levels in (2, 5))
    assert one == two / 2 > 0


@pytest.mark.parametrize(("levels", "steps_each", "step_lr"), [(232, 5, 6.2e-6), (58, 3, 4e-5), (20, 2, 3e-4)])
def test_noise_left_is_what_langevin_leaves(levels, steps_each, step_lr):
    rng, sigmas = torch.Generator().manual_seed(0), sigma_table(50.0, 0.01, levels)

    def direction(image, sigma):  # of a network that knows the clean image, which is 0
        return -image / image.std() / sigma[0]

    size = (1, 1, 64, 256)
    start = 1e-3 * torch.randn(size, generator=rng)  # next to nothing, but with a direction
    left = langevin(direction, start, lambda: torch.randn(size, generator=rng), sigmas, steps_each, step_lr)
    found = abs(float(left.std()) / 0.01 + 1)  # the last pass removes one level's noise
    assert found == pytest.approx(noise_left(sigmas, steps_each, step_lr), rel=0.03)


def test_steps_grow_where_the_published_ones_would_leave_noise():
    generator = made(reflectance=False)
    for levels, steps_each, wanted in ((232, 5, 6.2e-6), (58, 3, 4e-5), (50, 1, 1.2e-4)):
        sigmas, count, step_lr = generator._schedule(LangevinSampling(levels=levels, steps_each=steps_each))
        assert (len(sigmas), count) == (levels, steps_each)
        assert step_lr == pytest.approx(wanted, rel=1e-4)
        assert noise_left(sigmas, steps_each, step_lr) <= noise_left(sigmas, steps_each, 6.2e-6)
    small = sigma_table(50.0, 0.01, 58)
    assert noise_left(small, 3, 6.2e-6) > 1000
    assert noise_left(small, 3, 4e-5) < 1.4
    assert generator._schedule(LangevinSampling(step_lr=1e-7))[2] == 1e-7


def test_the_cost_of_a_pass_at_the_small_size_is_that_counted_in_the_program():
    preset = load_preset("lidargen_small", ("model.reflectance=true",))
    cost = LidarGen(preset.model, preset.data.load_sensor()).cost(LangevinSampling(levels=2, steps_each=1))
    assert cost.flops / cost.network_evaluations / 1e9 == pytest.approx(4.97, rel=0.02)


@pytest.mark.parametrize(
    "settings",
    [
        {"channels": 1},
        {"sigma_largest": 0.001},
        {"sigma_smallest": 0.0},
        {"levels": 1},
        {"steps_each": 0},
    ],
)
def test_models_that_cannot_be_are_refused(settings):
    with pytest.raises(ConfigError, match=f"{next(iter(settings))}="):
        LidarGenConfig(**settings)


@pytest.mark.parametrize(
    "settings", [{"levels": 1}, {"levels": 10**9}, {"steps_each": 0}, {"step_lr": 0.0}, {"step_lr": 2.0}, {"pull": 1.5}]
)
def test_sampling_settings_that_cannot_be_are_refused(settings):
    with pytest.raises(ConfigError, match=f"{next(iter(settings))}="):
        LangevinSampling(**settings)


def test_images_that_cannot_be_halved_are_refused():
    with pytest.raises(ConfigError, match=r"64x1 for lidargen; wanted even numbers"):
        LidarGen(LidarGenConfig(channels=4), load_sensor("hdl64e_kitti_360").with_columns(1))


def test_scans_without_reflectance_train_the_range_only():
    images = walls(reflectance=False)
    with pytest.raises(ConfigError, match=r"without reflectance.*model\.reflectance=false"):
        made().objective("score")(Example(images), torch.Generator().manual_seed(0))
    generator = made(reflectance=False)
    loss = generator.objective("score")(Example(images), torch.Generator().manual_seed(0))["loss"]
    assert bool(loss.isfinite())
    assert generator.sample([0]).reflectance is None


def test_a_completed_scan_keeps_what_was_observed_whichever_pixels_these_are():
    generator, images = made(), walls()
    sampling = LangevinSampling(levels=3, steps_each=2, step_lr=1e-9)
    observed = torch.rand(2, 64, 32, generator=torch.Generator().manual_seed(4)) < 0.3
    done = generator.complete(Observed.of_pixels(images, observed), [0, 1], sampling)
    for name in ("range_m", "return_mask", "reflectance"):
        assert torch.equal(getattr(done, name)[observed], getattr(images, name)[observed])
    range_m, mask = torch.where(observed, images.range_m, 9.0), images.return_mask | ~observed
    hidden = RangeImage.masked(range_m, mask, SENSOR, images.planes)
    again = generator.complete(Observed.of_pixels(hidden, observed), [0, 1], sampling)
    assert torch.equal(again.range_m, done.range_m)
    # What the network sees of the observed pixels reaches the others.
    nothing = torch.zeros_like(observed)
    free = generator.complete(Observed.of_pixels(images, nothing), [0, 1], sampling)
    assert torch.equal(free.range_m, generator.sample([0, 1], sampling=sampling).range_m)
    assert not torch.equal(done.range_m[~observed], free.range_m[~observed])
    weaker = generator.complete(Observed.of_pixels(images, observed), [0, 1], replace(sampling, pull=0.1))
    assert not torch.equal(weaker.range_m[~observed], done.range_m[~observed])


def test_an_image_is_learned_by_heart():
    sensor = load_sensor("vlp16").with_columns(16)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        config = LidarGenConfig(channels=8, reflectance=False, sigma_largest=1.0, levels=8)
        generator = LidarGen(config, sensor)
    range_m = (5 + 40 * torch.rand(1, 1, 16, generator=torch.Generator().manual_seed(0))).expand(4, 16, 16)
    images = RangeImage(range_m.clone(), range_m > 0, sensor)
    steps = learn(generator.objective("score").train(), images, range(40), 4e-3)
    losses = [terms["noise_mse"] for terms in steps]
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    clean, sigma = encode(images, generator.config), torch.full((4,), 0.5)
    noisy = clean + 0.5 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(99))
    with torch.no_grad():
        denoised = noisy + 0.5**2 * generator.network(noisy, sigma)
    assert float((denoised - clean).abs().mean()) < 0.5 * float((noisy - clean).abs().mean())


def checkpoint(image_channels=2, channels=4):
    """Return what the program saves: weights as trained, optimiser, epoch, step, their moving average."""
    network = Ncsn(image_channels, channels)
    rng = torch.Generator().manual_seed(5)
    average = {name: torch.randn(of.shape, generator=rng) for name, of in network.named_parameters()}
    trained = {"module.sigmas": sigma_table(50.0, 0.01, 232)}
    trained |= {f"module.{name}": torch.zeros_like(of) for name, of in average.items()}
    optimiser = {
        "state": {0: {"step": 5, "exp_avg": torch.ones(2)}},
        "param_groups": [{"lr": 1e-4, "betas": (0.9, 0.999), "params": [0]}],
    }
    return [trained, optimiser, 12, 100_000, average]


@pytest.mark.parametrize("image_channels", [1, 2])
def test_a_checkpoint_of_the_program_becomes_a_run(image_channels, tmp_path):
    saved = checkpoint(image_channels)
    torch.save(saved, tmp_path / "checkpoint.pth")
    assert main(["import-weights", "lidargen_kitti_360", str(tmp_path / "run"), str(tmp_path / "checkpoint.pth")]) == 0
    generator = lidargrit.load(tmp_path / "run")
    assert generator.config == LidarGenConfig(channels=4, reflectance=image_channels == 2)
    assert (generator.sensor.name, generator.sensor.width) == ("hdl64e_kitti_360", 1024)
    weights = generator.network.state_dict()
    assert weights.keys() == saved[4].keys()
    assert all(torch.equal(weights[name], of) for name, of in saved[4].items())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop(), "holds no list of 5 parts"),
        (lambda c: c[0].pop("module.sigmas"), r"holds no 'module\.sigmas'"),
        (lambda c: c[0].update({"module.sigmas": torch.ones(3)}), "are no falling noise levels"),
        (lambda c: c[0].update({"module.sigmas": torch.tensor([3.0, 2.0, 1.0])}), "do not fall by one factor"),
        (lambda c: c[4].pop("begin_conv.weight"), r"holds no convolution 'begin_conv\.weight'"),
        (lambda c: c[4].pop("res1.0.conv1.bias"), r"lacks 'res1\.0\.conv1\.bias'"),
        (lambda c: c[4].update({"more": torch.ones(1)}), r"has besides 'more'"),
        (lambda c: c[4].update({"normalizer.beta": torch.ones(4).half()}), r"'normalizer\.beta' is no float32 tensor"),
        (
            lambda c: c[4].update({"begin_conv.weight": torch.ones(1 << 16, 4, 3, 3)}),
            "with a network (of|that)",
        ),
        (lambda c: c[4].update({"end_conv.weight": torch.ones(7, 4, 3, 3)}), "images of 7 channels"),
    ],
)
def test_checkpoints_of_another_form_are_refused(change, message, tmp_path):
    saved, path = checkpoint(), tmp_path / "checkpoint.pth"
    change(saved)
    torch.save(saved, path)
    with pytest.raises((CheckpointError, ConfigError), match=message):
        LidarGen.from_published([path], LidarGenConfig(), load_sensor("hdl64e_kitti_360"))
