"""Columns of prepared images gathered into fewer: every pixel is of one return, against a slow loop."""

import numpy as np

from lidargrit.data.images import Pixels, Provenance
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
from lidargrit.data.prepared.prepared import FewerColumns
from lidargrit.data.sources import open_source
from lidargrit.evaluation.pairs import EvalSet
from lidargrit.scans.sensors import load_sensor


class OneImage:
    """A store of one image."""

    provenance = Provenance(("one",))

    def __init__(self, pixels):
        self.read = lambda index: pixels

    def __len__(self):
        return 1


def test_range_reflectance_and_label_are_of_one_return():
    rng = np.random.default_rng(0)
    # Few different ranges, so that many returns of a pixel are equally near.
    range_m = rng.integers(0, 3, (4, 60)).astype(np.float32)
    reflectance = (rng.random((4, 60)) * (range_m > 0)).astype(np.float32)
    label = rng.integers(1, 99, (4, 60)) * (range_m > 0)
    pixels = Pixels(range_m, {"reflectance": reflectance, "label": label})
    for wanted in (60, 20, 17):
        got = FewerColumns(OneImage(pixels), 60, wanted).read(0)
        assert got.planes["reflectance"].dtype == np.float32
        new_column = [int((column + 0.5) * wanted / 60) for column in range(60)]
        for row in range(4):
            for column in range(wanted):
                olds = [old for old in range(60) if new_column[old] == column and range_m[row, old] > 0]
                pixel = (got.range_m[row, column], *(got.planes[name][row, column] for name in pixels.planes))
                if not olds:
                    assert pixel == (0, 0, 0)
                    continue
                first = min(olds, key=lambda old: (range_m[row, old], old))
                assert pixel == (range_m[row, first], reflectance[row, first], label[row, first])


def test_images_of_other_columns_of_the_same_scans_are_another_set(tmp_path):
    """Every 8th of 2048 columns, and all of them gathered into 256, of one prepared folder."""
    prepare("simulated:2:test", DataConfig(columns=2048, column_stride=8), tmp_path / "prepared")
    sensor = load_sensor("hdl64e_kitti_odometry")
    sensors = sensor, sensor.with_columns(256)
    source = open_source(str(tmp_path / "prepared"))
    records = [EvalSet("a", source.images(each), range(2)).record() for each in sensors]
    assert records[0].sha256 != records[1].sha256
