"""The examples in docstrings run, and every command in the README is one that the program knows."""

import doctest
import importlib
import pkgutil
import re
import shlex
from pathlib import Path

import pytest

import lidargrit
from lidargrit import _discovery
from lidargrit.cli import main

MODULES = [m.name for m in pkgutil.walk_packages(lidargrit.__path__, "lidargrit.") if not m.name.endswith("__main__")]
README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"^lidargrit ([^#\n]+)", README, re.MULTILINE)))


def test_docstring_examples_run():
    results = [doctest.testmod(importlib.import_module(name)) for name in MODULES]
    assert sum(result.attempted for result in results) >= 5
    assert sum(result.failed for result in results) == 0


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_readme_have_the_options_they_use(command, capsys):
    words = shlex.split(command)
    assert words[0].replace("-", "_") in _discovery.names("cli")
    with pytest.raises(SystemExit) as stopped:
        main([words[0], "--help"])
    assert stopped.value.code == 0
    told = capsys.readouterr().out
    assert all(word in told for word in words if word.startswith("-"))
