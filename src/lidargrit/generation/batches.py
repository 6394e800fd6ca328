"""What callers pass to a generator is checked, and its scans are computed in batches of one size."""

from collections.abc import Callable, Collection, Iterator, Sequence
from numbers import Integral
from typing import overload

import numpy as np

from lidargrit.core.errors import ConfigError
from lidargrit.core.untrusted import SEED_AT_MOST
from lidargrit.nn.size import within_memory
from lidargrit.scans.condition import KINDS, Condition, ConditionKind, Nothing, Observed
from lidargrit.scans.past import Past
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


class BatchSeeds(Sequence[int]):
    """Seeds of one batch: those asked for, then copies of the last one that fill the batch up."""

    def __init__(self, asked_for: Sequence[int], size: int) -> None:
        self._seeds = (*asked_for, *[asked_for[-1]] * (size - len(asked_for)))
        self.num_asked_for = len(asked_for)

    def __len__(self) -> int:
        return len(self._seeds)

    @overload
    def __getitem__(self, index: int) -> int: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[int, ...]: ...
    def __getitem__(self, index: int | slice) -> int | tuple[int, ...]:
        return self._seeds[index]


def in_batches(seeds: Sequence[int], size: int, compute: Callable[[list[int], BatchSeeds], RangeImage]) -> RangeImage:
    """Compute one scan for each seed in batches of one size.

    Args:
        size: number of scans of a batch.
        compute: function from the indices and the seeds of a batch to its scans; those of the copies are dropped, and
            may be left out.
    """
    parts, halved = [], f"use sampling.batch_size={size // 2}" if size > 1 else "use another device"
    for first in range(0, len(seeds), size):
        wanted = range(first, min(first + size, len(seeds)))
        indices = [*wanted, *[wanted[-1]] * (size - len(wanted))]
        with within_memory(size, halved):
            made = compute(indices, BatchSeeds([int(seeds[index]) for index in wanted], size))
        parts.append(made[: len(wanted)])
    return RangeImage.cat(parts)


def one_by_one(images: RangeImage) -> Iterator[RangeImage]:
    """Yield batches of one image each, for work without seeds: what it gives for a scan depends on that scan alone.

    A network takes as long for each scan of a batch, and the memory of one is enough for any number of them.
    """
    for index in range(len(images)):
        yield images[index : index + 1]


def check_seeds(seeds: Sequence[int], count: int | None = None) -> None:
    """Refuse seeds that are out of bounds, none at all, or another number of them than there are images.

    Args:
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


def check_condition(
    condition: Condition,
    takes: Collection[type[Condition]],
    kinds: Collection[ConditionKind],
    sensor: SensorModel,
    name: str,
    first_command: str,
    count: int | None = None,
) -> None:
    """Refuse a condition of a type that a generator does not take, or by other rays, and observations of other kinds.

    Args:
        kinds: kinds of observations that it takes.
        first_command: command of ``lidargrit`` by which a generator that takes others is used.
        count: number of images that it is of; None where none are given.
    """
    if isinstance(condition, Observed):
        check_images(condition, sensor)
        if not condition.kinds <= set(kinds):
            raise ConfigError(
                " and ".join(KINDS[kind] for kind in sorted(condition.kinds - set(kinds))),
                " or ".join(KINDS[kind] for kind in sorted(kinds)) + f", which is what this {name!r} takes",
                "choose a model of lidargrit, such as pretrained",
            )
    if type(condition) not in takes:
        kind, wanted = type(condition).__name__, ", ".join(sorted(one.__name__ for one in takes))
        got = "no condition" if isinstance(condition, Nothing) else f"a condition of type {kind}"
        wanted = f"one of type {wanted}" if wanted else "a generator that samples"
        raise ConfigError(f"{got} for {name!r}", wanted, f"use it with: lidargrit {first_command}")
    if isinstance(condition, Past) and not condition.sensor.same_rays(sensor):
        got = f"a past by the sensor {condition.sensor.name!r}, {condition.sensor.height}x{condition.sensor.width}"
        raise ConfigError(got, f"one on the generator's own rays, {sensor.height}x{sensor.width}", "project its scans")
    if count not in (None, len(condition)):
        got = f"a {type(condition).__name__} of {len(condition)} scans for {count} images"
        raise ConfigError(got, "one for each image", "take as many of both")
