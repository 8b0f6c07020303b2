"""A map against a reference, as a table for a terminal."""

import math

import numpy as np
from rich.table import Table

from jaxsonar.evaluation.map_accuracy import Evaluation, largest, rms


def evaluation_table(evaluation: Evaluation) -> Table:
    """Matched walls, one row a pair, the longest first; largest and RMS deviations; precision and recall below."""
    matched, covered = evaluation.segment_matched.sum(), evaluation.reference_covered.sum()
    table = Table(
        title="Map against reference",
        caption=f"precision: {_shown(evaluation.precision, 3)} of {len(evaluation.segment_length)} segments, "
        f"{_shown(evaluation.precision_length, 3)} of their length "
        f"({matched:.2f} of {evaluation.segment_length.sum():.2f} m)\n"
        f"recall: {_shown(evaluation.recall, 3)} of {len(evaluation.reference_length)} walls, "
        f"{_shown(evaluation.recall_length, 3)} of their length "
        f"({covered:.2f} of {evaluation.reference_length.sum():.2f} m)",
    )
    for column in ("segment\n(index)", "wall\n(index)", "overlap\n(m)", "Δ distance\n(mm)", "Δ angle\n(deg)"):
        table.add_column(column, justify="right")
    for k in np.argsort(-evaluation.overlap, kind="stable"):
        table.add_row(
            str(evaluation.segment[k]),
            str(evaluation.reference[k]),
            f"{evaluation.overlap[k]:.2f}",
            _shown(1e3 * float(evaluation.distance[k]), 1),
            _shown(math.degrees(evaluation.angle[k]), 2),
        )
    table.add_section()
    for name, summary in (("largest", largest), ("RMS", rms)):
        distance, angle = 1e3 * summary(evaluation.distance), math.degrees(summary(evaluation.angle))
        table.add_row(name, "", "", _shown(distance, 1), _shown(angle, 2))
    return table


def _shown(value: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"
