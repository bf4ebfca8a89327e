"""Results from files, whatever they are of."""

from __future__ import annotations

import os

from ..errors import FileError
from .ensemble import Ensemble
from .files import ENSEMBLE_FORMAT, read
from .solution import Solution


def load(path: str | os.PathLike) -> Solution | Ensemble:
    """Read a file written by :meth:`Solution.save` or :meth:`Ensemble.save`.

    Raises
    ------
    FileError
        If the file is missing, cut short, damaged, or not a result of this library.

    Warns
    -----
    UserWarning
        If an earlier version wrote the file, without a checksum: damage may show in nothing.
    """
    series, attributes = read(path)
    try:
        if attributes["format"] == ENSEMBLE_FORMAT:
            return Ensemble.of_file(series, attributes)
        return Solution.of_file(series, attributes)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise FileError(f"{path} lacks a part of a liethermo result: {error}") from error
