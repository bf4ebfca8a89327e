"""``AttitudeLayout``: the components of a state that hold an attitude, an element of a group, and an impulse."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

import manifolds as mf


@dataclass(frozen=True)
class AttitudeLayout:
    """The place of the attitude in a state.

    The entries of a group element g follow the state of the body row by row, and imaginary parts follow for complex
    groups. The impulse of a torque comes last.

    Attributes
    ----------
    group : manifolds.MatrixGroup
    body_dim : int
        Number of components of the state of the body.
    impulse_dim : int
        Number of components of the impulse; 0 without one.
    """

    group: mf.MatrixGroup
    body_dim: int
    impulse_dim: int

    @property
    def n_real_parts(self) -> int:
        """Number of real numbers in an entry of g: 2 for complex groups, otherwise 1."""
        return 2 if self.group.is_complex else 1

    @property
    def impulse_start(self) -> int:
        """Index of the first component of the impulse."""
        return self.body_dim + self.n_real_parts * self.group.matrix_size**2

    def split(self, x) -> tuple[jax.Array, jax.Array]:
        """Return the state of the body, shape (..., n), and the group element, shape (..., m, m), of a state."""
        n, m = self.body_dim, self.group.matrix_size
        entries = x[..., n : self.impulse_start].reshape(*x.shape[:-1], self.n_real_parts, m, m)
        g = entries[..., 0, :, :]
        return x[..., :n], g if self.n_real_parts == 1 else g + 1j * entries[..., 1, :, :]

    def impulse(self, x) -> jax.Array:
        """Return the initial spatial momentum plus the impulse of the torque, shape (..., algebra.dim); or (..., 0)."""
        return x[..., self.impulse_start :]

    def join(self, mu, g, p=None) -> jax.Array:
        """Return the state with a state of the body, a group element and a spatial impulse: see :meth:`split`."""
        entries = g[..., None, :, :] if self.n_real_parts == 1 else jnp.stack([g.real, g.imag], axis=-3)
        impulse = [] if p is None else [p]
        return jnp.concatenate([mu, entries.reshape(*mu.shape[:-1], -1), *impulse], axis=-1)
