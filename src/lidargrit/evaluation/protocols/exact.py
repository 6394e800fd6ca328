"""Ours, the default: plain definitions of what needs no trained network, on images of the sets' own sensor."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol

exact = Protocol(
    title="plain definitions, exact projection, any data set",
    source="this project",
    metrics=(
        MetricChoice("sliced_wasserstein", "textbook"),
        MetricChoice("bev_jsd", "exact"),
        MetricChoice("bev_mmd", "exact"),
        MetricChoice("point_cloud_jsd", "exact"),
        MetricChoice("range_histogram_per_ring", "exact"),
        MetricChoice("return_rate_per_ring", "exact"),
        MetricChoice("drop_run_lengths", "exact"),
    ),
)
