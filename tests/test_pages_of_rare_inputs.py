"""Pages in a browser, with inputs that are rare: a sensor of one row, points without a pixel, a file that changes."""

import os
from dataclasses import replace

import torch

import lidargrit
from lidargrit.data.formats import load
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.viewer.interactive import write_page
from lidargrit.viewer.scan_sets import ScanSet
from served import running


def test_a_sensor_of_one_row_is_coloured_by_its_row(browser, tmp_path):
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(256)
    sensor = replace(sensor, elevation_rad=sensor.elevation_rad[:1])
    images = RangeImage(torch.full((1, 1, 256), 9.0), torch.ones(1, 1, 256, dtype=torch.bool), sensor)
    write_page([ScanSet("one row", images, ("a",))], tmp_path / "page.html")
    browser.open(tmp_path / "page.html")
    browser.run(
        "((one) => { one.value = 'ring'; one.dispatchEvent(new Event('change')); })(document.querySelector('#mode'))"
    )
    browser.settle()
    assert browser.run("document.querySelector('#legend').textContent").startswith("top row")
    assert browser.troubles() == []


def test_a_mark_on_a_point_that_the_next_scan_does_not_have_goes_away(browser, tmp_path):
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(256)
    images = RangeImage(torch.full((2, 64, 256), 9.0), torch.ones(2, 64, 256, dtype=torch.bool), sensor)
    beside = Scan(torch.tensor([[5.0, 0.0, 3.0], [6.0, 0.0, 3.0]]))
    write_page([ScanSet("two", images, ("a", "b"), beside=(beside, None))], tmp_path / "page.html")
    browser.open(tmp_path / "page.html")
    browser.run("page.mark(page.panes[0], page.panes[0].source.size + 1)")
    browser.press("ArrowRight")
    browser.settle()
    assert browser.troubles() == []
    assert browser.run("document.querySelector('#panes').getAttribute('aria-busy')") == "false"
    assert browser.run("document.querySelector('[data-part=readout]').textContent") == ""


def test_a_file_that_changed_after_it_was_chosen_is_told_apart_from_a_dead_server(browser, tmp_path):
    path = tmp_path / "mine.ply"
    load("ply").write(path, lidargrit.simulate(seed=5))
    with running(tmp_path / "runs") as served:
        browser.send("Page.navigate", url=served.url)
        browser.wait("document.readyState === 'complete' && typeof desk !== 'undefined' && desk?.busy === false")
        root = browser.send("DOM.getDocument")["root"]["nodeId"]
        node = browser.send("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
        browser.send("DOM.setFileInputFiles", files=[str(path)], nodeId=node)
        browser.run("document.querySelector('#file').files[0].lastModified")  # until asked, a browser has not looked
        path.write_bytes(path.read_bytes() + b" ")
        os.utime(path, (0, 0))  # not the same millisecond
        browser.click("#tasks [value=ahead]")
        browser.wait("!document.querySelector('#error').hidden")
        told = browser.run("document.querySelector('#error').textContent")
    assert told == "mine.ply has changed since you chose it, or can no longer be read. Choose it again."
