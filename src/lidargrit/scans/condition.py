"""What is known of scans that are to be generated: nothing, or range images and masks → :class:`Observed`."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from itertools import chain
from typing import Any, Literal, Self

import torch
from jaxtyping import Bool, Float, Int, Int64, Shaped
from torch import Tensor

from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.scans.planes import checked_planes, common_planes
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage, sensor_of_all

ConditionKind = Literal["pixels", "surfaces"]
"""What a condition knows of a pixel: whether the beam returned, and how far; or only how far the surface is."""

KINDS: dict[ConditionKind, str] = {
    "pixels": "pixels of which range and return are known",
    "surfaces": "ranges of surfaces of which it is not known whether they return",
}


@dataclass(frozen=True, eq=False)
class Condition:
    """What is known of each scan of a batch; a generator generates scans of which it holds.

    A subclass is a frozen dataclass of tensors, or mappings of them, the first axis of each for the scans; it may have
    a field ``sensor`` besides.
    """

    def __len__(self) -> int:
        """Return the number of scans; 0 for any."""
        values = (getattr(self, each.name) for each in fields(self))
        known = chain.from_iterable(each.values() if isinstance(each, Mapping) else (each,) for each in values)
        return max((len(each) for each in known if isinstance(each, Tensor)), default=0)

    def __getitem__(self, index: slice | list[int]) -> Self:
        """Return what is known of some of the scans."""
        return self._mapped(lambda known: known[index])

    def to(self, device: torch.device | str) -> Self:
        """Return it with its tensors on another device."""
        return self._mapped(lambda known: known.to(device))

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """Return what is known of the scans of several batches as one; a plane is kept if every batch has it."""
        made = copy(parts[0])  # checked already, as each part
        vars(made).update({each.name: made._joined(each.name, parts) for each in fields(made)})
        return made

    def _joined(self, name: str, parts: "Sequence[Condition]") -> Any:
        """Return a field of several batches as one."""
        values = [getattr(part, name) for part in parts]
        if isinstance(values[0], Mapping):
            return common_planes(values, torch.cat)
        return torch.cat(values) if isinstance(values[0], Tensor) else sensor_of_all(values)

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> Self:
        made = copy(self)  # the scans were checked already, and a check would wait for their device
        for name, value in ((each.name, getattr(self, each.name)) for each in fields(self)):
            if isinstance(value, Mapping):
                vars(made)[name] = {key: change(known) for key, known in value.items()}
            elif isinstance(value, Tensor):
                vars(made)[name] = change(value)
        return made

    def put_into(self, generated: RangeImage) -> RangeImage:
        """Return generated scans in which all that is known pixel by pixel stands as it is known."""
        return generated


@dataclass(frozen=True)
class Nothing(Condition):
    """Nothing is known, of as many scans as are asked for."""


NOTHING = Nothing()


@dataclass(frozen=True, eq=False)
class Observed(Condition):
    """The observed part of a batch of scans, on the sensor's grid; everything else is generated.

    Every quantity has a mask of its own that says where it was observed. Values elsewhere have no influence.

    Args:
        range_m: range of the surface that the beam meets, in metres, kept in 32 bits.
        range_observed: True where the range is known.
        return_mask: True where the beam came back.
        return_observed: True where it is known whether the beam came back.
        sensor: sensor whose rays the pixels are.
        planes: further planes of the observed surfaces or returns, by names of :data:`~lidargrit.scans.planes.PLANES`.
        earlier_seeds: seeds of the images whose columns lie before those of each image in one scan, the nearest last,
            and -1 for none; None where the images are scans of their own. Drops of neighbouring columns depend on them.

    Raises:
        ConfigError: masks or planes of another size or type than the ranges, or no batch.
        ScanError: an observed range that is not positive and finite, an observed return without a range, or its
            reflectance outside [0, 1].
    """

    range_m: Float[Tensor, "B H W"]
    range_observed: Bool[Tensor, "B H W"]
    return_mask: Bool[Tensor, "B H W"]
    return_observed: Bool[Tensor, "B H W"]
    sensor: SensorModel
    planes: Mapping[str, Shaped[Tensor, "B H W"]] = field(default_factory=dict)
    earlier_seeds: Int64[Tensor, "B K"] | None = None

    def __post_init__(self) -> None:
        _check_mask(self.range_observed, self.range_m)
        _check_mask(self.return_observed, self.range_m)
        _check_mask(self.return_mask, self.range_m, "a mask of returns")
        object.__setattr__(self, "range_m", self.range_m.float())  # those of NumPy often have 64 bits
        size = (len(self.range_m), self.sensor.height, self.sensor.width)
        if self.range_m.shape != size:
            raise ConfigError(f"range_m of {tuple(self.range_m.shape)}", f"{size}, of the sensor", "give all one shape")
        object.__setattr__(self, "planes", checked_planes(self.planes, self.range_m.shape))
        if not bool((((self.range_m > 0) & self.range_m.isfinite()) | ~self.range_observed).all()):
            raise ScanError("an observed range of 0 metres, NaN or infinity", "positive metres", "mark it as unknown")
        if bool((self.return_observed & self.return_mask & ~self.range_observed).any()):
            raise ScanError("an observed return of unknown range", "both, or neither", "mark it as unknown")
        if self.reflectance is not None:
            returned = self.return_observed & self.return_mask
            within = (self.reflectance >= 0) & (self.reflectance <= 1)  # NaN is neither
            if not bool((within | ~returned).all()):
                got = "an observed return whose reflectance is NaN, below 0 or above 1"
                raise ScanError(got, "values in [0, 1]", "scale it, e.g. divide an intensity of 0..255 by 255")

    @classmethod
    def of_pixels(cls, images: RangeImage, observed: Bool[Tensor, "B H W"]) -> "Observed":
        """Return the condition that some pixels of scans were observed, whether they have a return or not.

        Args:
            images: batch of range images (B, H, W); pixels that were not observed have no influence.
            observed: True for observed pixels.
        """
        _check_mask(observed, images.range_m)
        returned = images.return_mask & observed
        seen = RangeImage.masked(images.range_m, returned, images.sensor, images.planes)
        return cls(seen.range_m, returned, returned, observed, images.sensor, seen.planes)

    @classmethod
    def of_surfaces(cls, clean: RangeImage, unknown: Bool[Tensor, "B H W"] | None = None) -> "Observed":
        """Return the condition that the ranges of all surfaces are known, and that only surfaces can return.

        Args:
            clean: batch of range images (B, H, W) in which every beam that meets a surface returns.
            unknown: True for pixels of which nothing is known; none if not given.
        """
        unknown = torch.zeros_like(clean.return_mask) if unknown is None else unknown
        _check_mask(unknown, clean.range_m, "unknown pixels")
        hit = clean.return_mask & ~unknown
        planes = {} if clean.label is None else {"label": torch.where(hit, clean.label, 0)}
        return cls(clean.range_m, hit, torch.zeros_like(hit), ~clean.return_mask & ~unknown, clean.sensor, planes)

    @classmethod
    def nothing(cls, sensor: SensorModel, count: int, device: torch.device | str = "cpu") -> "Observed":
        """Return the condition of a number of scans of which nothing was observed."""
        none = torch.zeros(1, sensor.height, sensor.width, dtype=torch.bool)
        one = cls(none.float(), none, none, none, sensor)
        return one._mapped(lambda unknown: torch.zeros((count, *unknown.shape[1:]), dtype=unknown.dtype, device=device))

    def _joined(self, name: str, parts: Sequence[Condition]) -> Any:
        if name == "earlier_seeds":
            return _earlier_seeds([part for part in parts if isinstance(part, Observed)])
        return super()._joined(name, parts)

    @property
    def reflectance(self) -> Float[Tensor, "B H W"] | None:
        """Reflectance in [0, 1] of the observed returns; None if it is not known."""
        return self.planes.get("reflectance")

    @property
    def label(self) -> Int[Tensor, "B H W"] | None:
        """Class of the surface by SemanticKITTI's numbers, 0 where it is not known; None if no class is known."""
        return self.planes.get("label")

    @property
    def kinds(self) -> frozenset[ConditionKind]:
        """Kinds of observations in the condition; rays that are known not to return are of neither."""
        found: dict[ConditionKind, Tensor] = {
            "pixels": self.range_observed & self.return_observed,
            "surfaces": self.range_observed & ~self.return_observed,
        }
        return frozenset(kind for kind, mask in found.items() if bool(mask.any()))

    @property
    def has_all_surfaces(self) -> bool:
        """Whether each ray's range is observed, or that it does not return, and the return of some rays is open."""
        return bool((self.range_observed | self.return_observed).all()) and "surfaces" in self.kinds

    @property
    def images(self) -> RangeImage:
        """The observed returns as range images, without a return in all other pixels."""
        kept = self.return_mask & self.return_observed
        return RangeImage.masked(self.range_m, kept, self.sensor, self.planes)

    @property
    def surfaces(self) -> RangeImage:
        """Range images in which every surface of known range returns."""
        return RangeImage.masked(self.range_m, self.range_observed, self.sensor, self.planes)

    def put_into(self, generated: RangeImage) -> RangeImage:
        """Return generated scans in which all observed values are put in, bit for bit.

        Labels are kept where both have them; reflectance as well, and where no return was observed.
        """
        returned = torch.where(self.return_observed, self.return_mask, generated.return_mask)
        range_m = torch.where(self.range_observed, self.range_m, generated.range_m)
        observed = {"reflectance": self.return_observed & self.return_mask, "label": self.range_observed}
        planes = {
            name: torch.where(observed[name], self.planes[name], pixels)
            for name, pixels in generated.planes.items()
            if name in self.planes
        }
        if generated.reflectance is not None and not bool(observed["reflectance"].any()):
            planes.setdefault("reflectance", generated.reflectance)
        return RangeImage.masked(range_m, returned, self.sensor, planes)


def _earlier_seeds(parts: Sequence["Observed"]) -> Int64[Tensor, "B K"] | None:
    """Return the seeds of all images, as many of each as the scan of most images has, those that lack filled by -1."""
    known = [part.earlier_seeds for part in parts if part.earlier_seeds is not None]
    if not known:
        return None
    most = max(seeds.shape[1] for seeds in known)
    padded = []
    for part in parts:
        seeds = torch.full((len(part), most), -1, device=part.return_mask.device)
        if part.earlier_seeds is not None and part.earlier_seeds.shape[1]:
            seeds[:, -part.earlier_seeds.shape[1] :] = part.earlier_seeds
        padded.append(seeds)
    return torch.cat(padded)


def _check_mask(observed: Bool[Tensor, "..."], range_m: Float[Tensor, "..."], what: str = "observed pixels") -> None:
    """Refuse a mask whose shape is not that of the ranges, with ConfigError that says ``what`` it is."""
    if range_m.ndim != 3:
        raise ConfigError(f"ranges of shape {tuple(range_m.shape)}", "(B, H, W), a batch of images", "add a batch axis")
    if observed.shape != range_m.shape or observed.dtype != torch.bool:
        raise ConfigError(
            f"{what} of shape {tuple(observed.shape)} and type {observed.dtype}",
            f"{tuple(range_m.shape)} and torch.bool, one for each pixel of a batch of images",
            "give a mask for each image",
        )
