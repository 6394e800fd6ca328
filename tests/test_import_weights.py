"""Weights that others published: their programs' files → a run of ours, with their programs' numbers."""

import functools
import json
import pickle
import re

import numpy as np
import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.discovery import names
from lidargrit.core.files import claim_folder
from lidargrit.generation.generator import load_class
from lidargrit.generation.presets import load_preset
from lidargrit.systems.lidargrit.system import LidarGrit
from reference_weights import seeded_weights
from test_dcgan import published as dusty_weights
from test_r2dm import seeded_checkpoint as r2dm_checkpoint
from tiny_runs import contents, the_one_line

SMALL = [  # the sizes of the reference numbers' two networks, whose tokens fit one another at 64x64
    "data.columns=512",
    "data.column_stride=8",
    "data.projection_variant=reference",
    "model.tokenizer.channels=32",
    "model.tokenizer.channel_multipliers=[1,1,2,2]",
    "model.tokenizer.code_dim=16",
    "model.tokenizer.num_codes=32",
    "model.transformer.layers=2",
    "model.transformer.heads=4",
    "model.transformer.width=32",
]
PRESET = "lidargrit_kitti_odometry"
PUBLISHED = {name: f"{name}_kitti_360" for name in ("lidargen", "lidm", "r2dm", "r2flow", "ultralidar")}
PUBLISHED |= {name: f"{name}_kitti_odometry" for name in ("dusty", "lidargan", "lidargrit", "lidarvae")}


@functools.cache
def drawn(part):
    """Draw weights under our names, without what only our training keeps."""
    preset = load_preset(PRESET, SMALL)
    network = LidarGrit(preset.model, preset.data.load_sensor()).get_submodule(part)
    kept = ("quantize.usage", "quantize.code_sums")
    layout = {name: list(of.shape) for name, of in network.state_dict().items() if name not in kept}
    return seeded_weights({"layout": json.dumps(layout), "weight_seed": 3})


def write_released(folder, tokenizer, transformer):
    """Write two files as the program does, with all that it keeps besides."""
    masks = {f"blocks.{layer}.attn.mask": torch.ones(64, 64).tril()[None, None] for layer in (0, 1)}
    unused = {
        "loss.discriminator.main.0.weight": torch.ones(3),
        "loss.discriminator.flag": torch.tensor(0, dtype=torch.uint8),
    }
    others = {
        "optimizer_0": {"state": {0: {"step": 5, "exp_avg": torch.ones(2)}}, "param_groups": [{"lr": 8e-6}]},
        "scheduler_0": {"last_epoch": 3, "lr_lambdas": [None], "_last_lr": [8e-6]},
    }
    torch.save({"VQ": tokenizer | unused, **others}, folder / "vq.pth")
    torch.save({"Transformer": transformer | masks, **others}, folder / "gpt.pth")
    return [str(folder / "vq.pth"), str(folder / "gpt.pth")]


def imported(folder, files, *settings):
    return main(["import-weights", PRESET, str(folder), *files, "--set", *SMALL, *settings])


@pytest.fixture
def files(tmp_path):
    return write_released(tmp_path, drawn("tokenizer"), drawn("transformer"))


@pytest.mark.shared
def test_imported_networks_give_the_programs_numbers(golden, tmp_path):
    vq, gpt = golden("vqvae_small"), golden("gpt_small")
    files = write_released(tmp_path, seeded_weights(vq), seeded_weights(gpt))
    assert imported(tmp_path / "run", files) == 0
    model = lidargrit.load(tmp_path / "run")
    tokens = torch.from_numpy(gpt["tokens"])
    with torch.no_grad():
        z = model.tokenizer.quant_conv(model.tokenizer.encoder(torch.from_numpy(vq["x"])))
        assert np.allclose(z.numpy(), vq["pre_quant"], atol=1e-4)
        quantised = model.tokenizer.quantize(z)
        assert np.array_equal(quantised.tokens.numpy(), vq["indices"])
        raw = model.tokenizer.decoder(model.tokenizer.post_quant_conv(quantised.latents))
        assert np.allclose(raw.numpy(), vq["decoder_raw"], atol=1e-4)
        assert np.allclose(model.transformer(tokens[:, :-1]).numpy(), gpt["logits"], atol=1e-4)


def test_an_import_is_a_run_that_verbs_take(files, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(LidarGrit, "own_batches", (2, 2))  # as many as are wanted
    run, samples = str(tmp_path / "run"), str(tmp_path / "samples")
    assert imported(run, files) == 0
    assert "weights of lidargrit for hdl64e_kitti_odometry lie in" in capsys.readouterr().out
    model = lidargrit.load(run)
    assert all(torch.equal(of, model.tokenizer.state_dict()[name]) for name, of in drawn("tokenizer").items())
    assert all(torch.equal(of, model.transformer.state_dict()[name]) for name, of in drawn("transformer").items())
    assert main(["sample", run, samples, "-n", "2", "--set", "sampling.top_k=5"]) == 0
    assert json.loads((tmp_path / "samples" / "samples.json").read_text())["projection_variant"] == "reference"
    assert main(["evaluate", samples, "simulated:2:test", "--metrics", "sliced_wasserstein", "--intervals", "0"]) == 0
    assert main(["likelihood", "simulated:2:test", "--model", run]) == 0


def test_the_same_import_again_changes_nothing_and_no_training_goes_on_there(files, tmp_path, capsys):
    assert imported(tmp_path / "run", files) == 0
    before = contents(tmp_path / "run")
    assert set(before) == {"run.json", "config.json", "model.safetensors"}
    assert str(tmp_path) not in before["run.json"].decode()
    assert imported(tmp_path / "run", files) == 0
    assert main(["train", PRESET, str(tmp_path / "run"), "--set", *SMALL]) == 2
    assert "whose weights were imported; wanted " in capsys.readouterr().err
    assert imported(tmp_path / "run", files, "seed=7") == 2
    assert "which is not empty" in the_one_line(capsys.readouterr().err, "import-weights")
    with claim_folder(tmp_path / "run"):  # as another import of the same weights does
        assert imported(tmp_path / "run", files) == 2
    assert ", which process " in the_one_line(capsys.readouterr().err, "import-weights")
    assert contents(tmp_path / "run") == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda vq, gpt: vq.pop("quant_conv.bias"), r"vq\.pth .*the file lacks 'quant_conv\.bias'"),
        (lambda vq, gpt: vq.update({"extra.weight": torch.ones(2)}), r"the file has besides 'extra\.weight'"),
        (
            lambda vq, gpt: vq.update({"encoder.conv_in.weight": torch.ones(64, 1, 3, 3)}),
            r"'encoder\.conv_in\.weight' 64x1x3x3 in place of 32x1x3x3",
        ),
        (
            lambda vq, gpt: gpt.update(pos_emb=torch.ones(1, 32, 32)),
            r"gpt\.pth .*'pos_emb' .* in place of 1x64x32\)",
        ),
        (
            lambda vq, gpt: gpt.update({"head.weight": torch.ones(32, 32).half()}),
            r"'head\.weight' is no float32 tensor",
        ),
        (lambda vq, gpt: gpt.update({"head.weight": torch.ones(1).expand(1 << 30)}), r"'head\.weight' is no float32"),
        (
            lambda vq, gpt: gpt.update({f"x{i}": torch.ones(1).expand(1 << 28) for i in range(4)}),
            "whose tensors are larger than the file could be",
        ),
    ],
)
def test_weights_of_another_layout_are_refused_in_one_line(change, message, tmp_path, capsys):
    tokenizer, transformer = dict(drawn("tokenizer")), dict(drawn("transformer"))
    change(tokenizer, transformer)
    assert imported(tmp_path / "run", write_released(tmp_path, tokenizer, transformer)) == 2
    assert re.search(message, the_one_line(capsys.readouterr().err, "import-weights"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "found",
    [torch.ones(3), torch.tensor(1.0), [1, 2], 3, None, {}, {1: torch.ones(1)}, {"cfg": torch.ones(2)}, {"VQ": [1]}],
    ids=lambda found: str(found)[:20],
)
def test_files_that_hold_no_weights_are_refused_in_one_line(found, tmp_path, capsys):
    torch.save(found, tmp_path / "x.pth")
    for preset in (PRESET, "r2dm_kitti_360", "dusty_kitti_odometry"):
        files = [str(tmp_path / "x.pth")] * (2 if preset == PRESET else 1)
        assert main(["import-weights", preset, str(tmp_path / "run"), *files]) == 2
        assert "x.pth, wh" in the_one_line(capsys.readouterr().err, "import-weights")


def test_a_deeply_nested_file_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "x.pth").write_bytes(b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".")
    assert main(["import-weights", "r2dm_kitti_360", str(tmp_path / "run"), str(tmp_path / "x.pth")]) == 2
    assert "x.pth, which " in the_one_line(capsys.readouterr().err, "import-weights")


def test_files_in_another_order_or_number_or_of_another_system_are_refused(files, tmp_path, capsys):
    def error(*words):
        assert main(["import-weights", *map(str, words)]) == 2
        return the_one_line(capsys.readouterr().err, "import-weights")

    out = tmp_path / "run"
    assert "gpt.pth, which holds no 'VQ'" in error(PRESET, out, *reversed(files), "--set", *SMALL)
    assert "got 1 file; wanted 2, for the tokenizer and the transformer" in error(PRESET, out, files[0])
    assert "which holds no 'G_ema'" in error("dusty_kitti_odometry", out, files[0])
    able = "nobody published weights; wanted a preset of dusty, lidargan, lidargen, lidargrit, lidarvae, lidm, r2dm"
    assert able in error("marginal", out, "x")
    assert "none.pth, which is no file" in error(PRESET, out, tmp_path / "none.pth", files[1])
    torch.save(r2dm_checkpoint(), tmp_path / "r2dm.pth")
    other = error("r2dm_kitti_360", out, tmp_path / "r2dm.pth", "--set", "data.columns=512")
    assert re.search(r"'coords' .*1024 in place of .*512", other)
    assert not out.exists()


@pytest.mark.parametrize("name", PUBLISHED)
def test_code_in_a_file_is_never_run_and_cut_files_write_nothing(name, tmp_path, capsys):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    path, out, files = tmp_path / "x.pth", tmp_path / "run", len(load_class(name).published_files)
    for write in (
        lambda: torch.save({"VQ": Bomb()}, path),
        lambda: torch.save([Bomb()], path, _use_new_zipfile_serialization=False),
        lambda: path.write_bytes(pickle.dumps({"VQ": Bomb()})),
    ):
        write()
        assert main(["import-weights", PUBLISHED[name], str(out), *[str(path)] * files]) == 2
        assert "which does not hold tensors only" in the_one_line(capsys.readouterr().err, "import-weights")
    torch.save({"VQ": torch.ones(3000)}, path)
    path.write_bytes(path.read_bytes()[:-2000])
    assert main(["import-weights", PUBLISHED[name], str(out), *[str(path)] * files]) == 2
    assert "x.pth, which is no whole file" in the_one_line(capsys.readouterr().err, "import-weights")
    assert not (tmp_path / "ran").exists()
    assert not out.exists()


def test_every_system_with_published_weights_is_here():
    assert PUBLISHED.keys() == {name for name in names("generators") if load_class(name).published_files}


def test_r2dm_and_dusty_import_with_sizes_of_their_own(tmp_path):
    torch.save(r2dm_checkpoint(layout_of_2024=True), tmp_path / "r2dm.pth")
    torch.save({"G_ema": dusty_weights(1, (64, 256))}, tmp_path / "dusty.pth")
    assert main(["import-weights", "r2dm_kitti_360", str(tmp_path / "a"), str(tmp_path / "r2dm.pth")]) == 0
    assert main(["import-weights", "dusty_kitti_odometry", str(tmp_path / "b"), str(tmp_path / "dusty.pth")]) == 0
    r2dm, dusty = lidargrit.load(tmp_path / "a"), lidargrit.load(tmp_path / "b")
    assert (r2dm.config.unet.channels, r2dm.sensor.name, r2dm.sensor.width) == (4, "hdl64e_kitti_360", 1024)
    assert (dusty.config.variant, dusty.config.latent_dim, dusty.sensor.width) == ("dusty_1", 6, 256)
    assert dusty.sample([0]).range_m.shape == (1, 64, 256)
