"""Compute every figure, and write the tables of the page."""

import sys
import time

from . import PAGE, ROWS, Figure, bfm, find_table, gby, sml, tables  # noqa: F401

figures: dict[str, Figure] = {}
for name, line in ROWS.items():
    start = time.process_time()
    figures[name] = line.figure()
    print(f"{name}: {figures[name]}  ({time.process_time() - start:.1f} s)", file=sys.stderr, flush=True)
text = PAGE.read_text()
for paper, table in tables(figures).items():
    place = find_table(text, paper)
    text = text[: place.start()] + table + text[place.end() :]
PAGE.write_text(text)
