"""Sliced Wasserstein distance between local patches of range images, scale by scale: two sets → mean over scales."""

import hashlib
import math
from typing import Any, ClassVar, Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32, Int
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.evaluation.metrics import ImageMetric
from lidargrit.evaluation.metrics.shared.accumulators import RowAccumulator
from lidargrit.scans.projection import RangeEncoding
from lidargrit.scans.types import RangeImage

# All from Karras et al. 2018, whose values LidarGRIT's program keeps.
_COARSEST = 16  # rows or columns, whichever are fewer, of the last level of the pyramid
_PATCH = 7  # pixels; 7 * 7 = 49 numbers per descriptor
_PATCHES = 128  # per image and level
_BATCH = 128  # images; those of one batch share their patch positions in ``reference``
_REPEATS, _DIRECTIONS = 4, 128

_MAX_PROJECTED = 2**23  # projections held at once: 32 MB per set, and as much again while they are sorted


class SlicedWasserstein(ImageMetric):
    """Compare the distributions of 7x7 patches of the encoded range at 3 scales (2 for 32 rows) by random projections.

    The range is encoded linearly onto [-1, 1] between the sensor's limits, -1 for no return, and split into a
    Laplacian pyramid. Patches of a level are standardised by the mean and deviation of their own set, so a common
    offset or scale goes unseen. The value is the mean over levels, unscaled (the paper prints it times 100); the levels
    themselves are in the details by their number of rows, ``rows_64`` the finest. LidarGRIT's program names them the
    other way round: its "swd-16" is the finest, our ``rows_64``, and its "swd-64" our ``rows_16``.

    Neither variant is 0 for a set against itself, since the patch positions of the two sets are sampled separately.
    The value of real scans against real scans falls as sets grow, so only values of equally large sets can be compared.
    Of sets of unequal size the first n of the larger one are used, where n is the size of the smaller;
    ``num_compared`` in the details is n.

    Args:
        variant: ``reference`` repeats LidarGRIT's program with the same random numbers, generated images first:
            directions divided by their standard deviation instead of their length (values about 7 times larger), the
            upsampled level shifted by one pixel, patch positions shared by the 128 images of a batch. The order of
            images matters only for the batch into which each falls, which parts that are merged know by
            :attr:`first_image`. Left at 0, all parts share the positions of the first batch, and the value is larger.
            ``textbook`` is Karras et al.: directions of unit length, an aligned pyramid, and positions of its own for
            every image. These are sampled by a seed made of the image itself, its set and ``seed``, so that neither the
            order of images nor the number of processes matters; equal images of one set give equal patches.

    Source:
        Karras et al., Progressive growing of GANs, ICLR 2018, section 5; behaviour of hamedhaghighi/LidarGRIT@a3f86e7.
    """

    title = "Sliced Wasserstein distance between patches of range images"
    variants = ("reference", "textbook")
    of_equal_sets: ClassVar = {
        "reference": "patches of the two sets are sampled apart, and long directions make it some 7 times larger",
        "textbook": "patches of the two sets are sampled apart",
    }
    accumulator = RowAccumulator

    def __init__(self, *, variant: Literal["reference", "textbook"] = "reference", seed: int = 0) -> None:
        super().__init__(variant=variant, seed=seed)
        self._shared: SharedPositions | None = None

    def summarise(self, features: RangeImage, *, real: bool) -> Float32[np.ndarray, "B patches 49"]:
        """Cut the patches of a batch of images, those of the finest level first: 75 kB per image."""
        sensor = features.sensor
        encoding = RangeEncoding("linear", sensor.range_min_m, sensor.range_max_m)
        encoded = encoding.encode(features.range_m.float(), features.return_mask)
        pyramid = laplacian_pyramid(encoded, shifted=self.variant == "reference")
        if self.variant == "reference":
            first = self.first_image + self.num_images[real]
            images = range(first, first + len(features))
            positions = self._shared_positions().of_images(images, real)
        else:
            positions = own_positions(features.range_m, pyramid, self.seed, real)
        return torch.cat([descriptors(*pair) for pair in zip(pyramid, positions, strict=True)], dim=1).numpy()

    def compare(
        self, generated: Float32[np.ndarray, "n patches 49"], real: Float32[np.ndarray, "m patches 49"]
    ) -> tuple[float, dict[str, Any]]:
        """Return the mean over levels, and every level in the details."""
        assert self.kind is not None
        n = min(len(generated), len(real))
        reference = self.variant == "reference"
        # LidarGRIT's program takes its directions from the same random source, after the positions of all batches.
        rng = self._shared_positions().after_images(n) if reference else torch.Generator().manual_seed(self.seed)
        details: dict[str, Any] = {}
        first = 0
        for level, size in enumerate(self._level_sizes()):
            num_patches = _PATCHES if self.variant == "textbook" else min(_PATCHES, size)
            part = slice(first, first := first + num_patches)
            samples = (torch.from_numpy(each[:n, part].reshape(-1, _PATCH**2)) for each in (generated, real))
            patches = [standardised(sample, int(reference)) for sample in samples]
            repeats = [
                sliced_distance(patches[0], patches[1], random_directions(rng, unit_length=not reference))
                for _ in range(_REPEATS)
            ]
            details[f"rows_{self.kind.height >> level}"] = sum(repeats) / len(repeats)
        value = sum(details.values()) / len(details)
        return value, {**details, "num_compared": n}

    def _level_sizes(self) -> list[int]:
        assert self.kind is not None
        rows, columns = self.kind.height, self.kind.width
        return [num_positions(rows >> level, columns >> level) for level in range(num_levels(rows, columns))]

    def _shared_positions(self) -> "SharedPositions":
        if self._shared is None:
            self._shared = SharedPositions(self.seed, self._level_sizes())
        return self._shared


class SharedPositions:
    """The patch positions of ``reference`` for any batch, in the order in which the program samples them.

    That order is, batch by batch, the levels of the generated set and then those of the real set. It does not depend on
    the order in which the sets arrive here.
    """

    def __init__(self, seed: int, level_sizes: list[int]) -> None:
        self._level_sizes = level_sizes
        self._sampled: list[dict[bool, list[Tensor]]] = []
        self._states = [torch.Generator().manual_seed(seed).get_state()]  # before the first batch, after it, ...

    def of_images(self, images: range, real: bool) -> list[Int[Tensor, "B patches"]]:
        """Return the positions for every level of images of a set, by their numbers in it."""
        batches = [self._of_batch(image // _BATCH)[real] for image in images]
        return [torch.stack(level) for level in zip(*batches, strict=True)]

    def after_images(self, num_images: int) -> torch.Generator:
        """Return a random source in the state of the program's after the batches of so many images."""
        batches = math.ceil(num_images / _BATCH)
        self._of_batch(batches - 1)
        return self._source(batches)

    def _of_batch(self, batch: int) -> dict[bool, list[Int[Tensor, "patches"]]]:
        while len(self._sampled) <= batch:
            rng = self._source(len(self._sampled))
            self._sampled.append(
                {real: [shared_positions(size, rng) for size in self._level_sizes] for real in (False, True)}
            )
            self._states.append(rng.get_state())
        return self._sampled[batch]

    def _source(self, batches: int) -> torch.Generator:
        rng = torch.Generator()
        rng.set_state(self._states[batches])
        return rng


def num_levels(rows: int, columns: int) -> int:
    """Return how many levels the pyramid has: halved for as long as 16 rows and columns are left."""
    if min(rows, columns) < _COARSEST:
        raise ConfigError(
            f"range images of {rows}x{columns}",
            f"at least {_COARSEST} rows and columns, for {_PATCH}x{_PATCH} patches at every scale",
            "use another metric, or a sensor with more rows and columns",
        )
    levels = int(math.log2(min(rows, columns) // _COARSEST)) + 1
    step = 2 ** (levels - 1)
    if rows % step or columns % step:
        raise ConfigError(
            f"range images of {rows}x{columns}",
            f"rows and columns that are multiples of {step}, to be halved {levels - 1} times",
            "project with another number of columns: sensor.with_columns(...)",
        )
    return levels


def laplacian_pyramid(images: Float[Tensor, "B H W"], *, shifted: bool) -> list[Float[Tensor, "B _ _"]]:
    """Split images into what each scale adds to the next coarser one, finest first; the last is the coarsest image.

    Azimuth is not treated as circular: borders are mirrored, as in both sources.

    Args:
        images: encoded range images, in [-1, 1].
        shifted: True repeats LidarGRIT's program, where a coarse pixel lands one pixel down and right of where it came
            from; False keeps it in its place.
    """
    levels = []
    for _ in range(num_levels(*images.shape[1:]) - 1):
        coarse = _halved(_halved(images, dim=2), dim=1)
        levels.append(images - _doubled(_doubled(coarse, 1, shifted), 2, shifted))
        images = coarse
    return [*levels, images]


# Burt and Adelson, The Laplacian pyramid as a compact image code, 1983: the kernel [1, 4, 6, 4, 1] / 16 along rows and
# columns. Pixels that the next level leaves out are never computed, nor is anything multiplied by the zeros between
# coarse pixels: one axis after the other takes a sixth of the time of a 5x5 convolution.


def _halved(images: Float[Tensor, "B _ _"], dim: int) -> Float[Tensor, "B _ _"]:
    """Blur along one axis and keep the even pixels; borders are mirrored."""
    line = images.transpose(dim, 2)
    line = F.pad(line, (2, 2), mode="reflect")
    outer, inner = line[..., :-4:2] + line[..., 4::2], line[..., 1:-3:2] + line[..., 3:-1:2]
    return outer.div_(16).add_(inner, alpha=4 / 16).add_(line[..., 2:-2:2], alpha=6 / 16).transpose(dim, 2)


def _doubled(coarse: Float[Tensor, "B _ _"], dim: int, shifted: bool) -> Float[Tensor, "B _ _"]:
    """Double one axis: pixels go to the even (shifted: odd) positions, and those between are interpolated.

    Mirroring the fine line at its borders repeats the coarse pixel at one end and mirrors at the other.
    """
    n = coarse.shape[dim]
    before, after = (0, n - 2) if shifted else (1, n - 1)
    line = torch.cat((coarse.narrow(dim, before, 1), coarse, coarse.narrow(dim, after, 1)), dim=dim)
    left, here, right = (line.narrow(dim, start, n) for start in (0, 1, 2))
    on = (left + right).div_(8).add_(here, alpha=6 / 8)
    between = (left + here if shifted else here + right).div_(2)
    pair = (between, on) if shifted else (on, between)
    return torch.stack(pair, dim=dim + 1).flatten(dim, dim + 1)


def num_positions(rows: int, columns: int) -> int:
    """Return the number of patch positions in an image; position p has its corner at (p // k, p % k), k per row."""
    return (rows - _PATCH + 1) * (columns - _PATCH + 1)


def shared_positions(num: int, rng: torch.Generator) -> Int[Tensor, "patches"]:
    """Sample 128 of ``num`` positions without replacement, or return all in random order if there are fewer."""
    return torch.randperm(num, generator=rng)[:_PATCHES]


def own_positions(
    range_m: Float[Tensor, "B H W"], pyramid: list[Float[Tensor, "B _ _"]], seed: int, real: bool
) -> list[Int[Tensor, "B patches"]]:
    """Sample 128 positions per image and level, with replacement, by a seed made of the image, its set and ``seed``."""
    positions = [torch.empty(len(level), _PATCHES, dtype=torch.int64) for level in pyramid]
    for index, image in enumerate(range_m.float().cpu().contiguous().numpy()):
        content = hashlib.blake2b(image.tobytes(), digest_size=8, key=f"{seed} {int(real)}".encode())
        rng = torch.Generator().manual_seed(int.from_bytes(content.digest(), "big", signed=True))
        for level, chosen in zip(pyramid, positions, strict=True):
            chosen[index] = torch.randint(num_positions(*level.shape[1:]), (_PATCHES,), generator=rng)
    return positions


def descriptors(images: Float[Tensor, "B h w"], positions: Int[Tensor, "#B patches"]) -> Float[Tensor, "B patches 49"]:
    """Cut the 7x7 patches whose corners lie at given positions, either shared by all images or one set per image."""
    columns = images.shape[2]
    per_row = columns - _PATCH + 1
    positions = positions.to(images.device)
    corner = positions // per_row * columns + positions % per_row
    offset = torch.arange(_PATCH, device=images.device)
    pixel = corner[..., None] + (offset[:, None] * columns + offset).flatten()  # (B or 1, patches, 49)
    pixel = pixel.expand(len(images), -1, -1)
    return images.flatten(1).gather(1, pixel.flatten(1)).view(pixel.shape)


def standardised(patches: Float[Tensor, "n 49"], correction: int) -> Float[Tensor, "n 49"]:
    """Scale all numbers of a set together to mean 0 and deviation 1.

    Args:
        correction: 1 for the unbiased deviation, 0 for that of the set itself.
    """
    deviation, mean = torch.std_mean(patches, correction=correction)
    return (patches - mean) / (deviation + 1e-8)  # a set of constant images becomes 0, not NaN


def random_directions(rng: torch.Generator, *, unit_length: bool) -> Float[Tensor, "49 directions"]:
    """Sample 128 normally distributed directions, divided by their length or, as LidarGRIT does, their deviation."""
    directions = torch.randn(_PATCH**2, _DIRECTIONS, generator=rng)
    return directions / (directions.norm(dim=0) if unit_length else directions.std(dim=0))


def sliced_distance(
    first: Float[Tensor, "n 49"], second: Float[Tensor, "n 49"], directions: Float[Tensor, "49 directions"]
) -> float:
    """Return the mean over directions of the 1-D Wasserstein distance of the projected sets.

    Between equally large sets on a line that is the mean difference of their sorted members.
    """
    total = 0.0
    for some in directions.T.split(max(1, _MAX_PROJECTED // len(first))):
        # numpy sorts in place and without indices, several times faster than torch on a CPU
        projected = [np.sort((some @ patches.T).numpy(), axis=1) for patches in (first, second)]
        total += float(np.abs(projected[0] - projected[1]).mean(dtype=np.float64, axis=1).sum())
    return total / directions.shape[1]
