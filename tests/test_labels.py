"""Labels as one more channel: projected, prepared, hidden, completed, dropped, exported and scored."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.data.datasets.folder import Folder
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.formats.numpy_array import NumpyArray
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.plan import pixels_name
from lidargrit.data.prepared.prepare import damaged_shards, prepare
from lidargrit.data.prepared.prepared import PreparedImages
from lidargrit.data.scan_folder import KittiTree
from lidargrit.generation.generator import load
from lidargrit.scans.classes import LEARNED
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.fills import fill, fill_lacking
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.completion.classical_features import classical_features
from lidargrit.systems.completion.network import CompletionNetwork, CompletionNetworkConfig
from lidargrit.systems.completion.system import CompletionObjective
from lidargrit.systems.raydrop.network import RaydropNetwork, RaydropNetworkConfig
from lidargrit.systems.raydrop.system import RaydropObjective
from tiny_runs import every_fourth_row, learn, save_bundle

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
NETWORK = CompletionNetworkConfig(
    widths=(8, 8, 8), blocks=1, attention_layers=0, heads=1, features=4, mask_width=4, row_channels=1, labels=True
)
RAYDROP = RaydropNetworkConfig(widths=(8, 8, 8), blocks=1, features=4, mask_width=4, row_channels=1, labels=True)
ROAD, BUILDING, MOVING_CAR = 40, 50, 252


def streets(count: int) -> RangeImage:
    """Return a road below and a wall above it, with drops."""
    rng = torch.Generator().manual_seed(1)
    angle = SENSOR.azimuth_rad + 6 * torch.rand(count, 1, 1, generator=rng)
    range_m = (10 + 5 * angle.cos()).expand(count, 64, 32)
    label = torch.where(torch.arange(64)[:, None] < 30, BUILDING, ROAD).expand(count, 64, 32)
    returned = torch.rand(count, 64, 32, generator=rng) < 0.8
    return RangeImage.masked(range_m, returned, SENSOR, {"label": label})


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Write a KITTI tree of two labelled scans, and a run whose networks see classes."""
    root = tmp_path_factory.mktemp("labels")
    for number in (0, 1):
        scan = unproject(streets(2)[number])
        assert scan.label is not None
        instance = torch.arange(len(scan)) % 7 << 16
        KittiTree(root / "tree").write(
            f"sequences/00/velodyne/{number:06d}.bin", replace(scan, label=scan.label | instance)
        )
    torch.manual_seed(0)
    save_bundle(root / "run", SENSOR, NETWORK, RAYDROP)
    return root


def test_a_pixel_has_the_class_of_its_point_through_projection_and_preparation(folders, tmp_path):
    source = f"kitti_odometry:{folders / 'tree'}"
    scan = KittiOdometry(folders / "tree").scan(0)
    assert scan.label is not None
    assert int(scan.label.max()) > 0xFFFF
    image = project(scan, SENSOR, "spherical")
    assert image.label is not None
    back = unproject(image)
    assert back.label is not None
    assert back.ring is not None
    assert set(back.label.tolist()) == {ROAD, BUILDING}
    assert bool(((back.label == BUILDING) == (back.ring < 30)).all())
    config = DataConfig(train=(source,), projection="spherical", workers=1)
    folder = prepare(source, config, tmp_path / "prepared", sensor=replace(SENSOR, projection="spherical"))
    store = PreparedImages(str(folder))
    pixels = store.read(0, verify=True)
    assert np.array_equal(pixels.planes["label"], image.label.numpy())
    labels = folder / pixels_name("label", 0)
    content = bytearray(labels.read_bytes())
    content[30] ^= 255
    labels.write_bytes(content)
    assert damaged_shards(folder) == [0]


def test_a_flip_and_a_batch_keep_the_class_of_a_pixel():
    images = streets(2)
    joined = RangeImage.stack([images[1], images[0]]).mapped(lambda pixels: pixels.flip(-1))
    assert joined.label is not None
    assert images.label is not None
    assert torch.equal(joined.label[0].flip(-1), images.label[1])
    assert RangeImage.stack([images[0], images[1].with_planes(label=None)]).label is None


def test_hints_tell_the_class_of_the_next_return_on_every_side():
    range_m = torch.zeros(1, 64, 32)
    range_m[0, 10, 4], range_m[0, 10, 30], range_m[0, 20, 6] = 5.0, 8.0, 11.0
    label = torch.zeros(1, 64, 32, dtype=torch.int64)
    label[0, 10, 4], label[0, 10, 30], label[0, 20, 6] = 40, 50, 70
    image = RangeImage(range_m, range_m > 0, SENSOR, {"label": label})
    found = classical_features(Observed.of_pixels(image, torch.ones_like(image.return_mask)))
    assert found.labels is not None
    assert found.labels[0, :, 10, 6].tolist() == [70, 70, 70, 40, 50]  # nothing above: as the nearest, that below
    mirrored = found.mirrored().labels
    assert mirrored is not None
    assert mirrored[0, :, 10, 25].tolist() == [70, 70, 70, 50, 40]


def test_it_learns_classes_and_begins_with_those_of_neighbours():
    torch.manual_seed(0)
    objective, images = CompletionObjective(CompletionNetwork(NETWORK, SENSOR), SENSOR).train(), streets(4)
    accuracies = [terms["class_accuracy"] for terms in learn(objective, images, [0] * 12, 3e-3)]
    assert 0.4 < accuracies[0] < 0.95
    assert accuracies[-1] > accuracies[0]
    with pytest.raises(ConfigError, match="training scans without labels"):
        objective(Example(images.with_planes(label=None)), torch.Generator())


def test_without_labels_in_the_model_nothing_grows_and_with_them_it_begins_the_same():
    torch.manual_seed(0)
    plain = CompletionNetwork(replace(NETWORK, labels=False), SENSOR).eval()
    grown = CompletionNetwork(NETWORK, SENSOR).eval()
    assert plain.state_dict().keys() < grown.state_dict().keys()
    grown.load_state_dict({**grown.state_dict(), **plain.state_dict()})
    known = every_fourth_row(streets(1))
    with torch.no_grad():
        one, other = (net.sample(known, [torch.Generator().manual_seed(3)]) for net in (plain, grown))
    assert torch.equal(one.range_m, other.range_m)
    assert one.label is None
    nearest, one = fill("nearest", known), fill_lacking(one, known)
    both = one.return_mask & nearest.return_mask
    assert one.label is not None
    assert nearest.label is not None
    assert torch.equal(one.label[both], nearest.label[both])
    assert other.label is not None


def test_a_labelled_tree_is_completed_as_a_labelled_tree(folders, tmp_path, capsys):
    words = ["complete", f"{folders}/tree", str(tmp_path / "out"), "--model", f"{folders}/run", "--observed", "rows:4"]
    assert main([*words, "--format", "kitti_odometry", "--device", "cpu"]) == 0
    before, after = (KittiOdometry(root).scan(0) for root in (folders / "tree", tmp_path / "out"))
    assert before.label is not None
    assert after.label is not None
    assert len(after) > len(before) // 2
    known = {tuple(point): int(label) for point, label in zip(before.points_xyz_m.tolist(), before.label, strict=True)}
    same = [
        known[tuple(point)] == int(label)
        for point, label in zip(after.points_xyz_m.tolist(), after.label, strict=True)
        if tuple(point) in known
    ]
    assert len(same) > 300
    assert all(same)  # with their instances
    assert set((after.label & 0xFFFF).tolist()) <= {0, *LEARNED}
    capsys.readouterr()
    assert main([*words[:2], str(tmp_path / "bin"), *words[3:], "--device", "cpu"]) == 0
    assert ".bin keeps no labels; --format kitti_odometry or npz keeps them" in capsys.readouterr().err


def test_a_scan_without_labels_gets_none(folders):
    model, images = load(folders / "run"), streets(1)
    known = every_fourth_row(images)
    with_labels = model.complete(known, [3]).label
    assert with_labels is not None
    observed = known.return_observed
    assert images.label is not None
    assert torch.equal(with_labels[observed], images.label[observed])
    assert model.complete(every_fourth_row(images.with_planes(label=None)), [3]).label is None


def test_raydrop_sees_classes_and_keeps_those_of_what_returns(folders, tmp_path):
    model, images = load(folders / "run"), streets(1)
    dropped = model.complete(Observed.of_surfaces(images), [0])
    assert dropped.label is not None
    assert images.label is not None
    assert torch.equal(dropped.label[dropped.return_mask], images.label[dropped.return_mask])
    NumpyArray.write(tmp_path / "clean/1.npz", unproject(images[0]))
    words = ["raydrop", f"{tmp_path}/clean", f"{tmp_path}/out", "--model", f"{folders}/run", "--device", "cpu"]
    assert main(words) == 0
    written = NumpyArray.read(tmp_path / "out/1.npz")
    assert written.label is not None
    assert set(written.label.tolist()) == {ROAD, BUILDING}


def test_raydrop_learns_what_a_class_does():
    torch.manual_seed(0)
    images = streets(3)
    assert images.label is not None
    marked = images.with_planes(reflectance=((images.label == ROAD) & images.return_mask).float())  # walls never return
    found = {}
    for labels in (False, True):
        network = RaydropNetwork(replace(RAYDROP, labels=labels), SENSOR)
        objective = RaydropObjective(network, SENSOR).train()
        optimiser = torch.optim.Adam(objective.parameters(), lr=3e-3)
        for step in range(8):
            shuffled = marked.mapped(lambda pixels, by=step: pixels.roll(8 * by, -2))  # rows tell nothing
            loss = objective(Example(shuffled), torch.Generator().manual_seed(step))["loss"]
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        found[labels] = network
    with torch.no_grad():
        surface, label = images.return_mask, images.label
        blind = found[True](images.range_m, surface).logits
        seeing = found[True](images.range_m, surface, label).logits
    gap = [
        float(x[surface & (label == ROAD)].mean() - x[surface & (label == BUILDING)].mean()) for x in (blind, seeing)
    ]
    assert gap[1] > gap[0] + 0.05
    with pytest.raises(ConfigError, match="labels=true with surfaces=estimated"):
        RaydropNetworkConfig(labels=True, surfaces="estimated")


def test_right_classes_are_counted_where_both_scans_return(folders, tmp_path, capsys):
    words = ["compare", str(tmp_path / "out"), "nearest", f"{folders}/run", "--protocol", "completion"]
    assert (
        main(
            [
                *words,
                "--reference",
                f"kitti_odometry:{folders / 'tree'}",
                "--observed",
                "rows:4",
                "-n",
                "2",
                "--device",
                "cpu",
            ]
        )
        == 0
    )
    table = capsys.readouterr().out
    assert "class accuracy" in table
    nearest = next(line for line in table.splitlines() if line.startswith("nearest")).split()
    assert 0.9 < float(nearest[-2]) < 1  # wrong only where road and wall meet
    assert 0.8 < float(nearest[-1]) < 1


@pytest.mark.parametrize("bad", [(0, np.nan), (3, np.nan), (slice(0, 3), 0.0)])
def test_labels_of_dropped_points_are_dropped(bad, tmp_path):
    """Of a coordinate that is not finite, of a reflectance that is not, and of the origin."""
    rows = np.random.default_rng(0).uniform(0.1, 1, (9, 4)).astype("<f4")
    rows[4, bad[0]] = bad[1]
    folder = tmp_path / "sequences" / "00"
    for name, data in (("velodyne/000000.bin", rows), ("labels/000000.label", np.arange(9, dtype="<u4"))):
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_bytes(data.tobytes())
    for dataset in (KittiOdometry(tmp_path, bad_points="drop"), Folder(folder, bad_points="drop")):
        scan = dataset.scan(0)
        assert scan.label is not None
        assert scan.label.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]


def test_rows_that_are_padded_with_zeros_have_labels_too(tmp_path):
    rows = np.zeros((9, 5), "<f4")
    rows[:, :3] = np.random.default_rng(0).uniform(0.1, 1, (9, 3))
    for name, data in (("velodyne/000000.bin", rows), ("labels/000000.label", np.arange(9, dtype="<u4"))):
        (tmp_path / "sequences/00" / name).parent.mkdir(parents=True)
        (tmp_path / "sequences/00" / name).write_bytes(data.tobytes())
    assert KittiOdometry(tmp_path).scan(0).label.tolist() == list(range(9))
