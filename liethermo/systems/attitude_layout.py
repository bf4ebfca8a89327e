"""``AttitudeLayout``: the components of a state that hold an attitude, an element of a group, and an impulse."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

import manifolds as mf


@dataclass(frozen=True)
class AttitudeLayout:
    """Indices of the components of a state that hold the body, its attitude and the impulse of a torque.

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
    def n_reals_per_entry(self) -> int:
        """Number of real components that store an entry of the attitude matrix: 2 for complex groups, otherwise 1."""
        return 2 if self.group.is_complex else 1

    @property
    def impulse_start(self) -> int:
        """Index of the first component of the impulse."""
        return self.body_dim + self.n_reals_per_entry * self.group.matrix_size**2

    def split_state(self, x) -> tuple[jax.Array, jax.Array]:
        """Return the state of the body, shape (..., n), and the attitude matrix, shape (..., m, m), from a state."""
        n, m = self.body_dim, self.group.matrix_size
        entries = x[..., n : self.impulse_start].reshape(*x.shape[:-1], self.n_reals_per_entry, m, m)
        g = entries[..., 0, :, :]
        return x[..., :n], g if self.n_reals_per_entry == 1 else g + 1j * entries[..., 1, :, :]

    def impulse(self, x) -> jax.Array:
        """Return the initial spatial momentum plus the impulse of the torque, shape (..., algebra.dim); or (..., 0)."""
        return x[..., self.impulse_start :]

    def join_state(self, body_state, attitude, p=None) -> jax.Array:
        """Return the state, shape (..., dim), of a state of the body, an attitude matrix and an impulse p."""
        entries = (
            attitude[..., None, :, :]
            if self.n_reals_per_entry == 1
            else jnp.stack([attitude.real, attitude.imag], axis=-3)
        )
        impulse = [] if p is None else [p]
        return jnp.concatenate([body_state, entries.reshape(*body_state.shape[:-1], -1), *impulse], axis=-1)
