"""Weights drawn from a seed, by the rule that the reference numbers were made with."""

import json
import math

import numpy as np
import torch


def seeded_weights(data):
    """Draw every tensor of a layout, in sorted order of its names."""
    rng = np.random.default_rng(int(data["weight_seed"]))
    weights = {}
    for name, shape in sorted(json.loads(str(data["layout"])).items()):
        if name.endswith("num_batches_tracked"):
            continue
        if name.endswith("running_var"):
            drawn = rng.uniform(0.5, 1.5, shape)
        elif name.endswith(("running_mean", "bias")):
            drawn = rng.normal(0, 0.1, shape)
        elif len(shape) == 1:
            drawn = rng.uniform(0.5, 1.5, shape)
        else:
            drawn = rng.normal(0, 1, shape) / math.sqrt(math.prod(shape[1:]))
        weights[name] = torch.from_numpy(np.asarray(drawn, dtype=np.float32))
    return weights
