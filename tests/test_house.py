"""The rules of the house: sizes of files and functions, one public object per file, one version, honest exports."""

import ast
import functools
import re
import tomllib
from pathlib import Path

import pytest

import lidargrit
from lidargrit import api
from lidargrit.cli import _catalogue
from lidargrit.cli._catalogue import entries
from lidargrit.core import discovery
from lidargrit.generation.presets import load_preset

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))


@functools.cache
def functions_and_classes(path: Path) -> list[ast.FunctionDef | ast.ClassDef]:
    found, waiting = [], [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        inside = [node for node in ast.iter_child_nodes(waiting.pop()) if not isinstance(node, ast.expr)]
        waiting += inside
        found += [node for node in inside if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    return found


def test_files_and_functions_stay_short():
    long = []
    for path in SOURCES + sorted((ROOT / "tests").rglob("*.py")):
        lines = path.read_text(encoding="utf-8").count("\n")
        is_verb = path.parent.name == "cli" and not path.name.startswith("_")
        if lines > (60 if is_verb else 400):
            long.append(f"{path.relative_to(ROOT)}: {lines} lines")
        for node in functions_and_classes(path):
            lines = (node.end_lineno or 0) - node.lineno + 1
            if isinstance(node, ast.FunctionDef) and lines > 60:
                long.append(f"{path.relative_to(ROOT)}: {node.name} of {lines} lines")
    assert not long, "\n".join(long)


def test_the_version_is_said_once():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## \[?(\d+\.\d+\.\d+)", changelog, re.MULTILINE)
    assert newest is not None
    assert project["version"] == lidargrit.__version__ == newest[1]


def test_the_oldest_torch_that_is_let_in_has_the_optimisers():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (least,) = [found[1] for each in project["dependencies"] if (found := re.match(r"torch>=([\d.]+)", each))]
    assert tuple(map(int, least.split("."))) >= (2, 9), "torch.optim.Muon came with 2.9"


def test_what_is_exported_is_there():
    assert sorted(lidargrit.__all__) == sorted(api.__all__)
    for name in lidargrit.__all__:
        assert callable(getattr(lidargrit, name))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = lidargrit.nothing


@pytest.mark.parametrize("kind", ["datasets", "sensors", "tokenizers", "generators", "metrics", "presets", "cli"])
def test_every_public_file_says_what_it_is(kind):
    assert discovery.names(kind)
    for name in discovery.names(kind):
        assert 20 < len(discovery.summary(kind, name)) < 180


def test_presets_are_named_after_their_system_and_say_their_title():
    for name in discovery.names("presets"):
        preset = load_preset(name)
        assert preset.title == discovery.summary("presets", name)
        assert name.partition("_")[0] == preset.generator.partition("_")[0]


def test_presets_come_as_a_user_needs_them():
    groups = [entry["group"] for entry in entries("presets")]
    assert [entry["name"] for entry in entries("presets")[:4]] == [*_catalogue._FIRST]
    assert (groups[0], groups[4], groups[-1]) == _catalogue._GROUPS
    assert groups == sorted(groups, key=_catalogue._GROUPS.index)
    assert len(groups) == len(discovery.names("presets"))


def test_nothing_of_this_machine_is_in_the_project():
    texts = [*ROOT.glob("docs/**/*.md"), *ROOT.glob("src/**/*.md"), *ROOT.glob("src/**/*.json"), *ROOT.glob("*.md")]
    for path in [*SOURCES, *texts, ROOT / "Makefile"]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"/(home|root|Users)/|file://", text), path


_ENTRY = re.compile(r"    [*\w]+(?:, \w+)*: (.*)")
_CONTINUES_THE_NAME = re.compile(
    r"(of|for|from|with|by|in|on|to|at|as|after|before|likewise|the same|whose|which|where|when|how|what|who|that|its"
    r"|their|hears|gets|becomes|says|tells|is|has|see above)\b"
)


def test_argument_docs_are_noun_phrases():
    fragments = []
    for path in SOURCES:
        for node in functions_and_classes(path):
            text = ast.get_docstring(node) if "Args:" in (ast.get_docstring(node, clean=False) or "") else ""
            arguments = re.search(r"^Args:\n((?:    .*\n?|\n)+)", text, re.MULTILINE)
            entries = (_ENTRY.fullmatch(line) for line in (arguments[1] if arguments else "").splitlines())
            fragments += [
                f"{path.relative_to(ROOT)}: {entry[0].strip()}"
                for entry in entries
                if entry and (_CONTINUES_THE_NAME.match(entry[1]) or len(entry[1].split()) < 2)
            ]
    assert not fragments, "\n".join(fragments)
