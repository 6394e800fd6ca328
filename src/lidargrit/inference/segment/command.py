"""The verb segment: a source of scans, a segmenter and a folder → the scans with a label for every point."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from lidargrit.core.errors import ConfigError, DataError, ScanError
from lidargrit.core.files import claim_folder
from lidargrit.core.reporting import Reporter
from lidargrit.data.export import KittiTree, claimed_scans, write_with_labels
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.run_folder import locate, weights_sha256
from lidargrit.data.sources import open_source
from lidargrit.data.sources.named import ImageScans, NamedScans, named_scans
from lidargrit.inference.complete.inputs import ScanReader
from lidargrit.inference.segment import can_label, label_images, open_segmenter
from lidargrit.inference.segment.points import labels_of_points
from lidargrit.inference.segment.scores import LabelScores
from lidargrit.scans.classes import as_semantic_kitti
from lidargrit.scans.projection import unproject
from lidargrit.scans.types import CLASS_BITS, RangeImage, Scan
from lidargrit.systems.segmenter.system import Segmenter

MANIFEST = "segmented.json"


def segment_scans(
    source: str,
    out: Path,
    model: str = "pretrained",
    config: DataConfig | None = None,
    reporter: Reporter | None = None,
    device: str = "",
    numbering: str = "",
) -> tuple[int, LabelScores | None]:
    """Write scans into a tree of KITTI odometry, with SemanticKITTI's ``labels/NNNNNN.label`` beside them.

    Every point of a scan is there, in its order, with a label (:func:`~.points.labels_of_points`); of range images, a
    point on the ray of each return. Files that are there already are not written again.

    Args:
        source: a file, a folder or another source of scans, samples, prepared scans, or range images as ``.npy``.
        out: an empty folder, or one that the same command began.
        model: segmenter; see :func:`.open_segmenter`.
        config: number of scans, and what to do with unusable points and scans; nothing else of it is used.
        reporter: receiver of progress and messages.
        device: device to compute on.
        numbering: numbering of the scans' own labels, with which the found ones are compared; "" for no comparison.

    Returns:
        number of scans that are there now, and how well their own labels were found, None without a comparison.

    Raises:
        ConfigError: a run that does not label scans, range images of other rows, or own labels of another numbering.
        ScanError: a scan that cannot be used, or of another sensor.
        DataError: no usable scan, or own labels are missing where they are to be compared.
        OutputError: the folder holds something else, lies in the source, or cannot be written.
    """
    config, reporter = config or DataConfig(), reporter or Reporter()
    segmenter = open_segmenter(model, device)
    scans = _opened(source, segmenter, config)
    scans.check_output(out)
    files = KittiTree(out).files([scans.name(index) for index in range(len(scans))])
    identities = {file: scans.identity(index) for index, file in enumerate(files)}
    facts = {"source": source, "weights_sha256": weights_sha256(locate(model, "segment")), "scans": identities}
    missing = {index for index, file in enumerate(files) if not (out / file).exists()}
    scores = LabelScores() if numbering else None
    if scores is not None:
        _own_labels(_scan(scans, 0), numbering)  # a mistake is told before anything is written
    told = set[str]()
    with (
        claim_folder(out),
        claimed_scans(out / MANIFEST, facts) as left_out,
        reporter.progress("labelling", len(files), 0 if scores else len(files) - len(missing)) as progress,
    ):
        for index in range(len(files)) if scores else sorted(missing):
            try:
                scan = _scan(scans, index)
                found = _labelled(segmenter, scans, scan, index, told, reporter)
            except ScanError as error:
                if config.bad_scans == "refuse":
                    raise
                reporter.message(f"left out: {error}")
                left_out.add(files[index])
            else:
                if index in missing:
                    write_with_labels(out / files[index], found)
                if scores is not None:
                    assert found.label is not None
                    scores.add(found.label, _own_labels(scan, numbering))
            progress.advance(1)
    if len(left_out) == len(files):
        raise DataError(f"no usable scan in {source}", "at least one", "see the messages above")
    return len(files) - len(left_out), scores


def _opened(source: str, segmenter: Segmenter, config: DataConfig) -> NamedScans:
    """Open the scans of a source; refuse range images that the segmenter cannot label."""
    scans = named_scans(open_source(source, config.bad_points), config, segmenter.sensor)
    if isinstance(scans, ImageScans) and not can_label(segmenter.sensor, scans.images.sensor):
        of, own = scans.images.sensor, segmenter.sensor
        raise ConfigError(
            f"range images of {of.height}x{of.width} of the sensor {of.name!r} in {source}",
            f"images of the segmenter's {own.height} rows of {own.name!r}, and a multiple of its {own.width} columns",
            "name a segmenter of such images with --model, or give the scans as points",
        )
    return scans


def _scan(scans: NamedScans, index: int) -> Scan:
    """Return the points of a scan with the labels that it came with."""
    return unproject(scans.image(index)) if isinstance(scans, ImageScans) else scans.scan(index)


def _labelled(
    segmenter: Segmenter, scans: NamedScans, scan: Scan, index: int, told: set[str], reporter: Reporter
) -> Scan:
    """Return a scan whose every point has the label that the segmenter finds."""
    if isinstance(scans, ImageScans):
        return unproject(label_images(segmenter, RangeImage.stack([scans.image(index)]))[0])
    read = ScanReader(segmenter.sensor.fine(), partial=True).read(scan)
    if read.doubt and not told:
        told.add(read.doubt)
        reporter.message(f"WARNING: {read.doubt}")
    assert read.point_of_pixel is not None
    image = label_images(segmenter, RangeImage.stack([read.image]))[0]
    label = labels_of_points(scan, image, read.point_of_pixel, read.method)
    unlabelled = int((label == 0).sum())
    if unlabelled and "unlabelled" not in told:
        told.add("unlabelled")
        what = f"{unlabelled:,} of {len(scan):,} points have no return of the image nearby, and the label 0"
        reporter.message(f"{scan.source}: {what}; so may points of further scans")
    return replace(scan, label=label)


def _own_labels(scan: Scan, numbering: str) -> torch.Tensor:
    if scan.label is None:
        raise DataError(f"no labels in {scan.source}", "labels to compare with", "leave --compare out")
    return as_semantic_kitti(scan.label & CLASS_BITS, numbering)
