"""What can be chosen on the page that is served, and the command that serves it."""

import re
import socket
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from waitress.server import TcpWSGIServer

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.data.formats import load
from lidargrit.scans.types import Scan
from lidargrit.viewer.serve import server
from lidargrit.viewer.serve.jobs import JobQueue
from lidargrit.viewer.serve.requests import SampleRequest, parse_json_object, parse_request, sampling_settings
from lidargrit.viewer.serve.worker import compute_result
from served import LIMITS, MODELS
from test_generator_contract import made

QUICK = {"steps": 3, "resamples": 2}


@pytest.fixture(scope="module")
def scan_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scans") / "my <b>street.ply"
    load("ply").write(path, lidargrit.simulate(seed=5))
    return path


# What can be chosen.


def test_numbers_of_every_generator_can_be_chosen():
    found = {name: [setting.name for setting in sampling_settings(made(name)[0].Sampling())] for name in MODELS}
    of_tokens = ["temperature", "top_k", "top_p", "guidance"]
    of_pixels = [*(f"{what}_temperature" for what in ("range", "surface", "mask")), "range_noise", "mask_correlation"]
    assert found == {
        "lidargrit": [*of_tokens, *of_pixels],
        "marginal": [],
        "r2dm": ["steps", "resamples"],
    }
    settings = {setting.name: setting for setting in sampling_settings(made("dusty")[0].Sampling())}
    assert settings["tolerance"].default is None
    assert not settings["tolerance"].whole
    assert settings["search_steps"].at_most == 1024
    assert settings["search_rate"].about == "highest learning rate of that optimiser."


GOOD = {"model": 0, "seed": 3, "count": 2, "sampling": {"temperature": 1, "top_k": 5}}


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"seed": -1}, "whole number, at least 0"),
        ({"seed": 2**32}, "whole number, at least 0"),
        ({"seed": 2**32 - 1}, "seeds up to 4294967295; lower one of the two"),
        ({"seed": 10**400}, "whole number, at least 0"),
        ({"seed": True}, "whole number"),
        ({"seed": 1.0}, "whole number"),
        ({"seed": "1"}, "whole number"),
        ({"seed": None}, "whole number"),
        ({"count": 0}, "at least 1, at most 8"),
        ({"count": 10**9}, "at least 1, at most 8"),
        ({"model": 3}, "at least 0, at most 2"),
        ({"model": -1}, "at least 0, at most 2"),
        ({"task": ["ahead"]}, "ahead, region, returns, rows"),
        ({"example": "../street"}, "one of street, vlp16, clean"),
        ({"region": [0, 0, 1]}, "left, top, right and bottom"),
        ({"region": [0.5, 0, 0.5, 1]}, "draw it anew"),
        ({"region": [0, 0, 1, float("nan")]}, "as shares of the image"),
        ({"region": "all"}, "as shares of the image"),
        ({"sampling": {"temperature": "hot"}}, "a number, at least -100, at most 100"),
        ({"sampling": {"temperature": 1e300}}, "a number, at least -100, at most 100"),
        ({"sampling": {"temperature": False}}, "a number, at least -100, at most 100"),
        ({"sampling": {"top_k": 1.5}}, "at least 0, at most 1,024"),
        ({"sampling": {"top_k": 10**30}}, "at least 0, at most 1,024"),
        ({"sampling": {"tempreature": 1}}, "temperature"),
        ({"sampling": {"mask": "threshold"}}, "does not have"),
        ({"sampling": [1]}, "JSON object"),
        ({"file": "/etc/passwd"}, "one of model, seed"),
        ({"x" * 9999: 1}, "one of model, seed"),
    ],
)
def test_requests_out_of_bounds_are_refused(changed, why):
    settings = [sampling_settings(made(name)[0].Sampling()) for name in MODELS]
    request = parse_request(GOOD, settings, LIMITS)
    assert (request.seed, request.count, request.sampling) == (3, 2, {"temperature": 1.0, "top_k": 5})
    with pytest.raises(ConfigError, match=why) as refused:
        parse_request({**GOOD, **changed}, settings, LIMITS)
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize("data", [b"", b"[]", b"7", b"{", b'{"seed": NaN}', b"\xff", b"[" * 4000, b'{"a":' * 800])
def test_words_that_are_none_are_refused(data):
    with pytest.raises(ConfigError, match="not a JSON object"):
        parse_json_object(data)


def test_names_of_files_lose_what_could_do_harm():
    for name, plain in (("../../a b.ply", "a_b.ply"), ("c:\\x\\y.bin", "y.bin"), ("<i>.npz", "_i_.npz"), (7, "")):
        assert parse_request({"name": name}, [[]], LIMITS).name == plain
    assert len(parse_request({"name": "n" * 9999}, [[]], LIMITS).name) == 60


def test_a_part_of_the_circle_and_rings_that_nobody_told(tmp_path):
    scan = lidargrit.simulate(seed=5)
    ahead = scan.points_xyz_m[:, 0] > scan.points_xyz_m[:, 1].abs()
    shuffled = torch.randperm(int(ahead.sum()), generator=torch.Generator().manual_seed(0))
    part = Scan(scan.points_xyz_m[ahead][shuffled], scan.reflectance[ahead][shuffled])
    load("kitti_bin").write(tmp_path / "part.bin", part)
    request = SampleRequest(0, sampling=QUICK, file=str(tmp_path / "part.bin"), name="mine.bin")
    uploaded, completed = compute_result(made("r2dm")[0], request)
    kept = uploaded.images.return_mask
    assert 0.15 < kept.float().mean() < 0.3
    assert not kept[:, :, :8].any(), "behind"
    assert completed.images.return_mask.sum() > kept.sum()
    assert torch.equal(completed.images.range_m[kept], uploaded.images.range_m[kept])
    with pytest.raises(ScanError, match=r"degrees of azimuth in mine\.bin"):
        compute_result(made("maskgit")[0], replace(request, sampling={}))


def test_a_region_is_drawn_and_filled_in_rows_are_added_and_returns_dropped(tmp_path, scan_file):
    model = made("lidargrit")[0]
    request = SampleRequest(0, count=2, task="region", file=str(scan_file), name="mine.ply")
    assert [one.name for one in compute_result(model, request)] == ["as uploaded"], "to draw on"
    whole, seen, completed = compute_result(model, replace(request, region=(0.25, 0.5, 0.5, 1.0)))
    height, width = whole.images.range_m.shape[1:]
    outside = torch.ones(height, width, dtype=torch.bool)
    outside[height // 2 :, width // 4 : width // 2] = False
    for images in (seen.images, completed.images):
        assert all(torch.equal(one[outside], whole.images.range_m[0][outside]) for one in images.range_m)
    assert not seen.images.return_mask[0][~outside].any()
    assert len(completed.images) == 2
    whole, dropped = compute_result(model, replace(request, task="raydrop"))
    assert dropped.name == "with raydrop"
    assert bool((dropped.images.return_mask <= whole.images.return_mask).all())
    assert 0 < dropped.images.return_mask.float().mean() < whole.images.return_mask.float().mean()
    load("ply").write(tmp_path / "few.ply", lidargrit.simulate(seed=5, sensor=lidargrit.load_sensor("vlp16")))
    few = replace(request, task="vlp16", file=str(tmp_path / "few.ply"))
    sparse, dense = compute_result(model, few)
    rows = [int(one.images.return_mask.any(2).any(0).sum()) for one in (sparse, dense)]
    assert rows[0] < 16
    assert rows[1] > 50
    with pytest.raises(ScanError, match=r"16 rings in mine\.ply"):
        compute_result(model, replace(few, task="returns"))


# The command.


class Idle(JobQueue):
    """Runs no jobs."""

    def __init__(self, *_: object) -> None:
        self.models, self.limits = [], LIMITS

    def __exit__(self, *_: object) -> None:
        pass


def test_the_command_says_where_and_to_whom(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made("marginal")[0].save(tmp_path / "runs" / "tiny")
    (tmp_path / "runs" / "tiny" / "model.safetensors").write_bytes(b"no weights")
    assert main(["serve", "runs/tiny", "--port", "0"]) == 2, "told by the worker process"
    assert re.fullmatch(r"lidargrit serve: got \S*model.safetensors.*; wanted .*; .*\n", capsys.readouterr().err)
    monkeypatch.setattr(server, "JobQueue", Idle)
    monkeypatch.setattr(TcpWSGIServer, "run", lambda self: None)
    assert main(["serve", "--port", "0", "--host", "0.0.0.0"]) == 0
    said = capsys.readouterr().out
    assert re.match(
        r"left out: runs/tiny: got \S*model.safetensors.*; wanted .*\nWARNING: everybody who reaches ", said
    )
    assert re.search(rf"open http://{re.escape(socket.gethostname())}:\d+ in a browser \(where .* numeric", said)
    for wrong in (
        ["--seconds", "-1"],
        ["--seconds", "inf"],
        ["--port", "99999"],
        ["--host", "ü" * 70],
        ["nope", "--port", "0"],  # by no worker process, which takes seconds to load
    ):
        assert main(["serve", *wrong]) == 2
        assert capsys.readouterr().err.startswith("lidargrit serve: got ")
