"""One model for any sensor: the same weights on other rays, absent rows, drawn sensors, batches of one sensor each."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.data.batches import Batches
from lidargrit.data.images import Pixels, RangeImages
from lidargrit.generation.generator import load
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.pixel_decoder.phase_noise import COLUMN_RAD, ROW_RAD, PhaseNoise
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder, PixelSampling
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice, phases_of
from lidargrit.generation.pixel_decoder.ray_encoding import check_bounds, row_features, with_absent_rows
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.generation.tokens import PixelObjective
from lidargrit.nn.blocks import Block, prepare_for_training
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel, SensorSetup, load_sensor
from lidargrit.systems.multiscale.system import Multiscale, MultiscaleConfig
from pixel_decoder_examples import random_images, tiny_sensor, write_other_sensor
from seeded_images import SeededImages

CONFIG = PixelDecoderConfig(16, row_channels=3, mask_width=6, range_width=6, blocks=1, any_sensor=True)
EVEN, ODD = tiny_sensor(16, 32), tiny_sensor(13, 24)  # cells of 16 pixels, and of 8 with 3 absent rows


def random_decoder(sensor: SensorModel) -> PixelDecoder:
    """Return a decoder none of whose weights are zero, so that everything depends on everything it may."""
    torch.manual_seed(0)
    decoder = PixelDecoder(CONFIG, sensor, 0)
    for weight in decoder.parameters():
        weight.data = 0.2 * torch.randn_like(weight)
    return decoder.eval()


def rngs(count: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


def test_one_decoder_for_another_sensor_is_as_one_made_for_it() -> None:
    one = random_decoder(EVEN)
    other = PixelDecoder(CONFIG, ODD, 0).eval()
    other.load_state_dict(one.state_dict())
    for mine, theirs in zip(
        one.for_sensor(ODD)(None, random_images(ODD, 2)), other(None, random_images(ODD, 2)), strict=True
    ):
        assert torch.equal(mine, theirs)
    assert one.for_sensor(ODD) is one.for_sensor(ODD)
    assert one.for_sensor(EVEN) is one
    images = one.for_sensor(ODD).sample(None, rngs(2))
    assert torch.equal(images.range_m, other.sample(None, rngs(2)).range_m)
    assert images.range_m.shape == (2, 13, 24)


def test_what_is_learned_from_one_sensor_is_known_of_another() -> None:
    decoder = random_decoder(EVEN).train()
    objective = PixelObjective(decoder)
    before = random_decoder(EVEN)(None, random_images(EVEN, 1)).range.sum()
    sums = decoder.mask.noise.sums.clone()
    loss = objective(Example(random_images(ODD, 2)), torch.Generator().manual_seed(0))["loss"]
    loss.backward()
    for weight in decoder.parameters():
        weight.data.sub_(0.0 if weight.grad is None else 0.1 * weight.grad)
    assert not torch.equal(decoder.mask.noise.sums, sums)
    assert decoder.eval()(None, random_images(EVEN, 1)).range.sum() != before


def test_absent_rows_cost_no_bits_and_have_no_influence() -> None:
    decoder, images = random_decoder(ODD), random_images(ODD, 2)
    steps = RangeSteps(ODD, 10)
    nll = decoder(None, images, steps)
    assert nll.mask.shape == images.range_m.shape
    assert torch.equal(nll.range > 0, images.return_mask)
    whole = PixelDecoder(CONFIG, with_absent_rows(ODD), 0).eval()  # as if the rows were the sensor's own
    whole.load_state_dict(decoder.state_dict())
    padded = random_images(with_absent_rows(ODD), 2)
    assert whole(None, padded).mask[:, 13:].min() > 1e-3
    guide, mask = decoder.guide(None, 2), torch.zeros(2, 16, 24, dtype=torch.bool)
    for phases in decoder.mask.by_lattice():
        nats = decoder.mask.phase_nll(phases, decoder.mask.guided(guide), guide, mask)
        rows = torch.stack([torch.arange(16)[phase.pixels[0]] for phase in phases])
        assert nats.movedim(2, 1)[rows >= 13].sum() < 1e-18
    observed = torch.rand(images.range_m.shape, generator=rngs(1)[0]) < 0.5
    done = decoder.sample(None, rngs(2), condition=Observed.of_pixels(images, observed))
    assert torch.equal(done.range_m[observed], images.range_m[observed])


def test_no_range_takes_more_bits_than_a_bound() -> None:
    """1e-4 of a nearly uniform density: at most 13.3 bits more than a range of which nothing is known."""
    decoder = random_decoder(EVEN)
    for weight in decoder.parameters():
        weight.data *= 8  # as sure as it is wrong
    images, steps = random_images(EVEN, 1), RangeSteps(EVEN, 2)
    bits = decoder(None, images, steps).range / math.log(2)
    unknown = math.log2(math.log1p(80) - math.log1p(1)) - (2e-3 / (1 + images.range_m)).log2()
    over = (bits - unknown)[images.return_mask]
    assert 5 < over.max() < -math.log2(1e-4) + 0.2
    every = torch.arange(steps.first, steps.last + 1)
    guide = decoder.guide(None, 1)
    nothing = torch.zeros(1, 16, 32, dtype=torch.bool)
    mixture = decoder.range.distributions(
        decoder.range.phases[:1], decoder.range.guided(guide), guide, nothing, torch.zeros(1, 16, 32)
    )
    low_m, high_m = (edge[:, None, None, None, None] for edge in steps.edges_m(every))
    assert mixture.log_mass(low_m, high_m).exp().sum(0).detach() == pytest.approx(1, abs=1e-4)


def test_rows_are_told_as_a_slow_loop_tells_them() -> None:
    sensor = replace(ODD, setup=SensorSetup(height_m=2.1))
    told = row_features(with_absent_rows(sensor), 13, Lattice(2, 4))
    elevation = sensor.elevation_rad[:, 0].double().tolist()
    assert told.shape[0] == 16
    assert told[13:, :-1].abs().sum() == 0
    assert told[:, -1].tolist() == [0.0] * 13 + [1.0] * 3
    for row in (0, 5, 12):
        angles = [f(c * elevation[row]) for c in (2, 4, 8, 16, 32, 64) for f in (math.sin, math.cos)]
        above = elevation[row - 2] - elevation[row] if row >= 2 else elevation[row] - elevation[row + 2]
        below = elevation[row] - elevation[row + 2] if row + 2 < 13 else elevation[row - 2] - elevation[row]
        steps = [math.log(step / math.radians(0.5)) / 2 for step in (above, below, 4 * 2 * math.pi / 24)]
        rest = [row >= 2, row + 2 < 13, 2.1 - 1.8, 1.0, math.log(1.0) / 2, math.log(80 / 100) / 2, 0.0]
        wanted = [2 * elevation[row], 2 * math.sin(elevation[row]), *angles, *steps, *map(float, rest)]
        assert told[row].tolist() == pytest.approx(wanted, abs=1e-5)


def test_noise_that_a_sensor_learned_decays_by_degrees_on_another() -> None:
    """Rows half as far apart share more of the noise, and the same shares are learned from either sensor."""
    phases = phases_of(4)
    phase, found = phases[4], []
    for per_row in (1.0, 0.5):
        noise = PhaseNoise(phases, (tuple(per_row * row for row in range(32)), 1.0))
        noise.sums[:, 0, 0], noise.sums[:, 0, 1] = 0.3 * 1e9, 1e9
        rng = rngs(1)[0]
        uniform = torch.stack([noise(torch.rand(32, 128, generator=rng), rng, noise.shares()) for _ in range(100)])
        normal = torch.special.ndtri(uniform.double())[(..., *phase.pixels)]
        assert (normal[:, 1:] * normal[:, :-1]).mean() == pytest.approx(0.5 * 0.6**per_row, abs=0.02)
        learning = PhaseNoise(phases, (tuple(per_row * row for row in range(32)), 1.0))
        returned = (uniform < 0.5)[(..., *phase.pixels)][None]
        learning.learn([phase], torch.zeros(returned.shape), returned)
        found.append(float(learning.shares()[4, 0]))
    assert found == pytest.approx([0.5, 0.5], abs=0.06)
    assert random_decoder(EVEN).mask.noise._given is not None
    assert math.degrees(ROW_RAD) == pytest.approx(26.9 / 64, abs=0.01)  # of the HDL-64E
    assert math.degrees(COLUMN_RAD) == 360 / 256


class LabelledImages(SeededImages):
    """The same with labels: cars at every third pixel, a building elsewhere."""

    def read(self, index: int) -> Pixels:
        range_m = super().read(index).range_m
        label = np.where(np.arange(range_m.size).reshape(range_m.shape) % 3, 50, 10)
        return Pixels(range_m, {"label": label.astype(np.int64)})


def test_activations_are_computed_again_for_every_sensor() -> None:
    decoder = random_decoder(EVEN)
    prepare_for_training(decoder, recompute=True, compiled=False)
    blocks = [each for each in decoder.for_sensor(ODD).modules() if isinstance(each, Block)]
    assert blocks
    assert all(each.recomputed for each in blocks)


def test_a_decoder_behind_a_tokenizer_has_no_absent_rows() -> None:
    assert PixelDecoder(CONFIG, EVEN, features=4).grid is EVEN
    told = "images of 13 rows, behind a tokenizer or the past; wanted rows in multiples of 16"
    with pytest.raises(ConfigError, match=told):
        PixelDecoder(CONFIG, ODD, features=4)


def test_a_model_of_one_sensor_does_not_learn_from_others(tmp_path, capsys) -> None:
    sources = 'data.train=["simulated:4@vlp16:train","simulated:4@hdl32e:train"]'
    assert main(["train", "marginal", str(tmp_path / "run"), "--set", "data.own_sensors=true", sources]) == 2
    assert "own_sensors=true for 'marginal', whose networks know the rays of one sensor" in capsys.readouterr().err


def test_phases_of_another_sensor_leave_the_numbers_of_a_mask_uniform() -> None:
    """Cells of 8 are smaller than those that were learned from, of 16."""
    mask = random_decoder(EVEN).for_sensor(ODD).mask
    mask.noise.sums[..., :2] = torch.tensor([50.0, 100.0])  # in all phases that any sensor has, pixels correlate
    numbers = mask.uniform(rngs(2000)).double()
    assert torch.special.ndtri(numbers).std(0).sub(1).abs().max() < 0.08  # 0.016 is the error of one


def test_drawn_sensors_are_within_the_bounds_and_follow_from_their_seed() -> None:
    sensors = [load_sensor(f"drawn_{seed}") for seed in range(120)]
    for sensor in sensors:
        check_bounds(sensor)
        assert sensor.height * sensor.width <= 1 << 15
        assert sensor.width % 8 == 0
    assert {sensor.height for sensor in sensors} >= {16, 32, 40, 64, 128}
    assert 0.35 < np.mean([sensor.setup is None for sensor in sensors]) < 0.65
    assert load_sensor("drawn_7").to_json() == sensors[7].to_json()
    assert load_sensor("drawn_8").to_json() != sensors[7].to_json()
    for known in ("hdl64e_kitti_odometry", "pandar64", "vlp16", "vlp32c", "os1_128", "hdl32e_nuscenes"):
        check_bounds(load_sensor(known))


def test_a_batch_is_of_one_sensor_and_each_image_comes_once() -> None:
    parts = [RangeImages(sensor, [SeededImages(sensor, count)]) for sensor, count in ((EVEN, 4), (ODD, 6))]
    images = RangeImages.joined(None, parts)
    assert [images.sensor_of(index) for index in (0, 3, 4, 9)] == [EVEN, EVEN, ODD, ODD]
    batches = Batches(images, 2, (), any_columns=False, seed=3)
    seen = [batches.at(position).images for position in range(0, 20, 2)]
    firsts = [[(one.sensor.height, float(first)) for first in one.range_m[:, 0, 0]] for one in seen]
    epochs = [sorted(pair for batch in some for pair in batch) for some in (firsts[:5], firsts[5:])]
    assert len({*epochs[0]}) == 10
    assert epochs[0] == epochs[1]
    assert firsts[:5] != firsts[5:]
    assert {one.sensor for one in seen[:5]} == {EVEN, ODD}
    resumed = [one.images.range_m for one in batches.stream(4, 20)]
    assert all(map(torch.equal, resumed, [one.range_m for one in seen[2:]]))
    assert images.alike([0, 1, 2, 5, 6], 2) == [[0, 1], [2], [5, 6]]
    assert images.of_each_sensor() == [range(4), range(4, 10)]
    assert RangeImages.joined(None, [parts[0], *parts]).of_each_sensor() == [range(8), range(8, 14)]
    labelled = [RangeImages(sensor, [LabelledImages(sensor, 4)]) for sensor in (EVEN, ODD)]
    pasting = Batches(RangeImages.joined(None, labelled), 2, ("paste",), any_columns=False, seed=3)
    pasted = [batch.images for batch in pasting.stream(0, 8)]
    own = {float(each) for index in range(4) for each in LabelledImages(EVEN, 4).read(index).range_m.flatten()}
    own |= {float(each) for index in range(4) for each in LabelledImages(ODD, 4).read(index).range_m.flatten()}
    assert {float(each) for one in pasted for each in one.range_m.flatten()} < own
    fresh = Batches(RangeImages.joined(None, labelled), 2, (), any_columns=False, seed=3)
    assert any(not torch.equal(one.range_m, fresh.at(2 * at).images.range_m) for at, one in enumerate(pasted))
    halves = [Batches(RangeImages.joined(None, labelled), 2, ("paste",), False, 3, rank, 2) for rank in (0, 1)]
    for at, one in enumerate(pasted):
        assert torch.equal(torch.cat([half.at(2 * at).images.range_m for half in halves]), one.range_m)
    with pytest.raises(ConfigError, match="fewer scans of each of 2 sensors"):
        Batches(images, 8, (), any_columns=False, seed=3)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a run that takes any sensor, untrained, and the file of another sensor than its own."""
    folder = tmp_path_factory.mktemp("any")
    torch.manual_seed(0)
    own = load_sensor("vlp16").with_columns(256)
    config = replace(CONFIG, surface_components=True, gravity_components=True)
    Multiscale(MultiscaleConfig(config), own).save(folder / "run")
    write_other_sensor(folder)
    return folder


def test_commands_take_another_sensor(run, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    model, sensor = str(run / "run"), str(run / "mine.json")
    scans, as_named = str(run / "scans"), ["--model", model, "--sensor", sensor]
    assert main(["sample", model, "samples", "-n", "1", "--sensor", sensor, "--device", "cpu"]) == 0
    assert np.load("samples/00000000.npz")["range_m"].shape == (13, 256)
    assert main(["likelihood", scans, *as_named, "--json", "bits.json", "--device", "cpu"]) == 0
    assert main(["compress", scans, "scan.lgz", *as_named]) == 0
    assert main(["decompress", "scan.lgz", "back", "--model", model]) == 0
    found = json.loads((tmp_path / "bits.json").read_text())
    assert found["pixels"] == 13 * 256
    size = 8 * (tmp_path / "scan.lgz").stat().st_size
    assert size < 1.1 * found["bits"]["all"]["scan"]["value"] + 8 * 5000  # which names the sensor, too
    given, back = np.load(run / "scans" / "one.npy"), np.load("back/one.npy")
    assert np.array_equal(back > 0, given > 0)
    assert np.abs(back - given).max() < 0.0051
    keeps = ["--observed", "rows:4", "--format", "image", "--device", "cpu"]
    assert main(["complete", scans, "whole", *as_named, *keeps]) == 0
    kept = [row for row, pixels in enumerate(np.load("whole/one.npy")) if np.array_equal(pixels, given[row])]
    assert kept == [*range(kept[0], 13, 4)]
    capsys.readouterr()
    assert main(["sample", model, "no", "--sensor", "os1_64", "--set", "data.columns=128"]) == 2
    told = capsys.readouterr().err
    assert "with 128 columns" in told
    assert "256 to 2048 columns" in told
    assert main(["sample", "pretrained", "no", "--sensor", "os1_64"]) == 2
    assert "multiscale_any" in capsys.readouterr().err


def test_a_run_for_any_sensor_samples_the_same_when_it_is_read_again(run) -> None:
    generator, sensor = load(run / "run"), load_sensor(str(run / "mine.json"))
    as_learned = PixelSampling(range_temperature=1.0, range_noise=1.0, mask_correlation=0.0)
    once = generator.for_sensor(sensor).sample([3], sampling=as_learned)
    again = load(run / "run").for_sensor(sensor).sample([3], sampling=as_learned)
    assert torch.equal(once.range_m, again.range_m)
    assert once.sensor is sensor
    own = generator.sample([3]).range_m
    assert torch.equal(own, load(run / "run").sample([3]).range_m)
