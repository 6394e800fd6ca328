"""Range images → their labels, by a segmenter or their own, for metrics that compare what stands in two sets."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, final

import numpy as np

from lidargrit.core.errors import DataError, WeightsError
from lidargrit.data.run_folder import PACKAGED, locate, read_config, weights_sha256
from lidargrit.evaluation.metrics import FeatureExtractor, Metric
from lidargrit.evaluation.metrics.shared.accumulators import SumAccumulator
from lidargrit.inference.segment import can_label, label_images, open_segmenter
from lidargrit.nn.devices import usable_device
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.segmenter.system import Segmenter

_SEGMENTER = "segmenter"


@dataclass(frozen=True)
class Labelled(FeatureExtractor[RangeImage]):
    """Images with labels.

    Args:
        run: folder of the segmenter's run; None for the images' own labels.
    """

    run: Path | None
    device: str = "cpu"

    def __call__(self, images: RangeImage) -> RangeImage:
        """Return the images with labels; a segmenter sees no reflectance, which many generated scans do not have."""
        if self.run is not None:
            return label_images(_loaded(self.run, self.device), images.with_planes(reflectance=None))
        if images.label is None:
            raise DataError("range images without labels", "labels in both sets", "--variant segmented")
        return images


class LabelMetric(Metric[RangeImage, np.ndarray]):
    """Compares what stands in two sets of images, by labels; only counts are kept.

    Args:
        variant: ``segmented``: both sets are labelled by one segmenter, also scans that have labels, so that its errors
            fall on both; ``labelled``: both sets have labels of their own, as simulated scans do.
        seed: seed of nothing: the metric has no random numbers.
        weights: folder of a segmenter's run; if not given, the segmenter in the package that has the images' rows.
        device: device on which the segmenter computes, such as "cuda".
    """

    bounds = (0.0, 1.0)
    variants = ("segmented", "labelled")
    needs_weights = _SEGMENTER
    sees_objects = True
    fewest_images = 1
    accumulator = SumAccumulator

    def __init__(
        self, *, variant: str | None = None, seed: int = 0, weights: Path | None = None, device: str = "cpu"
    ) -> None:
        super().__init__(variant=variant, seed=seed)
        self.weights, self.device = weights, str(usable_device(device))
        self._run: Path | None = None

    @property
    def weights_sha256(self) -> str:
        """Hash of the segmenter's weights; empty before the first image, and where it is not used."""
        return "" if self._run is None else weights_sha256(self._run)

    @final
    def extractor(self, sensor: SensorModel) -> Labelled:
        """Return what labels images of a sensor."""
        if self.variant == "segmented" and self._run is None:
            self._run = segmenter_of(sensor, self.weights)
        return Labelled(self._run, self.device)

    @final
    def options(self) -> str:
        """Return what metrics must have in common to be merged, the segmenter among it."""
        return f"{super().options()} of labels by {self.weights or 'the package'}"

    def segmenter_details(self) -> dict[str, Any]:
        """Return what identifies the segmenter, for the details of a result."""
        return {"weights": {"file": self._run.name, "sha256": self.weights_sha256}} if self._run else {}


def segmenter_of(sensor: SensorModel, named: Path | None = None) -> Path:
    """Return the folder of the segmenter for images of a sensor.

    Args:
        named: folder of a run, or of a bundle; None for the package's own.
    """
    folders = [locate(each, "segment") for each in (PACKAGED if named is None else [named])]
    configs = {folder: read_config(folder) for folder in folders}
    segmenters = {folder: each.sensor for folder, each in configs.items() if each.generator == _SEGMENTER}
    for folder, own in segmenters.items():
        if can_label(own, sensor):
            return folder
    have = " or ".join(f"{own.name} {own.height}x{own.width}" for own in segmenters.values())
    raise WeightsError(
        f"range images of {sensor.name} {sensor.height}x{sensor.width} to be labelled by {named or 'the package'}",
        f"the rows of {have}, and a multiple of its columns" if have else "a segmenter's run",
        "train a segmenter of this sensor (lidargrit train segmenter_compact RUN --set data.sensor=...), and name it: "
        "--weights segmenter=RUN",
    )


@lru_cache(maxsize=2)
def _loaded(run: Path, device: str) -> Segmenter:
    return open_segmenter(str(run), device)
