"""The examples in docstrings run."""

import doctest
import importlib
import pkgutil

import lidargrit

MODULES = [m.name for m in pkgutil.walk_packages(lidargrit.__path__, "lidargrit.") if not m.name.endswith("__main__")]


def test_docstring_examples_run():
    results = [doctest.testmod(importlib.import_module(name)) for name in MODULES]
    assert sum(result.attempted for result in results) >= 5
    assert sum(result.failed for result in results) == 0
