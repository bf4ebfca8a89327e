"""What all pictures share: colours, and how a figure becomes a file."""

from __future__ import annotations

import io
import os
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from ... import disk
from ...errors import FileError, InputError

SUFFIXES = (".pdf", ".png", ".svg")
DPI = 150

# Colours that colour-blind readers tell apart [Okabe & Ito 2008].
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "0.55"


def checked_figure_path(path: str | os.PathLike | None) -> Path | None:
    """The path of a figure, whose suffix is one of those that can be written."""
    if path is not None and Path(path).suffix.lower() not in SUFFIXES:
        raise InputError(f"a figure is written as {', '.join(SUFFIXES)}, and {Path(path).name!r} ends in none of them")
    return None if path is None else Path(path)


def save_figure(figure: Figure, path: Path | None) -> Figure:
    """The figure, written to the path and closed if there is one."""
    if path is not None:
        drawn = io.BytesIO()
        try:
            figure.savefig(drawn, format=path.suffix[1:].lower())
        finally:
            plt.close(figure)
        try:
            disk.write_atomically(path, drawn.getbuffer())
        except (OSError, ValueError) as error:  # the latter for what is no path
            raise FileError(f"cannot write {path}: {disk.describe_os_error(error)}") from error
    return figure
