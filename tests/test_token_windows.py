"""Windows of columns over the tokens of a scan: what they cover, and that sampling and likelihood agree."""

from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.generation.presets import load_preset
from lidargrit.nn.decoding import CachedDecoder
from lidargrit.nn.transformer import CausalTransformer, TokensAround, TransformerConfig
from lidargrit.nn.windows import Windows
from lidargrit.scans.example import Example
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit, TokenSampling, nats_of_tokens, sample_token

GRID = (4, 21)


@pytest.fixture
def transformer():
    torch.manual_seed(0)
    config = TransformerConfig(2, 2, 16, embedding_dropout=0.0, neighbours=True, window_columns=8)
    made = CausalTransformer(config, 20, GRID).eval()
    for weight in (made.head.weight, made.pos_emb, made.column_emb, made.tok_emb.weight):
        torch.nn.init.normal_(weight, std=0.5)
    return made


@pytest.mark.parametrize(("columns", "of"), [(8, 9), (8, 21), (16, 128), (32, 256), (20, 21)])
def test_windows_in_turn_bring_every_column_once_after_those_that_they_go_on_from(columns, of):
    done = []
    windows = Windows((2, of), columns)
    for window in windows.in_turn():
        numbers = window.columns.tolist()
        assert len(numbers) == columns
        assert set(numbers[: window.known]) <= set(done)
        assert not set(numbers[window.known :]) & set(done)
        assert numbers[window.known :]
        if done:
            assert numbers[: windows.first] == list(range(windows.first))
            assert numbers[windows.first :] == list(range(numbers[windows.first], numbers[-1] + 1))
        done += numbers[window.known :]
    assert done == list(range(of))


def test_a_window_takes_the_tokens_of_its_columns_and_a_drawn_one_learns_none_twice():
    grid = torch.arange(3 * 2 * 12).view(3, 2, 12)
    windows = Windows((2, 12), 8)
    columns, counted = windows.draw(3, torch.Generator().manual_seed(0))
    taken = windows.take(grid, columns)
    for scan in range(3):
        assert taken[scan].tolist() == [int(grid[scan, row, column]) for column in columns[scan] for row in range(2)]
    many, counted = windows.draw(400, torch.Generator().manual_seed(1))
    first = (many == torch.arange(8)).all(1)
    assert 0.1 < float(first.float().mean()) < 0.4
    assert counted[first].all()
    assert not counted[~first][:, :1].any()
    assert counted[~first][:, 1:].all()
    assert set(many[~first][:, 1].tolist()) == set(range(2, 6)), "every start comes up"
    drawn, _ = Windows((2, 200), 8).draw(1000, torch.Generator().manual_seed(1))
    assert 0.07 < float((drawn[:, -1] == 199).float().mean()) < 0.13, "the last window, of 193 starts"


@pytest.mark.parametrize("static", [False, True])
@pytest.mark.parametrize("guidance", [1.0, 1.5])
def test_tokens_are_sampled_with_the_probabilities_that_the_likelihood_tells(transformer, static, guidance):
    nats, drawn = [], []

    def recorded(logits, uniform):
        chosen = sample_token(logits, uniform, TokenSampling())
        nats.append(-logits.log_softmax(-1).gather(1, chosen[:, None])[:, 0])
        drawn.append(chosen)
        return chosen

    decoder = CachedDecoder(transformer, 3, recorded, static=static, guidance=guidance)
    uniform = torch.rand((3, 84), generator=torch.Generator().manual_seed(1))
    tokens = decoder.generate(uniform)
    assert tokens.shape == (3, 84)
    assert torch.equal(tokens, decoder.generate(uniform))
    if guidance == 1.0:
        grid = tokens.unflatten(1, GRID)
        with torch.no_grad():
            in_order = nats_of_tokens(transformer, grid).transpose(1, 2).flatten(1)
        assert torch.allclose(torch.stack(nats[:84], 1), in_order, atol=1e-4)
        assert torch.equal(torch.stack(drawn[:84], 1), grid.transpose(1, 2).flatten(1))
        assert float(in_order.std()) > 0.5
    else:  # what is read at once moves the guided logits as what is read step by step does
        steps = CachedDecoder(transformer, 3, recorded, static=static, guidance=guidance)
        begin, through = steps._begin, []

        def step_by_step(known):
            begin(known[:, :0])
            for place in range(known.shape[1]):
                through.append(steps.next_logits(steps._tokens, place))
                steps._tokens.copy_(known[:, place])
            steps._generated[:, : known.shape[1]] = known
            steps._position.fill_(known.shape[1])

        steps._begin = step_by_step
        assert torch.equal(steps.generate(uniform), tokens)
        assert through


def test_observed_tokens_stay_and_later_windows_know_of_them(transformer):
    uniform = torch.rand((1, 84), generator=torch.Generator().manual_seed(1)).expand(2, -1)
    observed = torch.full((2, *GRID), -1)
    observed[1, :, 2] = 7
    decoder = CachedDecoder(transformer, 2, lambda *given: sample_token(*given, TokenSampling()))
    free, held = decoder.generate(uniform, observed.flatten(1)).unflatten(1, GRID)
    assert (held[:, 2] == 7).all()
    assert torch.equal(free[:, :2], held[:, :2])
    assert not torch.equal(free[:, 3:], held[:, 3:])


def test_the_first_columns_reach_the_last(transformer):
    grid = torch.randint(20, (1, *GRID), generator=torch.Generator().manual_seed(2))
    changed = grid.clone()
    changed[0, :, 0] = (changed[0, :, 0] + 1) % 20
    with torch.no_grad():
        moved = (nats_of_tokens(transformer, grid) - nats_of_tokens(transformer, changed)).abs()
    assert float(moved[..., -1].max()) > 1e-4


@pytest.mark.parametrize(("turn", "starts"), [(21, (2, 9, 12, 13, 14)), (9, (1, 2))])
def test_tokens_around_a_position_are_those_beside_it_in_the_turn_that_come_before_it(turn, starts):
    windows, around, none = [[0, *range(start, start + 7)] for start in starts], TokensAround((8, 4), 3, turn), 32
    beside = [(0, -2), (0, -3), (-1, -2), (-1, -1), (-1, 0), (-1, 1), (-1, 2), (-2, -1), (-2, 0), (-2, 1), (-3, 0)]
    beside += [(1, -1), (1, 0), (1, 1), (2, 0), (3, 0)]
    for columns, found in zip(windows, around.places(torch.tensor(windows)), strict=True):
        wanted = []
        for place, column in enumerate(columns):
            for row in range(4):
                for right, down in beside:
                    there = (column + right) % turn
                    before = there in columns and (right == 0 or columns.index(there) < place)
                    known = before and 0 <= row + down < 4
                    wanted.append(4 * columns.index(there) + row + down + 1 if known else none)
        assert found.flatten().tolist() == wanted
        ahead = found[-4:, 11:] != none
        assert bool(ahead.any()) == (columns[-1] + 3 >= turn), "the scan's last columns know its first"


def test_what_graphs_of_a_gpu_read_stays_at_its_place(transformer):
    decoder = CachedDecoder(transformer, 1, lambda *given: sample_token(*given, TokenSampling()), static=True)
    places = [each.data_ptr() for each in (decoder._places, decoder._positions)]
    decoder.generate(torch.rand((1, 84), generator=torch.Generator().manual_seed(1)))
    assert [each.data_ptr() for each in (decoder._places, decoder._positions)] == places


def small_system(columns=512):
    settings = [
        "model.transformer.width=16",
        "model.transformer.heads=2",
        "model.transformer.layers=1",
        "model.transformer.window_columns=8",
        f"data.columns={columns}",
        "data.column_stride=4",
    ]
    preset = load_preset("lidargrit_fine_wide", settings)
    torch.manual_seed(0)
    return LidarGrit(replace(preset.model, pixels=None), preset.data.load_sensor())


def two_images(sensor):
    range_m = 5 + 20 * torch.rand((2, sensor.height, sensor.width), generator=torch.Generator().manual_seed(0))
    return RangeImage.masked(range_m, range_m < 22, sensor)


def test_training_learns_windows_and_validation_the_whole_scan():
    generator = small_system()
    images = two_images(generator.sensor)
    objective, rng = generator.transformer_objective(), torch.Generator().manual_seed(0)
    objective.train()
    terms = objective(Example(images), rng)
    terms["loss"].backward()
    assert all(weight.grad is not None for weight in objective.transformer.parameters())
    objective.eval()
    with torch.no_grad():
        whole = objective(Example(images), rng)["loss"]
        bits = generator.token_bits(generator.get_tokenizer().encode(images))
    assert float(whole) == pytest.approx(float(bits.mean()) * float(torch.tensor(2.0).log()), rel=1e-4)


def test_a_training_reads_as_many_windows_of_each_scan_as_are_asked_for_and_counts_each_alike():
    generator = small_system()
    for weight in (generator.transformer.tok_emb.weight, generator.transformer.around.maps):
        torch.nn.init.normal_(weight, std=0.5)  # so that windows that are mistaken for one another are seen
    generator.transformer.config = replace(generator.transformer.config, windows_per_scan=3)
    images = two_images(generator.sensor)
    objective = generator.transformer_objective().train()
    loss = objective(Example(images), torch.Generator().manual_seed(5))["loss"].detach()
    grid = generator.get_tokenizer().encode(images).tokens
    windows = generator.transformer.windows
    columns, counted = windows.draw(6, torch.Generator().manual_seed(5))
    nats, count = 0.0, 0
    for number in range(6):  # a slow loop: the windows of one scan follow one another
        tokens = grid[number // 3][:, columns[number]].t().flatten()[None]
        inputs = torch.cat((torch.zeros(1, 1, dtype=torch.long), tokens[:, :-1]), 1)
        logits = generator.transformer(inputs, columns[number : number + 1])
        each = torch.nn.functional.cross_entropy(logits[0], tokens[0], reduction="none").unflatten(0, (8, 16))
        nats, count = nats + float(each.detach()[counted[number]].sum()), count + 16 * int(counted[number].sum())
    assert float(loss) == pytest.approx(nats / count, rel=1e-4)


def test_several_windows_of_a_scan_without_windows_get_one_line():
    with pytest.raises(
        ConfigError, match=r"windows_per_scan=2 without windows; wanted model\.transformer\.window_columns"
    ):
        TransformerConfig(windows_per_scan=2)


def test_the_cost_counts_a_step_for_every_token_and_a_pass_for_every_window_after_the_first():
    generator = small_system()
    steps, windows = 16 * generator.tokenizer.grid_size[1], generator.transformer.windows.in_turn()
    assert generator.cost().network_evaluations == steps + len(windows) - 1 + 1  # and the tokenizer's decoder


def test_positions_of_columns_are_resampled_for_a_grid_of_others_and_those_in_the_window_stay():
    wide, narrow = small_system(1024).transformer_objective(), small_system(512).transformer_objective()
    torch.nn.init.normal_(wide.transformer.column_emb)
    taken = narrow.weights_from(wide)
    pairs = wide.transformer.column_emb.unflatten(1, (-1, 2)).mean(2)
    assert torch.allclose(taken["transformer.column_emb"], pairs, atol=1e-6)
    assert torch.equal(taken["transformer.pos_emb"], wide.transformer.pos_emb)


@pytest.mark.parametrize("columns", [7, 21, 400])
def test_windows_that_do_not_fit_get_one_line(columns):
    with pytest.raises(ConfigError, match=r"window_columns=\d+ for tokens in 21 columns; wanted from 8 to 20"):
        CausalTransformer(TransformerConfig(2, 2, 16, window_columns=columns), 20, GRID)
