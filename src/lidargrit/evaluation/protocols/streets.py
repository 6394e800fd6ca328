"""Curves of raydrop, ranges and reflectance.

Of simulated streets, whose surfaces are known, independent drops and figures of one set, too
(:mod:`lidargrit.evaluation.street_figures`).
"""

from lidargrit.evaluation.protocols import MetricChoice, Protocol
from lidargrit.evaluation.realism import CURVES

streets = Protocol(
    title="curves of raydrop, ranges, walls and reflectance, each a Jensen-Shannon distance, and points in space",
    source="this project",
    metrics=tuple(MetricChoice(name, "exact") for name in CURVES),
)
