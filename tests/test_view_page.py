"""The page that shows scans: what it holds, and what it does when somebody clicks and types, in a browser."""

import base64
import gzip
import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from browser import Browser
from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.data.formats import read_scan
from lidargrit.data.prepared.config import DataConfig, ScanSettings
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.viewer import interactive, scan_sets
from lidargrit.viewer.interactive import page, write_page
from lidargrit.viewer.scan_sets import ScanSet, load_scan_sets

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(256)
NAMES = ("first <b>scan</b>", "second", "third")


def scans(sensor=SENSOR, count=3, seed=0) -> RangeImage:
    """Return images of round places between wavy walls, with reflectance."""
    down = -sensor.ray_directions()[:, :, 2]
    rng = torch.Generator().manual_seed(seed)
    images = []
    for index in range(count):
        wall_m = 18 + 6 * ((index + 3) * sensor.azimuth_rad.expand(down.shape) + seed).sin()
        range_m = torch.where(down > 0, 1.73 / down.clamp(min=1e-3), 1000.0).minimum(wall_m)
        returned = torch.rand(range_m.shape, generator=rng) < 0.85
        reflectance = torch.rand(range_m.shape, generator=rng) * returned
        images.append(RangeImage(range_m * returned, returned, sensor, {"reflectance": reflectance}))
    return RangeImage.stack(images)


def labels(images: RangeImage) -> torch.Tensor:
    """Call the lower half road and the upper half building."""
    rows = torch.arange(64)[:, None].expand(images.range_m.shape)
    return torch.where(images.return_mask, torch.where(rows > 32, 40, 50), 0)


@pytest.fixture(scope="module")
def shown() -> list[ScanSet]:
    real, other = scans(), scans(seed=1)
    plain = RangeImage(other.range_m, other.return_mask, SENSOR)  # as a generator without reflectance draws
    return [
        ScanSet("real </script>", real.with_planes(label=labels(real)), NAMES),
        ScanSet("generated", plain[:2], ("seed 0", "seed 1")),
    ]


def page_data(text: str) -> dict:
    return json.loads(re.search(r'id="scans">(.*?)</script>', text, re.DOTALL)[1])


def unpacked(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(gzip.decompress(base64.b64decode(text)), kind)


def test_the_page_holds_all_pixels_and_nothing_foreign(shown):
    text = page(shown)
    assert not re.search(r"https?://|src=|href=|@import|url\(", text)
    assert text.count("</script>") == 2, "names cannot end a script"
    assert "real &lt;/script&gt;" in text
    data = page_data(text)
    assert [source["name"] for source in data["sources"]] == ["real </script>", "generated"]
    for one, source in zip(shown, data["sources"], strict=True):
        assert len(source["scans"]) == len(one.images)
        assert np.array_equal(unpacked(source["elevation"], "<f4"), SENSOR.elevation_rad.numpy().ravel())
        for index, scan in enumerate(source["scans"]):
            steps = unpacked(scan["range"], "<u2").reshape(64, 256)
            assert np.array_equal(steps > 0, one.images.return_mask[index].numpy())
            error_m = np.abs(steps * source["rangeStepM"] - one.images.range_m[index].numpy())
            assert error_m.max() <= source["rangeStepM"] / 2 + 1e-6
    scan = data["sources"][0]["scans"][1]
    named = np.array([one["number"] for one in data["sources"][0]["classes"]])
    returned = shown[0].images.return_mask[1].numpy()
    assert set(named) == {40, 50}
    label = named[unpacked(scan["label"], "u1").reshape(64, 256)]
    assert np.array_equal(label[returned], shown[0].images.label[1].numpy()[returned])
    reflectance = unpacked(scan["reflectance"], "u1").reshape(64, 256) / 255
    assert np.abs(reflectance - shown[0].images.reflectance[1].numpy()).max() < 0.002
    assert "label" not in data["sources"][1]["scans"][0]


def test_twelve_scans_take_a_few_megabytes():
    images = scans(load_sensor("hdl64e_kitti_360"), 12)
    noisy = images.range_m + 0.02 * torch.randn(images.range_m.shape, generator=torch.Generator().manual_seed(0))
    images = RangeImage.masked(noisy.clamp(min=1.5), images.return_mask, images.sensor)
    assert len(page([ScanSet("noisy", images, tuple("abcdefghijkl"))])) < 3_000_000


def test_pages_of_nothing_and_of_too_much(shown, tmp_path):
    empty = RangeImage(torch.zeros(1, 64, 256), torch.zeros(1, 64, 256, dtype=torch.bool), SENSOR)
    write_page([ScanSet("none", empty, ("a",))], tmp_path / "new" / "page.html")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["page.html"]
    for wrong in ([], shown * 5):
        with pytest.raises(ConfigError, match="1 to 8"):
            page(wrong)


def test_scripts_stay_short():
    folder = Path(interactive.__file__).parent
    files = sorted(path for part in ("browser", "templates") for path in (folder / part).iterdir())
    assert {path.suffix for path in files} == {".js", ".css", ".html"}
    for path in files:
        assert path.read_text(encoding="utf-8").count("\n") <= 400, path.name


def test_labels_stand_where_their_points_are():
    (one,) = load_scan_sets(["simulated:1:val"], 1)
    assert one.scan_names == ("seed_1000000",)
    assert one.images.label is not None
    assert not one.images.label[~one.images.return_mask].any()
    down = SENSOR.with_columns(2048, 8).ray_directions()[:, :, 2] * one.images.range_m[0] < -1.2
    near = down & one.images.return_mask[0] & (one.images.range_m[0] < 12)
    ground = torch.isin(one.images.label[0][near], torch.tensor([40, 44, 48, 49, 60, 72]))
    assert ground.float().mean() > 0.8


def test_scans_that_cannot_be_used_are_refused_or_left_out(tmp_path):
    from lidargrit.data.formats.kitti_bin import KittiBin

    scan = unproject(scans(SENSOR.with_columns(2048, 8))[0])
    order = (scan.ring * 10 + torch.atan2(*scan.points_xyz_m[:, :2].double().T.flip(0)) % (2 * torch.pi)).argsort()
    KittiBin.write(tmp_path / "0.bin", type(scan)(scan.points_xyz_m[order], scan.reflectance[order]))
    (tmp_path / "1.bin").write_bytes(b"no scan at all")
    with pytest.raises(ScanError, match=r"1\.bin"):
        load_scan_sets([str(tmp_path)], 2)
    (one,) = load_scan_sets([str(tmp_path)], 2, settings=ScanSettings(DataConfig(bad_scans="skip")))
    assert one.scan_names == ("0",)
    assert one.images.label is None
    assert scan_sets._short("x" * 99) == "..." + "x" * 37
    assert scan_sets._short(f"/data/{'x' * 30}/other_sensors/vlp16") == ".../other_sensors/vlp16"


def test_the_command_writes_a_page(tmp_path, capsys):
    out = tmp_path / "view.html"
    assert main(["view", "simulated:2:val", "-o", str(out), "-n", "2"]) == 0
    assert len(page_data(out.read_text(encoding="utf-8"))["sources"][0]["scans"]) == 2
    assert main(["view", "simulated:2:val", "-o", str(out)]) == 2
    assert "there already" in capsys.readouterr().err
    assert main(["view", "simulated:2:val", "-o", str(tmp_path / "no.html"), "-n", "101"]) == 2
    assert "1 to 100" in capsys.readouterr().err


# What follows happens in a browser.


@pytest.fixture(scope="module")
def browser(browser):
    # Here WebGL is computed on the processor, of which the page would rather not make use.
    script = (
        "const was = WebGLRenderingContext.prototype.getParameter;"
        "WebGLRenderingContext.prototype.getParameter = function (what) {"
        "return what === 0x9246 && !globalThis.honest ? 'A graphics card' : was.call(this, what); };"
    )
    browser.send("Page.addScriptToEvaluateOnNewDocument", source=script)
    return browser


@pytest.fixture(scope="module")
def written(shown, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "scans.html"
    write_page(shown, path)
    return path


@pytest.fixture
def opened(browser, written) -> Browser:
    browser.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    browser.open(written)
    return browser


def drawn(picture: np.ndarray) -> float:
    """Return the share of a picture that is not background."""
    return float((picture != picture[2, 2]).any(axis=2).mean())


def words(browser: Browser, part: str) -> list[str]:
    return browser.run(f"[...document.querySelectorAll('[data-part={part}]')].map((one) => one.textContent.trim())")


def test_points_and_images_are_drawn_without_any_network(opened):
    for which in range(2):
        picture = opened.screenshot(".cloud", which)
        assert drawn(picture) > 0.02
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 30
        assert drawn(opened.screenshot(".image", which)) > 0.5
    assert words(opened, "name") == ["real </script>", "generated"]
    assert words(opened, "about")[0].startswith("first <b>scan</b> (1 of 3): ")
    assert opened.run("document.documentElement.scrollHeight <= innerHeight"), "all is seen at once"
    assert opened.run("document.querySelector('#slow').hidden")
    assert opened.troubles() == []
    assert opened.requests() == []


def test_keys_and_buttons_step_through_the_scans(opened):
    first = opened.screenshot(".cloud")
    opened.press("ArrowRight")
    assert opened.run("document.querySelector('#counter').textContent") == "Scan 2 of 3"
    assert words(opened, "about")[0].startswith("second (2 of 3)")
    assert (opened.screenshot(".cloud") != first).any()
    opened.click("#next")
    assert [one.partition(":")[0] for one in words(opened, "about")] == ["third (3 of 3)", "seed 1 (2 of 2)"]
    opened.press("ArrowRight")
    assert opened.run("document.querySelector('#counter').textContent") == "Scan 1 of 3"
    opened.click("#previous")
    assert opened.run("document.querySelector('#position').value") == "3"
    opened.click("#position")  # its middle
    opened.press("ArrowLeft")
    assert opened.run("document.querySelector('#counter').textContent") == "Scan 1 of 3", (
        "the slider has its own arrows"
    )
    assert (opened.screenshot(".cloud") == first).all()


def test_one_camera_turns_all_views(opened):
    before = [opened.screenshot(".cloud", which) for which in range(2)]
    left, top, width, height = opened.box(".cloud")
    opened.drag((left + width / 2, top + height / 2), (left + width / 2 + 90, top + height / 2 + 20))
    opened.move(5, 5)
    after = [opened.screenshot(".cloud", which) for which in range(2)]
    assert all((one != other).mean() > 0.01 for one, other in zip(before, after, strict=True))
    share = drawn(after[1])
    opened.send("Input.dispatchMouseEvent", type="mouseWheel", x=left + 50, y=top + 50, deltaX=0, deltaY=-300)
    opened.settle()
    opened.wait("page.camera.distanceM < 40")
    opened.settle()
    assert drawn(opened.screenshot(".cloud", 1)) != share
    opened.click("#reset")
    opened.move(5, 5)
    assert all((opened.screenshot(".cloud", which) == before[which]).all() for which in range(2))
    opened.press("d")
    tilt = opened.run("page.camera.tilt")
    opened.press("W")
    assert opened.run("page.camera.tilt") > tilt, "though Caps Lock is on"
    opened.press("+")
    assert all((opened.screenshot(".cloud", which) != before[which]).any() for which in range(2))


def test_colours_are_chosen_and_explained(opened):
    seen = {}
    opened.run("document.querySelector('#mode').focus()")
    legends = {"height": "above the sensor", "range": "m away", "reflectance": "1, strong", "ring": "bottom row"}
    for mode, legend in legends.items():
        assert opened.run("document.querySelector('#mode').value") == mode
        assert legend in opened.run("document.querySelector('#legend').textContent")
        assert words(opened, "missing") == ["", "No reflectance is known here." if mode == "reflectance" else ""]
        seen[mode] = opened.screenshot(".image")
        opened.press("ArrowDown")
    assert (seen["range"] != seen["height"]).mean() > 0.3
    ring = seen["ring"][:, :, 0].astype(int)
    assert np.median(np.abs(np.diff(ring, axis=1))) == 0, "a row has one colour"
    assert opened.run("document.querySelector('#mode').value") == "label"
    assert opened.run("document.querySelector('#legend').textContent") == "roadbuildingno return"
    assert words(opened, "missing") == ["", "No label is known here."]


def test_rays_that_did_not_return_are_shown_on_request(opened):
    before = drawn(opened.screenshot(".cloud"))
    opened.click("#dropped")
    assert drawn(opened.screenshot(".cloud")) > before + 0.005
    opened.click("#dropped")
    opened.move(5, 5)
    assert drawn(opened.screenshot(".cloud")) == before


def test_pointing_in_one_picture_finds_the_place_in_the_other(opened, shown):
    row, column = 40, 133
    range_m = float(shown[0].images.range_m[0, row, column])
    assert range_m > 0
    left, top, width, height = opened.box(".image")
    before = opened.box(".cloud")
    opened.move(left + (column + 0.5) / 256 * width, top + (row + 0.5) / 64 * height)
    said = words(opened, "readout")
    assert re.fullmatch(
        rf"road, {range_m:.2f} m away, height -1\.73 m, reflectance 0\.\d\d \(row 40, column 133\)", said[0]
    )
    assert said[1].endswith(" (row 40, column 133)"), "the same ray in the other set"
    assert opened.box(".cloud") == before, "nothing moves while one points"
    mark = opened.box("[data-part=cloudMark]")
    assert opened.run("!document.querySelector('[data-part=cloudMark]').hidden")
    opened.move(5, 5)
    assert words(opened, "readout") == ["", ""]
    opened.move(mark[0] + mark[2] / 2, mark[1] + mark[3] / 2)
    assert words(opened, "readout")[0] == said[0], "and back again"
    near = opened.box("[data-part=imageMark]")
    assert near[0] + near[2] / 2 == pytest.approx(left + (column + 0.5) / 256 * width, abs=1)
    opened.run("document.querySelector('.image').focus()")
    opened.press("ArrowDown", modifiers=8)
    assert words(opened, "readout")[0].endswith("(row 41, column 133)")


def test_scans_are_saved_as_files_that_others_read(opened, shown, tmp_path):
    opened.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    opened.press("ArrowRight")
    opened.click("[data-part=bin]")
    opened.click("[data-part=ply]")
    opened.click("[data-part=ply]", 1)
    names = ["real_script_-second.bin", "real_script_-second.ply", "generated-seed_1.ply"]
    end = time.monotonic() + 20
    while not all((tmp_path / name).exists() for name in names):
        assert time.monotonic() < end, sorted(path.name for path in tmp_path.iterdir())
        time.sleep(0.05)
    for name, one in zip(names, (*shown[:1] * 2, shown[1]), strict=True):
        wanted, back = unproject(one.images[1]), read_scan(tmp_path / name)
        assert torch.allclose(back.points_xyz_m, wanted.points_xyz_m, rtol=0, atol=0.001)
        if wanted.reflectance is not None:
            assert torch.allclose(back.reflectance, wanted.reflectance, rtol=0, atol=0.002 + 1e-6)
        if name.endswith(".ply"):
            assert torch.equal(back.ring, wanted.ring)
        if name.startswith("real") and name.endswith(".ply"):
            assert torch.equal(back.label, one.images.label[1][one.images.return_mask[1]])


def test_everything_is_reached_by_keys_and_has_a_name(opened):
    reached = []
    for _ in range(14):
        opened.press("Tab")
        what, outline = opened.run(
            "((one) => [one.id || one.dataset.part || one.tagName, getComputedStyle(one).outlineStyle])"
            "(document.activeElement)"
        )
        assert what == "BODY" or outline == "solid", f"{what} does not show that it has the focus"
        reached.append(what)
    for control in ("previous", "position", "next", "mode", "dropped", "size", "reset", "cloud", "image", "bin", "ply"):
        assert control in reached
    nodes = opened.send("Accessibility.getFullAXTree")["nodes"]
    kinds = ("button", "slider", "combobox", "checkbox", "image", "img")
    named = [(one["role"]["value"], one.get("name", {}).get("value")) for one in nodes if not one.get("ignored")]
    wanted = [(role, name) for role, name in named if role in kinds]
    assert len(wanted) >= 13
    assert all(name for _, name in wanted), wanted


def test_light_and_dark(opened):
    dark = opened.screenshot()[3, 3]
    opened.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}])
    opened.settle()
    light = opened.screenshot()
    assert dark.max() < 60
    assert light[3, 3].min() > 230
    assert drawn(opened.screenshot(".cloud")) > 0.02


def test_an_old_browser_is_told_so(browser, written):
    script = {"source": "delete globalThis.DecompressionStream;"}
    number = browser.send("Page.addScriptToEvaluateOnNewDocument", **script)["identifier"]
    browser.open(written)
    browser.send("Page.removeScriptToEvaluateOnNewDocument", identifier=number)
    browser.move(300, 300)
    assert "browser of 2023" in browser.run("document.querySelector('#trouble:not([hidden])').textContent")
    assert browser.troubles() == []


@pytest.mark.parametrize(
    "script",
    [
        "globalThis.honest = true;",
        "const ask = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
        "return kind === 'webgl' ? null : ask.call(this, kind, ...more); };",
    ],
    ids=["computed", "none"],
)
def test_without_a_graphics_card_points_are_drawn_by_hand(opened, written, script):
    by_card = opened.screenshot(".cloud")
    number = opened.send("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"]
    opened.open(written)
    opened.send("Page.removeScriptToEvaluateOnNewDocument", identifier=number)
    assert opened.run("!document.querySelector('#slow').hidden")
    opened.run("document.querySelector('#slow').hidden = true")  # it takes room
    opened.settle()
    by_hand = opened.screenshot(".cloud")
    assert opened.troubles() == []
    assert by_hand.shape == by_card.shape
    assert abs(drawn(by_hand) / drawn(by_card) - 1) < 0.35, "squares of whole pixels are a little larger"
    tall, wide = (side // 8 * 8 for side in by_card.shape[:2])
    blocks = [
        (one != one[2, 2]).any(axis=2)[:tall, :wide].reshape(tall // 8, 8, wide // 8, 8).any(axis=(1, 3))
        for one in (by_card, by_hand)
    ]
    assert (blocks[0] == blocks[1]).mean() > 0.9, "the same points in the same places"
