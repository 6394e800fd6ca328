"""Published weights: where they are looked for, how they are fetched, and what strangers' files cannot do."""

import hashlib
import io
import os
import pickle
import tarfile
import urllib.error
import urllib.request
import zipfile
from dataclasses import replace
from email.message import Message

import numpy as np
import pytest
import torch

from lidargrit.core.errors import WeightsError
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.metrics.shared.networks import weights as published_weights
from lidargrit.evaluation.metrics.shared.networks.network import NETWORKS, load_network
from lidargrit.evaluation.metrics.shared.networks.weights import (
    PublishedWeights,
    _HttpsOnly,
    find_weights,
    read_weights,
)
from seeded_networks import saved, weights, write_archive

FILE = PublishedWeights("tiny", "https://example.org/tiny.pth", "free to use", 100_000)
ARCHIVE = replace(FILE, url="https://example.org/tiny.tar.gz", members={"tiny/one": "a.", "tiny/two": "b."})
TENSORS = {"weight": torch.arange(6.0).view(2, 3), "bn.num_batches_tracked": torch.tensor(7)}
WHOLE = saved(TENSORS)


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    """Keep the user's own files out of it, and the network too."""
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("LIDARGRIT_WEIGHTS", raising=False)
    monkeypatch.setattr(published_weights, "_failures", {})
    serve(monkeypatch, urllib.error.URLError(OSError("Name or service not known")))
    return tmp_path / "cache" / "weights"


def serve(monkeypatch, answer, length=None):
    """Answer every request with these bytes, or raise this error."""

    class Response(io.BytesIO):
        headers = Message()

    if length is not None:
        Response.headers["Content-Length"] = str(length)

    def reply(opener, request, **options):
        assert request.full_url.startswith("https://")
        assert 0 < options["timeout"] < 120
        if isinstance(answer, Exception):
            raise answer
        return Response(answer)

    monkeypatch.setattr(urllib.request.OpenerDirector, "open", reply)


def refused(published, data, tmp_path, match):
    """Read a file of these bytes: it must be refused in one line that says where the right one is."""
    path = tmp_path / "given"
    path.write_bytes(data)
    with pytest.raises(WeightsError, match=match) as caught:
        read_weights(published, path)
    assert "\n" not in str(caught.value)
    assert str(path) in caught.value.got
    assert published.url in caught.value.wanted


# --- where they are looked for


def test_what_is_published_is_named_in_full():
    for name, (published, _) in NETWORKS.items():
        assert name == published.name
        assert published.url.startswith("https://")
        assert published.licence
        assert published.sha256 is None or len(published.sha256) == 64


def test_the_given_file_goes_first_then_the_folder_then_the_cache(cache, tmp_path, monkeypatch):
    given, folder = tmp_path / "mine.pth", tmp_path / "folder"
    for path in (given, folder / "tiny.pth", cache / "tiny.pth"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(WHOLE)
    assert find_weights(FILE) == cache / "tiny.pth"
    monkeypatch.setenv("LIDARGRIT_WEIGHTS", str(folder))
    assert find_weights(FILE) == folder / "tiny.pth"
    assert find_weights(FILE, given) == given
    (folder / "tiny.pth").unlink()
    assert find_weights(FILE) == cache / "tiny.pth"


def test_they_are_fetched_into_the_cache_once(cache, monkeypatch, heard):
    serve(monkeypatch, WHOLE, len(WHOLE))
    assert find_weights(FILE) == cache / "tiny.pth"
    assert (cache / "tiny.pth").read_bytes() == WHOLE
    assert heard == [
        "fetching https://example.org/tiny.pth (free to use)",
        f"{cache / 'tiny.pth'}: SHA-256 {hashlib.sha256(WHOLE).hexdigest()}; none is known to compare it with",
    ]
    serve(monkeypatch, AssertionError("asked again"))
    assert find_weights(FILE) == cache / "tiny.pth"


@pytest.mark.parametrize(
    ("answer", "length", "why"),
    [
        (urllib.error.URLError(OSError("Name or service not known")), None, "Name or service not known"),
        (urllib.error.HTTPError("https://example.org", 404, "Not Found", Message(), None), None, "Not Found"),
        (TimeoutError("timed out"), None, "timed out"),
        (ConnectionResetError(), None, "ConnectionResetError"),
        (b"<html>please log in</html>", None, "what came is not what was asked for"),
        (WHOLE[:-100], len(WHOLE), "of .* bytes came"),
        (bytes(FILE.bytes_at_most + 1), None, "the server sends too much"),
    ],
)
def test_without_them_a_line_says_what_to_do(answer, length, why, cache, monkeypatch):
    serve(monkeypatch, answer, length)
    with pytest.raises(WeightsError, match=why) as caught:
        find_weights(FILE)
    text = str(caught.value)
    assert "\n" not in text
    for part in (FILE.url, FILE.licence, str(cache), "--weights tiny=FILE", "LIDARGRIT_WEIGHTS"):
        assert part in text
    assert not cache.exists() or not list(cache.iterdir())
    serve(monkeypatch, WHOLE)
    with pytest.raises(WeightsError, match=why):  # nobody is asked twice in a minute
        find_weights(FILE)
    now_s = published_weights.time.monotonic()
    monkeypatch.setattr(published_weights.time, "monotonic", lambda: now_s + 61)
    assert find_weights(FILE).read_bytes() == WHOLE


def test_a_metric_without_its_weights_says_so_before_any_scan_is_read():
    for name in ("frechet_pointcloud_distance", "frechet_range_distance"):
        with pytest.raises(WeightsError, match=f"got no weights of {load_metric(name).needs_weights} on this computer"):
            load_metric(name)()


def test_no_server_leads_away_from_https():
    request = urllib.request.Request(FILE.url)
    follow = _HttpsOnly().redirect_request
    assert follow(request, None, 302, "", {}, "https://elsewhere.org/x").full_url == "https://elsewhere.org/x"
    for address in ("http://elsewhere.org/x", "file:///etc/passwd", "ftp://elsewhere.org/x"):
        with pytest.raises(urllib.error.URLError, match="not https"):
            follow(request, None, 302, "", {}, address)


# --- what is read from them


@pytest.mark.parametrize("zipped", [True, False])
def test_tensors_of_both_formats(zipped, tmp_path):
    data = saved(TENSORS, _use_new_zipfile_serialization=zipped)
    (tmp_path / "x.pth").write_bytes(data)
    tensors, checksum = read_weights(FILE, tmp_path / "x.pth")
    assert list(tensors) == ["weight"]
    assert torch.equal(tensors["weight"], TENSORS["weight"])
    assert checksum == hashlib.sha256(data).hexdigest()


def test_tensors_of_an_archive(tmp_path):
    write_archive(tmp_path / "x", {"tiny/arch_cfg.yaml": b"...", "tiny/two": WHOLE, "tiny/one": WHOLE})
    assert sorted(read_weights(ARCHIVE, tmp_path / "x")[0]) == ["a.weight", "b.weight"]


def test_a_known_checksum_must_be_met(tmp_path):
    known = replace(FILE, sha256=hashlib.sha256(WHOLE).hexdigest())
    (tmp_path / "x.pth").write_bytes(WHOLE)
    assert read_weights(known, tmp_path / "x.pth")[1] == known.sha256
    refused(replace(FILE, sha256="0" * 64), WHOLE, tmp_path, "with the SHA-256 [0-9a-f]{64}; wanted .*SHA-256 0{64}")


def test_what_is_no_file_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "nothing", tmp_path / "nothing" / "below"):
        with pytest.raises(WeightsError, match="which is no file"):
            read_weights(FILE, path)


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pickle_runs_nothing(zipped, tmp_path):
    for bomb in (Bomb(tmp_path / "ran"), {"weight": Bomb(tmp_path / "ran")}):
        data = saved(bomb, _use_new_zipfile_serialization=zipped)
        refused(FILE, data, tmp_path, "does not hold tensors only")
        refused(FILE, pickle.dumps(bomb), tmp_path, "does not hold tensors only")
        write_archive(tmp_path / "x", {"tiny/one": data, "tiny/two": WHOLE})
        refused(ARCHIVE, (tmp_path / "x").read_bytes(), tmp_path, "does not hold tensors only")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("thing", "match"),
    [
        ([torch.zeros(2)], "no tensors by name"),
        (torch.zeros(2), "no tensors by name"),
        ({1: torch.zeros(2)}, "no tensors by name"),
        ({"weight": [torch.zeros(2)]}, "'weight' is no float32 tensor"),
        ({"weight": {"weight": torch.zeros(2)}}, "'weight' is no float32 tensor"),
        ({"weight": torch.zeros(2, dtype=torch.float64)}, "'weight' is no float32 tensor"),
        ({"weight": torch.zeros(2, device="meta")}, "'weight' is no float32 tensor"),
        ({"weight": torch.eye(2).to_sparse()}, "no float32 tensor|tensors only"),
        ({"weight": torch.zeros(1).expand(10**9)}, "'weight' is no float32 tensor"),  # 4 GB, if it were copied
    ],
)
def test_other_things_than_tensors_are_refused(thing, match, tmp_path):
    refused(FILE, saved(thing), tmp_path, match)


def test_files_cut_short_or_damaged_are_refused(tmp_path):
    legacy = saved(TENSORS, _use_new_zipfile_serialization=False)
    write_archive(tmp_path / "x", {"tiny/one": WHOLE, "tiny/two": WHOLE})
    archive = (tmp_path / "x").read_bytes()
    for published, data in ((FILE, WHOLE), (FILE, legacy), (ARCHIVE, archive)):
        # The last bytes of an archive are padding: what is wanted may be whole without them.
        for end in np.linspace(0, len(data) * (0.7 if published is ARCHIVE else 0.99), 25).astype(int):
            refused(published, data[:end], tmp_path, "given")
    rng = np.random.default_rng(0)
    for _ in range(60):  # any damage is refused, or leaves tensors: it never ends otherwise
        damaged = bytearray(rng.choice([WHOLE, legacy, archive]))
        for offset in rng.integers(0, len(damaged), 8):
            damaged[offset] = rng.integers(256)
        (tmp_path / "y").write_bytes(damaged)
        for published in (FILE, ARCHIVE):
            try:
                read_weights(published, tmp_path / "y")
            except WeightsError:
                continue


def test_what_swells_is_refused(tmp_path):
    packed, overlapping = io.BytesIO(), bytearray(saved({"weight": torch.zeros(5000)}))
    with zipfile.ZipFile(io.BytesIO(overlapping)) as archive, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as out:
        for entry in archive.infolist():
            out.writestr(entry.filename, archive.read(entry))
    refused(FILE, packed.getvalue(), tmp_path, "compressed, as PyTorch does not write them")
    start = overlapping.rfind(b"PK\x01\x02")  # the last entry of the directory says it is larger than the whole
    overlapping[start + 20 : start + 28] = (50_000).to_bytes(4, "little") * 2
    refused(FILE, bytes(overlapping), tmp_path, "parts overlap|no whole file")
    refused(FILE, bytes(100_001), tmp_path, "larger than 0 MB")
    write_archive(tmp_path / "x", {"zeros": bytes(10**7), "tiny/one": WHOLE, "tiny/two": WHOLE})
    refused(replace(ARCHIVE, bytes_at_most=2 * 10**7), (tmp_path / "x").read_bytes()[:-900_000], tmp_path, "given")
    import gzip

    data = gzip.compress(gzip.decompress((tmp_path / "x").read_bytes()))
    assert len(data) < 100_000
    refused(ARCHIVE, data, tmp_path, "unpacks to too much")


def test_a_size_that_is_only_claimed_is_refused(tmp_path):
    legacy = saved({"weight": torch.zeros(12345)}, _use_new_zipfile_serialization=False)
    count = b"M" + (12345).to_bytes(2, "little")
    assert count in legacy
    for claimed in (2**31 - 1, 2**40, 2**62):
        data = legacy.replace(count, b"\x8a\x08" + claimed.to_bytes(8, "little"))
        refused(FILE, data, tmp_path, "given")


def test_paths_in_an_archive_lead_nowhere(tmp_path):
    link = tarfile.TarInfo("tiny/one")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    hard = tarfile.TarInfo("tiny/two")
    hard.type, hard.linkname = tarfile.LNKTYPE, "tiny/one"
    for members in (
        [("../tiny/one", WHOLE), ("/tiny/two", WHOLE), ("tiny/../../ran", WHOLE)],
        [(link, b""), ("tiny/two", WHOLE)],
        [("tiny/one", WHOLE), (hard, b"")],
        [("other/one", WHOLE), ("other/two", WHOLE)],
    ):
        inside = tmp_path / "inside"
        inside.mkdir(exist_ok=True)
        write_archive(inside / "x", members)
        refused(ARCHIVE, (inside / "x").read_bytes(), inside, "which lacks 'tiny/")
        assert sorted(path.name for path in inside.iterdir()) == ["given", "x"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["inside"]
    write_archive(tmp_path / "x", [("tiny/one", WHOLE), ("tiny/one", WHOLE), ("tiny/two", WHOLE)])
    refused(ARCHIVE, (tmp_path / "x").read_bytes(), tmp_path, "holds 'tiny/one' twice")


def test_weights_of_another_layout_are_refused(tmp_path):
    drawn = weights("pointnet")
    for change, got, wanted in (
        ({"fc3.bias": None}, "nothing for 'fc3.bias'", r"\(16,\) there"),
        ({"fc9.bias": torch.zeros(3)}, r"\(3,\) for 'fc9.bias'", "nothing there"),
        ({"fc3.weight": torch.zeros(40, 256)}, r"\(40, 256\) for 'fc3.weight'", r"\(16, 256\) there"),
    ):
        torch.save({k: v for k, v in {**drawn, **change}.items() if v is not None}, tmp_path / "x.pth")
        with pytest.raises(
            WeightsError, match=f"got weights in .*x.pth that are not of PointNet .{got}.; wanted {wanted}"
        ):
            load_network("pointnet", tmp_path / "x.pth")


def test_a_changed_file_is_read_again(tmp_path):
    checksums = set()
    for seed in (1, 2):
        torch.save(weights("pointnet", seed), tmp_path / "x.pth")
        os.utime(tmp_path / "x.pth", ns=(seed, seed))
        checksums.add(load_network("pointnet", tmp_path / "x.pth").sha256)
    assert len(checksums) == 2
