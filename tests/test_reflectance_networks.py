"""Reflectance in the networks that complete and drop: marked, filled in, hinted, learned, written and scored."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load
from lidargrit.generation.objective import hidden_in_some
from lidargrit.generation.reflectance import TYPICAL_REFLECTANCE
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.fills import FILLS, fill, fill_lacking
from lidargrit.scans.marks import mark, read_marks
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.systems.completion.classical_features import classical_features
from lidargrit.systems.completion.network import CompletionNetwork, CompletionNetworkConfig
from lidargrit.systems.completion.system import Completion, CompletionConfig, CompletionObjective, random_patterns
from lidargrit.systems.lidargrit.system import TokenSampling
from lidargrit.systems.raydrop.network import RaydropNetwork, RaydropNetworkConfig
from lidargrit.systems.raydrop.system import Raydrop, RaydropConfig, RaydropObjective
from lidargrit.training.taken_stages import taken_stages
from tiny_runs import every_fourth_row, learn, save_bundle, the_one_line

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
NETWORK = CompletionNetworkConfig(
    widths=(8, 8, 8), blocks=1, attention_layers=0, heads=1, features=4, mask_width=4, row_channels=1, reflectance=True
)
RAYDROP = RaydropNetworkConfig(widths=(8, 8, 8), blocks=1, features=4, mask_width=4, row_channels=1, reflectance=True)


def streets(count: int) -> RangeImage:
    """Return walls with drops, brighter from below to above and on one side."""
    rng = torch.Generator().manual_seed(1)
    angle = SENSOR.azimuth_rad + 6 * torch.rand(count, 1, 1, generator=rng)
    range_m = (10 + 5 * angle.cos()).expand(count, 64, 32)
    bright = (0.5 + 0.3 * angle.cos() - torch.arange(64)[:, None] / 400).expand(count, 64, 32)
    return RangeImage.masked(range_m, torch.rand(count, 64, 32, generator=rng) < 0.8, SENSOR, {"reflectance": bright})


def reflectance_of(images: RangeImage) -> Tensor:
    assert images.reflectance is not None
    return images.reflectance


def by_point(scan: Scan) -> dict[tuple[float, ...], float]:
    assert scan.reflectance is not None
    points = (tuple(point) for point in scan.points_xyz_m.tolist())
    return dict(zip(points, scan.reflectance.tolist(), strict=True))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Write two scans, and runs whose networks complete and drop with reflectance and without."""
    root = tmp_path_factory.mktemp("reflectance")
    for number in (0, 1):
        KittiBin.write(root / f"scans/{number}.bin", unproject(streets(2)[number]))
    torch.manual_seed(0)
    for name, bright in (("run", True), ("plain", False)):
        completion = replace(NETWORK, reflectance=bright, labels=not bright)
        save_bundle(root / name, SENSOR, completion, replace(RAYDROP, reflectance=bright))
    return root


def test_marks_tell_every_hundredth_and_lost_returns_after_rounding():
    hundredths = torch.arange(100).float().expand(1, 1, 100) / 100
    returned = torch.arange(100).expand(1, 1, 100) % 7 > 0
    stored = (mark(returned, hundredths) * 255).round() / 255
    found = read_marks(stored)
    assert torch.equal(found.returned, returned)
    assert torch.equal((found.reflectance * 100).round() / 100, torch.where(returned, hundredths, 0.0))
    assert found.is_clear
    assert found.has_reflectance
    bare = read_marks(returned.float())  # files that mark returns alone
    assert torch.equal(bare.returned, returned)
    assert not bare.has_reflectance
    assert not read_marks(hundredths).is_clear  # an ordinary scan


def test_triangles_interpolate_reflectance_within_surfaces_and_others_take_the_nearest():
    elevation = SENSOR.elevation_rad.expand(64, 32)
    bright = 0.5 + 0.5 * elevation
    image = RangeImage.stack(
        [RangeImage(torch.full((64, 32), 9.0), torch.ones(64, 32) > 0, SENSOR, {"reflectance": bright})]
    )
    observed = torch.zeros(1, 64, 32, dtype=torch.bool)
    observed[:, ::3] = True
    known = Observed.of_pixels(image, observed)
    done = {method: reflectance_of(fill(method, known)) for method in FILLS}
    assert torch.allclose(done["triangulation"][0], bright, atol=1e-4)
    assert torch.equal(done["nearest"], done["linear"])
    assert set(done["nearest"].unique().tolist()) == set(bright[::3].unique().tolist())
    range_m = torch.full((64, 32), 5.0)
    range_m[:, 16:] = 40.0
    edge = RangeImage.stack([RangeImage(range_m, range_m > 0, SENSOR, {"reflectance": range_m / 50})])
    columns = torch.zeros(1, 64, 32, dtype=torch.bool)
    columns[:, :, ::3] = True
    filled = reflectance_of(fill("triangulation", Observed.of_pixels(edge, columns)))
    assert filled.unique().tolist() == pytest.approx([0.1, 0.8])


def test_hints_tell_the_reflectance_of_the_next_return_on_every_side():
    range_m, bright = torch.zeros(1, 64, 32), torch.zeros(1, 64, 32)
    range_m[0, 10, 4], range_m[0, 10, 30], range_m[0, 20, 6] = 5.0, 8.0, 11.0
    bright[0, 10, 4], bright[0, 10, 30], bright[0, 20, 6] = 0.2, 0.4, 0.8
    image = RangeImage(range_m, range_m > 0, SENSOR, {"reflectance": bright})
    found = classical_features(Observed.of_pixels(image, torch.ones_like(image.return_mask)))
    assert found.reflectances is not None
    assert found.reflectances[0, 1:, 10, 6].tolist() == pytest.approx([0.8, 0.8, 0.8, 0.2, 0.4])
    mirrored = found.mirrored().reflectances
    assert mirrored is not None
    assert mirrored[0, 1:, 10, 25].tolist() == pytest.approx([0.8, 0.8, 0.8, 0.4, 0.2])
    assert classical_features(Observed.nothing(SENSOR, 1)).reflectances is None


@torch.no_grad()
def test_the_loss_counts_hidden_returns_alone():
    torch.manual_seed(0)
    network, images = CompletionNetwork(NETWORK, SENSOR), streets(2)
    terms = CompletionObjective(network, SENSOR).eval()(Example(images), torch.Generator().manual_seed(4))
    rng = torch.Generator().manual_seed(4)
    observed = random_patterns(2, 64, 32, rng)
    known = Observed.of_pixels(images, observed)
    assert known.reflectance is not None
    known = replace(known, planes={"reflectance": hidden_in_some(known.reflectance, TYPICAL_REFLECTANCE, 0.25, rng)})
    found = network(classical_features(known), observed).reflectance
    assert found is not None
    true, errors = reflectance_of(images), []
    for scan in range(2):
        of_scan = []
        for row, column in np.ndindex(64, 32):
            if images.return_mask[scan, row, column] and not observed[scan, row, column]:
                of_scan.append(abs(float(found[scan, row, column]) - float(true[scan, row, column])))
        errors.append(sum(of_scan) / len(of_scan))
    assert float(terms["reflectance_error"]) == pytest.approx(sum(errors) / 2, rel=1e-4)


def test_it_learns_reflectance_and_begins_near_triangulation():
    torch.manual_seed(0)
    network, images = CompletionNetwork(NETWORK, SENSOR), streets(4)
    known = every_fourth_row(images)
    both = ~known.return_observed & images.return_mask
    with torch.no_grad():
        begun = network(classical_features(known), known.return_observed).reflectance
    assert begun is not None
    triangulated = fill("triangulation", known)
    both &= triangulated.return_mask
    found, true = reflectance_of(triangulated), reflectance_of(images)
    assert float((begun - found)[both].abs().mean()) < 0.01
    assert float((found - true)[both].abs().mean()) < 0.01
    objective = CompletionObjective(network, SENSOR).train()
    errors = [terms["reflectance_error"] for terms in learn(objective, images, [0] * 12, 3e-3)]
    assert errors[-1] < 0.9 * errors[0]
    with pytest.raises(ConfigError, match=r"without reflectance, for a model of model\.completion\.reflectance=true"):
        objective(Example(images.with_planes(reflectance=None)), torch.Generator())


@torch.no_grad()
def test_without_it_nothing_grows_and_with_it_ranges_begin_the_same():
    torch.manual_seed(0)
    plain = CompletionNetwork(replace(NETWORK, reflectance=False), SENSOR).eval()
    grown = CompletionNetwork(NETWORK, SENSOR).eval()
    assert plain.state_dict().keys() < grown.state_dict().keys()
    grown.load_state_dict({**grown.state_dict(), **plain.state_dict()})
    known = every_fourth_row(streets(1))
    one, other = (net.sample(known, [torch.Generator().manual_seed(3)]) for net in (plain, grown))
    assert torch.equal(one.range_m, other.range_m)
    assert one.reflectance is None
    by_triangulation, one = fill("triangulation", known), fill_lacking(one, known)
    both = one.return_mask & by_triangulation.return_mask
    assert both.any()
    assert one.reflectance is not None
    assert by_triangulation.reflectance is not None
    assert other.reflectance is not None
    assert torch.equal(one.reflectance[both], by_triangulation.reflectance[both])
    assert not torch.equal(other.reflectance, one.reflectance)


def test_observed_reflectance_is_kept_bit_for_bit_and_scans_without_it_get_none(folders):
    model, images = load(folders / "run"), streets(2)
    known = every_fourth_row(images)
    done = model.complete(known, [3, 4]).reflectance
    assert done is not None
    assert images.reflectance is not None
    observed = known.return_observed
    assert torch.equal(done[observed], images.reflectance[observed])
    assert 0 <= float(done.min()) <= float(done.max()) <= 1
    assert bool((done[~observed] > 0).any())
    assert model.complete(every_fourth_row(images.with_planes(reflectance=None)), [3, 4]).reflectance is None
    plain = load(folders / "plain").complete(known, [3, 4]).reflectance
    assert plain is not None
    assert torch.equal(plain[observed], images.reflectance[observed])


def test_raydrop_learns_reflectance_from_marks():
    torch.manual_seed(0)
    images = streets(3)
    assert images.reflectance is not None
    returned = images.return_mask & (torch.arange(32) % 3 > 0)
    marked = images.with_planes(reflectance=mark(returned, images.reflectance))
    objective = RaydropObjective(RaydropNetwork(RAYDROP, SENSOR), SENSOR).eval()
    rng = torch.Generator().manual_seed(0)
    with torch.no_grad():
        found = objective.raydrop(images.range_m, images.return_mask).reflectance
        terms = objective(Example(marked), rng)
    errors = [float((found - images.reflectance)[scan][returned[scan]].abs().mean()) for scan in range(3)]
    assert float(terms["reflectance_error"]) == pytest.approx(sum(errors) / 3, rel=1e-4)
    learned = [terms["reflectance_error"] for terms in learn(objective.train(), marked, range(12), 1e-2)]
    assert learned[-1] < 0.8 * learned[0]
    with pytest.raises(ConfigError, match=r"without their reflectance, for model\.raydrop\.reflectance=true"):
        objective(Example(images.with_planes(reflectance=returned.float())), rng)
    plain = RaydropObjective(RaydropNetwork(replace(RAYDROP, reflectance=False), SENSOR), SENSOR).eval()
    with torch.no_grad():  # files that mark returns alone are the same to a network without reflectance
        by_marks, bare = (
            plain(Example(images.with_planes(reflectance=marks)), torch.Generator().manual_seed(0))
            for marks in (marked.reflectance, returned.float())
        )
    assert by_marks["loss"] == bare["loss"]
    real = RaydropObjective(RaydropNetwork(replace(RAYDROP, surfaces="estimated"), SENSOR), SENSOR).eval()
    assert float(real(Example(images), rng)["reflectance_error"]) > 0


def test_raydrop_writes_the_reflectance_of_the_network_and_not_that_of_the_simulator(folders, tmp_path):
    words = ["raydrop", f"{folders}/scans", "--device", "cpu", "--seed", "2"]
    for name in ("run", "plain"):
        assert main([*words[:2], f"{tmp_path}/{name}", "--model", f"{folders}/{name}", *words[2:]]) == 0
    clean, bright, plain = (
        KittiBin.read(folder / "1.bin") for folder in (folders / "scans", tmp_path / "run", tmp_path / "plain")
    )
    own = by_point(clean)
    read = [(value, own[point]) for point, value in by_point(bright).items()]
    assert len(read) > 100
    assert sum(found == before for found, before in read) < 0.1 * len(read)
    assert all(own[point] == value for point, value in by_point(plain).items())


def test_complete_writes_it_and_its_error_is_told_where_both_have_it(folders, tmp_path, capsys):
    words = ["complete", f"{folders}/scans", f"{tmp_path}/out", "--observed", "rows:4", "--device", "cpu"]
    assert main([*words, "--model", f"{folders}/run"]) == 0
    before, after = (KittiBin.read(root / "0.bin") for root in (folders / "scans", tmp_path / "out"))
    own, values = by_point(before), by_point(after)
    kept = own.keys() & values.keys()
    assert len(kept) > 300
    assert all(own[point] == values[point] for point in kept)
    assert any(values[point] > 0 for point in values.keys() - kept)
    capsys.readouterr()
    models = [f"{folders}/run", f"{folders}/plain", "triangulation"]
    settings = ["--protocol", "completion", "--reference", f"{folders}/scans", "--observed", "rows:4", "-n", "2"]
    assert main(["compare", str(tmp_path / "one"), *models, *settings, "--device", "cpu"]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = next(index for index, line in enumerate(lines) if "reflectance MAE" in line)
    head, run, plain, triangles = lines[first : first + 4]
    column = slice(head.index("reflectance MAE") - 10, head.index("reflectance MAE") + 15)
    errors = [line[column].split() for line in (run, plain, triangles)]
    assert 0 < float(errors[2][0]) < float(errors[0][0]) + 0.05
    assert 0 < float(errors[1][0]) < 1
    assert main(["compare", str(tmp_path / "two"), f"{folders}/plain/lidargrit", *settings]) == 0  # it has learned none
    assert "reflectance MAE" in capsys.readouterr().out


def test_what_a_generator_does_not_write_is_filled_in_from_observed_returns(folders):
    model, scans = load(folders / "plain"), streets(2)
    label = torch.where(scans.return_mask, torch.where(torch.arange(64)[:, None] < 32, 40, 50), 0)
    scans, observed = scans.with_planes(label=label), torch.zeros(2, 64, 32, dtype=torch.bool)
    observed[:, ::4] = True
    known = Observed.of_pixels(scans, observed)
    done = model.complete(known, [3, 4], TokenSampling())
    assert done.label is not None
    assert known.label is not None
    assert torch.equal(reflectance_of(done)[observed], reflectance_of(scans)[observed])
    assert torch.equal(done.label[observed], known.label[observed])
    new, classical = done.return_mask & ~observed, fill("triangulation", known)
    both = new & classical.return_mask
    assert classical.label is not None
    assert int(both.sum()) > 100
    assert torch.equal(reflectance_of(done)[both], reflectance_of(classical)[both])
    assert torch.equal(done.label[both], classical.label[both])
    assert not bool(reflectance_of(done)[~done.return_mask].any())
    bare = model.complete(replace(known, planes={}), [3, 4], TokenSampling())
    assert bare.reflectance is None
    assert bare.label is None
    assert torch.equal(bare.range_m, done.range_m)
    none = torch.zeros_like(scans.return_mask[1:])
    lost = RangeImage.masked(scans.range_m[1:], none, SENSOR, scans[1:].planes)
    mixed = Observed.of_pixels(RangeImage.cat([scans[:1], lost]), observed)
    alone, together = model.complete(mixed[1:2], [4]), model.complete(mixed, [3, 4])
    assert not bool(reflectance_of(alone).any()), "no observed pixel returned"
    assert torch.equal(reflectance_of(together)[1:], reflectance_of(alone)), "whatever else is completed"
    dark = model.complete(Observed.of_pixels(scans, torch.zeros_like(observed)), [3, 4])
    assert dark.reflectance is None, "nothing tells the reflectance where no return was observed"


def test_a_stage_may_start_from_weights_that_lack_it_but_not_lose_it(folders):
    def preset(run: str, model: Completion | Raydrop, frozen: str = "") -> Preset:
        name = model.public_name()
        fit = TrainingConfig(scans=2, batch_size=2, learning_rate=1e-3, start=f"{frozen}{folders / run / name}")
        return Preset("grown", name, model.config, DataConfig(), {name: fit})

    grown = Raydrop(RaydropConfig(replace(RAYDROP, labels=True)), SENSOR)
    taken = taken_stages(preset("plain", grown), grown)["raydrop"]
    assert taken.state_dict().keys() < grown.objective("raydrop").state_dict().keys()
    other = Completion(CompletionConfig(replace(NETWORK, reflectance=True)), SENSOR)
    with pytest.raises(ConfigError, match=r"whose completion is another \(model\.completion\.labels=True\)"):
        taken_stages(preset("plain", other, "frozen:"), other)  # the stage is not fine-tuned
    less = Raydrop(RaydropConfig(replace(RAYDROP, reflectance=False)), SENSOR)
    with pytest.raises(ConfigError, match=r"whose raydrop is another \(model\.raydrop\.reflectance=True\)"):
        taken_stages(preset("run", less), less)


def test_a_wrong_setting_is_refused_in_one_line(tmp_path, capsys):
    words = ["train", "completion_compact", str(tmp_path / "no"), "--set", "model.completion.reflectance=perhaps"]
    assert main(words) == 2
    the_one_line(capsys.readouterr().err, "train")
