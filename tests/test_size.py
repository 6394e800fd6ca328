"""Networks that are too large: refused in one line, before they fill the memory."""

import json
import resource
import shutil
from concurrent.futures import ThreadPoolExecutor

import pytest
from torch import nn

from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.data.run_folder import locate
from lidargrit.generation.generator import load
from lidargrit.generation.presets import load_preset
from lidargrit.nn.size import numbers_at_most


def test_weights_and_buffers_of_all_modules_are_counted():
    with numbers_at_most(110 + 41):
        nn.Sequential(nn.Linear(10, 10), nn.BatchNorm1d(10))
    with pytest.raises(ConfigError, match=r"got a network of more than 150 numbers; wanted fewer; lower its"):  # noqa: SIM117
        with numbers_at_most(150):
            nn.Sequential(nn.Linear(10, 10), nn.BatchNorm1d(10))
    nn.Linear(100, 100)  # afterwards nothing is counted


def test_networks_of_other_threads_are_not_counted():
    with numbers_at_most(110), ThreadPoolExecutor(1) as pool:
        pool.submit(nn.Linear, 100, 100).result()
        nn.Linear(10, 10)


def test_modules_are_counted_too_however_small_they_are():
    with pytest.raises(ConfigError, match="got a network of more than 20,000 modules"), numbers_at_most():
        nn.Sequential(*(nn.Identity() for _ in range(20_001)))


@pytest.mark.parametrize(
    "setting",
    [
        "model.transformer.layers=1000000",
        "model.transformer.width=4611686018427387904",
        "model.tokenizer.num_codes=1000000000",
        "model.tokenizer.code_dim=1000000000",
        "model.tokenizer.residual_blocks=1000000",
        "model.tokenizer.channels=1048576",
        "model.tokenizer.channel_multipliers=[1,1,1,9223372036854775807]",
    ],
)
def test_a_word_of_the_user_builds_no_network_that_fills_the_memory(setting):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ConfigError):
        load_preset("lidargrit_small", [setting]).build_generator()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, "kibibytes"


@pytest.mark.parametrize(("name", "value"), [("layers", 1000), ("layers", 10**6), ("width", 2**18), ("width", 2**62)])
def test_a_configuration_beside_small_weights_builds_no_large_network(tmp_path, name, value):
    folder = shutil.copytree(locate("pretrained"), tmp_path / "run")
    about = json.loads((folder / "config.json").read_text())
    about["config"]["transformer"][name] = value
    (folder / "config.json").write_text(json.dumps(about))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError, match=r"config\.json( with a network|.*layers=1000000; wanted)"):
        load(folder)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, "kibibytes"
