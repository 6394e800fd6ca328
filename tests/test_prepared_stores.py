"""Prepared images as a Zarr store: far away, behind HTTP, and as other programs read them."""

import threading
from contextlib import closing
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import tensorstore
import torch
import xarray
import zarr

from dataset_examples import write_example
from lidargrit.core.errors import DataError, ScanError
from lidargrit.data.prepared.arrays import store_context, store_of
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
from lidargrit.data.prepared.prepared import PreparedImages
from lidargrit.data.sources import load_range_images
from lidargrit.scans.marks import read_marks

SIMULATED = DataConfig(workers=1)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "tree"
    write_example("kitti_odometry", folder, 5)
    return folder


def test_prepared_images_are_a_source_here_and_by_url(tree, tmp_path):
    folder = prepare(str(tree), SIMULATED, tmp_path / "out")
    here = load_range_images((str(folder),), SIMULATED)
    memory = tensorstore.KvStore.open("memory://bucket/scans/", context=store_context(True)).result()
    for path in filter(Path.is_file, folder.rglob("*")):
        memory.write(str(path.relative_to(folder)), path.read_bytes()).result()
    away = load_range_images(("memory://bucket/scans",), SIMULATED)
    assert torch.equal(here.batch([3, 0]).range_m, away.batch([3, 0]).range_m)
    with pytest.raises(DataError, match=r"prepared for 'hdl64e_kitti_odometry' \(64x2048\); wanted the rays of"):
        load_range_images((str(folder),), DataConfig(sensor="hdl64e_kitti_360"))
    with pytest.raises(DataError, match=r"memory://bucket/nothing/plan.json, which does not exist"):
        load_range_images(("memory://bucket/nothing",), SIMULATED)
    with pytest.raises(DataError, match=r"gopher.*wanted s3://, gs://, http:// or https://; check it"):
        load_range_images(("gopher://somewhere",), SIMULATED)


class PartsOfFiles(SimpleHTTPRequestHandler):
    """Serves parts of files, as object stores do."""

    answer = 206

    def do_GET(self):
        path, wanted = Path(self.translate_path(self.path)), self.headers["Range"]
        code = PartsOfFiles.answer if path.is_file() else 404
        content = path.read_bytes() if code == 206 else b""
        self.send_response(code if wanted or code != 206 else 200)
        if wanted and code == 206:
            first, _, last = wanted.removeprefix("bytes=").partition("-")
            begin = int(first) if first else len(content) - int(last)
            part = content[begin : int(last) + 1 if first and last else None]
            self.send_header("Content-Range", f"bytes {begin}-{begin + len(part) - 1}/{len(content)}")
            content = part
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format, *args):
        pass


def test_prepared_images_are_read_by_http(tree, tmp_path, monkeypatch):
    folder = prepare(str(tree), SIMULATED, tmp_path / "out")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(PartsOfFiles, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/out"
    with closing(server.socket):
        images = load_range_images((url,), SIMULATED)
        here = load_range_images((str(folder),), SIMULATED)
        assert torch.equal(images.batch([3, 0]).range_m, here.batch([3, 0]).range_m)
        monkeypatch.setattr(PartsOfFiles, "answer", 403)
        with pytest.raises(DataError, match=r"images.zarr, which cannot be read \(PERMISSION_DENIED.*; wanted a store"):
            images.batch([1])
        with pytest.raises(DataError, match=r"plan.json, which cannot be read \(PERMISSION_DENIED"):
            load_range_images((url,), SIMULATED)
        server.shutdown()


def test_the_usual_variables_tell_where_a_bucket_is(monkeypatch):
    for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ACCESS_KEY_ID", "AWS_REGION", "AWS_DEFAULT_REGION"):
        monkeypatch.delenv(name, raising=False)
    plain = {"driver": "s3", "bucket": "bucket", "path": "scans/"}
    assert store_of("s3://bucket/scans") == plain
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "me")
    here = {"endpoint": "http://127.0.0.1:1", "aws_region": "us-east-1", "aws_credentials": {"type": "environment"}}
    assert store_of("s3://bucket/scans") == plain | here


def test_other_programs_for_zarr_read_the_images(tree, tmp_path):
    images = PreparedImages(str(prepare(str(tree), SIMULATED, tmp_path / "out")))
    opened = xarray.open_zarr(tmp_path / "out" / "images.zarr", consolidated=False)
    assert opened["range"].dims == ("scan", "row", "column")
    steps = zarr.open_array(str(tmp_path / "out" / "images.zarr" / "range"), mode="r")
    step_m = float(str(steps.attrs["step_m"]))
    for index in range(5):
        pixels = images.read(index)
        assert np.array_equal(np.asarray(steps[index]) * np.float32(step_m), pixels.range_m)
        assert np.array_equal(opened["reflectance"][index].values * np.float32(1 / 255), pixels.planes["reflectance"])


def test_streets_of_one_seed_are_told_apart_by_what_is_made_of_them(tmp_path, monkeypatch):
    """Surfaces have the seeds of measured streets, and another sensor may scan them; the cache must not mix them up."""
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path))
    config = DataConfig(workers=1, columns=64)
    sources = ("simulated:1:val", "simulated_surfaces:1:val")
    measured, surfaces = (load_range_images((source,), config).batch([0]) for source in sources)
    assert measured.reflectance is not None
    assert surfaces.reflectance is not None
    assert not read_marks(measured.reflectance).is_clear
    assert read_marks(surfaces.reflectance).is_clear
    assert surfaces.return_mask.sum() > measured.return_mask.sum()
    with pytest.raises(ScanError, match="rings that lie elsewhere"):  # and not the scan of the other sensor
        load_range_images(("simulated:1@vlp16:val",), config)
