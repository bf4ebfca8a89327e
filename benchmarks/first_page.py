"""First page of the benchmarks: the pairs of rows that it compares, by theme.

A measurement appears on the page if it has a line in :data:`PAIRS_BY_THEME` or :data:`COST_MEASUREMENTS`; nothing else
has to change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from .report import Report, Table, Target

COMPILED_ROW = "compiled engine"
"""Row of the compiled engine."""
EXPLICIT_ROW = "explicit, order 8, compiled engine"
"""Row of the explicit method in :mod:`.measurements.work_precision`."""
GAUSS_ROW = "this library, Gauss, order 6"
"""Row of the Gauss method in :mod:`.measurements.tumbling`."""


@dataclass(frozen=True)
class RowPair:
    """Two rows of one table of a measurement, one of this library and one of another program.

    Attributes
    ----------
    measurement, table : str, int
        The name of the measurement, and the index of its table.
    work : str
        Description of the task.
    unit : str
        What a time is the time of, such as ``"a step"``.
    ours, theirs : str
        Beginnings of the rows' names. Of several rows of another program the fastest counts, unless ``row_number`` is
        given.
    time_column, error_column, drift_column : str
        Beginnings of the headings of the times, of the errors and of the drifts of a conserved quantity. A table
        without such errors or drifts has none on the page.
    row_number : int, optional
        Index among several rows that begin alike but have different settings.
    max_error : float, optional
        Rows with larger errors do not count.
    """

    measurement: str
    table: int
    work: str
    unit: str
    ours: str
    theirs: str
    time_column: str = "Time"
    error_column: str = "Error"
    drift_column: str = "Energy drift"
    row_number: int | None = None
    max_error: float | None = None


@dataclass(frozen=True)
class RowFigures:
    """The measured figures of a row: the time, infinite if there is none, the error and the drift, None if absent."""

    seconds: float
    error: float | None
    drift: float | None


@dataclass(frozen=True)
class PeerComparison:
    """The figures of this library and of another program for the same work."""

    work: str
    unit: str
    peer: str
    ours: RowFigures
    theirs: RowFigures

    @property
    def ratio(self) -> float:
        """Time of this library over the time of the other program."""
        return self.ours.seconds / self.theirs.seconds


def _row_pairs_of_ensembles(table: int, work: str) -> list[RowPair]:
    return [RowPair("ensemble", table, work, "a body to t = 10", COMPILED_ROW, peer) for peer in ("heyoka", "diffrax")]


PAIRS_BY_THEME: dict[str, list[RowPair]] = {
    "The same scheme in C": [
        RowPair("single_body", 0, "midpoint, quadratic H and S", "a step", "compiled engine, plain functions", "C"),
        RowPair("single_body", 1, "midpoint, calls of 1000 steps", "a step", COMPILED_ROW, "C"),
        RowPair("general", 0, "midpoint, quartic H and logarithmic S", "a step", COMPILED_ROW, "C"),
        *(RowPair("variational", i, f"variational scheme {i + 1}", "a step", COMPILED_ROW, "C") for i in range(3)),
        RowPair("spin", 0, "midpoint, a spin on its sphere", "a step", COMPILED_ROW, "C"),
        RowPair("spin", 1, "midpoint, a spin in charts of its sphere", "a step", COMPILED_ROW, "C"),
        RowPair("ensemble", 0, "midpoint, 10,000 bodies", "a body of 200 steps", COMPILED_ROW, "C with SIMD"),
    ],
    "One trajectory at equal accuracy": [
        RowPair(
            *("work_precision", 1, f"one body to an error of {error}", "a run to t = 100", EXPLICIT_ROW, peer),
            max_error=float(error),
        )
        for error in ("1e-5", "1e-9")
        for peer in ("heyoka", "diffrax", "SciPy")
    ],
    "Many trajectories at equal accuracy": [
        *_row_pairs_of_ensembles(3, "10,000 bodies to 1e-3"),
        *_row_pairs_of_ensembles(4, "10,000 bodies to 1e-5"),
        *_row_pairs_of_ensembles(5, "10,000 bodies to 1e-8"),
        *_row_pairs_of_ensembles(6, "10,000 bodies to 1e-12"),
        *_row_pairs_of_ensembles(2, "10,000 bodies, Gauss of order 6, to 3e-8"),
        *(
            RowPair("others", table, work, "a state to t = 10", COMPILED_ROW, "heyoka", row_number=2)
            for table, work in enumerate(
                (
                    "10,000 states, quartic H, to 7e-14",
                    "10,000 states of su(3) to 3e-13",
                    "10,000 spins, each with a bath, to 7e-11",
                )
            )
        ),
    ],
    "Satellites": [
        RowPair(
            *("tumbling", table, body, "a run of 1000 s", GAUSS_ROW, peer, "Time of the run"),
            error_column="Momentum in the body",
            drift_column="Size of L",
        )
        for table, body in enumerate(("a free body", "a body with a damped wheel"))
        for peer in ("SciPy DOP853", "MuJoCo, RK4", "Basilisk, RK4")
    ],
    "Large algebras and lattices": [
        *(
            RowPair(
                *("fluids", 0, f"a fluid on the sphere, su({N})", "a step", "this library", "isospectral midpoint"),
                drift_column="Energy",
                row_number=i,
            )
            for i, N in enumerate((32, 64, 128, 256, 512))
            if N in (32, 128, 512)
        ),
        RowPair("lattice", 0, "10⁵ coupled spins, two cores", "a step", "array engine", "C, 2 threads"),
    ],
    "Manifolds": [
        RowPair("spin", 2, "a spin with a bath to an error of 1e-8", "a run to t = 500", "Taylor(12)", "heyoka")
    ],
    "Quantum systems": [],
}
"""The pairs of each theme; a theme without measured pairs is omitted from the page."""

COST_MEASUREMENTS = (
    *("first_run", "network", "memory", "scaling", "studies", "manifolds", "functions", "isolated_body", "large"),
    *("magnet", "fluids"),
)
"""Measurements without another program; their targets that are no ratios form a table of their own."""

LEARNING_MEASUREMENTS = ("learn_gas", "learn_pendulum", "learn_body")
"""Measurements of learned systems, whose tables a page of their own shows in full."""

THEME_NOTES = {
    "The same scheme in C": "By construction, variational schemes 1 and 3 conserve the energy only approximately, "
    "in the C programs as in this library. Calls of 1000 steps keep every state.",
    "One trajectory at equal accuracy": "The error is relative, at t = 100. The other programs are prepared once; a "
    "run of this library is a call of `integrate`, which prepares it anew.",
    "Many trajectories at equal accuracy": "The error is the largest of 32 states at t = 10. The drifts of the other "
    "programs compare the first and the last state.",
    "Satellites": "Every run computes the attitude too. Error: the angular momentum in the body, relative to DOP853 "
    "at a tolerance of 1e-13. Drift: the length of the angular momentum, which no torque changes.",
    "Large algebras and lattices": "The isospectral midpoint scheme conserves all Casimirs and has no dissipation; "
    "the fluids of this library decay selectively.",
}
"""Notes that precede the table of a theme."""

PEER_GROUPS = {
    "C by hand, the same scheme": ("C",),
    "heyoka": ("heyoka",),
    "diffrax and SciPy": ("diffrax", "SciPy"),
    "MuJoCo and Basilisk": ("MuJoCo", "Basilisk"),
}
"""Groups of peers, each the subject of one sentence, with the beginnings of their row names."""


def compare_themes(reports: Mapping[str, Report]) -> dict[str, list[PeerComparison]]:
    """Return the comparisons by theme, for the pairs of rows that were both measured."""
    pairs_by_theme = {theme: [_compare_rows(reports[p.measurement], p) for p in pairs if p.measurement in reports]
             for theme, pairs in PAIRS_BY_THEME.items()}  # fmt: skip
    return {
        theme: measured_pairs
        for theme, pairs in pairs_by_theme.items()
        if (measured_pairs := [pair for pair in pairs if pair is not None])
    }


def _compare_rows(report: Report, pair: RowPair) -> PeerComparison | None:
    if pair.table >= len(report.tables):
        return None
    table = report.tables[pair.table]
    our_row, their_row = _find_row(table, pair.ours, pair), _find_row(table, pair.theirs, pair)
    if our_row is None or their_row is None:
        return None
    ours, theirs = _row_figures(table, our_row, pair), _row_figures(table, their_row, pair)
    return PeerComparison(pair.work, pair.unit, _row_name(their_row), ours, theirs)


def _column_index(table: Table, start: str) -> int | None:
    """Return the index of the first column whose heading begins with a text."""
    return next((i for i, name in enumerate(table.columns) if name.startswith(start)), None)


def _row_figures(table: Table, row: list, pair: RowPair) -> RowFigures:
    columns = (_column_index(table, start) for start in (pair.time_column, pair.error_column, pair.drift_column))
    seconds, error, drift = (None if column is None else row[column] for column in columns)
    return RowFigures(math.inf if seconds is None else seconds, error, drift)


def _find_row(table: Table, start: str, pair: RowPair) -> list | None:
    """Return the row with a name, or of those whose name begins with it the one at ``row_number`` or the fastest.

    Rows without a time, or with an error above ``max_error``, do not count.
    """
    figures = [(row, _row_figures(table, row, pair)) for row in table.rows]
    valid_rows = [
        (row, f.seconds)
        for row, f in figures
        if f.seconds < math.inf and (pair.max_error is None or (f.error is not None and f.error <= pair.max_error))
    ]
    candidates = [candidate for candidate in valid_rows if _row_name(candidate[0]) == start]
    candidates = candidates or [candidate for candidate in valid_rows if _row_name(candidate[0]).startswith(start)]
    if pair.row_number is not None:
        return candidates[pair.row_number][0] if pair.row_number < len(candidates) else None
    return min(candidates, key=lambda candidate: candidate[1], default=(None, None))[0]


def _row_name(row: list) -> str:
    return next((cell for cell in row if isinstance(cell, str)), "")


def page_sections(reports: Mapping[str, Report]) -> Iterator[str]:
    """Yield the sections of the first page: the summary, and one for each theme."""
    themes = compare_themes(reports)
    yield "\n".join(
        f"- {sentence}"
        for sentence in summary_sentences([c for theme_comparisons in themes.values() for c in theme_comparisons])
    )
    for theme, comparisons in themes.items():
        note = f"\n\n{THEME_NOTES[theme]}" if theme in THEME_NOTES else ""
        yield f"## {theme}{note}" + _comparison_table(comparisons).markdown()
    targets = [t for name in COST_MEASUREMENTS if name in reports for t in reports[name].targets if t.kind != "ratio"]
    if targets:
        table = Table("", {"Work": "text", "Measured": "text"}, [target.row()[::2] for target in targets])
        yield "## Other costs" + table.markdown()


def learning_sections(reports: Mapping[str, Report]) -> Iterator[str]:
    """Yield the full report of each measurement of learned systems."""
    for name in LEARNING_MEASUREMENTS:
        if name in reports:
            yield reports[name].markdown()


def _comparison_table(comparisons: list[PeerComparison]) -> Table:
    columns = {"Work": "text", "Compared with": "text", "Time of": "text", "liethermo": "seconds", "Other": "seconds"}
    rows = [[c.work, c.peer, c.unit, c.ours.seconds, c.theirs.seconds, c.ratio] for c in comparisons]
    columns |= {"Ratio": "about"}
    for quantity in ("error", "drift"):
        figures = [(getattr(c.ours, quantity), getattr(c.theirs, quantity)) for c in comparisons]
        if all(None not in figure for figure in figures):
            columns |= {quantity.capitalize(): "error", f"Other's {quantity}": "error"}
            rows = [[*row, *figure] for row, figure in zip(rows, figures, strict=True)]
    return Table("", columns, rows)


def summary_sentences(comparisons: list[PeerComparison]) -> Iterator[str]:
    """Yield a sentence on wins and losses for each group of peers, and one on the drift of the energy."""
    for name, starts in PEER_GROUPS.items():
        group = sorted((c for c in comparisons if c.peer.startswith(starts)), key=lambda c: c.ratio)
        if group:
            lowest, highest, n_won = group[0], group[-1], sum(c.ratio < 1.0 for c in group)
            yield (
                f"**{name}**: this library is faster in {n_won} of {len(group)} tasks. It takes {lowest.ratio:.2g} "
                f"times the other's time at best ({lowest.work}) and {highest.ratio:.2g} times at worst "
                f"({highest.work})."
            )
    drifts = [
        (c.ours.drift, c.theirs.drift)
        for c in comparisons
        if c.ours.drift is not None and c.theirs.drift is not None and not c.peer.startswith("C")
    ]
    if drifts:
        ours_drifts, peer_drifts = zip(*drifts, strict=True)
        yield (
            f"**conservation**: compared with programs that run another scheme, the relative drift of the conserved "
            f"quantity is at most {max(ours_drifts):.1e} with this library, and {min(peer_drifts):.1e} to "
            f"{max(peer_drifts):.1e} with the others ({len(drifts)} tasks)."
        )


def missed_targets_text(targets: list[Target]) -> str:
    """Return a clause with the number of targets and of missed ones."""
    count = sum(target.verdict == "missed" for target in targets)
    return f"{count} of {len(targets)} targets are missed"
