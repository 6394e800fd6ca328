"""The page of the demo, for newcomers: a scan, its tokens, its reconstruction and new scans → HTML."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
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
from lidargrit.viewer._page import document, figure
from lidargrit.viewer.interactive import button
from lidargrit.viewer.report_charts import bar_chart, score_table
from lidargrit.viewer.report_pictures import colour_picture, range_picture, rate_picture
from lidargrit.viewer.report_style import STYLE
from lidargrit.viewer.scan_sets import ScanSet

_SCANS_OF_A_SET = 6  # of each set on the page: enough to step through, and half a megabyte each
_LATTICES_SHOWN = 4  # the finest: of coarser ones a picture has a handful of pixels
_EVERY_PIXEL = Lattice(1, 1)
_PIECE = 6, 16  # rows and columns of tokens that are shown as numbers: as many as can be read
_CELL = 44, 24  # width and height of the cell of a token on the page, in pixels
_STYLE = """
main{display:block;max-width:1240px}
.lead{font-size:1.08rem;max-width:80ch}
.step{margin-top:2.4em}
.step>h2{margin:0 0 .3em;font-size:1.3rem}
.step>p{max-width:85ch;margin:0 0 .8em}
.head h2{margin:0;font-size:1rem}
.three{display:grid;grid-template-columns:repeat(3,1fr);gap:4px 20px}
.phases{display:grid;grid-template-columns:repeat(4,1fr);gap:4px 14px;margin-bottom:1em}
.points{min-height:380px}
.bar rect,rect.bar{fill:var(--b)}
.tokens{width:100%;max-width:760px;font-family:ui-monospace,monospace}
.grid{display:block;width:100%;height:170px;border-radius:3px}
.grid image{image-rendering:pixelated}
.facts{color:var(--soft);font-size:.92rem}
#panes .about{font-size:.78rem;overflow:hidden;white-space:nowrap;text-overflow:ellipsis}
figure img{max-height:170px}
code{overflow-wrap:anywhere}
@media (max-width:760px){.three,.phases{grid-template-columns:1fr}#panes .about{white-space:normal}}
"""


@dataclass(frozen=True, eq=False)
class DemoPage:
    """What a page is made of; it follows the first held-out scan through the networks.

    Args:
        kind: kind of the scans: "real" or "simulated".
        real: training scans, of which the nearest to each new scan stands beside it.
        val: held-out scans.
        samples: scans that the generator sampled.
        errors: errors of reconstruction over all held-out scans.
        card: scores of the samples against held-out scans, with real against real and pixel statistics.
        seconds: time that each stage took, in seconds, by its name.
        facts: short sentences about the model and its training.
        run: folder of the run.
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


def write_demo_page(demo: DemoPage, path: Path) -> None:
    """Write the page; it needs no network and no other file."""
    write_text(path, page(demo))


@torch.no_grad()
def page(demo: DemoPage) -> str:
    """Return the page as text; names of files and other foreign text are escaped."""
    steps = [_new_scans, _the_scan, _its_tokens, _its_reconstruction, _its_raydrop, _its_phases, _scores, _timings]
    if demo.pixels is None:
        steps.remove(_its_phases)
    parts = [_lead(demo), *(_step(f"{number}. ", *step(demo)) for number, step in enumerate(steps, 1)), _next(demo)]
    looks = f"{interactive.style()}{STYLE}{_STYLE}"
    title, scans = f"lidargrit demo: {demo.name}", interactive.as_json(demo.sets())
    script = interactive.opening_script() + "page.turn();\n"
    return document(title, looks, "\n".join(parts), script, scans, "data: blob:")


class _Step(NamedTuple):
    """A numbered part of the page: title, text in HTML and what stands below it."""

    title: str
    text: str
    body: str


def _lead(demo: DemoPage) -> str:
    facts = "".join(f"<li>{escape(fact)}</li>" for fact in demo.facts)
    return (
        "<h1>New LiDAR scans, and how they came about</h1>\n"
        '<p class="lead">This page shows what <code>lidargrit demo</code> has just done. Networks learned from '
        f"{demo.kind} LiDAR scans, and now generate scans that no sensor recorded.</p>"
        f'<ul class="facts">{facts}</ul>'
    )


def _step(number: str, title: str, text: str, body: str) -> str:
    return f'<div class="step"><h2>{number}{escape(title)}</h2><p>{text}</p>{body}</div>'


def _limits_m(demo: DemoPage) -> tuple[float, float]:
    ranges = demo.scan.range_m[demo.scan.return_mask].numpy()
    near, far = (float(edge) for edge in np.quantile(ranges, (0.005, 0.995))) if len(ranges) else (1.0, 80.0)
    return near, max(far, 2 * near)


def _ranges(demo: DemoPage, image: RangeImage, caption: str, lattice: Lattice = _EVERY_PIXEL) -> str:
    pixels = (0, *lattice.pixels)
    range_m, returned = image.range_m[pixels].numpy(), image.return_mask[pixels].numpy()
    return figure(
        range_picture(range_m, returned, _limits_m(demo)), f"{caption}; {returned.mean():.0%} of rays returned"
    )


def _the_scan(demo: DemoPage) -> _Step:
    rows, columns = demo.scan.range_m.shape[1:]
    near, far = _limits_m(demo)
    text = (
        "A LiDAR sensor on the roof of a car spins and measures distances with many lasers. This is one revolution as "
        f"a range image: {rows} rows, one for each laser, and {columns} columns, one for each direction around the "
        "car, with straight ahead in the middle. The colour is the distance, from yellow "
        f"({near:.0f} m) to violet ({far:.0f} m). Grey marks rays without a return: no light came back to the sensor. "
        "The model was not trained on this scan."
    )
    return _Step("A scan", text, _ranges(demo, demo.scan, f"{demo.kind} scan {demo.name}"))


def _its_tokens(demo: DemoPage) -> _Step:
    tokens = demo.tokens.tokens[0].numpy()
    colours = _colours(demo)
    top = (tokens.shape[0] - _PIECE[0]) // 2
    left = (tokens.shape[1] - _PIECE[1]) // 2
    rows, columns = slice(max(top, 0), max(top, 0) + _PIECE[0]), slice(max(left, 0), max(left, 0) + _PIECE[1])
    block = demo.scan.range_m.shape[1] // tokens.shape[0]
    text = (
        f"The first network, a VQ-VAE, encodes the scan as {tokens.shape[0]} x {tokens.shape[1]} whole numbers from 0 "
        f"to {demo.tokens.num_codes - 1}, one for each block of {block} x {block} pixels. Each number is the index of "
        f"a learned code, and is called a token. Nothing else of the scan is kept. This scan uses "
        f"{len(np.unique(tokens))} of the {demo.tokens.num_codes} codes. Each code has its own colour here; the "
        "colours are in the order of the distances that the codes decode to. The second network, a transformer, "
        "samples such tokens one after another, each from probabilities that depend on those before it; the new scans "
        "above are decoded from these."
    )
    return _Step(
        "Its tokens", text, _grid(colours, rows, columns) + _numbers(tokens[rows, columns], colours[rows, columns])
    )


def _grid(colours: Float[np.ndarray, "h w 3"], rows: slice, columns: slice) -> str:
    """Plot all tokens as colours, with a frame around those that are then shown as numbers."""
    height, width = colours.shape[:2]
    caption = "tokens of the scan, one colour for each code; those in the frame are shown below as numbers"
    stretched = f'width="{width}" height="{height}" preserveAspectRatio="none"'
    frame = "".join(
        f'<rect x="{columns.start}" y="{rows.start}" width="{min(columns.stop, width) - columns.start}" '
        f'height="{min(rows.stop, height) - rows.start}" fill="none" stroke="{colour}" stroke-width="{thick}" '
        'vector-effect="non-scaling-stroke"/>'
        for colour, thick in (("#000", 5), ("#fff", 2))
    )
    return (
        f'<figure><svg class="grid" viewBox="0 0 {width} {height}" preserveAspectRatio="none" role="img" '
        f'aria-label="{caption}"><image href="{colour_picture(colours)}" {stretched}/>{frame}</svg>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _colours(demo: DemoPage) -> Float[np.ndarray, "h w 3"]:
    """Return a colour for each token; codes are ordered by the mean range that they decode to."""
    tokens = demo.tokens.tokens[0]
    blocks = torch.nn.functional.adaptive_avg_pool2d(demo.decoded.range_m[:1], (tokens.shape[0], tokens.shape[1]))[0]
    codes, index = tokens.unique(return_inverse=True)
    mean_m = torch.zeros(len(codes)).index_add(0, index.flatten(), blocks.flatten())
    mean_m /= torch.bincount(index.flatten(), minlength=len(codes))
    order = mean_m.argsort().argsort().float() / max(len(codes) - 1, 1)
    return colormaps["turbo"](order[index].numpy())[..., :3]


def _numbers(tokens: Int[np.ndarray, "h w"], colours: Float[np.ndarray, "h w 3"]) -> str:
    """Plot a part of the token grid as numbers; a screen reader gets their number only."""
    wide, tall = _CELL
    cells = []
    for row, column in np.ndindex(*tokens.shape):
        red, green, blue = (255 * colours[row, column]).round().astype(int)
        ink = "#000" if 0.3 * red + 0.6 * green + 0.1 * blue > 120 else "#fff"
        x, y = column * wide, row * tall
        cells.append(
            f'<rect x="{x}" y="{y}" width="{wide}" height="{tall}" fill="rgb({red} {green} {blue})"/>'
            f'<text x="{x + wide / 2:.0f}" y="{y + 0.7 * tall:.0f}" text-anchor="middle" style="fill:{ink}">'
            f"{tokens[row, column]}</text>"
        )
    height, width = tokens.shape
    caption = f"{height} x {width} tokens from the middle, straight ahead, as the second network sees them"
    return (
        f'<figure><svg class="tokens" viewBox="0 0 {width * wide} {height * tall}" role="img" '
        f'aria-label="{caption}">{"".join(cells)}</svg><figcaption>{caption}</figcaption></figure>'
    )


def _its_reconstruction(demo: DemoPage) -> _Step:
    clean_m = demo.decoded.range_m[0].numpy()
    every = range_picture(clean_m, np.ones(clean_m.shape, dtype=bool), _limits_m(demo))
    text = (
        "From the tokens alone, the decoder of the VQ-VAE computes a distance for every pixel, even where the scan has "
        f"no return: a clean range image without holes. Over {demo.errors.num_scans} held-out scans, the mean error of "
        f"the distance is {demo.errors.range_mae_m:.2f} m where the scan has a return."
    )
    return _Step("Its reconstruction", text, figure(every, "decoded range, before any ray is dropped"))


def _its_raydrop(demo: DemoPage) -> _Step:
    likely = demo.decoded.return_logits[0].sigmoid().numpy()
    text = (
        "Real sensors lose rays: dark, wet, shiny or far surfaces send too little light back. For each pixel, the "
        "decoder therefore also computes the probability of a return. A return mask is then sampled from these "
        "probabilities, so that no two scans lose the same rays. The decoder finds "
        f"{demo.errors.drop_recall:.0%} of the lost rays, and {demo.errors.drop_precision:.0%} of the rays that it "
        "predicts as lost are lost indeed."
    )
    pictures = (
        figure(
            rate_picture(demo.scan.return_mask[0].float().numpy()), "the return mask of the scan: yellow is a return"
        )
        + figure(rate_picture(likely), "decoded probability of a return: dark blue 0, yellow 1")
        + figure(
            rate_picture(demo.sampled.return_mask[0].float().numpy()), "a return mask sampled from these probabilities"
        )
    )
    both = _ranges(demo, demo.sampled, "decoded range with the sampled return mask: a complete scan")
    return _Step("Its raydrop", text, f'<div class="three">{pictures}</div>{both}')


def _its_phases(demo: DemoPage) -> _Step:
    assert demo.pixels is not None
    whole = reconstructed(demo.generator, demo.scan, demo.sampling)
    lattices = completed_lattices(demo.pixels.mask.phases)
    text = (
        "So far every ray is dropped by itself and every edge is blurred, because the decoder gives each pixel one "
        "distance and one probability. A third network, the pixel decoder, samples the pixels of the same tokens in "
        f"{lattices[-1][1]} phases from coarse to fine: first the return mask, then the distances. Each pixel is "
        "sampled given all pixels of the phases before it. So dropped rays cluster as real ones do, and a point at an "
        "edge lies on the near surface or on the far one, not between them."
    )
    masks, ranges = [], []
    for lattice, count in lattices[-_LATTICES_SHOWN:]:
        after = f"after {count} phase" + ("s" if count > 1 else "")
        mask = whole.return_mask[(0, *lattice.pixels)].float().numpy()
        masks.append(figure(rate_picture(mask), f"return mask {after}"))
        ranges.append(_ranges(demo, whole, after, lattice))
    before_and_after = (
        _ranges(demo, demo.scan, "the scan itself")
        + _ranges(demo, demo.sampled, "its tokens, without the pixel decoder")
        + _ranges(demo, whole, "its tokens, with the pixel decoder")
    )
    grid = f'<div class="phases">{"".join(masks)}{"".join(ranges)}</div>'
    return _Step("Its pixels, phase by phase", text, f'{grid}<div class="three">{before_and_after}</div>')


def _new_scans(demo: DemoPage) -> _Step:
    text = (
        f"On the left are scans that were just generated. Beside each stands the {demo.kind} scan, of those trained on "
        "here, that is nearest to it pixel by pixel: see for yourself whether it is a copy, and whether you can name "
        "a car, a pole or a person on the left as on the right. Drag to turn the points, use the wheel to zoom, and "
        "step through the scans with the arrows."
    )
    buttons = button("bin", ".bin") + button("ply", ".ply")
    return _Step("New scans", text, interactive.viewer_html("", f"Save {buttons}", f"Made by lidargrit {__version__}."))


def _scores(demo: DemoPage) -> _Step:
    text = (
        f"Each metric measures how far {demo.card.samples.scans_used} new scans are from as many held-out scans, which "
        "no network learned from; lower is better. Two bounds stand beside every score. <i>Real against real</i> "
        "(dashed line) is the score of one half of the held-out scans against the other half: no model can be expected "
        "to do better. <i>Pixel statistics</i> (square) is the score of scans each of whose pixels comes from another "
        "held-out scan, so that no shape is left: any model should do better. Both are of half as many scans, and most "
        "metrics fall as sets grow, so a good score may lie below real against real. The bar behind the dot is the "
        "95 % interval. The scores cannot be compared with published tables."
    )
    return _Step("Scores of the new scans", text, score_table(demo.card))


def _timings(demo: DemoPage) -> _Step:
    text = "The time of each stage on the machine that made this page."
    return _Step("How long it took", text, bar_chart(demo.seconds, "s"))


def _next(demo: DemoPage) -> str:
    run = escape(shlex.quote(str(demo.run)))
    commands = (
        (
            f"lidargrit serve {run}",
            "generate more scans in the browser, with other seeds and temperatures, or reconstruct your own",
        ),
        (f"lidargrit sample {run} samples -n 100", "sample a hundred scans into a folder"),
        ("lidargrit train lidargrit_small runs/small", "train for an hour or two instead of minutes, for better scans"),
    )
    items = "".join(f"<li><code>{command}</code>: {purpose}</li>" for command, purpose in commands)
    return _step("", "What to do next", "", f"<ul>{items}</ul>")
