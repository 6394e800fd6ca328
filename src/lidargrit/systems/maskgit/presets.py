"""Presets of MaskGIT: the networks of LidarGRIT's, of which the second fills in tokens in 16 passes, not one by one."""

from lidargrit.generation import presets as shared
from lidargrit.generation.presets import preset
from lidargrit.systems.maskgit.system import MaskGitConfig

_SMALL = MaskGitConfig(shared.SMALL_VQVAE, shared.SMALL_TRANSFORMER)

TO_COMPARE_WITH = {
    "maskgit_small": preset(
        "MaskGIT, small: networks of lidargrit_small, the second filling in tokens in few passes",
        shared.STREETS,
        _SMALL,
        tokenizer=shared.SMALL_STAGES["tokenizer"],
        transformer=shared.SMALL_STAGES["transformer"],
    ),
    # The tokenizer of a run of lidargrit_demo can be taken by ``training.tokenizer.start``.
    "maskgit_demo": preset(
        "MaskGIT, demo: the small model for a few minutes",
        shared.DEMO_STREETS,
        _SMALL,
        tokenizer=shared.DEMO_STAGES["tokenizer"],
        transformer=shared.DEMO_STAGES["transformer"],
    ),
}
