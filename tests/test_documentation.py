"""The pages say what is so: links and anchors, commands, quoted messages, pictures and their examples, navigation."""

import ast
import contextlib
import csv
import importlib.util
import inspect
import json
import re
import shlex
import tomllib
import types
import typing
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest
import yaml
from PIL import Image

from lidargrit.cli import build_parser
from lidargrit.core import discovery
from lidargrit.core.errors import UsageError
from lidargrit.generation.generator import load_class
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.lidargrit.system import LidarGrit

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")])
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
VERBS = {parser.prog.split()[1]: parser for parser in build_parser().verbs()}


def prose(text: str) -> str:
    """Return a page without its blocks of code, in which brackets and number signs mean other things."""
    return re.sub(r"^ {4}[^\n]*$|^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as both GitHub and the site make them of plain words."""
    titles = re.findall(r"^#+ (.+)$", prose(TEXTS[page]), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles}


def commands(text: str) -> list[str]:
    """Return the commands of lidargrit that stand in a page's code, with lines joined that a backslash breaks."""
    text = text.replace("\\\n", " ")
    typed = re.findall(
        r"^(?: {4})?(?:\w+=\S+ |torchrun --no-python .*?)?lidargrit ([a-z][^#|>\n]*)", text, re.MULTILINE
    )
    return [*typed, *re.findall(r"`lidargrit ([a-z-]+(?: [^`]*)?)`", text)]


def test_links_lead_to_pages_and_headings():
    wrong, count = [], 0
    for page, text in TEXTS.items():
        for link in re.findall(r"\]\(([^)\s]+)\)", prose(text)):
            if re.match(r"[a-z]+:", link):
                continue
            count += 1
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            if not target.exists() or (anchor and target in TEXTS and anchor not in anchors(target)):
                wrong.append(f"{page.name}: {link}")
    assert wrong == []
    assert count > 60


def test_the_readme_counts_what_there_is():
    counts = re.findall(r"\b(\d+) (metrics|protocols|sensors|file formats|data sets)\b", TEXTS[ROOT / "README.md"])
    assert len(counts) == 5
    ours = {"folder", "range_images", "simulated", "simulated_surfaces"}  # scans of no data set
    for count, kind in counts:
        known = {*discovery.names(kind.removeprefix("file ").replace("data sets", "datasets"))} - ours
        assert int(count) == len(known), kind


def test_every_page_is_in_the_navigation():
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))

    def named(entry: object) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        parts = entry if isinstance(entry, list) else list(entry.values()) if isinstance(entry, dict) else []
        return [name for part in parts for name in named(part)]

    docs, wanted = ROOT / "docs", set()
    for name in named(config["nav"]):
        wanted |= set((docs / name).glob("*.md")) if name.endswith("/") else {docs / name}
    assert wanted == set(docs.rglob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_are_such_as_the_program_takes(page):
    for command in commands(TEXTS[page]):
        verb, *words = shlex.split(command, comments=True)
        if verb.startswith("--"):
            continue
        refused = ""
        with contextlib.suppress(SystemExit):  # the end of a verb's --help
            try:
                VERBS[verb].parse_args(words)
            except UsageError as error:
                refused = str(error)
        assert not refused or refused.startswith("got no "), command  # a sentence may name a verb alone


def test_programs_that_pages_and_docstrings_name_are_there():
    sources = [path for folder in ("src", "benchmarks", "examples") for path in (ROOT / folder).rglob("*.py")]
    for page, text in (TEXTS | {path: path.read_text(encoding="utf-8") for path in sources}).items():
        for path in re.findall(r"\b((?:benchmarks|examples)/\w+\.py)", text):
            assert (ROOT / path).is_file(), f"{page.name}: {path}"


def test_the_architecture_names_every_package_in_the_order_of_the_layers():
    table = TEXTS[ROOT / "docs" / "architecture.md"].partition("## Packages")[2].partition("\n## ")[0]
    named = re.findall(r"^\| `(\w+)(?:/|\.py)`", table, re.MULTILINE)
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (layers,) = (each["layers"] for each in contracts if each["type"] == "layers")
    order = [name for layer in layers for name in layer.split(" | ")]
    assert [name for name in named if name != "pretrained"] == order[::-1]  # pretrained holds weights, no code


def quoted_in_source() -> str:
    """Return all strings of the program, with a sign where something is filled in."""
    found = []
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(part.value if isinstance(part, ast.Constant) else "\0" for part in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\n".join(found)


def test_messages_that_the_faq_explains_are_the_programs_own():
    messages = re.findall(r"^### `(.+)`$", TEXTS[ROOT / "docs" / "faq.md"], re.MULTILINE)
    source = quoted_in_source()
    assert len(messages) > 15
    for message in messages:
        for part in re.split(r"…|; wanted |; | points | in |WARNING: |left out: ", message):
            words = part.strip(" ():,.")
            assert words in source, f"{words!r} of {message!r}"


def test_pictures_are_small_and_shown():
    shown = {
        (page.parent / path).resolve()
        for page, text in TEXTS.items()
        for path in re.findall(r"!\[.*?\]\((.+?)\)", text)
    }
    pictures = set((ROOT / "docs" / "pictures").glob("*"))
    assert pictures <= shown
    assert sum(path.stat().st_size for path in pictures) < 4_000_000


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """Return a run of random weights, for examples that take the packaged one if they are told no other."""
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(64)
    pixels = PixelDecoderConfig(mask_features=2, range_features=2, mask_width=4, range_width=4, blocks=1)
    model = LidarGrit(replace(LidarGrit.smallest_config(sensor), pixels=pixels), sensor)
    model.save(folder := tmp_path_factory.mktemp("run"))
    return folder


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run_and_draw_what_is_shown(path, tiny_run, tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(path.parent)  # as Python itself does for a program, which may use another one
    module = _program(path)
    for name in {"STEPS", "COUNT"} & vars(module).keys():
        setattr(module, name, 3)  # what is shown takes seconds more
    if "MODEL" in vars(module):
        module.MODEL = str(tiny_run)
    runs = [str(tiny_run)] if "run" in inspect.signature(module.main).parameters else []
    module.main(tmp_path, *runs)
    assert capsys.readouterr().out
    drawn = re.findall(r"→ (\w+\.(?:png|webp))\.", module.__doc__ or "")
    assert {file.name for file in tmp_path.iterdir()} == set(drawn)
    for name in drawn:
        with Image.open(tmp_path / name) as new, Image.open(ROOT / "docs" / "pictures" / name) as shown:
            assert new.size == shown.size


def _program(path: Path) -> types.ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_fair_table_is_what_the_scores_say(capsys, monkeypatch):
    program, page = _program(ROOT / "benchmarks" / "fair_table.py"), TEXTS[ROOT / "docs/results/fair-table.md"]
    for words, count in ((["table"], 20), (["ranks"], 19)):
        monkeypatch.setattr("sys.argv", ["fair_table.py", *words])
        program.main()
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) > count
        assert [line for line in lines if not line.startswith("| real against real") and line not in page] == []


def test_scores_of_a_comparison_become_rows_of_the_table(tmp_path, monkeypatch, capsys):
    program = _program(ROOT / "benchmarks" / "fair_table.py")
    before = program.SCORES.read_text(encoding="utf-8")
    (scores := tmp_path / "scores.csv").write_text(before, encoding="utf-8")
    monkeypatch.setattr(program, "SCORES", scores)
    score = {"metric": "bev_jsd", "variant": "exact", "value": 0.25, "higher_is_better": False, "num_generated": 64}
    score |= {"interval": {"low": 0.125, "high": 0.5}, "real_against_real": None}
    card = {"inputs": {"reference": {"source": "/data/held_out", "sha256": "0123456789"}}, "scores": [score]}
    cell = {"system": "r2dm_small:steps=32", "costs": {"parameters": 7, "training_flops": None}, "scores": card}
    settings = {"flops": 1e13, "preset_settings": ["data.train=/data/mine", "seed=5"]}
    (tmp_path / "table.json").write_text(json.dumps({"settings": settings, "cells": [cell]}), encoding="utf-8")
    monkeypatch.setattr("sys.argv", ["fair_table.py", "add", str(tmp_path)])
    for more in (1, 0):  # a second time adds nothing
        program.main()
        assert f"done: {more} scores more" in capsys.readouterr().out
    after = scores.read_text(encoding="utf-8")
    assert after.startswith(before)
    row = "R2DM, 32 steps", "r2dm_small", "steps=32", "/data/mine", "1e+13", "5", "held_out", "01234567", "64"
    assert tuple(next(csv.reader([after[len(before) :]])))[:15] == (
        *row,
        "bev_jsd",
        "exact",
        "0.25",
        "0.125",
        "0.5",
        "",
    )


def _settings_below(config: type) -> list[type]:
    """Return a class of settings and those of its fields."""
    hints = typing.get_type_hints(config)
    kinds = [kind for field in fields(config) for kind in (hints[field.name], *typing.get_args(hints[field.name]))]
    return [config, *(one for kind in kinds if is_dataclass(kind) for one in _settings_below(kind))]


def test_the_reference_has_every_setting_of_every_generator():
    page = (ROOT / "docs" / "reference" / "settings.md").read_text()
    for name in discovery.names("generators"):
        cls = load_class(name)
        for config in dict.fromkeys([*_settings_below(cls.Config), cls.Sampling]):
            if fields(config):
                assert f".{config.__name__}\n" in page, f"{name}: {config.__module__}.{config.__name__}"
