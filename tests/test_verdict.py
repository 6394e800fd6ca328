"""The verdict on scores: what it counts and what it never praises, in the same words wherever it is told."""

import html
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from lidargrit.cli import main
from lidargrit.core.errors import DataError
from lidargrit.core.files import read_json, write_json
from lidargrit.core.table import render
from lidargrit.evaluation.intervals import Interval, RealAgainstReal, Score, around
from lidargrit.evaluation.metrics import MetricResult, load_metric
from lidargrit.evaluation.scorecard import EvalSetRecord, LeftOut, Scorecard
from lidargrit.evaluation.tables import compare_systems, judge, share_pixel_statistics, side_by_side
from lidargrit.evaluation.verdict import ENOUGH, _measured, blind_to, notes_on_floors, tells_apart, verdict
from lidargrit.publishing.card import _scores
from lidargrit.viewer.report_charts import score_table
from lidargrit.viewer.table_page import table_page

FACTS = EvalSetRecord("a", "samples", "", 200, 200, "s 8x8", "spherical, exact", "ab" * 32)
FEW = replace(FACTS, scans=9, scans_used=9)
UNSCORED = "Pixel statistics, which any model has to beat, were not scored, so that no good score is counted"


def score(value, real=None, pixels=None, *, noise=0.1, metric="bev_jsd", higher=False, variant="exact"):
    result = MetricResult(metric, value, higher, 9, 9, variant)
    interval = Interval(value - noise, value + noise, noise / 2, 20, value) if noise else None
    among_real = None if real is None else RealAgainstReal(real, 9, 5, noise / 2)
    return Score(result, interval, among_real, pixel_statistics=pixels)


def card(*scores, facts=FACTS, **more):
    return Scorecard("exact", {}, facts, facts, scores, **more)


def said(*scores, **more):
    return verdict(scores, 200, **more).sentences


@pytest.fixture(autouse=True)
def every_metric_sees_objects(monkeypatch):
    unseen = {"coverage": ("boxes",)}
    monkeypatch.setattr("lidargrit.evaluation.verdict.blind_to", lambda metric, *_: unseen.get(metric, ()))


def test_a_metric_that_would_not_have_seen_damaged_objects_is_not_within_noise():
    real, note = said(score(0.15, 0.1, 0.9), score(0.1, 0.1, 0.9, metric="coverage"))[1:]
    assert real == (
        "Against real scans: worse in 0 of 2 scores, within noise in 1 (bev_jsd), undecided in 1 (coverage)."
    )
    assert note == (
        "With 200 scans, coverage cannot see at least one of these: blurred ranges, missing vehicles, boxes in place "
        "of vehicles. So a good score there is not called within noise."
    )
    convicted = said(score(0.85, 0.1, 0.9, metric="coverage"))
    assert convicted[1].startswith("Against real scans: worse in 1 of 1 scores")
    assert not any("cannot see" in sentence for sentence in convicted)


def test_a_damage_that_was_seen_with_fewer_scans_is_seen_with_more(monkeypatch):
    rows = [
        {"metric": "m", "variant": "v", "damage": damage, "scans": scans, "deviations": deviations}
        for damage, scans, deviations in [
            ("blur", "300", "9.0"),
            ("blur", "100", "2.0"),
            ("boxes", "100", "3.1"),
            ("boxes", "300", "1.0"),
            ("gone", "100", "0.1"),
            ("gone", "300", "2.8"),
        ]
    ]
    monkeypatch.undo()
    monkeypatch.setattr("lidargrit.evaluation.verdict._rows", lambda: iter(rows))
    _measured.cache_clear()
    assert blind_to("m", "v", 299) == ("blur", "gone")
    assert blind_to("m", "v", 300) == ("gone",)
    assert blind_to("m", "v", 99) == ("blur", "boxes", "gone")
    assert blind_to("m", "other", 300) is None
    monkeypatch.undo()
    _measured.cache_clear()


def test_every_measured_metric_has_every_damage_and_is_one_of_the_program(monkeypatch):
    monkeypatch.undo()
    measured = _measured()
    damages = {tuple(sorted(each)) for each in measured.values()}
    assert len(damages) == 1
    assert len(damages.pop()) == 3
    for metric, variant in measured:
        assert variant in load_metric(metric).variants
    assert "ranges blurred over 3 columns" not in blind_to("object_statistics", "segmented", 100)
    assert len(blind_to("bev_jsd", "exact", 100)) == 3


def test_all_scores_are_counted_and_losses_come_first():
    scores = [
        score(1.5, 0.1, 0.9),
        score(0.15, 0.1, 0.9, metric="bev_mmd"),
        score(0.85, 0.1, 0.9, metric="coverage"),
        score(0.1, 0.9, 0.5, metric="bev_occupancy", higher=True),
    ]
    assert said(*scores, left_out=[("drop_run_lengths", "exact")]) == (
        "Against pixel statistics: worse in 2 of 5 scores (bev_jsd, bev_occupancy), better in 1 (bev_mmd), "
        "undecided in 2 (coverage, drop_run_lengths).",
        "Against real scans: worse in 3 of 5 scores (bev_jsd, coverage, bev_occupancy), within noise in 1 (bev_mmd), "
        "undecided in 1 (drop_run_lengths).",
        "Not scored, so undecided: drop_run_lengths.",
    )


def test_a_metric_that_cannot_praise_can_convict():
    """Pixel statistics score .12, real scans .1: this metric sees no shape."""
    good, bad = score(0.05, 0.1, 0.12), score(0.5, 0.1, 0.12)
    assert tells_apart(good) is False
    pixels, real, why = said(good)
    assert pixels == "Against pixel statistics: worse in 0 of 1 scores, better in 0, undecided in 1 (bev_jsd)."
    assert real == "Against real scans: worse in 0 of 1 scores, within noise in 0, undecided in 1 (bev_jsd)."
    assert why == "Pixel statistics pass for real scans in bev_jsd: no good score there is counted."
    pixels, real, _ = said(bad)
    assert pixels.startswith("Against pixel statistics: worse in 1 of 1 scores (bev_jsd)")
    assert real.startswith("Against real scans: worse in 1 of 1 scores (bev_jsd)")


def test_what_stands_there_is_told_first():
    """Of a model whose poles are gone although every other score is good; also of scans that are too few."""
    numbers = {
        which: {kind: {"number_a_scan": number} for kind, number in zip(("vehicle", "pole"), each, strict=True)}
        for which, each in {"generated": (4.0, 0.5), "real": (4.25, 4.875)}.items()
    }
    worse = score(0.9, 0.1, 0.8, metric="object_statistics", variant="segmented")
    worse = replace(worse, result=replace(worse.result, details=numbers))
    first, pixels, real = said(score(0.15, 0.1, 0.9), worse)
    assert first == "Objects a scan, samples v reference: vehicle 4.0 v 4.2, pole 0.5 v 4.9."
    assert pixels.startswith("Against pixel statistics: worse in 0 of 2 scores, better in 1 (bev_jsd), undecided in 1")
    assert real == (
        "Against real scans: worse in 1 of 2 scores (object_statistics), within noise in 1 (bev_jsd), undecided in 0."
    )
    both = said(score(1.5, 0.1, 0.9), worse)[2]
    assert both.startswith("Against real scans: worse in 2 of 2 scores, ")
    lost = said(score(1.5, 0.1, 0.9), score(0.15, 0.1, 0.9, metric="bev_mmd"), worse)[2]
    assert lost.startswith("Against real scans: worse in 2 of 3 scores (object_statistics, bev_jsd), ")
    assert verdict([worse], 24).sentences[0] == first


def counted_slowly(scores):
    """Count losses and wins against pixel statistics by the definitions of the documentation, one score at a time."""
    counts = {"worse": 0, "better": 0, "undecided": 0}
    for one in scores:
        sign = -1 if one.result.higher_is_better else 1
        chance = (one.interval.high - one.interval.low) / 2
        by = sign * (one.interval.mean_of_halves - one.pixel_statistics)
        seen = sign * (one.pixel_statistics - one.real_against_real.value)
        if by > chance:
            counts["worse"] += 1
        elif by < -chance and seen > 2.8 * one.real_against_real.spread:
            counts["better"] += 1
        else:
            counts["undecided"] += 1
    return counts


def test_counts_are_those_of_a_slow_count():
    rng = np.random.default_rng(0)
    for higher in (False, True):
        scores = [
            score(
                *rng.uniform(0, 1, 3).tolist(), noise=float(rng.uniform(0.01, 0.4)), metric=f"m{index}", higher=higher
            )
            for index in range(200)
        ]
        pixels = verdict(scores, 200).tallies[0]
        found = {"worse": len(pixels.worse), "better": len(pixels.better), "undecided": len(pixels.undecided)}
        assert found == counted_slowly(scores)
        assert min(found.values()) > 10


def test_few_scans_give_no_verdict_and_say_why():
    scores = [score(0.5, 0.1, 0.9)]
    assert verdict(scores, ENOUGH - 1).sentences == (
        "No verdict: 99 scans in each set are too few for reliable scores and intervals, which take 100 or more.",
    )
    assert len(verdict(scores, ENOUGH).tallies) == 2
    few = card(*scores, facts=FEW).as_table().splitlines()
    assert few[0].startswith("No verdict: 9 scans")
    assert "0.5000" in few[-1], "the figures are there"


def test_a_good_score_does_not_count_where_pixel_statistics_are_not_known():
    real, why = said(score(0.15, 0.1))
    assert real == "Against real scans: worse in 0 of 1 scores, within noise in 0, undecided in 1 (bev_jsd)."
    assert why.startswith(UNSCORED)
    (pixels,) = said(score(0.15, None, 0.9))
    assert pixels == "Against pixel statistics: worse in 0 of 1 scores, better in 0, undecided in 1 (bev_jsd)."
    for unknown in (score(0.15), score(0.15, 0.1, 0.9, noise=0)):  # nothing is known of halves without an interval
        assert said(unknown)[0].startswith("No verdict: it takes intervals")


def test_scans_that_the_model_knew_are_said_with_and_without_a_verdict():
    leak = "The reference is of the training scans"
    for scans in (9, 200):
        assert "The reference is of the training scans." in verdict([score(0.5, 0.1, 0.9)], scans, (), leak).sentences


def test_a_noisy_model_is_not_excused_from_a_metric():
    """Noise of the model itself says nothing of what the metric can tell."""
    noisy = replace(score(0.9, 0.1, 0.5), interval=Interval(0.1, 1.7, 0.4, 20))
    assert tells_apart(noisy) is True


def test_files_of_before_are_judged_by_the_interval():
    assert tells_apart(replace(score(0.9, 0.1, 0.15), real_against_real=RealAgainstReal(0.1, 9, 5))) is False


def test_values_below_zero_and_better_than_real_are_explained():
    words = " ".join(said(score(-0.01, 0.0, 0.9, metric="bev_mmd"), score(0.1, 0.5, 0.9)))
    assert "bev_mmd below 0: the unbiased estimate" in words
    assert "Better than real against real: bev_jsd." in words
    assert "or they vary less than real ones." in words
    both = [score(-0.01, 0.0, variant="exact"), score(-0.01, 0.0, variant="r2dm")]
    assert "bev_jsd (exact), bev_jsd (r2dm) below 0" in " ".join(said(*both))


def test_equal_sets_that_do_not_score_0_have_their_floor_beside_them(tmp_path):
    variants = [score(0.05, 0.06, metric="sliced_wasserstein", variant=each) for each in ("reference", "textbook")]
    words = notes_on_floors(variants)
    assert words[0].startswith("sliced_wasserstein (reference) is not 0 for equal sets: patches of the two sets")
    assert words[1].startswith("sliced_wasserstein (textbook) is not 0 for equal sets: ")
    assert all(each.endswith("; its floor, real against real, is 0.0600 between 9 scans") for each in words)
    (unknown,) = notes_on_floors([score(0.05, metric="sliced_wasserstein", variant="textbook")])
    assert unknown.endswith("is not known here")
    told = card(*variants)
    write_json(tmp_path / "a.json", told.to_json())
    beside = render(side_by_side([tmp_path / "a.json"]))
    places = (told.as_table(), beside, score_table(told), _scores(told).replace("\\", ""))
    page = table_page([{"system": "a", "costs": {}, "scores": read_json(tmp_path / "a.json")}], 0.0)
    assert [words[1] in text for text in (*places, page)] == [True] * 5


def test_halves_are_compared_with_halves():
    """A score of whole sets is better than that of halves, so it would seem like real too often."""
    of_halves = replace(score(0.15, 0.1, 0.25), interval=Interval(0.1, 0.2, 0.025, 20, mean_of_halves=0.31))
    pixels, real = said(of_halves)
    assert "worse in 1 of 1" in pixels
    assert "worse in 1 of 1" in real
    of_before = replace(of_halves, interval=Interval(0.1, 0.2, 0.025, 20))
    assert said(of_before)[0].startswith("No verdict"), "files of before lack it, and whole sets are no substitute"


def halved(rng, values, common, metric="bev_jsd"):
    """Return a score whose half-samples share the chance of the reference with those of another system."""
    halves = [float(value) for value in values + common + rng.normal(0, 0.01, 20)]
    interval = around(float(np.mean(halves)), halves, 16, (-math.inf, math.inf))
    return Score(MetricResult(metric, float(np.mean(halves)), False, 200, 200, "exact"), interval)


def test_differences_have_the_interval_of_paired_halves():
    rng = np.random.default_rng(1)
    common = rng.normal(0, 0.3, 20)
    ours, theirs = card(halved(rng, 0.9, common)), card(halved(rng, 1.0, common))
    found = compare_systems("b", ours, "a", theirs)
    (difference,) = found.differences.values()
    first, second = (each.scores[0].interval.values for each in (ours, theirs))
    halves = [one - other for one, other in zip(first, second, strict=True)]
    mean = sum(halves) / 20
    error = math.sqrt(sum((one - mean) ** 2 for one in halves) / 19)
    reach = student.ppf(0.975, 15) * error
    assert [difference.low, difference.high] == pytest.approx([difference.value - reach, difference.value + reach])
    assert found.verdict.sentences == (
        "Is b better than a? Yes: worse in 0 of 1 scores, better in 1 (bev_jsd), undecided in 0.",
    )
    widths = [each.scores[0].interval.high - each.scores[0].interval.low for each in (ours, theirs)]
    assert min(widths) > 10 * (difference.high - difference.low), "the reference's chance is common to both"


def test_the_answer_has_losses_wins_and_both():
    rng = np.random.default_rng(2)

    def system(*values, facts=FACTS):
        return card(*(halved(rng, value, 0, f"m{index}") for index, value in enumerate(values)), facts=facts)

    def answer(ours, theirs=None):
        (sentence,) = compare_systems("b", ours, "a", theirs or system(1.0, 1.0)).verdict.sentences
        return sentence.removeprefix("Is b better than a? ")

    assert answer(system(2.0, 0.5)) == "In part: worse in 1 of 2 scores (m0), better in 1 (m1), undecided in 0."
    assert answer(system(2.0, 1.0)) == "No: worse in 1 of 2 scores (m0), better in 0, undecided in 1 (m1)."
    assert answer(system(1.0, 1.0)) == "Undecided: worse in 0 of 2 scores, better in 0, undecided in 2."
    assert answer(system(0.5)) == "Yes: worse in 0 of 2 scores, better in 1 (m0), undecided in 1 (m1)."
    assert answer(system(0.5, facts=FEW)).startswith("No verdict: 9 scans")
    others = replace(system(0.5, 0.5), settings={"seed": 1})
    assert answer(others).startswith("No verdict: without half-samples that both have in common")
    for foreign in ({"groups": 0}, {"groups": "many"}, {}):
        strange = [replace(system(0.5), settings={"resampling": foreign}) for _ in range(2)]
        assert answer(*strange).startswith("No verdict: without half-samples")


def test_equal_systems_seldom_differ_in_any_score():
    """Of 300 pairs of equal systems with seven scores each, about 5 % may differ in any; 30 % would, one by one."""
    rng = np.random.default_rng(3)
    differ = 0
    for _ in range(300):
        cards = []
        for _ in range(2):
            scores = []
            for index in range(7):
                scans = rng.normal(1, 0.2, 160).reshape(16, 10)
                halves = [float(scans[rng.permutation(16)[:8]].mean()) for _ in range(20)]
                result = MetricResult(f"m{index}", float(scans.mean()), False, 160, 160, "exact")
                scores.append(Score(result, around(result.value, halves, 16, (0.0, math.inf))))
            cards.append(card(*scores))
        (tally,) = compare_systems("b", cards[0], "a", cards[1]).verdict.tallies
        differ += bool(tally.worse or tally.better)
    assert differ / 300 < 0.09


def written(folder, files):
    paths = []
    for name, one in files.items():
        paths.append(folder / f"{name}.json")
        write_json(paths[-1], one.to_json())
    return paths


def test_terminal_page_and_card_tell_the_same(tmp_path):
    """`compare` said "4 of 4" in the terminal, which knew the row of pixel statistics, and "7 of 7" on its page."""
    rng = np.random.default_rng(4)
    seen = [replace(score(0.5, 0.1), interval=halved(rng, 0.5, 0).interval), score(0.12, 0.1, metric="bev_mmd")]
    files = {
        "mine": card(*seen, left_out=(LeftOut("coverage", "exact", "no weights"),)),
        "theirs": card(*seen),
        "marginal": card(score(0.9, 0.1), score(0.13, 0.1, metric="bev_mmd")),
        "memorised": card(score(0.1, 0.1)),
    }
    paths = written(tmp_path, files)
    terminal = render(side_by_side(paths)).splitlines()
    share_pixel_statistics(paths)
    cells = [{"system": path.stem, "costs": {}, "scores": read_json(path)} for path in paths]
    page = html.unescape(re.sub("<[^>]+>", "\n", table_page(cells, 0.0))).splitlines()
    lines = [line for line in terminal if line.startswith(("mine: Against", "theirs: Against", "Is "))]
    assert len(lines) == 3
    assert "worse in 0 of 3 scores, better in 1 (bev_jsd), undecided in 2 (bev_mmd, coverage)" in lines[0]
    assert [line for line in page if line.startswith(("mine: Against", "theirs: Against", "Is "))] == lines
    mine = Scorecard.read(paths[0])
    assert lines[0] == f"mine: {' '.join(mine.verdict.sentences)}"
    assert lines[0] == f"mine: {' '.join(read_json(paths[0])['verdict'])}"
    told = {
        "terminal": mine.as_table(),
        "card": re.sub(r"\\(.)", r"\1", html.unescape(_scores(mine))),
        "report": html.unescape(score_table(mine)),
    }
    for place, text in told.items():
        assert all(sentence in text for sentence in mine.verdict.sentences), place
    markdown, latex = (render(side_by_side(paths), form) for form in ("markdown", "latex"))
    assert "- mine: Against pixel statistics: worse" in markdown
    assert latex.splitlines()[1].startswith("% mine: Against pixel statistics: worse")


def test_a_table_names_the_bounds_and_compares_none_of_them(tmp_path):
    files = {"marginal": card(score(0.9, 0.1)), "memorised": card(score(0.1, 0.1)), "mine": card(score(0.5, 0.1))}
    table = render(side_by_side(written(tmp_path, files)))
    assert table.splitlines()[1].startswith("mine: Against pixel statistics: worse in 0 of 1 scores, better in 1")
    assert "marginal (pixel statistics)" in table
    assert "memorised (memorised training scans)" in table
    assert "Is m" not in table
    assert judge(list(files.items())).differences == ()


def test_bounds_and_halves_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(5)
    one = card(score(0.5, 0.1, 0.9), score(0.5), halved(rng, 0.5, 0), leak="both have scans of 00")
    data = json.loads(json.dumps(one.to_json()))
    write_json(tmp_path / "scores.json", data)
    found = Scorecard.read(tmp_path / "scores.json")
    assert found.scores == one.scores
    assert found.leak == one.leak
    del data["scores"][0]["real_against_real"]
    write_json(tmp_path / "without.json", data)
    with pytest.raises(DataError, match=r"without\.json"):
        Scorecard.read(tmp_path / "without.json")


def test_the_command_scores_pixel_statistics_where_they_are_wanted(tmp_path, capsys):
    words = ["evaluate", "simulated:4:val", "simulated:4:test", "--metrics", "bev_jsd", "--variant", "exact"]
    assert main([*words, "--pixel-statistics", "--json", str(tmp_path / "s.json")]) == 0
    verdict_line, _, head, *_ = capsys.readouterr().out.splitlines()
    assert verdict_line.startswith("No verdict: 4 scans in each set")
    assert "pixel statistics" in head
    found = read_json(tmp_path / "s.json")
    assert found["scores"][0]["pixel_statistics"] > 0
    assert found["verdict"] == [verdict_line]
