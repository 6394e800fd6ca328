"""Metrics of several processes → one number, and metrics by the names of their classes."""

import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lidargrit.evaluation import metrics
from lidargrit.evaluation.metrics import load_metric
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

PROCESS = """
import pickle, sys
import torch.distributed as distributed
from lidargrit.evaluation.metrics import BevMmd, SlicedWasserstein
from test_metric_reduction import images

rank, meeting, out = int(sys.argv[1]), sys.argv[2], sys.argv[3]
distributed.init_process_group("gloo", f"file://{meeting}", rank=rank, world_size=2)
found = []
for metric in (BevMmd(), SlicedWasserstein(variant="textbook")):
    for real in (False, True):
        metric.update(images(real)[rank * 4 : rank * 4 + 4], real=real)
    metric.reduce()
    found.append(metric.compute())
with open(f"{out}{rank}", "wb") as file:
    pickle.dump(found, file)
"""


def images(real: bool) -> RangeImage:
    sensor = load_sensor("hdl64e_kitti_360").with_columns(64)
    range_m = 3 + 40 * torch.rand(8, sensor.height, sensor.width, generator=torch.Generator().manual_seed(int(real)))
    return RangeImage(range_m, range_m > 0, sensor)


def test_two_processes_have_the_number_of_one(tmp_path):
    words = [sys.executable, "-c", PROCESS]
    ends = [str(tmp_path / "meeting"), str(tmp_path / "found")]
    processes = [subprocess.Popen([*words, str(rank), *ends], cwd=Path(__file__).parent) for rank in range(2)]
    assert [process.wait(timeout=60) for process in processes] == [0, 0]
    both = [pickle.loads((tmp_path / f"found{rank}").read_bytes()) for rank in range(2)]
    assert both[0] == both[1]
    for result in both[0]:
        metric = load_metric(result.metric)(variant=result.variant)
        for real in (False, True):
            metric.update(images(real), real=real)
        metric.reduce()  # alone, it changes nothing
        alone = metric.compute()
        assert result.value == pytest.approx(alone.value, rel=1e-6)
        assert (result.num_generated, result.num_reference) == (8, 8)


def test_a_metric_is_imported_by_the_name_of_its_class():
    from lidargrit.evaluation.metrics import SlicedWasserstein

    assert SlicedWasserstein is load_metric("sliced_wasserstein")
    with pytest.raises(ImportError, match="SlicedWassertein"):
        from lidargrit.evaluation.metrics import SlicedWassertein  # noqa: F401
    assert not hasattr(metrics, "sliced_wasserstien")
