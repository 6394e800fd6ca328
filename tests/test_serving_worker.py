"""What the server's worker process computes is what the commands compute: settings left alone, and the projection."""

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import torch

import lidargrit
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import load, read_scan
from lidargrit.inference.complete.inputs import ScanReader
from lidargrit.inference.segment import label_images, open_segmenter
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.viewer.serve.requests import TASKS, SampleRequest
from lidargrit.viewer.serve.worker import PAGE_FILE, PIXELS_FILE, compute_result, describe_model, run_worker
from test_generator_contract import made


@pytest.fixture(scope="module")
def scan_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scans") / "street.ply"
    load("ply").write(path, lidargrit.simulate(seed=5))
    return path


class BegunError(Exception):
    """A model would begin to compute."""


@pytest.mark.parametrize(
    ("name", "other", "changed"), [("r2dm", "steps", {"resamples": 2}), ("dusty", "search_steps", {"search_rate": 0.5})]
)
def test_settings_that_were_left_alone_are_those_of_what_is_done(name, other, changed, scan_file, monkeypatch):
    def begin(*given, sampling=None):
        raise BegunError(given[-1] if sampling is None else sampling)

    model = made(name)[0]
    monkeypatch.setattr(model, "sample", begin)
    monkeypatch.setattr(model, "complete", begin)
    for file, own in (("", model.Sampling()), (str(scan_file), model.completion_sampling())):
        with pytest.raises(BegunError) as begun:
            compute_result(model, SampleRequest(0, sampling=changed, file=file, name="mine.ply"))
        assert begun.value.args == (replace(own, **changed),)
    value = getattr(model.completion_sampling(), other)
    settings = describe_model("tiny", model)["settings"]
    unread = {one["name"] for one in settings if one["about"].endswith("Only completing a scan reads it.")}
    assert unread == {one["name"] for one in settings} & model.not_of_sampling != set()
    assert [one["name"] for one in settings if f"a scan is completed with {value}." in one["about"]] == [other]


def test_an_uploaded_scan_is_projected_as_those_that_the_model_learned_from(scan_file, tmp_path, monkeypatch):
    runs = [tmp_path / variant for variant in ("reference", "exact")]
    model, images = made("r2dm")[0], []
    for run in runs:
        model.save(run)
        (run / "run.json").write_text(json.dumps({"preset": {"data": {"projection_variant": run.name}}}))
    for number, run in enumerate(runs):
        out = tmp_path / f"{run.name} result"
        out.mkdir()
        request = {"model": number, "task": "ahead", "file": str(scan_file), "sampling": {"steps": 1, "resamples": 1}}
        monkeypatch.setattr("sys.stdin", StringIO(json.dumps({"request": request, "folder": str(out)})))
        monkeypatch.setattr("sys.stdout", answers := StringIO())
        run_worker(runs, "cpu")
        assert json.loads(answers.getvalue().splitlines()[-1]) == {"done": True}
        images.append(np.load(out / PIXELS_FILE)["range_m_0"][0])
        wanted = ScanReader(model.sensor, run.name, partial=True).read(read_scan(scan_file, bad_points="drop"))
        assert np.array_equal(images[-1], wanted.image.range_m.numpy())
    assert not np.array_equal(*images)


@pytest.fixture(scope="module")
def part_file(tmp_path_factory) -> Path:
    path, scan = tmp_path_factory.mktemp("scans") / "behind.ply", lidargrit.simulate(seed=5)
    behind = scan.points_xyz_m[:, 0] < -scan.points_xyz_m[:, 1].abs()
    load("ply").write(path, Scan(scan.points_xyz_m[behind], scan.reflectance[behind]))
    return path


@pytest.mark.parametrize("task", [task for task in TASKS if task not in ("returns", "label")])
def test_a_part_of_the_circle_is_taken_only_where_lost_returns_are_completed(task, part_file):
    # elsewhere rays outside of it would count as observed, and lost
    with pytest.raises(ScanError, match=r"degrees of azimuth in mine\.ply|rings in mine\.ply"):
        compute_result(made("lidargrit")[0], SampleRequest(0, task=task, file=str(part_file), name="mine.ply"))


@pytest.mark.parametrize(
    ("sensor", "task", "cure"),
    [
        ("vlp16", "returns", "choose the task 'Add the rows that a VLP-16 lacks', or a model of the scan's sensor"),
        ("hdl32e", "returns", "lacks' or 'Add the rows that a VLP-32C lacks', or a model of the scan's sensor"),
        ("os1_128", "returns", "choose a model of the sensor that made the scan, or choose another scan"),
        ("hdl32e", "vlp16", "choose the task that names the sensor of the scan, or choose another scan"),
    ],
)
def test_the_cure_for_a_scan_of_another_sensor_is_one_of_the_page(sensor, task, cure, tmp_path):
    load("ply").write(tmp_path / "a.ply", lidargrit.simulate(seed=5, sensor=lidargrit.load_sensor(sensor)))
    request = SampleRequest(0, task=task, file=str(tmp_path / "a.ply"), name="mine.ply")
    with pytest.raises(ScanError, match=r"mine\.ply") as refused:
        compute_result(made("lidargrit")[0], request)
    assert refused.value.cure.endswith(cure)


def test_models_that_do_not_complete_have_no_task(scan_file):
    model = made("maskgit")[0]
    assert describe_model("tiny", model)["tasks"] == []
    assert "vlp16" in describe_model("tiny", made("lidargrit")[0])["tasks"]
    plain, chosen = (
        compute_result(model, SampleRequest(0, task=task, file=str(scan_file))) for task in ("returns", "vlp16")
    )
    assert np.array_equal(plain[0].images.range_m, chosen[0].images.range_m), "the task of another model"
    assert [one.generated for one in plain] == [False, True], "no pixel of a reconstruction was measured"
    assert plain[0].filled is None, "nothing to tell apart in a scan"


def test_messages_of_tasks_name_no_option_of_the_command_line(tmp_path):
    scan = lidargrit.simulate(seed=5)
    ahead = scan.points_xyz_m[:, 0] > scan.points_xyz_m[:, 1].abs()
    points_xyz_m = torch.where(ahead[:, None], scan.points_xyz_m, scan.points_xyz_m * 1e-3)  # others below all limits
    load("ply").write(tmp_path / "ahead.ply", Scan(points_xyz_m, scan.reflectance, scan.ring))
    request = SampleRequest(0, task="ahead", file=str(tmp_path / "ahead.ply"), name="mine.ply")
    with pytest.raises(ScanError, match=r"^got mine\.ply without a return outside the part to fill in") as refused:
        compute_result(made("lidargrit")[0], request)
    assert "--" not in str(refused.value)
    (tmp_path / "none.csv").write_text("x,y,z\n0,0,0\n")  # the origin is no return
    with pytest.raises(ScanError, match=r"^got no point in mine\.csv; wanted a full revolution; take another scan$"):
        compute_result(made("lidargrit")[0], replace(request, file=str(tmp_path / "none.csv"), name="mine.csv"))


def test_a_scan_is_labelled_by_the_segmenter_beside_a_model(scan_file, tmp_path, monkeypatch):
    request = {"model": 0, "task": "label", "file": str(scan_file), "name": "mine.ply"}
    monkeypatch.setattr("sys.stdin", StringIO(json.dumps({"request": request, "folder": str(tmp_path)})))
    monkeypatch.setattr("sys.stdout", answers := StringIO())
    run_worker([Path("pretrained")], "cpu")
    described, answered = map(json.loads, answers.getvalue().splitlines())
    assert "label" in described["models"][0]["tasks"]
    assert answered == {"done": True}
    pixels, scan = np.load(tmp_path / PIXELS_FILE), read_scan(scan_file, bad_points="drop")
    segmenter = open_segmenter("pretrained", "cpu")
    seen = ScanReader(segmenter.sensor, partial=True).read(scan)
    wanted = label_images(segmenter, RangeImage.stack([seen.image]))
    assert np.array_equal(pixels["label_0"], wanted.label)
    page = json.loads((tmp_path / PAGE_FILE).read_text())
    assert [source["name"] for source in page["sources"]] == ["labelled"]
    assert {"road", "car"} <= {one["name"] for one in page["sources"][0]["classes"]}
    assert "label" not in describe_model("tiny", made("lidargrit")[0])["tasks"]
