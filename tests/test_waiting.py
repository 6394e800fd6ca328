"""Training on a GPU: the host waits for the device in few steps, and still saves no number that is not finite."""

import math

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from lidargrit.core.errors import TrainingError
from lidargrit.core.files import read_tensors
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.generation.objective import Objective
from lidargrit.generation.settings import TrainingConfig
from lidargrit.scans.sensors import load_sensor
from lidargrit.training.log import read_log
from lidargrit.training.stage import StageTraining


class Walls:
    """A few walls around the sensor."""

    provenance = Provenance()

    def __len__(self):
        return 6

    def read(self, index):
        return Pixels(np.full((64, 32), 10.0 + index, np.float32))


IMAGES = RangeImages(load_sensor("hdl64e_kitti_odometry").with_columns(32), [Walls()])


class MeanRange(Objective):
    """A number that learns the mean range, whose loss is not finite from some step on; notes the reads so far."""

    def __init__(self, sensor, reads, breaks_at=10**9):
        super().__init__(sensor)
        self.mean = torch.nn.Parameter(torch.tensor(1.0))
        self.reads, self.breaks_at, self.reads_before = reads, breaks_at, []

    def forward(self, example, rng, player=""):
        self.reads_before.append(self.reads.count)
        loss = (example.images.range_m.mean() - self.mean).square()
        return {"loss": loss * math.nan if len(self.reads_before) > self.breaks_at else loss}


class Reads(TorchDispatchMode):
    """Counts where a number of a tensor is asked for, which waits for a GPU; whole numbers are those of the order."""

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += func is torch.ops.aten._local_scalar_dense.default and args[0].dtype != torch.long
        return func(*args, **(kwargs or {}))

    def __deepcopy__(self, memo):
        return self


def mean_range_on_a_gpu(folder, images, breaks_at=10**9):
    """Return an objective and its training of 50 steps, in which numbers are not seen at once, as on a GPU."""
    objective = MeanRange(images.sensor, Reads(), breaks_at)
    config = TrainingConfig(scans=100, batch_size=2, learning_rate=1e-3, checkpoint_every=60)
    fit = StageTraining(objective, config, folder, 0).begun()
    fit.engine.sees_at_once = False
    return objective, fit


def test_on_a_gpu_the_host_waits_for_every_twentieth_step_and_for_checkpoints(tmp_path):
    objective, fit = mean_range_on_a_gpu(tmp_path, IMAGES)
    with objective.reads:
        fit.run(IMAGES, IMAGES, "training")
    waits = [step for step, count in enumerate(np.diff(objective.reads_before[:50]), start=1) if count]
    assert waits == [20, 30, 40]
    assert [entry["scans_seen"] for entry in read_log(tmp_path / "log.jsonl") if entry["split"] == "train"] == [40, 80]


def test_on_a_gpu_no_checkpoint_holds_numbers_that_are_not_finite(tmp_path):
    objective, fit = mean_range_on_a_gpu(tmp_path, IMAGES, breaks_at=32)
    with pytest.raises(TrainingError, match=r"a loss or gradient of nan after 80 scans.*last checkpoint is"):
        fit.run(IMAGES, IMAGES, "training")
    assert len(objective.reads_before) == 40
    assert all(bool(tensor.isfinite().all()) for tensor in read_tensors(fit.checkpoint)[0].values())
