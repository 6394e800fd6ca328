"""The verb segment: a source of scans, a segmenter and a folder → the scans with a label for every point."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import torch
from jaxtyping import Int
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.errors import ConfigError, DataError
from lidargrit.core.table import Table
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.prepared.config import DEFAULTS, DataConfig
from lidargrit.data.run_folder import locate, weights_sha256
from lidargrit.data.scan_folder import KittiTree, ScanFolder, write_with_labels
from lidargrit.data.sources import open_source
from lidargrit.data.sources.named import ImageScans, NamedScans, named_scans
from lidargrit.generation.semantic_classes import class_iou
from lidargrit.inference.segment import can_label, label_images, open_segmenter
from lidargrit.inference.segment.points import PointLabels
from lidargrit.scans.classes import CLASS_BITS, CLASSES, Group, as_semantic_kitti
from lidargrit.scans.sensors import ProjectionOption
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.systems.segmenter.system import Segmenter

GROUPS = tuple(group for group in get_args(Group) if group)
GROUP_OF_NUMBER = torch.zeros(max(CLASSES) + 1, dtype=torch.int64)
"""Group of each of SemanticKITTI's numbers, from 1 in the order of ``GROUPS``; 0 for none."""
for _number, _class in CLASSES.items():
    GROUP_OF_NUMBER[_number] = GROUPS.index(_class.group) + 1 if _class.group else 0


class LabelScores:
    """Counts of points by true and found group of classes, over scans.

    Points whose true class is in no group do not count. A found class of no group is wrong.

    Source:
        the mean intersection over union of Behley et al., SemanticKITTI, ICCV 2019, over coarser classes.
    """

    def __init__(self) -> None:
        size = len(GROUPS) + 1
        self.counts = torch.zeros(size, size, dtype=torch.int64)
        """Number of points by true group (rows) and found group (columns); the first of each is no group."""

    def add(self, found: Int[Tensor, " n"], true: Int[Tensor, " n"]) -> None:
        """Count the points of a scan, of labels by SemanticKITTI's numbers."""
        pairs = GROUP_OF_NUMBER[true.long()] * len(self.counts) + GROUP_OF_NUMBER[found.long()]
        self.counts += pairs.bincount(minlength=self.counts.numel()).view_as(self.counts)

    def intersection_over_union(self) -> dict[str, float]:
        """Return the score of each group of which there are true points, in [0, 1]."""
        scores = class_iou(self.counts.double()).tolist()
        return {group: score for group, score in zip(GROUPS, scores, strict=True) if not math.isnan(score)}

    def mean(self) -> float:
        """Return the mean over the groups of which there are true points; NaN without any."""
        each = self.intersection_over_union().values()
        return sum(each) / len(each) if each else float("nan")

    def as_table(self) -> str:
        """Return the scores as a table for a person."""
        rows = [*self.intersection_over_union().items(), ("mean", self.mean())]
        head = ("group", "intersection over union")
        return Table(head, tuple((name, f"{score:.3f}") for name, score in rows)).as_text()

    def as_json(self) -> dict[str, Any]:
        """Return the scores and the counts as plain values."""
        return {
            "intersection_over_union": self.intersection_over_union(),
            "mean": self.mean(),
            "groups": ["", *GROUPS],
            "points_by_true_and_found_group": self.counts.tolist(),
        }


MANIFEST = "segmented.json"


def segment_scans(
    source: str,
    out: Path,
    model: str = "pretrained",
    config: DataConfig = DEFAULTS,
    device: str = "",
    numbering: str = "",
) -> tuple[int, LabelScores | None]:
    """Write scans into a tree of KITTI odometry, with SemanticKITTI's ``labels/NNNNNN.label`` beside them.

    Every point of a scan is there, in its order, with a label (:func:`~.points.labels_of_points`); of range images, a
    point on the ray of each return. Files that are there already are not written again.

    Args:
        out: an empty folder, or one that the same command began.
        model: segmenter; see :func:`.open_segmenter`.
        config: number of scans, and what to do with unusable points and scans; nothing else of it is used.
        numbering: numbering of the scans' own labels, with which the found ones are compared; "" for no comparison.

    Returns:
        number of scans that are there now, and how well their own labels were found, None without a comparison.
    """
    segmenter = open_segmenter(model, device)
    source_scans = _opened(source, segmenter, config)
    source_scans.check_output(out)
    labels = _Labels(source_scans, segmenter, config.projection)
    files = KittiTree(out).files([source_scans.name(index) for index in range(len(source_scans))])
    identities = [source_scans.identity(index) for index in range(len(files))]
    facts = {"source": source, "weights_sha256": weights_sha256(locate(model, "segment"))}
    facts |= {"projection": config.projection} if config.projection != "sensor" else {}
    folder = ScanFolder(out, MANIFEST, facts, files, identities, config.bad_scans)
    scores = LabelScores() if numbering else None
    wanted = folder.missing if scores is None else range(len(files))
    with folder.writing("labelling", len(wanted)) as progress:
        for index in wanted:
            with folder.leaving_out(index):
                scan = source_scans.scan(index)
                own = _own_labels(scan, numbering) if numbering else None  # a mistake is told before a file is written
                if own is None:  # else the user knows that labels are of another numbering
                    source_scans.tell_notes(scan)
                label = labels.of(index, scan)
                if index in folder.missing:
                    if labels.sensor.name != KittiOdometry.sensor:  # else readers of such trees take it anyway
                        folder.tell_sensor(labels.sensor)
                    write_with_labels(out / files[index], replace(scan, label=label))
                if scores is not None and own is not None:
                    scores.add(label, own)
            progress.advance(1)
    return folder.num_written, scores


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


class _Labels:
    """The label that a segmenter finds for every point of a scan; what makes them doubtful is told once.

    Args:
        scans: scans of the source.
        segmenter: segmenter of a run.
        projection: way in which points find their rows.
    """

    def __init__(self, scans: NamedScans, segmenter: Segmenter, projection: ProjectionOption) -> None:
        self._scans, self._segmenter = scans, segmenter
        self._points = PointLabels(segmenter, projection)
        self.sensor = scans.images.sensor if isinstance(scans, ImageScans) else segmenter.sensor.fine()
        self._told = set[str]()

    def of(self, index: int, scan: Scan) -> Int[Tensor, " n"]:
        if isinstance(self._scans, ImageScans):
            image = label_images(self._segmenter, RangeImage.stack([self._scans.image(index)]))
            assert image.label is not None
            return image.label[image.return_mask]
        label, doubt = self._points.of(scan)
        if doubt:
            self._tell("doubt", f"WARNING: {doubt}")
        if unlabelled := int((label == 0).sum()):
            what = f"{unlabelled:,} of {len(scan):,} points have no return of the image nearby, and the label 0"
            self._tell("unlabelled", f"{scan.source}: {what}; so may points of further scans")
        return label

    def _tell(self, kind: str, what: str) -> None:
        if kind not in self._told:
            self._told.add(kind)
            reporting.message(what)


def _own_labels(scan: Scan, numbering: str) -> Int[Tensor, " n"]:
    """Return the labels that a scan came with, by SemanticKITTI's numbers."""
    if scan.label is None:
        cure = "name the tree that has them, as kitti_odometry:ROOT:00, or leave --compare out"
        raise DataError(f"no labels in {scan.source}", "labels to compare with", cure)
    return as_semantic_kitti(scan.label & CLASS_BITS, numbering)
