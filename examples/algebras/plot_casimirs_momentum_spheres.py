r"""
What takes the place of the momentum sphere on other algebras?
==============================================================

A free body moves on a sphere :math:`|\mu| = \mathrm{const}`, a level surface of the Casimir of so(3). On every Lie
algebra the motion stays on the common level surfaces of its Casimirs. The figure has these surfaces for four algebras
of dimension three, with motions of the same energy function.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LightSource

import liethermo as lt
import manifolds as mf

energy = lt.Quadratic([1.0, 0.5, 0.2])

# %%
# Each algebra has a Casimir C of the given degree, and the surface C = 1 has parameters a and b from -1 to 1. Bianchi
# VIII is sl(2, R) in a basis whose Casimir is a sum of squares.

a, b = np.meshgrid(np.linspace(-1, 1, 61), np.linspace(-1, 1, 121), indexing="ij")
cos, sin = np.cos(np.pi * b), np.sin(np.pi * b)
surfaces = [
    (
        mf.so(3),
        2,
        np.array(
            [
                np.cos(np.pi / 2 * a) * cos,
                np.cos(np.pi / 2 * a) * sin,
                np.sin(np.pi / 2 * a),
            ]
        ),
    ),
    (
        mf.bianchi("VIII"),
        2,
        np.array([np.cosh(1.2 * a) * cos, np.cosh(1.2 * a) * sin, np.sinh(1.2 * a)]),
    ),
    (mf.se(2), 2, np.array([1.5 * a, cos, sin])),
    (mf.heisenberg(1), 1, np.array([1.2 * b, 1.7 * a, np.ones_like(a)])),
]

# %%
# The library computes the Casimirs, and every motion conserves its Casimir to rounding. The motions are the lines of
# constant energy on the surface. Dark lines have little energy, and lines on the far side are pale.


def draw(ax, g, casimir, surface):
    """Draw the surface and motions that start on the lines a = 0 and b = 1/2."""
    ax.set(
        proj_type="ortho",
        title=f"{g.name}\n${casimir}$ = 1".replace("**", "^").replace("mu", r"\mu_"),
    )
    ax.view_init(elev=25, azim=55)
    ax.computed_zorder = False
    style = {
        "color": "white",
        "linewidth": 0,
        "antialiased": False,
        "lightsource": LightSource(55, 50),
    }
    ax.plot_surface(*surface, rstride=1, cstride=1, **style)
    azimuth, elevation = np.radians([ax.azim, ax.elev])
    eye = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    ]
    system = lt.LiePoissonSystem(g, energy, entropy=casimir)
    for i, j in [
        (30, 64),
        (30, 70),
        (30, 76),
        (30, 82),
        (30, 88),
        (36, 90),
        (41, 90),
        (46, 90),
        (52, 90),
    ]:
        solution = lt.integrate(system, surface[:, i, j], t_span=(0.0, 30.0), step=0.05)
        assert np.ptp(solution.entropy) < 1e-13
        color = plt.get_cmap("viridis")(1.2 * solution.energy[0])
        near = (jax.vmap(jax.grad(casimir))(solution.x) @ np.array(eye) > 0.0)[:, None]
        ax.plot(*np.where(near, solution.x, np.nan).T, color=color)
        ax.plot(*np.where(near, np.nan, solution.x).T, color=color, alpha=0.2)
    ax.set(
        xlabel=r"$\mu_1$",
        ylabel=r"$\mu_2$",
        zlabel=r"$\mu_3$",
        xticks=[],
        yticks=[],
        zticks=[],
    )
    ax.set_aspect("equal")
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.labelpad = -12


figure, axes = plt.subplots(
    2, 2, figsize=(7.5, 7.5), layout="constrained", subplot_kw={"projection": "3d"}
)
for ax, (g, degree, surface) in zip(axes.flat, surfaces, strict=True):
    draw(ax, g, *g.casimirs(degree), surface)
plt.show()
