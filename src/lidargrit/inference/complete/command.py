"""The verbs complete, upsample and raydrop: a source, a model, a task and a folder → files."""

from dataclasses import replace
from pathlib import Path

from lidargrit.data.prepared.config import DataConfig
from lidargrit.inference.complete import Model
from lidargrit.inference.complete.files import OutputConfig, Written, write_completions
from lidargrit.inference.complete.inputs import open_inputs
from lidargrit.inference.complete.tasks import Task


def complete_scans(
    source: str,
    out: Path,
    model: Model,
    task: Task,
    output: OutputConfig,
    config: DataConfig | None = None,
) -> Written:
    """Write the scans of a source as a task changes them: whole clouds, or the images of the model.

    Args:
        source: a file, a folder or another source of scans, samples, prepared scans, or range images as ``.npy``.
        out: an empty folder, or one that the same command began.
        model: model or classical method; see :func:`lidargrit.inference.complete.open_model`.
        task: the work on each scan.
        output: number and kind of files.
        config: number of scans, and what to do with unusable points and scans; nothing else of it is used.

    Returns:
        what was written, and how many points came in and went out.
    """
    config = config or DataConfig()
    reader = replace(task.reader(model.sensor, model.projection_variant), projection=model.projection)
    inputs = open_inputs(source, reader, config)
    facts = {"verb": task.verb, "source": source, **task.identity()}
    return write_completions(inputs, out, model, task, output, facts, config)
