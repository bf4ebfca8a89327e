"""Newton's and Euler's equations of bodies with joints as constraints, in maximal coordinates: a reference for trees.

Each body has a position, a rotation matrix, a velocity and an angular velocity in axes fixed in space. The
accelerations and the forces of the constraints solve one linear system. Nothing is shared with the reduced equations of
the library.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp


@dataclass
class Body:
    """A body: mass, centre of mass and inertia in its axes, and the joint to its parent, if it has one."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    parent: int = -1
    slides: bool = False
    place: np.ndarray | None = None
    axis: np.ndarray | None = None
    stiffness: float = 0.0
    damping: float = 0.0


def cross_matrix(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotation(axis, angle):
    K = cross_matrix(axis)
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def initial_state(bodies, angular_velocity, q, rates, is_fixed=False):
    """Return positions of the centres, rotations, velocities and angular velocities.

    The centre of mass is at rest at zero, unless the first body is fixed.
    """
    n = len(bodies)
    R, origin, w, v_origin = [np.eye(3)], [np.zeros(3)], [np.asarray(angular_velocity, float)], [np.zeros(3)]
    for i, body in enumerate(bodies[1:], start=1):
        P, u = body.parent, R[body.parent] @ body.axis
        at = origin[P] + R[P] @ body.place
        v_at = v_origin[P] + np.cross(w[P], at - origin[P])
        if body.slides:
            R.append(R[P])
            w.append(w[P])
            origin.append(at + q[i - 1] * u)
            v_origin.append(v_at + rates[i - 1] * u + q[i - 1] * np.cross(w[P], u))
        else:
            R.append(R[P] @ rotation(body.axis, q[i - 1]))
            w.append(w[P] + rates[i - 1] * u)
            origin.append(at)
            v_origin.append(v_at)
    x = np.array([origin[i] + R[i] @ bodies[i].centre for i in range(n)])
    v = np.array([v_origin[i] + np.cross(w[i], R[i] @ bodies[i].centre) for i in range(n)])
    masses = np.array([body.mass for body in bodies])
    if not is_fixed:
        x, v = x - masses @ x / masses.sum(), v - masses @ v / masses.sum()
    return np.concatenate([x.ravel(), np.array(R).ravel(), v.ravel(), np.array(w).ravel(), q, [0.0]])


def unpack(bodies, z):
    n = len(bodies)
    x, z = z[: 3 * n].reshape(n, 3), z[3 * n :]
    R, z = z[: 9 * n].reshape(n, 3, 3), z[9 * n :]
    v, w, z = z[: 3 * n].reshape(n, 3), z[3 * n : 6 * n].reshape(n, 3), z[6 * n :]
    return x, R, v, w, z[: n - 1]


def rate(bodies, z, t=0.0, loads=None, is_fixed=False):
    """Return the rate of positions, rotations, velocities, angular velocities, joint coordinates and heat.

    ``loads(t, x, R)`` returns forces in the centres and torques on the bodies, in axes in space, shapes (n, 3).
    """
    n = len(bodies)
    x, R, v, w, q = unpack(bodies, z)
    M, f, heat = np.zeros((6 * n, 6 * n)), np.zeros(6 * n), 0.0
    rows, right, rates = [], [], np.zeros(n - 1)
    for i, body in enumerate(bodies):
        J = R[i] @ body.inertia @ R[i].T
        M[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = body.mass * np.eye(3)
        k = 3 * (n + i)
        M[k : k + 3, k : k + 3] = J
        f[k : k + 3] -= np.cross(w[i], J @ w[i])
    if loads is not None:
        f += np.concatenate([np.ravel(load) for load in loads(t, x, R)])
    if is_fixed:
        for k in (0, 3 * n):
            for e in np.eye(3):
                row = np.zeros(6 * n)
                row[k : k + 3] = e
                rows.append(row)
                right.append(0.0)
    for i, body in enumerate(bodies[1:], start=1):
        P, u = body.parent, R[body.parent] @ body.axis
        linear, angular = slice(3 * i, 3 * i + 3), slice(3 * (n + i), 3 * (n + i) + 3)
        linear_P, angular_P = slice(3 * P, 3 * P + 3), slice(3 * (n + P), 3 * (n + P) + 3)
        a, b = -R[i] @ body.centre, R[P] @ (body.place - bodies[P].centre)  # from the centres to the joint
        normals = np.linalg.svd(u[None])[2][1:]
        if body.slides:
            b_now = b + q[i - 1] * u
            v_relative = v[i] + np.cross(w[i], a) - v[P] - np.cross(w[P], b_now)
            rates[i - 1] = s = u @ v_relative
            force = -body.stiffness * q[i - 1] - body.damping * s
            f[linear] += force * u
            f[angular] += np.cross(a, force * u)
            f[linear_P] -= force * u
            f[angular_P] -= np.cross(b_now, force * u)
            for e in np.eye(3):
                row = np.zeros(6 * n)
                row[angular], row[angular_P] = e, -e
                rows.append(row)
                right.append(0.0)
            # centripetal and Coriolis accelerations of the point of the child and the point of the parent
            known = np.cross(w[i], np.cross(w[i], a)) - np.cross(w[P], np.cross(w[P], b_now))
            known = known - 2.0 * s * np.cross(w[P], u)
            for e in normals:
                row = np.zeros(6 * n)
                row[linear], row[linear_P] = e, -e
                row[angular], row[angular_P] = np.cross(a, e), -np.cross(b_now, e)
                rows.append(row)
                right.append(-e @ known)
        else:
            rates[i - 1] = s = u @ (w[i] - w[P])
            torque = (-body.stiffness * q[i - 1] - body.damping * s) * u
            f[angular] += torque
            f[angular_P] -= torque
            known = np.cross(w[i], np.cross(w[i], a)) - np.cross(w[P], np.cross(w[P], b))
            for e in np.eye(3):
                row = np.zeros(6 * n)
                row[linear], row[linear_P] = e, -e
                row[angular], row[angular_P] = np.cross(a, e), -np.cross(b, e)
                rows.append(row)
                right.append(-e @ known)
            for e in normals:
                row = np.zeros(6 * n)
                row[angular], row[angular_P] = e, -e
                rows.append(row)
                right.append(e @ (s * np.cross(w[P], u)))
        heat += body.damping * s**2
    C = np.array(rows).reshape(-1, 6 * n)
    KKT = np.block([[M, -C.T], [C, np.zeros((len(C), len(C)))]])
    acceleration = np.linalg.solve(KKT, np.concatenate([f, right]))[: 6 * n]
    turns = np.array([cross_matrix(w[i]) @ R[i] for i in range(n)])
    return np.concatenate([v.ravel(), turns.ravel(), acceleration, rates, [heat]])


def final_state(bodies, angular_velocity, q, rates, end, loads=None, is_fixed=False):
    """Return the rotation of the base, the joint coordinates and the heat of the dampers at the end."""
    start = initial_state(bodies, angular_velocity, np.asarray(q, float), rates, is_fixed)
    run = solve_ivp(
        lambda t, z: rate(bodies, z, t, loads, is_fixed), (0.0, end), start, "DOP853", rtol=1e-11, atol=1e-12
    )
    z = run.y[:, -1]
    _, R, _, _, q = unpack(bodies, z)
    return R[0], q, z[-1]
