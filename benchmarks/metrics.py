"""Seconds that the metrics of sets take: ours and plain versions written from the formulas, side by side in one run.

    python benchmarks/metrics.py [--clouds 100] [--images 200] [--repeats 3]

One thread. Every plain version gives the same result, which is checked. Times are processor time, the best of the
repeats: other work on the machine adds little to it. Where the plain version takes minutes, it does a part of the work
and its time is multiplied; the table says by what. Below it: how our cost grows with the number of scans.
"""

import argparse
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

import lidargrit
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.metrics.bev_mmd import discrepancy, frobenius
from lidargrit.evaluation.metrics.lidm_bev_matching import packed, ways_between
from lidargrit.evaluation.metrics.point_cloud_jsd import divergence_with_epsilon, grid_counts
from lidargrit.evaluation.metrics.shared import clouds as _clouds
from lidargrit.evaluation.metrics.shared import matching
from lidargrit.evaluation.metrics.shared.birds_eye import histograms
from lidargrit.evaluation.metrics.shared.farthest_points import farthest_points
from lidargrit.scans.projection import RangeEncoding, points_of_pixels
from lidargrit.scans.types import RangeImage


def timed(work: Callable[[], Any], repeats: int = 1) -> tuple[float, Any]:
    """Return the least processor time of several runs, and what the last returned."""
    times, result = [], None
    for _ in range(repeats):
        begun = time.process_time()
        result = work()
        times.append(time.process_time() - begun)
    return min(times), result


def line(name: str, plain_s: float, part: int, ours_s: float) -> None:
    """Print one row of the table."""
    taken = f" (x{part})" if part > 1 else ""
    print(f"{name:<52}{plain_s * part:>9.3f} s{taken:<7}{ours_s:>9.4f} s{plain_s * part / ours_s:>9.1f}x", flush=True)


# Plain versions


def plain_histogram(points_m: np.ndarray) -> np.ndarray:
    """Count point by point."""
    counts = np.zeros((100, 100), dtype=int)
    for point in points_m:
        if 3 < math.sqrt((point**2).sum()) < 70:
            counts[min(int((point[0] + 80) / 1.6), 99), min(int((point[1] + 80) / 1.6), 99)] += 1
    return counts


def plain_farthest(points: np.ndarray, num: int) -> np.ndarray:
    """Go through all points for every one that is chosen."""
    nearest = np.full(len(points), 1e10, dtype=np.float32)
    chosen, last = np.zeros(num, dtype=np.int64), np.zeros(3, dtype=np.float32)
    for k in range(num):
        nearest = np.minimum(nearest, ((points - last) ** 2).sum(axis=1))
        chosen[k] = nearest.argmax()
        last = points[chosen[k]]
    return chosen


def plain_chamfer(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Take all differences of all points, pair by pair of clouds."""
    matrix = np.zeros((len(first), len(second)))
    for i, a in enumerate(torch.from_numpy(first)):
        for j, b in enumerate(torch.from_numpy(second)):
            squared = ((a[:, None] - b[None]) ** 2).sum(dim=2)
            matrix[i, j] = squared.amin(dim=0).mean() + squared.amin(dim=1).mean()
    return matrix


def plain_matching(rr: np.ndarray, rg: np.ndarray, gg: np.ndarray) -> tuple[float, float, float]:
    """Return matching distance, coverage and accuracy from three matrices."""
    n = len(rr)
    whole = np.block([[rr, rg], [rg.T, gg]]) + np.diag(np.full(2 * n, np.inf))
    is_real = np.arange(2 * n) < n
    return rg.min(axis=1).mean(), len(set(rg.argmin(axis=0))) / n, (is_real[whole.argmin(axis=1)] == is_real).mean()


def plain_grid_counts(clouds: np.ndarray) -> np.ndarray:
    """Measure every point against every grid point."""
    axis = np.linspace(-1, 1, 28)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.linalg.norm(grid, axis=1) <= 1].astype(np.float32)
    counts = np.zeros(len(grid), dtype=int)
    for cloud in clouds:
        for nearest in ((cloud[:, None] - grid) ** 2).sum(axis=2).argmin(axis=1):
            counts[nearest] += 1
    return counts


def plain_sliced(first: torch.Tensor, second: torch.Tensor, seed: int) -> float:
    """Convolve with the 5x5 kernel and sort with torch; images of one batch of 128 share their patch positions."""
    row = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
    rng = torch.Generator().manual_seed(seed)

    def blurred(images: torch.Tensor, stride: int) -> torch.Tensor:
        return F.conv2d(F.pad(images, (2, 2, 2, 2), mode="reflect"), torch.outer(row, row)[None, None], stride=stride)

    def patches(images: torch.Tensor) -> list[torch.Tensor]:
        levels = []
        for _ in range(2):
            coarse = blurred(images, 2)
            fine = torch.zeros_like(images)
            fine[:, :, 1::2, 1::2] = coarse
            levels.append(images - 4 * blurred(fine, 1))
            images = coarse
        cut = []
        for level in [*levels, images]:
            across = level.shape[3] - 6
            corners = torch.randperm((level.shape[2] - 6) * across, generator=rng)[:128]
            cut.append(
                torch.stack([level[:, 0, p // across :, p % across :][:, :7, :7] for p in corners.tolist()], dim=1)
            )
        return cut

    batches = [
        [patches(images[start : start + 128, None]) for images in (first, second)]
        for start in range(0, len(first), 128)
    ]
    distances = []
    for level in range(3):
        sides = [torch.cat([batch[which][level] for batch in batches]).reshape(-1, 49) for which in (0, 1)]
        sides = [(side - side.mean()) / (side.std() + 1e-8) for side in sides]
        for _ in range(4):
            directions = torch.randn(49, 128, generator=rng)
            directions = directions / directions.std(dim=0)
            projected = [(side @ directions).sort(dim=0).values for side in sides]
            distances.append(float((projected[0] - projected[1]).abs().mean()))
    return float(np.mean(distances))


# The table


def per_scan(repeats: int) -> None:
    """Histograms and farthest points of full scans of 64x1024 pixels."""
    sensor = lidargrit.load_sensor("hdl64e_kitti_360")
    scans = [lidargrit.project(lidargrit.simulate(seed=seed), sensor) for seed in range(4)]
    images = RangeImage.stack(scans * 2)
    points_m = points_of_pixels(images).flatten(1, 2)
    plain_s, plain = timed(lambda: plain_histogram(points_m[0].numpy()))
    ours_s, ours = timed(lambda: histograms(points_m, "lidargrit"), repeats)
    assert np.array_equal(ours[0].reshape(100, 100), plain)
    line("bird's-eye histogram, a scan, against a loop", plain_s, 1, ours_s / 8)
    plain_s, plain = timed(
        lambda: [np.histogram2d(*p[:, :2].T, 100, [[-80, 80]] * 2) for p in points_m[:2].numpy()], repeats
    )
    line("the same, against numpy.histogram2d", plain_s / 2, 1, ours_s / 8)
    full = torch.where(points_m.norm(dim=2, keepdim=True) > 0, points_m, torch.rand_like(points_m) * 40).numpy() / 80
    every = np.ones(full.shape[:2], dtype=bool)
    plain_s, plain = timed(lambda: plain_farthest(full[0], 512), repeats)
    ours_s, ours = timed(lambda: farthest_points(full, every, 512), repeats)
    assert np.array_equal(ours[0], plain)
    line("farthest points, 65,536 to 512, a scan", plain_s, 1, ours_s / 8)


def clouds_of(n: int, seed: int) -> np.ndarray:
    """Return clouds of 512 points in the unit ball, flat as scans are, each of its own width."""
    rng = np.random.default_rng(seed)
    spread = rng.uniform(0.1, 0.4, (n, 1, 3)) * [1, 1, 0.1]
    return np.clip(rng.normal(size=(n, _clouds.POINTS, 3)) * spread, -0.57, 0.57).astype(np.float32)


def of_clouds(n: int, repeats: int) -> None:
    """Chamfer matrix, the three scores from it, and the divergence in space."""
    generated, real = clouds_of(n, 0), clouds_of(n, 1)
    few = max(n // 10, 1)
    plain_s, plain = timed(lambda: plain_chamfer(real[:few], generated))
    ours_s, ours = timed(lambda: matching.chamfer_matrix(real, generated), repeats)
    assert np.allclose(ours[:few], plain, atol=1e-6)
    line(f"Chamfer matrix, {n} x {n} clouds of 512", plain_s, n // few, ours_s)
    small = [side[:few] for side in (real, generated)]
    plain_s, plain = timed(
        lambda: plain_matching(
            plain_chamfer(small[0], small[0]), plain_chamfer(*small), plain_chamfer(small[1], small[1])
        )
    )
    names = ("minimum_matching_distance", "coverage", "one_nearest_neighbour")
    checked = [load_metric(name)().compare(small[1], small[0])[0] for name in names]
    assert np.allclose(plain, checked, atol=1e-6), (plain, checked)
    ours_s, _ = timed(lambda: [load_metric(name)().compare(generated, real) for name in names])
    line(f"matching, coverage and 1-NNA, {n} v {n}", plain_s, (n // few) ** 2, ours_s)
    plain_s, plain = timed(lambda: plain_grid_counts(real[:few]))
    assert np.array_equal(grid_counts(real[:few].reshape(-1, 3)), plain)
    ours_s, _ = timed(
        lambda: divergence_with_epsilon(*(grid_counts(x.reshape(-1, 3)) for x in (real, generated))), repeats
    )
    line(f"divergence in space, {n} v {n}", plain_s, 2 * n // few, ours_s)


def of_patches(n: int, repeats: int) -> None:
    """Sliced Wasserstein distance of images of 64x1024."""
    sensor = lidargrit.load_sensor("hdl64e_kitti_360")
    rng = torch.Generator().manual_seed(0)
    sides = []
    for _ in range(2):
        walls_m = (2 + 70 * torch.rand(n, 1, 64, generator=rng)).repeat_interleave(16, dim=2).expand(n, 64, 1024)
        range_m = walls_m + torch.rand(walls_m.shape, generator=rng)
        sides.append(RangeImage.masked(range_m, torch.rand(range_m.shape, generator=rng) > 0.2, sensor))
    encoding = RangeEncoding("linear", sensor.range_min_m, sensor.range_max_m)
    plain_s, plain = timed(
        lambda: plain_sliced(*(encoding.encode(side.range_m, side.return_mask) for side in sides), 0)
    )

    def ours() -> float:
        metric = load_metric("sliced_wasserstein")()
        for real, side in enumerate(sides):
            metric.update(side, real=bool(real))
        return metric.compute().value

    ours_s, value = timed(ours, repeats)
    assert math.isclose(value, plain, rel_tol=1e-4), (value, plain)
    line(f"sliced Wasserstein, {n} v {n} of 64x1024", plain_s, 1, ours_s)


def growth() -> None:
    """Print how our cost grows; of what is per scan, a scan costs the same in any set."""
    print(f"\n{'seconds, n v n':<52}" + "".join(f"{f'n = {n}':>12}" for n in (50, 100, 200)))
    rng = np.random.default_rng(0)
    counts = {n: [rng.poisson(0.5, (n, 10_000)).astype(np.uint16) for _ in range(2)] for n in (50, 100, 200)}
    cells = {
        n: [np.concatenate([packed(np.flatnonzero(rng.random(40_000) < 0.1)) for _ in range(n)]) for _ in range(2)]
        for n in (50, 100, 200)
    }
    rows: dict[str, Callable[[int], Any]] = {
        "Chamfer matrix": lambda n: matching.chamfer_matrix(clouds_of(n, 0), clouds_of(n, 1)),
        "bev_mmd": lambda n: discrepancy(*counts[n], frobenius, unbiased=True),
        "lidm_bev_matching": lambda n: ways_between(*cells[n], 200),
    }
    for name, work in rows.items():
        print(f"{name:<52}" + "".join(f"{timed(lambda: work(n))[0]:>12.3f}" for n in (50, 100, 200)), flush=True)  # noqa: B023


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clouds", type=int, default=100, help="in each set")
    parser.add_argument("--images", type=int, default=200, help="in each set, for the sliced distance")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'':<52}{'plain':>11}{'':<7}{'ours':>11}{'ratio':>10}")
    per_scan(options.repeats)
    of_clouds(options.clouds, options.repeats)
    of_patches(options.images, options.repeats)
    growth()


if __name__ == "__main__":
    main()
