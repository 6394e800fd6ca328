"""The transformer against the reference program; how it generates token by token."""

import copy
from functools import partial

import numpy as np
import pytest
import torch
from scipy import stats

from lidargrit.core.errors import ConfigError
from lidargrit.nn.codes import CodeFeatures, CodeHead, GroupedCodeHead
from lidargrit.nn.decoding import CachedDecoder
from lidargrit.nn.flops import flops_of
from lidargrit.nn.transformer import CausalTransformer, TokensAround, TransformerConfig, resample_positions
from lidargrit.systems.lidargrit.system import START_TOKEN, TokenSampling, after_start, sample_token
from reference_weights import seeded_weights

GREEDY = TokenSampling(temperature=0.0)
CODE_FEATURES = CodeFeatures(torch.randn((21, 5), generator=torch.Generator().manual_seed(3)), group_size=4)


@pytest.fixture
def transformer():
    torch.manual_seed(0)
    small = CausalTransformer(TransformerConfig(layers=2, heads=4, width=32), num_tokens=20, grid_size=(1, 24)).eval()
    for weight in (*small.head.parameters(), small.pos_emb):
        torch.nn.init.normal_(weight, std=0.5)  # far from uniform, so that a mistake shows
    return small


@pytest.fixture
def golden_transformer(golden):
    data = golden("gpt_small")
    config = TransformerConfig(layers=2, heads=4, width=32)
    model = CausalTransformer(config, num_tokens=32, grid_size=(1, 64)).eval()
    model.load_state_dict(seeded_weights(data))  # strict: the layout is the program's
    return model, data


@pytest.mark.parametrize(
    ("preset", "parameters"), [("lidargrit_kitti_360", 10_264_064), ("lidargrit_kitti_odometry", 5_263_360)]
)
def test_published_sizes(preset, parameters):
    from lidargrit.generation.presets import load_preset
    from lidargrit.systems.lidargrit.system import LidarGrit

    preset = load_preset(preset)
    generator = LidarGrit(preset.model, preset.data.load_sensor())
    assert sum(p.numel() for p in generator.transformer.parameters()) == parameters
    assert generator.transformer.context_length == 1024


@pytest.mark.shared
def test_logits_and_loss_are_the_programs(golden_transformer):
    model, data = golden_transformer
    tokens = torch.from_numpy(data["tokens"])
    with torch.no_grad():
        logits = model(tokens[:, :-1])
    assert np.allclose(logits.numpy(), data["logits"], atol=1e-4)
    loss = torch.nn.functional.cross_entropy(logits.flatten(0, 1), tokens[:, 1:].flatten())
    assert float(loss) == pytest.approx(float(data["loss"]), abs=1e-4)


@pytest.mark.shared
def test_greedy_steps_with_the_cache_are_the_programs(golden_transformer):
    model, data = golden_transformer
    decoder = CachedDecoder(model, 2, partial(sample_token, sampling=GREEDY))
    tokens, chosen = torch.tensor([0, 3]), []
    with torch.no_grad():
        for position in range(30):
            tokens = sample_token(decoder.next_logits(tokens, position), torch.zeros(2), GREEDY)
            chosen.append(tokens)
    assert np.array_equal(torch.stack(chosen, 1).numpy(), data["greedy_from_sos_0_and_3"])


@pytest.mark.shared
def test_top_k_keeps_what_the_program_keeps(golden_transformer):
    _, data = golden_transformer
    logits = torch.from_numpy(data["logits"][0])
    kept = torch.zeros_like(logits, dtype=torch.bool)
    for uniform in torch.linspace(0, 0.9999, 4000):
        kept.scatter_(1, sample_token(logits, uniform.expand(len(logits)), TokenSampling(top_k=5))[:, None], True)
    theirs = torch.from_numpy(data["topk5_of_logits0"])
    # Every token that can be sampled is among the program's; one too unlikely for 4,000 steps may be missing.
    assert bool((~kept | theirs.isfinite()).all())
    assert int(kept.sum()) > 0.9 * int(theirs.isfinite().sum())


def generate(transformer, uniform, sampling, **options):
    return CachedDecoder(transformer, len(uniform), partial(sample_token, sampling=sampling), **options).generate(
        uniform
    )


def without_attention(transformer, block):
    weaker = copy.deepcopy(transformer)
    torch.nn.init.zeros_(weaker.blocks[block].attn.proj.weight)
    torch.nn.init.zeros_(weaker.blocks[block].attn.proj.bias)
    return weaker


@pytest.fixture
def sharing():
    """A transformer whose codes share weights, far from uniform."""
    torch.manual_seed(0)
    config = TransformerConfig(layers=2, heads=4, width=32, code_features=True)
    made = CausalTransformer(config, num_tokens=21, grid_size=(1, 24), code_features=CODE_FEATURES).eval()
    for weight in (*made.head.parameters(), made.pos_emb):
        torch.nn.init.normal_(weight, std=0.3)
    return made


@pytest.mark.parametrize("head", ["transformer", "sharing"])
@pytest.mark.parametrize("guidance", [1.0, 1.5])
@pytest.mark.parametrize(("precision", "tolerance"), [("fp32", 1e-5), ("bf16", 0.2), ("int8", 0.2)])
def test_steps_give_the_logits_of_the_whole_prefix(head, precision, tolerance, guidance, request):
    transformer = request.getfixturevalue(head)
    tokens = torch.randint(20, (3, 24), generator=torch.Generator().manual_seed(0))
    by_choices = partial(sample_token, sampling=GREEDY)
    decoder = CachedDecoder(transformer, 3, by_choices, precision=precision, guidance=guidance)
    with torch.no_grad():
        whole = torch.lerp(without_attention(transformer, 0)(tokens), transformer(tokens), guidance)
        stepwise = torch.stack([decoder.next_logits(tokens[:, i], i) for i in range(24)], dim=1)
    assert whole.std() > 1
    assert float((whole - stepwise).abs().max()) < tolerance


def embedding_by_loop(transformer):
    """Return each code's own vector plus those of its features, one code and one feature at a time."""
    vectors = transformer.tok_emb.weight.clone()
    if transformer.shared is not None:
        for code, features in enumerate(CODE_FEATURES.of_codes):
            for number, value in enumerate(features):
                vectors[code] += 3 * value / features.norm() * transformer.shared.embedding[number]
    return vectors


def tokens_around_by_loop(transformer, read, columns):
    """Return what the tokens around add at each position, one position and one neighbour at a time."""
    length, added = read.shape[1], torch.zeros(*read.shape, transformer.config.width)
    for position in range(length):
        row, column = divmod(position, columns)
        for number, (up, left) in enumerate(
            [(0, 2), (0, 3), (1, 2), (1, 1), (1, 0), (1, -1), (1, -2), (2, 1), (2, 0), (2, -1), (3, 0)]
        ):
            if row - up < 0 or (up == 0 and column - left < 0):
                continue
            place = (row - up) * columns + (column - left) % columns
            token = read[:, place + 1]  # the first is the start token
            added[:, position] += embedding_by_loop(transformer)[token] @ transformer.around.maps[number]
    return added


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("static", [False, True])
def test_the_tokens_around_are_those_of_a_loop_and_steps_with_the_cache_know_them(static, shared):
    torch.manual_seed(0)
    config = TransformerConfig(
        layers=2, heads=2, width=16, embedding_dropout=0.0, neighbours=True, code_features=shared
    )
    transformer = CausalTransformer(
        config, num_tokens=21, grid_size=(4, 6), code_features=CODE_FEATURES if shared else None
    ).eval()
    for weight in (transformer.tok_emb.weight, *transformer.head.parameters()):
        torch.nn.init.normal_(weight, std=0.5)
    uniform = torch.rand((3, 24), generator=torch.Generator().manual_seed(1))
    sampled = generate(transformer, uniform, TokenSampling(), static=static)
    with torch.no_grad():
        read = after_start(sampled[:, :-1])
        plain = embedding_by_loop(transformer)[read] + transformer.pos_emb
        around = transformer.embedded(read) - plain
        assert torch.allclose(around, tokens_around_by_loop(transformer, read, 6), atol=1e-5)
        assert torch.allclose(transformer(read[:, :9]), transformer(read)[:, :9], atol=1e-5)  # of a shorter sequence
        fewer_than_codes = read[:1, :9]
        assert torch.allclose(transformer(fewer_than_codes), transformer(read)[:1, :9], atol=1e-5)
        logits = transformer(read)
    chosen = [sample_token(logits[:, i], uniform[:, i], TokenSampling()) for i in range(24)]
    assert torch.equal(torch.stack(chosen, 1), sampled)


def log_probabilities_by_loop(head, x):
    """Return the log-probability of every code at one position, one group and one code at a time."""
    of_groups = torch.tensor([float(head.group.weight[group] @ x) for group in range(1 + head.num_groups)])
    found = [of_groups.log_softmax(0)[0]]
    for group in range(head.num_groups):
        hidden = head.hidden.weight @ x + head.hidden.bias + head.of_group.weight[group]
        hidden = hidden * 0.5 * (1 + torch.erf(hidden / 2**0.5))
        within = head.in_group.weight @ hidden + head.in_group.bias
        found += [of_groups.log_softmax(0)[1 + group] + each for each in within.log_softmax(0)]
    return torch.stack(found)


def test_a_grouped_head_is_a_loop_over_its_groups_and_all_its_probabilities_are_1_together():
    torch.manual_seed(0)
    head = GroupedCodeHead(8, num_codes=21, group_size=4)
    for weight in head.parameters():
        torch.nn.init.normal_(weight, std=0.5)
    x, codes = torch.randn(3, 21, 8), torch.stack([torch.randperm(21) for _ in range(3)])
    with torch.no_grad():
        logits, nats = head(x), head.nats(x, codes)
        wanted = torch.stack([torch.stack([log_probabilities_by_loop(head, one) for one in line]) for line in x])
    assert torch.allclose(logits, wanted, atol=1e-5)
    assert torch.allclose(logits.exp().sum(-1), torch.ones(3, 21), atol=1e-5)
    assert torch.allclose(nats, -wanted.gather(-1, codes[..., None])[..., 0], atol=1e-5)
    assert wanted.std() > 1


def test_operations_of_a_head_are_those_that_torch_counts():
    for head in (CodeHead(8, 21), GroupedCodeHead(8, num_codes=21, group_size=4)):
        assert head.flops == flops_of(head, (1, 8))
    with pytest.raises(ConfigError, match="20 codes in groups of 4"):
        GroupedCodeHead(8, num_codes=20, group_size=4)


def test_tokens_around_are_the_same_mapped_by_code_and_by_token():
    torch.manual_seed(0)
    around, embedding = TokensAround((4, 6), 8), torch.randn(24, 8)
    tokens, found = torch.randint(24, (1, 24)), []
    for enabled in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            by_code = around.added(around.around(tokens, around.places(None)), around.tables(embedding))
            found += [around(tokens, embedding), by_code]
    gradients = [torch.autograd.grad(each.square().sum(), around.maps)[0] for each in found]
    for these in (found, gradients):
        assert torch.allclose(these[0], these[1], atol=1e-4)
        assert torch.allclose(these[2], these[3], atol=0.03 * float(these[0].detach().abs().max()))
    assert all(each.dtype == torch.float32 for each in found)


def test_codes_of_a_group_learn_from_those_at_the_same_place_in_others():
    """A step on one code moves the share of its place in all groups, and not that of other places."""
    torch.manual_seed(0)
    head, x = GroupedCodeHead(8, num_codes=21, group_size=4), torch.randn(1, 1, 8)
    of_places = lambda: head(x)[0, 0, 1:].unflatten(0, (5, 4)).log_softmax(-1).detach()  # noqa: E731
    before = of_places()
    head.nats(x, torch.tensor([[6]])).sum().backward()  # the second code of the second group
    with torch.no_grad():
        for weight in head.parameters():
            assert weight.grad is not None
            weight.sub_(0.1 * weight.grad)
    moved = of_places() - before
    assert float(moved[:, 1].min()) > 0
    assert float(moved[:, (0, 2, 3)].max()) < 0


def test_features_of_codes_are_refused_of_a_tokenizer_that_has_none():
    with pytest.raises(ConfigError, match="take the tokenizer nearest_range"):
        CausalTransformer(TransformerConfig(1, 2, 8, code_features=True), 3, (1, 2))


@pytest.mark.parametrize(("layers", "unattending"), [(1, 0), (2, 0), (4, 2)])
@pytest.mark.parametrize("static", [False, True])
def test_guidance_moves_logits_away_from_those_without_the_attention_of_the_last_block_but_one(
    layers, unattending, static
):
    torch.manual_seed(layers)
    config = TransformerConfig(layers=layers, heads=2, width=16)
    transformer = CausalTransformer(config, num_tokens=20, grid_size=(1, 24)).eval()
    for parameter in transformer.parameters():  # at first biases are zero
        torch.nn.init.normal_(parameter, std=0.5)
    uniform = torch.rand((4, 24), generator=torch.Generator().manual_seed(1))
    sampled = generate(transformer, uniform, TokenSampling(), guidance=1.5, static=static)
    decoder = CachedDecoder(transformer, 4, partial(sample_token, sampling=GREEDY), guidance=1.5)
    with torch.no_grad():
        read = after_start(sampled[:, :-1])
        own, weaker = transformer(read), without_attention(transformer, unattending)(read)
        stepwise = torch.stack([decoder.next_logits(read[:, i], i) for i in range(24)], dim=1)
    guided = weaker + 1.5 * (own - weaker)
    assert float((own - weaker).abs().max()) > 1
    assert torch.allclose(stepwise, guided, atol=1e-3)
    chosen = [sample_token(guided[:, i], uniform[:, i], TokenSampling()) for i in range(24)]
    assert torch.equal(torch.stack(chosen, 1), sampled)
    with torch.no_grad():  # after another sequence, and of observed tokens
        again = CachedDecoder(
            transformer, 4, partial(sample_token, sampling=TokenSampling()), guidance=1.5, static=static
        )
        again.generate(1 - uniform)
        assert torch.equal(again.generate(uniform), sampled)
        held = torch.where(torch.arange(24) < 12, sampled, -1)
        assert torch.equal(again.generate(uniform, held), sampled)
    assert not torch.equal(generate(transformer, uniform, TokenSampling(), static=static), sampled)


def test_a_token_never_sees_what_follows(transformer):
    tokens = torch.randint(20, (1, 24), generator=torch.Generator().manual_seed(0))
    changed = tokens.clone()
    changed[0, 12] = (changed[0, 12] + 1) % 20
    with torch.no_grad():
        before, after = transformer(tokens), transformer(changed)
    assert torch.equal(before[:, :12], after[:, :12])
    assert not torch.allclose(before[:, 12:], after[:, 12:])


def sample_by_recomputing(transformer, uniform, sampling):
    """Sample as the released program does: every step reads the whole prefix again."""
    tokens = torch.full((len(uniform), 1), START_TOKEN)
    for step in range(uniform.shape[1]):
        chosen = sample_token(transformer(tokens)[:, -1], uniform[:, step], sampling)
        tokens = torch.cat((tokens, chosen[:, None]), dim=1)
    return tokens[:, 1:]


@pytest.mark.parametrize("sampling", [TokenSampling(), TokenSampling(0.7, 5), TokenSampling(1.2, 0, 0.8), GREEDY])
def test_generated_tokens_are_those_of_recomputing_in_any_batch_and_by_static_shapes(transformer, sampling):
    uniform = torch.rand((4, 24), generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        recomputed = sample_by_recomputing(transformer, uniform, sampling)
    assert torch.equal(generate(transformer, uniform, sampling), recomputed)
    assert torch.equal(torch.cat([generate(transformer, uniform[i : i + 1], sampling) for i in range(4)]), recomputed)
    assert torch.equal(generate(transformer, uniform, sampling, static=True), recomputed)


@pytest.mark.parametrize("static", [False, True])
def test_a_decoder_may_generate_again_and_further_than_one_recording(static):
    torch.manual_seed(0)
    longer = CausalTransformer(TransformerConfig(layers=1, heads=2, width=16), num_tokens=8, grid_size=(1, 140)).eval()
    torch.nn.init.normal_(longer.pos_emb)
    decoder = CachedDecoder(longer, 2, partial(sample_token, sampling=TokenSampling()), static=static)
    one, other = torch.rand((2, 2, 140), generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = [sample_by_recomputing(longer, uniform, TokenSampling()) for uniform in (one, other, one)]
    assert all(
        torch.equal(decoder.generate(uniform), tokens)
        for uniform, tokens in zip((one, other, one), expected, strict=True)
    )


def test_tokens_are_sampled_with_their_probability():
    logits = torch.tensor([[0.0, 1.0, 2.0, -1.0, 0.5]])
    uniform = torch.rand(20_000, generator=torch.Generator().manual_seed(0))
    sampled = sample_token(logits.expand(20_000, -1), uniform, TokenSampling(top_k=0))
    expected = logits[0].double().softmax(0).numpy() * 20_000
    assert stats.chisquare(torch.bincount(sampled, minlength=5).numpy(), expected).pvalue > 1e-3


def test_top_p_keeps_the_smallest_set_that_holds_the_share():
    logits = torch.tensor([[0.5, 0.3, 0.15, 0.05]]).log()
    uniform = torch.linspace(0, 0.9999, 1000)
    for top_p, kept in ((0.4, {0}), (0.5, {0}), (0.6, {0, 1}), (0.81, {0, 1, 2}), (1.0, {0, 1, 2, 3})):
        sampled = sample_token(logits.expand(1000, -1), uniform, TokenSampling(top_k=0, top_p=top_p))
        assert set(sampled.tolist()) == kept


def test_the_start_token_is_an_ordinary_one():
    assert after_start(torch.tensor([[5, 6]])).tolist() == [[START_TOKEN, 5, 6]]


@pytest.mark.parametrize(("guidance", "layers"), [(1.0, 2), (1.5, 2), (1.5, 1)])
def test_the_cost_is_what_torch_counts(guidance, layers):
    from torch.utils.flop_counter import FlopCounterMode

    from lidargrit.generation.presets import load_preset
    from lidargrit.systems.lidargrit.system import LidarGrit

    changes = [f"model.guidance={guidance}", f"model.transformer.layers={layers}", "model.transformer.width=32"]
    preset = load_preset("lidargrit_small", [*changes, "data.columns=512", "data.column_stride=16"])
    generator = LidarGrit(preset.model, preset.data.load_sensor())
    with FlopCounterMode(display=False) as counter:
        generator.sample(range(generator.batch_size()))
    assert generator.cost().flops * generator.batch_size() == counter.get_total_flops()
    assert generator.cost().network_evaluations == 128 + 1


def test_a_changed_weight_is_noticed_and_token_bits_are_those_of_the_transformer():
    from lidargrit.generation.presets import load_preset
    from lidargrit.generation.range_steps import RangeSteps
    from lidargrit.systems.lidargrit.system import LidarGrit

    preset = load_preset("lidargrit_small", ["model.transformer.width=32", "data.columns=512", "data.column_stride=8"])
    torch.manual_seed(0)
    generator = LidarGrit(preset.model, preset.data.load_sensor()).eval()
    first = generator.sample([0])
    assert torch.equal(generator.sample([0]).range_m, first.range_m)
    with torch.no_grad():
        bits = generator.bits(first, step_mm=1)
        tokens = generator.tokenizer.encode(RangeSteps(first.sensor, 1).round(first))
        odds = generator.transformer(after_start(tokens.tokens.flatten(1)[:, :-1])).softmax(-1)
        for position in (0, 7, 255):
            share = odds[0, position, tokens.tokens.flatten()[position]]
            assert float(bits.tokens.flatten()[position]) == pytest.approx(-np.log2(float(share)), abs=1e-4)
        for weight in generator.transformer.head.parameters():
            weight.mul_(-30)
    assert not torch.equal(generator.sample([0]).range_m, first.range_m)


def test_positions_are_interpolated_around_the_azimuth():
    rows, old, new = 3, 8, 32
    centres = (np.arange(old) + 0.5) * 360 / old
    learned = torch.arange(rows)[:, None, None] * 10 + torch.from_numpy(np.cos(np.deg2rad(centres)))[None, :, None]
    found = resample_positions(learned.flatten(0, 1)[None], (rows, old), new)[0].unflatten(0, (rows, new))
    wanted = np.interp((np.arange(new) + 0.5) * 360 / new, centres, np.cos(np.deg2rad(centres)), period=360)
    for row in range(rows):
        assert np.allclose(found[row, :, 0].numpy(), 10 * row + wanted)
    assert torch.equal(resample_positions(learned.flatten(0, 1)[None], (rows, old), old)[0], learned.flatten(0, 1))
