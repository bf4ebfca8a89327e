"""A small study shared by the tests, and a digest of all files of its store."""

import hashlib
from pathlib import Path

import numpy as np

import liethermo as lt


def body(p):
    """Return a relaxing body; a negative rate is refused."""
    return lt.models.rigid_body((1.0 + p["ratio"], 1.0, 0.8), p["rate"])


RATES = np.append(np.geomspace(0.1, 2.0, 6), -1.0)
RATIOS = np.linspace(0.1, 0.6, 5)
X0 = [0.1, 1.0, 0.1]


def study(store=None, axes=None, **changes):
    arguments = {
        "x0": X0,
        "t_span": (0.0, 4.0),
        "step": 0.1,
        "measure": {"tau": "relaxation_time", "final": "final"},
        "chunk": 8,
        "store": store,
    } | changes
    build = arguments.pop("build", body)
    return lt.Study(build, {"rate": RATES, "ratio": RATIOS} if axes is None else axes, **arguments)


def content(store) -> dict[str, str]:
    """Return a digest of every file of a store except its lock."""
    files = [path for path in Path(store).rglob("*") if path.is_file() and path.name != ".lock"]
    return {str(path.relative_to(store)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
