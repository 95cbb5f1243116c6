"""The curves of a result: recall, precision, distance."""

from __future__ import annotations

from services.trainer.evaluation.distance_error import distance_error
from services.trainer.evaluation.report.charts import Axis, Series, line_chart, percent_axis
from services.trainer.evaluation.result import EvaluationResult


def recall_chart(result: EvaluationResult) -> str:
    curve = result.measured.recall_curve
    ticks = [k for k in (1, 5, 10, 20, 50, 100) if k <= len(curve)]
    x = Axis("k: database photos looked at", 1, max(2, len(curve)), ticks)
    points = list(enumerate(curve, start=1))
    series = [Series("of all queries", points)]
    total = result.measured.recalls.queries
    findable = total - result.measured.recalls.without_positive
    if 0 < findable < total:
        raised = [(k, share * total / findable) for k, share in points]
        series.append(Series("of those with a positive", raised))
    return line_chart("Recall at k", x, percent_axis("recall at k"), series)


def precision_chart(result: EvaluationResult) -> str | None:
    curve = result.measured.curve
    if curve is None:
        return None
    points = list(zip(curve.recall.tolist(), curve.precision.tolist(), strict=True))
    shown = points[:: max(1, len(points) // 400)] + points[-1:]
    label = f"area {curve.area:.3f}"
    return line_chart(
        "Precision and recall of the first match",
        percent_axis("recall: answered rightly"),
        percent_axis("precision: right of the answers"),
        [Series(label, shown)],
    )


def distance_chart(result: EvaluationResult) -> str | None:
    metres = result.measured.metres
    found = None if metres is None else distance_error(metres[:, 0])
    if found is None:
        return None
    points = [(entry["metres"], entry["share"]) for entry in found["within"]]
    x = Axis("x in metres", 1, 1000, (1, 5, 25, 100, 1000), log=True)
    label = f"median {found['median_m']:.1f} m"
    return line_chart(
        "How far the first match lies", x, percent_axis("within x metres"), [Series(label, points)]
    )
