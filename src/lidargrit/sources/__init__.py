"""What a user names as a source → range images: samples, prepared scans, scans on disk, or simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lidargrit.datasets import open_dataset
from lidargrit.generators import is_run, locate
from lidargrit.loading import (
    DataConfig,
    PreparedImages,
    Provenance,
    RangeImages,
    is_prepared,
    load_range_images,
)
from lidargrit.reporting import Reporter
from lidargrit.sensors import SensorModel
from lidargrit.sources.sample_formats import is_tensor_folder, read_tensor_folder
from lidargrit.sources.samples import is_sample_folder, read_samples, trained_on


def open_images(
    source: str,
    sensor: SensorModel | None = None,
    config: DataConfig | None = None,
    reporter: Reporter | None = None,
    samples_format: str = "",
) -> RangeImages:
    """Open a folder of samples, or any source of scans as range images of a sensor.

    Args:
        source: a folder of samples, of ours or of another program (``.pth``), or what data sets are opened by
            ("kitti_raw:ROOT:SPLIT", "FOLDER", ...).
        sensor: of scans; the data set's own if not given. Samples have theirs.
        config: how scans are read and projected, and how many at most; its sources and its sensor are not looked at.
        reporter: hears of the projection.
        samples_format: which program wrote a folder of ``.pth`` files; told from what is in them if empty.
    """
    config = config or DataConfig()
    if is_sample_folder(Path(source)):
        return read_samples(Path(source), config.max_scans or None)
    if samples_format or is_tensor_folder(Path(source)):
        return read_tensor_folder(Path(source), samples_format, config.max_scans or None)
    if is_prepared(source):
        prepared = PreparedImages(source)
        return load_range_images((source,), config, reporter, sensor or prepared.sensor)
    dataset = open_dataset(source, config.bad_points)
    return load_range_images((source,), replace(config, sensor=dataset.sensor), reporter, sensor)


def holds_images(source: str) -> bool:
    """Tell whether a source holds range images, as samples and prepared scans are, and not the points of scans."""
    return is_sample_folder(Path(source)) or is_tensor_folder(Path(source)) or is_prepared(source)


def warn_of_overlap(source: str, images: RangeImages | None, reference: RangeImages, reporter: Reporter) -> None:
    """Say what a set, or the model that made it, has seen of the reference.

    Args:
        source: of the set: samples or a run, whose training scans count, or scans.
        images: of the set, where it holds scans.
        reference: what it is compared with.
        reporter: hears of it.
    """
    if shared := overlap(source, images, reference):
        reporter.message(f"WARNING: {source} and the reference overlap ({shared}): the scores flatter it")


def overlap(source: str, images: RangeImages | None, reference: RangeImages) -> str:
    """Say in a few words what a set, or the model that made it, has in common with the reference; "" if nothing."""
    learned = Provenance() if images is None else images.provenance
    folder = locate(source)
    if is_sample_folder(folder) or is_run(folder):
        learned = trained_on(folder)
    return learned.overlap(reference.provenance)
