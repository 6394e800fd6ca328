"""One range image ⇄ bytes, by a generator with a pixel decoder, and by the past of its drive if that takes one."""

import copy
import hashlib
import json
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.generation.generator import Generator
from lidargrit.generation.pixel_decoder.phase_network import Guide
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.generation.tokenizers import Tokenizer
from lidargrit.generation.tokens import TokenGenerator
from lidargrit.inference.compress.coder import ONE, Coder, Decoder, Encoder, StepMixture, not_reproduced
from lidargrit.inference.compress.rounding import MASK_LOGITS, Rounding, sigmoid
from lidargrit.nn.precision import inference
from lidargrit.scans.past import Past
from lidargrit.scans.types import Decoded, RangeImage, TokenGrid
from lidargrit.scans.warp import warp
from lidargrit.systems.forecaster.network import PastNetwork
from lidargrit.systems.forecaster.system import Forecaster
from lidargrit.systems.multiscale.system import Multiscale

_HASH_BYTES = 8  # of the hash of the pixels, with which a scan begins

Pixels = Int64[np.ndarray, "H W"]
"""Range of every pixel in whole steps; 0 where there is no return."""


class Known(NamedTuple):
    """What a coder knows of a scan, and a decoder does not.

    Args:
        tokens: tokens in raster order; None without a tokenizer.
        pixels: range of every pixel in whole steps; 0 where there is no return.
    """

    tokens: Int64[np.ndarray, " n"] | None
    pixels: Pixels


class ScanCodec:
    """Compresses range images losslessly, once their ranges are rounded to a step.

    Tokens if there are any, mask and ranges are coded in the order in which the generator would sample them, the latter
    two phase by phase. Tokens are coded as equally likely: a transformer would make the file one hundredth smaller, and
    would take most of the time. Scans are computed on the CPU, one by one, whatever device the generator is on.

    Attributes:
        past_scans: number of scans of a past that probabilities depend on; 0 for a model that takes none.
    """

    def __init__(self, generator: Generator, step_mm: int) -> None:
        tokenizer, pixels, past = _parts(generator)
        if pixels is None:
            raise ConfigError(
                f"a model of {generator.public_name()!r} without a pixel decoder",
                "one whose pixels have probabilities",
                "take pretrained, or train a preset with the stage pixels, such as lidargrit_compact_pixels",
            )
        Encoder()  # says at once if there is no range coder
        self.sensor, self.steps = generator.sensor, RangeSteps(generator.sensor, step_mm)
        self._encoder = None if tokenizer is None else tokenizer.eval()
        self._tokenizer = copy.deepcopy(tokenizer)
        if self._tokenizer is not None:
            self._tokenizer.cpu().double().eval().requires_grad_(False)
        self._pixels = copy.deepcopy(pixels).cpu().double().eval().requires_grad_(False)
        self._past = None if past is None else copy.deepcopy(past).cpu().double().eval().requires_grad_(False)
        self.past_scans = generator.past_scans

    def digest(self) -> str:
        """Return a hash of all that probabilities depend on: weights, their sizes, and the sensor."""
        found = hashlib.sha256(json.dumps(self.sensor.to_json(), sort_keys=True).encode())
        for part in (self._tokenizer, self._pixels, self._past):
            for name, weight in sorted(part.state_dict().items() if part is not None else ()):
                found.update(f"{name} {tuple(weight.shape)}".encode())
                found.update(weight.contiguous().numpy().astype("<f8").tobytes())
        return found.hexdigest()

    def rounded(self, image: RangeImage) -> RangeImage:
        """Return a range image (H, W) as it comes back: on the CPU, its ranges rounded to the step."""
        return self.steps.round(RangeImage.stack([image]).to("cpu"))[0]

    @inference()
    def compress(self, image: RangeImage, past: Past | None = None) -> bytes:
        """Return a range image (H, W) as bytes; rounding to the step moves ranges by half of it at most.

        Args:
            past: past of the scan, for a model that takes one; none if not given.
        """
        if image.range_m.ndim != 2 or not image.sensor.same_rays(self.sensor):
            raise ConfigError(
                f"a range image {tuple(image.range_m.shape)} of the sensor {image.sensor.name!r}",
                f"one image ({self.sensor.height}, {self.sensor.width}) of {self.sensor.name!r}",
                "project the scan with the sensor of the model",
            )
        rounded = RangeImage.stack([self.rounded(image)])
        tokens = None
        if self._encoder is not None:
            device = next(self._encoder.parameters()).device
            tokens = self._encoder.encode(rounded.to(device)).tokens.flatten().cpu().numpy()
        pixels = self.steps.indices(rounded.range_m[0]).where(rounded.return_mask[0], 0).numpy()
        pixels = np.pad(pixels, ((0, self._pixels.grid.height - len(pixels)), (0, 0)))  # in absent rows nothing returns
        coder = Encoder()
        self._code(coder, past, Known(tokens, pixels))
        compressed = _hash(pixels) + coder.words()
        self.decompress(compressed, past)  # so that nothing is written that this machine could not read
        return compressed

    @inference()
    def decompress(self, compressed: bytes, past: Past | None = None) -> RangeImage:
        """Return the range image (H, W) that :meth:`compress` was given, its ranges rounded to the step.

        Args:
            past: the very past that it was given.
        """
        if len(compressed) < _HASH_BYTES or (len(compressed) - _HASH_BYTES) % 4:
            raise not_reproduced()
        pixels = self._code(Decoder(compressed[_HASH_BYTES:]), past, None)
        if _hash(pixels) != compressed[:_HASH_BYTES]:
            raise not_reproduced()
        found = torch.from_numpy(pixels)[: self.sensor.height]
        return RangeImage.masked(self.steps.range_m(found), found > 0, self.sensor)

    def _code(self, coder: Coder, past: Past | None, known: Known | None) -> Pixels:
        """Code or decode a scan, in one order; the scan itself is given only to an encoder."""
        decoded = self._code_tokens(coder, known) if self._past is None else self._told(self._past, past)
        guide = self._pixels.guide(decoded, 1)
        mask = self._code_mask(coder, guide, known)
        return self._code_ranges(coder, guide, mask, known)

    def _told(self, network: PastNetwork, past: Past | None) -> Decoded:
        return network.told(warp(past or Past.nothing(self.sensor, 1, 1)), self.sensor)

    def _code_tokens(self, coder: Coder, known: Known | None) -> Decoded | None:
        if self._tokenizer is None:
            return None
        (rows, columns), codes = self._tokenizer.grid_size, self._tokenizer.num_codes
        tokens = coder.uniform(rows * columns, codes, None if known is None else known.tokens)
        return self._tokenizer.decode(TokenGrid(torch.from_numpy(tokens).view(1, rows, columns), codes))

    def _code_mask(self, coder: Coder, guide: Guide, known: Known | None) -> Tensor:
        network, mask = self._pixels.mask, torch.zeros_like(guide.v, dtype=torch.bool)
        guided = network.guided(guide)
        for phase in network.phases:
            logits = network.logits([phase], guided, guide, mask)[0, 0]

            def probabilities(rounding: Rounding, logits: Tensor = logits) -> Int64[np.ndarray, " n"]:
                rounded = rounding.indices(logits.flatten().numpy(), MASK_LOGITS) * MASK_LOGITS.step
                return np.rint(sigmoid(rounded) * ONE).astype(np.int64)

            outcome = None if known is None else known.pixels[phase.pixels].flatten() > 0
            returned = coder.decisions(coder.rounded(probabilities), outcome)
            mask[(0, *phase.pixels)] = torch.from_numpy(returned).view(logits.shape)
        return mask

    def _code_ranges(self, coder: Coder, guide: Guide, mask: Tensor, known: Known | None) -> Pixels:
        network, v = self._pixels.range, torch.zeros_like(guide.v)
        guided, pixels = network.guided(guide), np.zeros(v.shape[1:], dtype=np.int64)
        for phase in network.phases:
            mixture = network.distributions([phase], guided, guide, mask, v)
            returned = mask[(0, *phase.pixels)]
            some = mixture.at(returned[None, None])
            steps = coder.rounded(lambda rounding, some=some: StepMixture(some, rounding, self.steps))
            values = None if known is None else known.pixels[phase.pixels][returned.numpy()]
            pixels[phase.pixels][returned.numpy()] = coder.integers(steps, self.steps.first, self.steps.last, values)
            range_m = torch.from_numpy(pixels[phase.pixels] * self.steps.step_mm / 1000)
            v[(0, *phase.pixels)] = range_m.log1p()
        return pixels


def _parts(generator: Generator) -> tuple[Tokenizer | None, PixelDecoder | None, PastNetwork | None]:
    """Return the tokenizer, the pixel decoder, and the network over the past of a generator, which may lack some."""
    if isinstance(generator, Forecaster):
        return None, generator.pixels, generator.past
    if isinstance(generator, Multiscale):
        return None, generator.pixels, None
    return (
        (generator.tokenizer, generator.pixels, None) if isinstance(generator, TokenGenerator) else (None, None, None)
    )


def _hash(pixels: Pixels) -> bytes:
    return hashlib.sha256(pixels.astype("<u4").tobytes()).digest()[:_HASH_BYTES]
