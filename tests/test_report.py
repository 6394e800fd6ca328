"""The page: self-contained, escaped, and readable by machines that read aloud."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

from lidargrit.evaluation import profiles
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_sources
from lidargrit.evaluation.intervals import Interval, RealAgainstReal, Score
from lidargrit.evaluation.metrics import MetricResult
from lidargrit.evaluation.profiles import matches, profile, searched_scans
from lidargrit.evaluation.scorecard import LeftOut
from lidargrit.scans.projection import points_of_pixels
from lidargrit.viewer._page import document
from lidargrit.viewer.report import page, write_report
from lidargrit.viewer.report_charts import line_chart, score_chart

VOID = {"meta", "img", "br", "line", "circle"}
POLICY = r'Content-Security-Policy" content="([^"]*)"'
EVIL = "<script>alert('x')</script>\"'&"


@pytest.fixture(scope="module")
def evaluated():
    # Of real streets only a few: simulating them takes most of the time.
    return evaluate_sources("simulated:4:train", "simulated:4:test", EvalConfig(metrics=("return_rate_per_ring",)))


class Reader(HTMLParser):
    """Checks that tags nest, and gathers them."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.attributes = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def read(text):
    reader = Reader()
    reader.feed(text)
    assert reader.open == []
    return reader


def test_the_page_is_whole_and_needs_nothing_else(evaluated, tmp_path):
    write_report(*evaluated, tmp_path / "deep" / "report.html")
    text = (tmp_path / "deep" / "report.html").read_text(encoding="utf-8")
    reader = read(text)
    assert len(text) < 3_000_000
    assert not {"script", "link", "iframe", "object", "embed", "form"} & set(reader.tags)
    for _, name, value in reader.attributes:
        assert not name.startswith("on")
        if name in {"src", "href", "xlink:href", "action"}:
            assert re.match(r"data:image/png;base64,[A-Za-z0-9+/=]+$", value)
    assert "url(" not in text
    assert "@import" not in text
    assert "http://" not in text
    for heading in ("Scores", "The best matches", "Mean images", "Return rate by ring", "Seen from above", "Settings"):
        assert f">{heading}</h" in text


def test_the_page_can_be_heard_and_walked(evaluated):
    reader = read(page(*evaluated))
    named = {(tag, name) for tag, name, value in reader.attributes if value}
    assert ("html", "lang") in named
    assert reader.tags.count("h1") == 1
    assert reader.tags.count("main") == 1
    images = [value for tag, name, value in reader.attributes if (tag, name) == ("img", "alt")]
    assert len(images) == reader.tags.count("img")
    assert all(images)
    drawings = [value for tag, name, value in reader.attributes if (tag, name) == ("svg", "aria-label")]
    assert len(drawings) == reader.tags.count("svg")
    assert any("95 % interval" in value and "real against real" in value for value in drawings)
    heads = [value for tag, name, value in reader.attributes if (tag, name) == ("th", "scope")]
    assert len(heads) == reader.tags.count("th")


def test_the_page_names_no_folder_of_the_machine(evaluated):
    card, pair = evaluated
    samples = replace(card.samples, source="/srv/secret/runs/mine/samples")
    warnings = ("see kitti_360:/home/somebody/secret/kitti_360:train",)
    text = page(replace(card, samples=samples, warnings=warnings), pair)
    assert "secret" not in text
    assert "/home" not in text
    assert "…/samples" in text
    assert "kitti_360:…/kitti_360:train" in text


@pytest.mark.parametrize(
    "folder", ["/home/jane doe/secret project", "/home/jane/secret (old)", '/home/jane/"secret" x']
)
def test_folders_of_the_sources_may_have_any_letters(evaluated, folder):
    card, pair = evaluated
    source = f"kitti_360:{folder}/scans:lidargen-code/train"
    told = {"warnings": (f"{folder}/scans/1.bin: few points",), "settings": {"weights": {"lidm": f"{folder}/a.pt"}}}
    changed = replace(card, reference=replace(card.reference, source=source), **told)
    text = page(changed, replace(pair, reference=replace(pair.reference, source=source)))
    assert "secret" not in text
    assert "jane" not in text
    assert "<td>kitti_360:…/scans:lidargen-code/train</td>" in text
    assert "…/1.bin: few points" in text
    assert "…/a.pt" in text


def test_whatever_comes_from_outside_is_escaped(evaluated):
    card, pair = evaluated
    bad = replace(card.samples, source=EVIL, split=EVIL, sensor=EVIL)
    evil = replace(
        card,
        samples=bad,
        protocol=EVIL,
        about={**card.about, "title": EVIL, "departures": [EVIL]},
        warnings=(EVIL,),
        deviations=(EVIL,),
        left_out=(LeftOut(EVIL, EVIL, EVIL),),
        settings={EVIL: EVIL},
        scores=(replace(card.scores[0], result=replace(card.scores[0].result, variant=EVIL)),),
    )
    text = page(evil, pair)
    assert "<script" not in text
    assert "alert(" in text
    assert "script" not in read(text).tags


def test_a_chart_puts_marks_where_the_numbers_are():
    result = MetricResult("bev_jsd", 0.2, False, 9, 9, "exact")
    drawn = score_chart(Score(result, Interval(0.1, 0.3, 0.05, 20), RealAgainstReal(0.4, 4, 5)))
    assert 'aria-label="score 0.2000, 95 % interval 0.1000 to 0.3000, real against real 0.4000"' in drawn
    assert 'cx="160.0"' in drawn  # half-way between 0, at 10, and the largest mark, real against real, at 310
    assert 'class="interval" x1="85.0"' in drawn
    assert 'class="real" x1="310.0"' in drawn
    assert score_chart(Score(replace(result, value=float("nan")))) == ""
    assert "<circle" in score_chart(Score(replace(result, value=0.0)))
    lines = line_chart({"a<b": np.array([0.0, 1.0]), "c": np.array([0.5, 0.5])}, "x", "y", [0])
    assert "a&lt;b" in lines


def test_profiles_are_means_by_a_slow_loop(evaluated):
    side = evaluated[1].samples
    found, batch = profile(side), side.batch(range(4))
    row, column = 40, 17
    ranges = [float(one[row, column]) for one in batch.range_m if one[row, column] > 0]
    assert found.return_rate[row, column] == pytest.approx(len(ranges) / 4)
    assert found.mean_range_m[row, column] == pytest.approx(np.mean(ranges))
    points = points_of_pixels(batch)[batch.return_mask]
    inside = (points[:, 0] >= 3) & (points[:, 0] < 4) & (points[:, 1] >= -8) & (points[:, 1] < -7)
    assert found.density[53, 42] == pytest.approx(float(inside.sum()) / 4)
    near = (points[:, :2].abs() < 50).all(dim=1)
    assert found.density.sum() == pytest.approx(float(near.sum()) / 4, rel=1e-3)


def test_a_scan_is_its_own_nearest(evaluated):
    pair = evaluated[1]
    found = matches(pair.samples, pair.samples)
    assert [match.distance for match in found] == [0.0] * 4
    assert all(match.generated == match.real for match in found)
    other = matches(pair.samples, pair.reference)
    assert [match.distance for match in other] == sorted(match.distance for match in other)
    rows = torch.linspace(0, pair.samples.images.sensor.height - 1, 32).round().long()
    columns = torch.linspace(0, pair.samples.images.sensor.width - 1, 128).round().long()
    pair = [side.batch([index])[0].range_m for side, index in
            ((pair.samples, other[0].generated), (pair.reference, other[0].real))]  # fmt: skip
    apart = [torch.log2(1 + one[rows][:, columns]) for one in pair]
    assert other[0].distance == pytest.approx(float((apart[0] - apart[1]).abs().mean()), rel=1e-4)


def test_all_reference_scans_are_searched_for_the_nearest(evaluated, monkeypatch):
    card, pair = evaluated
    few = replace(pair, samples=replace(pair.samples, indices=[0]), reference=replace(pair.reference, indices=[1]))
    monkeypatch.setattr(profiles, "_BLOCK", 3)  # the last of several blocks is smaller
    copied = replace(few, samples=replace(few.samples, images=pair.reference.images, indices=[3]))
    assert [(one.real, one.distance) for one in matches(copied.samples, searched_scans(copied.reference))] == [(3, 0.0)]
    wanted = "For 1 of the 1 samples the nearest was searched among 4 of the 4 reference scans that were read"
    assert wanted in page(card, few)
    assert "over 32 x 128 evenly spaced pixels" in page(card, few)
    monkeypatch.setattr(profiles, "SEARCHED_AT_MOST", 2)
    assert "among 2 of the 4 reference scans" in page(card, few)


def test_pages_run_no_script_but_their_own_and_fetch_nothing():
    plain, scripted = document(EVIL, "", ""), document("", "", "", "let a = 1;", "[]", "data: blob:")
    assert re.findall(POLICY, plain) == ["default-src 'none'; style-src 'unsafe-inline'"]
    assert EVIL not in plain
    digest = "xY6QKfH9PRsQnLz56nj6MBwiK5oHg+im1Jkpdp1x/Ck="
    policy = f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    assert re.findall(POLICY, scripted) == [policy]
    assert scripted.count("<script") == 2
