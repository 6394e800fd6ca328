"""The page of the demo, for newcomers: a scan, its tokens, its reconstruction and new scans → HTML."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps

from lidargrit.core.files import write_text
from lidargrit.core.version import __version__
from lidargrit.data.images import RangeImages
from lidargrit.evaluation.reconstruction import ReconstructionErrors
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.generation.generator import Generator
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice, completed_lattices
from lidargrit.nn.random import rngs_of
from lidargrit.scans.types import Decoded, RangeImage, TokenGrid
from lidargrit.systems.lidargrit.system import LidarGrit, TokenSampling
from lidargrit.viewer import interactive
from lidargrit.viewer._page import asset, document, part
from lidargrit.viewer.report_charts import score_table
from lidargrit.viewer.report_pictures import colour_picture, range_picture, rate_picture
from lidargrit.viewer.scan_sets import ScanSet

_SCANS_OF_A_SET = 6  # of each set on the page: enough to step through, and half a megabyte each
_LATTICES_SHOWN = 4  # the finest: of coarser ones a picture has a handful of pixels
_EVERY_PIXEL = Lattice(1, 1)
_PIECE = 6, 16  # rows and columns of tokens that are shown as numbers: as many as can be read


@dataclass(frozen=True, eq=False)
class DemoPage:
    """What a page is made of; it follows the first held-out scan through the networks.

    Args:
        kind: kind of the scans: "real" or "simulated".
        real: training scans, of which the nearest to each new scan stands beside it.
        card: scores of the samples against held-out scans, with real against real and pixel statistics.
        seconds: time that each stage took, in seconds, by its name.
        facts: short sentences about the model and its training.
        sampling: settings by which pixels of reconstructed scans are sampled, as those of ``samples`` were.
    """

    generator: Generator
    kind: str
    real: RangeImages
    val: RangeImages
    samples: RangeImages
    errors: ReconstructionErrors
    card: Scorecard
    seconds: Mapping[str, float]
    facts: Sequence[str]
    run: Path
    sampling: TokenSampling = field(default_factory=TokenSampling)

    @cached_property
    def scan(self) -> RangeImage:
        """A batch of the first held-out scan, which the model was not trained on."""
        return self.val.batch([0])

    @cached_property
    def name(self) -> str:
        """The name of this scan."""
        return _name(self.val, 0)

    @cached_property
    def tokens(self) -> TokenGrid:
        """Tokens of the scan."""
        return self.generator.get_tokenizer().encode(self.scan)

    @cached_property
    def decoded(self) -> Decoded:
        """Ranges and probabilities of a return, decoded from the tokens."""
        return self.generator.get_tokenizer().decode(self.tokens)

    @cached_property
    def sampled(self) -> RangeImage:
        """Range image decoded from the tokens, with a sampled return mask."""
        return self.generator.get_tokenizer().sample(self.tokens, rngs_of([0]))

    @cached_property
    def pixels(self) -> PixelDecoder | None:
        """The pixel decoder; None for a model without one."""
        return self.generator.pixels if isinstance(self.generator, LidarGrit) else None

    def sets(self) -> list[ScanSet]:
        """Return new scans, and the training scan nearest to each."""
        new = self.samples.batch(range(min(_SCANS_OF_A_SET, len(self.samples))))
        nearest = nearest_scans(new, self.real)
        names = tuple(_name(self.real, index) for index in nearest)
        return [
            ScanSet("new", new, tuple(f"seed {seed}" for seed in range(len(new))), generated=True),
            ScanSet(f"nearest {self.kind} scan of training", self.real.batch(nearest), names),
        ]


def _name(images: RangeImages, index: int) -> str:
    return images.provenance.names[index].rpartition("/")[2]


def nearest_scans(new: RangeImage, real: RangeImages) -> list[int]:
    """Return for each new scan the index of the real one whose logarithms of range differ least from its own."""
    logs = new.range_m.log1p()
    differences = [(logs - real.batch([index]).range_m.log1p()).abs().mean((1, 2)) for index in range(len(real))]
    return torch.stack(differences).argmin(0).tolist()


def reconstructed(generator: Generator, images: RangeImage, sampling: TokenSampling) -> RangeImage:
    """Return scans decoded from the tokens of others just as those of new scans are, with sampled return masks."""
    tokenizer = generator.get_tokenizer()
    tokens, rngs = tokenizer.encode(images), rngs_of(range(len(images)))
    if isinstance(generator, LidarGrit) and generator.pixels is not None:
        return generator.pixels.sample(tokenizer.decode(tokens), rngs, sampling.pixels())
    return tokenizer.sample(tokens, rngs)


@torch.no_grad()
def write_demo_page(demo: DemoPage, path: Path) -> None:
    """Write the page, which needs no network and no other file; names of files and other foreign text are escaped."""
    near, far = _limits_m(demo)

    def ranges(image: RangeImage, lattice: Lattice = _EVERY_PIXEL) -> tuple[str, str]:
        """Return the picture of a range image, and the share of its rays that returned."""
        pixels = (0, *lattice.pixels)
        range_m, returned = image.range_m[pixels].numpy(), image.return_mask[pixels].numpy()
        return range_picture(range_m, returned, (near, far)), f"{returned.mean():.0%}"

    clean_m, masks = demo.decoded.range_m[0].numpy(), [demo.scan.return_mask, demo.sampled.return_mask]
    phases = []
    if demo.pixels is not None:
        whole = reconstructed(demo.generator, demo.scan, demo.sampling)
        for lattice, count in completed_lattices(demo.pixels.mask.phases)[-_LATTICES_SHOWN:]:
            mask = whole.return_mask[(0, *lattice.pixels)].float().numpy()
            phases.append((count, rate_picture(mask), ranges(whole, lattice)))
    likely, shown = demo.decoded.return_logits[0].sigmoid(), [mask[0].float() for mask in masks]
    content = part(
        "demo.html",
        demo=demo,
        viewer=interactive.viewer_html({"bin": ".bin", "ply": ".ply"}, f"Made by lidargrit {__version__}.", "Save"),
        rows=demo.scan.sensor.height,
        columns=demo.scan.sensor.width,
        limits_m=(near, far),
        scan=ranges(demo.scan),
        **_token_facts(demo),
        decoded=range_picture(clean_m, np.ones(clean_m.shape, dtype=bool), (near, far)),
        masks=[rate_picture(rate.numpy()) for rate in (shown[0], likely, shown[1])],
        sampled=ranges(demo.sampled),
        phases=phases,
        scores=score_table(demo.card),
        run=shlex.quote(str(demo.run)),
    )
    looks = "".join(map(asset, ("page.css", "report.css", "demo.css")))
    title, scans = f"lidargrit demo: {demo.name}", interactive.as_json(demo.sets())
    script = interactive.opening_script() + "page.turn();\n"
    write_text(path, document(title, looks, content, script, scans, "data: blob:"))


def _limits_m(demo: DemoPage) -> tuple[float, float]:
    ranges = demo.scan.range_m[demo.scan.return_mask].numpy()
    near, far = (float(edge) for edge in np.quantile(ranges, (0.005, 0.995))) if len(ranges) else (1.0, 80.0)
    return near, max(far, 2 * near)


def _token_facts(demo: DemoPage) -> dict[str, Any]:
    """Return the tokens as colours, and a piece from the middle as numbers with their colours and ink."""
    tokens, colours = demo.tokens.tokens[0].numpy(), _colours(demo)
    top, left = (max((whole - shown) // 2, 0) for whole, shown in zip(tokens.shape, _PIECE, strict=True))
    piece = slice(top, top + _PIECE[0]), slice(left, left + _PIECE[1])
    shades = (255 * colours[piece]).round().astype(int)
    inks = np.where(shades @ (0.3, 0.6, 0.1) > 120, "#000", "#fff")
    parts_of_rows = zip(tokens[piece], shades, inks, strict=True)
    return {
        "tokens": tokens,
        "codes_used": len(np.unique(tokens)),
        "block": demo.scan.sensor.height // tokens.shape[0],
        "token_picture": colour_picture(colours),
        "top": top,
        "left": left,
        "piece": [[*zip(*row, strict=True)] for row in parts_of_rows],
    }


def _colours(demo: DemoPage) -> Float[np.ndarray, "h w 3"]:
    """Return a colour for each token; codes are ordered by the mean range that they decode to."""
    tokens = demo.tokens.tokens[0]
    blocks = torch.nn.functional.adaptive_avg_pool2d(demo.decoded.range_m[:1], (tokens.shape[0], tokens.shape[1]))[0]
    codes, index = tokens.unique(return_inverse=True)
    mean_m = torch.zeros(len(codes)).index_add(0, index.flatten(), blocks.flatten())
    mean_m /= torch.bincount(index.flatten(), minlength=len(codes))
    order = mean_m.argsort().argsort().float() / max(len(codes) - 1, 1)
    return colormaps["turbo"](order[index].numpy())[..., :3]
