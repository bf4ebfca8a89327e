"""
Where does Morrison's rigid body settle?
========================================

A torque that does no work acts on a rigid body (Morrison 1986). Its energy is constant, its entropy
:math:`S = |\\mu|^2/2` grows, and it ends in a spin about its axis of greatest inertia. This is the run of Figure 1 of
Bloch, Farré Puiggalí and Martín de Diego (2024).
"""

import liethermo as lt

inertia = (10.0, 5.0, 1.0)
body = lt.models.rigid_body(inertia)
solution = lt.integrate(body, [0.001, 1.0, 0.001], t_span=(0.0, 60.0), step=0.1)

# %%
# The scheme obeys both laws at every step, and the audit says so.

print(solution.audit())

# %%
# At a given energy H the entropy is largest on the axis of greatest inertia, where it is ``max(inertia) * H``.

print(
    f"entropy reached: {solution.entropy[-1]:.6f}, largest possible:"
    f" {max(inertia) * solution.energy[0]:.6f}"
)

# %%
# The body starts next to its middle axis, where the curves of constant entropy cross. It leaves along one of them. From
# then on it crosses them towards larger spheres and stays on the energy surface.

lt.plot.momentum_sphere(solution, body)
