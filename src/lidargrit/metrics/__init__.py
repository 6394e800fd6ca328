"""Two sets of range images → a number; one metric = one file, which knows no generator and no global random state."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from typing import ClassVar

from torch import distributed

from lidargrit import _discovery
from lidargrit.errors import ConfigError, DataError, nearest_names
from lidargrit.structures import MetricResult, RangeImage


class Metric(ABC):
    """Compares a set of generated range images with a set of real ones, fed batch by batch.

    A subclass takes keyword options only, all with defaults, ``variant`` and ``seed`` among them. It changes none of
    its inputs. What it remembers survives pickling, so that the parts of several processes can be merged in one.

    Args:
        variant: which definition is used; the first of ``variants`` if not given.
        seed: of all that the metric draws.

    Raises:
        ConfigError: a variant that the metric does not have.
    """

    title: ClassVar[str]
    """One line for lists and reports."""
    higher_is_better: ClassVar[bool]
    """Direction of the value."""
    variants: ClassVar[tuple[str, ...]]
    """The definitions on offer, the default first."""
    needs_weights: ClassVar[str] = ""
    """Network whose published weights the metric looks through; empty for most."""

    def __init__(self, *, variant: str | None = None, seed: int = 0) -> None:
        self.variant = self.variants[0] if variant is None else variant
        self.seed = seed
        if self.variant not in self.variants:
            raise ConfigError(
                f"variant {self.variant!r} of the metric {self.name!r}",
                " or ".join(repr(known) for known in self.variants),
                "choose one of these",
            )

    @property
    def name(self) -> str:
        """The public name of the metric: that of its file."""
        return type(self).__module__.rpartition(".")[2]

    @abstractmethod
    def update(self, images: RangeImage, *, real: bool) -> None:
        """Take in a batch of real or of generated images; called as often as wanted, the two sets in any order."""

    @abstractmethod
    def compute(self) -> MetricResult:
        """Return the number for all images so far; may be called again after further updates.

        Raises:
            DataError: one of the sets has too few images.
        """

    @abstractmethod
    def merge(self, other: Metric) -> None:
        """Take in what another process has gathered, as if its images had been fed here after ours.

        Raises:
            ConfigError: the other was made with other options or fed with images of another kind.
        """

    def reduce(self) -> None:
        """Take in what all other processes of ``torch.distributed``'s group have gathered, in the order of their ranks.

        Every process must call it, and each then has the number for all images; alone, a process keeps what it has.
        """
        if not (distributed.is_available() and distributed.is_initialized()):
            return
        everyone: list[Metric | None] = [None] * distributed.get_world_size()
        distributed.all_gather_object(everyone, self)
        first, *others = (metric for metric in everyone if metric is not None)
        for other in others:
            first.merge(other)
        vars(self).update(vars(first))

    def require_same_options(self, other: Metric) -> None:
        """Refuse to merge with a metric of another kind, variant or seed."""
        mine, theirs = ((metric.name, metric.variant, metric.seed) for metric in (self, other))
        if mine != theirs:
            raise ConfigError(
                "to merge {} (variant {!r}, seed {})".format(*theirs),
                "{} (variant {!r}, seed {})".format(*mine),
                "make the metric with the same options in every process",
            )

    def require_images(self, num_generated: int, num_reference: int, at_least: int) -> None:
        """Refuse to compute from sets with fewer than ``at_least`` images."""
        if min(num_generated, num_reference) < at_least:
            raise DataError(
                f"{num_generated} generated and {num_reference} real range images for {self.name!r}",
                f"at least {at_least} of each",
                "sample more scans, or check the folder",
            )


def __getattr__(name: str) -> type[Metric]:
    """Find ``from lidargrit.metrics import SlicedWasserstein`` in ``sliced_wasserstein.py``, when it is asked for."""
    file = re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
    if not name[:1].isupper() or file not in _discovery.names("metrics"):
        meant = "".join(word.title() for word in nearest_names(file, _discovery.names("metrics"), 1).split("_"))
        hint = f"; did you mean {meant}?" if name[:1].isupper() else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    return load_metric(file)


def load_metric(name: str) -> type[Metric]:
    """Return the class of a metric by its name.

    Raises:
        UnknownNameError: no metric of that name; names its nearest neighbours.

    Example:
        >>> load_metric("sliced_wasserstein").higher_is_better
        False
    """
    return _discovery.load_class("metrics", name, Metric)
