"""PointNet and RangeNet-53 against reference numbers and slow re-statements; what metrics show them, and keep of it."""

import hashlib
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError, DataError, WeightsError
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.metrics.shared.networks.features import NormalisedImages, UnitClouds
from lidargrit.evaluation.metrics.shared.networks.network import NETWORKS, filled, load_network
from lidargrit.evaluation.metrics.shared.networks.pointnet import PointNet
from lidargrit.evaluation.metrics.shared.networks.rangenet import chosen_values
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from reference_weights import seeded_weights
from seeded_networks import weights, weights_folder

K360 = load_sensor("hdl64e_kitti_360")
SMALL = replace(K360, elevation_rad=K360.elevation_rad[::8]).with_columns(32)
ODOMETRY = load_sensor("hdl64e_kitti_odometry").with_columns(32)


@pytest.fixture(autouse=True)
def _folder(monkeypatch):
    monkeypatch.setenv("LIDARGRIT_WEIGHTS", str(weights_folder()))


def images(sensor=SMALL, count=3, seed=0, reflectance=True):
    rng = torch.Generator().manual_seed(seed)
    shape = (count, sensor.height, sensor.width)
    range_m = sensor.range_min_m + torch.rand(shape, generator=rng) * (sensor.range_max_m - sensor.range_min_m)
    mask = torch.rand(shape, generator=rng) > 0.2
    bright = torch.where(mask, torch.rand(shape, generator=rng), 0.0)
    return RangeImage(torch.where(mask, range_m, 0.0), mask, sensor, {"reflectance": bright} if reflectance else {})


# --- the networks themselves


def test_pointnet_reference_numbers(golden):
    data = golden("pointnet")
    network = filled(PointNet, seeded_weights(data), weights_folder())
    names = {name for name in json.loads(str(data["layout"])) if not name.endswith("num_batches_tracked")}
    assert names == set(network.state_dict())
    with torch.no_grad():
        features = network(torch.from_numpy(data["points"]))
    np.testing.assert_allclose(features.numpy(), data["features"], atol=1e-4, rtol=1e-4)


def norm(x, w, name):
    """Batch normalisation of (channels, ...) by the statistics that are stored."""
    at = [w[f"{name}.{part}"].reshape(-1, *[1] * (x.ndim - 1)) for part in ("running_mean", "running_var")]
    by = [w[f"{name}.{part}"].reshape(-1, *[1] * (x.ndim - 1)) for part in ("weight", "bias")]
    return (x - at[0]) / np.sqrt(at[1] + 1e-5) * by[0] + by[1]


def slow_pointnet(points, w):
    """The features of one cloud (3, n), point by point of the paper's figure 2."""

    def dense(x, name):
        weight = w[f"{name}.weight"]
        return weight.reshape(weight.shape[0], -1) @ x + w[f"{name}.bias"].reshape(-1, *[1] * (x.ndim - 1))

    def relu(x):
        return np.maximum(x, 0)

    def per_point(x, of):
        x = relu(norm(dense(x, f"{of}conv1"), w, f"{of}bn1"))
        x = relu(norm(dense(x, f"{of}conv2"), w, f"{of}bn2"))
        return norm(dense(x, f"{of}conv3"), w, f"{of}bn3").max(axis=1)

    pose = relu(per_point(points, "feat.stn."))
    pose = relu(norm(dense(pose, "feat.stn.fc1"), w, "feat.stn.bn4"))
    pose = relu(norm(dense(pose, "feat.stn.fc2"), w, "feat.stn.bn5"))
    pose = dense(pose, "feat.stn.fc3").reshape(3, 3) + np.eye(3)
    first = per_point((points.T @ pose).T, "feat.")
    second = relu(norm(dense(first, "fc1"), w, "bn1"))
    third = relu(norm(dense(second, "fc2"), w, "bn2"))
    return np.concatenate((first, second, third, dense(third, "fc3")))


def test_pointnet_takes_clouds_of_any_size():
    w = {name: tensor.double().numpy() for name, tensor in weights("pointnet").items()}
    points = np.random.default_rng(0).normal(size=(1, 3, 5000)).astype(np.float32)  # more than it holds at once
    features = load_network("pointnet").features(torch.from_numpy(points))
    np.testing.assert_allclose(features[0], slow_pointnet(points[0].astype(np.float64), w), atol=1e-4, rtol=1e-4)


def conv(x, weight, step=1):
    """3x3 or 1x1 convolution of (channels, rows, columns) as a sum of shifted products; zeros outside."""
    reach = weight.shape[2] // 2
    rows, columns = x.shape[1:]
    padded = np.pad(x, ((0, 0), (reach, reach), (reach, reach)))
    return sum(
        np.tensordot(weight[:, :, i, j], padded[:, i : i + rows, j : j + columns : step], 1)
        for i in range(weight.shape[2])
        for j in range(weight.shape[3])
    )


def widened(x, weight, bias):
    """Every column of the input is spread over four of the output, two apart from those of its neighbour."""
    _, rows, columns = x.shape
    out = np.zeros((weight.shape[1], rows, 2 * columns + 2))
    for column in range(columns):
        for tap in range(4):
            out[:, :, 2 * column + tap] += weight[:, :, 0, tap].T @ x[:, :, column]
    return out[:, :, 1:-1] + bias[:, None, None]


def slow_rangenet(x, w):
    def leaky(y):
        return np.where(y > 0, y, 0.1 * y)

    def residual(y, name):
        inner = leaky(norm(conv(y, w[f"{name}.conv1.weight"]), w, f"{name}.bn1"))
        return y + leaky(norm(conv(inner, w[f"{name}.conv2.weight"]), w, f"{name}.bn2"))

    x = leaky(norm(conv(x, w["backbone.conv1.weight"]), w, "backbone.bn1"))
    seen = []
    for level, blocks in zip("12345", (1, 2, 8, 8, 4), strict=True):
        name = f"backbone.enc{level}"
        seen.append(x)
        x = leaky(norm(conv(x, w[f"{name}.conv.weight"], step=2), w, f"{name}.bn"))
        for block in range(blocks):
            x = residual(x, f"{name}.residual_{block}")
    for level in "54321":
        name = f"decoder.dec{level}"
        x = leaky(norm(widened(x, w[f"{name}.upconv.weight"], w[f"{name}.upconv.bias"]), w, f"{name}.bn"))
        x = residual(x, f"{name}.residual") + seen.pop()
    return x


def test_rangenet_is_what_a_slow_restatement_says():
    w = {name: tensor.double().numpy() for name, tensor in weights("rangenet53").items()}
    image = np.random.default_rng(0).normal(size=(1, 5, 3, 64)).astype(np.float32)
    expected = slow_rangenet(image[0].astype(np.float64), w).reshape(-1)[chosen_values(32 * 3 * 64).numpy()]
    features = load_network("rangenet53").features(torch.from_numpy(image))[0]
    assert len(features) == 4096
    np.testing.assert_allclose(features, expected, atol=1e-4 * np.abs(expected).max())


def test_rangenet_has_the_parameters_of_the_paper():
    drawn = weights("rangenet53")
    learnt = sum(tensor.numel() for name, tensor in drawn.items() if "running" not in name)
    assert round(learnt / 1e6) == 50  # Milioto et al. 2019, table I


def test_the_draw_of_features_is_that_of_lidargen(golden):
    data = golden("misc")
    chosen = chosen_values(32 * 64 * 1024)
    assert np.array_equal(chosen[:32], data["frd_indices_first32"])
    assert hashlib.sha256(chosen.numpy().tobytes()).hexdigest() == str(data["frd_indices_sha256"])
    assert len(chosen_values(100)) == 100


# --- what they are shown


@pytest.mark.parametrize(
    ("sensor", "variant", "unit_m", "cut"),
    [
        (SMALL, "lidargrit", 80, True),
        (ODOMETRY, "lidargrit", 120, False),
        (SMALL, "r2dm", 80, True),
        (ODOMETRY, "r2dm", 80, True),
    ],
)
def test_clouds_of_the_programs(sensor, variant, unit_m, cut):
    batch = images(sensor)
    clouds = UnitClouds.of(variant, sensor)(batch).numpy()
    assert clouds.shape == (3, 3, sensor.height * sensor.width)
    points = points_of_pixels(batch).numpy().reshape(3, -1, 3)
    kept = 0
    for index, range_m in enumerate(batch.range_m.flatten(1).numpy()):
        for pixel, r in enumerate(range_m):
            keep = r > 0 and (0.5 < r < 63 or not cut)
            expected = points[index, pixel] / unit_m if keep else np.zeros(3)
            np.testing.assert_allclose(clouds[index, :, pixel], expected, rtol=1e-6, atol=1e-9)
            kept += keep
    assert 0 < kept < batch.range_m.numel()


def test_exact_clouds_are_the_returns_alone():
    batch = images()
    network = load_network("pointnet")
    features = network.features(UnitClouds.of("exact", SMALL)(batch))
    for index in range(3):
        returns = points_of_pixels(batch[index])[batch.return_mask[index]] / 80
        np.testing.assert_allclose(features[index], network.features(returns.T[None])[0], atol=1e-5)


def test_an_image_without_a_return_is_a_point_at_the_origin():
    empty = torch.zeros(1, SMALL.height, SMALL.width)
    for variant in ("lidargrit", "r2dm", "exact"):
        assert not UnitClouds.of(variant, SMALL)(RangeImage(empty, empty > 0, SMALL)).any()


@pytest.mark.parametrize(("variant", "cut"), [("r2dm", True), ("exact", False)])
def test_normalised_images(variant, cut):
    batch = images()
    channels = NormalisedImages.of(variant)(batch).numpy()
    points = points_of_pixels(batch).numpy()
    for pixel in np.ndindex(*batch.range_m.shape):
        r = float(batch.range_m[pixel])
        raw = np.array([r, *points[pixel], float(batch.reflectance[pixel])])
        expected = (raw - [12.12, 10.88, 0.23, -1.04, 0.21]) / [12.32, 11.47, 6.91, 0.86, 0.16]
        kept = r > 0 and (0.5 < r < 63 or not cut)
        np.testing.assert_allclose(channels[pixel[0], :, pixel[1], pixel[2]], expected * kept, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["frechet_range_distance", "kernel_range_distance"])
def test_rangenet_needs_reflectance_and_widths_that_can_be_halved(name):
    metric = load_metric(name)()
    with pytest.raises(DataError, match="got range images without reflectance; wanted reflectance at every return"):
        metric.update(images(reflectance=False), real=True)
    with pytest.raises(ConfigError, match=r"got range images of 48 columns.*wanted a multiple of 32"):
        load_metric(name)().update(images(SMALL.with_columns(48)), real=True)


# --- what metrics keep of it


def test_published_definitions_that_want_equal_inputs_share_them():
    definitions = [
        ("frechet_pointcloud_distance", "lidargrit"),
        ("frechet_pointcloud_distance", "r2dm"),
        ("kernel_pointcloud_distance", "r2dm"),
        ("frechet_pointcloud_distance", "exact"),
        ("kernel_pointcloud_distance", "exact"),
    ]
    metrics = [load_metric(name)(variant=variant) for name, variant in definitions]
    assert (
        len({metric.extractor(SMALL) for metric in metrics}) == 2
    )  # of the programs, which agree on KITTI-360, and ours
    assert len({metric.extractor(ODOMETRY) for metric in metrics}) == 3


def test_few_scans_are_warned_of_and_weights_are_named():
    metric = load_metric("frechet_pointcloud_distance")()
    for real in (False, True):
        metric.update(images(seed=int(real)), real=real)
    details = metric.compute().details
    (line,) = details["warnings"]
    assert line.startswith("3 generated and 3 real scans for 1808 features: too few")
    data = (weights_folder() / "cls_model_39.pth").read_bytes()
    assert details["weights"] == {"file": "cls_model_39.pth", "sha256": hashlib.sha256(data).hexdigest()}
    for count, warnings in ((1807, 1), (1808, 0)):
        for moments in metric._kept.values():
            moments.num = count
        assert len(metric.compute().details["warnings"]) == warnings


def test_pickled_metrics_hold_no_weights():
    metric = load_metric("kernel_range_distance")()
    assert len(pickle.dumps(metric)) < 2000
    assert pickle.loads(pickle.dumps(metric)).network is metric.network


def test_parts_through_other_weights_are_not_merged(tmp_path):
    torch.save(weights("pointnet", seed=1), tmp_path / "other.pth")
    for name in ("frechet_pointcloud_distance", "kernel_pointcloud_distance"):
        metric, other = load_metric(name)(), load_metric(name)(weights=tmp_path / "other.pth")
        with pytest.raises(ConfigError, match=r"got to merge .* through weights of .*same options"):
            metric.merge(other)


def test_images_of_two_kinds_are_not_mixed():
    metric = load_metric("frechet_pointcloud_distance")()
    metric.update(images(), real=True)
    with pytest.raises(ConfigError, match=r"got range images of 64x32 between 0\.9 and 120 m"):
        metric.update(images(ODOMETRY), real=False)


def test_kernel_distance_draws_alike_whatever_the_order_of_scans():
    values = []
    for order in ([0, 1, 2, 3, 4], [3, 1, 4, 0, 2]):
        metric = load_metric("kernel_pointcloud_distance")(variant="r2dm")
        metric.update(images(count=5), real=False)
        batch = images(count=8, seed=1)
        for index in (*order, 5, 6, 7):
            metric.update(batch[index], real=True)
        values.append(metric.compute().value)
    assert values[0] == pytest.approx(values[1], rel=1e-9)


def test_weights_that_no_training_gives_are_refused(tmp_path):
    broken = weights("pointnet")
    broken["fc3.bias"][3] = float("nan")
    torch.save(broken, tmp_path / "nan.pth")
    with pytest.raises(WeightsError, match=r"got features that are not finite from pointnet with .*nan.pth"):
        load_network("pointnet", tmp_path / "nan.pth").features(torch.rand(1, 3, 10))


def test_devices_that_are_not_there_are_refused():
    for device in ("nonsense", "cuda:99"):
        with pytest.raises(ConfigError, match=f"got device '{device}'"):
            load_metric("frechet_pointcloud_distance")(device=device)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a graphics card")
@pytest.mark.parametrize("name", list(NETWORKS))
def test_a_graphics_card_gives_the_same_features(name):
    batch = torch.rand(10, 5, 8, 64) if name == "rangenet53" else torch.rand(10, 3, 3000)
    here, there = (load_network(name, device=device).features(batch) for device in ("cpu", "cuda"))
    np.testing.assert_allclose(here, there, atol=1e-4 * np.abs(here).max())
