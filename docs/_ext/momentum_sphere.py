"""A Sphinx extension: the directive ``momentum-sphere``, a moving picture of a relaxing body, computed by the build."""

from __future__ import annotations

import html
import json

import numpy as np
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

INERTIA = (3.0, 2.0, 1.0)
ENERGY = 0.5
START = (0.06, 0.1)
"""First two components of the momentum at the start; the third follows from the energy."""


def _motion(system, start, end: float, step: float, digits: int = 4) -> list[list[float]]:
    import liethermo as lt

    solution = lt.integrate(system, start, (0.0, end), step)
    if not solution.audit().passed:
        raise RuntimeError(f"the picture's own run breaks a law:\n{solution.audit()}")
    return np.round(solution.x, digits).tolist()


def scene() -> dict:
    """Free motions on the energy ellipsoid, and one that relaxes."""
    import liethermo as lt

    moments = np.array(INERTIA)
    axes = np.sqrt(2 * ENERGY * moments)
    first, second = START
    third = np.sqrt(2 * ENERGY * moments[2] * (1 - first**2 / axes[0] ** 2 - second**2 / axes[1] ** 2))
    relaxing = _motion(lt.models.rigid_body(INERTIA, rate=0.08), [first, second, third], 60.0, 0.1)
    orbits = []
    for axis, other in ((2, 0), (0, 2)):  # around the axis of least inertia, and around that of greatest
        for angle in np.linspace(0.1, 0.97, 6) * np.pi / 2:
            start = np.zeros(3)
            start[[axis, 1]] = axes[axis] * np.cos(angle), axes[1] * np.sin(angle)
            orbit = _motion(lt.models.free_rigid_body(INERTIA), start, 60.0, 0.2, 3)
            once = 2 + np.nonzero(np.diff(np.sign([point[other] for point in orbit[1:]])))[0][1]
            orbits += [orbit[: once + 1], (-np.array(orbit[: once + 1])).tolist()]
    return {"axes": axes.tolist(), "orbits": orbits, "relaxing": relaxing}


class MomentumSphere(Directive):
    """The picture; the content of the directive says in words what it shows."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        words = html.escape(" ".join(self.content), quote=True)
        data = json.dumps(scene(), separators=(",", ":"))
        markup = (
            f'<canvas class="momentum-sphere" role="img" aria-label="{words}" tabindex="0"></canvas>'
            f'<script type="application/json" class="momentum-sphere-data">{data}</script>'
        )
        return [nodes.raw("", markup, format="html")]


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("momentum-sphere", MomentumSphere)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
