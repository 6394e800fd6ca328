"""Checks of what a caller passes to a generator: seeds, images and conditions."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from numbers import Integral

import numpy as np

from lidargrit.core.errors import ConfigError
from lidargrit.core.untrusted import SEED_AT_MOST
from lidargrit.scans.condition import KINDS, ConditionKind, Observed
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


def check_seeds(seeds: Sequence[int], count: int | None = None) -> None:
    """Refuse seeds that are out of bounds, none at all, or another number of them than there are images.

    Args:
        seeds: seeds, one for each scan.
        count: number of images; None where the seeds alone say how many scans are wanted.
    """
    if not isinstance(seeds, Sequence | np.ndarray):  # a set has no order by which the scans could be told apart
        raise ConfigError(f"seeds of type {type(seeds).__name__}", "a sequence, such as [0]", "put them into a list")
    if count is not None and len(seeds) != count:
        raise ConfigError(f"{len(seeds)} seeds for {count} images", "one seed for each image", "correct the seeds")
    if not len(seeds):
        raise ConfigError("no seeds", "at least one, such as seeds=[0]", "name a seed for each scan")
    for seed in seeds:
        if not isinstance(seed, Integral) or isinstance(seed, bool) or not 0 <= seed <= SEED_AT_MOST:
            raise ConfigError(f"the seed {str(seed)[:30]}", "a whole number from 0 to 2^32 - 1", "choose another seed")


def check_images(images: RangeImage | Observed, sensor: SensorModel) -> None:
    """Refuse a single image, an empty batch, and images whose pixels are other rays than the sensor's."""
    if images.range_m.ndim != 3 or not len(images):
        raise ConfigError(
            f"range images of shape {tuple(images.range_m.shape)}",
            f"a batch (B, {sensor.height}, {sensor.width}) of at least one",
            "make a batch of single images with RangeImage.stack([image])",
        )
    if not images.sensor.same_rays(sensor):
        raise ConfigError(
            f"range images of the sensor {images.sensor.name!r}, {images.sensor.height}x{images.sensor.width}",
            f"images of the generator's own, {sensor.name!r}, {sensor.height}x{sensor.width}, with the same rays",
            "project the scans with generator.sensor",
        )


def check_observed_part(condition: Observed, kinds: Collection[ConditionKind], sensor: SensorModel, name: str) -> None:
    """Refuse observations of other rays, and those of a kind that a generator does not take.

    Args:
        condition: condition that a caller gave.
        kinds: kinds that the generator takes.
        sensor: sensor of the generator.
        name: name of the generator, for the message.
    """
    check_images(condition, sensor)
    if not condition.kinds <= set(kinds):
        raise ConfigError(
            " and ".join(KINDS[kind] for kind in sorted(condition.kinds - set(kinds))),
            " or ".join(KINDS[kind] for kind in sorted(kinds)) + f", which is what this {name!r} takes",
            "choose a model of lidargrit, such as pretrained",
        )
