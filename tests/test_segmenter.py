"""The segmenter: it learns and resumes, labels every point, and its labels are scored and coloured."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.data import formats
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.data.scan_folder import KittiTree
from lidargrit.data.sources import open_source
from lidargrit.evaluation.metrics.shared.labelled import segmenter_of
from lidargrit.generation.semantic_classes import labels_of
from lidargrit.inference.segment import can_label, class_probabilities, label_images, open_segmenter
from lidargrit.inference.segment.command import GROUPS, LabelScores
from lidargrit.inference.segment.points import labels_of_points
from lidargrit.scans.classes import CLASSES
from lidargrit.scans.example import Example
from lidargrit.scans.projection import index_map, project
from lidargrit.scans.projection.pixel_coordinates import pixel_coordinates
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import simulate
from lidargrit.systems.segmenter.system import (
    Segmenter,
    SegmenterConfig,
    SegmenterNetworkConfig,
    SegmenterObjective,
    bends_across_columns,
)
from tiny_runs import learn, the_one_line

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(64)
TINY = SegmenterNetworkConfig((8, 8, 8), blocks=1, attention_layers=0, heads=1)
TRAIN = [
    "data.columns=64",
    "data.train=simulated:4:train",
    "data.val=simulated:1:val",
    "model.segmenter.widths=[8,8,8]",
    "model.segmenter.blocks=1",
    "model.segmenter.attention_layers=0",
    "training.segmenter.batch_size=2",
    "training.segmenter.warmup_scans=4",
    "training.segmenter.checkpoint_every=4",
    "training.segmenter.validate_every=8",
]


def made(sensor=SENSOR, config=TINY):
    torch.manual_seed(0)
    return Segmenter(SegmenterConfig(config), sensor).eval()


def scan_of(seed, columns=256):
    return simulate(seed=seed, sensor=load_sensor("hdl64e_kitti_odometry").with_columns(columns))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Train a toy in two goes, and in one, and return both runs."""
    root = tmp_path_factory.mktemp("segmenters")
    for name, goes in (("whole", (12,)), ("resumed", (6, 12))):
        for scans in goes:
            words = ["train", "segmenter_compact", str(root / name), "--set", *TRAIN]
            assert main([*words, f"training.segmenter.scans={scans}", "training.segmenter.schedule=constant"]) == 0
            if scans == 6:  # as if it had been stopped there: more scans make another preset, which is another run
                (root / name / "config.json").unlink()
                about = json.loads((root / name / "run.json").read_text())
                about["preset"]["training"]["segmenter"]["scans"] = 12
                (root / name / "run.json").write_text(json.dumps(about))
    return root


def test_it_learns_the_classes_of_streets():
    images = RangeImage.stack([project(scan_of(seed, 64), SENSOR) for seed in (1, 2)])
    objective = SegmenterObjective(made().segmenter, SENSOR).train()
    terms = learn(objective, images, range(60), 1e-2)
    assert terms[-1]["accuracy"] > max(0.5, 2 * terms[0]["accuracy"])
    assert terms[-1]["mean_iou"] > 2 * terms[0]["mean_iou"]
    found = made()
    found.load_stage("segmenter", objective)
    label = label_images(found, images).label
    assert label is not None
    learned = torch.tensor([[CLASSES[int(n)].learned for n in row] for row in images.label.flatten(1)]).view_as(label)
    known = learned > 0
    assert float((label == learned)[known].float().mean()) > 0.5
    assert not label[~images.return_mask].any()


def test_the_terms_are_those_of_a_loop():
    images = RangeImage.stack([project(scan_of(3, 64), SENSOR)])
    objective = SegmenterObjective(made(config=replace(TINY, reflectance=False)).segmenter, SENSOR).eval()
    with torch.no_grad():
        terms = objective(Example(images), torch.Generator())
    log_p = objective.segmenter(images.range_m).log_softmax(1)[0].tolist()
    order = sorted({each.learned for each in CLASSES.values()} - {0})
    nats, right, found = [[] for _ in order], [0] * 19, [0] * 19
    for row in range(64):
        for column in range(64):
            learned = CLASSES[int(images.label[0, row, column])].learned
            if learned:
                scores = [of_class[row][column] for of_class in log_p]
                true, best = order.index(learned), scores.index(max(scores))
                nats[true].append(-scores[true])
                right[true] += true == best
                found[best] += 1
    weights = [len(each) ** 0.5 if each else 0 for each in nats]
    mean = sum(w * sum(each) / len(each) for w, each in zip(weights, nats, strict=True) if each) / sum(weights)
    assert float(terms["loss"]) == pytest.approx(mean, rel=1e-4)
    assert float(terms["accuracy"]) == pytest.approx(sum(right) / sum(map(len, nats)))
    iou = [right[at] / (len(nats[at]) + found[at] - right[at]) for at in range(19) if nats[at]]
    assert float(terms["mean_iou"]) == pytest.approx(sum(iou) / len(iou), rel=1e-5)


def test_scans_without_a_label_teach_nothing():
    images = RangeImage.stack([project(scan_of(3, 64), SENSOR)])
    objective = SegmenterObjective(made(config=replace(TINY, reflectance=False)).segmenter, SENSOR)
    terms = objective(Example(images.with_planes(label=torch.zeros_like(images.label))), torch.Generator())
    terms["loss"].backward()
    assert all(float(term.detach()) == 0 for term in terms.values())
    assert all(float(weight.grad.abs().max()) == 0 for weight in objective.parameters())


def test_attention_that_the_network_cannot_have_is_refused():
    with pytest.raises(ConfigError, match="2 layers of attention of 4 heads, 96 channels; wanted at most 1 layers"):
        SegmenterNetworkConfig(blocks=1, attention_layers=2)
    with pytest.raises(ConfigError, match="heads that divide the channels"):
        SegmenterNetworkConfig(heads=5)
    assert SegmenterNetworkConfig(attention_layers=0, heads=5).heads == 5  # of no layer, as saved runs may have them


def test_a_resumed_training_gives_the_same_weights(run):
    one, other = (open_segmenter(str(run / name), "cpu") for name in ("whole", "resumed"))
    for name, weight in one.state_dict().items():
        assert torch.equal(weight, other.state_dict()[name]), name


def test_images_of_more_columns_are_labelled_by_votes_of_several(run):
    segmenter = open_segmenter(str(run / "whole"), "cpu")
    wide = SENSOR.with_columns(256)
    images = RangeImage.stack([project(scan_of(5), wide)])
    label = label_images(segmenter, images).label
    assert can_label(SENSOR, wide)
    assert not can_label(SENSOR, SENSOR.with_columns(96))
    assert not can_label(SENSOR, load_sensor("hdl64e_kitti_360").with_columns(64))
    of_class = torch.zeros(19, 64, 256)
    for first in range(4):
        some = [each[..., first::4] for each in (images.range_m, images.reflectance)]
        with torch.no_grad():
            of_class[..., first::4] = segmenter.segmenter(*some)[0].softmax(0)
    range_m, found, moved = images.range_m[0], class_probabilities(segmenter, images)[0], 0
    for row, column in np.ndindex(64, 256):
        own_m, votes = float(range_m[row, column]), []
        for other_row in range(max(row - 1, 0), min(row + 2, 64)):
            for step in (-2, -1, 0, 1, 2):
                other_m = float(range_m[other_row, (column + step) % 256])
                if other_m > 0 and abs(other_m - own_m) < 0.2 + 0.02 * own_m:
                    votes.append(of_class[:, other_row, (column + step) % 256])
        if own_m:
            wanted = torch.stack(votes).mean(0)
            assert torch.allclose(found[:, row, column], wanted, atol=1e-6), (row, column)
            assert label[0, row, column] in labels_of((wanted > wanted.max() - 1e-6).nonzero()[:, 0] + 1)
            moved += not torch.allclose(wanted, of_class[:, row, column], atol=1e-3)
    assert moved > 1000
    assert not label[~images.return_mask].any()
    narrow = RangeImage.stack([project(scan_of(5), SENSOR)])
    assert torch.equal(class_probabilities(segmenter, narrow), segmenter.probabilities(narrow))
    for wrong in (narrow[0], narrow[:0]):
        with pytest.raises(ConfigError, match=r"^got range images of shape .* at least one; make a batch"):
            label_images(segmenter, wrong)


def test_bends_are_those_of_a_loop_and_nearly_none_on_a_wall():
    range_m = torch.from_numpy(np.random.default_rng(0).uniform(2, 60, (2, 4, 16)).astype(np.float32))
    range_m[:, 1, ::3] = 0
    found = bends_across_columns(range_m)
    for image, row, column in np.ndindex(2, 4, 16):
        left, own, right = (float(range_m[image, row, (column + step) % 16]) for step in (-1, 0, 1))
        bend = own * (1 / left + 1 / right) / 2 - 1 if left and own and right else 0.0
        wanted = math.copysign(math.log1p(abs(bend) / 0.005) / 3, bend)
        assert float(found[image, row, column]) == pytest.approx(wanted, abs=1e-4)
    turn = torch.linspace(-1, 1, 201)  # a wall 10 m ahead, in columns of half a degree
    wall = (10 / turn.cos()).expand(1, 1, -1)
    assert bends_across_columns(wall)[..., 1:-1].abs().max() < 0.01
    rough = wall + 0.3 * torch.randn(wall.shape, generator=torch.Generator().manual_seed(0))
    assert bends_across_columns(rough)[..., 1:-1].abs().median() > 0.3


def test_every_point_has_the_label_of_the_nearest_return_along_its_ray():
    sensor, scan = SENSOR.with_columns(64), scan_of(7)
    image = project(scan, sensor, "unfolding")
    at = torch.from_numpy(index_map(scan, sensor, "unfolding").astype(np.int64))
    image = image.with_planes(label=torch.where(image.return_mask, torch.arange(64 * 64).view(64, 64) % 81 + 1, 0))
    pixels = pixel_coordinates(scan, sensor, "unfolding", "exact")
    found = labels_of_points(image, at, pixels)
    kept = {int(point) for point in at.flatten() if point >= 0}
    assert len(kept) < len(scan) / 2
    for point in [*sorted(kept)[::50], *range(0, len(scan), 97)]:
        row, column = int(pixels.row[point]), int(pixels.column[point])
        if point in kept:
            assert int(found[point]) == int(image.label[row, column])
            continue
        for rows, columns in ((1, 2), (3, 8)):
            near = [
                (abs(float(image.range_m[r, c % 64]) - float(pixels.range_m[point])), int(image.label[r, c % 64]))
                for r in range(max(row - rows, 0), min(row + rows, 63) + 1)
                for c in range(column - columns, column + columns + 1)
                if image.return_mask[r, c % 64]
            ]
            if near:
                break
        least = min(near)[0] if near else None
        assert int(found[point]) in ({label for apart, label in near if apart == least} if near else {0})


def test_the_verb_writes_a_label_for_every_point_and_goes_on(run, tmp_path, capsys):
    for number in (0, 1):
        KittiTree(tmp_path / "in").write(f"sequences/00/velodyne/{number:06d}.bin", scan_of(number))
    words = ["segment", str(tmp_path / "in"), str(tmp_path / "out"), "--model", str(run / "whole"), "--device", "cpu"]
    assert main([*words, "--compare", "semantic_kitti", "--json", str(tmp_path / "found.json")]) == 0
    labels = sorted(tmp_path.glob("out/sequences/00/labels/*.label"))
    assert [path.name for path in labels] == ["000000.label", "000001.label"]
    scores = LabelScores()
    for path in labels:
        found, true = (
            torch.from_numpy(np.fromfile(each, "<u4").astype(np.int64))
            for each in (path, tmp_path / "in/sequences/00/labels" / path.name)
        )
        scores.add(found, true & 0xFFFF)
    assert json.loads((tmp_path / "found.json").read_text())["mean"] == scores.mean()
    scan = formats.read_scan(tmp_path / "in/sequences/00/velodyne/000000.bin")
    by_function = lidargrit.segment(scan, str(run / "whole"))
    assert by_function.label is not None
    assert np.array_equal(by_function.label, np.fromfile(labels[0], "<u4"))
    assert torch.equal(by_function.points_xyz_m, scan.points_xyz_m)
    before = labels[0].read_bytes()
    labels[0].unlink()
    (tmp_path / "out/sequences/00/velodyne/000000.bin").unlink()
    assert main(words) == 0
    assert labels[0].read_bytes() == before
    assert main([*words, "--projection", "spherical"]) == 2
    assert "segmented.json has another 'projection'" in capsys.readouterr().err
    (tmp_path / "in/sequences/00/velodyne/000000.bin").write_bytes(b"cut")  # the labels of the next one are looked at
    skipping = ["segment", str(tmp_path / "in"), str(tmp_path / "skipped"), *words[3:], "--bad-scans", "skip"]
    assert main([*skipping, "--compare", "semantic_kitti"]) == 0
    assert [path.name for path in tmp_path.glob("skipped/sequences/00/velodyne/*")] == ["000001.bin"]
    page = tmp_path / "page.html"
    assert main(["view", str(tmp_path / "out"), "-o", str(page), "--set", "data.columns=64"]) == 0
    assert any(f'"{CLASSES[int(n)].name}"' in page.read_text() for n in np.unique(np.fromfile(labels[0], "<u4")) if n)


def test_a_labelled_tree_tells_the_sensor_of_its_segmenter(tmp_path):
    pandar = load_sensor("pandar64")
    made(pandar.with_columns(64)).save(tmp_path / "run")
    write_drives(tmp_path / "in", 1, DriveConfig(pandar.with_columns(64)))
    assert main(["segment", str(tmp_path / "in"), str(tmp_path / "out"), "--model", str(tmp_path / "run")]) == 0
    assert open_source(str(tmp_path / "out")).sensor.same_rays(pandar.with_columns(64))


def test_the_sensor_that_a_run_learned_from_may_be_named_with_all_its_columns(run, tmp_path, capsys):
    words = ["segment", "simulated:1:test", str(tmp_path / "out"), "--model", str(run / "whole"), "--device", "cpu"]
    assert main([*words, "--sensor", "hdl64e_kitti_odometry"]) == 0
    assert main([*words, "--sensor", "pandar64"]) == 2
    assert main([*words, "--set", "data.columns=128"]) == 2
    assert "64x128, for --model" in capsys.readouterr().err


def test_scores_are_those_of_a_loop():
    rng = torch.Generator().manual_seed(0)
    numbers = torch.tensor(sorted(CLASSES))
    true, found = (numbers[torch.randint(len(numbers), (500,), generator=rng)] for _ in range(2))
    scores, expected = LabelScores(), {}
    scores.add(found[:200], true[:200])
    scores.add(found[200:], true[200:])
    pairs = [(CLASSES[int(t)].group, CLASSES[int(f)].group) for t, f in zip(true, found, strict=True)]
    for group in GROUPS:
        counted = [(t, f) for t, f in pairs if t]
        both = sum(t == f == group for t, f in counted)
        expected[group] = both / sum(group in pair for pair in counted)
    assert scores.intersection_over_union() == pytest.approx(expected)
    assert scores.mean() == pytest.approx(sum(expected.values()) / len(expected))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["simulated:1:test", "--model", "{run}/none"], "which does not exist; wanted a segmenter's run"),
        (["simulated:1:test", "--model", "pretrained/raydrop"], "'raydrop', which labels no scans; wanted a segmenter"),
        (
            ["{tmp}/in", "--model", "{run}/whole", "--compare", "semantic_kitti"],
            "does not have: 5, 41; wanted .*pand",
        ),
        (
            ["{tmp}/bare.npz", "--model", "{run}/whole", "--compare", "pandaset"],
            "no labels in .*; wanted labels to",
        ),
        (["{tmp}/in", "--model", "{run}/whole", "--compare", "waymo"], "numbering 'waymo'; wanted nuscenes, pandaset"),
        (["{tmp}/image.npy", "--model", "{run}/whole"], "wanted .*"),
        (["simulated:1:test", "--model", "{run}/whole", "--device", "abacus"], "abacus"),
    ],
)
def test_what_cannot_be_labelled_is_told_in_one_line(words, told, run, tmp_path, capsys):
    scan = scan_of(0)
    foreign = torch.tensor([5, 41])[torch.arange(len(scan)) % 2]
    KittiTree(tmp_path / "in").write("sequences/00/velodyne/000000.bin", replace(scan, label=foreign))
    np.savez(tmp_path / "bare.npz", points=scan.points_xyz_m.numpy())
    np.save(tmp_path / "image.npy", np.ones((32, 64), np.float32))
    words = [word.format(run=run, tmp=tmp_path) for word in words]
    assert main(["segment", words[0], str(tmp_path / "out"), *words[1:]]) != 0
    assert re.search(told, the_one_line(capsys.readouterr().err, "segment"))
    assert not (tmp_path / "out").exists()


def test_a_segmenter_has_no_scans_to_sample(run):
    with pytest.raises(ConfigError, match=r"^got no condition for 'segmenter'; wanted a generator that samples"):
        open_segmenter(str(run / "whole"), "cpu").sample([0])


def test_a_named_run_labels_for_metrics(run):
    assert segmenter_of(SENSOR.with_columns(128), run / "whole") == run / "whole"
