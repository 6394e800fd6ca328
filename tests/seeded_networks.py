"""The networks that metrics look through, with weights drawn from a seed: files laid out as the published ones."""

import atexit
import functools
import gzip
import io
import json
import shutil
import tarfile
import tempfile
from pathlib import Path

import torch

from lidargrit.evaluation.metrics.shared.networks.network import NETWORKS
from reference_weights import seeded_weights


@functools.cache
def weights_folder():
    """Write all of them into one folder, once in a process: RangeNet-53 takes 200 MB."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    torch.save(weights("pointnet"), folder / NETWORKS["pointnet"][0].file_name)
    published, _ = NETWORKS["rangenet53"]
    drawn = weights("rangenet53")
    parts = {
        member: {name.removeprefix(prefix): value for name, value in drawn.items() if name.startswith(prefix)}
        for member, prefix in published.members.items()
    }
    write_archive(folder / published.file_name, {member: saved(part) for member, part in parts.items()})
    return folder


def weights(name, seed=1090):
    with torch.device("meta"):
        layout = {key: list(value.shape) for key, value in NETWORKS[name][1]().state_dict().items()}
    return seeded_weights({"layout": json.dumps(layout), "weight_seed": seed})


def saved(thing, **options):
    file = io.BytesIO()
    torch.save(thing, file, **options)
    return file.getvalue()


def write_archive(path, members):
    """Write a tar.gz of names and their bytes, or of made-up entries and their bytes."""
    with gzip.open(path, "wb", compresslevel=0) as packed, tarfile.open(fileobj=packed, mode="w") as archive:
        for name, data in members.items() if isinstance(members, dict) else members:
            entry = name if isinstance(name, tarfile.TarInfo) else tarfile.TarInfo(name)
            if entry.type in tarfile.REGULAR_TYPES:
                entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
