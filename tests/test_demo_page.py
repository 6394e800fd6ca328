"""The page of the demo: a scan, its tokens and what comes of them, as it is written and as a browser shows it."""

import json
import math
import re
import shlex
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.data.run_folder import RUN_FILE
from lidargrit.evaluation.intervals import RealAgainstReal
from lidargrit.evaluation.reconstruction import score_reconstruction
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.viewer import demo
from lidargrit.viewer.demo_page import DemoPage, nearest_scans, write_demo_page
from lidargrit.viewer.report_charts import score_chart
from test_generator_contract import SENSOR, Store, made

SECONDS = {"simulate": 3.0, "train the tokenizer": 154.1}


class Sampled(Store):
    """Scans that a generator sampled."""

    def __init__(self, images):
        self.range_m = images.range_m

    def read(self, index):
        return Pixels(self.range_m[index].numpy())


class Named(Store):
    """Scans whose names would do harm if they were HTML."""

    provenance = Provenance(tuple(f"drive/<b>{index}</b></script>" for index in range(12)))


@pytest.fixture(scope="module")
def scored():
    images = RangeImages(SENSOR, [Store()])
    generator = made("lidargrit")[0]
    sampled = RangeImages(SENSOR, [Sampled(generator.sample(range(12)))])
    return sampled, demo._score(sampled, images)


@pytest.fixture(scope="module")
def written(tmp_path_factory, scored) -> Path:
    folder = tmp_path_factory.mktemp("a") / "new run"
    folder.mkdir()
    generator, val = made("lidargrit")[0], RangeImages(SENSOR, [Named()])
    errors = score_reconstruction(generator.get_tokenizer(), val)
    page = DemoPage(generator, "simulated", val, val, scored[0], errors, scored[1], SECONDS, ("a <fact>",), folder)
    write_demo_page(page, folder / "demo.html")
    return folder / "demo.html"


@pytest.fixture(scope="module")
def with_pixel_decoder(tmp_path_factory, scored) -> Path:
    """Return the page of a model that has a pixel decoder."""
    folder, plain = tmp_path_factory.mktemp("run"), made("lidargrit")[0]
    sizes = PixelDecoderConfig(mask_width=4, range_width=4, blocks=1)
    generator = LidarGrit(replace(plain.config, pixels=sizes), SENSOR).eval()
    val = RangeImages(SENSOR, [Named()])
    errors = score_reconstruction(generator.get_tokenizer(), val)
    page = DemoPage(generator, "simulated", val, val, scored[0], errors, scored[1], SECONDS, (), folder)
    write_demo_page(page, folder / "demo.html")
    return folder / "demo.html"


def test_scores_stand_between_real_against_real_and_pixel_statistics(scored):
    sampled, card = scored
    for score in card.scores:
        real = score.real_against_real
        assert real.value <= max(score.result.value, 1e-9), "the reference itself, which nothing can beat"
        assert (real.num_scans, real.halvings) == (6, 5)
        assert score.pixel_statistics is not None
    score = replace(card.scores[0], real_against_real=RealAgainstReal(0.25, 6, 5), pixel_statistics=9.0)
    assert "real against real 0.2500, pixel statistics 9.0000" in score_chart(score)
    plain = score_chart(replace(score, real_against_real=None, pixel_statistics=None))
    assert 'class="pixels"' not in plain
    assert 'class="real"' not in plain
    assert len(sampled) == 12


def test_the_page_tells_all_of_it_and_fetches_nothing(written, scored):
    text = written.read_text(encoding="utf-8")
    titles = re.findall(r"<h2>(.*?)</h2>", text)
    assert [title[:2] for title in titles] == ["1.", "2.", "3.", "4.", "5.", "6.", "7.", "Wh"]
    assert not re.search(r"https?://|src=\"(?!data:)|@import|url\(", text)
    assert text.count("</script>") == 2, "names cannot end a script"
    assert "<b>0</b>" not in text
    assert text.count('class="verdict"') == 1
    assert text.index('class="verdict"') < text.index("pixel statistics</th>"), "words come before numbers"
    assert "a &lt;fact&gt;" in text
    assert "154.1 s" in text
    assert shlex.split(unescape(re.findall(r"<code>(lidargrit serve .*?)</code>", text)[0]))[2:] == [
        str(written.parent)
    ]
    generator = made("lidargrit")[0]
    tokens = generator.get_tokenizer().encode(RangeImages(SENSOR, [Store()]).batch([0])).tokens[0]
    shown = [int(number) for number in re.findall(r'text-anchor="middle" style="fill:#\w+">(\d+)</text>', text)]
    assert shown == tokens[1:7].flatten().tolist(), "the middle six of eight rows, as numbers"
    assert text.count('<th scope="row">') == len(scored[1].scores) + len(SECONDS)


def test_a_pixel_decoder_is_shown_phase_by_phase(written, with_pixel_decoder):
    plain, text = written.read_text(encoding="utf-8"), with_pixel_decoder.read_text(encoding="utf-8")
    titles = re.findall(r"<h2>(.*?)</h2>", text)
    assert [title[:2] for title in titles] == ["1.", "2.", "3.", "4.", "5.", "6.", "7.", "8.", "Wh"]
    assert "phase by phase" in titles[5]
    assert "pixel decoder" not in plain
    numbers = re.findall(r"<figcaption>return mask after (\d+) phases?</figcaption>", text)
    assert numbers == ["1", "4", "7", "10"]
    assert len(re.findall(r"<figcaption>after \d+ phases?; \d+% of rays returned</figcaption>", text)) == len(numbers)
    assert "in 10 phases" in text


def test_a_browser_shows_it(written, browser):
    browser.open(written)
    names = browser.run("[...document.querySelectorAll('[data-part=name]')].map((one) => one.textContent)")
    assert names == ["new", "nearest simulated scan of training"]
    for which in range(2):
        for canvas in (".cloud", ".image"):
            picture = browser.screenshot(canvas, which)
            assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    assert browser.run("[...document.images].every((one) => one.complete && one.naturalWidth > 0)")
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    browser.run("document.querySelector('#next').scrollIntoView()")
    browser.click("#next")
    assert browser.run("document.querySelector('#counter').textContent") == "Scan 2 of 6"
    assert browser.troubles() == []
    assert browser.requests() == []


def test_the_nearest_scan_is_that_of_a_loop_over_pixels():
    real = RangeImages(SENSOR, [Store()])
    new = real.batch([7, 3])
    new = replace(new, range_m=new.range_m * 1.01)
    assert nearest_scans(new, real) == [7, 3]
    other = real.batch([1])
    sums = []
    for index in range(len(real)):
        one = real.batch([index]).range_m[0]
        pixels = np.ndindex(*one.shape)
        sums.append(
            sum(abs(math.log1p(float(one[at])) - math.log1p(float(1.3 * other.range_m[0][at]))) for at in pixels)
        )
    assert nearest_scans(replace(other, range_m=1.3 * other.range_m), real) == [int(np.argmin(sums))]


def test_times_are_those_of_the_first_time(tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text("".join(json.dumps({"scans_seen": 8, "seconds": one}) + "\n" for one in (3.0, 5.5, 1.0, 4.0)))
    assert demo._trained_s(log) == 9.5, "stopped after 5.5 s, and 4 s more"
    clock = demo._Clock(tmp_path / "timings.json")
    with clock.stage("a"):
        pass
    clock.add("b", 7.04)
    assert not (tmp_path / "timings.json").exists(), "a folder that is not ours is left as it is"
    (tmp_path / RUN_FILE).write_text("{}")
    clock.keep()
    again = demo._Clock(tmp_path / "timings.json")
    again.add("b", 100.0)
    assert again.seconds["b"] == 7.0
