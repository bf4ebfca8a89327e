"""Colours of all figures, and the writing of figures to files."""

from __future__ import annotations

import io
import os
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from ... import disk
from ...errors import InputError

SUFFIXES = (".pdf", ".png", ".svg")
"""Suffixes of the file formats of figures."""

DPI = 150
"""Resolution of figures, in dots per inch."""

# These colours can be told apart by colour-blind readers [Okabe & Ito 2008].
BLUE = "#0072B2"
ORANGE = "#E69F00"
GREEN = "#009E73"
RED = "#D55E00"
GREY = "0.55"


def checked_figure_path(path: str | os.PathLike | None) -> Path | None:
    """Return the path of a figure; InputError if its suffix is not one of SUFFIXES."""
    if path is None:
        return None
    path = disk.checked_path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"the suffix of path must be one of {', '.join(SUFFIXES)}, but {path.name!r} ends in none of them"
        )
    return path


def save_figure(figure: Figure, path: Path | None) -> Figure:
    """Write a figure to the path, if there is one, and close it; return the figure."""
    if path is not None:
        buffer = io.BytesIO()
        try:
            figure.savefig(buffer, format=path.suffix[1:].lower())
        finally:
            plt.close(figure)
        with disk.file_errors("write", path):
            disk.write_atomically(path, buffer.getbuffer())
    return figure
