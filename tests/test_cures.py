"""What a message tells to type: every verb that reads scans takes each option that its messages name, and guesses."""

import ast
import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import lidargrit
from lidargrit.cli import build_parser, main
from lidargrit.data.sources import open_source
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate

VERBS = {  # verb → the words of a command on the scans in IN
    "compare": ["OUT", "marginal", "--reference", "IN", "-n", "2", "--set", "data.train=IN", "data.val=IN"],
    "complete": ["IN/0.bin", "OUT", "--model", "linear"],
    "compress": ["IN", "OUT.lgz"],
    "demo": ["--data", "IN", "--out", "OUT"],
    "evaluate": ["IN", "IN", "--intervals", "0"],
    "export": ["IN", "OUT"],
    "fine-tune": ["IN", "OUT"],
    "fit-sensor": ["IN", "-o", "OUT.json"],
    "inspect": ["IN"],
    "likelihood": ["IN"],
    "prepare": ["IN", "-o", "OUT", "--workers", "1"],
    "raydrop": ["IN", "OUT"],
    "rescan": ["IN", "OUT", "--to", "vlp16"],
    "segment": ["IN", "OUT"],
    "train": ["marginal", "OUT", "--set", "data.train=IN", "data.val=IN"],
    "upsample": ["IN", "OUT"],
    "view": ["IN", "-o", "OUT.png"],
}
FAULTS = ("not_finite", "shuffled_by_ring", "few_rings", "narrow")
PARSERS = {parser.prog.split()[1]: parser for parser in build_parser().verbs()}
CHEAP = ("export", "fit-sensor", "inspect", "prepare", "rescan", "view")  # whose cures are tried, too


@cache
def points(sensor: str, seed: int = 0) -> np.ndarray:
    scan = simulate(seed=seed, sensor=load_sensor(sensor).with_columns(900))
    assert scan.reflectance is not None
    return np.concatenate([scan.points_xyz_m.numpy(), scan.reflectance.numpy()[:, None]], 1).astype("<f4")


@pytest.fixture(scope="module")
def scans(tmp_path_factory) -> Path:
    """Folders of scans, each with one fault: of a number, of the order, of the sensor, or of the field of view."""
    root = tmp_path_factory.mktemp("faulty")
    for fault in FAULTS:
        (root / fault).mkdir()
        for index in range(2):
            rows = points("vlp16" if fault == "few_rings" else "hdl64e_kitti_odometry", index)
            if fault == "not_finite":
                rows = rows.copy()
                rows[5, 0] = np.nan
            if fault == "shuffled_by_ring":
                rows = rows[np.random.default_rng(index).permutation(len(rows))]
            if fault == "narrow":
                rows = rows[np.abs(np.arctan2(rows[:, 1], rows[:, 0])) < 0.7]
            (root / fault / f"{index}.bin").write_bytes(rows.tobytes())
    return root


@pytest.mark.parametrize("sensor", ["vlp16", "hdl64e_kitti_odometry"])
def test_the_sensor_of_files_that_name_none_is_guessed_and_told(sensor, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "0.bin").write_bytes(points(sensor).tobytes())
    assert open_source(str(tmp_path / "in")).sensor_name == sensor
    told = f"no sensor is named, so {sensor} is taken, which looks closest; --sensor names another"
    out = str(tmp_path / "out")
    for number, words in enumerate(
        (["prepare", "-o", out], ["view", "-o", f"{out}.png"], ["rescan", f"{out}_seen", "--to", sensor])
    ):
        assert main([words[0], str(tmp_path / "in"), *words[1:]]) == 0
        assert capsys.readouterr().err.count(told) == 1, words
        assert main([words[0], str(tmp_path / "in"), *words[1:], "--sensor", "no_such_sensor"]) == 2, number
        assert told not in capsys.readouterr().err


def words_of(verb: str, folder: Path, tmp_path: Path) -> list[str]:
    words = [verb, *VERBS[verb]]
    return [word.replace("OUT", str(tmp_path / "out")).replace("IN", str(folder)) for word in words]


def options_named(message: str, verb: str) -> list[tuple[str, str]]:
    """Return each option that a message tells to type, with the verb that it is for."""
    found = []
    for part in re.split(r"[,;()]| or (?=leave|name|take)", message):  # a command ends where the sentence goes on
        other = re.search(r"lidargrit ([a-z][a-z-]+)", part)
        of = other[1] if other and other[1] in PARSERS else verb
        found += [(of, option) for option in re.findall(r"(?<![\w-])--[a-z][a-z-]+", part)]
        if "data." in part:
            found.append((of, "--set"))
    return found


def test_every_verb_that_reads_scans_is_here():
    reading = {verb for verb, parser in PARSERS.items() if "--bad-scans" in parser._option_string_actions}
    assert reading == VERBS.keys()
    for verb in reading - {"export", "fit-sensor"}:  # the one projects nothing, the other finds the sensor
        assert {"--sensor", "--projection", "--bad-points", "--set"} <= PARSERS[verb]._option_string_actions.keys()


def test_no_text_of_the_program_names_an_option_that_no_verb_has():
    known = {"--version", "--print-completion", "--no-python", "--nproc-per-node", "--head"}  # of torchrun, ray
    for parser in PARSERS.values():
        known |= parser._option_string_actions.keys()
    for path in Path(lidargrit.__file__).parent.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        nodes = ast.walk(ast.parse(source)) if "--" in source else ()
        for text in (node.value for node in nodes if isinstance(node, ast.Constant)):
            if isinstance(text, str) and "var(--" not in text and ":root{" not in text:  # of styles
                named = {*re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)}
                assert named <= known, f"{path.name}: {text[:200]}"


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_that_a_message_names_is_taken(verb, scans, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    cut_short = lambda *_args, **_options: pytest.skip("begun to train")  # noqa: E731
    for place in ("training.run.train", "training.train", "viewer.demo.train", "evaluation.compare.train"):
        monkeypatch.setattr(f"lidargrit.{place}", cut_short)
    refused = 0
    for fault in FAULTS:
        words = words_of(verb, scans / fault, tmp_path / fault)
        more = (
            ["--projection", "unfolding"]
            if fault == "shuffled_by_ring" and verb not in ("export", "fit-sensor")
            else []
        )
        code = main([*words, *more])
        message = capsys.readouterr().err
        refused += code == 2
        for of, option in options_named(message, verb):
            assert option in PARSERS[of]._option_string_actions, f"{verb} of {fault}: {of} {option} in {message}"
        if verb in CHEAP and code == 2:
            for cure in re.findall(r"--(?:bad-points|bad-scans|projection) (?:drop|skip|spherical)", message):
                tried = main([*words_of(verb, scans / fault, tmp_path / f"{fault}_{cure}"), *cure.split()])
                assert tried == 0 or message not in capsys.readouterr().err, f"{verb} of {fault} with {cure}"
    assert refused, "no message at all"


@pytest.mark.parametrize("verb", ["fit-sensor", "inspect", "prepare", "view"])
def test_a_scan_without_points_is_not_left_out_by_the_option_that_was_given(verb, scans, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "0.npy", np.zeros((0, 4), np.float32))
    words, skip = words_of(verb, tmp_path / "in", tmp_path), ["--bad-scans", "skip"]
    assert main(words) == 2
    assert capsys.readouterr().err.count(" ".join(skip)) == 1
    assert main([*words, *skip]) == 2
    told = capsys.readouterr().err
    assert "--bad-scans" not in told
    assert re.search("; take another scan$|no usable scan", told, re.MULTILINE)
    (tmp_path / "in" / "1.bin").write_bytes(points("vlp16").tobytes())
    assert main([*words_of(verb, tmp_path / "in", tmp_path / "two"), *skip]) == 0
    output = "".join(capsys.readouterr())
    assert "left out: got no point in " in output
    assert "--bad-scans" not in output


@pytest.mark.parametrize("verb", ["complete", "compress", "likelihood", "raydrop", "segment"])
def test_a_run_refuses_another_sensor_and_other_columns_with_a_cure_that_works(verb, scans, tmp_path, capsys):
    words = words_of(verb, scans / "few_rings", tmp_path)
    if verb == "complete":
        words[words.index("linear")] = "pretrained"
    assert main([*words, "-n", "1", "--set", "data.columns=512"]) == 2
    assert "64x512, for --model pretrained" in capsys.readouterr().err
    assert main([*words, "-n", "1", "--sensor", "vlp16"]) == 2
    message = capsys.readouterr().err
    cure = re.search(r"first: lidargrit (rescan SCANS SEEN --sensor vlp16 --to hdl64e_kitti_odometry)", message)
    assert cure, message
    seen = str(tmp_path / "seen")
    typed = cure[1].replace("SCANS", str(scans / "few_rings")).replace("SEEN", seen)
    assert main(typed.split()) == 0
    assert main([word.replace(str(scans / "few_rings"), seen) for word in (*words, "-n", "1")]) == 0


def test_the_cure_for_a_sensor_of_a_file_names_that_file(scans, tmp_path, capsys):
    mine = tmp_path / "my sensor.json"
    mine.write_text(json.dumps({**load_sensor("vlp16").to_json(), "name": "mine"}))
    assert main(["compress", str(scans / "few_rings"), str(tmp_path / "a.lgz"), "--sensor", str(mine)]) == 2
    told = capsys.readouterr().err
    assert f"rescan SCANS SEEN --sensor '{mine}' --to hdl64e_kitti_odometry" in told
