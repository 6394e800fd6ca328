"""What the tests of wrong input share: tiny runs, samples and scans, and a command that must be refused."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from dataset_examples import write_example
from lidargrit.cli import main
from tiny_runs import contents, the_one_line, train_words


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> dict[str, Path]:
    """Return finished runs that differ in their sizes."""
    root = tmp_path_factory.mktemp("runs")
    changes = {"run": [], "wider": ["model.tokenizer.channels=64"], "deeper": ["model.transformer.layers=2"]}
    for name, settings in changes.items():
        assert main(train_words(root / name, *settings)) == 0
    assert main(["sample", str(root / "run"), str(root / "samples"), "-n", "2"]) == 0
    return {name: root / name for name in (*changes, "samples")}


@pytest.fixture
def run_folder(finished, tmp_path) -> Path:
    """Return a copy of a finished run, to be damaged."""
    return shutil.copytree(finished["run"], tmp_path / "run")


@pytest.fixture
def samples(finished, tmp_path) -> Path:
    return shutil.copytree(finished["samples"], tmp_path / "samples")


@pytest.fixture(scope="session")
def rows(tmp_path_factory) -> np.ndarray:
    """Return the rows of a good scan."""
    folder = tmp_path_factory.mktemp("good")
    write_example("folder", folder, 1)
    return np.fromfile(folder / "000000.bin", dtype="<f4").reshape(-1, 4)


@pytest.fixture
def refused(capsys, tmp_path, monkeypatch):
    """Return a function that runs a command, which must be refused and change nothing, and returns the one line."""
    monkeypatch.setattr("lidargrit.viewer.demo.measure", lambda _preset: [])  # seconds, for an estimate

    def run(*words: object) -> str:
        capsys.readouterr()
        before = contents(tmp_path)
        assert main([str(word) for word in words]) == 2
        captured = capsys.readouterr()
        after = contents(tmp_path)
        assert {name: after.get(name) for name in before} == before, "what was there is not there any more"
        assert after.keys() == before.keys(), "something was left behind"
        assert captured.out == ""
        return the_one_line(captured.err, str(words[0]))

    return run
