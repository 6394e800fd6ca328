"""Completion and raydrop told their rays: the same weights on other rays, absent rows, commands for other sensors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.core.files import read_tensors
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.run_folder import WEIGHTS_FILE, locate
from lidargrit.generation.any_sensor import RayNetwork
from lidargrit.generation.generator import Generator, load
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.nn.quantization import without_quantized
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.completion.classical_features import classical_features
from lidargrit.systems.completion.network import CompletionNetwork, CompletionNetworkConfig
from lidargrit.systems.completion.system import Completion, CompletionConfig
from lidargrit.systems.raydrop.network import RaydropNetwork, RaydropNetworkConfig
from lidargrit.systems.raydrop.system import Raydrop, RaydropConfig
from lidargrit.training.taken_stages import taken_stages
from pixel_decoder_examples import random_images, tiny_sensor, write_other_sensor

EVEN, ODD = tiny_sensor(16, 32), tiny_sensor(13, 24)  # the second has 3 absent rows
COMPLETION = CompletionNetworkConfig(
    (8, 8, 8),
    blocks=1,
    attention_layers=1,
    heads=2,
    features=4,
    mask_width=4,
    row_channels=3,
    any_sensor=True,
    labels=True,
    reflectance=True,
)
RAYDROP = RaydropNetworkConfig(
    "estimated", (8, 8, 8), blocks=1, features=4, mask_width=4, row_channels=3, any_sensor=True, reflectance=True
)


def generator(kind: str, sensor: SensorModel, any_sensor: bool = True) -> Generator:
    """Return a generator none of whose weights are zero, so that everything depends on everything it may."""
    torch.manual_seed(0)
    if kind == "completion":
        made = Completion(CompletionConfig(replace(COMPLETION, any_sensor=any_sensor)), sensor)
    else:
        made = Raydrop(RaydropConfig(replace(RAYDROP, any_sensor=any_sensor)), sensor)
    for weight in made.parameters():
        weight.data = 0.2 * torch.randn_like(weight)
    return made.eval()


def network_of(made: Generator) -> CompletionNetwork | RaydropNetwork:
    network = next(made.children())
    assert isinstance(network, (CompletionNetwork, RaydropNetwork))
    return network


def scans(sensor: SensorModel, count: int) -> RangeImage:
    """Return random scans with reflectance and labels."""
    images = random_images(sensor, count)
    rng = torch.Generator().manual_seed(5)
    label = torch.where(torch.rand(images.range_m.shape, generator=rng) < 0.5, 40, 50)
    planes = {"reflectance": torch.rand(images.range_m.shape, generator=rng), "label": label}
    return RangeImage.masked(images.range_m, images.return_mask, sensor, planes)


def known_of(kind: str, images: RangeImage) -> Observed:
    if kind == "raydrop":
        return Observed.of_surfaces(images)
    observed = torch.zeros_like(images.return_mask)
    observed[:, 2::4] = True
    return Observed.of_pixels(images, observed)


def result_of(network: RayNetwork, images: RangeImage) -> list[torch.Tensor]:
    """Return everything that a network tells of scans, but for the guide of the phases."""
    if isinstance(network, RaydropNetwork):
        found = network(images.range_m, images.return_mask)
        return [found.logits, found.reflectance]
    known = known_of("completion", images)
    assert isinstance(network, CompletionNetwork)
    found = network(classical_features(known), known.return_observed)
    return [found.v, found.return_logits, found.class_logits, found.reflectance]


@pytest.mark.parametrize("kind", ["completion", "raydrop"])
@torch.no_grad()
def test_one_model_for_another_sensor_is_as_one_made_for_it(kind: str) -> None:
    one, other = generator(kind, EVEN), generator(kind, ODD)
    images = scans(ODD, 2)
    for mine, theirs in zip(
        result_of(network_of(one).for_sensor(ODD), images), result_of(network_of(other), images), strict=True
    ):
        assert torch.equal(mine, theirs)
        assert mine.isfinite().all()
        assert mine.shape[-2:] == (13, 24)
    assert network_of(one).for_sensor(ODD) is network_of(one).for_sensor(ODD)
    known = known_of(kind, images)
    done = other.complete(known, [1, 2])
    assert done.range_m.shape == (2, 13, 24)
    wide = load_sensor("vlp16").with_columns(256)
    with pytest.raises(ConfigError, match="32 columns; wanted 256 to 2048 columns"):
        one.for_sensor(EVEN)
    taken = one.for_sensor(wide)
    assert taken.sensor is wide
    assert all(mine is theirs for mine, theirs in zip(one.parameters(), taken.parameters(), strict=True))
    with pytest.raises(ConfigError, match=f"name a run of that sensor, or train .*{kind}_any"):
        generator(kind, EVEN, any_sensor=False).for_sensor(wide)


@pytest.mark.parametrize("kind", ["completion", "raydrop"])
def test_a_step_on_one_sensor_moves_the_weights_that_another_has(kind: str) -> None:
    made = generator(kind, EVEN).train()
    objective = made.objective(kind).train()
    before = [one.detach() for one in result_of(network_of(made), scans(EVEN, 1))]
    loss = objective(Example(scans(ODD, 2)), torch.Generator().manual_seed(0))["loss"]
    assert loss.isfinite()
    loss.backward()
    assert all(weight.grad is not None for name, weight in made.named_parameters() if ".unet." in name)
    assert all(weight.grad is not None for name, weight in made.named_parameters() if f"{kind}.rows." in name)
    for weight in made.parameters():
        weight.data.sub_(0.0 if weight.grad is None else 0.1 * weight.grad)
    after = result_of(network_of(made), scans(EVEN, 1))
    assert not torch.equal(before[1 if kind == "completion" else 0], after[1 if kind == "completion" else 0])


@pytest.mark.parametrize("kind", ["completion", "raydrop"])
@torch.no_grad()
def test_absent_rows_are_outside_of_the_loss_and_what_they_hold_changes_nothing(kind: str) -> None:
    network, images = network_of(generator(kind, ODD)), scans(ODD, 2)
    known = known_of("completion", images)
    if isinstance(network, CompletionNetwork):
        guide = network(classical_features(known), known.return_observed).guide
    else:
        surfaces_m = torch.where(images.return_mask, images.range_m, 5.0)
        guide = network(surfaces_m, surfaces_m > 0).guide
    assert guide.v.shape == (2, 16, 24)
    true = network.padded(images.return_mask)
    guided, whole = network.mask.guided(guide), torch.zeros(2)
    for phases in network.mask.by_lattice():
        nats = network.mask.phase_nll(phases, guided, guide, true)
        rows = torch.stack([torch.arange(16)[phase.pixels[0]] for phase in phases])
        assert nats.movedim(2, 1)[rows >= 13].sum() < 1e-18
        whole += nats.sum((0, 2, 3))
    assert torch.allclose(network.mask.nats(guide, true), whole)
    rng = [torch.Generator().manual_seed(0)]
    whole_mask = network.mask.sample(
        guide.part(slice(1)), network.mask.uniform(rng), network.padded_condition(known[:1])
    )
    assert whole_mask[:, :13].any()
    assert not whole_mask[:, 13:].any()


@pytest.mark.parametrize("kind", ["completion", "raydrop"])
@torch.no_grad()
def test_a_turned_scan_is_turned_where_azimuth_is_not_told(kind: str) -> None:
    """Columns close a circle: without what tells where the car is, a turn by eight columns is a turn of the result."""
    network, images = network_of(generator(kind, ODD)), scans(ODD, 1)
    network.azimuth.zero_()
    turned = images.mapped(lambda pixels: pixels.roll(8, -1))
    if isinstance(network, CompletionNetwork):
        known = known_of("completion", images)
        classical = classical_features(known)
        moved = classical.mapped(lambda maps: maps.roll(8, -1))
        one = network(classical, known.return_observed)
        other = network(moved, known.return_observed.roll(8, -1))
        pairs = [(one.v, other.v), (one.return_logits, other.return_logits)]
    else:
        pairs = [*zip(result_of(network, images), result_of(network, turned), strict=True)]
    for mine, theirs in pairs:
        assert torch.allclose(mine.roll(8, -1), theirs, atol=1e-4)


@torch.no_grad()
def test_raydrop_of_rows_half_as_far_apart_is_told_so() -> None:
    """The incidence on a wall is that of its angles, not of its pixels."""
    even = load_sensor("os1_64").with_columns(256)
    dense = replace(even, elevation_rad=even.elevation_rad / 2)
    made = network_of(generator("raydrop", even))
    assert isinstance(made, RaydropNetwork)
    ground = [(1.8 / -sensor.elevation_rad[40:].sin()).expand(-1, 256) for sensor in (even, dense)]
    found = []
    for sensor, range_m in zip((even, dense), ground, strict=True):
        network, whole = made.for_sensor(sensor), torch.zeros(1, 64, 256)
        whole[0, 40:] = range_m
        cos = network._maps(whole, whole > 0)[0, -1, 44:60]
        wanted = -sensor.elevation_rad[44:60, 0].sin()
        found.append(float((cos.mean(1) / wanted).log().abs().max()))
    assert max(found) < 0.2  # on level ground the cosine of incidence is the sine of the elevation


@pytest.mark.parametrize("kind", ["completion", "raydrop"])
def test_training_for_any_sensor_starts_from_a_network_of_one(kind: str, tmp_path) -> None:
    """All weights but those of its rows are taken over, whatever the number of rows."""
    given = generator(kind, load_sensor("hdl64e_kitti_odometry").with_columns(32), any_sensor=False)
    given.save(tmp_path)
    config = CompletionConfig(COMPLETION) if kind == "completion" else RaydropConfig(RAYDROP)
    fit = TrainingConfig(scans=2, batch_size=2, learning_rate=1e-3, start=str(tmp_path))
    preset = Preset("a test", kind, config, DataConfig(sensor="vlp16", columns=256), {kind: fit})
    wanted = preset.build_generator()
    taken = wanted.objective(kind).weights_from(taken_stages(preset, wanted)[kind])
    own = given.objective(kind).state_dict()
    assert {*own} - {*taken} == {f"{kind}.rows", f"{kind}.mask.rows", f"{kind}.mask.row_bias"}
    assert all(torch.equal(weight, own[name]) for name, weight in taken.items())
    wanted.objective(kind).load_state_dict(taken, strict=False)
    one_sensor = type(config)(replace(getattr(config, kind), any_sensor=False))
    back = replace(preset, model=one_sensor, data=DataConfig(columns=32))
    wanted.save(tmp_path / "any")
    back = replace(back, training={kind: replace(fit, start=str(tmp_path / "any"))})
    with pytest.raises(ConfigError, match=f"whose {kind} is another .model.{kind}.any_sensor=True"):
        taken_stages(back, back.build_generator())


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return the folder of an untrained run of each kind that takes any sensor, and the file of another sensor."""
    folder = tmp_path_factory.mktemp("any")
    own = load_sensor("vlp16").with_columns(256)
    generator("completion", own).save(folder / "completion")
    generator("raydrop", own).save(folder / "raydrop")
    write_other_sensor(folder)
    return folder


def test_commands_take_another_sensor(runs, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    scans, given = str(runs / "scans"), np.load(runs / "scans" / "one.npy")
    named = ["--sensor", str(runs / "mine.json"), "--device", "cpu"]
    keeps = ["--observed", "rows:4", "--format", "image", "--model", str(runs / "completion")]
    assert main(["complete", scans, "whole", *named, *keeps]) == 0
    kept = [row for row, pixels in enumerate(np.load("whole/one.npy")) if np.array_equal(pixels, given[row])]
    assert kept == [*range(kept[0], 13, 4)]
    assert main(["raydrop", scans, "dropped", *named, "--format", "image", "--model", str(runs / "raydrop")]) == 0
    dropped = np.load("dropped/one.npy")
    assert np.array_equal(dropped[dropped > 0], given[dropped > 0])
    assert 0 < (dropped > 0).sum() < (given > 0).sum()
    capsys.readouterr()
    asked = ["complete", scans, "no", "--model", str(runs / "completion"), "--sensor", "os1_64"]
    assert main([*asked, "--set", "data.columns=128"]) == 2
    assert "256 to 2048 columns" in capsys.readouterr().err
    sensor = load_sensor("vlp16")
    rows = np.sin(sensor.elevation_rad[:, 0].double().numpy()), np.cos(sensor.elevation_rad[:, 0].double().numpy())
    turn = np.linspace(-np.pi, np.pi, 900, endpoint=False)
    each = [
        10 * np.stack((c * np.cos(turn), c * np.sin(turn), np.full(900, s), 0 * turn), 1)
        for s, c in zip(*rows, strict=True)
    ]
    points = np.concatenate(each).astype(np.float32)
    points.tofile(tmp_path / "few.bin")
    upsampled = ["upsample", "few.bin", "dense", "--sensor", "vlp16", "--to", "os1_64", "--device", "cpu"]
    assert main([*upsampled, "--model", str(runs / "completion")]) == 0
    whole = np.fromfile("dense/few.bin", dtype=np.float32).reshape(-1, 4)
    assert np.array_equal(whole[: len(points)], points)
    assert len(whole) > len(points)


def test_a_run_for_any_sensor_is_read_again(runs) -> None:
    mine = load_sensor(str(runs / "mine.json"))
    known = known_of("completion", scans(mine, 1))
    once, again = (load(runs / "completion").for_sensor(mine).complete(known, [3]) for _ in range(2))
    assert torch.equal(once.range_m, again.range_m)
    assert once.sensor is mine


@pytest.mark.parametrize("job", ["complete", "raydrop"])
def test_packaged_models_have_the_weights_of_their_files(job) -> None:
    """They know their own sensor alone, so nothing of the encoding of rays is in them."""
    packaged = load("pretrained", job)
    stored = without_quantized(read_tensors(locate("pretrained", job) / WEIGHTS_FILE)[0])
    mine = packaged.state_dict()
    assert mine.keys() == stored.keys()
    assert all(torch.equal(mine[name], weight.to(mine[name].dtype)) for name, weight in stored.items())
    assert isinstance(network_of(packaged).rows, torch.nn.Parameter)
    assert network_of(packaged).grid is packaged.sensor
