"""The data types that packages pass to one another; ranges are metres, and a return mask is True = a return."""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Shaped
from torch import Tensor

from lidargrit.core.errors import OR_LEAVE_IT_OUT, ConfigError, ScanError
from lidargrit.scans.columns import BadPoints, ScanParts, Values, columns_of_arrays, parts_of_columns, selected
from lidargrit.scans.file_rows import FileRows
from lidargrit.scans.planes import NO_PLANES, checked_planes, common_planes, masked_planes, planes_of
from lidargrit.scans.sensors import SensorModel

TYPICAL_LOG_RANGE = 2.5  # ln(1 + range in metres) in the middle of what scans hold: subtracted, inputs are near 0

MaskDecoding = Literal["bernoulli", "threshold"]
"""How returns are decided from their probabilities: each at random, or wherever a return is likelier than none."""


@dataclass(frozen=True, eq=False)
class Scan:
    """The points of one revolution, in the sensor's frame (x forward, y left, z up).

    Args:
        points_xyz_m: coordinates in metres, kept in 32 bits.
        reflectance: reflectance of every point, in [0, 1], kept in 32 bits.
        ring: index of the laser of every point, 0 = the highest.
        label: class of every point by SemanticKITTI's numbers, with its instance in the upper 16 of 32 bits.
        source: file or other origin of the scan, for messages.
        full_scale: number that reflectance was divided by, 1, 255 or 65,535, where the file does not tell and the
            values decided; 0 elsewhere.
        notes: sentences on what was taken or left out when the file was read, for those who look at the scan.
        point_time_s: time of every point in seconds, kept in 64 bits: on the clock of ``time_s``, or since the scan
            began; None if it is not known.
        filled: True for points that a model added to the measured ones; None where none did.
        rows: rows of the file that the points were read from; None where the format keeps none.
        time_s: time in seconds, on one clock for all scans of a recording; None if it is not known.
        pose: matrix from the sensor's frame to that of the recording, kept in 64 bits; None if it is not known.

    Raises:
        ScanError: no point, a coordinate that is not finite, a point at the origin, or a reflectance outside [0, 1].
    """

    points_xyz_m: Float[Tensor, "n 3"]
    reflectance: Float[Tensor, "n"] | None = None
    ring: Int[Tensor, "n"] | None = None
    label: Int[Tensor, "n"] | None = None
    source: str = "a scan"
    full_scale: int = 0
    notes: tuple[str, ...] = ()
    filled: Bool[Tensor, "n"] | None = None
    rows: FileRows | None = None
    time_s: float | None = None
    pose: Float64[Tensor, "4 4"] | None = None
    point_time_s: Float[Tensor, "n"] | None = None

    @classmethod
    def from_points(
        cls,
        xyz: np.ndarray | Tensor,
        intensity: Values | None = None,
        ring: Values | None = None,
        time: Values | None = None,
        label: Values | None = None,
        bad_points: BadPoints = "refuse",
    ) -> "Scan":
        """Make a scan of arrays, of NumPy or torch on any device.

        Args:
            xyz: coordinates (n, 3) in metres in the sensor's frame, x forward, y left, z up; with intensity (n, 4).
            intensity: intensity or reflectance (n,), from 0 to 1, 255 or 65,535: the smallest that no value exceeds.
            ring: index of each point's laser (n,), counted from the top or from the bottom.
            time: time of each point (n,), in seconds, or in nanoseconds as whole numbers.
            label: class of each point (n,) by SemanticKITTI's numbers.
            bad_points: treatment of points that are no returns: ``refuse`` raises an error, ``drop`` removes points
                with NaN or infinite coordinates and points at the origin.

        Raises:
            ScanError: an array of another shape, or points that cannot be used; says what is wrong and what to do.

        Example:
            >>> import numpy as np
            >>> scan = Scan.from_points(np.array([[10.0, 0.0, -1.0], [0.0, 5.0, -1.0]]), intensity=[12, 255])
            >>> len(scan), round(float(scan.reflectance[0]), 3)
            (2, 0.047)
        """
        columns = columns_of_arrays(xyz, intensity=intensity, ring=ring, time=time, label=label)
        source = "the points in memory"
        return cls(**parts_of_columns(columns, source, bad_points), source=source)

    def __post_init__(self) -> None:
        if len(self) == 0:
            raise ScanError(f"no point in {self.source}", "a full revolution", "take another scan" + OR_LEAVE_IT_OUT)
        object.__setattr__(self, "points_xyz_m", self.points_xyz_m.float())  # those of NumPy often have 64 bits
        if self.reflectance is not None:
            object.__setattr__(self, "reflectance", self.reflectance.float())
        for name in ("reflectance", "ring", "label", "filled", "point_time_s"):
            values: Tensor | None = getattr(self, name)
            if values is not None and values.shape != (len(self),):
                raise ScanError(
                    f"{name} of shape {tuple(values.shape)} in {self.source}",
                    f"one for each of {len(self)} points",
                    "fix it",
                )
        if self.point_time_s is not None:
            object.__setattr__(self, "point_time_s", self.point_time_s.double())
        # Point by point takes twenty times as long as over all coordinates at once, and is seldom needed.
        low, high = self.points_xyz_m.aminmax()  # NaN where any is: no comparison holds
        if not (bool(low > -torch.inf) and bool(high < torch.inf)):
            self._refuse(~self.points_xyz_m.isfinite().all(dim=1), "with NaN or infinite coordinates")
        if self.points_xyz_m.count_nonzero() < self.points_xyz_m.numel():
            self._refuse((self.points_xyz_m == 0).all(dim=1), "at the origin (placeholders for no return)")
        if self.reflectance is not None:
            low, high = (float(v) for v in self.reflectance.aminmax())  # NaN where any is
            if math.isnan(low):
                self._refuse(self.reflectance.isnan(), "with NaN for reflectance", "a number for each")
            if not (low >= 0 and high <= 1):
                raise ScanError(
                    f"reflectance from {low:g} to {high:g} in {self.source}",
                    "values in [0, 1]",
                    "scale the fourth column, e.g. divide an intensity of 0..255 by 255"
                    if low >= 0
                    else "check the layout: the file may have three or five columns, not x, y, z, reflectance",
                )

    def _refuse(
        self, bad: Bool[Tensor, "n"], what: str, wanted: str = "finite coordinates away from the origin"
    ) -> None:
        if bool(bad.any()):
            raise ScanError(
                f"{int(bad.sum())} of {len(self)} points {what} in {self.source}",
                wanted,
                "remove these points, or drop them by --bad-points drop (in Python: Scan.from_points(points, "
                "bad_points='drop'))",
            )

    def __len__(self) -> int:
        return self.points_xyz_m.shape[0]

    def measured(self) -> "Scan":
        """Return the scan without the points that a model added."""
        if self.filled is None or bool(self.filled.all()):
            return self
        return replace(self.select(~self.filled), filled=None)

    def select(self, which: Bool[Tensor, "n"] | Int[Tensor, "k"]) -> "Scan":
        """Return some of the points with all that is known of them, by a mask or by their numbers."""
        parts = ScanParts(
            points_xyz_m=self.points_xyz_m,
            reflectance=self.reflectance,
            ring=self.ring,
            label=self.label,
            filled=self.filled,
            point_time_s=self.point_time_s,
            rows=self.rows,
        )
        return replace(self, **selected(parts, which))


@dataclass(frozen=True, eq=False)
class RangeImage:
    """One range image or a batch: row 0 is the highest elevation, column 0 the azimuth +pi, falling to the right.

    Args:
        range_m: Euclidean distance to the return, in metres, kept in 32 bits; 0 where there is none.
        return_mask: whether the beam came back.
        sensor: sensor whose rays the pixels are.
        planes: further planes of pixels that are known, by names of :data:`~lidargrit.scans.planes.PLANES`.

    Raises:
        ScanError: a range that is not finite, not positive on a return, or not 0 elsewhere.
        ConfigError: an image whose size is not the sensor's, or a plane of another name, size or type.
    """

    range_m: Float[Tensor, "*batch H W"]
    return_mask: Bool[Tensor, "*batch H W"]
    sensor: SensorModel
    planes: Mapping[str, Shaped[Tensor, "*batch H W"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "range_m", self.range_m.float())  # those of NumPy often have 64 bits
        self._check_shapes()
        if not self._is_valid():
            valid = torch.where(self.return_mask, (self.range_m > 0) & self.range_m.isfinite(), self.range_m == 0)
            raise ScanError(
                f"{int((~valid).sum())} pixels whose range contradicts their return mask",
                "a positive finite range on every return and 0 elsewhere",
                "build the image with RangeImage.masked",
            )

    def _check_shapes(self) -> None:
        size = tuple(self.range_m.shape[-2:])
        if size != (self.sensor.height, self.sensor.width):
            raise ConfigError(
                f"a range image of {size[0]}x{size[1]}",
                f"the {self.sensor.height}x{self.sensor.width} of the sensor {self.sensor.name!r}",
                "use the sensor's own size, or sensor.with_columns(...)",
            )
        if self.return_mask.shape != self.range_m.shape:
            wanted = f"the {tuple(self.range_m.shape)} of range_m"
            raise ConfigError(f"return_mask of {tuple(self.return_mask.shape)}", wanted, "give all one shape")
        object.__setattr__(self, "planes", checked_planes(self.planes, self.range_m.shape))

    def _is_valid(self) -> bool:
        if not self.range_m.numel() or self.range_m.is_meta:  # without values, where operations are only counted
            return True
        nearest, farthest = self.range_m.aminmax()  # NaN where any is: no comparison holds
        agrees = ((self.range_m > 0) == self.return_mask).all()
        return bool((nearest >= 0) & (farthest < torch.inf) & agrees)  # the host waits once for a GPU

    @classmethod
    def masked(
        cls,
        range_m: Float[Tensor, "*batch H W"],
        return_mask: Bool[Tensor, "*batch H W"],
        sensor: SensorModel,
        planes: Mapping[str, Shaped[Tensor, "*batch H W"]] = NO_PLANES,
    ) -> "RangeImage":
        """Make a range image of a clean range and a mask: planes of returns are set to 0 where nothing returned."""
        return cls(torch.where(return_mask, range_m, 0.0), return_mask, sensor, masked_planes(planes, return_mask))

    @classmethod
    def stack(cls, images: "Sequence[RangeImage]") -> "RangeImage":
        """Make one batch of single images of one sensor; a plane is kept if every image has it."""
        return cls._joined(images, torch.stack)

    @classmethod
    def cat(cls, batches: "Sequence[RangeImage]") -> "RangeImage":
        """Make one batch of several batches of one sensor; a plane is kept if every batch has it."""
        return cls._joined(batches, torch.cat)

    @classmethod
    def _joined(cls, images: "Sequence[RangeImage]", join: Callable[[list[Tensor]], Tensor]) -> "RangeImage":
        sensor_of_all([image.sensor for image in images])
        planes = common_planes([image.planes for image in images], join)
        range_m, mask = join([image.range_m for image in images]), join([image.return_mask for image in images])
        return images[0]._of_checked(range_m, mask, planes)

    @property
    def reflectance(self) -> Float[Tensor, "*batch H W"] | None:
        """Reflectance of the return, in [0, 1]; 0 where there is none. None if it is not known."""
        return self.planes.get("reflectance")

    @property
    def label(self) -> Int[Tensor, "*batch H W"] | None:
        """Class of what returned by SemanticKITTI's numbers, 0 where there is none; None if no class is known."""
        return self.planes.get("label")

    def with_planes(self, **changed: Shaped[Tensor, "*batch H W"] | None) -> "RangeImage":
        """Return the image with some of its planes changed, by name, or taken away by None."""
        return replace(self, planes=planes_of(**{**self.planes, **changed}))

    def __len__(self) -> int:
        return self.range_m.shape[0] if self.range_m.ndim > 2 else 1

    def __getitem__(self, index: int | slice | list[int]) -> "RangeImage":
        """Return one image of a batch, or a batch of some of its images."""
        return self._moved(lambda pixels: pixels[index])

    def to(self, device: torch.device | str) -> "RangeImage":
        """Return the image with its pixels on another device."""
        return self._moved(lambda pixels: pixels.to(device))

    def _moved(self, move: Callable[[Tensor], Tensor]) -> "RangeImage":
        planes = {name: move(pixels) for name, pixels in self.planes.items()}
        return self._of_checked(move(self.range_m), move(self.return_mask), planes)

    def _of_checked(self, range_m: Tensor, return_mask: Tensor, planes: Mapping[str, Tensor]) -> "RangeImage":
        """Return an image of pixels whose values were checked when they came: another check would wait for a GPU."""
        made = copy(self)
        vars(made).update(range_m=range_m, return_mask=return_mask, planes=planes)
        made._check_shapes()
        return made

    def mapped(self, change: Callable[[Tensor], Tensor], sensor: SensorModel | None = None) -> "RangeImage":
        """Return the image in which range, mask and whatever else it has are changed alike.

        Args:
            change: function of the pixels.
            sensor: sensor of the changed pixels, where they are of another size.
        """
        planes = {name: change(pixels) for name, pixels in self.planes.items()}
        return RangeImage(change(self.range_m), change(self.return_mask), sensor or self.sensor, planes)


def sensor_of_all(sensors: Sequence[SensorModel]) -> SensorModel:
    """Return the sensor of all images of a batch, or raise ConfigError where two have different rays."""
    first = sensors[0]
    for other in sensors:
        if other is not first and not other.same_rays(first):
            got = f"images of the sensors {first.name!r} and {other.name!r} in one batch"
            raise ConfigError(got, "images of one sensor", "make a batch of each")
    return first


@dataclass(frozen=True, eq=False)
class TokenGrid:
    """The discrete tokens of a batch of range images, in the layout of the latent grid.

    Args:
        tokens: indices of codes.
        num_codes: number of codes in the codebook; every token is below it.

    Raises:
        ConfigError: a token outside [0, num_codes).
    """

    tokens: Int[Tensor, "*batch h w"]
    num_codes: int

    def __post_init__(self) -> None:
        if self.tokens.is_meta or not self.tokens.numel():  # without values, where operations are only counted
            return
        lowest, highest = self.tokens.aminmax()
        if bool((lowest < 0) | (highest >= self.num_codes)):
            raise ConfigError(
                f"tokens from {int(lowest)} to {int(highest)}",
                f"tokens of a codebook of {self.num_codes} codes",
                "use the tokenizer that made them",
            )

    @classmethod
    def unchecked(cls, tokens: Int[Tensor, "*batch h w"], num_codes: int) -> "TokenGrid":
        """Return a grid of tokens that a network of the package has just made: a check would wait for a GPU."""
        made = object.__new__(cls)
        vars(made).update(tokens=tokens, num_codes=num_codes)
        return made


@dataclass(frozen=True, eq=False)
class Decoded:
    """Output of a decoder for every pixel of a batch of scans, before returns are sampled.

    Args:
        range_m: range of the surface that the beam meets, in metres, whether or not it returns; 0 where a decoder of
            some pixels only tells none.
        return_logits: logits of the probability that the beam returns.
        sensor: sensor whose rays the pixels are.
        reflectance: reflectance of that surface, in [0, 1]; None from a decoder without reflectance.
        features: feature maps of the decoder, for networks that refine its output; None if it gives none.
        components: logits, centres and log scales of the likeliest components of the range's distribution, a mixture
            of logistic distributions of ln(1 + range in metres); None from a decoder of ranges alone.
    """

    range_m: Float[Tensor, "B H W"]
    return_logits: Float[Tensor, "B H W"]
    sensor: SensorModel
    reflectance: Float[Tensor, "B H W"] | None = None
    features: Float[Tensor, "B C H W"] | None = None
    components: Float[Tensor, "B 3 K H W"] | None = None

    def threshold(self) -> RangeImage:
        """Return the scans in which every beam returns whose probability is at least 0.5."""
        return self._masked(self.return_logits >= 0)

    def sample(self, rngs: Sequence[torch.Generator]) -> RangeImage:
        """Return scans in which every beam returns with its probability, independently of the others.

        Args:
            rngs: random generators on the CPU, one for each scan, so that no scan depends on its neighbours.
        """
        uniform = torch.stack([torch.rand(self.range_m.shape[1:], generator=rng) for rng in rngs])
        return self._masked(uniform.to(self.return_logits.device) < self.return_logits.sigmoid())

    def _masked(self, return_mask: Bool[Tensor, "B H W"]) -> RangeImage:
        return RangeImage.masked(self.range_m, return_mask, self.sensor, planes_of(reflectance=self.reflectance))
