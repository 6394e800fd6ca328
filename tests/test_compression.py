"""Range images come back from a compressed file to the last bit, or not at all."""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.data.sources import open_source
from lidargrit.generation.generator import load
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelSampling
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.inference.compress import rounding
from lidargrit.inference.compress.archive import add_scan, writing
from lidargrit.inference.compress.rounding import exp, ln, sigmoid
from lidargrit.inference.compress.scan_codec import ScanCodec
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit, LidarGritConfig, TokenSampling
from lidargrit.systems.multiscale.system import Multiscale, MultiscaleConfig
from tiny_runs import the_one_line, with_random_weights

pytest.importorskip("constriction")
SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
TOKENIZER = VqvaeConfig(
    channels=32, channel_multipliers=(1, 1, 1, 1), code_dim=4, num_codes=8, dropout=0.0, padding="wrap"
)
PIXELS = PixelDecoderConfig(mask_features=2, range_features=2, mask_width=4, range_width=4, blocks=1)


def made(pixels: PixelDecoderConfig | None = PIXELS, seed: int = 3) -> LidarGrit:
    """Return a generator of random weights, whose probabilities differ from pixel to pixel."""
    config = LidarGritConfig(TOKENIZER, TransformerConfig(layers=1, heads=2, width=16), pixels)
    return with_random_weights(LidarGrit(config, SENSOR), seed).eval()


def scans(count: int) -> RangeImage:
    """Return walls at one range with a few others, and holes."""
    rng = torch.Generator().manual_seed(1)
    size = (count, SENSOR.height, SENSOR.width)
    wall = 12 + 5 * torch.rand((count, 1, SENSOR.width), generator=rng).expand(size)
    range_m = torch.where(torch.rand(size, generator=rng) < 0.9, wall, SENSOR.range_max_m)
    return RangeImage.masked(range_m, torch.rand(size, generator=rng) < 0.8, SENSOR)


@pytest.fixture(scope="module")
def codec() -> ScanCodec:
    return ScanCodec(made(), 20)


@pytest.fixture(scope="module")
def compressed(codec) -> bytes:
    return codec.compress(scans(1)[0])


def test_pixels_come_back_rounded_to_the_step(codec, compressed):
    image = scans(1)
    back = codec.decompress(compressed)
    assert torch.equal(back.range_m, codec.steps.round(image).range_m[0])
    assert float((back.range_m - image.range_m[0]).abs().max()) <= 0.01 + 1e-6


@pytest.mark.parametrize("halvings", [{"column_halvings": 1}, {"row_halvings": 1}])
def test_a_model_without_tokens_compresses_too(halvings):
    config = MultiscaleConfig(replace(PIXELS, coarsest_cell=4, **halvings))
    generator = with_random_weights(Multiscale(config, SENSOR))
    codec = ScanCodec(generator, 20)
    image = generator.sample([0], sampling=PixelSampling(range_temperature=1.0, range_noise=1.0))
    compressed, bits = codec.compress(image[0]), float(generator.bits(image, 20).total())
    assert torch.equal(codec.decompress(compressed).range_m, codec.steps.round(image).range_m[0])
    assert 0.99 * bits < 8 * len(compressed) < 1.01 * bits + 72 + 64


def test_a_scan_takes_as_many_bits_as_the_model_tells(codec):
    image = made().sample([0], sampling=TokenSampling(range_temperature=1.0, range_noise=1.0))
    compressed, bits = codec.compress(image[0]), made().bits(image, 20)
    expected = float(bits.total()) - float(bits.tokens.sum()) + 8 * 4 * math.log2(8)  # 32 tokens, all as likely
    assert 0.99 * expected < 8 * len(compressed) < 1.01 * expected + 72 + 64  # a head of 72 bits, two words


@pytest.mark.parametrize("kind", ["no return", "every return, nearest", "every return, farthest"])
def test_scans_at_the_limits_come_back(codec, kind):
    mask = torch.full((SENSOR.height, SENSOR.width), kind != "no return")
    limit = SENSOR.range_min_m if kind.endswith("nearest") else SENSOR.range_max_m
    image = RangeImage.masked(torch.full(mask.shape, limit), mask, SENSOR)
    back = codec.decompress(codec.compress(image))
    assert torch.equal(back.return_mask, mask)
    assert float((back.range_m - image.range_m).abs().max()) <= 0.01


@pytest.mark.parametrize("name", ["hdl64e_kitti_odometry", "hdl64e_kitti_360", "os1_64", "vlp16"])
def test_every_step_has_intervals_of_some_width(name):
    """Halves rounded to even would leave the first or the last without any, and a return there without probability."""
    for step_mm in range(1, 1001):
        steps = RangeSteps(load_sensor(name), step_mm)
        near_m, far_m = steps.edges_m(torch.tensor([steps.first, steps.last]))
        assert (near_m < far_m).all(), step_mm


def test_returns_beyond_the_limits_are_refused(codec):
    mask = torch.ones(SENSOR.height, SENSOR.width, dtype=torch.bool)
    for range_m in (SENSOR.range_min_m / 2, SENSOR.range_max_m + 1):
        image = RangeImage(torch.full(mask.shape, range_m), mask, SENSOR)
        with pytest.raises(ConfigError, match="beyond the limits of the sensor"):
            codec.compress(image)


def test_another_machine_within_the_margins_decodes_the_same(codec, compressed, monkeypatch):
    right, rng = rounding.Rounding.indices, np.random.default_rng(0)

    def elsewhere(self, values, grid, matters=None):
        return right(self, values + grid.margin * rng.uniform(-0.99, 0.99, values.shape), grid, matters)

    expected = codec.decompress(compressed).range_m
    monkeypatch.setattr(rounding.Rounding, "indices", elsewhere)
    assert torch.equal(codec.decompress(compressed).range_m, expected)


def test_a_number_near_a_border_is_rounded_by_other_borders():
    grid = rounding.Grid(0.25, 1e-3)
    values = np.array([0.0, 0.1249999, 0.7])
    with pytest.raises(rounding.TooNearABorderError):
        rounding.Rounding(0, checked=True).indices(values, grid)
    assert rounding.Rounding(0, checked=False).indices(values, grid).tolist() == [0, 0, 3]
    assert rounding.Rounding(0, checked=True).indices(values, grid, values != values[1]).tolist() == [0, 0, 3]
    found = {tuple(rounding.Rounding(attempt, checked=True).indices(values, grid)) for attempt in (1, 2)}
    assert found == {(0, 1, 3), (0, 0, 3)}


def test_one_that_does_not_reproduce_the_probabilities_says_so(codec, compressed):
    message = "probabilities that are not those of the machine"
    with pytest.raises(ScanError, match=message):
        ScanCodec(made(seed=4), 20).decompress(compressed)
    rng = np.random.default_rng(0)
    for _ in range(4):
        altered = bytearray(compressed)
        altered[rng.integers(len(altered))] ^= 1 << rng.integers(8)
        with pytest.raises(ScanError, match=message):
            codec.decompress(bytes(altered))
    with pytest.raises(ScanError, match=message):
        codec.decompress(compressed[:7])


def test_a_strangers_file_writes_only_files_that_can_be_and_below_its_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lidargrit.inference.compress.command._codec_of", lambda *_: ScanCodec(made(), 20))
    path = tmp_path / "scans.lgz"
    for names, message in (
        (["../out"], "a scan that would lie outside"),
        (["/tmp/out"], "a scan that would lie outside"),
        ([".lidargrit-partial-0/lock"], "a scan that would lie outside"),
        (["a\0b"], "with a NUL in it"),
        (["\ud800"], "not UTF-8"),
        (["x" * 300], "at most 255 bytes a name"),
        (["one", "one"], "was cut off or altered"),
        (["one", "./one"], "several scans of scans.lgz that would be one.npy"),  # the second replaced the first
        (["a.npy/b", "a"], "a scan of scans.lgz that would be a.npy, which is also the folder of another"),
    ):
        path.unlink(missing_ok=True)
        with writing(path, {"step_mm": 20}) as writer:
            for number, name in enumerate(names):
                add_scan(writer.folder, number, (name, name, 1), b"a")
        assert main(["decompress", str(path), str(tmp_path / "out")]) == 2
        assert message in the_one_line(capsys.readouterr().err, "decompress")
        assert [one.name for one in tmp_path.iterdir()] == ["scans.lgz"]
    os.mkfifo(tmp_path / "pipe.lgz")
    assert main(["decompress", str(tmp_path / "pipe.lgz"), str(tmp_path / "out")]) == 2
    assert "which is not a file" in the_one_line(capsys.readouterr().err, "decompress")


def test_rays_that_are_none_are_told_with_the_file(tmp_path, capsys):
    path = tmp_path / "scans.lgz"
    with writing(path, {"step_mm": 20, "model_sha256": "", "rays": {"name": "mine"}}) as writer:
        add_scan(writer.folder, 0, ("one", "one", 1), b"a")
    assert main(["decompress", str(path), str(tmp_path / "out")]) == 2
    told = the_one_line(capsys.readouterr().err, "decompress")
    assert f"{path}, in which stands a sensor without azimuth_rad, " in told


def test_models_and_images_that_cannot_be_compressed_are_refused(codec):
    with pytest.raises(ConfigError, match="without a pixel decoder"):
        ScanCodec(made(None), 20)
    with pytest.raises(ConfigError, match=r"got a range image .*; wanted one image"):
        codec.compress(scans(1))


def test_the_commands_restore_what_was_compressed(tmp_path, capsys):
    made().save(tmp_path / "run")
    made(seed=4).save(tmp_path / "other")
    folder = tmp_path / "images"
    folder.mkdir()
    for index, range_m in enumerate(scans(2).range_m):
        np.save(folder / f"{index}.npy", range_m.numpy())
    run, file, out = (str(tmp_path / name) for name in ("run", "scans.lgz", "out"))
    assert main(["compress", str(folder), file, "--model", run, "--step-mm", "20"]) == 0
    size = Path(file).stat().st_size
    assert f"done: 2 scans in {file}: {size:,} bytes" in capsys.readouterr().out
    assert main(["decompress", file, out, "--model", run, "--only", "1"]) == 0
    assert [one.name for one in Path(out).iterdir() if one.suffix == ".npy"] == ["1.npy"]
    assert main(["decompress", file, out, "--model", run]) == 0
    assert open_source(out).sensor.same_rays(load(run).sensor)
    for index, range_m in enumerate(scans(2).range_m):
        assert np.abs(np.load(Path(out) / f"{index}.npy") - range_m.numpy()).max() <= 0.01 + 1e-6
    capsys.readouterr()
    for words, message in (
        (["--model", str(tmp_path / "other")], "compressed by the model 'run' of hash"),
        (["--model", run, "--only", "2"], "got --only 2; wanted indices from 0 to 1"),
    ):
        assert main(["decompress", file, str(tmp_path / "nothing"), *words]) == 2
        assert message in capsys.readouterr().err
    Path(file).write_bytes(Path(file).read_bytes()[:-40])
    assert main(["decompress", file, str(tmp_path / "nothing"), "--model", run]) == 2
    error = capsys.readouterr().err
    assert "cut off or altered" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "nothing").exists()


@pytest.fixture
def two_sources(tmp_path, monkeypatch) -> list[str]:
    """Save a run, and two folders of images of the same names, of which the second is one scan shorter."""
    monkeypatch.chdir(tmp_path)
    made().save(tmp_path / "run")
    for name, images in (("a", scans(3).range_m), ("b", scans(3).range_m.flip(0)[:2])):
        (tmp_path / name).mkdir()
        for index, range_m in enumerate(images):
            np.save(tmp_path / name / f"{index}.npy", range_m.numpy())
    return ["a", "b"]


def compress(source: str, out: str, *words: str) -> int:
    return main(["compress", source, out, "--model", "run", "--step-mm", "20", *words])


def test_another_file_of_the_same_name_is_not_taken_for_the_one_before(two_sources, capsys):
    for source in two_sources:
        assert compress(source, f"{source}/scans.lgz", "-n", "1") == 0
    command = ["out", "--model", "run"]
    assert main(["decompress", "a/scans.lgz", *command]) == 0
    assert main(["decompress", "a/scans.lgz", *command]) == 0, "the same goes on"
    capsys.readouterr()
    assert main(["decompress", "b/scans.lgz", *command]) == 2
    assert "has another 'index_crc32'" in the_one_line(capsys.readouterr().err, "decompress")


def test_a_first_scan_that_is_not_restored_leaves_the_folder_to_a_corrected_command(two_sources, capsys, monkeypatch):
    assert compress("a", "scans.lgz", "-n", "1") == 0
    Path("out").mkdir()
    with monkeypatch.context() as patch:
        patch.delattr(ScanCodec, "decompress")
        with pytest.raises(AttributeError):
            main(["decompress", "scans.lgz", "out", "--model", "run"])
    assert main(["decompress", "scans.lgz", "out", "--model", "run", "--format", "pcd"]) == 0
    assert sorted(os.listdir("out")) == ["0.pcd", "decompressed.json", "sensor.json"]


def test_an_interrupted_file_goes_on_only_with_the_options_that_say_which_scans(two_sources, capsys, monkeypatch):
    whole, calls = ScanCodec.compress, []

    def interrupted(self, image):
        calls.append(image)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return whole(self, image)

    monkeypatch.setattr(ScanCodec, "compress", interrupted)
    assert compress("a", "scans.lgz") != 0
    for source, words, changed in (
        ("b", [], "source"),
        ("a", ["-n", "2"], "max_scans"),
        ("b", ["-n", "2"], "source, max_scans"),
        ("a", ["--projection", "spherical"], "projection"),
    ):
        capsys.readouterr()
        assert compress(source, "scans.lgz", *words) == 2
        line = the_one_line(capsys.readouterr().err, "compress")
        assert f"an unfinished file with scans of other options ({changed})" in line
    assert compress("a", "scans.lgz", "--bad-scans", "skip") == 0, "what it stopped at may be left out"
    assert compress("a", "whole.lgz") == 0
    assert Path("scans.lgz").read_bytes() == Path("whole.lgz").read_bytes()
    assert not Path("scans.lgz.unfinished").exists()


def test_the_formats_that_are_named_are_those_it_writes(tmp_path, two_sources, capsys):
    assert compress("a", "scans.lgz", "-n", "1") == 0
    for kind in ("kitti_odometry", "docx"):
        capsys.readouterr()
        assert main(["decompress", "scans.lgz", "out", "--model", "run", "--format", kind]) == 2
        got, wanted, _ = the_one_line(capsys.readouterr().err, "decompress").split(";")
        assert f"the format {kind!r} to write" in got
        assert "image, " in wanted
        assert "ply" in wanted
        assert "kitti_odometry" not in wanted


def test_functions_that_every_machine_computes_alike_are_right():
    x = np.linspace(-60, 60, 4001)
    assert exp(x) == pytest.approx(np.exp(x), rel=2e-15)
    assert sigmoid(x) == pytest.approx(1 / (1 + np.exp(-x)), rel=2e-15)
    assert bool((np.diff(sigmoid(x)) >= 0).all())
    y = np.exp(x / 5)
    assert ln(y) == pytest.approx(np.log(y), rel=1e-15, abs=2e-16)
