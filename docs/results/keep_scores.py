"""Scores of a table of ``lidargrit compare`` → files small enough to keep: the same without points of curves and paths.

    python docs/results/keep_scores.py TABLE docs/results/fair/1e13

``lidargrit evaluate --tables docs/results/fair/1e13/*.json`` prints the files side by side. Under ``costs`` stand the
operations, parameters and seconds that ``compare`` measured. Scores by further metrics, which ``lidargrit evaluate
TABLE/SYSTEM/samples ... --json TABLE/SYSTEM.extra.json`` wrote, are kept with them.
"""

import argparse
import json
from pathlib import Path


def kept(scores: dict, further: list[dict], costs: dict, system: str) -> dict:
    """Return the scores of a system without what only plots need, and without the folders of the machine."""
    inputs = {name: dict(each) for name, each in scores["inputs"].items()}
    inputs["samples"]["source"] = system
    reference = Path(inputs["reference"]["source"]).name  # without its folders, if it is one
    inputs["reference"]["source"] = reference
    return scores | {
        "samples": system,
        "reference": reference,
        "inputs": inputs,
        "scores": [score | {"details": {}} for score in [*scores["scores"], *further]],
        "costs": costs,
    }


def main() -> None:
    """Write one file for each system."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, help="folder of compare")
    parser.add_argument("out", type=Path, help="folder to write to")
    choices = parser.parse_args()
    choices.out.mkdir(parents=True, exist_ok=True)
    for file in sorted(choices.table.glob("*/costs.json")):
        system = file.parent.name
        scores_file = file.with_name(f"{system}.json")
        if not scores_file.exists():
            continue  # sampled, not yet scored
        scores, costs = (json.loads(path.read_text(encoding="utf-8")) for path in (scores_file, file))
        extra = choices.table / f"{system}.extra.json"
        further = json.loads(extra.read_text(encoding="utf-8"))["scores"] if extra.exists() else []
        name = system.replace(":", ".").replace("=", "")  # names that every file system takes
        text = json.dumps(kept(scores, further, costs, system), indent=1) + "\n"
        text = text.replace(scores["inputs"]["samples"]["source"], system)  # warnings name it, too
        (choices.out / f"{name}.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
