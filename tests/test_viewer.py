"""The pictures: written whole or not at all, plausible in size, and without a trace in matplotlib's global state."""

import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import torch
from PIL import Image

from lidargrit import simulate
from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, OutputError
from lidargrit.data.formats import load as load_format
from lidargrit.data.prepared.config import ScanSettings
from lidargrit.data.sources import open_source
from lidargrit.generation.generator import load_class
from lidargrit.inference.samples import write_samples
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.viewer import pictures, plot_comparison, scan_sets, view
from lidargrit.viewer.scan_sets import load_scan_sets


@pytest.fixture(scope="module")
def images():
    sensor = load_sensor("hdl64e_kitti_odometry")
    rng = torch.Generator().manual_seed(0)
    range_m = 2 + 60 * torch.rand(2, sensor.height, sensor.width, generator=rng)
    return RangeImage.masked(range_m, torch.rand(range_m.shape, generator=rng) > 0.2, sensor)


def size_of_png(path):
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", head[16:24])


def test_picture_of_two_groups(images, tmp_path):
    plot_comparison({"real": images, "generated": images[0]}, tmp_path / "new" / "a.png", "title")
    width, height = size_of_png(tmp_path / "new" / "a.png")
    assert width == 1400
    assert 900 < height < 1300  # three rows: two real, one generated
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.png"]
    picture = np.asarray(Image.open(tmp_path / "new" / "a.png").convert("RGB"))
    for row in np.array_split(picture[: int(0.9 * height)], 3):  # a noisy range image, its mask and its points
        assert len(np.unique(row.reshape(-1, 3), axis=0)) > 100
        assert (row < 250).any(axis=2).mean() > 0.4


def test_an_image_of_one_row_has_a_height(images, tmp_path, recwarn):
    sensor = replace(images.sensor, elevation_rad=images.sensor.elevation_rad[:1])
    plot_comparison({"one": RangeImage(images.range_m[:1, :1], images.return_mask[:1, :1], sensor)}, tmp_path / "a.png")
    assert not recwarn.list


@pytest.mark.parametrize("name", ["hdl64e_kitti_odometry", "vlp32c", "os1_64", "vlp16"])
def test_round_elevations_stand_beside_their_rows(name):
    elevation_deg = load_sensor(name).elevation_rad.double().mean(dim=1).rad2deg().numpy()
    rows, labels = pictures._elevation_ticks(elevation_deg)
    degrees = [int(label.replace("−", "-").removesuffix("°")) for label in labels]
    assert 3 <= len(rows) <= 6
    assert set(degrees) >= {0, -10}
    for row, there in zip(rows, degrees, strict=True):
        assert elevation_deg[int(np.floor(row))] + 1e-9 >= there >= elevation_deg[int(np.ceil(row))] - 1e-9
    assert np.diff(sorted(rows)).min() >= len(elevation_deg) / 6, "their labels do not overlap"
    assert pictures._elevation_ticks(elevation_deg[:1]) == ([0.0], [f"{elevation_deg[0]:.1f}°"])


def test_other_sensors_labels_and_empty_images(images, tmp_path):
    sensor = load_sensor("hdl64e_kitti_360")
    nothing = RangeImage(torch.zeros(64, 1024), torch.zeros(64, 1024, dtype=torch.bool), sensor)
    plot_comparison({"one": images[:1], "none": nothing}, tmp_path / "a.png")
    plot_comparison({"none": nothing}, tmp_path / "b.png")
    assert size_of_png(tmp_path / "a.png")[1] > size_of_png(tmp_path / "b.png")[1]


def test_images_in_training_can_be_drawn(images, tmp_path):
    leaf = RangeImage(images.range_m.clone().requires_grad_(), images.return_mask, images.sensor)
    plot_comparison({"reconstructed": leaf[:1]}, tmp_path / "a.png")
    assert (tmp_path / "a.png").is_file()


def test_global_state_is_left_alone(images, tmp_path):
    before = dict(mpl.rcParams), "matplotlib.pyplot" in sys.modules
    plot_comparison({"real": images[0]}, tmp_path / "a.png")
    after = dict(mpl.rcParams), "matplotlib.pyplot" in sys.modules
    assert before == after


def test_no_settings_of_the_current_folder_are_obeyed(tmp_path):
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nfigure.dpi: 31\n")
    script = "import runpy, sys; runpy.run_path(sys.argv[1]); import matplotlib, os; print(os.getcwd(), "
    script += "matplotlib.rcParams['text.usetex'], matplotlib.rcParams['figure.dpi'])"
    path = str(Path(pictures.__file__).with_name("_matplotlib.py"))
    printed = subprocess.run(
        [sys.executable, "-c", script, path], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert printed.stdout.split() == [str(tmp_path), "False", "100.0"]


def test_older_picture_is_replaced_in_one_step(images, tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    plot_comparison({"real": images[0]}, path)
    whole = path.read_bytes()

    def fail_half_way(self, target, **kwargs):
        target.write_bytes(b"half a picture")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pictures.Figure, "savefig", fail_half_way)
    with pytest.raises(OutputError, match="No space left on device"):
        plot_comparison({"real": images[1]}, path)
    assert path.read_bytes() == whole
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_place_below_a_file_is_refused(images, tmp_path):
    (tmp_path / "file").write_text("taken")
    with pytest.raises(OutputError, match="while writing"):
        plot_comparison({"real": images[0]}, tmp_path / "file" / "a.png")


def test_what_cannot_be_drawn_is_refused(images, tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(ConfigError, match="no group of range images"):
        plot_comparison({}, path)
    nine = RangeImage.stack([images[0]] * 9)
    with pytest.raises(ConfigError, match="of 1 to 8"):
        plot_comparison({"real": nine}, path)
    assert not path.exists()


def test_runs_compute_on_the_device_that_is_named(tmp_path):
    with pytest.raises(ConfigError, match="device 'cuda:99'"):
        load_scan_sets(["pretrained"], 1, device="cuda:99")
    with pytest.raises(ConfigError, match="device 'cuda:99'"):
        view(["simulated:1"], tmp_path / "a.png", anomaly_by="pretrained", device="cuda:99")
    assert main(["view", "pretrained", "-o", str(tmp_path / "a.png"), "--device", "cuda:99"]) == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "width"),
    [
        ({}, 2048),
        ({"sensor": "hdl64e_kitti_360"}, 1024),
        ({"sensor": "hdl64e_kitti_odometry"}, 2048),
        ({"columns": 512}, 512),
        ({"sensor": "hdl64e_kitti_odometry", "columns": 512}, 512),
    ],
)
def test_a_page_has_all_columns_of_a_named_sensor_too(options, width):
    how = {"settings": ScanSettings.read(**options), "all_columns": True}
    (one,) = load_scan_sets(["simulated:1:val"], 1, **how)
    assert one.images.range_m.shape == (1, 64, width)
    model = load_sensor("hdl64e_kitti_odometry")
    (beside,) = load_scan_sets(["simulated:1:val"], 1, sensor=model, all_columns=True)
    assert beside.images.sensor.same_rays(model), "a model computes on its own columns only"


def test_a_picture_of_too_many_scans_names_the_page(tmp_path):
    with pytest.raises(ConfigError, match=r"wanted 1 to 8; correct the number, or write an \.html, which takes 100$"):
        view(["simulated:9"], tmp_path / "a.png", count=9)
    with pytest.raises(ConfigError, match=r"wanted 1 to 100; correct the number$"):
        view(["simulated:9"], tmp_path / "a.html", count=101)


def test_sets_of_one_name_are_told_apart_and_runs_of_other_rays_reconstruct_nothing(tmp_path, heard):
    samples = [tmp_path / f"a_run_{word}_reflectance_and_a_long_name" / "samples" for word in ("with", "without")]
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(128)
    model = load_class("memorised")(load_class("memorised").smallest_config(sensor), sensor)
    model.fit_statistics(open_source("simulated:2:val").images(sensor))
    model.save(tmp_path / "run")
    for folder in samples:
        write_samples(model, tmp_path / "run", folder, range(2))
    sets = load_scan_sets([str(folder) for folder in samples], 1)
    assert [one.name[-12:] for one in sets] == ["/samples (1)", "/samples (2)"]
    sets = load_scan_sets([str(samples[0]), "pretrained"], 1)
    assert [one.name for one in sets][1:] == ["pretrained: generated"]
    assert any("pretrained: no reconstructions, for its sensor has other rays" in text for text in heard)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-o", "a.svg"], "got a.svg, which will hold PNG or HTML; wanted a name in .png or .html"),
        (["-o", "a.png", "--model", "nosuch"], "got --model nosuch with --color range; wanted --color anomaly"),
    ],
)
def test_words_that_the_command_would_not_follow_are_refused(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["view", "simulated:1", *words]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", [r"a$\nosuch{$.bin", "街.bin"])
def test_names_are_drawn_as_they_are_written(name, tmp_path, recwarn):
    """Between dollar signs would be a formula; and what a font lacks is no matter for the terminal."""
    load_format("kitti_bin").write(tmp_path / name, simulate(seed=0))
    assert main(["view", str(tmp_path / name), "-o", str(tmp_path / "view.png")]) == 0
    assert main(["inspect", str(tmp_path / name), "-o", str(tmp_path / "inspect.png")]) == 0
    assert size_of_png(tmp_path / "view.png")[0] == size_of_png(tmp_path / "inspect.png")[0] == 1400
    assert not [str(one.message) for one in recwarn.list if "Glyph" in str(one.message)]


def test_a_later_seed_that_is_too_large_is_told_before_scans_are_read(tmp_path, monkeypatch, capsys):
    assert len(load_scan_sets(["simulated:2"], 2, seed=2**32 - 1)) == 1, "scans have no seed"
    monkeypatch.setattr(scan_sets, "_of_scans", lambda *given: pytest.fail("read a scan"))
    words = ["view", "simulated:2", "pretrained", "-n", "2", "--seed", str(2**32 - 1), "-o", str(tmp_path / "a.png")]
    assert main(words) == 2
    assert "got --seed 4294967295 with -n 2, of which the last scan has" in capsys.readouterr().err
