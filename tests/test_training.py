"""Training: batches as a function of scans seen, exact resuming, one real scan learned by heart."""

import functools
import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dataset_examples import write_example
from lidargrit.core import configuration, reporting
from lidargrit.core.errors import CheckpointError, ConfigError, OutputError, TrainingError
from lidargrit.core.files import claim_folder, read_tensors, write_json, write_tensors
from lidargrit.data.batches import Batches
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.generation.objective import Objective
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import TrainingConfig
from lidargrit.generation.tokenizers.vqvae import Vqvae
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.r2flow.rectified_flow import ReflowConfig
from lidargrit.training import check_folder, measure, train, training_flops
from lidargrit.training.checkpoint import load_checkpoint, save_checkpoint
from lidargrit.training.log import Log, read_log
from lidargrit.training.optimiser import WeightAverage, learning_rate_at, make_optimiser, memory_of_weights
from lidargrit.training.stage import StageTraining
from lidargrit.viewer import plot_progress
from tiny_runs import MODEL

TINY = [
    "data.train=[simulated:6:train]",
    "data.val=[simulated:2:val]",
    *MODEL,
    "model.tokenizer.dropout=0.2",
    *[
        f"training.{stage}.{setting}"
        for stage in ("tokenizer", "transformer")
        for setting in ("scans=12", "batch_size=2", "precision=fp32", "checkpoint_every=4", "validate_every=100")
    ],
]
TINY_GAN = [
    *TINY[:2],
    *MODEL[:2],
    "model.latent_dim=8",
    "model.channels=4",
    "model.max_channels=8",
    "model.penalty_every=4",
    *[
        f"training.adversarial.{setting}"
        for setting in ("scans=24", "batch_size=2", "precision=fp32", "checkpoint_every=4", "validate_every=8")
    ],
]
PRESETS = {"lidargrit_demo": TINY, "dusty_small": TINY_GAN}


@pytest.fixture
def images():
    config = DataConfig(train=("simulated:6:train",), val=(), columns=512, column_stride=8)
    return load_range_images(config.train, config)


class StopAfterError(Exception):
    pass


class StopAfter(reporting.Reporter):
    """Stops the training, as a kill would, when a stage has learned from so many scans."""

    def __init__(self, stage, scans):
        self.stage, self.scans = stage, scans

    def progress(self, what, total, done=0):
        stop = self

        class Bar:
            seen = done

            def advance(self, amount, note=""):
                self.seen += amount
                if stop.stage in what and self.seen >= stop.scans:
                    raise StopAfterError

            def __enter__(self):
                return self

            def __exit__(self, *error):
                return False

        return Bar()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a function that gives the folder of a preset's run, trained once and without a stop; only to be read."""

    @functools.cache
    def run(name: str) -> Path:
        folder = tmp_path_factory.mktemp("whole") / "run"
        train(load_preset(name, PRESETS[name]), folder)
        return folder

    return run


@pytest.mark.parametrize(
    ("name", "stage", "scans"),
    [
        ("lidargrit_demo", "tokenizer", 6),
        ("lidargrit_demo", "transformer", 2),
        ("lidargrit_demo", "transformer", 10),
        ("dusty_small", "adversarial", 6),  # between two penalties on the discriminator
        ("dusty_small", "adversarial", 16),  # at a checkpoint
    ],
)
def test_a_stopped_run_ends_with_the_same_bits_as_one_that_was_not(tmp_path, whole, name, stage, scans):
    preset = load_preset(name, PRESETS[name])
    with pytest.raises(StopAfterError), reporting.to(StopAfter(stage, scans)):
        train(preset, tmp_path / "stopped")
    train(preset, tmp_path / "stopped")
    folders = whole(name), tmp_path / "stopped"
    unbroken, stopped = (read_tensors(folder / "model.safetensors")[0] for folder in folders)
    assert unbroken.keys() == stopped.keys()
    assert all(torch.equal(unbroken[key], stopped[key]) for key in unbroken)
    logs = [(folder / stage / "log.jsonl").read_text().splitlines() for folder in folders]
    without_time = [[{**json.loads(line), "seconds": 0} for line in log] for log in logs]
    assert without_time[0] == without_time[1]


def test_a_finished_run_is_not_trained_again(whole):
    folder = whole("lidargrit_demo")
    before = (folder / "tokenizer" / "checkpoint.safetensors").stat().st_mtime_ns
    train(load_preset("lidargrit_demo", TINY), folder)
    assert (folder / "tokenizer" / "checkpoint.safetensors").stat().st_mtime_ns == before


def test_batches_depend_on_the_scans_seen_alone(images):
    batches = Batches(images, 4, ("flip", "roll", "geometric"), True, seed=3)
    in_order = [batches.at(seen).images for seen in (0, 4, 8)]
    again = Batches(images, 4, ("flip", "roll", "geometric"), True, seed=3).at(8).images
    assert torch.equal(in_order[2].range_m, again.range_m)
    assert not torch.equal(in_order[0].range_m, in_order[1].range_m)


def test_an_epoch_shows_every_scan_once_and_processes_share_it(images):
    whole = Batches(images, 6, (), False, seed=0).at(6).images
    assert {float(r.sum()) for r in whole.range_m} == {float(r.sum()) for r in images.batch(range(6)).range_m}
    parts = [Batches(images, 6, (), False, seed=0, rank=rank, world_size=3).at(6).images for rank in range(3)]
    assert torch.equal(torch.cat([part.range_m for part in parts]), whole.range_m)


def test_other_columns_of_the_same_scan_can_be_kept(images):
    kept = {
        tuple(Batches(images, 1, (), True, seed=0).at(seen).images.range_m[0, 40].tolist()) for seen in range(0, 60)
    }
    assert len(kept) > 12  # of 6 scans at most 6 without it


class OneWeight(Objective):
    """The smallest objective."""

    def __init__(self, sensor):
        super().__init__(sensor)
        self.weight = torch.nn.Parameter(torch.rand(1))

    def forward(self, example, rng, player=""):
        return {"loss": self.weight.sum()}


def test_weight_average_follows_as_a_slow_loop_says():
    weight = OneWeight(load_sensor("vlp16"))
    average = WeightAverage(weight, half_life_scans=8)
    slow = weight.weight.item()
    for step in range(1, 50):
        weight.weight.data.fill_(step)
        average.update(weight, scans_seen=2 * step, batch_size=2)
        keep = 0.5 ** (2 / min(8, 0.1 * 2 * step))
        slow = keep * slow + (1 - keep) * step
    assert average.objective.weight.item() == pytest.approx(slow, rel=1e-4)


@pytest.mark.shared
def test_the_linear_schedule_is_the_programs(golden):
    factors = golden("misc")["lr_linear_100"]
    config = TrainingConfig(scans=100_000, batch_size=1, learning_rate=1.0, schedule="linear_second_half")
    ours = [learning_rate_at(config, 1000 * epoch) for epoch in range(100)]
    # The program steps once an epoch and would reach 0 at epoch 101, ours falls with every scan and ends at 0.
    assert max(abs(a - b) for a, b in zip(ours, factors, strict=True)) < 0.02


def test_a_stage_does_nothing_before_it_begins(tmp_path, images, monkeypatch):
    monkeypatch.setattr("lidargrit.training.stage.begin_training", lambda *_: pytest.fail("launched"))
    vqvae = Vqvae(load_preset("lidargrit_demo", TINY).model.tokenizer, images.sensor)
    StageTraining(vqvae, TrainingConfig(scans=4, batch_size=2, learning_rate=1e-3), tmp_path / "stage", 0)
    assert not (tmp_path / "stage").exists()


def test_a_loss_that_is_not_finite_stops_with_the_step(tmp_path, images):
    vqvae = Vqvae(load_preset("lidargrit_demo", TINY).model.tokenizer, images.sensor)
    vqvae.encoder.conv_in.weight.data.fill_(torch.nan)
    fit = StageTraining(vqvae, TrainingConfig(scans=4, batch_size=2, learning_rate=1e-3), tmp_path, 0).begun()
    with pytest.raises(TrainingError, match=r"a loss or gradient of nan after 0 scans") as error:
        fit.run(images, images, "training")
    assert "checkpoint" not in str(error.value), "there is none yet"


@pytest.mark.shared
@pytest.mark.timeout(600)  # half a minute on a quiet core, minutes on a busy one
def test_one_real_scan_is_learned_by_heart(tmp_path, real):
    """Within 20 seconds: range error under 0.3 m, mask accuracy over 0.95."""
    train = (f"kitti_raw:{real}/kitti_raw:2011_09_26_drive_9005_sync[:4%]",)
    config = DataConfig(train=train, val=(), columns=2048, column_stride=128)  # 16 are quick
    scan = load_range_images(config.train, config)
    assert len(scan) == 1
    preset = load_preset("lidargrit_small")
    torch.manual_seed(0)
    vqvae = Vqvae(replace(preset.model.tokenizer, raydrop_weight=0.3), scan.sensor)
    learn = TrainingConfig(
        scans=150, batch_size=1, learning_rate=2e-3, schedule="cosine", warmup_scans=30, precision="auto",
        average_over_scans=20, validate_every=1000, checkpoint_every=1000,
    )  # fmt: skip
    fit = StageTraining(vqvae, learn, tmp_path, 0).begun()
    fit.run(scan, scan, "training")
    learned = fit.validate(scan)
    assert learned["range_mae_m"] < 0.3
    assert learned["mask_accuracy"] > 0.95


def test_a_tree_of_scans_trains_from_its_folder_alone(tmp_path):
    write_example("kitti_odometry", tmp_path / "tree", 4)
    settings = [f"data.train={tmp_path / 'tree'}", f"data.val={tmp_path / 'tree'}:all[:50%]"]
    generator = train(load_preset("lidargrit_demo", TINY + settings), Path(tmp_path / "run"))
    first, again = (generator.sample([5, 6]), generator.sample([6]))
    # Sums of a batch of two and of one may differ in their last bit, and a mask drawn there in a pixel.
    assert float((first.range_m[1] - again.range_m[0]).abs().gt(1e-3).float().mean()) < 1e-3
    assert first.range_m.shape == (2, 64, 64)


def test_stages_use_their_own_settings():
    preset = load_preset("lidargrit_demo", ["training.transformer.learning_rate=0.5"])
    assert preset.training["transformer"].learning_rate == 0.5
    assert preset.training["tokenizer"] == load_preset("lidargrit_demo").training["tokenizer"]
    assert replace(preset, seed=1) != preset


def test_a_run_goes_on_though_the_words_about_its_preset_have_changed(tmp_path):
    preset = load_preset("marginal")
    older = replace(preset, title="another title", published="other words")
    write_json(tmp_path / "run.json", {"preset": configuration.to_json(older)})
    check_folder(tmp_path, preset)
    with pytest.raises(OutputError, match=r"there seed=0, here 1"):
        check_folder(tmp_path, replace(preset, seed=1))


def test_a_run_goes_on_with_settings_that_change_nothing_computed(tmp_path):
    write_json(tmp_path / "run.json", {"preset": configuration.to_json(load_preset("lidargrit_demo"))})
    stage = "training.tokenizer"
    check_folder(
        tmp_path,
        load_preset("lidargrit_demo", ["data.workers=7", f"{stage}.checkpoint_every=3", f"{stage}.pictures_every=5"]),
    )
    with pytest.raises(OutputError, match=r"training\.tokenizer\.validate_every"):
        check_folder(tmp_path, load_preset("lidargrit_demo", [f"{stage}.validate_every=3"]))


def test_settings_that_a_later_stage_cannot_follow_are_refused_before_the_first(tmp_path):
    settings = ["training.transformer.batch_size=2", "training.transformer.accumulate=3"]
    with pytest.raises(ConfigError, match="batch_size=2 on 1 processes in 3 parts"):
        train(load_preset("lidargrit_demo", [*TINY, *settings]), tmp_path)
    assert not [*tmp_path.iterdir()]
    preset = load_preset("r2flow_small")
    with pytest.raises(ConfigError, match=r"without training\.reflow"):
        train(replace(preset, model=replace(preset.model, reflow=ReflowConfig())), tmp_path)


def test_a_folder_is_trained_in_by_one_process_at_a_time(tmp_path):
    with (
        claim_folder(tmp_path / "run"),
        pytest.raises(OutputError, match=rf"run, which process {os.getpid()} on .* since 2\d\d\d-.* is writing"),
    ):
        train(load_preset("lidargrit_demo", TINY), tmp_path / "run")
    train(load_preset("lidargrit_demo", TINY), tmp_path / "run")
    assert not [path for path in (tmp_path / "run").rglob("*") if path.name.startswith(".")]


def test_pictures_change_nothing(tmp_path, whole, monkeypatch):
    monkeypatch.setattr("lidargrit.viewer._matplotlib._DOTS_PER_INCH", 20)
    every = [f"training.{stage}.pictures_every=12" for stage in ("tokenizer", "transformer")]
    train(load_preset("lidargrit_demo", TINY + every), tmp_path / "drawn", plot=plot_progress)
    plain, drawn = (
        (folder / "model.safetensors").read_bytes() for folder in (whole("lidargrit_demo"), tmp_path / "drawn")
    )
    assert plain == drawn
    pictures = {str(path.relative_to(tmp_path / "drawn")): path for path in (tmp_path / "drawn").rglob("*.png")}
    assert pictures.keys() == {f"{stage}/pictures/000000012.png" for stage in ("tokenizer", "transformer")}
    heights = {name: int.from_bytes(path.read_bytes()[20:24], "big") for name, path in pictures.items()}  # of a PNG
    assert heights["transformer/pictures/000000012.png"] > heights["tokenizer/pictures/000000012.png"]


def test_the_memory_of_weights_is_what_a_step_leaves_behind(images):
    vqvae = Vqvae(load_preset("lidargrit_demo", TINY).model.tokenizer, images.sensor)
    optimiser = make_optimiser(vqvae, TrainingConfig(scans=1, batch_size=1, learning_rate=1e-3))
    average = WeightAverage(vqvae, 1)
    vqvae(Example(images.batch([0])), torch.Generator())["loss"].backward()
    optimiser.step()
    held = [*vqvae.state_dict().values(), *average.objective.state_dict().values()]
    held += [parameter.grad for parameter in vqvae.parameters() if parameter.grad is not None]
    held += [value for state in optimiser.state.values() for name, value in state.items() if name != "step"]
    assert memory_of_weights(vqvae) == sum(tensor.nbytes for tensor in held)


def test_a_measured_plan_tells_operations_time_and_memory():
    preset = load_preset("lidargrit_demo", TINY)
    lines = [stage.as_text() for stage in measure(preset)]
    for line, (stage, flops) in zip(lines, training_flops(preset).items(), strict=True):
        wanted = rf"{stage}: {flops:.2e} floating-point operations at [\d.e+]+ scans/s: [\d.]+ \w+ on cpu, [\d.]+ GiB"
        assert re.fullmatch(wanted.replace("e+", "e\\+", 1), line)


def test_lines_that_are_no_entries_of_a_log_are_passed_over(tmp_path):
    good = '{"scans_seen": 4, "split": "train", "seconds": 1.5}\n'
    bad = [
        "{}",
        "[]",
        "null",
        '{"scans_seen": "4", "seconds": 1}',
        "[" * 50_000,
        '{"a": 1e400}',
        '{"scans_seen": 4, "se',
    ]
    content = "".join(f"{line}\n" for line in (good.strip(), *bad, good.strip())).encode() + b"\xff\xfe"
    (tmp_path / "log.jsonl").write_bytes(content)
    assert [entry["seconds"] for entry in read_log(tmp_path / "log.jsonl")] == [1.5, 1.5]
    Log(tmp_path, 4).write("val", 8, 2.0, {"loss": float("nan")})
    lines = (tmp_path / "log.jsonl").read_text().splitlines()
    assert lines[:-1] == [good.strip()] * 2
    assert json.loads(lines[-1])["loss"] is None


def test_tensorboard_draws_what_the_log_says(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = Log(tmp_path, 0)
    log.write("train", 4, 1.0, {"loss": 0.5})
    log.write("train", 8, 2.0, {"loss": 0.25})
    log.close()
    again = Log(tmp_path, 4)  # killed after the checkpoint at 4 scans
    again.write("train", 8, 2.0, {"loss": 0.125})
    again.close()
    seen = EventAccumulator(str(tmp_path)).Reload().Scalars("loss/train")
    assert [(event.step, event.value) for event in seen] == [(4, 0.5), (8, 0.125)]
    assert [json.loads(line)["loss"] for line in (tmp_path / "log.jsonl").read_text().splitlines()] == [0.5, 0.125]


def test_the_log_is_written_without_tensorboard(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    (log := Log(tmp_path, 0)).write("train", 4, 1.0, {"loss": 0.5})
    log.close()
    assert [path.name for path in tmp_path.iterdir()] == ["log.jsonl"]


def test_a_checkpoint_that_does_not_fit_its_optimiser_is_refused(tmp_path):
    path, layer = tmp_path / "checkpoint.safetensors", OneWeight(load_sensor("vlp16"))
    layer.bias = torch.nn.Parameter(torch.ones(3))
    optimiser = torch.optim.AdamW(layer.parameters())
    (layer.weight.sum() + layer.bias.sum()).backward()
    optimiser.step()
    average = WeightAverage(layer, 0)
    save_checkpoint(path, layer, average, optimiser, 8, "")
    assert load_checkpoint(path, layer, average, optimiser, "") == 8
    tensors, about = read_tensors(path)
    moment = "optimiser.0.exp_avg"
    for changed, message in (
        ({moment: torch.ones(2, 2)}, "moments of another size for weight 0"),
        ({moment: None}, "moments that some weights lack"),
        ({"optimiser.7.step": torch.ones(())}, "moments of more than 2 weights"),
        ({"optimiser.x.step": torch.ones(())}, "invalid literal"),
        ({"scans_seen": -1}, "-1 scans seen"),
        ({"scans_seen": 1e300}, "1e[+]300 scans seen"),
        ({"scans_seen": None}, "None scans seen"),
    ):
        kept = {name: of for name, of in {**tensors, **changed}.items() if isinstance(of, torch.Tensor)}
        write_tensors(path, kept, {name: changed.get(name, of) for name, of in about.items()})
        with pytest.raises(CheckpointError, match=rf"cannot be used \({message}.*train again"):
            load_checkpoint(path, layer, average, optimiser, "")


def test_a_run_to_take_stages_from_is_looked_at_before_any_scan(tmp_path):
    start = f"training.tokenizer.start={tmp_path / 'nothing'}"
    preset = load_preset("lidargrit_demo", ("data.train=nowhere", "data.val=nowhere", start))
    with pytest.raises(CheckpointError, match="nothing, which does not exist"):
        train(preset, tmp_path / "run")
    assert not (tmp_path / "run").exists()
