"""An evaluation as one page that needs nothing else: scorecard and the two sets → HTML."""

import json
from collections.abc import Sequence
from dataclasses import fields, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import without_folders
from lidargrit.core.files import write_text
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.profiles import (
    HALF_VIEW_M,
    MATCHED_COLUMNS,
    MATCHED_ROWS,
    Match,
    Profile,
    matches,
    profile,
    searched_scans,
)
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, EvalSetRecord, LeftOut, Scorecard
from lidargrit.viewer._page import document, figure
from lidargrit.viewer.report_charts import REAL_AGAINST_REAL, line_chart, score_table
from lidargrit.viewer.report_pictures import NO_RETURN, density_picture, difference_picture, range_picture, rate_picture
from lidargrit.viewer.report_style import STYLE

_MATCHES = 3  # best, and as many worst
_SHEET = 12  # samples on the sheet
_NAME = 48  # longest name, in letters: what fits below half of the page


def write_report(card: Scorecard, pair: EvalPair, path: Path) -> None:
    """Write a page with scores, pictures and settings; it needs no network, no script and no other file."""
    write_text(path, page(card, pair))


def page(card: Scorecard, pair: EvalPair) -> str:
    """Return the page as text; foreign text is escaped, and absolute paths lose their folders."""
    card, without_raydrop = _for_others(card, pair.without_raydrop())
    limits_m = _limits_m(pair)
    both = profile(pair.samples), profile(pair.reference)
    parts = [
        _head(card),
        _notes("Read this first", [*card.warnings], "warning"),
        _notes(f"Not as in the protocol {card.protocol}", [*card.deviations], "warning"),
        _scores(card),
        _matches(pair.samples, searched_scans(pair.reference), limits_m),
        _means(both, limits_m),
        _rings(both, without_raydrop),
        _densities(both),
        _sheet(pair.samples, limits_m),
        _settings(card),
    ]
    return document(
        f"{card.samples.source} against {card.reference.source}",
        STYLE,
        "\n".join(part for part in parts if part),
        images="data:",
    )


def _for_others(card: Scorecard, without_raydrop: str) -> tuple[Scorecard, str]:
    """Return scores and a sentence without the folders of the user's machine, for a page that others may see."""
    files = map(str, (card.settings.get("sensor", ""), *card.settings.get("weights", {}).values()))
    sources = [card.samples.source, card.reference.source, *files]

    def changed(value: Any) -> Any:
        if isinstance(value, str):
            return without_folders(value, sources)
        if isinstance(value, (list, tuple)):
            return type(value)(map(changed, value))
        if isinstance(value, dict):
            return {changed(name): changed(of) for name, of in value.items()}
        if isinstance(value, (EvalSetRecord, LeftOut)):
            return replace(value, **{one.name: changed(getattr(value, one.name)) for one in fields(value)})
        return value

    names = ("samples", "reference", "left_out", "deviations", "warnings", "settings", "leak")
    return replace(card, **{name: changed(getattr(card, name)) for name in names}), changed(without_raydrop)


def _head(card: Scorecard) -> str:
    rows = "".join(
        f'<tr><th scope="row">{name}</th><td>{escape(scans.source)}</td><td>{escape(_kind(scans))}</td>'
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


def _kind(scans: EvalSetRecord) -> str:
    return " ".join(word for word in (scans.data_set or "not known", scans.split) if word)


def _notes(title: str, lines: Sequence[str], kind: str) -> str:
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<section class="{kind}"><h2>{escape(title)}</h2><ul>{items}</ul></section>' if lines else ""


def _scores(card: Scorecard) -> str:
    left_out = "".join(f"<li><b>{escape(each.metric)}</b>: {escape(each.why)}</li>" for each in card.left_out)
    return (
        f"<section><h2>Scores</h2>{score_table(card)}<p>The dot is the score and the bar its "
        f"95 % interval. The upright dashed line is <i>real against real</i>: {REAL_AGAINST_REAL}. The square, where "
        "there is one, is <i>pixel statistics</i>: scans each of whose pixels comes from another real scan. Any model "
        "has to beat it. Every chart begins at 0 and has its own scale.</p>"
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
    name = without_folders(names[index], [scans.source]) if index < len(names) else f"scan {index}"
    while len(name) > _NAME and "/" in name:
        name = name.partition("/")[2]
    return name[-_NAME:]


def _matches(samples: EvalSet, searched: EvalSet, limits_m: tuple[float, float]) -> str:
    """Return the samples that are most and least like any reference scan, each beside that scan."""
    found = matches(samples, searched)

    def pairs(some: Sequence[Match]) -> str:
        return "".join(
            '<div class="pair">'
            + _scan(samples, match.generated, limits_m, _name(samples, match.generated))
            + _scan(searched, match.real, limits_m, f"nearest, at {match.distance:.3f}: {_name(searched, match.real)}")
            + "</div>"
            for match in some
        )

    why = (
        "Each sample stands on the left, and the reference scan that is most like it on the right. For "
        f"{len(found):,} of the {len(samples):,} samples the nearest was searched among {len(searched):,} of the "
        f"{len(searched.images):,} reference scans that were read, whether the metrics compare them or not. The "
        "distance of two scans is the mean absolute difference of log2(1 + range in metres) over "
        f"{MATCHED_ROWS} x {MATCHED_COLUMNS} evenly spaced pixels, where no return counts as 0 m. Yellow is near "
        f"({limits_m[0]:.1f} m), violet is far ({limits_m[1]:.0f} m), and light grey marks rays without a return. A "
        "distance near 0 means that the model memorised a scan, or that one scan is in both sets. Scans that were not "
        "searched, such as training scans outside of the reference, may be nearer."
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
        return f"<section><h2>Return rate by ring</h2><p>{escape(sentence[0].upper() + sentence[1:])}.</p></section>"
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
    text = escape(json.dumps(data, indent=2, ensure_ascii=False))
    return (
        f"{departures}<section><h2>Settings</h2><details><summary>Every setting, hash and version</summary>"
        f'<pre tabindex="0">{text}</pre></details><p><span class="swatch" style="background:{NO_RETURN}"></span> '
        "is the colour of rays without a return, in all pictures.</p></section>"
    )
