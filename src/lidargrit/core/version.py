"""The version of the package, which pyproject.toml says, too, and the hash of its source."""

import hashlib
from functools import cache
from pathlib import Path

__version__ = "0.2.0"


@cache
def source_sha256() -> str:
    """Return a hash of all Python files of the package, which tells apart programs of one version."""
    package = Path(__file__).parents[1]
    content = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content.update(f"{path.relative_to(package).as_posix()} ".encode())
        content.update(path.read_bytes())
    return content.hexdigest()
