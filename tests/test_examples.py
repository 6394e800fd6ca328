"""The examples in docstrings and in the notebook run."""

import doctest
import importlib
import json
import re
from pathlib import Path

import matplotlib.pyplot as plt

import lidargrit

NOTEBOOK = Path(__file__).parents[1] / "examples" / "first_scans.ipynb"

SOURCE = Path(lidargrit.__file__).parent
# Of the modules with examples alone: to import all others takes longer than to run these.
MODULES = [
    ".".join(path.relative_to(SOURCE.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted(SOURCE.rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


def test_docstring_examples_run():
    results = [doctest.testmod(importlib.import_module(name)) for name in MODULES]
    assert sum(result.attempted for result in results) >= 5
    assert sum(result.failed for result in results) == 0


def test_the_notebook_runs_without_a_gpu(capsys):
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert not cell["outputs"], "kept without outputs, which nobody can review"
            exec(compile("".join(cell["source"]), NOTEBOOK.name, "exec"), names)
    assert len(plt.get_fignums()) == 2
    plt.close("all")
    came_in, came_out, filled = (
        int(one.replace(",", "")) for one in re.findall(r"[\d,]*\d", capsys.readouterr().out)[:3]
    )
    assert came_out == came_in + filled
    assert filled > 0
