"""First page of the benchmarks: the pairs of rows that it compares, by theme.

A measurement appears on the page if it has a line in :data:`PAIRS_BY_THEME` or :data:`COST_MEASUREMENTS`; nothing else
has to change.
"""

from __future__ import annotations

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
    ours, theirs : str
        Beginnings of the rows' names. Of several rows of another program the fastest counts, unless ``row_number`` is
        given.
    column : str, optional
        The heading of the times; by default the first that begins with "Time".
    row_number : int, optional
        Index among several rows that begin alike but have different settings.
    """

    measurement: str
    table: int
    work: str
    ours: str
    theirs: str
    column: str = "Time"
    row_number: int | None = None


@dataclass(frozen=True)
class PeerComparison:
    """The measured times and laws of a pair; a verdict on the laws is None if the table has none."""

    work: str
    peer: str
    ours: float
    theirs: float
    our_laws: str | None
    their_laws: str | None

    @property
    def ratio(self) -> float:
        return self.ours / self.theirs


def _ensemble_pairs(table: int, work: str) -> list[RowPair]:
    return [RowPair("ensemble", table, work, COMPILED_ROW, peer) for peer in ("heyoka", "diffrax")]


PAIRS_BY_THEME: dict[str, list[RowPair]] = {
    "The same scheme in C": [
        RowPair("single_body", 0, "midpoint, quadratic H and S", "compiled engine, plain functions", "C"),
        RowPair("single_body", 1, "a call of 1000 midpoint steps, every state kept", COMPILED_ROW, "C"),
        RowPair("general", 0, "midpoint, quartic H and logarithmic S", COMPILED_ROW, "C"),
        *(RowPair("variational", i, f"variational scheme {i + 1}", COMPILED_ROW, "C") for i in range(3)),
        RowPair("spin", 0, "midpoint, a spin on its sphere", COMPILED_ROW, "C"),
        RowPair("spin", 1, "the same in charts", COMPILED_ROW, "C"),
        RowPair("ensemble", 0, "10,000 bodies, 200 midpoint steps", COMPILED_ROW, "C with SIMD"),
    ],
    "One trajectory at equal accuracy": [
        RowPair("work_precision", 0, f"one body to an error of {error}", EXPLICIT_ROW, peer, f"≤ {error}")
        for error in ("1e-05", "1e-09")
        for peer in ("heyoka", "diffrax", "SciPy")
    ],
    "Many trajectories at equal accuracy": [
        *_ensemble_pairs(3, "10,000 bodies to 1e-3"),
        *_ensemble_pairs(4, "10,000 bodies to 1e-5"),
        *_ensemble_pairs(5, "10,000 bodies to 1e-8"),
        *_ensemble_pairs(6, "10,000 bodies to 1e-12"),
        *(
            RowPair("ensemble", 2, "10,000 bodies, Gauss of order 6, to 3e-8", COMPILED_ROW, peer)
            for peer in ("heyoka", "diffrax")
        ),
        RowPair("others", 0, "10,000 states, quartic H, to 7e-14", COMPILED_ROW, "heyoka", row_number=2),
        RowPair("others", 1, "10,000 states of su(3) to 3e-13", COMPILED_ROW, "heyoka", row_number=2),
        RowPair("others", 2, "10,000 spins, each with a bath, to 7e-11", COMPILED_ROW, "heyoka", row_number=2),
    ],
    "Satellites": [
        RowPair(
            "tumbling", table, f"{body}, 1000 s with attitude", "this library, Gauss, order 6", peer, "Time of the run"
        )
        for table, body in enumerate(("a free body", "a body with a damped wheel"))
        for peer in ("SciPy DOP853", "MuJoCo, RK4", "Basilisk, RK4")
    ],
    "Large algebras and lattices": [
        *(
            RowPair(
                "fluids", 0, f"a fluid on the sphere, su({N})", "this library", "isospectral midpoint", row_number=i
            )
            for i, N in enumerate((32, 64, 128, 256, 512))
            if N in (32, 128, 512)
        ),
        RowPair("lattice", 0, "10⁵ coupled spins, two cores", "array engine", "C, 2 threads"),
    ],
    "Manifolds": [RowPair("spin", 2, "a spin with a bath to an error of 1e-8", "Taylor(12)", "heyoka")],
    "Quantum systems": [],
}
"""The pairs of each theme; a theme without measured pairs is omitted from the page."""

COST_MEASUREMENTS = (
    *("first_run", "network", "memory", "scaling", "studies", "manifolds", "functions", "isolated_body", "large"),
    *("magnet", "fluids"),
)
"""Measurements without another program; their targets that are no ratios form a table of their own."""

FULL_REPORT_THEMES = {"Learning": ("learn_gas", "learn_pendulum", "learn_body")}
"""Themes whose measurements are about errors; their tables are shown in full."""

THEME_NOTES = {
    "The same scheme in C": "Two of the variational schemes let the energy drift by their nature, here and in C."
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
    """Return the comparisons of each theme whose two rows were measured."""
    pairs_by_theme = {theme: [_compare_rows(reports[p.measurement], p) for p in pairs if p.measurement in reports]
             for theme, pairs in PAIRS_BY_THEME.items()}  # fmt: skip
    return {
        theme: kept for theme, pairs in pairs_by_theme.items() if (kept := [pair for pair in pairs if pair is not None])
    }


def _compare_rows(report: Report, pair: RowPair) -> PeerComparison | None:
    if pair.table >= len(report.tables):
        return None
    table = report.tables[pair.table]
    column = next(i for i, name in enumerate(table.columns) if name.startswith(pair.column))
    laws = list(table.columns).index("Laws") if "Laws" in table.columns else None
    rows = [_find_row(table, column, start, pair.row_number) for start in (pair.ours, pair.theirs)]
    if None in rows or None in (times := [row[column] for row in rows if row]):
        return None
    verdicts = [None if laws is None else row[laws] for row in rows if row]
    return PeerComparison(pair.work, _row_name(rows[1] or []), *times, *verdicts)


def _find_row(table: Table, column: int, start: str, row_number: int | None) -> list | None:
    """Return the row of this name, or else one whose name begins so: the one at ``row_number``, or the fastest."""
    candidates = [row for row in table.rows if _row_name(row) == start]
    candidates = candidates or [row for row in table.rows if _row_name(row).startswith(start)]
    if row_number is not None:
        return candidates[row_number] if row_number < len(candidates) else None
    return min((row for row in candidates if row[column] is not None), key=lambda row: row[column], default=None)


def _row_name(row: list) -> str:
    return next((cell for cell in row if isinstance(cell, str)), "")


def page_sections(reports: Mapping[str, Report]) -> Iterator[str]:
    """Yield the summary, and a section for each theme."""
    themes = compare_themes(reports)
    yield "\n".join(f"- {sentence}" for sentence in summary_sentences([c for found in themes.values() for c in found]))
    for theme, comparisons in themes.items():
        note = f"\n\n{THEME_NOTES[theme]}" if theme in THEME_NOTES else ""
        yield f"## {theme}{note}" + _comparison_table(comparisons).markdown()
    for theme, names in FULL_REPORT_THEMES.items():
        theme_reports = [reports[name] for name in names if name in reports]
        if theme_reports:
            yield "\n\n".join([f"## {theme}", *(r.markdown().replace("## ", "### ", 1) for r in theme_reports)])
    targets = [t for name in COST_MEASUREMENTS if name in reports for t in reports[name].targets if t.kind != "ratio"]
    if targets:
        table = Table("", {"Work": "text", "Measured": "text"}, [target.row()[::2] for target in targets])
        yield "## Other costs" + table.markdown()


def _comparison_table(comparisons: list[PeerComparison]) -> Table:
    columns = {"Work": "text", "Beside": "text", "Here": "seconds", "There": "seconds", "Here / there": "about"}
    rows = [[c.work, c.peer, c.ours, c.theirs, c.ratio] for c in comparisons]
    if any(c.our_laws for c in comparisons):
        columns |= {"Laws here": "text", "Laws there": "text"}
        rows = [[*row, c.our_laws, c.their_laws] for row, c in zip(rows, comparisons, strict=True)]
    return Table("", columns, rows)


def summary_sentences(comparisons: list[PeerComparison]) -> Iterator[str]:
    """Yield a sentence on wins and losses for each group of peers, and one on the laws."""
    for name, starts in PEER_GROUPS.items():
        ours = sorted((c for c in comparisons if c.peer.startswith(starts)), key=lambda c: c.ratio)
        if ours:
            lowest, highest, n_won = ours[0], ours[-1], sum(c.ratio < 1.0 for c in ours)
            yield (
                f"**{name}**: this library is faster in {n_won} of {len(ours)} tasks. It takes {lowest.ratio:.2g} "
                "times "
                f"the other's time at best ({lowest.work}) and {highest.ratio:.2g} times at worst ({highest.work})."
            )
    with_verdict = [c for c in comparisons if c.our_laws is not None and not c.peer.startswith("C")]
    if with_verdict:
        n_held = sum(c.our_laws == "hold" for c in with_verdict)
        n_peer_held = sum(c.their_laws == "hold" for c in with_verdict)
        yield (
            f"**the laws**: beside programs that do not run the same scheme, the laws hold in {n_held} of "
            f"{len(with_verdict)} "
            f"runs of this library and in {n_peer_held} of theirs."
        )


def missed_targets_text(targets: list[Target]) -> str:
    """Return a clause with the number of targets and of missed ones."""
    count = sum(target.verdict == "missed" for target in targets)
    return f"{count} of {len(targets)} targets are missed"
