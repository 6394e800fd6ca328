"""What pages of one file share: the head with its security policy, the one script that may run, figures → HTML."""

import base64
import hashlib
from html import escape
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from lidargrit.evaluation.intervals import format_value

_TEMPLATES = Environment(
    loader=PackageLoader("lidargrit.viewer"),
    autoescape=True,  # names of files and other foreign text are no HTML
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters["value"] = format_value


def asset(name: str) -> str:
    """Return a style sheet or a script of ``browser/``; none names a file, or a font that a computer may lack."""
    return (Path(__file__).parent / "browser" / name).read_text(encoding="utf-8")


def part(template: str, **values: Any) -> Markup:
    """Return a part of a page: one of ``templates/`` with these values, escaped unless they are ``Markup``."""
    return Markup(_TEMPLATES.get_template(template).render(values))


def document(title: str, style: str, content: str, script: str = "", scans: str = "", images: str = "") -> str:
    """Return a whole page, which fetches nothing and runs no other script, whatever a name in it may hold.

    Args:
        style: style sheets.
        content: HTML of the page.
        script: the one script that may run; none if empty.
        scans: JSON that the script finds in the element ``scans``, without "<"; none if empty.
        images: sources of pictures, such as ``data:``; none if empty.
    """
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_policy(script, images)}">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>\n<main>\n{content}\n</main>\n"
        + (f'<script type="application/json" id="scans">{scans}</script>\n' if scans else "")
        + (f"<script>{script}</script>\n" if script else "")
        + "</body>\n</html>\n"
    )


def _policy(script: str, images: str) -> str:
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    rules = ["default-src 'none'", *([f"img-src {images}"] if images else []), "style-src 'unsafe-inline'"]
    return "; ".join([*rules, *([f"script-src 'sha256-{digest}'"] if script else [])])
