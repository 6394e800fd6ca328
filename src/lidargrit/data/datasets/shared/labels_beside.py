"""Labels of SemanticKITTI beside a scan: folder/velodyne/NAME.bin → folder/labels/NAME.label → the scan with labels."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lidargrit.core.errors import ScanError
from lidargrit.data.formats import read_bytes
from lidargrit.scans.classes import notes_on_labels
from lidargrit.scans.types import Scan

_LABEL_BYTES = 4  # uint32: class in the lower 16 bits, instance in the upper
_LABELS = "one uint32 for each point, as SemanticKITTI has them"
_LABEL_BYTES_AT_MOST = 16_000_000  # of as many points as a file of scans may have


def label_file(path: Path) -> Path:
    """Return where the labels of a scan lie, whether they are there or not."""
    return path.absolute().parents[1] / "labels" / f"{path.stem}.label"


def with_labels(scan: Scan, path: Path) -> Scan:
    """Return a scan with its labels, or as it is where there are none.

    Args:
        path: file of KITTI's format that the scan was read from.

    Raises:
        ScanError: the file of labels is not of as many points.

    Source:
        Behley et al., SemanticKITTI, ICCV 2019.
    """
    if not os.path.isfile(labels := label_file(path)):  # False, too, where its name would be too long
        return scan
    assert scan.rows is not None  # as of all files of KITTI's format
    data = read_bytes(labels, _LABEL_BYTES_AT_MOST, _LABELS)
    count = len(scan.rows.columns["x"])
    if len(data) != _LABEL_BYTES * count:
        raise ScanError(
            f"{len(data)} bytes of labels in {labels}, and {count} points in {path}",
            f"{_LABELS}: {_LABEL_BYTES * count} bytes",
            "download both again, or move the labels away",
        )
    # Where points were dropped, their labels go with them.
    label = torch.from_numpy(np.frombuffer(data, "<u4").astype(np.int64)[scan.rows.of_point])
    return replace(scan, label=label, notes=(*scan.notes, *notes_on_labels(label)))
