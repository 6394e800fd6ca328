"""The word ``training.STAGE.batch_size=auto`` → batches as large as this machine gains by, and their learning rate."""

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from lidargrit.core import reporting
from lidargrit.core.errors import ConfigError, nearest_names
from lidargrit.core.files import read_json
from lidargrit.core.processes import rank_and_world_size
from lidargrit.data.run_folder import RUN_FILE, preset_settings
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.nn.size import TooLargeError
from lidargrit.training.measure import scans_per_s

_ASKED = re.compile(r"training\.(\w+)\.batch_size=auto")
_GAIN = 1.1  # by which twice the scans in a batch must raise the scans a second; fewer steps learn less
_DOUBLINGS_AT_MOST = 4
_STEPS_AT_LEAST = 1000  # over the whole training
_MEMORY_AT_MOST = 0.8  # of what is free on a GPU: a validation, and other images, take some more


def without_auto(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Divide settings as users type them into those of a preset, and the stages that ask for ``batch_size=auto``."""
    asked = [found[1] for word in words if (found := _ASKED.fullmatch(word))]
    return [word for word in words if not _ASKED.fullmatch(word)], asked


def with_best_batches(preset: Preset, stages: Collection[str], folder: Path) -> Preset:
    """Return a preset with the batch sizes by which this machine trains some of its stages best.

    A batch is doubled up to four times, while that raises the scans a second by a tenth or more, leaves 1,000 steps,
    and fits into the memory that is free. Larger ones only mean fewer steps. The learning rate grows by the square root
    of the batch size.

    Args:
        stages: names of the stages; the others stay as they are.
        folder: run folder; a training that began there goes on with the sizes that it has.

    Raises:
        ConfigError: a stage that the preset does not train, or one of several processes, which would find other sizes.

    Source:
        Malladi et al., On the SDEs and Scaling Rules for Adaptive Gradient Algorithms, NeurIPS 2022, for the square
        root; the other changes of that rule, to Adam's decay rates, are left out.
    """
    if not stages:
        return preset
    if (processes := rank_and_world_size(None, None)[1]) > 1:
        got = f"batch_size=auto in {processes} processes"
        raise ConfigError(got, "a number", "see what one process takes with --dry-run, and multiply it")
    begun = preset_settings(read_json(folder / RUN_FILE)) if (folder / RUN_FILE).exists() else {}
    training = dict(preset.training)
    for stage in dict.fromkeys(stages):
        if stage not in training or training[stage].frozen:
            trained = [name for name, config in training.items() if not config.frozen]
            raise ConfigError(
                f"training.{stage}.batch_size=auto", nearest_names(stage, trained), "name a stage that is trained"
            )
        names = {name: f"training.{stage}.{name}" for name in ("batch_size", "learning_rate")}
        if all(name in begun for name in names.values()):
            training[stage] = replace(training[stage], **{name: begun[full] for name, full in names.items()})
        else:
            training[stage] = _best(preset, stage)
    return replace(preset, training=training)


def _best(preset: Preset, stage: str) -> TrainingConfig:
    own = best = preset.settings_of(stage)
    rate = _rate(preset, stage, own)
    tried = [f"{own.batch_size}: {rate:.3g}"]
    for doubling in range(1, _DOUBLINGS_AT_MOST + 1):
        larger = scaled(own, 2**doubling)
        if larger.batch_size * _STEPS_AT_LEAST > own.scans or not rate:
            break
        found = _rate(preset, stage, larger)
        tried.append(f"{larger.batch_size}: {found:.3g}" if found else f"{larger.batch_size}: too large for the memory")
        if found < _GAIN * rate:
            break
        best, rate = larger, found
    reporting.message(
        f"{stage}: batch_size={best.batch_size} learning_rate={best.learning_rate:.3g} "
        f"(scans a second by batch size: {'; '.join(tried)})"
    )
    return best


def scaled(config: TrainingConfig, factor: int) -> TrainingConfig:
    """Return settings with batches so many times as large, and the learning rate that goes with them."""
    rate = config.learning_rate * math.sqrt(factor)
    return replace(config, batch_size=config.batch_size * factor, learning_rate=rate)


def _rate(preset: Preset, stage: str, config: TrainingConfig) -> float:
    """Return how many scans a second a stage is trained on; 0 where its batches leave too little memory."""
    on_gpu = torch.cuda.is_available()
    free = 0
    if on_gpu:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        free = torch.cuda.mem_get_info()[0]
    try:
        rate = scans_per_s(replace(preset, training={**preset.training, stage: config}), stage)
    except TooLargeError:
        return 0.0
    return 0.0 if on_gpu and torch.cuda.max_memory_allocated() > _MEMORY_AT_MOST * free else rate
