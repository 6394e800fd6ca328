"""The folder of a relay ⇄ a few files small enough to travel, in as many bits as fit.

A stage that is still trained keeps weights, their average and the optimiser's moments; a finished one keeps its average
alone. Where 32 bits take too much room, the moments lose bits first, then the average, then the weights. Then the
average stays behind: it begins anew from the weights. At last every stage keeps its average alone, which is the copy
that is small enough to be committed: training goes on from it with fresh moments.
"""

import hashlib
import io
import tarfile
import tempfile
from pathlib import Path

import torch
from torch import Tensor, nn

from lidargrit.core.errors import CheckpointError, OutputError
from lidargrit.core.files import atomic_path, read_json, read_tensors, write_json, write_tensors
from lidargrit.data.run_folder import CHECKPOINT_FILE
from lidargrit.training.log import LOG_FILE

MANIFEST = "relay_manifest.json"
RELAY_FILE = "relay.json"
_PART_BYTES = 15 << 20
_PARTS_AT_MOST = 4
_LARGEST_HALF = 6e4  # larger numbers, such as counts, have no 16-bit float
# Types by entries of a checkpoint, from the most bits to the fewest; None leaves an entry out, others have 32 bits.
# Moments need the range of 32 bits, not the digits.
_LEVELS: tuple[dict[str, torch.dtype | None], ...] = (
    {},
    {"optimiser": torch.bfloat16},
    {"optimiser": torch.bfloat16, "average": torch.float16},
    {"optimiser": torch.bfloat16, "average": torch.float16, "objective": torch.float16},
    {"optimiser": torch.bfloat16, "average": None, "objective": torch.float16},
    {"optimiser": None, "average": torch.float16, "objective": None},
)
_AVERAGE_ALONE = _LEVELS[-1]


def pack(run: Path, out: Path, bytes_at_most: int = _PARTS_AT_MOST * _PART_BYTES) -> str:
    """Write what the next leg needs into a folder, and return in one line what it is.

    Args:
        run: folder of the relay, with ``relay.json`` and a folder for each stage.
        out: folder for parts of 15 MiB and a manifest of their hashes.
        bytes_at_most: bound of all parts together.

    Raises:
        OutputError: even in the fewest bits it takes more room.
    """
    finished = read_json(run / RELAY_FILE).get("finished", [])
    for types in _LEVELS:
        content = _tar(run, finished, types)
        if len(content) <= bytes_at_most:
            break
    else:
        wanted = f"at most {bytes_at_most / 2**20:.1f} MiB"
        raise OutputError(f"{len(content) / 2**20:.1f} MiB to pack", wanted, "take a preset with smaller networks")
    hashes: dict[str, str] = {}
    for number, at in enumerate(range(0, len(content), _PART_BYTES)):
        part = content[at : at + _PART_BYTES]
        name = f"relay_part_{number}"
        hashes[name] = hashlib.sha256(part).hexdigest()
        with atomic_path(out / name) as partial:
            partial.write_bytes(part)
    write_json(out / MANIFEST, {"parts": hashes})
    rounded = ", ".join(f"{name} in {dtype}".replace("torch.", "") for name, dtype in types.items() if dtype)
    left_out = "".join(f", without {name}" for name, dtype in types.items() if dtype is None)
    return f"packed {len(content) / 2**20:.1f} MiB in {len(hashes)} parts, {rounded or 'nothing rounded'}{left_out}"


def unpack(packed: Path, run: Path) -> None:
    """Put what :func:`pack` wrote into the folder of a relay; nothing changes there unless every part is whole.

    Raises:
        CheckpointError: a part is missing or damaged; names it.
    """
    content = b"".join(_parts(packed))
    with tempfile.TemporaryDirectory() as name, tarfile.open(fileobj=io.BytesIO(content)) as tar:
        tar.extractall(name, filter="data")
        for path in sorted(Path(name).rglob("*.*")):
            target = run / path.relative_to(name)
            if path.name == CHECKPOINT_FILE:
                tensors, about = read_tensors(path)
                write_tensors(target, _whole(tensors), about)
            else:
                with atomic_path(target) as partial:
                    partial.write_bytes(path.read_bytes())


def _parts(packed: Path) -> list[bytes]:
    cure = "fetch or copy it again"
    hashes = read_json(packed / MANIFEST).get("parts")
    if not isinstance(hashes, dict) or not hashes or any(Path(name).name != name for name in hashes):
        raise CheckpointError(f"{packed / MANIFEST}, which names no parts", "what a leg packed", cure)
    parts = []
    for name, expected in hashes.items():
        if not (path := packed / name).is_file():
            raise CheckpointError(f"no file {path}", f"all of {', '.join(hashes)}", cure)
        parts.append(path.read_bytes())
        if hashlib.sha256(parts[-1]).hexdigest() != expected:
            raise CheckpointError(f"{path}, which is damaged", f"the hash in {MANIFEST}", cure)
    return parts


@torch.no_grad()
def round_finished(module: nn.Module) -> None:
    """Round the weights of a finished stage as packing does, so that later stages see the same before and after it."""
    for tensor in module.state_dict().values():
        tensor.copy_(_cast(tensor, torch.float16))


def _tar(run: Path, finished: list[str], types: dict[str, torch.dtype | None]) -> bytes:
    buffer = io.BytesIO()
    with tempfile.TemporaryDirectory() as name, tarfile.open(fileobj=buffer, mode="w") as tar:
        for path in (run / RELAY_FILE, *sorted(run.glob(f"*/{LOG_FILE}"))):
            tar.add(path, str(path.relative_to(run)))
        for path in sorted(run.glob(f"*/{CHECKPOINT_FILE}")):
            tensors, about = read_tensors(path)
            short = Path(name) / CHECKPOINT_FILE
            write_tensors(short, _shortened(tensors, path.parent.name in finished, types), about)
            tar.add(short, str(path.relative_to(run)))
    return buffer.getvalue()


def _shortened(
    tensors: dict[str, Tensor], is_finished: bool, types: dict[str, torch.dtype | None]
) -> dict[str, Tensor]:
    types = _AVERAGE_ALONE if is_finished else types
    of_each = ((name, tensor, types.get(name.partition(".")[0], torch.float32)) for name, tensor in tensors.items())
    return {name: _cast(tensor, dtype) for name, tensor, dtype in of_each if dtype is not None}


def _cast(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    numbers = tensor.dtype == torch.float32 and tensor.ndim > 0
    fits = numbers and (dtype != torch.float16 or bool((tensor.abs() < _LARGEST_HALF).all()))
    return tensor.to(dtype) if fits else tensor


def _whole(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return a checkpoint's tensors in 32 bits; of weights and their average, the one stands in for the other."""
    whole = {
        name: one.float() if one.dtype in (torch.float16, torch.bfloat16) else one for name, one in tensors.items()
    }
    for absent, present in (("objective.", "average."), ("average.", "objective.")):
        if not any(name.startswith(absent) for name in whole):
            stand_in = {name: tensor for name, tensor in whole.items() if name.startswith(present)}
            whole |= {name.replace(present, absent, 1): tensor.clone() for name, tensor in stand_in.items()}
    return whole
