"""Preset → run folder, by one training loop for every generator."""

from lidargrit.training.batch_size import with_best_batches, without_auto
from lidargrit.training.compute import computing_time, training_flops, with_budget
from lidargrit.training.measure import measure
from lidargrit.training.plan import open_data, plan_training
from lidargrit.training.run import check_folder, train

__all__ = [
    "check_folder",
    "computing_time",
    "measure",
    "open_data",
    "plan_training",
    "train",
    "training_flops",
    "with_best_batches",
    "with_budget",
    "without_auto",
]
