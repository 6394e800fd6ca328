"""R2Flow: its solvers and codec against its program, its published layout, learning."""

import resource

import numpy as np
import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.generation.presets import load_preset
from lidargrit.generation.range_values import decode, encode
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.r2flow import flow
from lidargrit.systems.r2flow.hdit import Hdit, HditConfig
from lidargrit.systems.r2flow.rectified_flow import FlowPairs, ReflowConfig, as_kept
from lidargrit.systems.r2flow.system import FlowSampling, R2flow, R2flowConfig
from lidargrit.training import compute
from lidargrit.training.taken_stages import taken_stages
from test_hdit import reference_network
from tiny_runs import learn, the_one_line

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
TINY = HditConfig(16, 16, (1, 1), (1, 2))
PUBLISHED = HditConfig(8, 8, (1, 2, 1), (1, 2, 2))  # small sizes for a file of the published layout


def walls(count=2, reflectance=True):
    rng = torch.Generator().manual_seed(0)
    mask = torch.rand(count, 64, 32, generator=rng) < 0.8
    range_m = torch.where(mask, (2 + 70 * torch.rand(count, 1, 32, generator=rng)).expand(-1, 64, -1), 0)
    planes = {"reflectance": torch.rand(count, 64, 32, generator=rng) * mask} if reflectance else {}
    return RangeImage(range_m, mask, SENSOR, planes)


def made(**settings):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return R2flow(R2flowConfig(TINY, **settings), SENSOR).eval()


def stirred(generator):
    """Fill the layers that begin at zero, so that the network says something."""
    with torch.no_grad(), torch.random.fork_rng():
        torch.manual_seed(3)
        for weight in generator.parameters():
            weight.add_(0.1 * torch.randn(weight.shape))
    return generator


def seeded_checkpoint():
    """Return what the authors' program saves, with seeded weights of a small network at the published image size."""
    with torch.random.fork_rng():
        torch.manual_seed(5)
        network = Hdit(PUBLISHED, 2, *torch.randn(2, 64, 1024))
        weights = {name: torch.randn(of.shape) for name, of in network.state_dict().items()}
    state = {"state": {0: {"step": torch.tensor(5.0), "exp_avg": torch.ones(2)}}, "param_groups": [{"lr": 1e-4}]}
    schedule = {"last_epoch": 3, "lr_lambdas": [None]}
    data = {"dataset": "kitti_360", "data_format": "logscale", "min_depth": 1.45, "max_depth": 80.0}
    cfg = {"model": {"base_channels": 8}, "data": data}  # and, of files since 819d7d3, "finetuning"
    return {"cfg": cfg, "weights": weights, "optimizer": state, "lr_scheduler": schedule, "num_images": 2_560_000}


@pytest.mark.shared
def test_euler_goes_where_the_reference_goes(golden):
    network, data = reference_network(golden, "tiny")
    states = data["ode_euler4"]
    with torch.no_grad():
        found = flow.euler(network, torch.from_numpy(data["ode_z"]), 4)
    assert found.evaluations == 4
    assert np.abs(found.images.numpy() - states[-1]).max() < 1e-3 * np.abs(states[-1]).max()


@pytest.mark.shared
def test_dopri5_ends_where_the_reference_ends(golden):
    network, data = reference_network(golden, "tiny")
    with torch.no_grad():
        found = flow.dopri5(network, torch.from_numpy(data["ode_z"]), 1e-5)
    wanted = data["ode_dopri5"]
    assert np.abs(found.images.numpy() - wanted).max() < 1e-2 * np.abs(wanted).max()
    assert found.evaluations == pytest.approx(int(data["ode_dopri5_nfe"]), rel=0.15)


@pytest.mark.shared
def test_the_way_and_its_velocity_are_the_references(golden):
    data = golden("rivals/r2flow")
    noise, clean, time = (torch.from_numpy(data[f"fm_{name}"]) for name in ("x0", "x1", "t"))
    assert np.allclose(flow.interpolated(noise, clean, time).numpy(), data["fm_x_t"], atol=1e-6)
    assert np.allclose((clean - noise).numpy(), data["fm_u_t"], atol=1e-6)
    loss = (torch.from_numpy(data["fm_v"]) - (clean - noise)).square().mean()
    assert float(loss) == pytest.approx(float(data["loss_l2"]), rel=1e-6)


@pytest.mark.shared
def test_ranges_are_encoded_as_in_the_reference(golden):
    data, sensor = golden("rivals/r2flow"), load_sensor("hdl64e_kitti_360")
    metres, scaled, back = (
        torch.from_numpy(data[f"codec_{name}"])[:, 0].repeat(1, 4, 1)
        for name in ("metres", "logscale", "logscale_back")
    )  # 16 rows, four times for the sensor's 64
    inside = (metres > sensor.range_min_m) & (metres < sensor.range_max_m)
    image = RangeImage.masked(metres.clamp(sensor.range_min_m, sensor.range_max_m), inside, sensor.with_columns(64))
    encoded = encode(image, with_reflectance=False)
    assert torch.allclose(encoded[:, 0], scaled, atol=1e-6)
    assert torch.allclose(decode(encoded, image.sensor).range_m, back, rtol=1e-5)


def test_an_adaptive_solver_takes_more_steps_for_less_error():
    def velocity(image, time):
        return 3 * image * time[:, None, None, None].cos()

    start = torch.randn(1, 1, 4, 8, generator=torch.Generator().manual_seed(0))
    exact = start * float(np.exp(3 * np.sin(1)))
    coarse, fine = (flow.dopri5(velocity, start, tolerance) for tolerance in (1e-2, 1e-6))
    errors = [float((solved.images - exact).abs().max()) for solved in (coarse, fine)]
    assert coarse.evaluations < fine.evaluations
    assert errors[1] < 1e-4 < errors[0]
    steps = [float((flow.euler(velocity, start, steps).images - exact).abs().max()) for steps in (8, 64)]
    assert steps[1] < 0.2 * steps[0]


@pytest.mark.shared
def test_the_later_trainings_compute_as_the_references(golden):
    data = golden("rivals/r2flow")
    times = flow.u_shaped(torch.from_numpy(data["u_shaped_u"]), torch.from_numpy(data["u_shaped_perm"]))
    assert np.allclose(times.numpy(), data["u_shaped_t"], atol=1e-6)
    error = torch.from_numpy(data["fm_v"] - data["fm_u_t"])
    loss = flow.pseudo_huber(error, 0.00054 * np.sqrt(error[0].numel()))
    assert float(loss) == pytest.approx(float(data["loss_pseudo_huber"]), rel=1e-6)


@pytest.mark.shared
def test_a_pair_ends_at_what_a_file_keeps_of_the_generated_scan(golden):
    data, sensor = golden("rivals/r2flow"), load_sensor("hdl64e_kitti_360").with_columns(64)
    end, wanted = (torch.from_numpy(data[name]).repeat(1, 1, 4, 1) for name in ("ode_dopri5", "reflow_target"))
    assert torch.allclose(as_kept(end, sensor), wanted, atol=1e-5)


def test_later_trainings_straighten_and_distil_the_flow():
    pairs = ReflowConfig(pairs=4, distilled_steps=2, distilled_pairs=4, pair_steps=4)
    generator, images = stirred(made(reflectance=False, reflow=pairs)), walls(2, reflectance=False)
    assert generator.stages == ("flow", "reflow", "distillation")
    for stage in generator.stages[1:]:
        objective = generator.objective(stage).train()
        seeds = [step % 2 for step in range(24)]  # the same pairs and times
        found = [terms["loss"] for terms in learn(objective, images, seeds, 3e-3)]
        assert sum(found[-2:]) < 0.8 * sum(found[:2]), stage
        kept = objective._pairs._kept
        assert set(kept) <= set(range(4)), "a pair is made once, and none is for validation"
        objective.eval()
        held_out = float(objective(Example(images), torch.Generator().manual_seed(0))["loss"].detach())
        assert 0 < held_out < 1
        assert max(kept) >= 4
        generator.load_stage(stage, objective)
    assert generator.cost().network_evaluations == 2
    assert generator.cost(FlowSampling(steps=1)).network_evaluations == 1


def test_pairs_depend_on_their_number_alone():
    network, solving = stirred(made()).network, FlowSampling(steps=2)
    kept, anew = (FlowPairs(network, SENSOR, solving, bytes_at_most) for bytes_at_most in (1 << 20, 0))
    together = kept(torch.tensor([5, 2]))
    assert all(torch.equal(one[1:], other) for one, other in zip(together, anew(torch.tensor([2])), strict=True))
    assert set(kept._kept) == {2, 5}
    assert not anew._kept
    network.tokenizer[0].weight.data.zero_()  # training goes on, pairs are those of the network as it was
    assert all(torch.equal(one[1:], other) for one, other in zip(together, anew(torch.tensor([2])), strict=True))


def test_a_distilled_model_takes_the_steps_that_it_has_learned():
    generator = made(reflow=ReflowConfig(distilled_steps=4))
    for sampling, got in (
        (FlowSampling(steps=3), "steps=3"),
        (FlowSampling(steps=256), "steps=256"),
        (FlowSampling(solver="dopri5"), "solver=dopri5"),
    ):
        with pytest.raises(ConfigError, match=f"got {got} for a model that was distilled to 4 equal steps; wanted "):
            generator.sample([0], sampling=sampling)
    with pytest.raises(ConfigError, match="got pairs=0; "):
        ReflowConfig(pairs=0)
    with pytest.raises(ConfigError, match="got distilled_steps=-1; wanted a whole number, at least 0, at most 256"):
        ReflowConfig(distilled_steps=-1)


def test_a_trained_flow_is_taken_over_if_its_sizes_fit(tmp_path):
    sizes = ("model.hdit.depths=[1,1]", "model.hdit.heads=[1,2]")
    load_preset("r2flow_small", sizes).build_generator().save(tmp_path)
    preset = load_preset("r2flow_small_reflow", (*sizes, f"training.flow.start=frozen:{tmp_path}"))
    assert taken_stages(preset, preset.build_generator()).keys() == {"flow"}
    wider = load_preset(
        "r2flow_small_reflow", (*sizes, "model.hdit.channels=32", f"training.flow.start=frozen:{tmp_path}")
    )
    with pytest.raises(ConfigError, match=r"whose flow is another \(model\.hdit\.channels=\d+\); wanted "):
        taken_stages(wider, wider.build_generator())


def test_operations_of_the_pairs_are_counted_once():
    sizes = ("model.hdit.depths=[1,1]", "model.hdit.heads=[1,2]")
    preset = load_preset("r2flow_small_reflow", ("training.reflow.scans=400", "model.reflow.pairs=100", *sizes))
    counted = compute.training_flops(preset)
    a_pair = load_preset("r2flow_small", sizes).build_generator().cost(FlowSampling(steps=16)).flops
    sights = (torch.randint(100, (400,), generator=torch.Generator().manual_seed(seed)) for seed in range(200))
    made = round(sum(len(some.unique()) for some in sights) / 200)  # of pairs that are drawn with repetition
    flow_scan = counted["flow"] / preset.training["flow"].scans
    assert counted["reflow"] == pytest.approx(400 * flow_scan + made * a_pair, rel=1e-6)


def test_a_setting_of_the_other_solver_is_refused():
    with pytest.raises(
        ConfigError, match=r"^got tolerance=0.001 for solver=euler, .*; leave it out, or add solver=dopri5"
    ):
        FlowSampling(tolerance=1e-3)
    with pytest.raises(ConfigError, match=r"^got steps=4 for solver=dopri5, .*; leave it out, or add solver=euler"):
        FlowSampling(solver="dopri5", steps=4)


def test_cost_counts_the_passes_of_either_solver():
    generator = stirred(made())
    two, four = (generator.cost(FlowSampling(steps=steps)) for steps in (2, 4))
    assert (two.network_evaluations, four.network_evaluations) == (2, 4)
    assert four.flops == 2 * two.flops > 0
    passes = []
    generator.network.register_forward_hook(lambda *_: passes.append(1))
    sampling = FlowSampling(solver="dopri5", tolerance=1e-3)
    generator.sample([0], sampling=sampling)
    assert generator.cost(sampling).network_evaluations * 2 + 1 == len(passes)  # again, and once to count operations
    assert generator.cost().network_evaluations == 256


def test_a_flow_that_explodes_is_told_in_one_line():
    for begins in (0.0, 0.5):
        with pytest.raises(
            ConfigError, match=r"a flow that is not finite at time 0.*; wanted a network whose training"
        ):
            flow.dopri5(
                lambda image, time, begins=begins: torch.full_like(image, torch.nan if time[0] >= begins else 1.0),
                torch.zeros(1, 1, 4, 8),
                1e-3,
            )
    for settings in ({"steps": -1}, {"tolerance": 0.0}, {"tolerance": float("nan")}):
        with pytest.raises(ConfigError, match=f"got {next(iter(settings))}="):
            FlowSampling(**settings)


def test_the_small_preset_has_the_small_size():
    preset = load_preset("r2flow_small")
    generator = preset.build_generator()
    assert sum(weight.numel() for weight in generator.network.parameters()) == 2_092_972
    assert preset.training.keys() == set(generator.stages)
    published = load_preset("r2flow_kitti_360")
    assert published.model == R2flowConfig()
    assert (published.data.load_sensor().height, published.data.load_sensor().width) == (64, 1024)


def test_an_imported_checkpoint_is_a_run_that_samples(tmp_path, capsys):
    checkpoint = seeded_checkpoint()
    torch.save(checkpoint, tmp_path / "1rf.pth")
    assert main(["import-weights", "r2flow_kitti_360", str(tmp_path / "run"), str(tmp_path / "1rf.pth")]) == 0
    assert "weights of r2flow for hdl64e_kitti_360 lie in" in capsys.readouterr().out
    generator = lidargrit.load(tmp_path / "run")
    assert generator.config == R2flowConfig(PUBLISHED, reflectance=True)
    loaded = generator.network.state_dict()
    assert all(torch.equal(loaded[name], tensor) for name, tensor in checkpoint["weights"].items())
    assert generator.sample([0], sampling=FlowSampling(steps=1)).reflectance.shape == (1, 64, 1024)


@pytest.mark.parametrize(
    ("k_distil", "reflow"), [(None, None), (1, ReflowConfig(distilled_steps=1)), (4, ReflowConfig(distilled_steps=4))]
)
def test_a_checkpoint_that_was_distilled_takes_the_steps_that_it_has_learned(tmp_path, k_distil, reflow):
    checkpoint = seeded_checkpoint()
    checkpoint["cfg"]["finetuning"] = {"init_ckpt": "2rf.pth", "sample_dir": "pairs", "k_distil": k_distil}
    torch.save(checkpoint, tmp_path / "td.pth")
    preset = load_preset("r2flow_kitti_360")
    generator = R2flow.from_published([tmp_path / "td.pth"], preset.model, preset.data.load_sensor())
    assert generator.config == R2flowConfig(PUBLISHED, True, reflow)
    assert generator.cost().network_evaluations == (k_distil or 256)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["cfg"]["data"].update(data_format="metric"), "with data.data_format=metric; wanted .*=logscale"),
        (lambda c: c["cfg"]["data"].update(max_depth=120.0), "with data.max_depth=120.0; wanted data.max_depth=80.0"),
        (lambda c: c["cfg"].update(finetuning={"k_distil": -1}), "k_distil=-1; wanted a number of steps"),
        (lambda c: c["cfg"]["data"].update(max_depth=torch.ones(2)), r"cannot be read \(RuntimeError: "),
        (lambda c: c.pop("weights"), "which holds no 'weights'"),
        (lambda c: c["weights"].pop("tokenizer.0.weight"), r"be read \(KeyError: 'tokenizer\.0\.weight'\)"),
        (lambda c: c["weights"].pop("detokenizer.0.scale"), r"the file lacks 'detokenizer\.0\.scale'"),
        (lambda c: c["weights"].update(extra=torch.ones(2)), r"the file has besides 'extra'"),
        (lambda c: c["weights"].update({"mid_levels.0.residual_attn.scale": torch.ones(3, 1)}), r"in which .*, heads="),
        (lambda c: c["weights"].update(coords=torch.ones(1, 2, 64, 512)), r"'coords' 1x2x64x512 in place of"),
        (lambda c: c["weights"].update(coords=torch.ones(2).half()), "'coords' is no float32 tensor"),
    ],
)
def test_weights_of_another_form_are_refused(tmp_path, change, message):
    checkpoint = seeded_checkpoint()
    change(checkpoint)
    torch.save(checkpoint, tmp_path / "1rf.pth")
    preset = load_preset("r2flow_kitti_360")
    with pytest.raises(CheckpointError, match=message):
        R2flow.from_published([tmp_path / "1rf.pth"], preset.model, preset.data.load_sensor())


def test_a_small_file_that_tells_of_a_vast_network_is_refused_before_memory_is_taken(tmp_path, capsys):
    checkpoint = seeded_checkpoint()
    for name, tensor in checkpoint["weights"].items():  # one number, repeated to fill any shape
        checkpoint["weights"][name] = torch.zeros(1).expand(tensor.shape)
    checkpoint["weights"]["tokenizer.0.weight"] = torch.zeros(1).expand(16384, 2, 1, 4)
    torch.save(checkpoint, tmp_path / "1rf.pth")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert main(["import-weights", "r2flow_kitti_360", str(tmp_path / "run"), str(tmp_path / "1rf.pth")]) == 2
    assert "1rf.pth with a network of more than" in the_one_line(capsys.readouterr().err, "import-weights")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, "kibibytes"
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"\x80\x04cos\nsystem\n.", b"words"])
def test_a_file_that_is_no_checkpoint_is_refused_and_nothing_is_written(tmp_path, content, capsys):
    (tmp_path / "1rf.pth").write_bytes(content)
    assert main(["import-weights", "r2flow_kitti_360", str(tmp_path / "run"), str(tmp_path / "1rf.pth")]) == 2
    assert "1rf.pth, which " in the_one_line(capsys.readouterr().err, "import-weights")
    assert not (tmp_path / "run").exists()


def test_an_image_is_learned_by_heart():
    generator, images = made(reflectance=False), walls(1, reflectance=False)
    before = generator.sample([0], sampling=FlowSampling(steps=8))
    objective = generator.objective("flow").train()
    batch = RangeImage.stack([images[0]] * 4)
    losses = [terms["loss"] for terms in learn(objective, batch, range(80), 5e-3)]
    assert sum(losses[-20:]) < 0.7 * sum(losses[:20])
    generator.load_stage("flow", objective)
    found = generator.sample([0], sampling=FlowSampling(steps=8))
    error, unlearned = (float((each.range_m - images.range_m).abs().mean()) for each in (found, before))
    assert error < 0.7 * unlearned
    adaptive = generator.sample([0], sampling=FlowSampling(solver="dopri5", tolerance=1e-3))
    assert float((adaptive.range_m - images.range_m).abs().mean()) < 0.7 * unlearned
