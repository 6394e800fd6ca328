"""What a trained model does, told on one page: a scan, its tokens and all that comes of them → HTML for everybody."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib import colormaps

from lidargrit import __version__
from lidargrit.evaluation.reconstruction import ReconstructionErrors
from lidargrit.evaluation.scorecard import Scorecard, format_value
from lidargrit.files import write_text
from lidargrit.metrics import load_metric
from lidargrit.structures import Decoded, RangeImage, TokenGrid
from lidargrit.viewer import interactive
from lidargrit.viewer.interactive import button
from lidargrit.viewer.report_charts import bar_chart, score_chart
from lidargrit.viewer.report_pictures import colour_picture, range_picture, rate_picture
from lidargrit.viewer.report_style import STYLE
from lidargrit.viewer.scan_sets import ScanSet

_PIECE = 6, 16  # rows and columns of tokens that are shown as numbers: as many as can be read
_CELL = 44, 24  # of a number on the page, in pixels
_STYLE = """
main{display:block;max-width:1240px}
.lead{font-size:1.08rem;max-width:80ch}
.step{margin-top:2.4em}
.step>h2{margin:0 0 .3em;font-size:1.3rem}
.step>p{max-width:85ch;margin:0 0 .8em}
.head h2{margin:0;font-size:1rem}
.three{display:grid;grid-template-columns:repeat(3,1fr);gap:4px 20px}
.points{min-height:380px}
@media (min-width:1000px){#panes{grid-template-columns:repeat(3,1fr)}}
.ceiling{fill:var(--soft);stroke:var(--paper);stroke-width:1.5}
.bar rect,rect.bar{fill:var(--b)}
.tokens{width:100%;max-width:760px;font-family:ui-monospace,monospace}
.grid{display:block;width:100%;height:170px;border-radius:3px}
.grid image{image-rendering:pixelated}
.facts{color:var(--soft);font-size:.92rem}
#panes .about{font-size:.78rem;overflow:hidden;white-space:nowrap;text-overflow:ellipsis}
figure img{max-height:170px}
code{overflow-wrap:anywhere}
@media (max-width:760px){.three{grid-template-columns:1fr}}
"""


@dataclass(frozen=True, eq=False)
class DemoPage:
    """What there is to tell.

    Args:
        kind: of the scans: "real" or "simulated".
        name: of the scan that is followed.
        scan: a batch of this one; the model has never learned from it.
        tokens: of it.
        decoded: what comes of the tokens.
        drawn: the same as a range image, its returns drawn.
        shown: sets of scans to turn side by side.
        errors: of reconstruction, over all held-out scans.
        card: scores of new scans against training scans.
        floor: the same of held-out scans.
        ceiling: the same of a generator that knows single pixels only.
        seconds: that each stage took, by its name.
        facts: about the model and its training, in short sentences.
        run: the folder that holds it.
    """

    kind: str
    name: str
    scan: RangeImage
    tokens: TokenGrid
    decoded: Decoded
    drawn: RangeImage
    shown: Sequence[ScanSet]
    errors: ReconstructionErrors
    card: Scorecard
    floor: Scorecard
    ceiling: Scorecard
    seconds: Mapping[str, float]
    facts: Sequence[str]
    run: Path


def write_demo_page(story: DemoPage, path: Path) -> None:
    """Write the page; it needs no network and no other file.

    Raises:
        OutputError: the page cannot be written.
    """
    write_text(path, page(story))


def page(story: DemoPage) -> str:
    """Return the page as text. Whatever comes from outside, such as names of files, is escaped."""
    script = interactive.opening_script()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    parts = (_lead, _the_scan, _its_tokens, _its_reconstruction, _its_raydrop, _new_scans, _scores, _timings, _next)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        # Nothing is fetched and no other script runs, whatever a file name may hold.
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data: blob:; '
        f"style-src 'unsafe-inline'; script-src 'sha256-{digest}'\">\n"
        f"<title>lidargrit demo: {escape(story.name)}</title>\n"
        f"<style>{interactive.style()}{STYLE}{_STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part(story) for part in parts)
        + f'\n</main>\n<script type="application/json" id="scans">{interactive.as_json(story.shown)}</script>\n'
        f"<script>{script}</script>\n</body>\n</html>\n"
    )


def _lead(story: DemoPage) -> str:
    facts = "".join(f"<li>{escape(fact)}</li>" for fact in story.facts)
    return (
        "<h1>A LiDAR scan, its tokens, and new scans</h1>\n"
        '<p class="lead">This page shows what <code>lidargrit demo</code> has just done: two networks learned from '
        f"{story.kind} scans for a few minutes, and now write scans of their own. A model of this size after so short "
        "a time is a demonstration, not a good model; its scores do not compare with published tables.</p>"
        f'<ul class="facts">{facts}</ul>'
    )


def _step(title: str, text: str, body: str) -> str:
    return f'<div class="step"><h2>{escape(title)}</h2><p>{text}</p>{body}</div>'


def _figure(drawn: str, told: str) -> str:
    return f'<figure><img src="{drawn}" alt="{escape(told)}"><figcaption>{escape(told)}</figcaption></figure>'


def _limits_m(story: DemoPage) -> tuple[float, float]:
    ranges = story.scan.range_m[story.scan.return_mask].numpy()
    near, far = (float(edge) for edge in np.quantile(ranges, (0.005, 0.995))) if len(ranges) else (1.0, 80.0)
    return near, max(far, 2 * near)


def _ranges(story: DemoPage, image: RangeImage, told: str) -> str:
    share = float(image.return_mask.float().mean())
    drawn = range_picture(image.range_m[0].numpy(), image.return_mask[0].numpy(), _limits_m(story))
    return _figure(drawn, f"{told}; {share:.0%} of rays returned")


def _the_scan(story: DemoPage) -> str:
    rows, columns = story.scan.range_m.shape[1:]
    near, far = _limits_m(story)
    text = (
        f"One revolution of a laser scanner as an image: {rows} rows, one for each laser, and {columns} columns, one "
        "for each direction around the car, with straight ahead in the middle. The colour is the distance, from yellow "
        f"({near:.0f} m) to violet ({far:.0f} m); grey means that nothing came back. The model never learned from it."
    )
    return _step("1. A scan", text, _ranges(story, story.scan, f"{story.kind} scan {story.name}"))


def _its_tokens(story: DemoPage) -> str:
    tokens = story.tokens.tokens[0].numpy()
    colours = _colours(story)
    top = (tokens.shape[0] - _PIECE[0]) // 2
    left = (tokens.shape[1] - _PIECE[1]) // 2
    rows, columns = slice(max(top, 0), max(top, 0) + _PIECE[0]), slice(max(left, 0), max(left, 0) + _PIECE[1])
    block = story.scan.range_m.shape[1] // tokens.shape[0]
    text = (
        f"The first network, a VQ-VAE, writes the scan as {tokens.shape[0]} x {tokens.shape[1]} whole numbers from 0 "
        f"to {story.tokens.num_codes - 1}, one for each {block} x {block} pixels. These {tokens.size:,} tokens are all "
        f"that is kept. This scan uses {len(np.unique(tokens))} of the {story.tokens.num_codes} codes; each has a "
        "colour here, in the order of the distances that it stands for."
    )
    return _step(
        "2. Its tokens", text, _grid(colours, rows, columns) + _numbers(tokens[rows, columns], colours[rows, columns])
    )


def _grid(colours: Float[np.ndarray, "h w 3"], rows: slice, columns: slice) -> str:
    """Draw all tokens, with a frame around the piece of which the numbers are shown."""
    height, width = colours.shape[:2]
    told = "tokens of the scan, a colour for each code; the frame is shown below"
    stretched = f'width="{width}" height="{height}" preserveAspectRatio="none"'
    frame = "".join(
        f'<rect x="{columns.start}" y="{rows.start}" width="{min(columns.stop, width) - columns.start}" '
        f'height="{min(rows.stop, height) - rows.start}" fill="none" stroke="{colour}" stroke-width="{thick}" '
        'vector-effect="non-scaling-stroke"/>'
        for colour, thick in (("#000", 5), ("#fff", 2))
    )
    return (
        f'<figure><svg class="grid" viewBox="0 0 {width} {height}" preserveAspectRatio="none" role="img" '
        f'aria-label="{told}"><image href="{colour_picture(colours)}" {stretched}/>{frame}</svg>'
        f"<figcaption>{told}</figcaption></figure>"
    )


def _colours(story: DemoPage) -> Float[np.ndarray, "h w 3"]:
    """Return a colour for each token: codes in the order of the range that is decoded from them, on a scale."""
    tokens = story.tokens.tokens[0]
    blocks = torch.nn.functional.adaptive_avg_pool2d(story.decoded.range_m[:1], (tokens.shape[0], tokens.shape[1]))[0]
    codes, index = tokens.unique(return_inverse=True)
    mean_m = torch.zeros(len(codes)).index_add(0, index.flatten(), blocks.flatten())
    mean_m /= torch.bincount(index.flatten(), minlength=len(codes))
    order = mean_m.argsort().argsort().float() / max(len(codes) - 1, 1)
    return colormaps["turbo"](order[index].numpy())[..., :3]


def _numbers(tokens: Int[np.ndarray, "h w"], colours: Float[np.ndarray, "h w 3"]) -> str:
    """Draw a piece of the grid with its numbers, for the eyes; a screen reader hears how many they are."""
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
    told = f"the middle {height} x {width} of them, straight ahead, as the second network reads and writes them"
    return (
        f'<figure><svg class="tokens" viewBox="0 0 {width * wide} {height * tall}" role="img" '
        f'aria-label="{told}">{"".join(cells)}</svg><figcaption>{told}</figcaption></figure>'
    )


def _its_reconstruction(story: DemoPage) -> str:
    clean_m = story.decoded.range_m[0].numpy()
    every = range_picture(clean_m, np.ones(clean_m.shape, dtype=bool), _limits_m(story))
    text = (
        "From the tokens alone, the decoder gives a distance for every pixel, also where nothing came back: a clean "
        f"range image without holes. Over {story.errors.num_scans} held-out scans it is "
        f"{story.errors.range_mae_m:.2f} m off on average, where the scan has a return."
    )
    return _step("3. Its reconstruction", text, _figure(every, "decoded range, before any ray is dropped"))


def _its_raydrop(story: DemoPage) -> str:
    likely = story.decoded.return_logits[0].sigmoid().numpy()
    text = (
        "Beside the distance the decoder tells, for each pixel, how likely a return is. Whether there is one is then "
        "drawn, so that no two scans lose the same rays. The decoder finds "
        f"{story.errors.drop_recall:.0%} of the rays that were really lost, and {story.errors.drop_precision:.0%} of "
        "those that it takes for lost are."
    )
    pictures = (
        _figure(rate_picture(story.scan.return_mask[0].float().numpy()), "the scan's own mask: yellow returned")
        + _figure(rate_picture(likely), "decoded probability of a return: dark blue 0, yellow 1")
        + _figure(rate_picture(story.drawn.return_mask[0].float().numpy()), "a mask drawn from it")
    )
    both = _ranges(story, story.drawn, "decoded range with the drawn mask: a scan again")
    return _step("4. Its raydrop", text, f'<div class="three">{pictures}</div>{both}')


def _new_scans(story: DemoPage) -> str:
    text = (
        "The second network, a transformer, writes such tokens one by one, each by the odds of what came before; the "
        "decoder makes scans of them. Drag to turn, use the wheel to zoom, and step through the sets with the arrows."
    )
    buttons = button("bin", ".bin") + button("ply", ".ply")
    return _step(
        "5. New scans", text, interactive.viewer_html("", f"Save {buttons}", f"Written by lidargrit {__version__}.")
    )


def _scores(story: DemoPage) -> str:
    floors, ceilings = (
        {(score.result.metric, score.result.variant): score.result.value for score in card.scores}
        for card in (story.floor, story.ceiling)
    )
    rows = []
    for score in story.card.scores:
        name = score.result.metric, score.result.variant
        floor, ceiling, interval = floors.get(name), ceilings.get(name), score.interval
        told = f"<br><small>{format_value(interval.low)} to {format_value(interval.high)}</small>" if interval else ""
        rows.append(
            f'<tr><th scope="row">{escape(load_metric(name[0]).title)}</th>'
            f'<td class="number">{"" if floor is None else format_value(floor)}</td>'
            f'<td class="number">{format_value(score.result.value)}{told}</td>'
            f'<td class="number">{"" if ceiling is None else format_value(ceiling)}</td>'
            f"<td>{score_chart(score, floor, ceiling)}</td></tr>"
        )
    text = (
        f"How far {story.card.samples.scans_used} new scans are from as many training scans; lower is better. The "
        f"floor (dashed line) is what held-out {story.kind} scans score, which no model should be expected to beat. "
        "The ceiling (square) is what <code>marginal</code> scores, which draws each pixel by itself and knows nothing "
        "of shapes: where it does as well as the floor, the metric looks at single pixels only, and a good score says "
        "little. With so few scans all of these are rough; the line through the dot is the 95 % interval."
    )
    heads = ("metric", "floor", "this model", "ceiling", "drawn from 0")
    head = "".join(f'<th scope="col">{name}</th>' for name in heads)
    return _step(
        "6. How near they come",
        text,
        '<div class="wide" tabindex="0" role="region" aria-label="scores"><table><thead><tr>'
        f"{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>",
    )


def _timings(story: DemoPage) -> str:
    text = "On the machine that made this page, when each stage was first done there."
    return _step("7. How long it took", text, bar_chart(story.seconds, "s"))


def _next(story: DemoPage) -> str:
    run = escape(str(story.run))
    commands = (
        (f"lidargrit serve {run}", "draw more in the browser: other seeds, other temperatures, scans of your own"),
        (f"lidargrit sample {run} samples -n 100", "write a hundred scans"),
        ("lidargrit train small runs/small", "an hour or two instead of minutes, for better ones"),
    )
    items = "".join(f"<li><code>{command}</code>: {told}</li>" for command, told in commands)
    return _step("And now", "", f"<ul>{items}</ul>")
