"""The verb segment: a source of scans, a segmenter and a folder → the scans with a label for every point."""

from dataclasses import replace
from pathlib import Path

from jaxtyping import Int
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.errors import ConfigError, DataError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.run_folder import locate, weights_sha256
from lidargrit.data.scan_folder import KittiTree, ScanFolder, write_with_labels
from lidargrit.data.sources import open_source
from lidargrit.data.sources.named import ImageScans, NamedScans, named_scans
from lidargrit.inference.complete.inputs import ScanReader
from lidargrit.inference.segment import can_label, label_images, open_segmenter
from lidargrit.inference.segment.points import labels_of_points
from lidargrit.inference.segment.scores import LabelScores
from lidargrit.scans.classes import CLASS_BITS, as_semantic_kitti
from lidargrit.scans.sensors import ProjectionOption
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.systems.segmenter.system import Segmenter

MANIFEST = "segmented.json"
_FEW_RINGS_CURE = (
    "name a segmenter of the scans' sensor with --model, or train one: lidargrit train segmenter_compact RUN"
)


def segment_scans(
    source: str,
    out: Path,
    model: str = "pretrained",
    config: DataConfig | None = None,
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
        numbering: numbering of the scans' own labels, with which the found ones are compared; "" for no comparison.

    Returns:
        number of scans that are there now, and how well their own labels were found, None without a comparison.
    """
    config = config or DataConfig()
    segmenter = open_segmenter(model, device)
    source_scans = _opened(source, segmenter, config)
    source_scans.check_output(out)
    labels = _Labels(source_scans, segmenter, config.projection)
    files = KittiTree(out).files([source_scans.name(index) for index in range(len(source_scans))])
    identities = [source_scans.identity(index) for index in range(len(files))]
    facts = {"source": source, "weights_sha256": weights_sha256(locate(model, "segment"))}
    folder = ScanFolder(out, MANIFEST, facts, files, identities, config.bad_scans)
    scores = LabelScores() if numbering else None
    wanted = folder.missing if scores is None else range(len(files))
    if scores is not None:
        _own_labels(source_scans.scan(0), numbering)  # a mistake is told before anything is written
    with folder.writing("labelling", len(wanted)) as progress:
        for index in wanted:
            with folder.leaving_out(index):
                scan = source_scans.scan(index)
                if scores is None:  # else the user knows that labels are of another numbering
                    source_scans.tell_notes(scan)
                label = labels.of(index, scan)
                if index in folder.missing:
                    write_with_labels(out / files[index], replace(scan, label=label))
                if scores is not None:
                    scores.add(label, _own_labels(scan, numbering))
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
    """The label that a segmenter finds for every point of a scan.

    Args:
        scans: scans of the source.
        segmenter: segmenter of a run.
        projection: way in which points find their rows.
    """

    def __init__(self, scans: NamedScans, segmenter: Segmenter, projection: ProjectionOption) -> None:
        self._scans, self._segmenter = scans, segmenter
        self._reader, self._told = (
            ScanReader(segmenter.sensor.fine(), "exact", True, projection, _FEW_RINGS_CURE),
            set[str](),
        )

    def of(self, index: int, scan: Scan) -> Int[Tensor, " n"]:
        """Return the labels of a scan of the source."""
        if isinstance(self._scans, ImageScans):
            image = label_images(self._segmenter, RangeImage.stack([self._scans.image(index)]))
            assert image.label is not None
            return image.label[image.return_mask]
        read = self._reader.read(scan)
        assert read.point_of_pixel is not None
        image = label_images(self._segmenter, RangeImage.stack([read.image]))[0]
        label = labels_of_points(image, read.point_of_pixel, read.coordinates)
        if read.doubt:
            self._tell("doubt", f"WARNING: {read.doubt}")
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
        raise DataError(f"no labels in {scan.source}", "labels to compare with", "leave --compare out")
    return as_semantic_kitti(scan.label & CLASS_BITS, numbering)
