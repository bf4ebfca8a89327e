"""A Sphinx extension: moving pictures that a reader can turn, computed by the build.

``momentum-sphere`` is a body with friction inside on its momentum sphere, ``sphere-field`` a decaying flow on the
sphere, ``tumbling-rod`` a satellite like Explorer 1. The content of each directive says in words what it shows.
"""

from __future__ import annotations

import html
import json
from collections.abc import Callable

import numpy as np
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

INERTIA = (3.0, 2.0, 1.0)
START = (0.06, 0.1)
"""First two components of the momentum at the start, of length one."""


def _motion(system, start, end: float, step: float, digits: int = 4) -> list[list[float]]:
    import liethermo as lt

    solution = lt.integrate(system, start, (0.0, end), step)
    if not solution.audit().passed:
        raise RuntimeError(f"the picture's own run breaks a law:\n{solution.audit()}")
    return np.round(solution.x, digits).tolist()


def relaxing_body() -> dict:
    """Free motions on the momentum sphere, and one that friction inside takes from the one axis to the other."""
    import liethermo as lt

    third = np.sqrt(1.0 - START[0] ** 2 - START[1] ** 2)
    body = lt.models.tumbling_body(INERTIA, rate=0.08, attitude=False)
    relaxing = [point[:3] for point in _motion(body, [*START, third], 150.0, 0.1)]
    orbits = []
    for axis, other in ((2, 0), (0, 2)):  # around the axis of least inertia, and around that of greatest
        for angle in np.linspace(0.1, 0.97, 6) * np.pi / 2:
            start = np.zeros(3)
            start[[axis, 1]] = np.cos(angle), np.sin(angle)
            orbit = _motion(lt.models.free_rigid_body(INERTIA), start, 60.0, 0.2, 3)
            once = 2 + np.nonzero(np.diff(np.sign([point[other] for point in orbit[1:]])))[0][1]
            orbits += [orbit[: once + 1], (-np.array(orbit[: once + 1])).tolist()]
    return {"axes": [1.0, 1.0, 1.0], "orbits": orbits, "relaxing": relaxing}


FLUID, GRID, FRAMES, END = 20, (32, 64), 25, 60.0
"""The flow of the gallery's example: its N, the grid that is drawn, the number of pictures and when it ends."""


def decaying_flow() -> dict:
    """The vorticity of a flow on the sphere whose enstrophy falls, on a grid, at equal times."""
    import liethermo as lt

    sphere = lt.models.QuantisedSphere(FLUID)
    flow = lt.models.zeitlin(FLUID, decay="enstrophy", rate=0.3)
    start = sphere.random(seed=3, degrees=(2, 8), enstrophy=40.0)
    every = round(END / 0.04 / (FRAMES - 1))
    method = lt.MetriplecticRungeKutta(4)
    solution = lt.integrate(flow, start, (0.0, END), 0.04, method, save_every=every, engine="array")
    if not solution.audit().passed:
        raise RuntimeError(f"the picture's own run breaks a law:\n{solution.audit()}")
    frames = np.stack([sphere.on_grid(mu, GRID) for mu in solution.x])
    return {
        "rows": GRID[0],
        "columns": GRID[1],
        "largest": float(np.round(np.abs(frames[0]).max(), 2)),
        "times": np.round(solution.t, 2).tolist(),
        "frames": np.round(frames, 2).reshape(len(frames), -1).tolist(),
    }


ROD, TILT, REST = (1.0, 1.0, 0.15), 3.0, 54.0
"""Moments of inertia of the rod, the angle that it begins off its length in degrees, and when the picture ends."""


def falling_rod() -> dict:
    """A rod that friction brings from the spin about its length to the one across, seen in space and in its own axes.

    Attitudes are nine numbers a frame, those of a rotation that takes the rod to space, where the momentum is upright.
    """
    from scipy.spatial.transform import Rotation

    import liethermo as lt

    angle = np.radians(TILT)
    start = [np.sin(angle), 0.0, np.cos(angle)]
    upright = Rotation.from_rotvec([0.0, -angle, 0.0]).as_matrix()
    rod = lt.models.tumbling_body(ROD, rate=1.0 / (6.0 * (1.0 / ROD[2] - 1.0)), capacity=100.0)
    fall = lt.integrate(rod, start, (0.0, REST), 0.02, save_every=4, attitude=upright)
    if not fall.audit().passed:
        raise RuntimeError(f"the picture's own run breaks a law:\n{fall.audit()}")
    attitudes = np.round(np.asarray(fall.attitude).reshape(-1, 9), 3)
    return {"attitudes": attitudes.tolist(), "momenta": np.round(fall.x[:, :3], 3).tolist()}


class _Moving(Directive):
    """A canvas, and the scene that its script draws."""

    has_content = True
    scene: Callable[[], dict]

    def run(self) -> list[nodes.Node]:
        words = html.escape(" ".join(self.content), quote=True)
        data = json.dumps(type(self).scene(), separators=(",", ":"))
        markup = (
            f'<canvas class="{self.name}" role="img" aria-label="{words}" tabindex="0"></canvas>'
            f'<script type="application/json" class="{self.name}-data">{data}</script>'
        )
        return [nodes.raw("", markup, format="html")]


class MomentumSphere(_Moving):
    scene = staticmethod(relaxing_body)


class SphereField(_Moving):
    scene = staticmethod(decaying_flow)


class TumblingRod(_Moving):
    scene = staticmethod(falling_rod)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("momentum-sphere", MomentumSphere)
    app.add_directive("sphere-field", SphereField)
    app.add_directive("tumbling-rod", TumblingRod)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
