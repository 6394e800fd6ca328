"""Training batches as a function of the scans seen so far; the number of threads that read ahead has no influence."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Int64
from torch import Tensor

from lidargrit.core.determinism import derive_seed
from lidargrit.core.errors import ConfigError
from lidargrit.data.images import RangeImages
from lidargrit.data.pasts import Pasts
from lidargrit.scans.augmentation import Augmentation, augment
from lidargrit.scans.condition import Condition
from lidargrit.scans.example import Example
from lidargrit.scans.types import RangeImage

_THREADS_AT_MOST = 128
_AHEAD = 8  # batches that wait beyond those that are being read: enough for no thread to idle


class Batches:
    """Training batches as a function of the scans seen so far: a resumed run sees the same as one that ran through.

    A batch holds images of one sensor.

    Args:
        images: range images to learn from; each comes once an epoch, in an order that the seed determines. Of images of
            several sensors, those are left out of an epoch that fill no batch.
        batch_size: number of scans in a batch, over all processes.
        augmentations: kinds of augmentation, applied in this order.
        any_columns: whether an image may begin at any fine column; see :class:`TrainingConfig`.
        rank: number of this process, from 0; it takes its share of every batch.
        world_size: number of processes that train together.
        condition_of: function from a batch of images to what a generator is told of each; nothing if not given.
        with_keys: whether images come with keys, by which what is computed of them is known again.
        past_scans: number of scans before each in its drive that a generator is told in place of ``condition_of``; 0
            for none. Most pasts end one scan before the image, others up to ten.
    """

    def __init__(
        self,
        images: RangeImages,
        batch_size: int,
        augmentations: Sequence[Augmentation],
        any_columns: bool,
        seed: int,
        rank: int = 0,
        world_size: int = 1,
        workers: int = 1,
        condition_of: Callable[[RangeImage], Condition] | None = None,
        with_keys: bool = False,
        past_scans: int = 0,
    ) -> None:
        if batch_size % world_size:
            raise ConfigError(
                f"batch_size={batch_size} on {world_size} processes",
                "a multiple of the processes",
                "change one of them",
            )
        self.images, self.batch_size, self.augmentations = images, batch_size, tuple(augmentations)
        self.any_columns, self.seed, self.rank, self.world_size = any_columns, seed, rank, world_size
        self.workers, self._condition_of, self._with_keys = workers, condition_of, with_keys
        self._pasts = Pasts(images, past_scans) if past_scans else None
        self._epoch, self._order = -1, torch.empty(0)
        self._by_sensor = images.of_each_sensor()
        self._epoch_length = len(images)
        if len(self._by_sensor) > 1:
            self._epoch_length = sum(len(each) // batch_size * batch_size for each in self._by_sensor)
            if not self._epoch_length:
                got = f"batch_size={batch_size}, and fewer scans of each of {len(self._by_sensor)} sensors"
                raise ConfigError(got, "a batch of one sensor", "lower batch_size, or take more scans of each")

    def stream(self, scans_seen: int, until: int) -> Iterator[Example]:
        """Yield the batches from ``scans_seen`` scans on, up to the last that begins before ``until`` scans."""
        waiting: deque[Future[Example]] = deque()
        threads = min(self.workers, _THREADS_AT_MOST)
        with ThreadPoolExecutor(threads, thread_name_prefix="reading scans") as pool:
            try:
                for position in range(scans_seen, until, self.batch_size):
                    waiting.append(pool.submit(self._read, *self._chosen(position)))
                    if len(waiting) > threads + min(threads, _AHEAD):  # few enough to hold in memory
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

    def at(self, scans_seen: int) -> Example:
        """Return this process's share of the batch that follows ``scans_seen`` scans."""
        return self._read(*self._chosen(scans_seen))

    def _chosen(self, scans_seen: int) -> tuple[list[int], list[int]]:
        """Return the indices of a batch's scans, and a seed for each scan's column and augmentation."""
        share = self.batch_size // self.world_size
        positions = range(scans_seen + self.rank * share, scans_seen + (self.rank + 1) * share)
        return [self._scan_at(position) for position in positions], [derive_seed(self.seed, 1, p) for p in positions]

    def _read(self, indices: list[int], seeds: list[int]) -> Example:
        # Each scan has its own random numbers, so that it looks the same however many processes share a batch.
        rngs = [torch.Generator().manual_seed(seed) for seed in seeds]
        stride = self.images.sensor_of(indices[0]).column_stride
        columns = [int(torch.randint(stride, (1,), generator=rng)) for rng in rngs]
        first_columns = columns if self.any_columns else None
        example = Example(self.images.batch(indices, first_columns))
        if self._pasts is not None:
            gaps = [self._pasts.random_gap(index, rng) for index, rng in zip(indices, rngs, strict=True)]
            example = replace(example, condition=self._pasts.of(indices, first_columns, gaps))
        if self.augmentations:
            another = [partial(self._another, *each) for each in zip(indices, columns, rngs, strict=True)]
            each = [augment(example[i : i + 1], self.augmentations, rngs[i], another[i]) for i in range(len(rngs))]
            example = Example.cat(each)
        if self._condition_of is not None and self._pasts is None:
            example = replace(example, condition=self._condition_of(example.images))
        return example.with_keys() if self._with_keys else example

    def _another(self, index: int, first_column: int, rng: torch.Generator) -> RangeImage:
        """Read any image of the sensor of one of the images, with its first column, as a batch of one."""
        alike = next(each for each in self._by_sensor if len(self._by_sensor) == 1 or index in each)
        chosen = alike[int(torch.randint(len(alike), (1,), generator=rng))]
        return self.images.batch([chosen], [first_column] if self.any_columns else None)

    def _scan_at(self, position: int) -> int:
        epoch, index = divmod(position, self._epoch_length)
        if epoch != self._epoch:
            rng = torch.Generator().manual_seed(derive_seed(self.seed, 0, epoch))
            self._epoch, self._order = epoch, self._ordered(rng)
        return int(self._order[index])

    def _ordered(self, rng: torch.Generator) -> Int64[Tensor, " n"]:
        """Return the images of an epoch: in any order, or of several sensors in batches in any order."""
        if len(self._by_sensor) == 1:
            return torch.randperm(len(self.images), generator=rng)
        batches: list[Tensor] = []
        for each in self._by_sensor:
            shuffled = torch.arange(each.start, each.stop)[torch.randperm(len(each), generator=rng)]
            batches += [some for some in shuffled.split(self.batch_size) if len(some) == self.batch_size]
        return torch.cat([batches[number] for number in torch.randperm(len(batches), generator=rng).tolist()])
