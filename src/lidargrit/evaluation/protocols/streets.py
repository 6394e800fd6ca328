"""Curves of raydrop, ranges and reflectance; of simulated streets, whose surfaces are known, independent drops too."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol
from lidargrit.evaluation.realism import CURVES

streets = Protocol(
    title="curves of raydrop, ranges and reflectance, each a Jensen-Shannon distance",
    source="this project",
    metrics=tuple(MetricChoice(name, "exact") for name in CURVES),
)
