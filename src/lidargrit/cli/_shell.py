"""The parser of all verbs → a script by which bash, zsh or fish completes verbs, options and names."""

from lidargrit.cli._catalogue import entries
from lidargrit.cli._parser import Parser

SHELLS = ("bash", "zsh", "fish")
_KINDS = {"preset": "presets", "sensor": "sensors", "to": "sensors", "protocol": "protocols", "metrics": "metrics"}


def script(parser: Parser, shell: str) -> str:
    """Return the script of one shell; its verbs' names of presets, sensors, protocols and metrics are completed too."""
    import shtab

    for verb in parser.verbs():
        for action in verb._actions:
            if action.dest in _KINDS:
                action.choices = [entry["name"] for entry in entries(_KINDS[action.dest])]
            elif action.choices is None and action.nargs != 0 and action.type not in (int, float):  # then a place
                action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]  shtab looks for it there
    return shtab.complete(parser, shell)
