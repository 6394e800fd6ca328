"""The page of the server: a form and the viewer's parts, files in ``browser/`` → HTML, script and style."""

from pathlib import Path

from lidargrit.core.untrusted import SEED_AT_MOST
from lidargrit.core.version import __version__
from lidargrit.viewer import interactive
from lidargrit.viewer.interactive import button, filled
from lidargrit.viewer.serve.requests import EXAMPLES, TASKS, upload_endings

_FOLDER = Path(__file__).parent / "browser"
_SAVED = ("npz", "ply", "bin")


def page() -> str:
    """Return the page without models and scans, which its script requests from the server."""
    buttons = "".join(button(kind, f".{kind}") for kind in _SAVED) + button("remove", "Remove")
    parts = {
        "viewer": interactive.viewer_html("", f'<span class="soft">Save</span>{buttons}', f"lidargrit {__version__}."),
        "tasks": "".join(f'<button name="task" value="{name}">{text}</button>' for name, text in TASKS.items()),
        "examples": "".join(_example(name) for name in EXAMPLES),
        "seed_at_most": str(SEED_AT_MOST),
        "endings": ",".join(upload_endings()),
        "listed_endings": ", ".join(upload_endings()),
    }
    return filled(_read("serve.html"), parts)


def script() -> str:
    """Return the scripts of the page."""
    return interactive.scripts() + _read("serve.js")


def style() -> str:
    """Return the style sheet of the page."""
    return interactive.style() + _read("serve.css")


def _example(name: str) -> str:
    example = EXAMPLES[name]
    return f'<button type="button" data-example="{name}" data-task="{example.task}">{example.words}</button>'


def _read(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")
