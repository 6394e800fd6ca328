"""Metrics of what stands in scans: against slow loops and SciPy, and how they rank known damages."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import jensenshannon

from damaged_streets import SENSOR, blurred, boxes_for_vehicles, kind_of, searched_objects, streets, without_vehicles
from lidargrit.core.errors import DataError, WeightsError
from lidargrit.evaluation.metrics import ImageKind, load_metric
from lidargrit.evaluation.metrics.shared.curves import range_edges
from lidargrit.evaluation.metrics.shared.objects import objects_in
from lidargrit.scans.classes import CLASSES, LEARNED
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.types import RangeImage

GENERATED, REAL = (100, 6), (200, 6)  # first seed and number of streets
FEW_GENERATED, FEW_REAL = (100, 4), (200, 4)  # for slow loops
EDGES = {  # as object_statistics documents them
    "number_a_scan": [0, 1, 2, 3, 5, 9, 17, 33],
    "length_m": np.geomspace(0.1, 20, 14),
    "height_m": np.geomspace(0.1, 12, 14),
    "distance_m": np.geomspace(2, 80, 12),
    "upper_share": np.arange(10) / 10,
}


def score(name, generated, real, variant="labelled"):
    metric = load_metric(name)(variant=variant)
    metric.update(generated, real=False)
    metric.update(real, real=True)
    return metric.compute()


@functools.cache
def measured(first, count):
    """Return rows (image, kind, returns, length, height, distance, upper share), by a loop over objects and points."""
    images, rows = streets(first, count), []
    for index in range(len(images)):
        points = points_of_pixels(images[index]).double().numpy()
        for pixels in searched_objects(images[index]):
            xyz = [points[pixel] for pixel in pixels]
            angles = [math.pi * turn / 8 for turn in range(8)]
            along = [[x * math.cos(angle) + y * math.sin(angle) for x, y, _ in xyz] for angle in angles]
            heights = [z for _, _, z in xyz]
            third = max(heights) - (max(heights) - min(heights)) / 3
            length = max(max(each) - min(each) for each in along)
            upper = [[a for a, z in zip(each, heights, strict=True) if z > third] for each in along]
            rows.append((
                index,
                kind_of(int(images.label[index][pixels[0]])),
                len(pixels),
                length,
                max(heights) - min(heights),
                min(math.hypot(x, y) for x, y, _ in xyz),
                max((max(each) - min(each) for each in upper if each), default=0.0) / length,
            ))  # fmt: skip
    return sorted(rows)


def test_objects_are_those_of_a_slow_search():
    found = objects_in(streets(*FEW_GENERATED))
    expected = measured(*FEW_GENERATED)
    assert len(expected) > 12
    assert {row[1] for row in expected} == {0, 1, 2, 3}
    assert np.allclose(sorted(zip(*found, strict=True)), expected, atol=1e-9)


def test_an_object_may_lie_across_the_first_and_the_last_column():
    image = streets(*GENERATED)[:1]
    turned = image.mapped(lambda pixels: pixels.roll(100, -1))
    assert sorted(objects_in(image).returns) == sorted(objects_in(turned).returns)


def test_labels_that_no_class_has_are_no_vehicles():
    range_m = torch.full((1, 8, SENSOR.width), 10.0)
    sensor = dataclasses.replace(SENSOR, elevation_rad=SENSOR.elevation_rad[:8])
    for label, count in ((max(CLASSES), 1), (max(CLASSES) + 1, 0), (60_000, 0)):
        labels = torch.zeros(range_m.shape, dtype=torch.int64)
        labels[:, 2:6, 20:26] = label
        image = RangeImage(range_m, range_m > 0, sensor, {"label": labels})
        assert len(objects_in(image).kind) == count


def test_the_statistics_are_those_of_a_loop():
    rows = [measured(*FEW_GENERATED), measured(*FEW_REAL)]
    numbers, shapes, weights = [], [], []
    for kind in range(4):
        of_kind = [[row for row in each if row[1] == kind] for each in rows]
        a_scan = [[sum(row[0] == index for row in each) for index in range(4)] for each in of_kind]
        numbers.append(squared_distance(*a_scan, EDGES["number_a_scan"]))
        columns = zip(list(EDGES)[1:], range(3, 7), strict=True)
        shapes.append(
            np.mean([squared_distance(*([r[at] for r in e] for e in of_kind), EDGES[n]) for n, at in columns])
        )
        weights.append(sum(len(each) / len(every) for each, every in zip(of_kind, rows, strict=True)) / 2)
    result = score("object_statistics", streets(*FEW_GENERATED), streets(*FEW_REAL))
    assert math.isclose(result.value, math.sqrt((np.mean(numbers) + np.dot(shapes, weights)) / 2), rel_tol=1e-9)
    for which, each in zip(("generated", "real"), rows, strict=True):
        vehicles = [row for row in each if row[1] == 0]
        means = result.details[which]["vehicle"]
        assert math.isclose(means["number_a_scan"], len(vehicles) / 4)
        assert math.isclose(means["length_m"], np.mean([row[3] for row in vehicles]))


def squared_distance(first, second, edges):
    """Squared Jensen-Shannon distance of two lists of values in bins, by SciPy."""
    if not (len(first) and len(second)):
        return float(bool(len(first)) != bool(len(second)))
    bins = [[max(sum(edge <= value for edge in edges) - 1, 0) for value in values] for values in (first, second)]
    return jensenshannon(*(np.bincount(each, minlength=len(edges)) for each in bins), base=2) ** 2


def test_shares_of_classes_are_those_of_a_loop():
    generated, real = streets(*GENERATED)[:2], streets(*REAL)[:2]
    edges = range_edges(ImageKind.of(SENSOR), 12)
    counts = np.zeros((2, 12, 20))
    for which, images in enumerate((generated, real)):
        for range_m, label in zip(images.range_m.flatten().tolist(), images.label.flatten().tolist(), strict=True):
            if range_m > 0:
                learned = CLASSES[label].learned
                at = max(index for index, edge in enumerate(edges[:-1]) if edge <= range_m)
                counts[which, at, LEARNED.index(learned) + 1 if learned else 0] += 1
    share = [each.sum(1) / each.sum() for each in counts]
    seen = [at for at in range(12) if counts[:, at].any()]
    apart = {at: jensenshannon(*counts[:, at], base=2) ** 2 if counts[:, at].any(1).all() else 1.0 for at in seen}
    value = math.sqrt(sum((share[0][at] + share[1][at]) / 2 * apart[at] for at in seen))
    result = score("class_jsd", generated, real)
    assert math.isclose(result.value, value, rel_tol=1e-9)
    road = result.details["share_by_range"]["real"]["road"]
    assert math.isclose(road[4], counts[1, 4, LEARNED.index(40) + 1] / counts[1, 4].sum())


def test_equal_sets_score_0_and_streets_against_streets_score_less_than_any_damage():
    """The blur bends objects, the others change what stands there: six streets would differ more by chance."""
    generated, real = streets(100, 16), streets(200, 16)
    for name in ("object_statistics", "class_jsd"):
        assert score(name, real, real).value < 1e-6
        none = score(name, generated, real).value
        half, gone = (score(name, without_vehicles(generated, every), real).value for every in (2, 1))
        assert none < gone
        assert half < gone
    objects = {
        "none": score("object_statistics", generated, real).value,
        "blur of 3": score("object_statistics", blurred(generated, 3), real).value,
        "blur of 5": score("object_statistics", blurred(generated, 5), real).value,
        "boxes": score("object_statistics", boxes_for_vehicles(generated), real).value,
    }
    assert sorted(objects, key=objects.__getitem__)[0] == "none", objects
    assert objects["blur of 3"] < objects["blur of 5"], objects


def test_a_box_is_as_long_above_as_below_and_a_car_is_not():
    generated = streets(*GENERATED)
    upper = [objects_in(images) for images in (generated, boxes_for_vehicles(generated))]
    cars, boxes = (np.median(each.upper_share[(each.kind == 0) & (each.returns > 30)]) for each in upper)
    assert cars < 0.9
    assert boxes > 0.99


def test_scans_without_labels_and_rays_without_a_segmenter_are_told_with_a_cure():
    images = streets(*GENERATED)[:2]
    bare = RangeImage(images.range_m, images.return_mask, SENSOR)
    with pytest.raises(
        DataError, match=r"^got range images without labels; wanted labels in both sets; --variant segmented$"
    ):
        score("class_jsd", bare, images)
    few = SENSOR.with_columns(64)
    other = RangeImage(torch.ones(1, 64, 64), torch.ones(1, 64, 64, dtype=torch.bool), few)
    with pytest.raises(WeightsError, match=r"64x64 to be labelled by the package; .*--weights segmenter=RUN$"):
        score("class_jsd", other, other, "segmented")
