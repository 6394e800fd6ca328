"""What a verb found → a table for people, or JSON for programs, on standard output or in a file.

One meaning everywhere: ``--json`` alone prints JSON and nothing else on standard output; ``--json FILE.json`` writes it
to that file besides the table. Progress, warnings and "done" are then on standard error.
"""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from lidargrit.core.errors import OutputError, UsageError, printable
from lidargrit.core.files import plain, refuse_to_overwrite, write_json
from lidargrit.core.untrusted import check_path

STANDARD_OUTPUT = Path("-")
_OF_FOLDERS = (
    *("run", "config", "trained_on", "bundle", "plan", "scans"),  # of runs and of prepared scans
    *("samples", "drive", "completed", "segmented", "simulated", "export", "decompressed", "sensor"),  # of scans
    *("table", "completion", "costs"),  # of comparisons
)
"""What files that the program itself keeps in folders are called, each ``.json``."""


def look_at(folder: Path) -> str:
    """Return the command that shows the scans of a folder, for the last line of a verb that wrote them."""
    return "look at them: " + shlex.join(["lidargrit", "view", str(folder), "-o", f"{folder.name}.html"])


def add_json(parser: argparse.ArgumentParser, files: str = "the file of --json") -> None:
    """Add ``--json [FILE.json]``, and ``--overwrite`` for the ``files`` that it may replace."""
    what = "print JSON; with a file name, write it there besides"
    file = {"nargs": "?", "const": STANDARD_OUTPUT, "type": _json_file, "metavar": "FILE.json"}
    parser.add_argument("--json", help=what, **file)
    parser.add_argument("--overwrite", action="store_true", help=f"replace {files}")


def refuse_taken(options: argparse.Namespace, replaces_others: bool = False) -> None:
    """Refuse, before any work, to replace a file that ``--json`` names, or one of the verb's own, with OutputError.

    Args:
        options: parsed options with ``json``, see :func:`add_json`.
        replaces_others: whether ``--overwrite`` is for other files of the verb, too, and may stand without this one.
    """
    if options.json in (None, STANDARD_OUTPUT):
        if options.overwrite and not replaces_others:
            wanted, cure = "--json FILE.json, which alone it replaces", "leave it out, or choose another folder"
            raise UsageError("--overwrite without a file of --json", wanted, cure)
        return
    if _is_another_file(options):
        raise OutputError(f"{options.json} for two files", "a name for each", "choose another name for --json")
    refuse_to_overwrite(options.json, options.overwrite, ".json")


def _is_another_file(options: argparse.Namespace) -> bool:
    """Return whether the file of ``--json`` is named by another option, too, or is kept in a folder that is named."""
    words = [word for value in vars(options).values() for word in (value if isinstance(value, list) else [value])]
    texts = [str(word) for word in words if isinstance(word, (str, Path)) and word is not options.json]
    named = {Path(os.path.abspath(part)) for text in texts for part in (text, *text.split(":")) if part}  # DATA:ROOT
    file = Path(os.path.abspath(options.json))
    folders = file.parents if file.is_file() else [file.parent]
    is_kept = file.stem in _OF_FOLDERS and not named.isdisjoint(folders)
    is_of_system = file.stem == file.parent.name and file.parent.parent in named  # in the folder of a comparison
    return file in named or is_kept or is_of_system


def print_result(
    options: argparse.Namespace, text: str, result: Any, done: str = "", also: Callable[[], None] | None = None
) -> None:
    """Print what was found as the user wants it, and write it where the user wants it.

    Args:
        options: parsed options with ``json``, see :func:`add_json`.
        text: result as people read it.
        result: result as programs read it; numbers that are NaN or infinite become null.
        done: last line, on standard error if JSON is printed.
        also: writes a further file.
    """
    with ExitStack() as files:  # written last and in any case: nothing is lost for a full disk, or where nobody reads
        if also:
            files.callback(also)
        if options.json == STANDARD_OUTPUT:
            print(json.dumps(plain(result), indent=2, allow_nan=False), flush=True)
        else:
            if options.json:
                files.callback(write_json, options.json, result)
            print("\n".join(map(printable, text.splitlines())), flush=True)  # names of files may hold anything
    if done:
        print(done, file=sys.stderr if options.json == STANDARD_OUTPUT else sys.stdout)


def files_told(**files: Path | None) -> str:
    """Return the last line of a command that wrote files, by what they hold; "" if there are none."""
    written = [f"{what} in {path}" for what, path in files.items() if path and path != STANDARD_OUTPUT]
    return f"done: {', '.join(written)}" if written else ""


def _json_file(word: str) -> Path:
    if word == str(STANDARD_OUTPUT):
        return STANDARD_OUTPUT
    if Path(word).suffix.lower() != ".json":  # a word of the command that came to stand behind --json
        raise UsageError(word[:200], "a name in .json, or nothing", "put --json last")
    return check_path(word)
