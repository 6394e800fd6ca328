"""Ours, the default: plain definitions of what needs no trained network, on images of the sets' own sensor."""

from lidargrit.evaluation.protocols import Choice, Protocol

exact = Protocol(
    title="plain definitions, exact projection, any data set",
    source="this project",
    choices=(
        Choice("sliced_wasserstein", "textbook"),
        Choice("bev_jsd", "exact"),
        Choice("bev_mmd", "exact"),
        Choice("point_cloud_jsd", "exact"),
        Choice("range_histogram_per_ring", "exact"),
        Choice("return_rate_per_ring", "exact"),
        Choice("drop_run_lengths", "exact"),
    ),
)
