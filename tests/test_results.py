"""Results on standard output and in files: neither is lost for the other, and neither runs what strangers wrote."""

import argparse
import json

import pytest

from lidargrit.cli import _results, main
from lidargrit.core.errors import OutputError
from lidargrit.core.files import write_json
from lidargrit.core.table import render
from lidargrit.evaluation.tables import side_by_side
from test_verdict import card, score


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


def test_a_foreign_name_reaches_no_terminal_as_code(tmp_path):
    write_json(tmp_path / "theirs.json", card(score(0.5, metric="bev\x1b[31m")).to_json())
    table = render(side_by_side([tmp_path / "theirs.json"]))
    assert "\x1b" not in table
    assert "bev\\x1b[31m" in table
