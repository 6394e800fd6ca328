"""The facts of a run → a model card: Markdown for people, with a header for the Hugging Face hub."""

import html
import json
import re
from collections.abc import Iterable
from typing import Any

from lidargrit.core import discovery
from lidargrit.core.errors import one_line
from lidargrit.data.datasets import load as load_dataset
from lidargrit.data.images import Provenance
from lidargrit.data.run_folder import preset_settings, taken_over
from lidargrit.data.sources import data_set_of
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, Scorecard, format_value
from lidargrit.evaluation.verdict import notes_on_floors, value_of_halves
from lidargrit.generation.generator import Generator
from lidargrit.nn.quantization import WeightBits

_PIPELINE = "unconditional-image-generation"  # of the hub's tasks the nearest; it has none for scans
_CREATIVE_COMMONS = re.compile(r"CC ([A-Z-]+) (\d\.\d) \([a-z-]+\)")  # without terms beside it
_FREE = load_dataset("simulated").licence
_PATH = re.compile(r"(?<![\w.])(?:~|[A-Za-z]:)?[/\\][^\s,;:)']*")


def model_card(
    generator: Generator,
    about: dict[str, Any],
    learned: Provenance,
    scores: Scorecard | None = None,
    bits: WeightBits = 32,
) -> str:
    """Return the card of a model, made from the facts in its run folder alone.

    Args:
        about: content of its ``run.json``; empty if there is no such file.
        learned: recordings and images that it was trained on.

    Source:
        The head's entries are those of the hub's documentation, "Model cards".
    """
    licences = _licences(about)
    bound = _hub_licence(licences)
    head = {
        "library_name": "lidargrit",
        "pipeline_tag": _PIPELINE,
        **({"license": bound} if bound else {}),
        "tags": ["lidar", "point-cloud", "range-image", generator.public_name()],
    }
    parts = [
        "\n".join(["---", *(f"{name}: {json.dumps(of)}" for name, of in head.items()), "---"]),  # JSON is YAML
        _what(generator, bits),
        _how_to_sample(),
        _data(about, learned),
        _licence(about, licences),
        _training(about),
        *([_scores(scores)] if scores else ["## Scores\n\nNo scores were published with this model."]),
    ]
    return "\n\n".join(parts) + "\n"


def _what(generator: Generator, bits: WeightBits) -> str:
    sensor, name = generator.sensor, generator.public_name()
    weights = sum(weight.numel() for weight in generator.parameters())
    rounded = {8: ", rounded to 8 bits (vectors to 16)", 16: ", rounded to 16 bits", 32: ""}[bits]
    return (
        f"# {name} for {_text(sensor.name)}\n\n"
        f"{discovery.summary('generators', name)}\n\n"
        f"This model generates LiDAR scans as range images of {sensor.height}x{sensor.width} pixels, "
        f"{sensor.range_min_m:g} to {sensor.range_max_m:g} m, along the rays of the sensor {_code(sensor.name)}.\n"
        f"It has {weights:,} parameters{rounded}.\n"
        "The Python package `lidargrit` reads it; `config.json` holds its sizes and the rays of the sensor."
    )


def _how_to_sample() -> str:
    return """## How to sample

```sh
lidargrit sample FOLDER samples -n 16    # FOLDER is where these files lie
lidargrit view samples
```

```python
from lidargrit import unproject
from lidargrit.generation.generator import Generator

model = Generator.from_pretrained("FOLDER")  # or "USER/NAME", with the extra lidargrit[hub]
scans = model.sample(seeds=[0, 1, 2, 3])  # one for each seed
points_xyz_m = unproject(scans[0]).points_xyz_m
```"""


def _data(about: dict[str, Any], learned: Provenance) -> str:
    data = about.get("preset", {}).get("data", {})
    if not data:
        return "## Data\n\nThe run does not say which scans the model was trained on."
    lines = ["## Data", ""]
    if _imported(about):
        lines += ["The model's authors trained it and know its training scans. The preset names these data sets:", ""]
    lines += ["| part | data set | split | licence |", "|---|---|---|---|"]
    leaks: list[str] = []
    for part in ("train", "val"):
        for name, split in map(data_set_of, data.get(part, ())):
            lines.append(_data_row(part, name, split))
            leaks += _leaks(name, split)
    own = {data_set_of(source) for source in data.get("train", ())}
    taken = {data_set_of(source) for source in taken_over(about)["train"]}
    lines += [_data_row("train, of the weights that it took", *of) for of in sorted(taken - own)]
    lines += ["", *dict.fromkeys(leaks)]
    if variant := preset_settings(about).get("data.projection_variant"):
        lines.append(f"The training scans were projected by the {_code(variant)} variant; project others by the same.")
    if learned.streets:
        lines.append(f"The simulated streets are {' and '.join(learned.streets)}.")
    if learned.fingerprints:
        lines.append(f"The model was trained on {len(learned.fingerprints):,} different images.")
    return "\n".join(lines)


def _data_row(part: str, name: str, split: str) -> str:
    return f"| {part} | {name or 'unnamed scans'} | {_text(split) or '-'} | {_terms(name)} |"


def _terms(name: str) -> str:
    """Return the licence of a data set; "" stands for one that is not known."""
    return load_dataset(name).licence if name else "not known"


def _leaks(name: str, split: str) -> list[str]:
    """Return a sentence for each published split in which the parts share scans or streets."""
    part = split.partition("[")[0]
    found = []
    for number, (scheme, of) in enumerate(load_dataset(name).schemes.items() if name else ()):
        if part in {f"{scheme}/{each}" for each in of.parts} | (set(of.parts) if number == 0 else set()):
            found.append(f"Splits of {name} are those of {of.source}. What their parts share: {of.leak}")
    return found


def _licence(about: dict[str, Any], licences: list[str]) -> str:
    lines = ["## Licence", ""]
    if _imported(about) or taken_over(about)["files"]:  # or those that it began with
        whose = "The weights" if _imported(about) else "Some of the weights, or those that they were trained from,"
        lines.append(f"{whose} belong to their authors; ask them whether they may be used and passed on.")
    if any("non-commercial" in licence for licence in licences):
        lines.append("The training data are for non-commercial use only: treat the weights as non-commercial too.")
    lines += [f"Terms of the training data: {licence}." for licence in licences]
    if not licences:
        lines.append("The run does not say which terms its training data have.")
    return "\n".join(lines)


def _training(about: dict[str, Any]) -> str:
    preset = about.get("preset", {})
    taken = taken_over(about)
    if _imported(about):
        return "\n".join(
            [
                "## Training",
                "",
                "The weights were not trained by lidargrit. They were imported from these files:",
                "",
                *_files(about["files"]),
            ]
        )
    lines = ["## Training", "", f"Preset: {_text(preset.get('title', 'unknown'))}.", ""]
    lines += ["| stage | scans seen | batch | learning rate |", "|---|---|---|---|"]
    for stage, fit in {**preset.get("training", {}), **taken["training"]}.items():
        name = f"{_text(stage)}{', taken from another run' if stage in taken['training'] else ''}"
        if fit is None:  # imported, or of a run that does not say
            lines.append(f"| {name} | not known | - | - |")
        else:
            lines.append(f"| {name} | {fit['scans']:,} | {fit['batch_size']:,} | {fit['learning_rate']:g} |")
    if not preset.get("training"):
        lines = ["## Training", "", "The run does not say how the model was trained."]
    if taken["files"]:
        lines += ["", "Weights that were taken over had been imported from these files:", "", *_files(taken["files"])]
    software = [f"{name} {_text(about[name])}" for name in ("lidargrit", "commit", "torch", "python") if name in about]
    lines += ["", f"Seed {_text(preset.get('seed', 'unknown'))}; {', '.join(software) or 'software unknown'}."]
    return "\n".join([*lines, "Every setting is in `run.json`."])


def _files(files: Iterable[dict[str, Any]]) -> list[str]:
    return [f"- {_code(file['name'])}, SHA-256 {_code(file['sha256'])}" for file in files]


def _scores(card: Scorecard) -> str:
    reference = " ".join(filter(None, (card.reference.data_set, card.reference.split))) or "an unnamed data set"
    lines = [
        "## Scores",
        "",
        f"By the protocol {_code(card.protocol)}, against {card.reference.scans_used:,} scans of {_text(reference)}.",
        "The interval says how far a score may move with other scans of the same kind.",
        "Real against real is the score of one half of the real scans against the other half. Most distances are "
        "larger between fewer scans, so it compares with the score of halves of both sets, not with that of all.",
        "",
        *(f"- {_text(_without_paths(sentence, card))}" for sentence in card.verdict.sentences),
        "",
        "| metric | variant | score | 95 % interval | score of halves | real against real | better |",
        "|---|---|---|---|---|---|---|",
    ]
    for score in card.scores:
        interval, result = score.interval, score.result
        between = f"{format_value(interval.low)} to {format_value(interval.high)}" if interval else "-"
        halves = "-" if (value := value_of_halves(score)) is None else format_value(value)
        real = format_value(score.real_against_real.value) if score.real_against_real else "-"
        better = "higher" if result.higher_is_better else "lower"
        cells = (_text(result.metric), _text(result.variant), format_value(result.value), between, halves, real, better)
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        f"| {_text(each.metric)} | {_text(each.variant)} | {NOT_APPLICABLE} | - | - | - | - |"
        for each in card.left_out
        if each.verdict == NOT_APPLICABLE
    ]
    notes = [f"- {_text(note)}" for note in notes_on_floors(card.scores)]
    notes += [f"- not as in the protocol: {_text(_without_paths(each, card))}" for each in card.deviations]
    notes += [f"- warning: {_text(_without_paths(each, card))}" for each in card.warnings]
    return "\n".join([*lines, "", *notes]).rstrip()


def _without_paths(words: str, card: Scorecard) -> str:
    """Return a sentence in which no folder of the user is named."""
    names = {card.samples.source: "the samples", card.reference.source: "the reference"}
    for source in sorted(filter(None, names), key=len, reverse=True):  # one may lie in the other
        # Not within a word; and a folder called "samples" stands for no more than the word does.
        words = re.sub(rf"(?<![\w./])(?:the )?{re.escape(source)}(?!\w)", names[source], words)
    return _PATH.sub("…", words)


def _text(words: Any) -> str:
    """Return untrusted text for Markdown: one line without HTML, links and table borders."""
    return re.sub(r"([\\`|\[\]])", r"\\\1", html.escape(one_line(str(words)), quote=False))


def _code(words: Any) -> str:
    """Return untrusted text as inline code for Markdown."""
    return "`" + one_line(str(words)).replace("`", "'") + "`"


def _imported(about: dict[str, Any]) -> bool:
    return bool(about.get("files"))


def _licences(about: dict[str, Any]) -> list[str]:
    sources = (*about.get("preset", {}).get("data", {}).get("train", ()), *taken_over(about)["train"])
    return sorted({_terms(data_set_of(source)[0]) for source in sources})


def _hub_licence(licences: list[str]) -> str:
    """Return the hub's name for the licence of the data: ``other`` where none fits, "" where there is none."""
    bound = [_CREATIVE_COMMONS.fullmatch(licence) for licence in licences if licence != _FREE]
    words = {f"cc-{found[1]}-{found[2]}".lower() if found else "other" for found in bound}
    return "other" if len(words) > 1 else "".join(words)
