"""A reference file: scores without the real scans, equal to those with them; damaged and altered files in one line."""

import dataclasses
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

import seeded_networks
from lidargrit import api
from lidargrit.cli import main
from lidargrit.core.arrays import read_arrays
from lidargrit.core.errors import ConfigError, DataError, LidarGritError
from lidargrit.core.files import sha256_of_json
from lidargrit.data.prepared.config import DataConfig
from lidargrit.evaluation import reference_file as module
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_sources, save_reference
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.metrics.shared.accumulators import SumAccumulator
from lidargrit.evaluation.metrics.shared.networks.frechet import Moments, frechet_distance
from lidargrit.evaluation.reference_file import ReferenceFile
from tiny_runs import the_one_line

METRICS = ("sliced_wasserstein", "bev_jsd", "bev_mmd", "drop_run_lengths")
SMALL = DataConfig(columns=128, column_stride=2, workers=1)
SETTINGS = EvalConfig("objects", METRICS, resampling=Resampling(4, 3), pixel_statistics=True, data=SMALL)
PLAIN = EvalConfig(resampling=Resampling(halves=0), data=SMALL)
SAMPLES, REAL = "simulated:9:val", "simulated:8:test"


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return save_reference(REAL, tmp_path_factory.mktemp("reference") / "streets.lgref", SETTINGS).path


def told(card):
    """All of a scorecard that a reference file must not change."""
    scores = [dataclasses.replace(score, seconds=0.0) for score in card.scores]
    return card.protocol, card.samples, card.reference, scores, card.left_out, card.deviations, card.warnings, card.leak


def test_scores_are_equal_with_and_without_the_file(path):
    with_file, _ = evaluate_sources(SAMPLES, str(path), SETTINGS)
    without, _ = evaluate_sources(SAMPLES, REAL, SETTINGS)
    assert told(with_file) == told(without)
    assert {score.result.metric for score in without.scores} == set(METRICS)
    assert all(score.interval and score.real_against_real and score.pixel_statistics for score in without.scores)
    assert with_file.reference.file_sha256 == ReferenceFile(path).sha256
    assert without.reference.file_sha256 == ""


def test_the_file_knows_scans_that_the_samples_repeat(path):
    settings = dataclasses.replace(SETTINGS, metrics=("bev_jsd",), pixel_statistics=False)
    assert "8 scans are in both" in evaluate_sources(REAL, str(path), settings)[0].leak


def test_moments_are_restored_bit_for_bit():
    vectors = np.random.default_rng(0).normal(size=(3, 40, 5)).astype(np.float32)
    seen, again, other = Moments(), Moments(), Moments()
    for batch in vectors[:2]:
        seen.add(batch)
    other.add(vectors[2])
    again.restore(seen.arrays())
    assert frechet_distance(again, other) == frechet_distance(seen, other)
    mean, covariance = again.mean, again.root().T @ again.root()
    rows = vectors[:2].reshape(-1, 5).astype(np.float64)
    np.testing.assert_allclose(mean, rows.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(covariance, np.cov(rows.T), atol=1e-12)


def test_counts_are_kept_small_and_add_up_again():
    seen, again = SumAccumulator(), SumAccumulator()
    seen.add(np.array([0, 255, 3]))
    assert seen.arrays()["total"].dtype == np.uint8, "4 MB for LiDM's cells, not 32 for each of 16 groups"
    for _ in range(2):
        again.restore(seen.arrays())
        again.merge(seen)
    assert again.value().tolist() == [0, 510, 6]


def test_the_file_holds_sums_and_no_scan(path, monkeypatch, tmp_path):
    (jsd,) = [each for each in ReferenceFile(path).contents.metrics if each.metric == "bev_jsd"]
    with path.open("rb") as file:
        names = tuple(part.arrays["total"] for part in jsd.real)
        total = np.sum([*read_arrays(file, names).values()])
    card, pair = evaluate_sources(SAMPLES, REAL, dataclasses.replace(PLAIN, metrics=("bev_jsd",), variant="exact"))
    assert card.reference.scans_used == 8
    points = 0
    for image in pair.reference.batch(range(8)):  # an independent count, ray by ray
        near = (image.range_m > 3) & (image.range_m < 70)
        points += int(near.sum())
    assert total == pytest.approx(points, abs=2)  # ranges of points are rounded otherwise, by the limits
    monkeypatch.setattr(module, "METRIC_BYTES_AT_MOST", 0)
    with pytest.raises(DataError, match="would hold nothing: sliced_wasserstein: it would take"):
        save_reference(REAL, tmp_path / "small.lgref", PLAIN)
    monkeypatch.setattr(module, "METRIC_BYTES_AT_MOST", 100_000)
    small = save_reference(REAL, tmp_path / "small.lgref", PLAIN)
    missing = [each.metric for each in small.contents.metrics if each.why_not]
    assert "sliced_wasserstein" in missing
    left_out = evaluate_sources(SAMPLES, str(small.path), PLAIN)[0].left_out
    assert [each.metric for each in left_out] == missing
    assert "more than 0 (--metrics sliced_wasserstein keeps all)" in left_out[0].why


@pytest.mark.parametrize(
    ("samples", "change", "line"),
    [
        (SAMPLES, {"protocol": "exact"}, "--protocol exact with {}, which was made with objects"),
        (SAMPLES, {"seed": 3}, "--seed 3 with {}, which was made with 0"),
        (SAMPLES, {"resampling": Resampling(8, 3)}, "--groups 8 with {}, which was made with 4"),
        (SAMPLES, {"max_scans": 3}, "-n 3 with {}, which sums up 8 scans"),
    ],
)
def test_other_settings_than_those_of_the_file_are_refused(path, samples, change, line):
    with pytest.raises(ConfigError) as refused:
        evaluate_sources(samples, str(path), dataclasses.replace(SETTINGS, **change))
    assert line.format(path) in str(refused.value)


def test_metrics_that_the_file_lacks_are_named(path):
    settings = dataclasses.replace(SETTINGS, metrics=("bev_jsd", "flying_points"))
    card, _ = evaluate_sources(SAMPLES, str(path), settings)
    (left_out,) = [each for each in card.left_out if each.metric == "flying_points"]
    assert "holds nothing for flying_points (exact): it was made without this metric" in left_out.why


def rewritten(path, out, change):
    """Write the arrays of a file again, some of them changed, as numpy would."""
    with zipfile.ZipFile(path) as archive:
        arrays = {name.removesuffix(".npy"): np.load(archive.open(name)) for name in archive.namelist()}
    change(arrays)
    with out.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return out


def test_damaged_and_altered_files_are_refused_in_one_line(path, tmp_path, capsys):
    assert told(evaluate_sources(SAMPLES, str(rewritten(path, tmp_path / "same.lgref", dict)), SETTINGS)[0]) == told(
        evaluate_sources(SAMPLES, str(path), SETTINGS)[0]
    )
    data = path.read_bytes()
    (tmp_path / "short.lgref").write_bytes(data[: len(data) // 2])
    (tmp_path / "empty.lgref").write_bytes(b"")
    (tmp_path / "begun.lgref").write_bytes(b"PK")

    def other_count(arrays):
        about = json.loads(arrays["about"].tobytes())
        about["set"]["scans_used"] = 7
        arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)

    def other_numbers(arrays):
        part = next(each for each in ReferenceFile(path).contents.metrics if each.metric == "bev_jsd").real[0]
        arrays[part.arrays["total"]] = arrays[part.arrays["total"]] + 1

    rewritten(path, tmp_path / "count.lgref", other_count)
    rewritten(path, tmp_path / "numbers.lgref", other_numbers)
    lines = {
        "short": "which cannot be read",
        "empty": "which cannot be read (an empty file)",
        "begun": "which cannot be read (2 bytes, too few for an archive)",
        "missing": "which is not there",
        "count": "which was altered after it was written",
        "numbers": "in which total of bev_jsd was altered",
    }
    for name, line in lines.items():
        words = [
            "evaluate",
            SAMPLES,
            str(tmp_path / f"{name}.lgref"),
            "--protocol",
            "objects",
            "--metrics",
            "bev_jsd",
            "--groups",
            "4",
        ]
        assert main(words) == 2
        assert line in the_one_line(capsys.readouterr().err, "evaluate")


def with_array_of_another_shape(path, out, metric, change):
    """Write a file whose hashes hold, in which the first array of a metric is another."""

    def changed(arrays):
        about = json.loads(arrays["about"].tobytes())
        kept = next(each for each in about["metrics"] if each["metric"] == metric)
        for part in kept["real"]:
            (name, sha256), *_ = part["arrays"].items()
            array = change(arrays[sha256])
            part["arrays"][name] = module._sha256_of_array(array)
            arrays[part["arrays"][name]] = array
        del about["sha256"]
        about["sha256"] = sha256_of_json(about)
        arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)

    return rewritten(path, out, changed)


@pytest.mark.parametrize("change", [lambda array: array[None], lambda array: np.array(1.0)], ids=["axis", "scalar"])
def test_arrays_of_another_shape_leave_their_metric_out(path, tmp_path, change):
    metric = "sliced_wasserstein"
    altered = with_array_of_another_shape(path, tmp_path / "shape.lgref", metric, change)
    card, _ = evaluate_sources(SAMPLES, str(altered), dataclasses.replace(SETTINGS, metrics=(metric, "bev_jsd")))
    assert [score.result.metric for score in card.scores] == ["bev_jsd"]
    assert [each.metric for each in card.left_out] == [metric]


def test_rows_that_always_return_are_two_numbers(path, tmp_path):
    def four(arrays):
        about = json.loads(arrays["about"].tobytes()) | {"full_rows": [1, 2, 3, 4]}
        del about["sha256"]
        about["sha256"] = sha256_of_json(about)
        arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)

    with pytest.raises(DataError, match="full_rows of 4 numbers"):
        ReferenceFile(rewritten(path, tmp_path / "rows.lgref", four))


def test_the_commands(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = ["evaluate", REAL, "--save-reference", "a.lgref", "--metrics", "bev_jsd", "--intervals", "0"]
    made += ["--set", "data.columns=128", "data.column_stride=2"]
    assert main([*made, "--json", "facts.json"]) == 0
    out = capsys.readouterr().out
    assert out.endswith("done: facts in facts.json\n")
    assert "score with: lidargrit evaluate SAMPLES a.lgref --protocol exact" in out
    assert main(made) == 2
    assert "which is there already" in the_one_line(capsys.readouterr().err, "evaluate")
    assert main([*made[:3], "a.scores", "--metrics", "bev_jsd"]) == 2
    assert "a name in .lgref" in the_one_line(capsys.readouterr().err, "evaluate")
    assert main(["evaluate", SAMPLES, "a.lgref", "--report", "page.html", "--intervals", "0"]) == 2
    assert "--report with a.lgref, which holds no scan" in the_one_line(capsys.readouterr().err, "evaluate")
    Path("A.LGREF").write_bytes(Path("a.lgref").read_bytes())
    assert main(["evaluate", SAMPLES, "A.LGREF", "--report", "page.html", "--intervals", "0"]) == 2
    assert "A.LGREF, which holds no scan" in the_one_line(capsys.readouterr().err, "evaluate")
    with pytest.raises(ConfigError, match=r"--groups 16 with a\.lgref, which was made with 0"):
        api.evaluate(SAMPLES, "a.lgref", metrics=["bev_jsd"])
    assert main(["view", "a.lgref", "-o", "a.html"]) == 2
    assert "a.lgref" in the_one_line(capsys.readouterr().err, "view")


def test_features_through_other_weights_are_not_compared(tmp_path):
    files = {seed: tmp_path / f"{seed}.pth" for seed in (1, 2)}
    for seed, file in files.items():
        torch.save(seeded_networks.weights("pointnet", seed), file)
    settings = dataclasses.replace(PLAIN, metrics=("frechet_pointcloud_distance", "bev_jsd"), variant="exact")
    first, other = (dataclasses.replace(settings, weights={"pointnet": file}) for file in files.values())
    made = str(save_reference(REAL, tmp_path / "features.lgref", first).path)
    assert told(evaluate_sources(SAMPLES, made, first)[0]) == told(evaluate_sources(SAMPLES, REAL, first)[0])
    (left_out,) = evaluate_sources(SAMPLES, made, other)[0].left_out
    assert "and a reference that was made by" in left_out.why


def test_fewer_samples_and_samples_of_other_rays_are_refused(path, tmp_path):
    lines = {"few": "4 scans in .*, and a reference file of 8", "wide": "a range image of 64x96; wanted 64x64"}
    for name, (count, columns) in {"few": (4, 64), "wide": (8, 96)}.items():
        (tmp_path / name).mkdir()
        for number in range(count):
            np.save(tmp_path / name / f"{number}.npy", np.ones((64, columns), np.float32))
        with pytest.raises(LidarGritError, match=lines[name]):
            evaluate_sources(str(tmp_path / name), str(path), SETTINGS)
    (tmp_path / "r2dm").mkdir()
    torch.save(torch.ones(5, 64, 1024), tmp_path / "r2dm" / "samples_0000000.pth")
    with pytest.raises(ConfigError, match=r"\(64x1024, column stride 1\), and .* scans as .*; have a file made with"):
        evaluate_sources(str(tmp_path / "r2dm"), str(path), dataclasses.replace(SETTINGS, data=DataConfig(workers=1)))
