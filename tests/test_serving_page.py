"""What happens when somebody clicks and types on the page that is served, in a browser."""

import os
import re
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import lidargrit
from browser import Browser
from lidargrit.data.formats import load, read_scan
from lidargrit.scans.projection import unproject
from served import MODELS, running
from test_generator_contract import made

QUICK = {"steps": 3, "resamples": 2}


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with running(tmp_path_factory.mktemp("runs")) as served:
        yield served
        folder = served.queue._folder
        assert folder.is_dir()
    assert not folder.exists(), "nothing is left behind"


@pytest.fixture(scope="module")
def scan_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scans") / "my <b>street.ply"
    load("ply").write(path, lidargrit.simulate(seed=5))
    return path


def said(browser: Browser) -> str:
    return browser.run("document.querySelector('#error:not([hidden])')?.textContent ?? ''")


def finish(browser: Browser) -> None:
    browser.wait("!document.querySelector('#generate').disabled")
    browser.settle()


def fill(browser: Browser, selector: str, value: str) -> None:
    browser.run(
        f"((one) => {{ one.value = {value!r}; one.dispatchEvent(new Event('change')); }})"
        f"(document.querySelector({selector!r}))"
    )


def choose_file(browser: Browser, path: Path) -> None:
    root = browser.send("DOM.getDocument")["root"]["nodeId"]
    node = browser.send("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
    browser.send("DOM.setFileInputFiles", files=[str(path)], nodeId=node)


@pytest.fixture
def opened(browser, served) -> Browser:
    browser.events.clear()
    browser.send("Page.navigate", url=served.url)
    browser.wait("document.readyState === 'complete' && typeof desk !== 'undefined' && desk?.busy === false")
    browser.click("[data-part=remove]")  # the scan that the page begins with
    return browser


def names(browser: Browser) -> list[str]:
    return browser.run("[...document.querySelectorAll('[data-part=name]')].map((one) => one.textContent)")


def plotted_share(picture: np.ndarray) -> float:
    return float((picture != picture[2, 2]).any(axis=2).mean())


def test_generate_compare_and_save(opened, served, tmp_path):
    options = opened.run("[...document.querySelectorAll('#model option')].map((one) => one.textContent)")
    assert options == [f"tiny-{name}" for name in MODELS]
    opened.click("#generate")
    finish(opened)
    assert opened.run("document.querySelector('#status').textContent").startswith("Done in ")
    fill(opened, "[name=temperature]", "0.5")
    opened.run("document.querySelector('#seed').select()")
    for digit in "40":  # with a result on the page, keys outside of fields turn the view
        opened.press(digit)
    assert opened.run("document.querySelector('#seed').value") == "40"
    fill(opened, "#seed", "4")
    opened.click("#generate")
    finish(opened)
    assert names(opened) == ["tiny-lidargrit", "tiny-lidargrit, temperature=0.5"]
    assert said(opened) == ""
    for which in range(2):
        assert plotted_share(opened.screenshot(".cloud", which)) > 0.005
        assert plotted_share(opened.screenshot(".image", which)) > 0.2
    assert opened.run("document.documentElement.scrollHeight <= innerHeight"), "all is seen at once"
    opened.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    opened.click("#next")
    files = [tmp_path / f"tiny-lidargrit_temperature_0.5-seed_5.{kind}" for kind in ("npz", "ply", "bin")]
    for kind in ("npz", "ply", "bin"):
        opened.click(f"[data-part={kind}]", 1)
    end = time.monotonic() + 20
    while not all(path.exists() for path in files):
        assert time.monotonic() < end, sorted(path.name for path in tmp_path.iterdir())
        time.sleep(0.05)
    generator = made("lidargrit")[0]
    wanted = unproject(generator.sample([5], sampling=generator.Sampling(temperature=0.5))[0])
    for path in files:
        assert torch.allclose(read_scan(path).points_xyz_m, wanted.points_xyz_m, atol=1e-4), path.name
    opened.click("[data-part=remove]")
    assert names(opened) == ["tiny-lidargrit, temperature=0.5"]
    assert opened.troubles() == []
    assert {url.removeprefix(served.url).split("/")[1] for url in opened.requests()} >= {"", "page.js", "jobs"}
    assert all(url.startswith(f"{served.url}/") for url in opened.requests())


def test_a_scan_that_is_uploaded_is_completed(opened, scan_file):
    opened.click("#generate")  # without labels, which the scans after it have
    finish(opened)
    opened.click("[data-part=remove]")
    fill(opened, "#model", "2")
    for name, value in QUICK.items():
        fill(opened, f"[name={name}]", str(value))
    choose_file(opened, scan_file)
    opened.click("#tasks [value=ahead]")
    finish(opened)
    assert said(opened) == ""
    assert names(opened) == ["as uploaded", "what the model saw", "completed by tiny-r2dm, steps=3, resamples=2"]
    points = opened.run("[...document.querySelectorAll('section .about')].map((one) => one.textContent)")
    counts = [
        int(found[1].replace(",", "")) for found in (re.search(r": ([\d,]+) points", text) for text in points) if found
    ]
    assert counts[1] < 0.8 * counts[0]
    assert counts[1] <= counts[2], "what was seen is kept"
    assert opened.run("document.querySelectorAll('section b').length") == 0, "names are no HTML"
    fill(opened, "#model", "0")
    opened.click("#tasks [value=ahead]")
    finish(opened)
    assert names(opened)[-1] == "completed by tiny-lidargrit"
    assert len(names(opened)) == 4
    fill(opened, "#mode", "label")
    assert "building" in opened.run("document.querySelector('#legend').textContent")
    fill(opened, "#model", "1")
    assert opened.run("[...document.querySelectorAll('#tasks button, #examples button')].every((one) => one.hidden)")
    assert "can neither complete" in opened.run("document.querySelector('#ability').textContent")
    assert opened.troubles() == []


def test_the_page_begins_with_a_scan_that_turns_until_somebody_takes_hold_of_it(browser, served):
    browser.events.clear()
    browser.send("Page.navigate", url=served.url)
    browser.wait("document.readyState === 'complete' && typeof desk !== 'undefined' && desk?.busy === false")
    assert names(browser) == ["tiny-lidargrit"]
    turned = browser.run("desk.page.camera.turn")
    browser.wait(f"desk.page.camera.turn > {turned} + 0.01")
    browser.press("Escape")
    browser.settle()
    stopped = browser.run("desk.page.camera.turn")
    browser.settle()
    assert browser.run("desk.page.camera.turn") == stopped


@pytest.mark.parametrize(("example", "panes"), [("street", 3), ("vlp16", 2), ("clean", 2)])
def test_an_example_is_one_click_away(example, panes, opened):
    opened.click(f"[data-example={example}]")
    finish(opened)
    assert said(opened) == ""
    assert len(names(opened)) == panes
    assert names(opened)[0] == "example"
    points = opened.run("desk.page.panes.map((pane) => pane.scan.returns)")
    filled = opened.run("desk.page.panes.map((pane) => pane.scan.filled.reduce((sum, one) => sum + one, 0))")
    assert filled[:-1] == [0] * (panes - 1), "what was measured"
    if example == "clean":
        assert points[1] < points[0]
        assert filled[1] == 0
    else:
        assert 0 < filled[-1] < points[-1]
    if example == "vlp16":  # with a task of scans of all rows
        opened.click("#tasks [value=ahead]")
        finish(opened)
        assert "choose the task 'Add the rows that a VLP-16 lacks'" in said(opened)
        assert "lidargrit " not in said(opened)


def test_scans_without_labels_are_not_coloured_by_those_that_were_shown_before(opened):
    opened.click("#generate")
    finish(opened)
    opened.run("desk.page.colourBy('label')")  # as the page does where a scan was labelled
    opened.click("#generate")
    finish(opened)
    assert opened.run("document.querySelector('#mode').value") == "height"
    assert opened.run("[...document.querySelectorAll('[data-part=missing]')].every((one) => !one.textContent)")


def test_new_scans_are_not_coloured_by_what_scans_had_that_were_removed(opened):
    for mode in ("filled", "height", "filled"):
        opened.click("#generate" if mode == "height" else "[data-example=street]")
        finish(opened)
        assert opened.run("document.querySelector('#mode').value") == mode
        while names(opened):
            opened.click("[data-part=remove]")


def test_a_number_that_is_typed_is_sent_though_it_is_the_one_that_is_shown(opened):
    fill(opened, "#model", "2")
    assert opened.run("document.querySelector('[name=steps]').placeholder") == "256"
    assert opened.run("desk.request().sampling") == {}, "a scan is completed in other steps than 256"
    fill(opened, "[name=steps]", "256")
    assert opened.run("desk.request().sampling") == {"steps": 256}


def test_a_setting_that_cannot_be_is_shown_though_it_is_folded_away(opened):
    fill(opened, "#settings [name=top_k]", "5000")
    for button in ("#generate", "[data-example=street]"):
        opened.run("document.querySelector('#more').open = false")
        opened.click(button)
        assert opened.run("document.activeElement.name") == "top_k", button
        assert names(opened) == []
    assert opened.troubles() == []


def test_the_mouse_draws_the_region_that_is_filled_in(opened, scan_file):
    choose_file(opened, scan_file)
    opened.click("#tasks [value=region]")
    finish(opened)
    assert names(opened) == ["as uploaded"]
    assert "Now drag over" in opened.run("document.querySelector('#status').textContent")
    left, top, width, height = opened.box(".image")
    opened.drag((left + 0.25 * width, top + 0.3 * height), (left + 0.5 * width, top + 0.8 * height))
    assert opened.run("desk.region") == pytest.approx([0.25, 0.3, 0.5, 0.8], abs=0.02)
    drawn = opened.box(".region")
    assert drawn == pytest.approx((left + 0.25 * width, top + 0.3 * height, 0.25 * width, 0.5 * height), abs=4)
    opened.click("#tasks [value=region]")
    finish(opened)
    assert said(opened) == ""
    assert names(opened)[-3:] == ["as uploaded", "what the model saw", "completed by tiny-lidargrit"]
    opened.click("#tasks [value=raydrop]")
    assert opened.run("document.querySelectorAll('.region:not([hidden])').length") == 0
    finish(opened)
    assert names(opened)[-1] == "raydrop by tiny-lidargrit"
    fill(opened, "#model", "2")
    assert opened.run("document.querySelector('#tasks [value=raydrop]').hidden"), "r2dm drops nothing"
    assert opened.troubles() == []


def test_a_bad_file_is_told_in_one_line(opened, tmp_path):
    for name, data, why in (
        ("cut.bin", bytes(17), "17 bytes in cut.bin"),
        ("README.md", b"hello", "'README.md', which is no LiDAR scan that this page reads"),
        ("large.bin", bytes(4_000_016), "at most 4,000,000"),
    ):
        (tmp_path / name).write_bytes(data)
        choose_file(opened, tmp_path / name)
        opened.click("#tasks [value=ahead]")
        finish(opened)
        assert why in said(opened), name
        assert "/" not in said(opened).replace("/complete", ""), "no place on the server's disk"
    assert opened.run("document.querySelector('#error').getAttribute('role')") == "alert"


def test_a_file_that_changed_after_it_was_chosen_is_told_apart_from_a_dead_server(opened, scan_file, tmp_path):
    path = tmp_path / "mine.ply"
    path.write_bytes(scan_file.read_bytes())
    choose_file(opened, path)
    opened.run("document.querySelector('#file').files[0].lastModified")  # until asked, a browser has not looked
    path.write_bytes(path.read_bytes() + b" ")
    os.utime(path, (0, 0))  # not the same millisecond
    opened.click("#tasks [value=ahead]")
    opened.wait("!document.querySelector('#error').hidden")
    assert said(opened) == "mine.ply has changed since you chose it, or can no longer be read. Choose it again."


def test_everything_is_reached_by_keys_and_has_a_name(opened):
    opened.click("#generate")
    finish(opened)
    opened.run("document.querySelector('#model').focus()")
    reached = []
    for _ in range(30):
        reached.append(
            opened.run("((one) => one.id || one.name || one.dataset.part || one.tagName)(document.activeElement)")
        )
        outline = opened.run("getComputedStyle(document.activeElement).outlineStyle")
        assert outline == "solid" or reached[-1] == "BODY", reached
        opened.press("Tab")
    wanted = (
        "model",
        "seed",
        "count",
        "temperature",
        "SUMMARY",
        "generate",
        "file",
        "task",
        "mode",
        "npz",
        "remove",
    )
    assert set(wanted) <= set(reached)
    nodes = opened.send("Accessibility.getFullAXTree")["nodes"]
    kinds = ("button", "spinbutton", "combobox", "slider", "checkbox", "img", "image")
    controls = [one for one in nodes if not one.get("ignored") and one["role"]["value"] in kinds]
    assert len(controls) > 15
    assert all(one.get("name", {}).get("value") for one in controls)
