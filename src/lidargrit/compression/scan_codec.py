"""One range image ⇄ bytes, by a generator with a tokenizer and a pixel decoder."""

from __future__ import annotations

import copy
import hashlib
import json
import struct

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from lidargrit.compression.arithmetic import sigmoid
from lidargrit.compression.coder import ONE, Coder, Decoder, Encoder, not_reproduced
from lidargrit.compression.rounding import ATTEMPTS, MASK_LOGITS, Rounding, TooNearABorderError
from lidargrit.compression.step_mixture import StepMixture
from lidargrit.errors import ConfigError, ScanError
from lidargrit.generators import Generator
from lidargrit.generators._tokens import TokenGenerator
from lidargrit.nn.pixel_networks import Guide
from lidargrit.nn.range_mixture import RangeMixture
from lidargrit.nn.range_steps import RangeSteps
from lidargrit.structures import RangeImage, TokenGrid

_HEAD = struct.Struct("<B8s")  # attempt of the rounding, first bytes of the hash of the pixels

Pixels = Int64[np.ndarray, "H W"]
"""Range of every pixel in whole steps; 0 where there is no return."""


class ScanCodec:
    """Compresses range images losslessly, once their ranges are rounded to a step.

    Tokens, mask and ranges are coded in the order in which the generator would sample them, the latter two phase by
    phase. Tokens are coded as equally likely: a transformer would make the file one hundredth smaller, and would take
    most of the time. Scans are computed on the CPU, one by one, whatever device the generator is on.

    Args:
        generator: generator with a pixel decoder.
        step_mm: step of the ranges in whole millimetres.

    Raises:
        ConfigError: a generator without a pixel decoder, a step that is not one, or no range coder.
    """

    def __init__(self, generator: Generator, step_mm: int) -> None:
        if not isinstance(generator, TokenGenerator) or generator.pixels is None:
            raise ConfigError(
                f"a model of {generator.public_name()!r} without a pixel decoder",
                "one whose pixels have probabilities",
                "take pretrained, or train a recipe with the stage pixels, such as compact_pixels",
            )
        Encoder()  # says at once if there is no range coder
        self.sensor, self.steps = generator.sensor, RangeSteps(generator.sensor, step_mm)
        self._encoder = generator.tokenizer.eval()
        self._tokenizer = copy.deepcopy(generator.tokenizer).cpu().double().eval().requires_grad_(False)
        self._pixels = copy.deepcopy(generator.pixels).cpu().double().eval().requires_grad_(False)

    def digest(self) -> str:
        """Return a hash of all that probabilities depend on: weights, their sizes, and the sensor."""
        found = hashlib.sha256(json.dumps(self.sensor.to_json(), sort_keys=True).encode())
        for part in (self._tokenizer, self._pixels):
            for name, weight in sorted(part.state_dict().items()):
                found.update(f"{name} {tuple(weight.shape)}".encode())
                found.update(weight.contiguous().numpy().astype("<f8").tobytes())
        return found.hexdigest()

    @torch.no_grad()
    def compress(self, image: RangeImage) -> bytes:
        """Return a range image (H, W) as bytes; ranges are rounded to the step, which moves them by half of it at most.

        Raises:
            ConfigError: an image of another sensor.
        """
        if image.range_m.ndim != 2 or not image.sensor.same_rays(self.sensor):
            raise ConfigError(
                f"a range image {tuple(image.range_m.shape)} of the sensor {image.sensor.name!r}",
                f"one image ({self.sensor.height}, {self.sensor.width}) of {self.sensor.name!r}",
                "project the scan with the sensor of the model",
            )
        rounded = self.steps.round(RangeImage.stack([image]))
        device = next(self._encoder.parameters()).device
        tokens = self._encoder.encode(rounded.to(device)).tokens.cpu()
        indices = self.steps.indices(rounded.range_m[0]).where(rounded.return_mask[0].cpu(), 0).cpu().numpy()
        for attempt in range(ATTEMPTS):
            coder = Encoder()
            try:
                self._code(coder, Rounding(attempt, checked=True), tokens, indices)
            except TooNearABorderError:
                continue
            compressed = _HEAD.pack(attempt, _hash(indices)) + coder.words()
            self.decompress(compressed)  # so that nothing is written that this machine could not read
            return compressed
        raise ScanError("a scan whose numbers lie at borders in every attempt", "another", "report it as a fault")

    @torch.no_grad()
    def decompress(self, compressed: bytes) -> RangeImage:
        """Return the range image (H, W) that :meth:`compress` was given, its ranges rounded to the step.

        Raises:
            ScanError: bytes of another model or machine; their pixels have another hash.
        """
        if len(compressed) < _HEAD.size or (len(compressed) - _HEAD.size) % 4 or compressed[0] >= ATTEMPTS:
            raise not_reproduced()
        attempt, expected = _HEAD.unpack_from(compressed)
        pixels = self._code(Decoder(compressed[_HEAD.size :]), Rounding(attempt, checked=False))
        if _hash(pixels) != expected:
            raise not_reproduced()
        found = torch.from_numpy(pixels)
        return RangeImage.masked(self.steps.range_m(found), found > 0, self.sensor)

    def _code(
        self, coder: Coder, rounding: Rounding, tokens: Tensor | None = None, known: Pixels | None = None
    ) -> Pixels:
        """Code or decode a scan, in one order; the scan itself is given only to an encoder."""
        rows, columns = self._tokenizer.grid_size
        numbers = None if tokens is None else tokens.flatten().numpy()
        found = coder.uniform(rows * columns, self._tokenizer.num_codes, numbers)
        grid = TokenGrid(torch.from_numpy(found).view(1, rows, columns), self._tokenizer.num_codes)
        guide = Guide.of(self._tokenizer.decode(grid))
        mask = self._code_mask(coder, rounding, guide, known)
        return self._code_ranges(coder, rounding, guide, mask, known)

    def _code_mask(self, coder: Coder, rounding: Rounding, guide: Guide, known: Pixels | None) -> Tensor:
        network, mask = self._pixels.mask, torch.zeros_like(guide.v, dtype=torch.bool)
        guided = network.guided(guide)
        for phase in network.phases:
            logits = network.logits([phase], network.outputs([phase], guided, guide, mask, guide.v), guide)[0, 0]
            rounded = rounding.indices(logits.flatten().numpy(), MASK_LOGITS) * MASK_LOGITS.step
            probability = np.rint(sigmoid(rounded) * ONE).astype(np.int64)
            outcome = None if known is None else known[phase.pixels].flatten() > 0
            returned = coder.decisions(probability, outcome)
            mask[(0, *phase.pixels)] = torch.from_numpy(returned).view(logits.shape)
        return mask

    def _code_ranges(
        self, coder: Coder, rounding: Rounding, guide: Guide, mask: Tensor, known: Pixels | None
    ) -> Pixels:
        network, v = self._pixels.range, torch.zeros_like(guide.v)
        guided, pixels = network.guided(guide), np.zeros(v.shape[1:], dtype=np.int64)
        for phase in network.phases:
            candidates = network.candidates([phase], guide, mask, v)
            output = network.outputs([phase], guided, guide, mask, v)
            mixture = network.mixture([phase], output, candidates, guide)
            returned = mask[(0, *phase.pixels)]
            parts = mixture.logits, mixture.centres, mixture.log_scales
            logits, centres, log_scales = (part[0, 0][returned] for part in parts)
            some = RangeMixture(logits, centres, log_scales, mixture.limits_m)
            steps = StepMixture(some, rounding, self.steps)
            values = None if known is None else known[phase.pixels][returned.numpy()]
            pixels[phase.pixels][returned.numpy()] = coder.integers(steps, self.steps.first, self.steps.last, values)
            range_m = torch.from_numpy(pixels[phase.pixels] * self.steps.step_mm / 1000)
            v[(0, *phase.pixels)] = range_m.log1p()
        return pixels


def _hash(pixels: Pixels) -> bytes:
    return hashlib.sha256(pixels.astype("<u4").tobytes()).digest()[:8]
