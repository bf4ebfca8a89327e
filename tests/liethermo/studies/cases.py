"""A small study that the tests share, and how its store is compared to the bit."""

import hashlib
from pathlib import Path

import numpy as np

import liethermo as lt


def body(p):
    """A relaxing body; its rate may be one that is refused."""
    return lt.models.rigid_body((1.0 + p["ratio"], 1.0, 0.8), p["rate"])


RATES = np.append(np.geomspace(0.1, 2.0, 6), -1.0)
RATIOS = np.linspace(0.1, 0.6, 5)
X0 = [0.1, 1.0, 0.1]


def study(store=None, axes=None, **changes):
    given = {
        "x0": X0,
        "t_span": (0.0, 4.0),
        "step": 0.1,
        "measure": {"tau": "relaxation_time", "final": "final"},
        "chunk": 8,
        "store": store,
    } | changes
    build = given.pop("build", body)
    return lt.Study(build, {"rate": RATES, "ratio": RATIOS} if axes is None else axes, **given)


def content(store) -> dict[str, str]:
    """Every file of a store but its lock, as a digest."""
    files = [path for path in Path(store).rglob("*") if path.is_file() and path.name != ".lock"]
    return {str(path.relative_to(store)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
