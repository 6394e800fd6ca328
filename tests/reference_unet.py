"""R2DM's network once more, slowly and in NumPy, from weights by the names that its authors published."""

import math

import numpy as np
from scipy.signal import upfirdn


class SlowUnet:
    """Reads a state dict laid out as the published one and evaluates one image (C, H, W) at one log SNR."""

    def __init__(self, weights, blocks, groups, heads):
        self.weights = {
            name.removeprefix("denoiser."): np.asarray(of, dtype=np.float64) for name, of in weights.items()
        }
        self.blocks, self.groups, self.heads = blocks, groups, heads

    def __call__(self, image, log_snr):
        embedding = self.time(log_snr)
        x = self.convolve("in_conv", np.concatenate((image, self.rays())))
        kept = []
        for level in (1, 2, 3, 4):
            x = self.level(f"d_block{level}", x, embedding, halve=level > 1, attend=level == 4)
            kept.append(x)
        x = self.level("u_block4", kept[3], embedding, double=True, attend=True)
        x = self.level("u_block3", np.concatenate((x, kept[2])), embedding, double=True)
        x = self.level("u_block2", np.concatenate((x, kept[1])), embedding, double=True)
        x = self.level("u_block1", np.concatenate((x, kept[0])), embedding)
        return self.convolve("out_conv", x)

    def level(self, name, x, embedding, halve=False, double=False, attend=False):
        if halve:
            x = resample(self.convolve(f"{name}.downsample.0", x), down=2)
        for block in range(self.blocks):
            x = self.residual(f"{name}.residual_blocks.{block}", x, embedding)
        if attend:
            x = self.attention(f"{name}.self_attn_block", x)
        return self.convolve(f"{name}.upsample.1", resample(x, up=2)) if double else x

    def residual(self, name, x, embedding):
        h = self.normed(x, f"{name}.norm1")
        h = self.convolve(f"{name}.conv1", silu(h))
        scale, shift = np.split(self.linear(f"{name}.norm2.proj.1", silu(embedding)), 2)
        h = self.normed(h) * (1 + scale[:, None, None]) + shift[:, None, None]
        h = self.convolve(f"{name}.conv2", silu(h))
        if f"{name}.skip.weight" in self.weights:
            x = np.einsum("oi,ihw->ohw", self.weights[f"{name}.skip.weight"][:, :, 0, 0], x)
            x += self.weights[f"{name}.skip.bias"][:, None, None]
        return (x + h) * math.sqrt(0.5)

    def attention(self, name, x):
        channels, height, width = x.shape
        pixels = self.normed(x, f"{name}.norm").reshape(channels, -1).T
        joint = pixels @ self.weights[f"{name}.attn.in_proj_weight"].T + self.weights[f"{name}.attn.in_proj_bias"]
        q, k, v = np.split(joint, 3, axis=1)
        size, found = channels // self.heads, []
        for head in range(self.heads):
            own = slice(head * size, (head + 1) * size)
            scores = np.exp(q[:, own] @ k[:, own].T / math.sqrt(size))
            found.append(scores / scores.sum(1, keepdims=True) @ v[:, own])
        out = np.stack([self.linear(f"{name}.attn.out_proj", one) for one in np.concatenate(found, 1)])
        return (x + out.T.reshape(channels, height, width)) * math.sqrt(0.5)

    def time(self, log_snr):
        channels = self.weights["time_embedding.1.weight"].shape[1]
        rates = np.exp(-math.log(10_000) / (channels // 2 - 1) * np.arange(channels // 2))
        h = np.concatenate((np.sin(log_snr * rates), np.cos(log_snr * rates)))
        return self.linear("time_embedding.3", silu(self.linear("time_embedding.1", h)))

    def rays(self):
        elevation, azimuth = self.weights["coords"][0]
        height, width = elevation.shape
        phases = [elevation * 2**k for k in range(math.ceil(math.log2(height)))]
        phases += [azimuth * 2**k for k in range(math.ceil(math.log2(width)))]
        return np.concatenate((np.sin(phases), np.cos(phases)))

    def normed(self, x, name=""):
        apart = x.reshape(self.groups, -1)
        y = ((apart - apart.mean(1, keepdims=True)) / np.sqrt(apart.var(1, keepdims=True) + 1e-6)).reshape(x.shape)
        if name:
            y = y * self.weights[f"{name}.weight"][:, None, None] + self.weights[f"{name}.bias"][:, None, None]
        return y

    def linear(self, name, x):
        return self.weights[f"{name}.weight"] @ x + self.weights[f"{name}.bias"]

    def convolve(self, name, x):
        """Sum over the nine taps: columns turn around, rows beyond the image are zero."""
        kernel = self.weights[f"{name}.weight"]
        height, total = x.shape[1], 0
        for row in (-1, 0, 1):
            moved = np.zeros_like(x)
            moved[:, max(-row, 0) : height - max(row, 0)] = x[:, max(row, 0) : height + min(row, 0)]
            for column in (-1, 0, 1):
                tap = kernel[:, :, row + 1, column + 1]
                total = total + np.einsum("oi,ihw->ohw", tap, np.roll(moved, -column, axis=2))
        return total + self.weights[f"{name}.bias"][:, None, None]


def silu(x):
    return x / (1 + np.exp(-x))


def resample(x, up=1, down=1):
    """Put zeros between pixels, filter by 1, 3, 3, 1, and keep every ``down``-th; columns turn around."""
    taps = np.array([1.0, 3.0, 3.0, 1.0]) * up / 8
    for axis in (2, 1):
        margin, length = 4, x.shape[axis]
        widths = [(0, 0)] * 3
        widths[axis] = (margin, margin)
        wide = np.pad(x, widths, mode="wrap" if axis == 2 else "constant")
        full = np.apply_along_axis(lambda line: upfirdn(taps, line, up), axis, wide)
        # An even filter reaches half a pixel of the finer grid to either side.
        begin = margin * up + (2 if down == 2 else 1)
        x = np.take(full, range(begin, begin + length * up, down), axis=axis)
    return x
