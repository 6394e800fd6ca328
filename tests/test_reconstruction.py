"""Reconstruction errors against the program's numbers, a slow loop and hand-counted masks."""

import math

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError, DataError, ScanError
from lidargrit.evaluation.reconstruction import ReconstructionScore, errors_of_scans
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(128)


def pairs(seed, count=5):
    rng = torch.Generator().manual_seed(seed)
    shape = (count, 64, 128)
    range_m = 1 + 100 * torch.rand(shape, generator=rng)
    real = RangeImage.masked(range_m, torch.rand(shape, generator=rng) > 0.3, SENSOR)
    return real, range_m + torch.randn(shape, generator=rng), torch.rand(shape, generator=rng) > 0.4


def errors_of(*batches):
    score = ReconstructionScore()
    for real, clean_range_m, return_mask in batches:
        score.update(real, clean_range_m, return_mask)
    return score.compute()


@pytest.mark.shared
def test_errors_and_accuracies_are_the_programs(golden):
    data = golden("misc")
    real, decoded = (torch.from_numpy(data[key][:, 0]) for key in ("depth_ref", "depth_gen"))
    mask = torch.from_numpy(data["depth_mask"][:, 0] > 0)
    ours = errors_of_scans(real, decoded, mask)
    theirs = {"abs_rel": "abs_rel", "sq_rel_m": "sq_rel", "scan_rmse_m": "rmse", "rmse_log": "rmse_log"}
    for name, their_name in theirs.items():
        assert np.allclose(ours[name].numpy(), data[f"err_{their_name}"], rtol=1e-5)
    assert np.allclose(ours["accuracy_1_25"].numpy(), data["acc_accuracy_1"], rtol=1e-6)


def test_pixels_without_a_return_have_no_say_in_the_measures_of_an_image():
    real = torch.tensor([[[2.0, 0.0, 4.0]], [[0.0, 0.0, 0.0]]])
    decoded = torch.tensor([[[3.0, 0.0, 4.0]], [[1.0, 2.0, 3.0]]])
    found = errors_of_scans(real, decoded, real > 0)
    expected = [0.25, 0.25, 0.5**0.5, math.log(1.5) / 2**0.5, 0.5]
    assert [each[0].item() for each in found.values()] == pytest.approx(expected)
    assert all(each[1].isnan() for each in found.values())


def test_score_is_that_of_a_slow_loop():
    real, clean_range_m, return_mask = pairs(0, count=2)
    absolute, squared, hits = [], [], []
    common = claimed = dropped = 0
    flat = (real.range_m, real.return_mask, clean_range_m, return_mask)
    for r, m, c, d in zip(*(x.flatten().tolist() for x in flat), strict=True):
        if m:
            absolute.append(abs(r - c))
            squared.append((r - c) ** 2)
        hits.append(m == d)
        common += not m and not d
        claimed += not d
        dropped += not m
    errors = errors_of((real, clean_range_m, return_mask))
    assert errors.range_mae_m == pytest.approx(np.mean(absolute), rel=1e-12)
    assert errors.range_rmse_m == pytest.approx(np.mean(squared) ** 0.5, rel=1e-12)
    assert errors.mask_accuracy == np.mean(hits)
    assert errors.drop_precision == common / claimed
    assert errors.drop_recall == common / dropped
    assert errors.drop_iou == common / (claimed + dropped - common)
    assert errors.num_scans == 2
    of_scans = {"abs_rel": [], "sq_rel_m": [], "scan_rmse_m": [], "rmse_log": [], "accuracy_1_25": []}
    for index in range(2):
        r, c = (x[index][real.return_mask[index]].double().numpy() for x in (real.range_m, clean_range_m))
        of_scans["abs_rel"].append(np.mean(abs(r - c) / r))
        of_scans["sq_rel_m"].append(np.mean((r - c) ** 2 / r))
        of_scans["scan_rmse_m"].append(np.mean((r - c) ** 2) ** 0.5)
        above = np.maximum(c, 1e-3)
        of_scans["rmse_log"].append(np.mean(np.log(r / above) ** 2) ** 0.5)
        of_scans["accuracy_1_25"].append(np.mean(np.maximum(r / above, above / r) < 1.25))
    for name, values in of_scans.items():
        assert getattr(errors, name) == pytest.approx(np.mean(values), rel=1e-5)


def test_a_perfect_decoder():
    real, _, _ = pairs(0)
    errors = errors_of((real, real.range_m, real.return_mask))
    assert (errors.range_mae_m, errors.range_rmse_m) == (0, 0)
    assert errors.mask_accuracy == errors.drop_precision == errors.drop_recall == errors.drop_iou == 1


def test_pieces_and_their_order_do_not_matter():
    real, clean_range_m, return_mask = pairs(0)
    batches = [(real[s], clean_range_m[s], return_mask[s]) for s in (slice(3, 5), slice(0, 1), slice(1, 3))]
    once = errors_of((real, clean_range_m, return_mask))
    assert vars(errors_of(*batches)) == pytest.approx(vars(once), rel=1e-12)


def test_what_the_decoder_says_of_dropped_rays_does_not_change_the_range_errors():
    real, clean_range_m, return_mask = pairs(0)
    wild = torch.where(real.return_mask, clean_range_m, math.nan)
    assert errors_of((real, wild, return_mask)) == errors_of((real, clean_range_m, return_mask))


def test_shares_of_nothing_are_1_and_inputs_stay_as_they_are():
    range_m = torch.full((1, 64, 128), 5.0)
    everywhere = torch.ones_like(range_m, dtype=torch.bool)
    real = RangeImage(range_m.clone(), everywhere.clone(), SENSOR)
    errors = errors_of((real, range_m, everywhere))
    assert errors.drop_precision == errors.drop_recall == errors.drop_iou == 1
    assert (range_m == 5).all()
    assert everywhere.all()
    errors = errors_of((real, range_m, ~everywhere))
    assert (errors.drop_precision, errors.drop_recall, errors.drop_iou, errors.mask_accuracy) == (0, 1, 0, 0)


def test_mistakes_are_refused():
    real, clean_range_m, return_mask = pairs(0)
    with pytest.raises(DataError, match="got 0 pairs of range images without one real return"):
        ReconstructionScore().compute()
    with pytest.raises(ConfigError, match="decode the batch that was encoded"):
        ReconstructionScore().update(real[:2], clean_range_m, return_mask)
    clean_range_m[real.return_mask] = math.inf
    with pytest.raises(ScanError, match="check the weights of the tokenizer"):
        ReconstructionScore().update(real, clean_range_m, return_mask)
