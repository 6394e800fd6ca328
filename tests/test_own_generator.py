"""The page on a generator of one's own: its file is trained, sampled and compared without a preset."""

import inspect
import json
import re
import shutil
from pathlib import Path

import pytest

import lidargrit.generation.presets
import lidargrit.systems
import test_generator_contract as contract
from lidargrit.cli import main
from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, UnknownNameError
from lidargrit.generation.generator import load
from lidargrit.generation.presets import default_preset, load_preset

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/how-to/own-generator.md").read_text(encoding="utf-8")
CONTRACT = [name for name in dir(contract) if name.startswith("test_")]
QUICK = ["data.train=[simulated:2:train]", "data.val=[simulated:2:val]", "data.workers=1"]


@pytest.fixture
def code(tmp_path, monkeypatch):
    """Add a folder to the generators in which the page's file lies, and return the path of the file."""
    folder, find = tmp_path / "systems", discovery._packages
    shutil.copytree(lidargrit.systems.__path__[0], folder, ignore=shutil.ignore_patterns("__pycache__"))
    systems = {lidargrit.systems.__name__: folder}
    monkeypatch.setattr(discovery, "_packages", lambda kind: systems if kind == "generators" else find(kind))
    monkeypatch.setattr(lidargrit.systems, "__path__", [*lidargrit.systems.__path__, str(folder)])
    path = folder / "mean_street" / "system.py"
    path.parent.mkdir()
    path.write_text(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0], encoding="utf-8")
    return path


def test_the_file_of_the_page_is_compared_without_a_preset(code, tmp_path, capsys, monkeypatch):
    lines = [line for line in code.read_text().splitlines() if line and not line.startswith(("import", "from", '"""'))]
    assert len(lines) < 40
    monkeypatch.setattr(lidargrit.generation.presets, "_SCANS", 8)
    words = [
        "compare",
        str(tmp_path / "table"),
        "marginal",
        "mean_street",
        "--reference",
        "simulated:2:test",
        "-n",
        "2",
    ]
    words += ["--metrics", "bev_jsd", "--json", str(tmp_path / "table.json"), "--set", *QUICK]
    assert main(words) == 0
    table = capsys.readouterr().out
    assert "mean_street: " in table
    assert "marginal (pixel statistics)" in table
    systems = json.loads((tmp_path / "table.json").read_text())
    assert [each["system"] for each in systems] == ["marginal", "mean_street"]
    assert float(load(tmp_path / "table" / "runs" / "mean_street").mean.range_m.detach().std()) > 0, "it has learned"


@pytest.mark.parametrize("test", CONTRACT)
def test_the_file_of_the_page_keeps_the_contract(test, code, tmp_path, request):
    asked = getattr(contract, test)
    for mark in getattr(asked, "pytestmark", ()):
        if mark.name == "usefixtures":
            request.getfixturevalue(*mark.args)
    given = {"name": "mean_street", "tmp_path": tmp_path}
    asked(**{name: given[name] for name in inspect.signature(asked).parameters})


def test_a_default_preset_needs_defaults_and_a_known_name(code):
    preset = load_preset("mean_street", ["model.start_m=20"])
    assert (preset.model.start_m, list(preset.training)) == (20.0, ["mean"])
    with pytest.raises(UnknownNameError, match="which is not among the presets"):
        load_preset("mean_streets")
    other = code.parents[1] / "without_default" / "system.py"
    other.parent.mkdir()
    other.write_text(code.read_text().replace("start_m: float = 10.0", "start_m: float"), encoding="utf-8")
    with pytest.raises(
        ConfigError, match=r"without_default without a preset .* add without_default to systems/without_default/presets"
    ):
        default_preset("without_default")
