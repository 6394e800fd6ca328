"""What the site's builder does beyond its own: lists whole folders, prints every verb's help, tidies docstrings."""

import os
import re
from pathlib import Path

from lidargrit.cli import build_parser

_ROLE = re.compile(r":(?:class|func|meth|mod):(?=<code>)")  # how our docstrings mark names; the site has no roles
_COMMANDS = "<!-- every verb's help -->"


def on_config(config):
    """Put every page of a folder into the navigation where the folder stands."""
    config["nav"] = [_opened(entry, Path(config["docs_dir"])) for entry in config["nav"]]
    return config


def on_page_markdown(markdown, page, config, files):
    """Write the help of every verb where a page asks for it."""
    return markdown.replace(_COMMANDS, _helps()) if _COMMANDS in markdown else markdown


def on_page_content(html, page, config, files):
    """Leave out the roles before names."""
    return _ROLE.sub("", html)


def _opened(entry, docs):
    if isinstance(entry, dict):
        ((title, below),) = entry.items()
        if isinstance(below, str) and below.endswith("/"):
            return {title: [str(path.relative_to(docs)) for path in sorted((docs / below).glob("*.md"))]}
        if isinstance(below, list):
            return {title: [_opened(one, docs) for one in below]}
    return entry


def _helps():
    os.environ["COLUMNS"] = "92"
    parts = []
    for parser in build_parser().verbs():
        parser.epilog = None  # exit codes: the page has them once
        parts.append(f"## {parser.prog.split()[1]}\n\n```text\n{parser.format_help().rstrip()}\n```\n")
    return "\n".join(parts)
