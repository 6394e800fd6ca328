"""How well scans of drives fit together by their poses: TTCE, by registration, CTC, by distances, and odometry."""

from lidargrit.evaluation.protocols import Protocol

drive = Protocol(
    title="how well scans of drives, recorded or generated, fit together: TTCE, CTC and odometry by KISS-ICP",
    source="LiDARCrafter (Liang et al., AAAI 2026), worldbench/lidarcrafter@3c62da2",
    metrics=(),
    departures=("Points lie on the rays of the range image, one a pixel: theirs are whole clouds.",),
)
