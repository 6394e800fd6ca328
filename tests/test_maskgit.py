"""Parallel decoding: the schedule by its formula, the order by a slow loop, the cost by torch, a borrowed tokenizer."""

import json
import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lidargrit.core.configuration import override
from lidargrit.core.errors import ConfigError
from lidargrit.generation.presets import load_preset
from lidargrit.nn.transformer import CausalTransformer, MaskedTransformer, TransformerConfig
from lidargrit.scans.example import Example
from lidargrit.scans.types import RangeImage
from lidargrit.systems.maskgit.system import (
    HiddenTokens,
    MaskedSampling,
    MaskGit,
    generate_tokens,
    numbers_hidden,
    share_hidden,
)
from lidargrit.training import train
from tiny_runs import MODEL, SHORT, SIMULATED

GREEDY = MaskedSampling(steps=24, temperature=0.0, order_temperature=0.0)


@pytest.fixture
def transformer():
    torch.manual_seed(0)
    small = MaskedTransformer(TransformerConfig(layers=2, heads=4, width=32), num_tokens=20, context_length=24).eval()
    torch.nn.init.normal_(small.head.weight, std=0.5)  # far from uniform, so that a mistake shows
    torch.nn.init.normal_(small.tok_emb.weight, std=0.5)
    torch.nn.init.normal_(small.pos_emb, std=0.5)
    return small


def rngs(*seeds):
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def test_the_schedule_is_the_cosine():
    progress = torch.tensor([0.0, 1 / 3, 0.5, 2 / 3, 1.0])
    assert torch.allclose(
        share_hidden(progress), torch.tensor([1.0, math.sqrt(3) / 2, math.sqrt(0.5), 0.5, 0.0]), atol=1e-6
    )
    # 1024 cos(pi / 2 * t / 8), rounded up, by a table of cosines
    cosines = [0.98078528, 0.92387953, 0.83146961, 0.70710678, 0.55557023, 0.38268343, 0.19509032]
    assert numbers_hidden(1024, 8) == [*(math.ceil(1024 * cosine) for cosine in cosines), 0]


@given(st.integers(1, 300), st.integers(1, 400))
def test_every_pass_shows_some_and_the_last_all(num_tokens, steps):
    hidden = [num_tokens, *numbers_hidden(num_tokens, steps)]
    assert len(hidden) == min(steps, num_tokens) + 1
    assert hidden[-1] == 0
    assert all(after < before for before, after in pairwise(hidden))


def test_every_token_is_decided_once_and_stays(transformer):
    seen = []
    transformer.register_forward_hook(lambda module, given, found: seen.append(given[0].clone()))
    generated = generate_tokens(transformer, rngs(0, 1), MaskedSampling(steps=5))
    assert len(seen) == 5
    assert bool((seen[0] == transformer.mask_token).all())
    for before, after in zip(seen, [*seen[1:], generated], strict=True):
        shown = before != transformer.mask_token
        assert torch.equal(before[shown], after[shown])
    counts = [int((tokens[0] == transformer.mask_token).sum()) for tokens in [*seen, generated]]
    assert counts == [24, *numbers_hidden(24, 5)]


def test_greedy_with_a_pass_for_each_token_is_a_slow_loop(transformer):
    tokens = torch.full((1, 24), transformer.mask_token)
    with torch.no_grad():
        for _ in range(24):
            odds = transformer(tokens)[0].softmax(-1)
            surest, position, token = max(
                (float(odds[position, token]), position, token)
                for position in range(24)
                if tokens[0, position] == transformer.mask_token
                for token in range(20)
            )
            assert surest > 0
            tokens[0, position] = token
        assert torch.equal(generate_tokens(transformer, rngs(0), GREEDY), tokens)


def test_one_pass_draws_every_token_with_its_own_probability(transformer):
    with torch.no_grad():
        odds = transformer(torch.full((1, 24), transformer.mask_token))[0].softmax(-1)
        generated = torch.cat(
            [generate_tokens(transformer, rngs(*range(i, i + 500)), MaskedSampling(1)) for i in (0, 500, 1000)]
        )
    for position in (0, 11, 23):
        share = torch.bincount(generated[:, position], minlength=20) / len(generated)
        assert float((share - odds[position]).abs().max()) < 0.06  # 5 standard deviations of a share of a half


def test_a_high_order_temperature_shows_tokens_in_any_order(transformer):
    seen = []
    transformer.register_forward_hook(lambda module, given, found: seen.append(given[0].clone()))
    generate_tokens(transformer, rngs(*range(400)), MaskedSampling(steps=2, order_temperature=1e6))
    shown = (seen[1] != transformer.mask_token).float().mean(0)
    assert float((shown - (1 - numbers_hidden(24, 2)[0] / 24)).abs().max()) < 0.12  # 5 standard deviations


def test_a_seed_gives_the_same_tokens_whatever_the_batch(transformer):
    together = generate_tokens(transformer, rngs(3, 4, 5), MaskedSampling(steps=6))
    assert torch.equal(generate_tokens(transformer, rngs(4), MaskedSampling(steps=6)), together[1:2])
    assert not torch.equal(together[0], together[1])
    assert not torch.equal(generate_tokens(transformer, rngs(4), MaskedSampling(steps=7)), together[1:2])


def test_a_masked_transformer_sees_both_sides_and_a_causal_one_does_not():
    config, rng = TransformerConfig(layers=1, heads=2, width=16), torch.Generator().manual_seed(0)
    tokens = torch.randint(8, (1, 10), generator=rng)
    changed = tokens.clone()
    changed[0, 9] = (changed[0, 9] + 1) % 8
    for network, sees in ((MaskedTransformer(config, 8, 10), True), (CausalTransformer(config, 8, (1, 10)), False)):
        network.eval()
        with torch.no_grad():
            assert torch.equal(network(tokens)[0, 0], network(changed)[0, 0]) != sees


def small_maskgit():
    preset = load_preset("maskgit_small", ["model.transformer.width=32", "data.columns=512", "data.column_stride=8"])
    torch.manual_seed(0)
    return MaskGit(preset.model, preset.data.load_sensor()).eval()


def test_the_objective_asks_for_hidden_tokens_only():
    generator = small_maskgit()
    rng = torch.Generator().manual_seed(0)
    sensor, range_m = generator.sensor, 5 + 40 * torch.rand(3, 64, 64, generator=rng)
    images = RangeImage.masked(range_m, torch.ones(3, 64, 64, dtype=torch.bool), sensor)
    objective = HiddenTokens(generator.tokenizer, generator.transformer).eval()
    tokens = generator.tokenizer.encode(images).tokens.flatten(1)
    seen = []
    generator.transformer.register_forward_hook(lambda module, given, found: seen.append((given[0], found)))
    with torch.no_grad():
        terms = objective(Example(images), torch.Generator().manual_seed(1))
    given_tokens, logits = seen[0]
    hidden = given_tokens == generator.transformer.mask_token
    assert torch.equal(given_tokens[~hidden], tokens[~hidden])
    nats = [-float(logits[i, j].log_softmax(0)[tokens[i, j]]) for i, j in hidden.nonzero().tolist()]
    assert float(terms["loss"]) == pytest.approx(sum(nats) / len(nats), rel=1e-4)
    # Each scan's share is the cosine of its progress, and these are a third of the way apart.
    first = float(torch.rand(1, generator=torch.Generator().manual_seed(1)))
    expected = [math.ceil(256 * math.cos(math.pi / 2 * ((first + i / 3) % 1))) for i in range(3)]
    assert hidden.sum(1).tolist() == pytest.approx(expected, abs=1)


def test_the_cost_is_what_torch_counts():
    from torch.nn.attention import SDPBackend, sdpa_kernel
    from torch.utils.flop_counter import FlopCounterMode

    generator, sampling = small_maskgit(), MaskedSampling(steps=3)
    with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):  # the CPU's own is not counted
        generator.sample([0], sampling=sampling)
    assert generator.cost(sampling).flops == counter.get_total_flops()
    assert generator.cost(sampling).network_evaluations == 3 + 1


def test_short_numbers_change_the_odds_a_little(transformer):
    exact = generate_tokens(transformer, rngs(*range(40)), MaskedSampling(steps=1))
    short = generate_tokens(transformer, rngs(*range(40)), MaskedSampling(steps=1, weights="bf16"))
    assert 0.9 < float((exact == short).float().mean()) < 1


@pytest.mark.parametrize("wrong", ["steps=0", "temperature=-1", "order_temperature=-1", "order_temperature=nan"])
def test_a_wrong_choice_is_told(wrong):
    with pytest.raises(ConfigError, match=r"wanted a (whole )?number, at least"):
        override(MaskedSampling(), [wrong])


def test_a_tokenizer_is_taken_from_another_run(tmp_path):
    settings = [*MODEL, *SIMULATED, *SHORT]
    donor = train(load_preset("lidargrit_demo", settings), tmp_path / "donor")
    other_scans = "data.train=[simulated:6:train]"
    preset = load_preset(
        "maskgit_demo", [*settings, other_scans, f"training.tokenizer.start=frozen:{tmp_path / 'donor'}"]
    )
    generator = train(preset, tmp_path / "run")
    theirs, ours = donor.get_tokenizer().state_dict(), generator.get_tokenizer().state_dict()
    assert theirs.keys() == ours.keys()
    assert all(torch.equal(theirs[name], ours[name]) for name in theirs)
    assert not (tmp_path / "run" / "tokenizer").exists()
    facts = [json.loads((tmp_path / run / "trained_on.json").read_text()) for run in ("donor", "run")]
    assert set(facts[0]["fingerprints"]) < set(facts[1]["fingerprints"])

    wider = override(preset, ["model.tokenizer.code_dim=16"])
    with pytest.raises(ConfigError, match="code_dim=8"):
        train(wider, tmp_path / "wider")
    assert not (tmp_path / "wider").exists()
