"""R2Flow small, straightened by reflow and distilled to one step (2-RF and 1-TD).

With ``--set stages_from=RUN`` it takes the flow of a trained run of r2flow_small, and trains the rest.
"""

from dataclasses import replace

from lidargrit.systems.r2flow.presets import r2flow_small
from lidargrit.systems.r2flow.system import FlowSampling, ReflowConfig

_FLOW = r2flow_small.PRESET.training["flow"]
_FURTHER = replace(_FLOW, scans=8_000, learning_rate=3e-4, warmup_scans=200, augmentations=())  # pairs are not mirrored

PRESET = replace(
    r2flow_small.PRESET,
    title="R2Flow (2-RF, 1-TD), small: 64x256 in one step, for two CPU cores",
    model=replace(
        r2flow_small.PRESET.model,
        # The adaptive solver would take most of the training's time.
        reflow=ReflowConfig(pairs=4_000, distilled_steps=1, distilled_pairs=4_000, solving=FlowSampling(steps=16)),
    ),
    training={"flow": _FLOW, "reflow": _FURTHER, "distillation": _FURTHER},
)
