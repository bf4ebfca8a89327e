"""Reading of results from files."""

from __future__ import annotations

import os

from ..errors import FileError
from .ensemble import Ensemble
from .netcdf import ENSEMBLE_FORMAT, read_dataset
from .solution import Solution


def load(path: str | os.PathLike) -> Solution | Ensemble:
    """Read a file written by :meth:`Solution.save` or :meth:`Ensemble.save`.

    Parameters
    ----------
    path : str or path
        The NetCDF file.

    Raises
    ------
    FileError
        If the file is missing, cut short, damaged, or not a result of this library.

    Warns
    -----
    UserWarning
        If an earlier version wrote the file, without a checksum: damage may show in nothing.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> solution = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 5.0), 0.1)
    >>> path = solution.save("run.nc")
    >>> bool((lt.load("run.nc").x == solution.x).all())
    True
    """
    series, attributes = read_dataset(path)
    try:
        if attributes["format"] == ENSEMBLE_FORMAT:
            return Ensemble.from_file(series, attributes)
        return Solution.from_file(series, attributes)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise FileError(f"{path} lacks a part of a liethermo result: {error}") from error
