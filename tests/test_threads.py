"""What the command arranges: threads sleep while they wait for one another, and freed memory is used again."""

import os
import platform
import subprocess
import sys

import pytest
import torch

from lidargrit.generation.generator import load
from lidargrit.nn.decoding import CachedDecoder
from lidargrit.nn.transformer import CausalTransformer, TransformerConfig
from lidargrit.scans.projection import project
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import simulate

ASK = """
import os, sys
from lidargrit.cli import main
{before}
loaded = "torch" in sys.modules
main([])  # its help
print(loaded, *(os.environ.get(name, "unset") for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")), file=sys.stderr)
"""


FAULTS = """
import resource, sys
from lidargrit.cli import main
sys.argv = ["lidargrit"]
main()
length = 27
b"x" * (1 << length)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
b"x" * (1 << length)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def waiting_in_the_command(before="", **variables):
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))}
    program = [sys.executable, "-c", ASK.format(before=before)]
    answer = subprocess.run(program, env=kept | variables, capture_output=True, text=True, check=True, timeout=60)
    return answer.stderr.split()


def test_the_command_lets_threads_sleep_before_torch_is_loaded():
    assert waiting_in_the_command() == ["False", "PASSIVE", "0"]


def test_what_the_user_has_set_stays():
    assert waiting_in_the_command(OMP_WAIT_POLICY="ACTIVE") == ["False", "ACTIVE", "unset"]
    assert waiting_in_the_command(GOMP_SPINCOUNT="1000") == ["False", "unset", "1000"]


def test_a_program_that_has_loaded_torch_keeps_its_environment():
    assert waiting_in_the_command("import torch") == ["True", "unset", "unset"]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep memory by rules of their own")
def test_the_command_uses_freed_memory_again_unless_the_user_sets_what_malloc_keeps():
    def page_faults(**variables):
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
        program = [sys.executable, "-c", FAULTS]
        answer = subprocess.run(program, env=kept | variables, capture_output=True, text=True, check=True, timeout=60)
        return int(answer.stdout.split()[-1])

    assert page_faults() < 1000  # 128 MiB are 32,768 pages of 4 KiB
    assert page_faults(MALLOC_ARENA_MAX="64") > 30_000


@pytest.mark.parametrize(("policy", "width", "expected"), [("", 16, 1), ("PASSIVE", 16, 3), ("ACTIVE", 1024, 3)])
def test_small_steps_are_not_shared_by_threads_that_spin(policy, width, expected, monkeypatch):
    monkeypatch.setenv("OMP_WAIT_POLICY", policy)
    config = TransformerConfig(layers=1, heads=2, width=width)
    transformer = CausalTransformer(config, num_tokens=8, grid_size=(1, 2)).eval()
    seen = []

    def sample_token(logits, uniform):
        seen.append(torch.get_num_threads())
        return logits.argmax(dim=1)

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        CachedDecoder(transformer, 8, sample_token).generate(torch.zeros(8, 2))
        assert seen == [expected, expected]
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_two_threads_move_decoded_ranges_by_less_than_a_millimetre():
    model, before = load("pretrained"), torch.get_num_threads()
    images = RangeImage.stack([project(simulate(0), model.sensor)])
    found = []
    try:
        for number in (1, 2):
            torch.set_num_threads(number)
            found.append(model.reconstruct(images))
    finally:
        torch.set_num_threads(before)
    both = found[0].return_mask & found[1].return_mask
    assert (found[0].return_mask == found[1].return_mask).float().mean() > 0.9999
    assert float((found[0].range_m - found[1].range_m)[both].abs().max()) < 1e-3
