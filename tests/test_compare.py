"""Several systems trained, sampled and scored alike, to one table; equal compute; the arithmetic counted by hand."""

import json
import shutil
from dataclasses import replace

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from dataset_examples import write_example
from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, LidarGritError, OutputError
from lidargrit.core.files import claim_folder
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
from lidargrit.evaluation import compare
from lidargrit.evaluation.compare import CompareConfig, as_json, as_table
from lidargrit.evaluation.compare import run as run_comparison
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.evaluation.intervals import Resampling
from lidargrit.generation.generator import load_class
from lidargrit.generation.presets import load_preset
from lidargrit.nn.flops import flops_of
from lidargrit.scans.example import Example
from lidargrit.scans.marks import read_marks
from lidargrit.systems.r2flow.rectified_flow import ReflowConfig
from lidargrit.training import compute, computing_time, training_flops, with_budget
from lidargrit.training.compute import uniform_images
from lidargrit.viewer.table_page import table_page
from test_verdict import FACTS, card, score
from tiny_runs import MODEL, the_one_line

FEW = ("data.train=simulated:6:train", "data.val=simulated:2:val", "data.columns=512", "data.column_stride=8")
QUICK = EvalConfig(metrics=("bev_jsd",), resampling=Resampling(groups=4, halves=2))
NARROW = ("model.unet.channels=8", "model.unet.channel_multipliers=[1,1,1,1]", "model.unet.attention_heads=2")
COMPARISON = CompareConfig("simulated:8:test", 8, QUICK, (*FEW, "seed=3"))


@pytest.fixture(scope="module")
def one_system(tmp_path_factory):
    """Return the folder of a comparison of one system, which tests copy before they go on with it."""
    folder = tmp_path_factory.mktemp("comparison")
    run_comparison(["marginal"], folder, COMPARISON)
    return folder


def test_systems_are_made_once_and_set_side_by_side(tmp_path):
    systems = ["marginal", "memorised"]
    scores = run_comparison(systems, tmp_path, COMPARISON)
    table = as_table(scores)
    assert all(name in table for name in systems)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    assert len(before) == 16
    assert run_comparison(systems, tmp_path, COMPARISON) == scores
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")} == before
    costs = json.loads((tmp_path / "marginal" / "costs.json").read_text())
    assert costs["training_flops"] == 0
    assert costs["seconds_per_scan"] > 0
    finished = [str(tmp_path / "runs" / "marginal")]
    again = run_comparison(finished, tmp_path / "again", replace(COMPARISON, preset_settings=()))
    assert json.loads(again[0].read_text())["scores"][0]["value"] == pytest.approx(
        json.loads(scores[0].read_text())["scores"][0]["value"]
    )


def test_a_run_named_by_dots_has_the_name_of_its_folder(one_system, tmp_path, monkeypatch):
    finished = shutil.copytree(one_system / "runs" / "marginal", tmp_path / "marginal")
    wanted = replace(COMPARISON, preset_settings=())
    for here, name in ((finished, "."), (finished / "below", "..")):
        here.mkdir(exist_ok=True)
        monkeypatch.chdir(here)
        assert run_comparison([name], tmp_path / "table", wanted) == [tmp_path / "table" / "marginal" / "marginal.json"]
    assert [path.name for path in (tmp_path / "table").iterdir() if path.is_dir()] == ["marginal"]


def test_a_preset_is_trained_once_in_how_many_ways_ever_it_is_drawn_from(tmp_path, capsys):
    words = ["compare", str(tmp_path), "r2dm_small:steps=1", "r2dm_small:steps=2", "--flops", "1e9", "-n", "2"]
    assert main([*words, "--reference", "simulated:2:test", "--metrics", "bev_jsd", "--set", *FEW, *NARROW]) == 0
    output = capsys.readouterr().out
    assert "bev_jsd" in output
    assert "sliced_wasserstein" not in output
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["r2dm_small"]
    assert "r2dm_small:steps=1 " in output
    assert "r2dm_small:steps=2 " in output


def test_samples_that_are_there_are_scored_beside_systems_that_are_made(tmp_path):
    made = run_comparison(["memorised"], tmp_path / "first", COMPARISON)
    samples = str(tmp_path / "first" / "memorised" / "samples")
    paths = run_comparison(["marginal", samples], tmp_path / "both", COMPARISON)
    values = [json.loads(path.read_text())["scores"][0]["value"] for path in (*made, paths[1])]
    assert values[0] == values[1]
    costs = json.loads((paths[1].parent / "costs.json").read_text())
    assert costs["parameters"] is costs["seconds_per_scan"] is None
    cells = as_json(paths)
    assert cells[1]["scores"]["scores"][0]["pixel_statistics"] is not None, "of the row marginal, in every file"
    assert cells[1]["system"] in as_table(paths)
    assert cells[1]["system"] in table_page(cells, 0.0)
    assert json.loads(run_comparison(["marginal", samples], tmp_path / "both", COMPARISON)[1].read_text())["verdict"]
    with pytest.raises(ConfigError, match="settings of sampling for samples that are there"):
        run_comparison([f"{samples}:steps=3"], tmp_path / "wrong", COMPARISON)


@pytest.mark.parametrize(
    ("systems", "message"),
    [
        ([], "at least one"),
        (["marginal", "marginal"], "each once"),
        (["a/scores.json", "b/scores.json"], "'scores' in the table"),
        (["marginl"], "marginal"),
        (["r2dm_small:step=3"], "steps"),
    ],
)
def test_wrong_words_are_told_before_anything_is_trained(systems, message, tmp_path):
    with pytest.raises(LidarGritError, match=message):
        run_comparison(systems, tmp_path, COMPARISON)
    assert not list(tmp_path.rglob("*"))


def test_scans_of_another_sensor_are_told_before_anything_is_trained(tmp_path):
    config = DataConfig(train=(), val=(), columns=64, column_stride=8)
    prepared = prepare("simulated:2:test", config, tmp_path / "narrow")
    with pytest.raises(LidarGritError, match="narrow"):
        run_comparison(["marginal"], tmp_path / "table", replace(COMPARISON, reference=str(prepared)))
    assert not list((tmp_path / "table").rglob("run.json"))


def test_a_run_of_another_sensor_is_told_before_it_is_sampled(tmp_path):
    prepared = prepare("simulated:2:test", DataConfig(columns=64, column_stride=8), tmp_path / "narrow")
    wanted = replace(COMPARISON, reference=str(prepared), preset_settings=())
    with pytest.raises(LidarGritError, match="narrow"):
        run_comparison(["pretrained"], tmp_path / "table", wanted)
    assert not list((tmp_path / "table").rglob("*"))


def test_settings_that_a_later_preset_cannot_follow_are_told_before_the_first_system(tmp_path):
    wrong = replace(COMPARISON, preset_settings=(*FEW, "training.tokenizer.accumulate=3"))
    with pytest.raises(ConfigError, match="on 1 processes in 3 parts"):
        run_comparison(["pretrained", "lidargrit_demo"], tmp_path, wrong)
    assert not list(tmp_path.rglob("*"))


def test_the_reference_is_projected_once_for_all_systems_of_a_sensor(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    run_comparison(["marginal", "memorised"], tmp_path / "table", replace(COMPARISON, num_samples=4))
    assert len(list((tmp_path / "cache").iterdir())) == 3, "train, val and the four scans that are compared"


def test_bounds_of_another_data_set_are_warned_of(tmp_path, capsys):
    write_example("kitti_odometry", tmp_path / "real", 2)
    words = ["-n", "2", "--metrics", "bev_jsd", "--reference", str(tmp_path / "real")]
    assert main(["compare", str(tmp_path / "table"), "marginal", "memorised", *words, "--set", *FEW]) == 0
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "bound no score" in line)
    assert line.startswith("WARNING: marginal and memorised would learn from simulated:6:train, another data set ")
    assert "--set data.train=FOLDER data.val=FOLDER" in line
    own = [f"data.train={tmp_path / 'real'}", f"data.val={tmp_path / 'real'}", *FEW[2:]]
    assert main(["compare", str(tmp_path / "own"), "marginal", *words, "--set", *own]) == 0
    assert "bound no score" not in capsys.readouterr().err


def test_training_flops_are_three_forward_passes_of_a_plain_stack():
    preset = load_preset("r2dm_small", FEW)
    network = load_preset("r2dm_small", FEW).model
    counted = training_flops(preset)["diffusion"] / preset.training["diffusion"].scans
    from lidargrit.systems.r2dm.system import R2dm

    generator = R2dm(network, preset.data.load_sensor())
    one_pass = generator.cost(replace(generator.Sampling(), steps=1)).flops
    assert 2.8 * one_pass < counted < 3.0 * one_pass  # the first layer needs no gradient of its input


@pytest.fixture(autouse=True)
def _counted_once(monkeypatch):
    """Count the operations of no preset twice in a test, which takes seconds; budgets count by it, too."""
    counted, count = {}, compute.stage_costs

    def costs(preset):
        if repr(preset) not in counted:
            counted[repr(preset)] = count(preset)
        return counted[repr(preset)]

    monkeypatch.setattr(compute, "stage_costs", costs)


def test_a_budget_scales_all_stages_alike():
    preset = load_preset("lidargrit_demo", MODEL)
    cost = sum(training_flops(preset).values())
    half = with_budget(preset, cost / 2)
    for stage, fit in preset.training.items():
        assert half.training[stage].scans == pytest.approx(fit.scans / 2, abs=fit.batch_size)
    assert with_budget(load_preset("marginal"), 1.0) == load_preset("marginal")
    vae = load_preset("lidarvae_small")
    short = with_budget(vae, sum(training_flops(vae).values()) / 4)
    assert short.model.warmup_scans == pytest.approx(vae.model.warmup_scans / 4, rel=0.01)
    with pytest.raises(ConfigError, match="at least one batch") as refused:
        with_budget(preset, 1e6)
    enough = with_budget(preset, float(refused.value.cure.removeprefix("raise it to ")))
    assert all(fit.scans >= fit.batch_size for fit in enough.training.values())
    lacking = load_preset("r2flow_small", ["model.hdit.depths=[1,1]", "model.hdit.heads=[1,1]"])
    lacking = replace(lacking, model=replace(lacking.model, reflow=ReflowConfig()))
    for count in (training_flops, lambda preset: with_budget(preset, 1e13)):
        with pytest.raises(ConfigError, match=r"without training\.reflow, a stage of model=r2flow"):
            count(lacking)


def test_images_that_only_count_mark_surfaces_that_return():
    marked = read_marks(uniform_images(load_preset("lidargrit_demo", MODEL).data.load_sensor(), 1).reflectance)
    assert marked.is_clear
    assert marked.has_reflectance


def test_stages_that_are_taken_from_another_run_are_not_counted():
    preset = load_preset(
        "lidargrit_compact_pixels",
        [f"training.{stage}.start=frozen:pretrained" for stage in ("tokenizer", "transformer")],
    )
    flops = training_flops(preset)
    assert list(flops) == ["pixels"]
    scaled = with_budget(preset, flops["pixels"] / 4)
    assert scaled.training["pixels"].scans == pytest.approx(preset.training["pixels"].scans / 4, rel=0.01)
    assert {**scaled.training, "pixels": None} == {**preset.training, "pixels": None}


def test_a_budget_counts_what_is_prepared_once(monkeypatch):
    """As a reflow's pairs: one for each training image, however many scans are seen."""

    cost = compute.StageCost(100.0, lambda scans: 900 * min(scans, 50))
    monkeypatch.setattr(compute, "stage_costs", lambda preset: {"tokenizer": cost})
    preset = load_preset("lidargrit_demo", ["training.tokenizer.scans=4000", "training.tokenizer.batch_size=1"])
    preset = replace(preset, training={"tokenizer": preset.training["tokenizer"]})
    for budget in (20_000.0, 60_000.0, 200_000.0, 2_000_000.0):
        scans = with_budget(preset, budget).training["tokenizer"].scans
        assert 100 * scans + 900 * min(scans, 50) == pytest.approx(budget, rel=0.021)


def test_a_run_of_another_preset_is_not_taken_for_this_one(one_system):
    other = replace(COMPARISON, preset_settings=("data.train=simulated:5:train", *COMPARISON.preset_settings[1:]))
    with pytest.raises(LidarGritError, match="which holds another run"):
        run_comparison(["marginal"], one_system, other)


def test_as_many_are_scored_as_were_asked_for(one_system, tmp_path):
    shutil.copytree(one_system, tmp_path, dirs_exist_ok=True)
    fewer = run_comparison(["marginal"], tmp_path, replace(COMPARISON, num_samples=4))
    assert json.loads(fewer[0].read_text())["inputs"]["samples"]["scans_used"] == 4


def test_what_all_are_scored_by_is_looked_at_first(tmp_path):
    with pytest.raises(LidarGritError):
        run_comparison(["marginal"], tmp_path, replace(COMPARISON, reference="no such folder"))
    assert not list(tmp_path.rglob("*"))
    with pytest.raises(LidarGritError, match="nope"):
        replace(QUICK, protocol="nope")


def test_attention_counts_in_training_flops():
    preset = load_preset("lidargrit_small", ("data.train=simulated:6:train", *FEW[2:]))
    flops, scans = training_flops(preset)["transformer"], preset.training["transformer"].scans
    generator = load_class("lidargrit")(preset.model, preset.data.load_sensor())
    tokens, sizes = generator.transformer.context_length, preset.model.transformer
    products = 3 * tokens * (24 * sizes.layers * sizes.width**2 + 2 * sizes.width * generator.transformer.num_tokens)
    attention = 3 * sizes.layers * 4 * sizes.width * tokens**2
    encoding = flops_of(generator.tokenizer.encoder, (1, 1, preset.data.load_sensor().height, 64))
    assert flops / scans == pytest.approx(products + attention + encoding, rel=0.05)


@pytest.mark.parametrize(
    ("preset", "stage"),
    [("lidargrit_demo", "tokenizer"), ("maskgit_demo", "transformer")],
)
def test_counted_operations_are_those_of_a_step_that_is_computed(preset, stage):
    preset = load_preset(preset, MODEL)
    objective = preset.build_generator().objective(stage).train()
    with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
        images = uniform_images(preset.data.load_sensor(), 2)
        objective(Example(images), torch.Generator().manual_seed(0))["loss"].backward()
    counted = training_flops(preset)[stage] / preset.training[stage].scans
    assert counted == pytest.approx(counter.get_total_flops() / 2, rel=1e-6)


SMALL = "ultralidar_small lidargen_small r2flow_small maskgit_small lidm_small lidargrit_fine_small lidarvae_small"


@pytest.mark.parametrize("preset", [*SMALL.split(), "dusty_kitti_odometry", "lidargrit_fine_wide"])
def test_operations_are_counted_without_computing_them(preset, monkeypatch):
    """Else a dry run of a wide network takes minutes: frozen networks, caches and counters count, too."""
    monkeypatch.delattr(compute, "_cost_with_values")
    preset = load_preset(preset)
    assert training_flops(preset).keys() == preset.training.keys()


def test_a_penalty_that_comes_rarely_is_counted_as_rarely():
    def flops(*settings):
        words = (*FEW, "model.latent_dim=8", "model.channels=4", "model.max_channels=8", *settings)
        return training_flops(load_preset("dusty_small", words))["adversarial"]

    none, half, always = flops("model.penalty_weight=0"), flops("model.penalty_every=2"), flops("model.penalty_every=1")
    assert none < half < always
    assert half == pytest.approx((none + always) / 2, rel=1e-6)


def test_an_a100_takes_days_or_minutes():
    assert "3.9 days on one A100 at 25%" in computing_time(1643 * 10**15, "fp32")
    assert "21.4 min on one A100" in computing_time(10**17, "auto")
    assert "A100" not in computing_time(10**15, "auto")


def test_processes_make_a_table_that_can_be_extended(tmp_path, capfd):
    words = ["--reference", "simulated:4:test", "-n", "4", "--metrics", "bev_jsd", "--set", *FEW]
    assert main(["compare", str(tmp_path), "marginal", "memorised", "--workers", "2", *words]) == 0
    output = capfd.readouterr().err
    assert "1 of 2 systems are done; left, for about" in output
    assert "marginal: marginal:" in output, "lines of processes begin with the run"
    run = str(tmp_path / "runs" / "marginal")
    capfd.readouterr()
    assert main(["compare", str(tmp_path), "--add", run]) == 0
    output = capfd.readouterr().err
    assert "1 of 3 systems are done; left: memorised" in output, "no time, by systems that were there already"
    table = json.loads((tmp_path / "table.json").read_text())
    assert table["systems"] == ["marginal", "memorised", run]
    first, _, again = ([score["value"] for score in cell["scores"]["scores"]] for cell in table["cells"])
    assert first == again
    assert (tmp_path / "table.html").read_text().count("<tr>") == 1 + 3 + 1
    for wrong, got in (
        (["--add", "lidargrit_small", "-n", "5"], "--add with settings of its own (-n)"),
        (
            ["--add", "lidargrit_small", "--reference", "simulated:256:test"],
            "--add with settings of its own (--reference)",
        ),
        (["lidargrit_small", "--add", "lidargrit_demo"], "--add with systems before it"),
        (["--add", str(tmp_path)], f"{tmp_path}, a folder that holds no finished run"),
    ):
        capfd.readouterr()
        assert main(["compare", str(tmp_path), *wrong]) == 2
        assert f"got {got}; " in the_one_line(capfd.readouterr().err, "compare")
    assert main(["compare", str(tmp_path / "none"), "--add", "marginal"]) == 2
    assert "none, which holds no table.json" in the_one_line(capfd.readouterr().err, "compare")


def cell_of(system, sha256="ab", metric="bev_jsd", source="real"):
    facts = replace(FACTS, scans_used=4, sha256=sha256, source=source)
    scores = card(score(0.5, 0.25, metric=metric), facts=facts, warnings=("4 scans were damaged",)).to_json()
    return {"system": system, "costs": {"parameters": 3}, "scores": json.loads(json.dumps(scores))}


def test_a_page_has_a_table_for_each_reference():
    page = table_page([cell_of("a"), cell_of("b", "cd"), cell_of("c")], 0.0)
    first, _, second = page.split("<table>")[1:]  # the second holds the differences of a and c
    assert [name in first for name in (">a<", ">b<", ">c<")] == [True, False, True]
    assert ">b<" in second
    assert first.count("real against real") == second.count("real against real") == 1
    assert "<li>a, c: 4 scans were damaged</li>" in page
    assert "<li>b: No verdict: 4 scans in each set are too few" in page


def test_a_page_of_foreign_names_holds_no_code_of_theirs():
    page = table_page([cell_of("<script>alert(1)</script>", metric="<b>", source="<i>")], 0.0)
    assert "<i>" not in page
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page
    assert page.count("<script>") == 1
    assert "0.25" in page


def test_metrics_of_which_none_can_be_made_are_refused_before_training(tmp_path, monkeypatch):
    monkeypatch.setattr(compare, "train", lambda *_: pytest.fail("trained"))

    def no_weights(*_args, **_options):
        raise LidarGritError("no weights", "weights", "get them")

    monkeypatch.setattr(compare, "metric_factory", lambda *_args, **_options: no_weights)
    with pytest.raises(LidarGritError, match="no weights"):
        run_comparison(["marginal"], tmp_path / "table", COMPARISON)


def test_a_second_comparison_in_the_same_folder_is_refused(tmp_path):
    with claim_folder(tmp_path), pytest.raises(OutputError, match=r"which process \d+ on .* is writing"):
        run_comparison(["marginal"], tmp_path, COMPARISON)


def test_a_folder_that_cannot_be_is_refused_before_the_reference_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(compare, "_check_reference", lambda *_: pytest.fail("it read the reference first"))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="File exists"):
        run_comparison(["marginal"], tmp_path / "file", COMPARISON)
