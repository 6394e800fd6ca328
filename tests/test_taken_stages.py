"""Stages that a preset takes from another run: as they are, trained further, or not at all."""

import json
from dataclasses import replace

import pytest
import torch

from lidargrit.core.configuration import changed, override
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.core.files import read_tensors
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load, load_class
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.systems.lidargrit.system import TokenSampling
from lidargrit.systems.maskgit.system import MaskGitConfig
from lidargrit.training import plan_training, train
from lidargrit.training.plan import check_stages
from lidargrit.training.taken_stages import taken_facts, taken_stages
from test_pixel_stage import PIXELS, SENSOR, TOKENIZER, TRANSFORMER, made, preset_of

ALL = ("tokenizer", "transformer", "pixels")


def starting(preset: Preset, run: object, frozen: tuple[str, ...] = (), further: tuple[str, ...] = ()) -> Preset:
    """Return a preset whose named stages start from a run, and whose others are new."""
    starts = {
        **dict.fromkeys(preset.training, ""),
        **dict.fromkeys(frozen, f"frozen:{run}"),
        **dict.fromkeys(further, str(run)),
    }
    return changed(preset, {f"training.{stage}.start": start for stage, start in starts.items()})


def test_only_the_pixel_decoder_is_trained_over_a_finished_run(tmp_path):
    first = train(preset_of(None), tmp_path / "first")
    second = train(starting(preset_of(PIXELS), tmp_path / "first", ALL[:2]), tmp_path / "second")
    assert not (tmp_path / "second" / "tokenizer").exists()
    assert not (tmp_path / "second" / "transformer").exists()
    for name, weight in first.state_dict().items():
        assert torch.equal(weight, second.state_dict()[name]), name
    assert torch.equal(first.sample([2]).range_m, second.sample([2], sampling=TokenSampling(mask="bernoulli")).range_m)


def test_fine_tuning_starts_from_the_weights_of_the_other_run(tmp_path):
    donor = made()
    donor.save(tmp_path / "donor")
    fit = TrainingConfig(scans=2, batch_size=2, learning_rate=1e-6, validation_scans=1)
    preset = replace(preset_of(PIXELS), training=dict.fromkeys(ALL, fit))
    preset = starting(preset, tmp_path / "donor", frozen=ALL[:2], further=("pixels",))
    tuned = train(preset, tmp_path / "run").state_dict()
    assert not (tmp_path / "run" / "transformer").exists()
    for stage in ("tokenizer", "transformer", "pixels"):
        moved = [
            float((tuned[name] - weight).abs().max())
            for name, weight in donor.state_dict().items()
            if name.startswith(stage) and not name.endswith("noise.sums")  # which learn from each scan at once
        ]
        assert max(moved) < 1e-4, "the weights are those of the donor, but for a step of the learning rate"
        assert (max(moved) > 0) == (stage == "pixels")
    with pytest.raises(ConfigError, match=r"the setting 'training\.mask\.start'"):
        override(preset, ["training.mask.start=pretrained"])
    with pytest.raises(ConfigError, match="start=frozen:; wanted frozen:RUN"):
        override(preset, ["training.pixels.start=frozen:"])


@pytest.mark.parametrize("further", [False, True])
def test_a_stage_over_a_tokenizer_that_is_trained_again_is_refused(tmp_path, further):
    made().save(tmp_path / "donor")
    preset, run = preset_of(PIXELS), tmp_path / "donor"

    def trained(*names: str) -> Preset:
        others = tuple(stage for stage in ALL if stage not in names)
        return starting(preset, run, others, names if further else ())

    for names in (("tokenizer",), ("tokenizer", "pixels")):
        wrong = trained(*names)
        message = r"training\.transformer\.start=frozen:\S+ without training\.tokenizer\.start=frozen:"
        with pytest.raises(ConfigError, match=message):
            taken_stages(wrong, wrong.build_generator())
    with pytest.raises(ConfigError, match=r"training\.pixels\.start=frozen:\S+ without training\.tokenizer\.start"):
        check_stages(trained("tokenizer", "transformer"))
    right = trained(*ALL)
    assert set(taken_stages(right, right.build_generator())) == ({*ALL} if further else set())


def test_stages_are_taken_from_several_runs_unless_one_rests_on_another(tmp_path):
    for name in ("first", "second"):
        made().save(tmp_path / name)
    preset = starting(preset_of(PIXELS), tmp_path / "first", frozen=("tokenizer",))
    second = tmp_path / "second"
    further = changed(preset, {"training.transformer.start": str(second)})
    assert taken_stages(further, further.build_generator()).keys() == {"tokenizer", "transformer"}
    over = changed(preset, {"training.transformer.start": f"frozen:{second}"})
    with pytest.raises(ConfigError, match="the transformer learned from that tokenizer"):
        taken_stages(over, over.build_generator())


def test_settings_of_a_stage_that_is_not_trained_are_not_looked_at(tmp_path, monkeypatch):
    made(None).save(tmp_path / "donor")
    loaded = []
    monkeypatch.setattr("lidargrit.training.taken_stages.load", lambda run: loaded.append(run) or load(run))
    preset = changed(preset_of(PIXELS), {"training.pixels.batch_size": 6})  # 3 processes cannot share a batch of 2
    preset = starting(preset, tmp_path / "donor", ("tokenizer", "transformer"))
    checked = check_stages(preset, processes=3)
    assert len(loaded) == 1, "a run of two stages is read once"
    assert checked.frozen == dict.fromkeys(("tokenizer", "transformer"), str(tmp_path / "donor"))
    assert list(checked.objectives) == ["tokenizer", "transformer", "pixels"]
    assert [stage.scans for stage in plan_training(preset).stages] == [0, 0, 4]
    with pytest.raises(ConfigError, match="batch_size=2 on 3 processes"):
        check_stages(starting(preset, tmp_path / "donor"), processes=3)
    without = {stage: config for stage, config in preset.training.items() if stage != "transformer"}
    with pytest.raises(ConfigError, match=r"without training\.transformer"):
        check_stages(replace(preset, training=without), processes=3)


def test_a_stage_that_was_trained_with_another_dropout_is_taken(tmp_path):
    """The page about training gives this command."""
    load_preset("lidargrit_compact").build_generator().save(tmp_path / "compact")
    checked = check_stages(starting(load_preset("lidargrit_compact_pixels"), tmp_path / "compact", ALL[:2]))
    assert checked.frozen == dict.fromkeys(("tokenizer", "transformer"), str(tmp_path / "compact"))


def test_a_stage_that_does_not_fit_is_told_before_any_scan(tmp_path):
    made(None).save(tmp_path / "donor")
    preset = starting(preset_of(PIXELS), tmp_path / "donor", ALL[:2])
    wider = replace(preset.model, transformer=replace(TRANSFORMER, width=32))
    preset = replace(preset, model=wider, data=replace(preset.data, train=("nowhere",)))
    with pytest.raises(ConfigError, match="whose transformer is another"):
        train(preset, tmp_path / "run")
    assert not (tmp_path / "run").exists()


SENSORS = ("hdl64e_kitti_odometry", "hdl64e_kitti_360")


@pytest.mark.parametrize("kind", ["r2dm", "r2flow"])
def test_rays_of_another_sensor_are_not_taken_over(kind):
    theirs, ours = (DataConfig(sensor=name, columns=1024, column_stride=8).load_sensor() for name in SENSORS)
    donor, own = (load_class(kind)(load_class(kind).smallest_config(each), each) for each in (theirs, ours))
    stage = own.stages[0]
    taken = own.objective(stage).weights_from(donor.objective(stage))
    assert "network.coords" not in taken
    assert "network.coords" in own.objective(stage).weights_from(own.objective(stage))
    assert taken.keys() | {"network.coords"} == own.objective(stage).state_dict().keys()


def test_fine_tuning_takes_a_run_of_fewer_columns_and_another_dropout(tmp_path):
    made().save(tmp_path / "donor")
    preset = starting(preset_of(PIXELS), tmp_path / "donor", ALL)
    wide = replace(preset, data=replace(preset.data, columns=512, column_stride=4))
    wide = replace(wide, model=replace(wide.model, transformer=replace(TRANSFORMER, residual_dropout=0.0)))
    with pytest.raises(ConfigError, match="whose tokenizer is another"):
        taken_stages(wide, wide.build_generator())
    wide = starting(wide, tmp_path / "donor", further=ALL)
    generator = wide.build_generator()
    objective = generator.objective("transformer")
    weights = objective.weights_from(taken_stages(wide, generator)["transformer"])
    objective.load_state_dict(weights)
    fine = generator.transformer.pos_emb.unflatten(1, generator.tokenizer.grid_size)
    coarse = made().transformer.pos_emb.unflatten(1, (8, 8))
    assert fine.shape[2] == 2 * coarse.shape[2]
    # Two new columns lie in each old one, a quarter of its width to either side of its centre.
    assert torch.allclose(fine[:, :, 2], 0.75 * coarse[:, :, 1] + 0.25 * coarse[:, :, 0])


@pytest.mark.parametrize("kind", ["frozen", "further"])
def test_settings_of_sampling_alone_are_the_preset_s_own(kind, tmp_path):
    made().save(tmp_path / "donor")
    preset = starting(preset_of(replace(PIXELS, range_temperature=0.1)), tmp_path / "donor", **{kind: ALL})
    preset = replace(preset, model=replace(preset.model, guidance=1.5))
    generator = preset.build_generator()
    assert {"transformer", "pixels"} <= set(taken_stages(preset, generator))
    assert (generator.pixels.config.range_temperature, generator.config.guidance) == (0.1, 1.5)


def test_a_run_of_other_sizes_or_another_kind_gives_no_stages(tmp_path):
    train(preset_of(None), tmp_path / "first")
    preset = starting(preset_of(PIXELS), tmp_path / "first", ALL[:2])
    wider = replace(preset, model=replace(preset.model, transformer=replace(TRANSFORMER, width=32)))
    with pytest.raises(ConfigError, match=r"whose transformer is another \(model.transformer.width=16\)"):
        train(wider, tmp_path / "second")
    other = replace(preset, generator="maskgit", model=MaskGitConfig(TOKENIZER, TRANSFORMER, PIXELS))
    with pytest.raises(ConfigError, match="a run of the generator 'lidargrit'"):
        train(other, tmp_path / "third")
    anew = starting(preset, tmp_path / "first", ("tokenizer",))
    assert taken_stages(anew, anew.build_generator()).keys() == {"tokenizer"}
    lacking = starting(preset, tmp_path / "first", ALL)
    with pytest.raises(ConfigError, match="wanted a run of 'lidargrit', or of another with the same stage 'pixels'"):
        check_stages(lacking)


def test_a_stage_whose_settings_do_not_have_its_name_is_compared_by_all_of_them(tmp_path):
    small = ("model.unet.channel_multipliers=[1,1,1,1]", "data.column_stride=1", "data.columns=64")
    donor = load_preset("r2dm_small", small).build_generator()
    donor.save(tmp_path)
    start = f"training.diffusion.start=frozen:{tmp_path}"
    preset = load_preset("r2dm_small", (*small, start))
    assert taken_stages(preset, preset.build_generator()).keys() == {"diffusion"}
    other = load_preset("r2dm_small", (*small, "model.unet.norm_groups=2", start))
    with pytest.raises(ConfigError, match=r"whose diffusion is another \(model\.unet\.norm_groups="):
        taken_stages(other, other.build_generator())
    columns = (small[0], "data.column_stride=2", "data.columns=128")
    taken = load_preset("r2dm_small", (*columns, start))
    with pytest.raises(ConfigError, match=r"whose diffusion is another \(data\.sensor\)"):
        taken_stages(taken, taken.build_generator())
    tuned = load_preset("r2dm_small", (*columns, f"training.diffusion.start={tmp_path}"))
    assert taken_stages(tuned, tuned.build_generator()).keys() == {"diffusion"}


@pytest.mark.parametrize("name", ["lidargan", "lidarvae"])
def test_a_taken_network_keeps_the_scale_of_its_images(name):
    donor, generator = (load_class(name)(load_class(name).smallest_config(SENSOR), SENSOR) for _ in range(2))
    donor.image.scale_m.fill_(37)
    (stage,) = donor.stages
    generator.load_stage(stage, donor.objective(stage))
    assert float(generator.image.scale_m) == 37


@pytest.mark.parametrize("setting", ["latent_axes=8", "latent_axes=2", "scale_latents=false"])
def test_a_denoiser_is_compared_by_the_noise_and_the_latents_that_it_learned(tmp_path, setting):
    small = ("model.tokenizer.channels=32", "model.denoiser.channels=32", "model.tokenizer.num_codes=16")
    donor = load_preset("lidm_small", small).build_generator()
    donor.save(tmp_path)
    words = [*small, f"model.{setting}", f"training.tokenizer.start=frozen:{tmp_path}"]
    words += ["model.scale_latents=false"] if "axes" in setting else []
    for frozen in ("frozen:", ""):
        other = load_preset("lidm_small", (*words, f"training.denoiser.start={frozen}{tmp_path}"))
        name = "scale_latents" if "axes" in setting else setting.partition("=")[0]
        with pytest.raises(ConfigError, match=rf"denoiser is another \(model\.{name}=.*one of this preset's model "):
            taken_stages(other, other.build_generator())
    anew = load_preset("lidm_small", words)
    assert taken_stages(anew, anew.build_generator()).keys() == {"tokenizer"}


def test_a_denoiser_that_is_trained_further_takes_the_scale_of_its_own_codebook():
    small = ("model.tokenizer.channels=32", "model.denoiser.channels=32", "model.tokenizer.num_codes=16")
    axes = ("model.scale_latents=false", "model.latent_axes=2")
    for sets in (small, (*small, *axes)):
        donor, generator = (load_preset("lidm_small", sets).build_generator() for _ in range(2))
        trained = donor.objective("denoiser")
        generator.tokenizer.load_state_dict(donor.tokenizer.state_dict())
        whole = generator.objective("denoiser").weights_from(trained)
        assert whole.keys() == trained.state_dict().keys(), "of the same codebook all is taken"
        with torch.no_grad():
            generator.tokenizer.quantize.embedding.weight.mul_(50)
        objective = generator.objective("denoiser")
        weights = objective.weights_from(trained)
        assert weights.keys() == {name for name in trained.state_dict() if name.startswith("denoiser.")}
        objective.load_state_dict({**objective.state_dict(), **weights})
        generator.load_stage("denoiser", objective)
        own = generator.tokenizer.quantize.spread() if generator.axes is None else objective.axes.scale
        assert torch.equal(generator.latent_scale if generator.axes is None else generator.axes.scale, own)
        assert all(torch.equal(weight, generator.denoiser.state_dict()[name[9:]]) for name, weight in weights.items())


def test_a_gan_that_is_trained_further_keeps_its_discriminator(tmp_path):
    fit = TrainingConfig(scans=2, batch_size=2, learning_rate=1e-3, validation_scans=1)
    data = DataConfig(train=("simulated:4:train",), val=("simulated:1:val",), columns=512, column_stride=8)
    model = load_class("dusty").smallest_config(SENSOR)
    preset = Preset("a test", "dusty", model, data, {"adversarial": fit})
    train(preset, tmp_path / "gan")
    tuned = starting(preset, tmp_path / "gan", further=("adversarial",))
    taken = taken_stages(tuned, tuned.build_generator())["adversarial"].state_dict()
    saved, _ = read_tensors(tmp_path / "gan" / "adversarial" / "checkpoint.safetensors")
    of_discriminator = [name for name in taken if name.startswith("discriminator")]
    assert of_discriminator
    assert all(torch.equal(taken[name], saved[f"average.{name}"]) for name in taken)
    (tmp_path / "gan" / "adversarial" / "checkpoint.safetensors").unlink()
    with pytest.raises(ConfigError, match=r"training\.adversarial\.start=\S+ without .*trained discriminator"):
        check_stages(tuned)
    assert not check_stages(preset).frozen


def test_a_stage_whose_sizes_another_stage_decides_is_refused_before_any_training(tmp_path):
    made().save(tmp_path)
    preset = starting(preset_of(None), tmp_path, further=("transformer",))
    check_stages(preset)
    other = replace(preset.model, tokenizer=replace(TOKENIZER, num_codes=TOKENIZER.num_codes // 2))
    with pytest.raises(ConfigError, match=r"whose transformer is another \(\S+ of \d+"):
        check_stages(replace(preset, model=other))


def test_plans_of_a_denoiser_that_is_trained_further_need_no_values(tmp_path):
    small = ("model.tokenizer.channels=32", "model.denoiser.channels=32", "model.tokenizer.num_codes=16")
    load_preset("lidm_small", small).build_generator().save(tmp_path)
    starts = (f"training.tokenizer.start=frozen:{tmp_path}", f"training.denoiser.start={tmp_path}")
    tuned = load_preset("lidm_small", (*small, *starts))
    assert check_stages(tuned).frozen.keys() == {"tokenizer"}


def test_one_reflow_is_distilled_to_several_numbers_of_steps(tmp_path):
    small = ("model.hdit.depths=[1,1]", "model.hdit.heads=[1,2]")
    load_preset("r2flow_small_reflow", (*small, "model.reflow.distilled_steps=4")).build_generator().save(tmp_path)
    start = [f"training.{stage}.start=frozen:{tmp_path}" for stage in ("flow", "reflow", "distillation")]
    taken = (*small, *start, "model.reflow.distilled_steps=2")
    preset = load_preset("r2flow_small_reflow", (*taken, "training.distillation.start="))
    assert check_stages(preset).frozen.keys() == {"flow", "reflow"}
    with pytest.raises(ConfigError, match=r"whose distillation is another \(model\.reflow\.distilled_steps=4\)"):
        check_stages(load_preset("r2flow_small_reflow", taken))


@pytest.mark.parametrize(
    "about",
    [{"preset": "x"}, {"preset": {"data": 3}}, {"preset": {"data": {"train": None}}}, {"files": 3}, {"taken": [1]}],
)
def test_a_donor_whose_facts_have_another_shape_is_told_in_one_line(about, tmp_path):
    (tmp_path / "run.json").write_text(json.dumps(about))
    with pytest.raises(CheckpointError, match=r"run\.json, which cannot be used .*; restore the file"):
        taken_facts(starting(preset_of(None), tmp_path, ALL[:1]))


def test_runs_that_are_no_donors(tmp_path):
    made().save(tmp_path)
    with pytest.raises(ConfigError, match="a run of 'r2dm', or of another with the same stage 'diffusion'; choose"):
        check_stages(load_preset("r2dm_small", (f"training.diffusion.start={tmp_path}",)))
    with pytest.raises(ConfigError, match=r"; set training\.segmenter\.start=pretrained/segmenter"):
        check_stages(load_preset("segmenter_compact", ("training.segmenter.start=pretrained",)))
    check_stages(load_preset("segmenter_compact", ("training.segmenter.start=pretrained/segmenter",)))
    nothing = load_preset("lidargrit_small", ("training.tokenizer.start=",))
    assert nothing.start_runs == nothing.frozen == {}
