"""One loop, one optimiser, one checkpoint, whatever the model: recipe → run folder."""

from lidargrit.training.compute import estimated_training_flops, gpu_time, training_flops, with_budget
from lidargrit.training.measure import Measured, measure
from lidargrit.training.plan import Plan, plan
from lidargrit.training.run import check_folder, train
from lidargrit.training.settings import FitConfig, Recipe
from lidargrit.training.tracking import tracked

__all__ = [
    "FitConfig",
    "Measured",
    "Plan",
    "Recipe",
    "check_folder",
    "estimated_training_flops",
    "gpu_time",
    "measure",
    "plan",
    "tracked",
    "train",
    "training_flops",
    "with_budget",
]
