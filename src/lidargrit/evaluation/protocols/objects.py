"""What stands in scans before all else: vehicles, people, poles, trunks and classes, then the metrics of ``exact``."""

from dataclasses import replace

from lidargrit.evaluation.protocols import MetricChoice
from lidargrit.evaluation.protocols import exact as _exact

objects = replace(
    _exact.exact,
    title="what stands in scans, by a segmenter, then the plain definitions of exact",
    metrics=(
        MetricChoice("object_statistics", "segmented"),
        MetricChoice("class_jsd", "segmented"),
        *_exact.exact.metrics,
    ),
)
