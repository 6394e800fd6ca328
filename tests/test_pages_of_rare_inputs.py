"""Pages in a browser, with inputs that are rare: a sensor of one row, points without a pixel."""

from dataclasses import replace

import torch

from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.viewer.interactive import write_page
from lidargrit.viewer.scan_sets import ScanSet


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


def test_a_long_name_does_not_make_the_page_wider_than_its_window(browser, tmp_path):
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(64)
    images = RangeImage(torch.full((1, 64, 64), 9.0), torch.ones(1, 64, 64, dtype=torch.bool), sensor)
    write_page([ScanSet("one", images, ("n" * 250,)), ScanSet("other", images, ("b",))], tmp_path / "page.html")
    browser.open(tmp_path / "page.html")
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
