"""Files that appear whole or not at all, and folders that belong to one owner: bytes, arrays, tensors → disk."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from lidargrit.errors import CheckpointError, ConfigError, OutputError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; it takes the place of ``path`` if the block ends well, else it vanishes.

    Raises:
        OutputError: the disk is full or the folder cannot be written to; what stood at ``path`` still stands.
    """
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)  # mkstemp keeps files private; ours are ordinary ones
        temporary.replace(path)
    except OSError as error:
        raise OutputError(
            f"'{error.strerror or error}' while writing {path}",
            "a folder with room that may be written to",
            "free some space or choose another folder; nothing that was there is lost",
        ) from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def is_taken(folder: Path, first_file: str) -> bool:
    """Tell whether something lies in a folder's place that is more than what a killed write of its first file left."""
    if not folder.is_dir():
        return folder.exists()
    return any(not path.name.startswith(f".{first_file}.") for path in folder.iterdir())


def refuse_to_overwrite(path: Path | None, overwrite: bool, ending: str = "") -> None:
    """Raise OutputError if something stands where a user's result is to be written, unless that is allowed.

    Also if a file stands where its folder should, or if its name has another ending than what will be in it.
    """
    above = None if path is None else next((place for place in path.absolute().parents if place.exists()), None)
    if above is not None and not above.is_dir():
        raise OutputError(f"{path}, whose folder {above} is a file", "a folder", "choose another place")
    if path is not None and ending and path.suffix.lower() != ending:
        raise OutputError(f"{path}, which will hold {ending[1:].upper()}", f"a name in {ending}", "choose another name")
    if path is not None and path.exists() and not overwrite:
        raise OutputError(f"{path}, which is there already", "a new name", "choose another, or add --overwrite")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_text(path: Path) -> str:
    """Read a text file that a user named.

    Raises:
        ConfigError: it is missing, or not text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}, which cannot be read ({error})", "a text file in UTF-8", "check the path") from None


def write_json(path: Path, data: Any) -> None:
    """Write a JSON file atomically."""
    write_text(path, json.dumps(data, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        CheckpointError: it is missing or not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path}, which cannot be read ({error})", "a JSON file that lidargrit wrote", "check the path"
        ) from None


def write_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any] | None = None) -> None:
    """Write tensors and what is to be known about them into one safetensors file, atomically."""
    from safetensors import SafetensorError  # noqa: PLC0415  quick start of commands that write no weights
    from safetensors.torch import save_file  # noqa: PLC0415

    with atomic_path(path) as temporary:
        try:
            save_file(
                {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()},
                temporary,
                {"about": json.dumps(dict(about or {}))},
            )
        except SafetensorError as error:  # its own class for what is here always a failed write
            raise OSError(str(error)) from error


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read tensors and what is known about them from a safetensors file.

    Raises:
        CheckpointError: the file is missing, cut short, or not one of ours.
    """
    from safetensors import SafetensorError, safe_open  # noqa: PLC0415

    try:
        with safe_open(path, framework="pt") as opened:
            about = json.loads((opened.metadata() or {}).get("about", "{}"))
            return {name: opened.get_tensor(name) for name in opened.keys()}, about  # noqa: SIM118  not a dict
    except (OSError, SafetensorError, ValueError) as error:
        raise CheckpointError(
            f"{path}, which cannot be read ({error})",
            "a complete safetensors file",
            "restore the file, or remove it and train again",
        ) from None


def load_exactly(module: nn.Module, weights: dict[str, Tensor], source: Path) -> None:
    """Load weights into a module of the very same layout.

    Raises:
        CheckpointError: a name or a size differs; names the first.
    """
    wanted = module.state_dict()
    cure = "load them with the configuration that they were trained with"
    for name in sorted(wanted.keys() | weights.keys()):
        if name not in weights or name not in wanted:
            side = "lacks" if name in wanted else "has besides"
            raise CheckpointError(
                f"weights in {source} of another configuration (the file {side} {name!r})", "those of this model", cure
            )
        if weights[name].shape != wanted[name].shape:
            raise CheckpointError(
                f"weights in {source} of another configuration ({name!r} is {tuple(weights[name].shape)})",
                f"{tuple(wanted[name].shape)}",
                cure,
            )
    module.load_state_dict(weights)
