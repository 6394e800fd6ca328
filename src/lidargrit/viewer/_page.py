"""What pages of one file share: the head with its security policy, the one script that may run, figures → HTML."""

import base64
import hashlib
from html import escape


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


def figure(picture: str, caption: str, spoken: str = "") -> str:
    """Return a picture with its caption.

    Args:
        spoken: words for those who do not see the picture; the caption if empty.
    """
    alt = escape(spoken or caption)
    return f'<figure><img src="{picture}" alt="{alt}"><figcaption>{escape(caption)}</figcaption></figure>'
