"""The verdict on scores: what it counts, which metrics it sets apart, and what it says of odd values."""

from dataclasses import replace

import pytest

from lidargrit.cli import main
from lidargrit.core.errors import DataError
from lidargrit.core.files import read_json, write_json
from lidargrit.evaluation.intervals import Interval, RealAgainstReal, Score
from lidargrit.evaluation.scorecard import EvalSetRecord, Scorecard
from lidargrit.evaluation.tables import side_by_side
from lidargrit.evaluation.verdict import counted_first, verdict
from lidargrit.scans.types import MetricResult

FACTS = EvalSetRecord("a", "samples", "", 9, 9, "s 8x8", "spherical, exact", "ab" * 32)


def score(value, real=None, pixels=None, *, noise=0.1, metric="bev_jsd", higher=False, variant="exact"):
    result = MetricResult(metric, value, higher, 9, 9, variant)
    interval = Interval(value - noise, value + noise, noise / 2, 20, value) if noise else None
    among_real = None if real is None else RealAgainstReal(real, 9, 5, noise / 2)
    return Score(result, interval, among_real, pixel_statistics=pixels)


def card(*scores):
    return Scorecard("exact", {}, FACTS, FACTS, scores)


def test_it_counts_scores_between_their_bounds():
    scores = [score(0.5, 0.1, 0.9), score(0.15, 0.1, 0.9, metric="bev_mmd"), score(0.85, 0.1, 0.9, metric="coverage")]
    assert verdict(scores) == (
        "Better than pixel statistics in 2 of 3 scores; within noise of real against real in 1.",
    )
    assert verdict([score(0.5, 0.9, 0.1, higher=True)])[0].startswith("Better than pixel statistics in 1 of 1 scores")


def test_one_bound_alone_is_counted_and_without_any_nothing_is_said():
    assert verdict([score(0.15, 0.1)]) == ("Within noise of real against real in 1 of 1 scores.",)
    assert verdict([score(0.15, None, 0.9)]) == ("Better than pixel statistics in 1 of 1 scores.",)
    assert verdict([score(0.15)]) == ()
    assert verdict([score(0.15, 0.1, 0.9, noise=0)]) == ()  # nothing is known of halves without an interval


def test_metrics_that_do_not_see_pixel_statistics_are_set_apart_last_in_the_table():
    blind, sees = score(0.3, 0.1, 0.15), score(0.5, 0.1, 0.9, metric="bev_mmd")
    assert counted_first([blind, sees]) == ([sees], [blind])
    words = verdict([blind, sees])
    assert words[0].startswith("Better than pixel statistics in 1 of 1 scores")
    assert words[1] == ("Set apart, and not counted: bev_jsd. Here it does not tell pixel statistics from real scans.")
    lines = card(blind, sees).as_table().splitlines()
    assert lines[:2] == list(words)
    assert [line.split()[0] for line in lines[4:]] == ["bev_mmd", "set", "bev_jsd"]
    assert lines[4].split()[-6:] == ["(n=9)", "0.9000", "lower", "9", "v", "9"]


def test_a_noisy_model_is_not_excused_from_a_metric():
    """Noise of the model itself says nothing of what the metric can tell."""
    noisy = replace(score(0.9, 0.1, 0.5), interval=Interval(0.1, 1.7, 0.4, 20))
    assert counted_first([noisy]) == ([noisy], [])


def test_files_of_before_are_judged_by_the_interval():
    old = replace(score(0.9, 0.1, 0.15), real_against_real=RealAgainstReal(0.1, 9, 5))
    assert counted_first([old]) == ([], [old])


def test_values_below_zero_and_better_than_real_are_explained():
    words = " ".join(verdict([score(-0.01, 0.0, 0.9, metric="bev_mmd"), score(0.1, 0.5, 0.9)]))
    assert "bev_mmd below 0: the unbiased estimate" in words
    assert "Better than real against real: bev_jsd." in words
    assert words.endswith("or they vary less than real ones.")
    both = [score(-0.01, 0.0, variant="exact"), score(-0.01, 0.0, variant="r2dm")]
    assert "bev_jsd (exact), bev_jsd (r2dm) below 0" in " ".join(verdict(both))


def test_halves_are_compared_with_halves():
    """A score of whole sets is better than that of halves, so it would seem like real too often."""
    of_halves = replace(score(0.15, 0.1, 0.25), interval=Interval(0.1, 0.2, 0.025, 20, mean_of_halves=0.3))
    assert verdict([of_halves]) == (
        "Better than pixel statistics in 0 of 1 scores; within noise of real against real in 0.",
    )
    of_before = replace(of_halves, interval=Interval(0.1, 0.2, 0.025, 20))
    assert verdict([of_before]) == ()  # files of before lack it, and whole sets are no substitute


def test_a_table_takes_pixel_statistics_from_their_own_row(tmp_path):
    files = {"marginal": card(score(0.9, 0.1)), "memorised": card(score(0.1, 0.1)), "mine": card(score(0.5, 0.1))}
    paths = []
    for name, one in files.items():
        paths.append(tmp_path / f"{name}.json")
        write_json(paths[-1], one.to_json())
    table = side_by_side(paths)
    assert table.splitlines()[1] == (
        "mine: Better than pixel statistics in 1 of 1 scores; within noise of real against real in 0."
    )
    assert "marginal (pixel statistics)" in table
    assert "memorised (memorised training scans)" in table
    assert "mine: Better" in side_by_side(paths, "markdown")
    assert side_by_side(paths, "latex").splitlines()[1].startswith("% mine: Better")


def test_both_bounds_are_read_as_they_were_written(tmp_path):
    data = card(score(0.5, 0.1, 0.9), score(0.5)).to_json()
    write_json(tmp_path / "scores.json", data)
    found = Scorecard.read(tmp_path / "scores.json").scores
    assert [(each.real_against_real, each.pixel_statistics) for each in found] == [
        (RealAgainstReal(0.1, 9, 5, 0.05), 0.9),
        (None, None),
    ]
    del data["scores"][0]["real_against_real"]
    write_json(tmp_path / "without.json", data)
    with pytest.raises(DataError, match=r"without\.json"):
        Scorecard.read(tmp_path / "without.json")


def test_the_command_scores_pixel_statistics_where_they_are_wanted(tmp_path, capsys):
    words = ["evaluate", "simulated:4:val", "simulated:4:test", "--metrics", "bev_jsd", "--variant", "exact"]
    assert main([*words, "--pixel-statistics", "--json", str(tmp_path / "s.json")]) == 0
    assert "pixel statistics" in capsys.readouterr().out.splitlines()[0].lower()
    found = read_json(tmp_path / "s.json")
    assert found["scores"][0]["pixel_statistics"] > 0
    assert found["verdict"]
