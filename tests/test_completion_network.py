"""The network that completes scans: it begins at triangulation, learns, samples its mask by seed, and is a run."""

from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.run_folder import locate
from lidargrit.generation.generator import load, load_class
from lidargrit.generation.pixel_decoder.mask_network import MaskNetwork
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.scans import fills
from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import fill
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.completion.classical_features import classical_features
from lidargrit.systems.completion.network import CompletionNetwork, CompletionNetworkConfig
from lidargrit.systems.completion.system import Completion, CompletionConfig, CompletionObjective, random_patterns
from lidargrit.systems.lidargrit.system import TokenSampling
from lidargrit.systems.ultralidar.system import UltraLidar
from lidargrit.training.taken_stages import taken_stages
from tiny_runs import learn, save_bundle

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
TINY = CompletionNetworkConfig(
    widths=(8, 8, 8), blocks=1, attention_layers=1, heads=2, features=4, mask_width=4, row_channels=1
)


def scans(count: int) -> RangeImage:
    """Return smooth walls with drops."""
    rng = torch.Generator().manual_seed(1)
    angle = SENSOR.azimuth_rad + 6 * torch.rand(count, 1, 1, generator=rng)
    range_m = (10 + 5 * angle.cos()).expand(count, 64, 32)
    return RangeImage.masked(range_m, torch.rand(count, 64, 32, generator=rng) < 0.8, SENSOR)


def rows_of(images: RangeImage) -> Observed:
    observed = torch.zeros_like(images.return_mask)
    observed[:, 2::4] = True
    return Observed.of_pixels(images, observed)


def made() -> CompletionNetwork:
    torch.manual_seed(0)
    return CompletionNetwork(TINY, SENSOR).eval()


@pytest.mark.parametrize("name", ["completion", "raydrop", "interpolation", "ultralidar", "lidargrit"])
def test_scans_that_are_computed_one_by_one_cost_no_copies(name, monkeypatch):
    """They fill a batch up to its size; a GPU's has 8 scans if the caller names no other."""
    cls, counted = load_class(name), []
    config = cls.smallest_config(SENSOR)
    generator = cls(replace(config, pixels=PixelDecoderConfig(mask_width=4)) if name == "lidargrit" else config, SENSOR)
    for owner, each in ((MaskNetwork, "sample"), (fills.SeenScan, "of"), (UltraLidar, "_voxels")):
        monkeypatch.setattr(owner, each, counting(getattr(owner, each), counted))
    sampling = replace(cls.quickest_sampling(), batch_size=8)
    if cls.has_new_scans:
        generator.sample([1], sampling=sampling)
    else:
        kind = Observed.of_surfaces if name == "raydrop" else rows_of
        generator.complete(kind(scans(1)), [1], sampling)
    assert len(counted) == (2 if name == "completion" else 1)  # the classical features, then the mask


def counting(function, counted):
    def call(*arguments, **named):
        counted.append(function)
        return function(*arguments, **named)

    return call


def test_hints_tell_the_next_return_on_every_side():
    range_m = torch.zeros(1, 64, 32)
    range_m[0, 10, 4], range_m[0, 10, 30], range_m[0, 20, 6] = 5.0, 8.0, 11.0
    image = RangeImage(range_m, range_m > 0, SENSOR)
    classical = classical_features(Observed.of_pixels(image, torch.ones_like(image.return_mask)))
    above, below, left, right = classical.candidates[0, 3:7, 10, 6].expm1().tolist()
    assert (below, left, right) == pytest.approx((11.0, 5.0, 8.0))
    assert above == pytest.approx(float(classical.candidates[0, 0, 10, 6].expm1()))  # nothing above: as triangulated
    assert classical.maps[0, 9:13, 10, 6].tolist() == pytest.approx([4.0, 10 / 16, 2 / 16, 24 / 16])
    assert float(classical_features(Observed.nothing(SENSOR, 1)).maps.abs().max()) == 0


def test_hints_of_the_mirror_image_are_those_of_mirrored_scans():
    images = scans(1)
    known = Observed.of_pixels(images, torch.rand(1, 64, 32, generator=torch.Generator().manual_seed(0)) < 0.2)
    there = RangeImage(known.range_m.flip(-1), known.return_mask.flip(-1), SENSOR)
    mirrored, wanted = (
        classical_features(known).mirrored(),
        classical_features(Observed.of_pixels(there, known.return_observed.flip(-1))),
    )
    exact = [
        0,
        1,
        2,
        *range(9, 15),
    ]  # the others depend on which of two equally near returns, or of two tilings, counts
    assert torch.allclose(mirrored.maps[:, exact], wanted.maps[:, exact], atol=1e-6)
    for one, other in zip((mirrored.maps, mirrored.candidates), (wanted.maps, wanted.candidates), strict=True):
        assert float(((one - other).abs() > 1e-3).float().mean()) < 0.1


@torch.no_grad()
def test_it_begins_near_triangulation_and_a_scan_depends_on_its_seed_alone():
    network, known = made(), rows_of(scans(3))
    seeds = [torch.Generator().manual_seed(seed) for seed in (5, 6, 5)]
    together = network.sample(known, seeds)
    alone = network.sample(known[1:2], [torch.Generator().manual_seed(6)])
    assert torch.equal(together.range_m[1], alone.range_m[0])
    triangles = fill("triangulation", known)
    both = together.return_mask & triangles.return_mask
    assert float((together.range_m - triangles.range_m)[both].abs().mean()) < 1.5
    assert torch.equal(together.return_mask[known.return_observed], known.return_mask[known.return_observed])


def test_the_likelihood_of_the_mask_counts_unknown_pixels_alone():
    network, images = made(), scans(2)
    known = rows_of(images)
    point = network(classical_features(known), known.return_observed)
    nats = network.mask.nats(point.guide, images.return_mask, None)
    assert nats.shape == (2,)
    rng = torch.Generator().manual_seed(0)
    estimates = torch.stack([network.mask.nats(point.guide, images.return_mask, rng) for _ in range(40)])
    assert torch.allclose(estimates.mean(0), nats, rtol=0.1)
    whole = Observed.of_pixels(images, torch.ones_like(images.return_mask))
    point = network(classical_features(whole), whole.return_observed)
    assert network.mask.nats(point.guide, images.return_mask, None).tolist() == [0, 0]


def test_it_learns():
    objective, images = CompletionObjective(made(), SENSOR).train(), scans(4)
    every = torch.ones_like(images.return_mask)
    images = RangeImage(torch.where(images.return_mask, images.range_m, 9.0), every, SENSOR)  # nothing drops
    losses = [terms["loss"] for terms in learn(objective, images, [0] * 12, 3e-3)]
    assert losses[-1] < 0.8 * losses[0]
    assert all(weight.grad is not None for weight in objective.completion.unet.parameters())


def test_more_attention_than_blocks_is_refused():
    with pytest.raises(ConfigError, match="3 layers of attention of 4 heads, 128 channels; wanted at most 2 layers"):
        CompletionNetworkConfig(blocks=2, attention_layers=3)


def test_training_hides_rows_sectors_boxes_and_pixels():
    masks = random_patterns(90, 64, 32, torch.Generator().manual_seed(0))
    rows = (masks == masks[:, :, :1]).all((1, 2))
    sectors = (masks == masks[:, :1]).all((1, 2))
    boxes = ~rows & ~sectors & masks.all(2).any(1)  # some rows are whole
    assert 22 < int(rows.sum()) < 46
    assert 12 < int(sectors.sum()) < 36
    assert 4 < int(boxes.sum()) < 24
    assert 12 < int((~rows & ~sectors & ~boxes).sum()) < 36
    assert bool(masks.flatten(1).any(1).all())
    assert not bool(masks.flatten(1).all(1).any())


def test_a_bundle_completes_each_scan_by_the_run_for_what_is_known_of_it(tmp_path):
    torch.manual_seed(0)
    save_bundle(tmp_path, SENSOR, TINY)
    bundle, alone, tokens = load(tmp_path), load(tmp_path, "complete"), load(tmp_path / "lidargrit")
    assert (bundle.public_name(), alone.public_name()) == ("lidargrit", "completion")
    known = rows_of(scans(2))
    done, by_tokens = bundle.complete(known, [1, 2]), tokens.complete(known, [1, 2])
    observed = known.return_observed
    assert torch.equal(done.range_m[observed], known.images.range_m[observed])
    assert torch.equal(done.range_m, alone.complete(known, [1, 2]).range_m)
    assert not torch.equal(done.range_m, by_tokens.range_m)
    assert torch.equal(bundle.complete(known, [1, 2], TokenSampling()).range_m, by_tokens.range_m)
    mixed = Observed.cat([known[:1], Observed.nothing(SENSOR, 1), known[1:]])
    together = bundle.complete(mixed, [1, 7, 2])
    assert torch.equal(together.range_m[[0, 2]], done.range_m)
    assert torch.equal(together.range_m[1], tokens.sample([7]).range_m[0])
    clean = Observed.of_surfaces(scans(1))  # there is no run for it
    assert torch.equal(bundle.complete(clean, [0]).range_m, tokens.complete(clean, [0]).range_m)
    assert locate(tmp_path, "raydrop") == locate(tmp_path) == tmp_path / "lidargrit"


@pytest.mark.parametrize(
    "runs",
    ['{"complete": "completion"}', '{"sample": "../x"}', '{"sample": 3}', '{"sample": ["lidargrit"]}', "[]", "{"],
)
def test_a_bundle_that_names_no_run_that_samples_or_one_elsewhere_is_refused(tmp_path, runs):
    save_bundle(tmp_path, SENSOR, TINY)
    (tmp_path / "bundle.json").write_text(runs)
    with pytest.raises(CheckpointError, match=r"bundle\.json"):
        load(tmp_path)


def test_what_only_completes_scans_samples_none():
    for name in ("completion", "raydrop", "interpolation"):
        cls = load_class(name)
        with pytest.raises(ConfigError, match=rf"got no condition for '{name}'; wanted one of type Observed; "):
            cls(cls.smallest_config(SENSOR), SENSOR).sample([0])


def test_training_starts_from_a_network_of_other_columns(tmp_path):
    torch.manual_seed(0)
    given = Completion(CompletionConfig(TINY), SENSOR)
    given.save(tmp_path)
    wide = DataConfig(columns=64)
    fit = TrainingConfig(scans=2, batch_size=2, learning_rate=1e-3, start=str(tmp_path))
    tuned = Preset("a test", "completion", CompletionConfig(TINY), wide, {"completion": fit})
    preset = replace(tuned, training={"completion": replace(fit, start=f"frozen:{tmp_path}")})
    taken = taken_stages(tuned, tuned.build_generator())["completion"]
    for name, weight in given.objective("completion").state_dict().items():
        assert torch.equal(taken.state_dict()[name], weight), name
    with pytest.raises(ConfigError, match=r"whose completion is another \(data.sensor\)"):
        taken_stages(preset, preset.build_generator())
    fewer_rows = replace(tuned, data=replace(wide, sensor="vlp16"))
    with pytest.raises(ConfigError, match=r"whose completion is another \(data.sensor\)"):
        taken_stages(fewer_rows, fewer_rows.build_generator())
