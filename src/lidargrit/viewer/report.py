"""An evaluation as one page that needs nothing else: scorecard and the two sets → HTML."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from lidargrit.determinism import evenly_spaced
from lidargrit.errors import without_folders
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.profiles import HALF_VIEW_M, Match, Profile, matches, profile
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, EvalSetRecord, Scorecard
from lidargrit.files import write_text
from lidargrit.viewer._page import document, figure
from lidargrit.viewer.report_charts import line_chart
from lidargrit.viewer.report_pictures import (
    NO_RETURN,
    density_picture,
    difference_picture,
    range_picture,
    rate_picture,
)
from lidargrit.viewer.report_style import STYLE
from lidargrit.viewer.score_table import score_table

_MATCHES = 3  # best, and as many worst
_SHEET = 12  # samples on the sheet
_NAME = 48  # longest name, in letters: what fits below half of the page


def write_report(card: Scorecard, pair: EvalPair, path: Path) -> None:
    """Write a page with scores, pictures and settings; it needs no network, no script and no other file.

    Args:
        card: scores and facts of the evaluation.
        pair: the two sets of scans that were compared.
        path: path of the page; an older page there is replaced in one step.

    Raises:
        OutputError: the page cannot be written.
    """
    write_text(path, page(card, pair))


def page(card: Scorecard, pair: EvalPair) -> str:
    """Return the page as text; foreign text is escaped, and absolute paths lose their folders."""
    limits_m = _limits_m(pair)
    both = profile(pair.samples), profile(pair.reference)
    found = matches(pair.samples, pair.reference)
    parts = [
        _head(card),
        _notes("Read this first", [*card.warnings], "warning"),
        _notes(f"Not as in the protocol {card.protocol}", [*card.deviations], "warning"),
        _scores(card),
        _matches(found, pair, limits_m),
        _means(both, limits_m),
        _rings(both, pair.without_raydrop()),
        _densities(both),
        _sheet(pair.samples, limits_m),
        _settings(card),
    ]
    title = without_folders(f"{card.samples.source} against {card.reference.source}")
    return document(title, STYLE, "\n".join(part for part in parts if part), images="data:")


def _head(card: Scorecard) -> str:
    rows = "".join(
        f'<tr><th scope="row">{name}</th><td>{_escaped(scans.source)}</td><td>{escape(_kind(scans))}</td>'
        f"<td>{scans.scans_used:,} of {scans.scans:,}</td><td>{escape(scans.sensor)}</td>"
        f"<td>{escape(scans.projection)}</td></tr>"
        for name, scans in (("samples", card.samples), ("reference", card.reference))
    )
    about = escape(f"{card.about.get('title', '')} (source: {card.about.get('source', '')})")
    return (
        f"<h1>How close are the samples to real scans?</h1>\n<p>Each metric below measures how far a set of "
        "samples, mostly generated LiDAR scans, is from a reference set of real scans.</p>\n"
        f"<p>Protocol <b>{escape(card.protocol)}</b>: {about}</p>\n"
        '<div class="wide" tabindex="0" role="region" aria-label="the two sets"><table><thead><tr><th scope="col">set'
        '</th><th scope="col">from</th><th scope="col">data set</th><th scope="col">scans compared</th>'
        f'<th scope="col">images</th><th scope="col">projection</th></tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _escaped(text: str) -> str:
    """Return text of the user's machine for a page that others may see."""
    return escape(without_folders(text))


def _kind(scans: EvalSetRecord) -> str:
    return " ".join(word for word in (scans.data_set or "not known", scans.split) if word)


def _notes(title: str, lines: Sequence[str], kind: str) -> str:
    items = "".join(f"<li>{_escaped(line)}</li>" for line in lines)
    return f'<section class="{kind}"><h2>{escape(title)}</h2><ul>{items}</ul></section>' if lines else ""


def _scores(card: Scorecard) -> str:
    not_applicable = [each for each in card.left_out if each.verdict == NOT_APPLICABLE]
    left_out = "".join(f"<li><b>{escape(each.metric)}</b>: {_escaped(each.why)}</li>" for each in card.left_out)
    return (
        f"<section><h2>Scores</h2>{score_table(card.scores, not_applicable)}<p>The dot is the score and the bar its "
        "95 % interval. The upright dashed line is <i>real against real</i>: the score of one half of the reference "
        "against its other half. No generator can be expected to do better. The halves are smaller than the sets, and "
        "most metrics fall as sets grow, so a good score may still lie below this line. The square, where there is "
        "one, is <i>pixel statistics</i>: scans each of whose pixels comes from another real scan. Any model has to "
        "beat it. Every chart begins at 0 and has its own scale.</p>"
        + (f"<h3>Left out</h3><ul>{left_out}</ul>" if left_out else "")
        + "</section>"
    )


def _limits_m(pair: EvalPair) -> tuple[float, float]:
    """Return the two ends of a scale of range, in metres, that holds nearly all returns of both sets."""
    some = [scans.batch(evenly_spaced(16, len(scans))) for scans in (pair.samples, pair.reference)]
    ranges = np.concatenate([images.range_m[images.return_mask].numpy() for images in some] + [np.array([1.0, 80.0])])
    near, far = (float(edge) for edge in np.quantile(ranges, (0.005, 0.999)))
    return near, max(far, near * 2)


def _scan(scans: EvalSet, index: int, limits_m: tuple[float, float], caption: str) -> str:
    image = scans.batch([index])[0]
    share = float(image.return_mask.float().mean())
    picture = range_picture(image.range_m.numpy(), image.return_mask.numpy(), limits_m)
    caption = f"{caption}, {share:.0%} of rays returned"
    return figure(picture, caption, f"range image of {caption}")


def _name(scans: EvalSet, index: int) -> str:
    """Return the end of a scan's path as its name: the folders before it are the user's, and alike for all scans."""
    names = scans.images.provenance.names
    index = scans.indices[index]
    name = names[index] if index < len(names) else f"scan {index}"
    if without_folders(name) != name:
        name = "/".join(name.split("/")[-3:])
    while len(name) > _NAME and "/" in name:
        name = name.partition("/")[2]
    return name[-_NAME:]


def _matches(found: Sequence[Match], pair: EvalPair, limits_m: tuple[float, float]) -> str:
    """Return the samples that are most and least like any reference scan, each beside that scan."""

    def pairs(some: Sequence[Match]) -> str:
        return "".join(
            '<div class="pair">'
            + _scan(pair.samples, match.generated, limits_m, _name(pair.samples, match.generated))
            + _scan(
                pair.reference,
                match.real,
                limits_m,
                f"nearest, at {match.distance:.3f}: {_name(pair.reference, match.real)}",
            )
            + "</div>"
            for match in some
        )

    why = (
        "Each sample stands on the left, and the reference scan that is most like it on the right. The distance of two "
        "scans is the mean absolute difference of log2(1 + range in metres) over all pixels. Yellow is near "
        f"({limits_m[0]:.1f} m), violet is far ({limits_m[1]:.0f} m), and light grey marks rays without a return. A "
        "distance near 0 means that the model memorised a scan, or that one scan is in both sets."
    )
    best, worst = found[:_MATCHES], found[_MATCHES:][-_MATCHES:][::-1]
    text = f"<section><h2>Nearest neighbours</h2><p>{why}</p><h3>The best matches</h3>{pairs(best)}"
    return text + (f"<h3>The worst matches</h3>{pairs(worst)}" if worst else "") + "</section>"


def _means(both: tuple[Profile, Profile], limits_m: tuple[float, float]) -> str:
    figures = []
    for name, scans in zip(("samples", "reference"), both, strict=True):
        finite = ~np.isnan(scans.mean_range_m)
        picture = range_picture(np.where(finite, scans.mean_range_m, 1.0), finite, limits_m)
        figures.append(figure(picture, f"mean range of the {name}", f"mean range image of the {name}"))
    for name, scans in zip(("samples", "reference"), both, strict=True):
        caption = f"return rate of the {name}: dark blue never, yellow always"
        figures.append(figure(rate_picture(scans.return_rate), caption, f"image of the {caption}"))
    why = "The mean over all scans of each set. A good generator has the same mean as the real scans."
    return f'<section><h2>Mean images</h2><p>{why}</p><div class="pair">{"".join(figures)}</div></section>'


def _rings(both: tuple[Profile, Profile], without_raydrop: str) -> str:
    if without_raydrop:
        sentence = f"{NOT_APPLICABLE}: {without_raydrop}"
        return f"<section><h2>Return rate by ring</h2><p>{_escaped(sentence[0].upper() + sentence[1:])}.</p></section>"
    rates = {name: scans.return_rate.mean(axis=1) for name, scans in zip(("samples", "reference"), both, strict=True)}
    count = len(rates["samples"])
    chart = line_chart(rates, "ring, 0 = the highest", "return rate", range(0, count, max(1, count // 8)))
    rows = "".join(
        f'<tr><th scope="row">{ring}</th><td>{first:.3f}</td><td>{second:.3f}</td></tr>'
        for ring, (first, second) in enumerate(zip(rates["samples"], rates["reference"], strict=True))
    )
    return (
        '<section><h2>Return rate by ring</h2><p><span class="key0">samples: solid</span>, '
        f'<span class="key1">reference: dashed</span>.</p>{chart}<details><summary>The same as numbers</summary>'
        '<table><thead><tr><th scope="col">ring</th><th scope="col">samples</th><th scope="col">reference</th></tr>'
        f"</thead><tbody>{rows}</tbody></table></details></section>"
    )


def _densities(both: tuple[Profile, Profile]) -> str:
    highest = max(float(scans.density.max()) for scans in both)
    difference = both[0].density - both[1].density
    figures = [
        figure(
            density_picture(scans.density, highest), f"the {name}", f"density of points of the {name}, seen from above"
        )
        for name, scans in zip(("samples", "reference"), both, strict=True)
    ]
    caption = "samples minus reference: red where the samples have more points, blue where the reference has"
    picture = difference_picture(difference, float(np.abs(difference).max()))
    return (
        "<section><h2>Seen from above</h2><p>Points per scan and square metre, on one scale. Forward is up and left is "
        f"left, each picture is {2 * HALF_VIEW_M:.0f} m long, and the sensor is in the middle.</p>"
        f'<div class="views">{"".join(figures)}{figure(picture, caption)}</div></section>'
    )


def _sheet(scans: EvalSet, limits_m: tuple[float, float]) -> str:
    figures = "".join(_scan(scans, index, limits_m, _name(scans, index)) for index in evenly_spaced(_SHEET, len(scans)))
    why = "These samples are evenly spaced over the set; nobody selected them."
    return f'<section><h2>Samples</h2><p>{why}</p><div class="pair">{figures}</div></section>'


def _settings(card: Scorecard) -> str:
    """Return everything that is needed to repeat the evaluation, without the curves."""
    data = card.to_json()
    for score in data["scores"]:
        score.pop("details")
    departures = _notes(
        "Where this program departs from the protocol's source", [*card.about.get("departures", [])], "note"
    )
    text = escape("\n".join(map(without_folders, json.dumps(data, indent=2, ensure_ascii=False).split("\n"))))
    return (
        f"{departures}<section><h2>Settings</h2><details><summary>Every setting, hash and version</summary>"
        f'<pre tabindex="0">{text}</pre></details><p><span class="swatch" style="background:{NO_RETURN}"></span> '
        "is the colour of rays without a return, in all pictures.</p></section>"
    )
