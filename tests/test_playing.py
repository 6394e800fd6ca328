"""The page plays the scans of a drive: their times on it, and what a press of the button does in a browser."""

import time

from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.data.prepared.config import DataConfig, ScanSettings
from lidargrit.viewer.interactive import page, write_page
from lidargrit.viewer.scan_sets import ScanSet, load_scan_sets
from test_view_page import SENSOR, page_data, scans


def test_times_of_a_drive_are_on_the_page(tmp_path, heard):
    write_drives(tmp_path, 3, DriveConfig(SENSOR, seed=2_000_001, frames=3))
    settings = ScanSettings(DataConfig(columns=256, column_stride=1))
    (one,) = load_scan_sets([f"kitti_odometry:{tmp_path}"], 2, settings=settings)
    assert one.times_s == (0.0, 0.1)
    (later,) = load_scan_sets([f"kitti_odometry:{tmp_path}:00[34%:]"], 2, settings=settings)
    assert [scan["time"] for scan in page_data(page([later]))["sources"][0]["scans"]] == [0, 0.1]
    (tmp_path / "sequences" / "00" / "times.txt").write_text("noon\n")
    (none,) = load_scan_sets([f"kitti_odometry:{tmp_path}"], 2, settings=settings)
    assert none.times_s == ()
    assert any("times are not known: got a row of" in line for line in heard)
    assert "time" not in page_data(page([none]))["sources"][0]["scans"][0]


def test_a_drive_is_played_at_its_times_until_somebody_steps(browser, tmp_path):
    drive = ScanSet("drive", scans(count=2), ("first", "second"), times_s=(7.0, 7.3))
    write_page([ScanSet("other", scans(count=2, seed=1), ("one", "two")), drive], tmp_path / "drive.html")
    browser.open(tmp_path / "drive.html")
    browser.run(
        "globalThis.seen = []; new MutationObserver(() => seen.push([counter.textContent, performance.now()]))"
        ".observe(globalThis.counter = document.querySelector('#counter'), { childList: true })"
    )
    browser.click("#play")
    until = time.monotonic() + 30
    while browser.run("seen.length") < 4 and time.monotonic() < until:
        time.sleep(0.1)
    assert browser.run("document.querySelector('#play').textContent") == "Pause"
    browser.press("ArrowLeft")
    count = browser.run("seen.length")
    time.sleep(1.5)
    assert browser.run("seen.length") == count
    assert browser.run("document.querySelector('#play').textContent") == "Play"
    words, at_ms = zip(*browser.run("seen"), strict=True)
    assert words[:4] == ("Scan 2 of 2", "Scan 1 of 2") * 2
    assert at_ms[1] - at_ms[0] >= 900, "a drive begins anew after a second"
    assert 290 <= at_ms[2] - at_ms[1] < at_ms[1] - at_ms[0] + 1500
    assert browser.troubles() == []


def test_scans_of_no_drive_cannot_be_played(browser, tmp_path):
    write_page([ScanSet("none", scans(), ("a", "b", "c"))], tmp_path / "none.html")
    browser.open(tmp_path / "none.html")
    assert browser.run("document.querySelector('#play').hidden")
    browser.press("p")
    assert browser.run("page.playing") is None
    assert browser.run("document.querySelector('#counter').textContent") == "Scan 1 of 3"
