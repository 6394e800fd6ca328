"""Scans of a drive → how far a forecast of one is off, and how well scans that follow one another fit together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidargrit.evaluation.metrics.shared.matching import chamfer_distance
from lidargrit.scans.motion import as_poses
from lidargrit.scans.sensors import SensorModel

BOX_M = (70.0, 70.0, 4.5)
"""Half the sides of the box around the sensor in which forecasts are scored: along x, y and z."""
_REGISTERED_M = 2.0  # that a point may lie from its partner
_ROUNDS_AT_MOST, _CONVERGED = 30, 1e-6  # Open3D's defaults
_AT_SENSOR_M = 0.2  # points nearer than this are left out


@dataclass(frozen=True)
class ForecastErrors:
    """How far the forecast of one scan is off.

    Args:
        l1_m: mean absolute error of the range in metres, over true returns in the box.
        abs_rel: mean of the same errors over the true range.
        median_m: median absolute error in metres, over rays where both return.
        covered: share of true returns where the forecast returns, too.
        mask_right: share of rays of which the forecast tells rightly whether they return.
        chamfer_m2: see :func:`chamfer_m2`, of the points in the box.
    """

    l1_m: float
    abs_rel: float
    median_m: float
    covered: float
    mask_right: float
    chamfer_m2: float


@dataclass(frozen=True)
class GemErrors:
    """GEM's Chamfer distances of the forecast of one scan, in square metres, and what its fault does to them.

    Args:
        chamfer_m2: distance of the points of all pixels; one without a return is a point at the sensor.
        inner_m2: distance of those in the box, in which the sensor lies.
        returns_m2: distance of returns alone.
        drops: share of pixels of the true scan without a return.
    """

    chamfer_m2: float
    inner_m2: float
    returns_m2: float
    drops: float


ErrorsOfForecast = ForecastErrors | GemErrors


def in_box(points_m: Float64[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
    """Return which points lie in the box around the sensor."""
    return np.all(np.abs(points_m) <= BOX_M, axis=-1)


def forecast_errors(
    forecast_m: Float64[Tensor, "H W"], true_m: Float64[Tensor, "H W"], sensor: SensorModel
) -> ForecastErrors:
    """Compare a forecast with the scan that came; ranges are in metres, 0 where nothing returns.

    In L1 and AbsRel a ray without a forecast takes the range of the ray nearest in angle that has one.

    Source:
        Khurana et al., Point Cloud Forecasting as a Proxy for 4D Occupancy Forecasting, CVPR 2023; there, every ray
        counts, its ends are clamped to the box, and the forecast point nearest in angle gives the range.
    """
    rays = sensor.ray_directions().double().numpy()
    forecast, true = forecast_m.numpy(), true_m.numpy()
    told, returned = forecast > 0, true > 0
    both, scored = told & returned, returned & in_box(true[..., None] * rays)
    filled = forecast.copy()
    if told.any():
        _, nearest = KDTree(rays[told]).query(rays[scored & ~told])
        filled[scored & ~told] = forecast[told][nearest]
    off_m = np.abs(filled - true)[scored]
    points = [(range_m[..., None] * rays)[range_m > 0] for range_m in (forecast, true)]
    return ForecastErrors(
        float(off_m.mean()) if len(off_m) else np.nan,
        float((off_m / true[scored]).mean()) if len(off_m) else np.nan,
        float(np.median(np.abs(forecast - true)[both])) if both.any() else np.nan,
        float(told[returned].mean()) if returned.any() else np.nan,
        float((told == returned).mean()),
        chamfer_m2(*(each[in_box(each)] for each in points)),
    )


def chamfer_m2(one_m: Float64[np.ndarray, "n 3"], other_m: Float64[np.ndarray, "m 3"]) -> float:
    """Return half the sum of the mean squared distances to the nearest point of the other set, in square metres.

    Source:
        Khurana et al., CVPR 2023, whose program returns 0 where one of the two sets is empty.
    """
    if not len(one_m) or not len(other_m):
        return 0.0
    return chamfer_distance(one_m, other_m) / 2


def gem_errors(forecast_m: Float64[Tensor, "H W"], true_m: Float64[Tensor, "H W"], sensor: SensorModel) -> GemErrors:
    """Compare a forecast with the scan that came as GEM's program does; ranges are in metres, 0 where nothing returns.

    Points lie on the upper and first edges of their pixels.

    Source:
        wuyang98/GEM@6fa73eb, evaluation_utils.py: compute_chamfer_distance and compute_chamfer_distance_inner, of the
        files that generate_and_save.py and vae/precompute_lidar.py write.
    """
    elevation, azimuth = sensor.elevation_rad.double().numpy(), sensor.azimuth_rad.double().numpy()
    elevation = elevation + (elevation[0] - elevation[-1]) / (len(elevation) - 1) / 2
    azimuth = azimuth + np.pi / sensor.width
    flat = np.cos(elevation)
    rays = np.stack(np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)
    images_m = forecast_m.numpy(), true_m.numpy()
    returns = [image_m[image_m > 0][:, None] * rays[image_m > 0] for image_m in images_m]
    drops = [image_m.size - len(points) for image_m, points in zip(images_m, returns, strict=True)]
    inner = [points[in_box(points)] for points in returns]
    chamfer, alone = _chamfers_with_and_without_drops_m2(returns, drops)
    return GemErrors(chamfer, _chamfers_with_and_without_drops_m2(inner, drops)[0], alone, drops[1] / true_m.numel())


def _chamfers_with_and_without_drops_m2(
    points_m: Sequence[Float64[np.ndarray, "_ 3"]], drops: Sequence[int]
) -> tuple[float, float]:
    """Return the Chamfer distance of two clouds with so many points at the sensor each, and that without these."""
    if not all(len(points) + count for points, count in zip(points_m, drops, strict=True)):
        return 0.0, 0.0  # as the program, where the box holds nothing
    with_drops, without = [], []
    for one, other, own_drops, other_drops in zip(points_m, points_m[::-1], drops, drops[::-1], strict=True):
        square = KDTree(other).query(one)[0] ** 2  # infinite where there is no other
        without.append(float(square.mean()) if len(one) and len(other) else 0.0)
        to_sensor = 0.0 if other_drops else float((other**2).sum(axis=1).min())
        if other_drops:
            square = np.minimum(square, (one**2).sum(axis=1))
        with_drops.append(float((square.sum() + own_drops * to_sensor) / (len(one) + own_drops)))
    return sum(with_drops) / 2, sum(without) / 2


def registered(
    source_m: Float64[np.ndarray, "n 3"], target_m: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix that moves one set of points onto another, by point-to-point ICP from the identity.

    Source:
        Besl and McKay, PAMI 1992; partners within 2 m, and the end of the rounds, as Open3D's registration_icp.
    """
    tree, found, moved_m, before = KDTree(target_m), np.eye(4), source_m, (-1.0, -1.0)
    for _ in range(_ROUNDS_AT_MOST + 1):
        distance_m, partner = tree.query(moved_m, distance_upper_bound=_REGISTERED_M)
        near = np.asarray(np.isfinite(distance_m))
        if near.sum() < 3:
            break
        partners_m = np.asarray(distance_m)[near]
        now = float(near.mean()), float(np.sqrt((partners_m**2).mean()))
        if max(abs(now[0] - before[0]), abs(now[1] - before[1])) < _CONVERGED:
            break
        ours, theirs = moved_m[near], target_m[np.asarray(partner)[near]]
        turn, *_ = Rotation.align_vectors(theirs - theirs.mean(0), ours - ours.mean(0))
        found, before = as_poses(turn.as_matrix(), theirs.mean(0) - turn.apply(ours.mean(0))) @ found, now
        moved_m = source_m @ found[:3, :3].T + found[:3, 3]
    return found


def consistency_error_m(
    one_m: Float64[np.ndarray, "n 3"], other_m: Float64[np.ndarray, "m 3"], transform: Float64[np.ndarray, "4 4"]
) -> float:
    """Return by how many metres two scans lie otherwise than their poses say: TTCE, the mean over the three axes.

    Args:
        one_m, other_m: points of the earlier and the later scan, each in its own frame.
        transform: matrix from the earlier frame to the later one.

    Source:
        LiDARCrafter (Liang et al., AAAI 2026), worldbench/lidarcrafter@3c62da2, lidargen/metrics/temporal.py.
    """
    one_m, other_m = _off_sensor(one_m), _off_sensor(other_m)
    return float(np.abs(registered(one_m, other_m)[:3, 3] - transform[:3, 3]).mean())


def consistency_chamfer_m2(
    one_m: Float64[np.ndarray, "n 3"], other_m: Float64[np.ndarray, "m 3"], transform: Float64[np.ndarray, "4 4"]
) -> float:
    """Return the chamfer distance of two scans in common axes, in square metres: CTC.

    Args, Source: as for :func:`consistency_error_m`; its program calls it TCD and prints it as TTCE.
    """
    moved_m = _off_sensor(one_m) @ transform[:3, :3].T + transform[:3, 3]
    return chamfer_m2(moved_m, _off_sensor(other_m))


def _off_sensor(points_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "k 3"]:
    return points_m[np.linalg.norm(points_m, axis=1) > _AT_SENSOR_M]
