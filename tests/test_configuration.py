"""Presets ⇄ JSON, and single settings changed by name."""

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Literal

import pytest
import torch

from lidargrit.core import discovery
from lidargrit.core.configuration import from_json, leaves, name_and_settings, override, to_json
from lidargrit.core.errors import ConfigError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load_class
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.systems.lidargrit.system import LidarGritConfig

PRESETS = discovery.names("presets")


@dataclass(frozen=True)
class Stage:
    """Every kind of setting in one place."""

    scans: int = 1
    rate: float = 0.5
    pair: tuple[float, float] = (0.9, 0.95)
    names: tuple[str, ...] = ()
    kind: Literal["constant", "cosine"] = "constant"
    loud: bool = False

    def __post_init__(self) -> None:
        if self.scans < 1:
            raise ConfigError(f"scans={self.scans}", "at least 1", "raise it")


@dataclass(frozen=True)
class Whole:
    """Settings in a dictionary below."""

    seed: int = 0
    stages: dict[str, Stage] = field(default_factory=lambda: {"first": Stage(), "second": Stage(scans=2)})


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_complete_and_survives_json(name):
    preset = load_preset(name)
    written = json.loads(json.dumps(to_json(preset)))
    generator = load_class(preset.generator)
    sensor = preset.data.load_sensor()
    with torch.device("meta"):  # no network of full size gets values for it
        stages = preset.build_generator(sensor).stages
    assert tuple(preset.training) == stages
    assert from_json(generator.Config, written["model"], "run.json") == preset.model
    assert from_json(DataConfig, written["data"], "run.json") == preset.data
    for stage, config in preset.training.items():
        assert from_json(TrainingConfig, written["training"][stage], "run.json") == config
    kind = {"model.tokenizer.name"}  # written for other tokenizers than the default one; no setting by itself
    assert leaves(written).keys() - kind == leaves(preset).keys()


@pytest.mark.parametrize("name", PRESETS)
def test_every_setting_of_a_preset_can_be_set_to_what_it_is(name):
    preset = load_preset(name)
    for path, value in leaves(preset).items():
        text = value if isinstance(value, str) else json.dumps(value)  # words are taken as they are
        assert override(preset, [f"{path}={text}"]) == preset, path


@pytest.mark.parametrize("name", PRESETS)
def test_a_changed_preset_differs_in_that_setting_only_and_the_preset_itself_stays(name):
    preset = load_preset(name)
    before = leaves(preset)
    changed = override(preset, ["data.max_scans=123", "data.train=[/a b, 'simulated:3:train']", "seed=7"])
    now = leaves(changed)
    assert {path for path in now if now[path] != before[path]} == {"data.max_scans", "data.train", "seed"}
    assert now["data.train"] == ("/a b", "simulated:3:train")
    assert leaves(load_preset(name)) == before
    assert isinstance(changed, Preset)


@pytest.mark.parametrize(
    ("setting", "wanted"),
    [
        ("stages.first.scans=8", {"scans": 8}),
        ("stages.first.rate=1e-3", {"rate": 0.001}),
        ("stages.first.rate=2", {"rate": 2.0}),
        ("stages.first.pair=[0.5, 0.9]", {"pair": (0.5, 0.9)}),
        ("stages.first.names=[a, b]", {"names": ("a", "b")}),
        ("stages.first.names=[]", {"names": ()}),
        ("stages.first.names=['kitti_raw:/data/a=b:train+val']", {"names": ("kitti_raw:/data/a=b:train+val",)}),
        ("stages.first.kind=cosine", {"kind": "cosine"}),
        ("stages.first.loud=true", {"loud": True}),
        (" stages.first.scans =3", {"scans": 3}),
    ],
)
def test_a_setting_is_read_as_its_type(setting, wanted):
    changed = override(Whole(), [setting])
    assert changed == Whole(stages={"first": dataclasses.replace(Stage(), **wanted), "second": Stage(scans=2)})
    for name, value in wanted.items():
        assert type(getattr(changed.stages["first"], name)) is type(value)


def test_the_last_of_two_settings_of_one_name_counts():
    assert override(Whole(), ["seed=1", "seed=2"]).seed == 2


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ("seed", r"got the setting 'seed'; wanted NAME=VALUE; e\.g\. --set seed="),
        ("", r"got the setting ''; wanted NAME=VALUE"),
        ("=1", r"got the setting '', which this preset does not have; wanted one such as"),
        ("sed=1", r"got the setting 'sed', which .*; wanted one such as seed.*; see all with --dry-run"),
        ("stages.first.scan=1", r"wanted one such as stages\.first\.scans"),
        ("stages.frist.scans=1", r"wanted one such as stages\.first\.scans"),
        ("stages.first=1", r"got the setting 'stages\.first', which"),
        ("stages=1", r"got the setting 'stages', which"),
        ("seed.deeper=1", r"got the setting 'seed\.deeper', which"),
        ("seed=many", r"got seed=many; wanted a whole number"),
        ("seed=1.5", r"got seed=1\.5; wanted a whole number"),
        ("seed=", r"got seed=; wanted a whole number"),
        ("seed=null", r"got seed=null; wanted a whole number"),
        ("seed=true", r"got seed=true; wanted a whole number"),
        ("seed=2:0", r"got seed=2:0; wanted a whole number"),
        ("stages.first.rate=1:1", r"rate=1:1; wanted a number"),
        ("stages.first.pair=0x1,2", r"pair=0x1,2; wanted 2 values, each a number"),
        ("stages.first.rate=fast", r"rate=fast; wanted a number"),
        ("stages.first.pair=[1]", r"pair=\[1\]; wanted 2 values, each a number"),
        ("stages.first.pair=[1, 2, 3]", r"wanted 2 values, each a number"),
        ("stages.first.names=[[a]]", r"wanted values, each text"),
        ("stages.first.names=[a", r"wanted values, each text"),
        ("stages.first.kind=cosin", r"wanted constant or cosine;"),
        ("stages.first.loud=perhaps", r"wanted true or false"),
        ("stages.first.scans=0", r"^got scans=0; wanted at least 1; raise it$"),
    ],
)
def test_a_setting_that_does_not_fit_is_told_in_one_line(setting, text):
    with pytest.raises(ConfigError, match=text) as refusal:
        override(Whole(), [setting])
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("cls", "change", "text"),
    [
        (
            VqvaeConfig,
            {"channels": 33},
            r"does not fit \(channels=33; wanted a whole number, at least 32, a multiple of 32\)",
        ),
        (
            VqvaeConfig,
            {"channel_multipliers": []},
            r"\(channel_multipliers=\(\); wanted at least 1, at most 16 values, each a whole number, at least 1\)",
        ),
        (TransformerConfig, {"width": 30}, r"\(heads=8, width=30; wanted a width that is a multiple of the heads\)"),
        (VqvaeConfig, {"channels": "many"}, r"^got a configuration in run\.json that does not fit \(.*channels"),
        (VqvaeConfig, {"padding": "mirror"}, r"^got a configuration in run\.json that does not fit \(.*padding"),
        (VqvaeConfig, {"colour": 1}, r"^got a configuration in run\.json that does not fit \(.*colour"),
        (
            VqvaeConfig,
            {"channel_multipliers": [1] * 1001},
            r"\(channel_multipliers=\(1, .* \[\.\.\.\]; wanted at least 1, at most 16 values",
        ),
        (
            VqvaeConfig,
            {"channel_multipliers": [2**64]},
            r"channel_multipliers=18446744073709551616; wanted a whole number, at least 1",
        ),
        (VqvaeConfig, {"channel_multipliers": [1, "x"]}, r"does not fit \(.*channel_multipliers"),
        (VqvaeConfig, {"channels": 10**4000}, r"does not fit \(channels=10{10,200} \[\.\.\.\]; wanted a whole number"),
    ],
)
def test_json_that_does_not_fit_is_told_in_one_line(cls, change, text):
    with pytest.raises(ConfigError, match=text) as refusal:
        from_json(cls, to_json(cls()) | change, "run.json")
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 600


@pytest.mark.parametrize("data", [None, 3, "words", [1], {}])
def test_json_that_is_no_configuration_at_all(data):
    with pytest.raises(ConfigError, match=r"a configuration in run\.json that does not fit"):
        from_json(TrainingConfig, data, "run.json")


@pytest.mark.parametrize("name", ["lidargrit", "maskgit", "lidm"])
def test_a_kind_that_is_not_named_is_the_default_of_its_configuration(name):
    config = load_class(name).Config
    assert from_json(config, {}, "config.json") == config()
    written = {key: value for key, value in to_json(config()).items() if key != "tokenizer"}
    assert from_json(config, written, "config.json") == config()


@pytest.mark.parametrize("key", ["transformer", "tokenizer"])
def test_what_is_no_settings_is_told_with_its_name(key):
    for wrong in (None, 5, [1]):
        with pytest.raises(ConfigError) as refusal:
            from_json(LidarGritConfig, {key: wrong}, "config.json")
        assert f"('{wrong}' in place of settings by name for {key!r})" in str(refusal.value)
    from_json(LidarGritConfig, {"pixels": None}, "config.json")


def test_settings_of_a_preset_are_checked_with_the_words_of_their_class():
    with pytest.raises(
        ConfigError, match=r"^got model.tokenizer.channels=40; wanted a whole number, at least 32, a multiple of 32"
    ):
        load_preset("lidargrit_small", ["model.tokenizer.channels=40"])
    with pytest.raises(ConfigError, match=r"^got training.tokenizer.batch_size=0; wanted a whole number, at least 1, "):
        load_preset("lidargrit_small", ["training.tokenizer.batch_size=0"])
    with pytest.raises(ConfigError, match=r"^got training.tokenizer.learning_rate=nan; wanted a number, above 0"):
        load_preset("lidargrit_small", ["training.tokenizer.learning_rate=nan"])


@pytest.mark.parametrize(
    ("word", "name", "settings"),
    [
        ("pretrained", "pretrained", []),
        ("small:steps=32,eta=0.5", "small", ["steps=32", "eta=0.5"]),
        ("runs/12:30", "runs/12:30", []),
        ("runs/12:30:steps=32", "runs/12:30", ["steps=32"]),
        ("runs/a=b", "runs/a=b", []),
        ("small:", "small:", []),
    ],
)
def test_a_name_may_hold_colons_beside_its_settings(word, name, settings):
    assert name_and_settings(word) == (name, settings)
