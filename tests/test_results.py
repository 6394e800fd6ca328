"""Results on standard output and in files: neither is lost for the other, and neither runs what strangers wrote."""

import argparse
import json
from dataclasses import replace

import numpy as np
import pytest

from lidargrit.cli import _results, main
from lidargrit.core.errors import DataError, OutputError
from lidargrit.core.files import write_json
from lidargrit.core.table import render
from lidargrit.evaluation.intervals import Score, around
from lidargrit.evaluation.metrics import MetricResult
from lidargrit.evaluation.tables import side_by_side
from test_verdict import card, score
from tiny_runs import the_one_line


def test_scores_are_printed_where_no_file_can_be_written(monkeypatch, capsys, tmp_path):
    def no_space(*_):
        raise OutputError("a full disk", "space", "make some")

    monkeypatch.setattr(_results, "write_json", no_space)
    words = [
        "evaluate",
        "simulated:2:val",
        "simulated:2:test",
        "--metrics",
        "bev_jsd",
        "--intervals",
        "0",
        "--json",
        str(tmp_path / "a.json"),
    ]
    assert main(words) == 2
    printed = capsys.readouterr()
    assert "bev_jsd" in printed.out
    assert "a full disk" in printed.err


def test_the_file_is_written_though_nobody_reads_the_table(monkeypatch, tmp_path):
    def gone(*_args, **_options):
        raise BrokenPipeError

    monkeypatch.setattr(_results, "print", gone, raising=False)
    options = argparse.Namespace(json=tmp_path / "a.json")
    with pytest.raises(BrokenPipeError):
        _results.print_result(options, "table", {"a": 1})
    assert json.loads(options.json.read_text()) == {"a": 1}


def test_departures_that_are_no_sentences_are_refused_in_one_line(tmp_path):
    for departures in (3, [3], "a sentence"):
        write_json(tmp_path / "theirs.json", replace(card(score(0.5)), about={"departures": departures}).to_json())
        with pytest.raises(DataError, match=r"theirs\.json, which cannot be used"):
            side_by_side([tmp_path / "theirs.json"])


def test_a_foreign_name_reaches_no_terminal_as_code(tmp_path):
    write_json(tmp_path / "theirs.json", card(score(0.5, metric="bev\x1b[31m")).to_json())
    table = render(side_by_side([tmp_path / "theirs.json"]))
    assert "\x1b" not in table
    assert "bev\\x1b[31m" in table


def test_results_that_others_sent_make_a_table_without_scans(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    halves = rng.normal(size=20)
    settings = {"resampling": {"groups": 16, "halves": 20, "seed": 0}, "seed": 0}
    for name, values in {"ours": (0.5, 0.5), "theirs": (0.1, 0.9)}.items():
        scores = (
            halved_as(halves, value, metric) for value, metric in zip(values, ("bev_jsd", "bev_mmd"), strict=True)
        )
        write_json(tmp_path / f"{name}.json", card(*scores, settings=settings).to_json())
    assert main(["compare", "table", "ours.json", "--table", "latex"]) == 0
    assert main(["compare", "table", "--add", "theirs.json", "--table", "latex"]) == 0
    table = capsys.readouterr().out.split("% Differences")[1]
    assert r"system & bev\_mmd (exact) & bev\_jsd (exact) \\" in table, "the loss stands first"
    assert "theirs & 0.4 [0.4, 0.4] & -0.4 [-0.4, -0.4]" in table
    (tmp_path / "theirs.json").unlink()
    assert main(["compare", "table", "--add", "theirs.json"]) == 0, "the table has its own copy"
    ours = (tmp_path / "ours.json").read_text()
    (tmp_path / "bent.json").write_text(ours.replace('"value": 0.5', '"value": 0.4', 1))
    capsys.readouterr()
    assert main(["compare", "table", "--add", "bent.json"]) == 2
    assert "bent.json, which was altered after it was written" in the_one_line(capsys.readouterr().err, "compare")


def halved_as(halves, value, metric):
    """A score whose half-samples scatter as those of every other system, around its own value."""
    result = MetricResult(metric, value, False, 200, 200, "exact")
    return Score(result, around(value, [value + 0.01 * each for each in halves], 16, (0.0, 10.0)))
