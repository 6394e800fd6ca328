"""Data sources → batches of range images: projected once, kept on disk, ordered and augmented by seed."""

from lidargrit.loading.batches import Batches
from lidargrit.loading.config import DataConfig
from lidargrit.loading.images import Pixels, Provenance, RangeImages
from lidargrit.loading.imaging import Imaging, choose_imaging
from lidargrit.loading.prepare import damaged_shards, prepare, prepare_and_describe
from lidargrit.loading.prepared import PreparedFolder, PreparedImages, is_prepared

__all__ = [
    "Batches",
    "DataConfig",
    "Imaging",
    "Pixels",
    "Provenance",
    "PreparedFolder",
    "PreparedImages",
    "RangeImages",
    "choose_imaging",
    "damaged_shards",
    "is_prepared",
    "prepare",
    "prepare_and_describe",
]
