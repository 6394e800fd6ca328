"""Stages that a preset takes from another run: as they are, trained further, or not at all."""

from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.core.files import read_tensors
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load_class
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.systems.lidargrit.system import TokenSampling
from lidargrit.systems.maskgit.system import MaskGitConfig
from lidargrit.training import plan_training, train
from lidargrit.training.plan import check_stages
from lidargrit.training.taken_stages import taken_stages
from test_pixel_stage import PIXELS, SENSOR, TOKENIZER, TRANSFORMER, made, preset_of


def test_only_the_pixel_decoder_is_trained_over_a_finished_run(tmp_path):
    first = train(preset_of(None), tmp_path / "first")
    second = train(preset_of(PIXELS, stages_from=str(tmp_path / "first")), tmp_path / "second")
    assert not (tmp_path / "second" / "tokenizer").exists()
    assert not (tmp_path / "second" / "transformer").exists()
    for name, weight in first.state_dict().items():
        assert torch.equal(weight, second.state_dict()[name]), name
    assert torch.equal(first.sample([2]).range_m, second.sample([2], sampling=TokenSampling(mask="bernoulli")).range_m)


def test_fine_tuning_starts_from_the_weights_of_the_other_run(tmp_path):
    donor = made()
    donor.save(tmp_path / "donor")
    fit = TrainingConfig(scans=2, batch_size=2, learning_rate=1e-6, validation_scans=1)
    preset = preset_of(PIXELS, stages_from=str(tmp_path / "donor"))
    preset = replace(preset, training=dict.fromkeys(preset.training, fit), fine_tune=("pixels",))
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
    for settings, message in (
        ({"fine_tune": ("mask",)}, "fine_tune=mask; wanted one of tokenizer, transformer, pixels"),
        (
            {"fine_tune": ("pixels",), "train_anew": ("pixels",)},
            "pixels in fine_tune and in train_anew; wanted a stage",
        ),
    ):
        wrong = replace(preset, **settings)
        with pytest.raises(ConfigError, match=message):
            taken_stages(wrong, wrong.build_generator())
    with pytest.raises(ConfigError, match="fine_tune=pixels without stages_from"):
        replace(preset, stages_from=None)
    with pytest.raises(ConfigError, match="train_anew=pixels without stages_from"):
        replace(preset, stages_from=None, fine_tune=(), train_anew=("pixels",))


@pytest.mark.parametrize("setting", ["train_anew", "fine_tune"])
def test_a_stage_over_a_tokenizer_that_is_trained_again_is_refused(tmp_path, setting):
    made().save(tmp_path / "donor")
    preset = preset_of(PIXELS, stages_from=str(tmp_path / "donor"))
    for names in (("tokenizer",), ("tokenizer", "pixels")):
        wrong = replace(preset, **{setting: names})
        with pytest.raises(ConfigError, match=f"{setting}=tokenizer without transformer, which learned from the token"):
            taken_stages(wrong, wrong.build_generator())
    with pytest.raises(ConfigError, match=f"{setting}=tokenizer without pixels"):
        check_stages(replace(preset, **{setting: ("tokenizer", "transformer")}))
    right = replace(preset, **{setting: ("tokenizer", "transformer", "pixels")})
    assert set(taken_stages(right, right.build_generator())) == ({*right.fine_tune})


def test_settings_of_a_stage_that_is_not_trained_are_not_looked_at(tmp_path):
    made(None).save(tmp_path / "donor")
    preset = preset_of(PIXELS, stages_from=str(tmp_path / "donor"))
    fits = {"tokenizer": preset.training["tokenizer"], "pixels": replace(preset.training["pixels"], batch_size=6)}
    preset = replace(preset, training=fits)  # a batch of 2 that 3 processes cannot share, and no transformer's settings
    checked = check_stages(preset, processes=3)
    assert checked.donors == dict.fromkeys(("tokenizer", "transformer"), str(tmp_path / "donor"))
    assert list(checked.objectives) == ["tokenizer", "transformer", "pixels"]
    assert [stage.scans for stage in plan_training(preset).stages] == [0, 0, 4]
    for settings, message in (
        ({"train_anew": ("tokenizer", "transformer")}, "batch_size=2 on 3 processes"),
        ({"fine_tune": ("transformer",)}, r"without training\.transformer"),
    ):
        with pytest.raises(ConfigError, match=message):
            check_stages(replace(preset, **settings), processes=3)


def test_a_stage_that_was_trained_with_another_dropout_is_taken(tmp_path):
    """The page about training gives this command."""
    load_preset("lidargrit_compact").build_generator().save(tmp_path / "compact")
    checked = check_stages(load_preset("lidargrit_compact_pixels", [f"stages_from={tmp_path / 'compact'}"]))
    assert checked.donors == dict.fromkeys(("tokenizer", "transformer"), str(tmp_path / "compact"))


def test_a_stage_that_does_not_fit_is_told_before_any_scan(tmp_path):
    made(None).save(tmp_path / "donor")
    preset = preset_of(PIXELS, stages_from=str(tmp_path / "donor"))
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
    preset = preset_of(PIXELS, stages_from=str(tmp_path / "donor"))
    wide = replace(preset, data=replace(preset.data, columns=512, column_stride=4))
    wide = replace(wide, model=replace(wide.model, transformer=replace(TRANSFORMER, residual_dropout=0.0)))
    with pytest.raises(ConfigError, match="whose tokenizer is another"):
        taken_stages(wide, wide.build_generator())
    wide = replace(wide, fine_tune=("tokenizer", "transformer", "pixels"))
    generator = wide.build_generator()
    objective = generator.objective("transformer")
    weights = objective.weights_from(taken_stages(wide, generator)["transformer"])
    objective.load_state_dict(weights)
    fine = generator.transformer.pos_emb.unflatten(1, generator.tokenizer.grid_size)
    coarse = made().transformer.pos_emb.unflatten(1, (8, 8))
    assert fine.shape[2] == 2 * coarse.shape[2]
    # Two new columns lie in each old one, a quarter of its width to either side of its centre.
    assert torch.allclose(fine[:, :, 2], 0.75 * coarse[:, :, 1] + 0.25 * coarse[:, :, 0])


@pytest.mark.parametrize("fine_tune", [(), ("tokenizer", "transformer", "pixels")])
def test_settings_of_sampling_alone_are_the_preset_s_own(fine_tune, tmp_path):
    made().save(tmp_path / "donor")
    preset = preset_of(replace(PIXELS, range_temperature=0.1), stages_from=str(tmp_path / "donor"))
    preset = replace(preset, fine_tune=fine_tune, model=replace(preset.model, guidance=1.5))
    generator = preset.build_generator()
    assert {"transformer", "pixels"} <= set(taken_stages(preset, generator))
    assert (generator.pixels.config.range_temperature, generator.config.guidance) == (0.1, 1.5)


def test_a_run_of_other_sizes_or_another_kind_gives_no_stages(tmp_path):
    train(preset_of(None), tmp_path / "first")
    preset = preset_of(PIXELS, stages_from=str(tmp_path / "first"))
    wider = replace(preset, model=replace(preset.model, transformer=replace(TRANSFORMER, width=32)))
    with pytest.raises(ConfigError, match=r"whose transformer is another \(model.transformer.width=16\)"):
        train(wider, tmp_path / "second")
    other = replace(preset, generator="maskgit", model=MaskGitConfig(TOKENIZER, TRANSFORMER, PIXELS))
    with pytest.raises(ConfigError, match="a run of the generator 'lidargrit'"):
        train(other, tmp_path / "third")
    anew = replace(preset, train_anew=("transformer",))
    assert taken_stages(anew, anew.build_generator()).keys() == {"tokenizer"}
    unknown = replace(preset, train_anew=("mask",))
    with pytest.raises(ConfigError, match="train_anew=mask; wanted one of tokenizer, transformer, pixels"):
        taken_stages(unknown, unknown.build_generator())
    with pytest.raises(ConfigError, match="tokenizer_from and stages_from together"):
        replace(preset, tokenizer_from="pretrained")


def test_a_stage_whose_settings_do_not_have_its_name_is_compared_by_all_of_them(tmp_path):
    small = ("model.unet.channel_multipliers=[1,1,1,1]", "data.column_stride=1", "data.columns=64")
    donor = load_preset("r2dm_small", small).build_generator()
    donor.save(tmp_path)
    preset = load_preset("r2dm_small", (*small, f"stages_from={tmp_path}"))
    assert taken_stages(preset, preset.build_generator()).keys() == {"diffusion"}
    other = load_preset("r2dm_small", (*small, "model.unet.norm_groups=2", f"stages_from={tmp_path}"))
    with pytest.raises(ConfigError, match=r"whose diffusion is another \(model\.unet\.norm_groups="):
        taken_stages(other, other.build_generator())
    columns = (small[0], "data.column_stride=2", "data.columns=128", f"stages_from={tmp_path}")
    taken = load_preset("r2dm_small", columns)
    with pytest.raises(ConfigError, match=r"whose diffusion is another \(data\.sensor\)"):
        taken_stages(taken, taken.build_generator())
    tuned = load_preset("r2dm_small", (*columns, "fine_tune=[diffusion]"))
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
    changed = [*small, f"model.{setting}", f"stages_from={tmp_path}"]
    changed += ["model.scale_latents=false"] if "axes" in setting else []
    for further in ("fine_tune=[]", "fine_tune=[denoiser]"):
        other = load_preset("lidm_small", (*changed, further))
        name = "scale_latents" if "axes" in setting else setting.partition("=")[0]
        with pytest.raises(ConfigError, match=rf"denoiser is another \(model\.{name}=.*one of this preset's model "):
            taken_stages(other, other.build_generator())
    anew = load_preset("lidm_small", (*changed, "train_anew=[denoiser]"))
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
    tuned = replace(preset, stages_from=str(tmp_path / "gan"), fine_tune=("adversarial",))
    taken = taken_stages(tuned, tuned.build_generator())["adversarial"].state_dict()
    saved, _ = read_tensors(tmp_path / "gan" / "adversarial" / "checkpoint.safetensors")
    of_discriminator = [name for name in taken if name.startswith("discriminator")]
    assert of_discriminator
    assert all(torch.equal(taken[name], saved[f"average.{name}"]) for name in taken)
    (tmp_path / "gan" / "adversarial" / "checkpoint.safetensors").unlink()
    with pytest.raises(ConfigError, match=r"fine_tune=adversarial without .*trained discriminator"):
        check_stages(tuned)
    assert not check_stages(replace(tuned, fine_tune=(), train_anew=("adversarial",))).donors


def test_a_stage_whose_sizes_another_stage_decides_is_refused_before_any_training(tmp_path):
    made().save(tmp_path)
    preset = preset_of(None, stages_from=str(tmp_path))
    preset = replace(preset, train_anew=("tokenizer",), fine_tune=("transformer",))
    check_stages(preset)
    other = replace(preset.model, tokenizer=replace(TOKENIZER, num_codes=TOKENIZER.num_codes // 2))
    with pytest.raises(ConfigError, match=r"whose transformer is another \(\S+ of \d+"):
        check_stages(replace(preset, model=other))


def test_plans_of_a_denoiser_that_is_trained_further_need_no_values(tmp_path):
    small = ("model.tokenizer.channels=32", "model.denoiser.channels=32", "model.tokenizer.num_codes=16")
    load_preset("lidm_small", small).build_generator().save(tmp_path)
    tuned = load_preset("lidm_small", (*small, f"stages_from={tmp_path}", "fine_tune=[denoiser]"))
    assert check_stages(tuned).donors.keys() == {"tokenizer"}


def test_one_reflow_is_distilled_to_several_numbers_of_steps(tmp_path):
    small = ("model.hdit.depths=[1,1]", "model.hdit.heads=[1,2]")
    load_preset("r2flow_small_reflow", (*small, "model.reflow.distilled_steps=4")).build_generator().save(tmp_path)
    taken = (*small, f"stages_from={tmp_path}", "model.reflow.distilled_steps=2")
    preset = load_preset("r2flow_small_reflow", (*taken, "train_anew=[distillation]"))
    assert check_stages(preset).donors.keys() == {"flow", "reflow"}
    with pytest.raises(ConfigError, match=r"whose distillation is another \(model\.reflow\.distilled_steps=4\)"):
        check_stages(load_preset("r2flow_small_reflow", taken))


def test_runs_that_are_no_donors(tmp_path):
    made().save(tmp_path)
    with pytest.raises(ConfigError, match="for 'multiscale', which has no tokenizer"):
        check_stages(load_preset("multiscale_small", (f"tokenizer_from={tmp_path}",)))
    with pytest.raises(ConfigError, match=r"a run of 'r2dm'; choose another run$"):
        check_stages(load_preset("r2dm_small", (f"stages_from={tmp_path}",)))
    nothing = load_preset("lidargrit_small", ("stages_from=", "tokenizer_from="))
    assert nothing.stages_from is None
    assert nothing.tokenizer_from is None
