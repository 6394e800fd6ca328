"""An evaluation as one page that needs nothing else: scorecard and the two sets → HTML."""

import json
from collections.abc import Mapping
from dataclasses import fields, replace
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
from lidargrit.evaluation.scorecard import EvalSetRecord, LeftOut, Scorecard
from lidargrit.viewer._page import asset, document, part
from lidargrit.viewer.report_charts import REAL_AGAINST_REAL, line_chart, score_table
from lidargrit.viewer.report_pictures import NO_RETURN, density_picture, difference_picture, range_picture, rate_picture

_MATCHES = 3  # best, and as many worst
_SHEET = 12  # samples on the sheet
Figure = tuple[str, str, str]  # picture, caption, and words for those who do not see it
_NAME = 48  # longest name, in letters: what fits below half of the page


def write_report(card: Scorecard, pair: EvalPair, path: Path) -> None:
    """Write a page with scores, pictures and settings; it needs no network, no script and no other file."""
    write_text(path, page(card, pair))


def page(card: Scorecard, pair: EvalPair) -> str:
    """Return the page as text; foreign text is escaped, and absolute paths lose their folders."""
    card, without_raydrop = _for_others(card, pair.without_raydrop())
    limits_m, searched = _limits_m(pair), searched_scans(pair.reference)
    both = {"samples": profile(pair.samples), "reference": profile(pair.reference)}
    found = matches(pair.samples, searched)
    extremes = (*found[:_MATCHES], *found[_MATCHES:][-_MATCHES:])
    pairs = [_pair(match, pair.samples, searched, limits_m) for match in extremes]
    rates = {name: of.return_rate.mean(axis=1) for name, of in both.items()}
    count = len(rates["samples"])
    content = part(
        "report.html",
        card=card,
        sets=[_set(name, scans) for name, scans in (("samples", card.samples), ("reference", card.reference))],
        scores=score_table(card),
        real_against_real=REAL_AGAINST_REAL,
        searched=f"{len(found):,} of the {len(pair.samples):,} samples the nearest was searched among "
        f"{len(searched):,} of the {len(searched.images):,} reference scans that were read",
        matched=f"{MATCHED_ROWS} x {MATCHED_COLUMNS}",
        limits_m=limits_m,
        best=pairs[:_MATCHES],
        worst=pairs[_MATCHES:][::-1],
        means=_means(both, limits_m),
        without_raydrop=without_raydrop,
        rings=line_chart(rates, "ring, 0 = the highest", "return rate", range(0, count, max(1, count // 8))),
        rates=[(ring, *(f"{rate[ring]:.3f}" for rate in rates.values())) for ring in range(count)],
        half_view_m=HALF_VIEW_M,
        views=_views(both),
        sheet=[_scan(pair.samples, index, limits_m) for index in evenly_spaced(_SHEET, len(pair.samples))],
        settings=_settings(card),
        no_return=NO_RETURN,
    )
    return document(
        f"{card.samples.source} against {card.reference.source}", asset("report.css"), content, images="data:"
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


def _set(name: str, scans: EvalSetRecord) -> tuple[str, ...]:
    kind = " ".join(filter(None, (scans.data_set or "not known", scans.split)))
    compared = f"{scans.scans_used:,} of {scans.scans:,}"
    return name, scans.source, kind, compared, scans.sensor, scans.projection


def _limits_m(pair: EvalPair) -> tuple[float, float]:
    """Return the two ends of a scale of range, in metres, that holds nearly all returns of both sets."""
    some = [scans.batch(evenly_spaced(16, len(scans))) for scans in (pair.samples, pair.reference)]
    ranges = np.concatenate([images.range_m[images.return_mask].numpy() for images in some] + [np.array([1.0, 80.0])])
    near, far = (float(edge) for edge in np.quantile(ranges, (0.005, 0.999)))
    return near, max(far, near * 2)


def _scan(scans: EvalSet, index: int, limits_m: tuple[float, float], before: str = "") -> Figure:
    """Return the picture of a scan with its caption, and words for those who do not see it."""
    image = scans.batch([index])[0]
    share = float(image.return_mask.float().mean())
    caption = f"{before}{_name(scans, index)}, {share:.0%} of rays returned"
    picture = range_picture(image.range_m.numpy(), image.return_mask.numpy(), limits_m)
    return picture, caption, f"range image of {caption}"


def _name(scans: EvalSet, index: int) -> str:
    """Return the end of a scan's path as its name: the folders before it are the user's, and alike for all scans."""
    names = scans.images.provenance.names
    index = scans.indices[index]
    name = without_folders(names[index], [scans.source]) if index < len(names) else f"scan {index}"
    while len(name) > _NAME and "/" in name:
        name = name.partition("/")[2]
    return name[-_NAME:]


def _pair(match: Match, samples: EvalSet, searched: EvalSet, limits_m: tuple[float, float]) -> list[Figure]:
    nearest = f"nearest, at {match.distance:.3f}: "
    return [_scan(samples, match.generated, limits_m), _scan(searched, match.real, limits_m, nearest)]


def _means(both: Mapping[str, Profile], limits_m: tuple[float, float]) -> list[Figure]:
    figures = []
    for name, scans in both.items():
        finite = ~np.isnan(scans.mean_range_m)
        picture = range_picture(np.where(finite, scans.mean_range_m, 1.0), finite, limits_m)
        figures.append((picture, f"mean range of the {name}", f"mean range image of the {name}"))
    for name, scans in both.items():
        caption = f"return rate of the {name}: dark blue never, yellow always"
        figures.append((rate_picture(scans.return_rate), caption, f"image of the {caption}"))
    return figures


def _views(both: Mapping[str, Profile]) -> list[Figure]:
    """Return the densities of both sets seen from above, on one scale, and their difference."""
    highest = max(float(scans.density.max()) for scans in both.values())
    figures = [
        (density_picture(scans.density, highest), f"the {name}", f"density of points of the {name}, seen from above")
        for name, scans in both.items()
    ]
    difference = both["samples"].density - both["reference"].density
    caption = "samples minus reference: red where the samples have more points, blue where the reference has"
    return [*figures, (difference_picture(difference), caption, "")]


def _settings(card: Scorecard) -> str:
    """Return everything that is needed to repeat the evaluation, without the curves."""
    data = card.to_json()
    for score in data["scores"]:
        score.pop("details")
    return json.dumps(data, indent=2, ensure_ascii=False)
