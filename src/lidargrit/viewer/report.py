"""An evaluation as one page that needs nothing else: scorecard and the two sets → HTML."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from lidargrit.determinism import evenly_spaced
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.profiles import HALF_VIEW_M, Match, Profile, matches, profile
from lidargrit.evaluation.scorecard import Score, Scorecard, SetFacts, format_value
from lidargrit.files import write_text
from lidargrit.metrics import load_metric
from lidargrit.viewer.report_charts import line_chart, score_chart
from lidargrit.viewer.report_pictures import (
    NO_RETURN,
    density_picture,
    difference_picture,
    range_picture,
    rate_picture,
)
from lidargrit.viewer.report_style import STYLE

_MATCHES = 3  # best, and as many worst
_SHEET = 12  # samples on the sheet
_NAME = 48  # letters: what fits below half of the page


def write_report(card: Scorecard, pair: EvalPair, path: Path) -> None:
    """Write a page with scores, pictures and the recipe; it needs no network, no script and no other file.

    Args:
        card: what was found.
        pair: the sets that it was found on.
        path: of the page; an older one there is replaced, in one step.

    Raises:
        OutputError: the page cannot be written.
    """
    write_text(path, page(card, pair))


def page(card: Scorecard, pair: EvalPair) -> str:
    """Return the page as text. Whatever comes from outside, such as names of files, is escaped."""
    limits_m = _limits_m(pair)
    both = profile(pair.samples), profile(pair.reference)
    found = matches(pair.samples, pair.reference)
    parts = [
        _head(card),
        _notes("Read this first", [*card.warnings], "warning"),
        _notes(f"Not as the protocol {card.protocol} wants it", [*card.deviations], "warning"),
        _scores(card),
        _matches(found, pair, limits_m),
        _means(both, limits_m),
        _rings(both),
        _densities(both),
        _sheet(pair.samples, limits_m),
        _recipe(card),
    ]
    title = escape(f"{card.samples.source} against {card.reference.source}")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        # Nothing is fetched and no script runs, whatever a file name may hold.
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">\n"
        f"<title>{title}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part for part in parts if part)
        + "\n</main>\n</body>\n</html>\n"
    )


def _head(card: Scorecard) -> str:
    rows = "".join(
        f'<tr><th scope="row">{name}</th><td>{escape(side.source)}</td><td>{escape(_kind(side))}</td>'
        f"<td>{side.scans_used:,} of {side.scans:,}</td><td>{escape(side.sensor)}</td>"
        f"<td>{escape(side.projection)}</td></tr>"
        for name, side in (("samples", card.samples), ("reference", card.reference))
    )
    about = escape(f"{card.about.get('title', '')} (source: {card.about.get('source', '')})")
    return (
        f"<h1>How near are the samples to real scans?</h1>\n<p>Protocol <b>{escape(card.protocol)}</b>: {about}</p>\n"
        '<div class="wide" tabindex="0" role="region" aria-label="the two sets"><table><thead><tr><th scope="col">set'
        '</th><th scope="col">from</th><th scope="col">data set</th><th scope="col">scans compared</th>'
        f'<th scope="col">images</th><th scope="col">projection</th></tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _kind(side: SetFacts) -> str:
    return " ".join(word for word in (side.data_set or "not known", side.split) if word)


def _notes(title: str, lines: Sequence[str], kind: str) -> str:
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<section class="{kind}"><h2>{escape(title)}</h2><ul>{items}</ul></section>' if lines else ""


def _scores(card: Scorecard) -> str:
    rows = "".join(_score_row(score) for score in card.scores)
    left_out = "".join(f"<li><b>{escape(each.metric)}</b>: {escape(each.why)}</li>" for each in card.left_out)
    return (
        "<section><h2>Scores</h2><p>The dot is the score, the bar its 95 % interval, and the upright dashed line the "
        "floor: what one half of the reference scores against its other half, which no generator can be expected to "
        "beat. Halves are smaller than the sets, and most metrics fall as sets grow, so a good score may lie below "
        "the floor. Every drawing begins at 0 and has a scale of its own.</p>"
        '<div class="wide" tabindex="0" role="region" aria-label="scores"><table><thead><tr><th scope="col">metric</th>'
        '<th scope="col">score</th><th scope="col">95 % interval</th><th scope="col">floor</th>'
        '<th scope="col">drawn</th><th scope="col">better</th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
        + _verdict(card)
        + (f"<h3>Left out</h3><ul>{left_out}</ul>" if left_out else "")
        + "</section>"
    )


def _verdict(card: Scorecard) -> str:
    """Say of which scores the whole interval is on the bad side of the floor."""
    known, worse = 0, []
    for score in card.scores:
        if score.interval and (real := score.real_against_real):
            known += 1
            higher = score.result.higher_is_better
            if score.interval.high < real.value if higher else score.interval.low > real.value:
                worse.append(f"{score.result.metric} ({score.result.variant})")
    if not known:
        return ""
    told = f"{len(worse)} of {known} scores are worse than the floor with their whole interval"
    return f"<p>{escape(told + (': ' + ', '.join(worse) if worse else ''))}.</p>"


def _score_row(score: Score) -> str:
    result, interval, floor = score.result, score.interval, score.real_against_real
    told = f"{format_value(interval.low)} to {format_value(interval.high)}" if interval else "not known"
    ground = f"{format_value(floor.value)} <small>(n = {floor.num_scans:,})</small>" if floor else "not known"
    title = escape(load_metric(result.metric).title)
    return (
        f'<tr><th scope="row">{title}<br><small>{escape(result.metric)}, {escape(result.variant)}</small></th>'
        f'<td class="number">{format_value(result.value)}</td><td class="number">{told}</td>'
        f'<td class="number">{ground}</td>'
        f"<td>{score_chart(score)}</td><td>{'higher' if result.higher_is_better else 'lower'}</td></tr>"
    )


def _limits_m(pair: EvalPair) -> tuple[float, float]:
    """Return a scale of range that holds nearly all returns of both sets."""
    some = [side.batch(evenly_spaced(16, len(side))) for side in (pair.samples, pair.reference)]
    ranges = np.concatenate([images.range_m[images.return_mask].numpy() for images in some] + [np.array([1.0, 80.0])])
    near, far = (float(edge) for edge in np.quantile(ranges, (0.005, 0.999)))
    return near, max(far, near * 2)


def _scan(side: EvalSet, place: int, limits_m: tuple[float, float], told: str) -> str:
    image = side.batch([place])[0]
    share = float(image.return_mask.float().mean())
    drawn = range_picture(image.range_m.numpy(), image.return_mask.numpy(), limits_m)
    told = f"{told}, {share:.0%} of rays returned"
    return _figure(drawn, f"range image of {told}", told)


def _figure(drawn: str, spoken: str, told: str) -> str:
    return f'<figure><img src="{drawn}" alt="{escape(spoken)}"><figcaption>{escape(told)}</figcaption></figure>'


def _name(side: EvalSet, place: int) -> str:
    """Name a scan by the end of its path: what stands before it is the same for all, and long."""
    names = side.images.provenance.names
    index = side.indices[place]
    name = names[index] if index < len(names) else f"scan {index}"
    while len(name) > _NAME and "/" in name:
        name = name.partition("/")[2]
    return name[-_NAME:]


def _matches(found: Sequence[Match], pair: EvalPair, limits_m: tuple[float, float]) -> str:
    """Show the samples that are most and least like any reference scan."""

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
        "Samples on the left, beside the reference scans that are most like them: by the mean absolute difference of "
        f"log2(1 + range in metres) over pixels. Yellow is near ({limits_m[0]:.1f} m), violet far "
        f"({limits_m[1]:.0f} m), light grey did not return. A distance near 0 means that a scan was learned by heart, "
        "or is in both sets."
    )
    best, worst = found[:_MATCHES], found[_MATCHES:][-_MATCHES:][::-1]
    text = f"<section><h2>Nearest neighbours</h2><p>{why}</p><h3>The best matches</h3>{pairs(best)}"
    return text + (f"<h3>The worst matches</h3>{pairs(worst)}" if worst else "") + "</section>"


def _means(both: tuple[Profile, Profile], limits_m: tuple[float, float]) -> str:
    figures = []
    for name, side in zip(("samples", "reference"), both, strict=True):
        known = ~np.isnan(side.mean_range_m)
        drawn = range_picture(np.where(known, side.mean_range_m, 1.0), known, limits_m)
        figures.append(_figure(drawn, f"mean range image of the {name}", f"mean range of the {name}"))
    for name, side in zip(("samples", "reference"), both, strict=True):
        told = f"return rate of the {name}: dark blue never, yellow always"
        figures.append(_figure(rate_picture(side.return_rate), f"image of the {told}", told))
    return f'<section><h2>Mean images</h2><div class="pair">{"".join(figures)}</div></section>'


def _rings(both: tuple[Profile, Profile]) -> str:
    rates = {name: side.return_rate.mean(axis=1) for name, side in zip(("samples", "reference"), both, strict=True)}
    count = len(rates["samples"])
    chart = line_chart(rates, "ring, 0 = the highest", "return rate", range(0, count, max(1, count // 8)))
    rows = "".join(
        f'<tr><th scope="row">{ring}</th><td>{first:.3f}</td><td>{second:.3f}</td></tr>'
        for ring, (first, second) in enumerate(zip(rates["samples"], rates["reference"], strict=True))
    )
    return (
        '<section><h2>Return rate by ring</h2><p><span class="key0">samples: solid</span>, '
        f'<span class="key1">reference: dashed</span>.</p>{chart}<details><summary>The numbers</summary>'
        '<table><thead><tr><th scope="col">ring</th><th scope="col">samples</th><th scope="col">reference</th></tr>'
        f"</thead><tbody>{rows}</tbody></table></details></section>"
    )


def _densities(both: tuple[Profile, Profile]) -> str:
    highest = max(float(side.density.max()) for side in both)
    difference = both[0].density - both[1].density
    figures = [
        _figure(
            density_picture(side.density, highest), f"density of points of the {name}, seen from above", f"the {name}"
        )
        for name, side in zip(("samples", "reference"), both, strict=True)
    ]
    told = "samples less reference: red denser in the samples, blue in the reference"
    drawn = difference_picture(difference, float(np.abs(difference).max()))
    return (
        "<section><h2>Seen from above</h2><p>Points per scan and square metre, on one scale; forward is up, left is "
        f"left, each side is {2 * HALF_VIEW_M:.0f} m long and the sensor is in the middle.</p>"
        f'<div class="views">{"".join(figures)}{_figure(drawn, told, told)}</div></section>'
    )


def _sheet(side: EvalSet, limits_m: tuple[float, float]) -> str:
    figures = "".join(_scan(side, place, limits_m, _name(side, place)) for place in evenly_spaced(_SHEET, len(side)))
    return f'<section><h2>Samples</h2><p>Evenly spaced, not chosen.</p><div class="pair">{figures}</div></section>'


def _recipe(card: Scorecard) -> str:
    """Show everything that is needed to repeat the evaluation, without the curves."""
    data = card.to_json()
    for score in data["scores"]:
        score.pop("details")
    departures = _notes(
        "What is done otherwise than in the protocol's source", [*card.about.get("departures", [])], "note"
    )
    text = escape(json.dumps(data, indent=2, ensure_ascii=False))
    return (
        f"{departures}<section><h2>Recipe</h2><details><summary>Every setting, hash and version</summary>"
        f'<pre tabindex="0">{text}</pre></details><p><span class="swatch" style="background:{NO_RETURN}"></span> '
        "is the colour of rays that did not return, in all pictures.</p></section>"
    )
