"""R2Flow's KITTI-360 experiment with its later trainings: a million pairs straighten the flow, 100,000 distil it.

The program distils to 1, 2 or 4 steps (``model.reflow.distilled_steps``). With ``--set stages_from=RUN`` a trained run
of r2flow_kitti_360 is taken over.
"""

from dataclasses import replace

from lidargrit.systems.r2flow.presets import r2flow_kitti_360
from lidargrit.systems.r2flow.system import ReflowConfig

_FLOW = r2flow_kitti_360.PRESET.training["flow"]

PRESET = replace(
    r2flow_kitti_360.PRESET,
    title="R2Flow (2-RF, 4-TD) on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    model=replace(r2flow_kitti_360.PRESET.model, reflow=ReflowConfig(distilled_steps=4)),
    training={"flow": _FLOW, "reflow": _FLOW, "distillation": _FLOW},  # the program changes no setting of these
)
