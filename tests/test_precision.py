"""Products of 32-bit numbers are rounded only where a setting says so, whatever the program around us has chosen."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
import torch
from torch import nn

from lidargrit.core.determinism import derive_seed
from lidargrit.generation.presets import load_preset
from lidargrit.nn.precision import Precision, autocast_to, products_in
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.lidargrit.system import LidarGrit, TokenSampling
from lidargrit.training.compute import uniform_images
from lidargrit.training.engine import Engine
from tiny_runs import MODEL

EXACT, ROUNDED = ("highest", False), ("high", True)


def now() -> tuple[str, bool]:
    return torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32


@pytest.fixture(params=[("highest", True), ("medium", True), EXACT])
def callers(request: pytest.FixtureRequest) -> Iterator[tuple[str, bool]]:
    """Let the program around the package choose; the first is torch's default, in which convolutions are rounded."""
    before = now()
    products, torch.backends.cudnn.allow_tf32 = request.param
    torch.set_float32_matmul_precision(products)
    yield request.param
    torch.set_float32_matmul_precision(before[0])
    torch.backends.cudnn.allow_tf32 = before[1]


def test_a_block_inside_another_ends_as_the_outer_one_began(callers: tuple[str, bool]) -> None:
    with products_in("fp32"):
        assert now() == EXACT
        with autocast_to("tf32", torch.device("cpu")):
            assert now() == ROUNDED
            with products_in("bf16"):
                assert now() == EXACT
            assert now() == ROUNDED
        assert now() == EXACT
    assert now() == callers


def test_threads_that_overlap_leave_the_callers_choice(callers: tuple[str, bool]) -> None:
    both_inside, first_left = Barrier(2, timeout=20), Barrier(2, timeout=20)

    def first() -> None:
        with products_in("fp32"):
            both_inside.wait()
        first_left.wait()

    def second() -> tuple[str, bool]:
        with products_in("fp32"):
            both_inside.wait()
            first_left.wait()
            return now()

    with ThreadPoolExecutor(2) as pool:
        found = pool.submit(first), pool.submit(second)
        assert [one.result() for one in found] == [None, EXACT]
    assert now() == callers


class Watched:
    """What torch may round, at every pass through a layer."""

    def __init__(self, network: nn.Module) -> None:
        self.found: set[tuple[str, bool]] = set()
        for layer in network.modules():
            if isinstance(layer, nn.Conv2d | nn.Linear):
                layer.register_forward_pre_hook(lambda *_: self.found.add(now()))


@pytest.mark.parametrize(("decoder", "wanted"), [("fp32", {EXACT}), ("tf32", {EXACT, ROUNDED}), ("bf16", {EXACT})])
def test_sampling_rounds_only_as_its_settings_say(decoder: Precision, wanted: set[tuple[str, bool]]) -> None:
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(32)
    torch.manual_seed(0)
    generator = LidarGrit(LidarGrit.smallest_config(sensor), sensor)
    watched, before = Watched(generator.tokenizer), now()
    generator.reconstruct(uniform_images(sensor, 1))
    assert watched.found == {EXACT}
    generator.tokenizer.for_decoding = lambda precision: generator.tokenizer  # the one that is watched
    generator.sample([0], sampling=TokenSampling(decoder=decoder))
    assert watched.found == wanted
    assert now() == before


@pytest.mark.parametrize(("precision", "wanted"), [("fp32", EXACT), ("tf32", ROUNDED)])
def test_a_training_step_rounds_as_its_precision_says(precision: Precision, wanted: tuple[str, bool]) -> None:
    preset = load_preset("lidargrit_demo", [*MODEL, f"training.tokenizer.precision={precision}"])
    sensor = preset.data.load_sensor()
    objective = preset.build_generator(sensor).objective("tokenizer")
    watched, before = Watched(objective), now()
    engine = Engine(preset.settings_of("tokenizer").precision)
    engine.set_up(objective, torch.optim.AdamW(objective.parameters(), 1e-4))
    example = Example(uniform_images(sensor, 1))
    engine.step(example, derive_seed(0), 1.0)
    engine.evaluate(objective, example, 0)
    assert watched.found == {wanted}
    assert now() == before
