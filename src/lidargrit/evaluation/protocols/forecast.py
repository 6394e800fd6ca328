"""Forecasts of scans of drives .1, .5, 1 and 3 s ahead: errors of ranges, of the mask and of points in a box."""

from lidargrit.evaluation.protocols import Protocol

forecast = Protocol(
    title="forecasts of drives from past scans (five without a model): L1, AbsRel, chamfer, beside copied ones",
    source="Khurana et al., Point Cloud Forecasting as a Proxy for 4D Occupancy Forecasting, CVPR 2023",
    metrics=(),
    departures=(
        "L1 and AbsRel are of true returns in the box, at each horizon: theirs are of all rays, whose ends are clamped "
        "to the box, and means over all horizons.",
    ),
)
