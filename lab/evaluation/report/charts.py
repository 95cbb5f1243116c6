"""Charts of reports, drawn with matplotlib: curves of recall, precision and distance, and a map.

Each chart is an `<img>` with an SVG inside, so that a report is one file. Equal charts have equal
bytes. matplotlib is imported when the first chart is drawn: most evaluations write no report.
"""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from lab.datasets.dataset import DatasetPhoto
from lab.evaluation.results import EvaluationResult
from lab.evaluation.retrieval_metrics import distance_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# From the palette of Okabe and Ito, which is distinguishable with any colour vision.
BLUE, RED, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#c4c4c4"


def percent_chart(
    x_label: str, y_label: str, *, x_ticks: Sequence[float] | None = None, log: bool = False
) -> tuple[Figure, Axes]:
    """Create a chart with a y axis from 0 to 100 %.

    `x_ticks` run from the first to the last value of the x axis; None: from 0 to 100 %.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    figure = Figure(figsize=(5, 3.3), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel=x_label, ylabel=y_label, ylim=(-0.02, 1.02))
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    if log:
        axes.set_xscale("log")
    if x_ticks is None:
        axes.set_xlim(-0.02, 1.02)
        axes.xaxis.set_major_formatter(PercentFormatter(1))
    else:
        axes.set_xticks(x_ticks, [f"{tick:g}" for tick in x_ticks])
        axes.minorticks_off()
    axes.grid(color="#e5e5e5")
    return figure, axes


def render_chart(figure: Figure, title: str) -> Markup:
    """Render a chart as an `<img>` element; the title is its alternative text."""
    from matplotlib import rc_context

    svg = io.StringIO()
    with rc_context({"svg.hashsalt": title, "svg.fonttype": "none"}):
        figure.savefig(svg, format="svg", metadata={"Creator": None, "Date": None})
    encoded = base64.b64encode(svg.getvalue().encode()).decode()
    return Markup('<img src="data:image/svg+xml;base64,{}" alt="{}">').format(encoded, title)


def recall_chart(result: EvaluationResult) -> Markup:
    """Render recall@k over k."""
    curve = np.asarray(result.measured.recall_curve)
    ks = np.arange(1, len(curve) + 1)
    figure, axes = percent_chart(
        "k: number of retrieved photos",
        "recall@k",
        x_ticks=[k for k in (1, 5, 10, 20, 50, 100) if k <= len(curve)],
    )
    axes.plot(ks, curve, ".-", color=BLUE, label="all queries")
    total = result.measured.recalls.queries
    findable = total - result.measured.recalls.without_positive
    if 0 < findable < total:
        axes.plot(ks, curve * total / findable, ".-", color=RED, label="queries with a positive")
    axes.legend()
    return render_chart(figure, "Recall@k")


def precision_chart(result: EvaluationResult) -> Markup | None:
    """Render the precision-recall curve; None without scores."""
    curve = result.measured.curve
    if curve is None:
        return None
    figure, axes = percent_chart("recall", "precision")
    axes.plot(curve.recall, curve.precision, color=BLUE, label=f"area {curve.area:.3f}")
    axes.legend()
    return render_chart(figure, "Precision and recall of the first match")


def reliability_chart(levels: Sequence[dict[str, Any]]) -> Markup:
    """Render the observed share of right answers over the stated probability, a line a level.

    `levels` are the figures of each level (`reliability_figures`), finest first.
    """
    figure, axes = percent_chart("stated probability", "observed share")
    axes.plot([0, 1], [0, 1], "--", color=GREY)
    for level in levels:
        bins = level["reliability"]
        stated = [each["stated"] for each in bins]
        observed = [each["observed"]["mean"] for each in bins]
        (line,) = axes.plot(stated, observed, ".-", label=f"level {level['level']}")
        for x, each in zip(stated, bins, strict=True):
            if (interval := each["observed"]["interval"]) is not None:
                axes.vlines(x, *interval, color=line.get_color(), alpha=0.4)
    axes.legend()
    return render_chart(figure, "Reliability of the probabilities of levels")


def distance_chart(result: EvaluationResult) -> Markup | None:
    """Render the cumulative distance error of first matches; None without positions."""
    metres = result.measured.metres
    error = None if metres is None else distance_error(metres[:, 0])
    if error is None:
        return None
    figure, axes = percent_chart(
        "x in metres", "queries within x metres", x_ticks=(1, 5, 25, 100, 1000), log=True
    )
    axes.plot(
        [entry["metres"] for entry in error["within"]],
        [entry["share"] for entry in error["within"]],
        ".-",
        color=BLUE,
        label=f"median {error['median_m']:.1f} m",
    )
    axes.legend()
    return render_chart(figure, "Distance of the first match")


MAX_DATABASE_POINTS = 4000
MAX_QUERY_POINTS = 2000


def positions_chart(result: EvaluationResult) -> tuple[Markup, str] | None:
    """Render a map of queries and first matches, and its caption; None without positions."""
    zone = _most_common_zone(result.evaluation_set.queries)
    database = _utm_positions(result.evaluation_set.database, zone)
    queries = _utm_positions(result.evaluation_set.queries, zone)
    located = np.flatnonzero(~np.isnan(queries[:, 0]))
    if not len(located) or np.isnan(database).all():
        return None
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    origin = np.nanmin(np.concatenate([database, queries]), axis=0)
    database, queries = database - origin, queries - origin
    located = located[:: -(-len(located) // MAX_QUERY_POINTS)]
    starts, ends = queries[located], database[result.ranked.indices[located, 0]]
    colours = np.where(result.measured.hits[located, 0], GREEN, RED)
    has_match = ~np.isnan(ends[:, 0])
    segments = np.stack([starts, ends], axis=1)[has_match]

    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="metres east", ylabel="metres north")
    shown = database[~np.isnan(database[:, 0])]
    shown = shown[:: -(-len(shown) // MAX_DATABASE_POINTS)]
    axes.scatter(shown[:, 0], shown[:, 1], s=4, color=GREY)
    axes.add_collection(LineCollection(list(segments), colors=colours[has_match], linewidths=0.8))
    axes.scatter(starts[:, 0], starts[:, 1], s=12, c=colours, zorder=3)
    caption = f"{len(located)} of {len(queries)} queries, UTM zone {zone or 'unknown'}"
    return render_chart(figure, "Map of queries and their first matches"), caption


def _most_common_zone(photos: tuple[DatasetPhoto, ...]) -> str | None:
    zones = Counter(photo.zone for photo in photos if photo.easting is not None)
    return zones.most_common(1)[0][0] if zones else None


def _utm_positions(photos: Sequence[DatasetPhoto], zone: str | None) -> NDArray[np.float64]:
    """Return eastings and northings in metres, (photos, 2); NaN outside the zone or unknown."""
    positions = np.full((len(photos), 2), np.nan)
    for index, photo in enumerate(photos):
        if photo.easting is not None and photo.northing is not None and photo.zone == zone:
            positions[index] = photo.easting, photo.northing
    return positions
