"""What is typed, and what programs read: mistakes in the words in one line, JSON on request, completion in shells."""

import json
import shutil
import subprocess

import pytest

from lidargrit.cli import build_parser, main
from lidargrit.core import discovery
from lidargrit.core.errors import LidarGritError, nearest_names

MISTAKES = {
    "simulte": "lidargrit: got 'simulte'; wanted one such as simulate; see: lidargrit --help",
    "--verion": "lidargrit: got the option '--verion'; wanted one such as --version; see: lidargrit --help",
    "train": "got no preset and no out; wanted lidargrit train PRESET OUT; see: lidargrit train --help",
    "simulate here": "got no -n/--count; wanted lidargrit simulate OUT -n COUNT;",
    "sample --cuont 3": "got the option '--cuont'; wanted one such as --count; see: lidargrit sample --help",
    "sample run out more": "got the unexpected argument 'more'; wanted fewer arguments;",
    "sample run out -x": "got the option '-x'; wanted one such as",
    "simulate here -n two": "got -n 'two'; wanted a whole number;",
    "simulate here -n -1": "got -n -1; wanted a whole number from 1 to 10,000,000; correct it",
    "simulate here -n 1 --wet very": "got --wet 'very'; wanted a number;",
    "forecast a next -n 0": "got -n 0; wanted a whole number from 1 to",
    "rescan a low --to vlp16 --raised-m nan": "got --raised-m nan; wanted a number from -10 to 10; correct it",
    "compress a a.lgz --points --step-mm 0": "got --step-mm 0; wanted a whole number from 1 to 1,000; correct it",
    "prepare a --rank 0 --world-size 0": "got --world-size 0; wanted a whole number from 1 to",
    "prepare a --workers 2000": "got --workers 2000; wanted a whole number from 1 to 1,024;",
    "serve --port -1": "got --port -1; wanted a whole number from 0 to 65,535;",
    "serve --seconds nan": "got --seconds nan; wanted a number from 0.001 to 86,400;",
    "compare out a --table pdf": "got --table pdf; wanted text, markdown or latex; choose one",
    "view a -n -1": "got -n -1; wanted a whole number from 1 to 100;",
    "list metric": "wanted one such as metrics; see: lidargrit list --help",
    "sample pretrained drive --path poses.txt": "got --path without --frames; wanted both; add --frames 20, or",
    "demo --set": "got nothing after --set; wanted a value;",
    "evaluate --pr x": "got --pr; wanted --protocol or --projection; write it out",
    "view a --overwrite=3": "got --overwrite with 3; wanted --overwrite alone;",
    "list --json datasets": "got --json datasets; wanted a name in .json, or nothing; put --json last",
    "doctor --json facts.txt": "got --json facts.txt; wanted a name in .json",
    "train lidargrit_demo run --json": "got --json for a training; wanted --dry-run or --measure beside it;",
    "compare out marginal --json out/table.json": "got out/table.json for two files; wanted a name for each;",
    "compare out marginal --json out/marginal/marginal.json": "got out/marginal/marginal.json for two files;",
    "segment simulated:1 out --overwrite --json out/segmented.json": "got out/segmented.json for two files;",
    "evaluate simulated:1:val drives:out:val --json out/samples.json": "got out/samples.json for two files;",
    "prepare simulated:1:val -o out --json out/plan.json": "got out/plan.json for two files; wanted a name for each;",
    "segment simulated:1 out --overwrite": "got --overwrite without a file of --json; wanted --json FILE.json, which",
    "train lidargrit_demo run --overwrite": "got --overwrite without a file of --json; wanted --json FILE.json, which",
    "compare out marginal --overwrite": "got --overwrite without a file of --json; wanted --json FILE.json, which",
    "--print-completion bash doctor": "got --print-completion bash before doctor; wanted one of them; leave doctor out",
    "--print-completion tcsh": "got --print-completion tcsh; wanted bash, zsh or fish; choose one",
    "sample nowhere out --device cuda:99": "got device 'cuda:99'; wanted one that PyTorch finds",
    "evaluate nowhere nowhere --device abacus": "got device 'abacus'; wanted one that PyTorch finds",
    "evaluate nowhere nowhere --variant exakt": "got variant 'exakt'; wanted one such as exact or textbook; choose one",
    "evaluate nowhere nowhere --metrics slicd_wasserstein": "wanted one such as sliced_wasserstein; see all",
    "view .": "got ., which is an empty folder; wanted one with scans in it;",
    "sample nowhere out --device meta": "try cpu",
    "inspect simulated:1 --sensor hdl64": "wanted one such as hdl64e_kitti_360, hdl64e_kitti_odometry or",
}
FACTS = {
    "doctor": "processors",
    "list": "datasets",
    "list datasets": "datasets",
    "train lidargrit_demo nowhere --dry-run": "settings",
    "inspect simulated:1:test": "points",
    "prepare simulated:1:test": "images",
    "fit-sensor simulated:2@vlp16 -n 2": "agree_share",
    "evaluate simulated:2:val simulated:2:test --metrics bev_jsd": "scores",
}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_in_the_words_is_told_in_one_line(words, capsys, tmp_path):
    assert main(words.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("lidargrit")
    assert MISTAKES[words] in captured.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("word", ["", "  "])
def test_a_blank_word_is_neither_the_folder_one_stands_in_nor_left_out(word, capsys):
    assert main(["simulate", word, "-n", "1"]) == 2
    assert f"got out {word!r}; wanted the name of a file or folder;" in capsys.readouterr().err
    for words in ("serve --host", "sample a b --device", "complete a b --sensor", "rescan a b --to", "inspect"):
        assert main([*words.split(), word]) == 2
        name = "scans" if words == "inspect" else words.split()[-1]
        assert f": got {name} {word!r}; wanted a name or a value; write one" in capsys.readouterr().err


def test_what_follows_two_dashes_is_no_option(capsys):
    assert main(["sample", "--", "--run", "--out"]) == 2
    assert "--run, which does not exist" in capsys.readouterr().err


def test_the_metric_that_was_meant_is_named():
    with pytest.raises(ImportError, match="cannot import name 'SlicdWasserstein'"):
        from lidargrit.evaluation.metrics import SlicdWasserstein  # noqa: F401
    import lidargrit.evaluation.metrics

    with pytest.raises(AttributeError, match="did you mean SlicedWasserstein"):
        _ = lidargrit.evaluation.metrics.SlicdWasserstein
    assert nearest_names("swd", ["bev_jsd", "sliced_wasserstein"], 1)


@pytest.mark.parametrize("words", FACTS)
def test_json_is_all_of_standard_output_or_a_file_besides(words, capsys, tmp_path):
    assert main([*words.split(), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert FACTS[words] in printed
    for path in tmp_path.glob("*"):
        path.unlink()  # pictures and sensors are not written twice
    assert main([*words.split(), "--json", "facts.json"]) == 0
    assert not capsys.readouterr().out.startswith("{")
    assert json.loads((tmp_path / "facts.json").read_text()).keys() == printed.keys()
    for path in set(tmp_path.glob("*")) - {tmp_path / "facts.json"}:
        path.unlink()
    assert main([*words.split(), "--json", "facts.json"]) == 2
    assert "facts.json, which is there already" in capsys.readouterr().err


def test_every_verb_that_reports_knows_json():
    silent = {"complete", "demo", "export", "forecast", "import-weights", "publish", "raydrop", "sample", "serve"}
    silent |= {"compress", "decompress", "fine-tune", "rescan", "simulate", "upsample", "view"}
    parsers = {parser.prog.split()[1]: parser for parser in build_parser().verbs()}
    assert parsers.keys() == {name.replace("_", "-") for name in discovery.names("cli")}
    assert {name for name, parser in parsers.items() if "--json" not in parser.format_help()} <= silent


def test_help_tells_the_exit_codes(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    assert stopped.value.code == 0
    output = capsys.readouterr().out
    assert all(f"{code} " in output.partition("exit codes:")[2] for code in (0, 1, 2, 130, 143))


def test_usage_shows_which_words_may_be_left_out():
    usage = {parser.prog.split()[1]: parser.usage for parser in build_parser().verbs()}
    assert usage["serve"] == "lidargrit serve [RUN ...] [OPTION ...]"
    assert usage["list"] == "lidargrit list [KIND] [OPTION ...]"
    assert usage["view"] == "lidargrit view SCANS ... [OPTION ...]"


def test_help_of_every_verb_fits_a_page(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = {parser.prog: len(parser.format_help().splitlines()) for parser in build_parser().verbs()}
    assert not {verb: count for verb, count in lines.items() if count > 50}


def test_a_traceback_is_shown_on_request_before_the_verb_or_behind_it(capsys):
    for words in (["--debug", "export", "nowhere", "out"], ["export", "nowhere", "out", "--debug"]):
        with pytest.raises(LidarGritError, match="nowhere"):
            main(words)
    assert main(["export", "nowhere", "out"]) == 2


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_learns_all_verbs_and_what_may_follow(shell, capsys, tmp_path):
    assert main(["--print-completion", shell]) == 0
    script = tmp_path / "script"
    script.write_text(capsys.readouterr().out)
    for word in (*discovery.names("cli"), *discovery.names("presets"), "lidargrit-kitti-360", "dry-run"):
        assert word in script.read_text() or word.replace("_", "-") in script.read_text()
    assert "prepare___workers_COMPGEN" not in script.read_text(), "no file stands where a number does"
    if shutil.which(shell):
        subprocess.run([shell, "-n", str(script)], check=True)


@pytest.mark.skipif(not shutil.which("bash"), reason="needs bash")
def test_bash_completes(capsys, tmp_path):
    assert main(["--print-completion", "bash"]) == 0
    (tmp_path / "script").write_text(capsys.readouterr().out)
    for words, offered in (
        ("tra", "train"),
        ("list met", "metrics"),
        ("train lidargrit_fine_s", "lidargrit_fine_small"),
        ("train --dr", "--dry-run"),
    ):
        typed = (
            f"COMP_WORDS=(lidargrit {words}); COMP_CWORD={len(words.split())}; _shtab_lidargrit; echo ${{COMPREPLY[@]}}"
        )
        done = subprocess.run(["bash", "-c", f"source ./script; {typed}"], capture_output=True, text=True, check=True)
        assert done.stdout.split() == [offered]
