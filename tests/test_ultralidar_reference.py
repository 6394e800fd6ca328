"""UltraLiDAR's networks, losses, voxels and sampling against the numbers of its program."""

import json
import math

import numpy as np
import pytest
import torch

from lidargrit.systems.ultralidar.swin import SwinConfig, sine_cosine_positions
from lidargrit.systems.ultralidar.ultralidar_checkpoint import of_ours
from lidargrit.systems.ultralidar.voxel_autoencoder import (
    VoxelAutoencoder,
    VoxelAutoencoderConfig,
    occupied_at_random,
    reconstruction_loss,
)
from lidargrit.systems.ultralidar.voxel_prior import (
    FillSampling,
    VoxelPrior,
    generate_tokens,
    hidden_at_random,
    hidden_token_loss,
    number_hidden,
)
from lidargrit.systems.ultralidar.voxels import VoxelGrid, occupied_voxels, points_of_voxels
from reference_weights import seeded_weights

pytestmark = pytest.mark.shared
SIZES = VoxelAutoencoderConfig(
    VoxelGrid((-50.0, -50.0, -3.73), (0.78125, 0.78125, 0.75), (128, 128, 8)), 8, SwinConfig(32, 4, 4), 24, 16
)
PARTS = {
    "encoder": "lidar_encoder.",
    "pre_quant": "pre_quant.",
    "quantizer": "vector_quantizer.",
    "decoder": "lidar_decoder.",
    "prior": "maskgit_transformer.",
}


@pytest.fixture(scope="module")
def numbers(golden):
    return golden("rivals/ultralidar")


def weights(numbers, part):
    """Return the seeded weights of a part under our names, as an imported checkpoint has them."""
    layout, kept = (json.loads(str(numbers[f"{part}_{of}"])) for of in ("layout", "kept"))
    sampled = {name: shape for name, shape in layout.items() if name not in kept}
    table = math.prod(layout.get("pos_embed", [0]))  # which the program counts as a parameter
    assert sum(math.prod(shape) for shape in sampled.values()) + table == int(numbers[f"{part}_parameters"])
    found = seeded_weights({"layout": json.dumps(sampled), "weight_seed": numbers[f"{part}_weight_seed"]})
    return {of_ours(PARTS[part] + name): of for name, of in found.items()}


@pytest.fixture(scope="module")
def autoencoder(numbers):
    found = {}
    for part in ("encoder", "pre_quant", "quantizer", "decoder"):
        found |= {name.removeprefix("autoencoder."): of for name, of in weights(numbers, part).items()}
    made = VoxelAutoencoder(SIZES)
    counts = {name: of for name, of in made.state_dict().items() if name in ("quantiser.usage", "quantiser.code_sums")}
    made.load_state_dict(counts | found)
    return made.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def prior(numbers):
    made = VoxelPrior(SIZES.blocks, SIZES.tokens, SIZES.num_codes, SIZES.code_dim)
    made.load_state_dict({name.removeprefix("prior."): of for name, of in weights(numbers, "prior").items()})
    return made.eval().requires_grad_(False)


def bits(numbers, name, shape):
    flat = np.unpackbits(numbers[name])[: math.prod(shape)]
    return torch.from_numpy(flat.reshape(shape)).float()


@pytest.fixture(scope="module")
def voxels(numbers):
    return bits(numbers, "net_voxels_bits", tuple(numbers["net_voxels_shape"]))


@pytest.fixture(scope="module")
def tokens(numbers):
    return torch.from_numpy(numbers["codes"]).long()


def agree(ours, theirs, tolerance=1e-4):
    theirs = torch.as_tensor(theirs)
    assert ours.shape == theirs.shape
    assert float((ours - theirs).abs().max()) <= tolerance * float(theirs.abs().max())


def test_voxels_and_their_points_are_the_programs(numbers):
    points = torch.from_numpy(numbers["voxel_points"][None, :, :3])
    grid = VoxelGrid()
    found = occupied_voxels(points, torch.ones(points.shape[:2], dtype=torch.bool), grid)
    assert list(found.shape) == numbers["voxel_shape"].tolist()
    assert np.array_equal(found.nonzero().numpy(), numbers["voxel_occupied"])
    agree(points_of_voxels(found[0], grid, "reference"), numbers["voxel_back_to_points"], 1e-6)


def test_positions_are_the_programs(numbers):
    agree(sine_cosine_positions((16, 16), 32)[0], numbers["pos_embed_16x16_32"], 1e-6)


def test_encoder_and_codebook_are_the_programs(numbers, autoencoder, voxels, tokens):
    latents = autoencoder.encoder(voxels)
    agree(latents, numbers["encoder_out"])
    agree(autoencoder.pre_quant(latents), numbers["pre_quant_out"])
    quantised, _ = autoencoder.quantise(voxels)
    assert torch.equal(quantised.tokens.flatten(1), tokens)
    agree(autoencoder.codes(tokens), numbers["quantised"])
    agree(10 * quantised.loss, numbers["loss_emb"], 1e-5)
    agree(quantised.loss, numbers["commit_loss_weighted"] + numbers["codebook_loss"], 1e-5)


def test_decoder_and_its_loss_are_the_programs(numbers, autoencoder, voxels, tokens):
    logits = autoencoder.decoder(autoencoder.codes(tokens))
    agree(logits[:1], numbers["decoder_logits"])
    assert float(logits.mean()) == pytest.approx(float(numbers["decoder_logits_mean"]), rel=1e-3)
    loss, overlap = reconstruction_loss(logits, voxels)
    agree(loss, numbers["loss_rec"], 1e-5)
    agree(overlap, numbers["iou"], 1e-3)
    theirs = torch.from_numpy(numbers["decoder_logits"])
    found = occupied_at_random(theirs, torch.from_numpy(numbers["gumbel_u"]))
    assert torch.equal(found.float(), bits(numbers, "gumbel_hard_bits", theirs.shape))


def test_hidden_tokens_their_logits_and_their_loss_are_the_programs(numbers, autoencoder, prior, tokens):
    share = math.cos(math.pi / 2 * float(numbers["mask_uniform"]))
    hidden = hidden_at_random(torch.from_numpy(numbers["mask_noise"]), share)
    assert torch.equal(hidden, torch.from_numpy(numbers["mask"]).bool())
    seen = prior.hide(autoencoder.codes(tokens), hidden)
    agree(seen, numbers["masked_tokens"])
    logits = prior(seen)
    agree(logits, numbers["prior_logits"])
    agree(hidden_token_loss(logits, tokens, hidden), numbers["prior_loss"], 1e-5)


@pytest.mark.parametrize("length", [6400, 256])
def test_as_many_tokens_are_hidden_after_each_pass(numbers, length):
    found = [number_hidden(length, done / 30) for done in range(1, 31)]
    assert found == numbers[f"tokens_left_masked_{length}"].tolist()
    sizes = [FillSampling().order_temperature * (1 - done / 30) for done in range(1, 31)]
    agree(torch.tensor(sizes), numbers["choice_temperature"].astype(np.float32), 1e-6)


def test_a_whole_generation_hides_the_programs_tokens_and_ends_at_its_codes(numbers, autoencoder, prior):
    """The program's random numbers are put in place of ours; which tokens are hidden is then no matter of chance."""
    gumbels, ids = (iter(torch.from_numpy(numbers[f"maskgit_{name}"])) for name in ("gumbels", "drawn_ids"))
    hidden_before = []

    def logits_of(tokens, hidden):
        hidden_before.append(hidden[0].clone())
        return prior(prior.hide(autoencoder.codes(tokens), hidden))

    blank = torch.from_numpy(numbers["maskgit_blank"])[None]
    start = torch.zeros(1, 256, dtype=torch.long)
    gumbel, fill = (lambda: next(gumbels)[None]), (lambda _: next(ids).long()[None])
    tokens = generate_tokens(logits_of, start, fill, gumbel, FillSampling(), blank)
    theirs = np.unpackbits(numbers["maskgit_masked_before_step"], axis=1)[:, :256].astype(bool)
    assert np.array_equal(torch.stack(hidden_before).numpy(), theirs)
    agree(autoencoder.codes(tokens)[0], numbers["maskgit_final_quantised"])
