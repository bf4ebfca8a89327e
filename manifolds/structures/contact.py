"""Contact structures: a one-form eta with ``eta ^ (d eta)^n != 0`` on R^(2n+1) [SML §2, §3.1].

Coordinates are (q, p, S) on T*Q x R and (q, v, S) on TQ x R. A two-form or bivector is given by its matrix,
``omega(u, v) = u @ omega @ v``, and ``(i_v omega)_j = v_i omega_ij``. The sign of the brackets is the paper's,
``[p, q] = 1``: it is the opposite of that of :class:`manifolds.PoissonStructure`, so that f' = [H, f].
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp

from .._arrays import real_components
from .._index_check import check_indices
from .._pytree_module import Module
from ..errors import ParameterError, ShapeError
from ..matrices.linear import determinant, inverse, solve
from .poisson import PoissonStructure


class ContactStructure(Module):
    """Contact structure; subclasses implement :meth:`form`, and override methods that have a closed form.

    Attributes
    ----------
    dim : int
        Number of coordinates, 2n + 1.
    """

    @property
    @abstractmethod
    def dim(self) -> int: ...

    @abstractmethod
    def form(self, x) -> jax.Array:
        """Return the contact form eta at one point: its components, shape (dim,)."""

    # -- what the form determines -------------------------------------------------------------------------------------

    def differential(self, x) -> jax.Array:
        """Return the two-form d eta at x, ``d_i eta_j - d_j eta_i``, shape (dim, dim)."""
        jacobian = jax.jacfwd(self.form)(x)
        return jacobian.T - jacobian

    def volume(self, x) -> jax.Array:
        """Return ``|eta ^ (d eta)^n| / n!`` in these coordinates, shape (): positive where the form is a contact
        form."""
        return jnp.sqrt(jnp.abs(determinant(self._flat_matrix(x))))

    def flat(self, x, v) -> jax.Array:
        """Return ``i_v d eta + eta(v) eta``: an isomorphism of vectors and covectors, both of shape (dim,)."""
        form = self.form(x)
        return v @ self.differential(x) + jnp.dot(form, v) * form

    def sharp(self, x, alpha) -> jax.Array:
        """Return the inverse of :meth:`flat`; not finite where the form is not a contact form."""
        return solve(self._flat_matrix(x), alpha[:, None])[:, 0]

    def reeb(self, x) -> jax.Array:
        """Return the Reeb vector field R, shape (dim,): ``eta(R) = 1`` and ``i_R d eta = 0``."""
        return self.sharp(x, self.form(x))

    def horizontal(self, x, v) -> jax.Array:
        """Return the component of v in the kernel of eta, ``v - eta(v) R`` [SML 1]."""
        return v - jnp.dot(self.form(x), v) * self.reeb(x)

    def bivector(self, x) -> jax.Array:
        """Return the matrix of ``Lambda(alpha, beta) = -d eta(sharp alpha, sharp beta)``, shape (dim, dim) [SML 3,
        11]."""
        sharp_matrix = inverse(self._flat_matrix(x))
        return -sharp_matrix.T @ self.differential(x) @ sharp_matrix

    def bivector_sharp(self, x, alpha) -> jax.Array:
        """Return ``Lambda(alpha, .)`` as a vector, shape (dim,): ``sharp(alpha) - alpha(R) R``, in the kernel of
        eta."""
        reeb = self.reeb(x)
        return self.sharp(x, alpha) - jnp.dot(alpha, reeb) * reeb

    def _flat_matrix(self, x) -> jax.Array:
        form = self.form(x)
        return self.differential(x).T + jnp.outer(form, form)

    # -- brackets and fields of functions -----------------------------------------------------------------------------

    def cartan_bracket(self, f: Callable, g: Callable) -> Callable:
        """Return the function ``[f, g] = Lambda(df, dg)``: it obeys Leibniz' rule, but not the Jacobi identity [SML
        §2.1]."""

        return self._bracket(self.bivector_sharp, f, g)

    def _bracket(self, sharp: Callable, f: Callable, g: Callable) -> Callable:
        """Return the function ``sharp(df) . dg``, the bracket of the bivector that ``sharp`` applies."""

        def value(x):
            x = real_components(x, self.dim, "x")
            return jnp.dot(sharp(x, jax.grad(f)(x)), jax.grad(g)(x))

        return value

    def jacobi_bracket(self, f: Callable, g: Callable) -> Callable:
        """Return the function ``{f, g} = Lambda(df, dg) + f E(g) - g E(f)``, E = -R [SML §2.1].

        It obeys the Jacobi identity, but of Leibniz' rule only the generalised form
        ``{f, g h} = g {f, h} + h {f, g} + g h E(f)`` [SML 5, where E(h) is printed].
        """

        def value(x):
            x = real_components(x, self.dim, "x")
            reeb, df, dg = self.reeb(x), jax.grad(f)(x), jax.grad(g)(x)
            return jnp.dot(self.bivector_sharp(x, df), dg) - f(x) * jnp.dot(reeb, dg) + g(x) * jnp.dot(reeb, df)

        return value

    def evolution_vector_field(self, f: Callable) -> Callable:
        """Return the field ``E_f = Lambda(df, .)``, which conserves f and lies in the kernel of eta [SML 7, Prop.
        2.1]."""

        def field(x):
            x = real_components(x, self.dim, "x")
            return self.bivector_sharp(x, jax.grad(f)(x))

        return field

    def hamiltonian_vector_field(self, f: Callable) -> Callable:
        """Return the contact field ``X_f = Lambda(df, .) - f R``, along which ``f' = -R(f) f`` [SML §2.2, Prop.
        2.1]."""

        def field(x):
            x = real_components(x, self.dim, "x")
            return self.bivector_sharp(x, jax.grad(f)(x)) - f(x) * self.reeb(x)

        return field


class ContactForm(ContactStructure):
    """Contact structure given by its form, a function from x, shape (dim,), to the components of eta.

    The form is not checked: ``volume`` measures at a point whether it is a contact form.

    Parameters
    ----------
    function : callable
        From x, shape (dim,), to the components of eta, shape (dim,).
    dim : int
        The number of state components, odd.
    """

    function: Callable
    size: int = eqx.field(static=True)

    def __init__(self, function: Callable, dim: int):
        if not isinstance(dim, int) or dim < 3 or dim % 2 == 0:
            raise ParameterError(f"dim must be odd and at least 3, the number 2n + 1 of coordinates, got {dim!r}")
        x = jax.ShapeDtypeStruct((dim,), jnp.float64)
        closed_jaxpr, result = jax.make_jaxpr(lambda x: jnp.asarray(function(x)), return_shape=True)(x)
        check_indices(closed_jaxpr, "a contact form")
        shape = result.shape
        if shape != (dim,):
            raise ShapeError(f"a form on {dim} coordinates must have shape ({dim},), got {shape}")
        self.function, self.size = function, dim

    @property
    def dim(self) -> int:
        return self.size

    def form(self, x) -> jax.Array:
        return jnp.asarray(self.function(x))


class Bundle(Protocol):
    """Positions on a manifold with their velocities or momenta: a :class:`manifolds.TangentBundle`."""

    @property
    def size(self) -> int: ...

    def tangential_part(self, q, w) -> jax.Array: ...

    def tangent_projector_and_compensation(self, x) -> tuple[jax.Array, jax.Array]: ...


class TangentMap(NamedTuple):
    """Map of arrays to tangent vectors of a bundle at one point, and its transpose.

    Attributes
    ----------
    P : array, shape (n, n)
        The projector along Q.
    N : array, shape (n, n)
        ``N q'`` is the component across Q of the velocity of v.
    """

    P: jax.Array
    N: jax.Array

    def lift(self, w) -> jax.Array:
        """Return the tangent vector with the component of w along Q and the nearest second component, shape (2n +
        1,)."""
        n = len(self.P)
        a = self.P @ w[:n]
        return jnp.concatenate([a, self.P @ w[n : 2 * n] + self.N @ a, w[2 * n :]])

    def lower(self, alpha) -> jax.Array:
        """Apply the transposed map, which removes the components of a covector that act on no tangent vector."""
        n = len(self.P)
        v_components = alpha[n : 2 * n]
        return jnp.concatenate([self.P @ (alpha[:n] + v_components @ self.N), self.P @ v_components, alpha[2 * n :]])


class SplitContact(ContactStructure):
    """Contact structure whose bivector is the sum of a Poisson bivector and a remainder: ``Lambda_0 + Delta ^ R`` [SML
    6].

    The brackets are ``[f, g] = {f, g}_0 + {f, g}_Delta``: a reversible part, for which S is a Casimir function, and
    the thermodynamic one. Delta is the Liouville field ``p d/dp`` on T*Q x R [SML 2].

    With a ``bundle``, positions and momenta are those of a manifold Q in its ambient arrays: the structure is that of
    T*Q x R, or TQ x R. Its fields are tangent to that space, and near it to the level sets of its
    constraints; components of a covector across these have no effect.

    Attributes
    ----------
    degrees_of_freedom : int
        Components of q: more than the dimension of Q if it is embedded in arrays.
    bundle : manifolds.TangentBundle, optional
        The tangent bundle of the positions.
    """

    degrees_of_freedom: int = eqx.field(static=True)
    bundle: Bundle | None = eqx.field(static=True, kw_only=True, default=None)

    def __check_init__(self):
        if not isinstance(self.degrees_of_freedom, int) or self.degrees_of_freedom < 1:
            raise ParameterError(f"degrees_of_freedom must be a positive integer, got {self.degrees_of_freedom!r}")

    @property
    def dim(self) -> int:
        return 2 * self.degrees_of_freedom + 1

    @abstractmethod
    def liouville(self, x) -> jax.Array:
        """Return the Liouville vector field Delta, shape (dim,)."""

    @abstractmethod
    def cosymplectic_sharp(self, x, alpha) -> jax.Array:
        """Return ``Lambda_0(alpha, .)``, shape (dim,)."""

    @abstractmethod
    def liouville_sharp(self, x, alpha) -> jax.Array:
        """Return ``(Delta ^ R)(alpha, .) = alpha(Delta) R - alpha(R) Delta``, shape (dim,)."""

    def bivector_sharp(self, x, alpha) -> jax.Array:
        return self.cosymplectic_sharp(x, alpha) + self.liouville_sharp(x, alpha)

    def cosymplectic_bracket(self, f: Callable, g: Callable) -> Callable:
        """Return the function ``{f, g}_0 = Lambda_0(df, dg)``, a Poisson bracket [SML §2.1]."""
        return self._bracket(self.cosymplectic_sharp, f, g)

    def liouville_bracket(self, f: Callable, g: Callable) -> Callable:
        """Return the function ``{f, g}_Delta = R(g) Delta(f) - R(f) Delta(g)`` [SML §2.1]."""
        return self._bracket(self.liouville_sharp, f, g)

    def _split_coordinates(self, x):
        """Return the components (q, p, S) or (q, v, S) of a point, vector or covector; S has shape (1,)."""
        n = self.degrees_of_freedom
        return x[:n], x[n : 2 * n], x[2 * n :]

    def bivector(self, x) -> jax.Array:
        if self.bundle is None:
            return super().bivector(x)
        return jax.vmap(lambda alpha: self.bivector_sharp(x, alpha))(jnp.eye(self.dim))

    # -- on a manifold ------------------------------------------------------------------------------------------------

    def tangential_part(self, q, v) -> jax.Array:
        """Return the component along Q of a velocity, momentum or force at q, shape (n,); on R^n all of it."""
        return v if self.bundle is None else self.bundle.tangential_part(q, v)

    def tangent_map(self, x) -> TangentMap | None:
        """Return the map of arrays to tangent vectors at x; None without a manifold."""
        return (
            None
            if self.bundle is None
            else TangentMap(*self.bundle.tangent_projector_and_compensation(x[: 2 * self.degrees_of_freedom]))
        )


class CanonicalContact(SplitContact):
    """Contact structure ``eta = dS - p dq`` on T*Q x R, coordinates (q_1 … q_n, p_1 … p_n, S) [SML §2].

    ``Lambda = d/dp ^ (d/dq + p d/dS)`` (4), and the evolution field of f is
    ``q' = f_p, p' = -f_q - p f_S, S' = p . f_p`` (7).

    Parameters
    ----------
    degrees_of_freedom : int
        n, the number of positions.
    bundle : Bundle, optional
        T*Q of a manifold Q instead of T*R^n.
    """

    def form(self, x) -> jax.Array:
        q, p, S = self._split_coordinates(x)
        return jnp.concatenate([-p, jnp.zeros_like(q), jnp.ones_like(S)])

    def reeb(self, x) -> jax.Array:
        return jnp.zeros(self.dim).at[-1].set(1.0)

    def liouville(self, x) -> jax.Array:
        q, p, S = self._split_coordinates(x)
        return jnp.concatenate([jnp.zeros_like(q), self.tangential_part(q, p), jnp.zeros_like(S)])

    def sharp(self, x, alpha) -> jax.Array:
        return self.bivector_sharp(x, alpha) + alpha[-1] * self.reeb(x)

    def cosymplectic_sharp(self, x, alpha) -> jax.Array:
        tangent_map = self.tangent_map(x)
        alpha_q, alpha_p, alpha_S = self._split_coordinates(alpha if tangent_map is None else tangent_map.lower(alpha))
        vector = jnp.concatenate([alpha_p, -alpha_q, jnp.zeros_like(alpha_S)])
        return vector if tangent_map is None else tangent_map.lift(vector)

    def liouville_sharp(self, x, alpha) -> jax.Array:
        p, (alpha_q, alpha_p, alpha_S) = self._split_coordinates(self.liouville(x))[1], self._split_coordinates(alpha)
        return jnp.concatenate([jnp.zeros_like(alpha_q), -p * alpha_S, jnp.dot(p, alpha_p)[None]])


class LagrangianContact(SplitContact):
    """Contact structure ``eta_L = dS - L_v dq`` on TQ x R, coordinates (q, v, S), the canonical one in the chart FL
    [SML §3.1].

    It is a contact form where the Lagrangian is regular, that is where its Hessian ``W = L_vv`` is invertible.

    Parameters
    ----------
    lagrangian : function from (q, v, S) in one array, shape (2n + 1,), to a scalar
        The Lagrangian (energy).
    degrees_of_freedom : int
        Number n of positions.
    bundle : manifolds.TangentBundle, optional
        On a manifold Q, n being the number of components of its arrays.
    """

    lagrangian: Callable

    def __init__(self, lagrangian: Callable, degrees_of_freedom: int, bundle: Bundle | None = None):
        self.lagrangian, self.degrees_of_freedom, self.bundle = lagrangian, degrees_of_freedom, bundle

    def momentum(self, x) -> jax.Array:
        """Return ``p = L_v``, shape (n,), as a covector of Q."""
        return self.tangential_part(
            self._split_coordinates(x)[0], self._split_coordinates(jax.grad(self.lagrangian)(x))[1]
        )

    def rates(self, x) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the derivatives of the momentum by q, v and S, shapes (n, n), (n, n) and (n, 1), along the manifold.

        The second is the Hessian W, which on a manifold is made invertible: across Q it is a multiple of 1.
        """
        n, tangent_map = self.degrees_of_freedom, self.tangent_map(x)
        rates = jax.jacfwd(self.momentum)(x)
        q_jacobian, W, S_jacobian = rates[:, :n], rates[:, n : 2 * n], rates[:, 2 * n :]
        if tangent_map is None:
            return q_jacobian, W, S_jacobian
        P, N = tangent_map
        q_jacobian, W = P @ (q_jacobian + W @ N) @ P, P @ W @ P
        return q_jacobian, W + jnp.max(jnp.abs(W)) * (jnp.eye(n) - P), P @ S_jacobian

    def legendre(self, x) -> jax.Array:
        """Return the Legendre transform ``FL(q, v, S) = (q, p, S)``, shape (dim,)."""
        q, _, S = self._split_coordinates(x)
        return jnp.concatenate([q, self.momentum(x), S])

    def hessian(self, x) -> jax.Array:
        """Return ``W = L_vv``, shape (n, n) [SML 8]; on a manifold as in :meth:`rates`."""
        return self.rates(x)[1]

    def energy(self, x) -> jax.Array:
        """Return ``E_L = v·L_v - L``, shape ()."""
        return jnp.dot(self._split_coordinates(x)[1], self.momentum(x)) - self.lagrangian(x)

    def form(self, x) -> jax.Array:
        return self._canonical_structure.form(self.legendre(x))

    def reeb(self, x) -> jax.Array:
        return self._pullback(x, lambda y, _: self._canonical_structure.reeb(y), jnp.zeros(self.dim))

    def liouville(self, x) -> jax.Array:
        return self._pullback(x, lambda y, _: self._canonical_structure.liouville(y), jnp.zeros(self.dim))

    def sharp(self, x, alpha) -> jax.Array:
        return self._pullback(x, self._canonical_structure.sharp, alpha)

    def bivector_sharp(self, x, alpha) -> jax.Array:
        return self._pullback(x, self._canonical_structure.bivector_sharp, alpha)

    def cosymplectic_sharp(self, x, alpha) -> jax.Array:
        return self._pullback(x, self._canonical_structure.cosymplectic_sharp, alpha)

    def liouville_sharp(self, x, alpha) -> jax.Array:
        return self._pullback(x, self._canonical_structure.liouville_sharp, alpha)

    @property
    def _canonical_structure(self) -> CanonicalContact:
        return CanonicalContact(self.degrees_of_freedom, bundle=self.bundle)

    def _pullback(self, x, sharp: Callable, alpha) -> jax.Array:
        """Return ``TFL^-1 sharp(FL(x), TFL^-T alpha)``: with p = L_v, ``dp = L_vq dq + W dv + L_vS dS``."""
        (q_jacobian, W, S_jacobian), tangent_map = self.rates(x), self.tangent_map(x)
        alpha_q, alpha_v, alpha_S = self._split_coordinates(alpha if tangent_map is None else tangent_map.lower(alpha))
        beta_p = solve(W, alpha_v[:, None])[:, 0]  # W is symmetric
        beta = jnp.concatenate([alpha_q - beta_p @ q_jacobian, beta_p, alpha_S - beta_p @ S_jacobian])
        q_dot, p_dot, S_dot = self._split_coordinates(sharp(self.legendre(x), beta))
        v_dot = solve(W, (p_dot - q_jacobian @ q_dot - S_jacobian @ S_dot)[:, None])[:, 0]
        vector = jnp.concatenate([q_dot, v_dot, S_dot])
        return vector if tangent_map is None else tangent_map.lift(vector)


class Cosymplectic(PoissonStructure):
    """Poisson structure Lambda_0 of a split contact structure; S is a Casimir function [SML §2.1].

    On T*R^n x R it is the canonical one, ``q' = H_p, p' = -H_q, S' = 0``; on T*Q x R that of T*Q.

    Parameters
    ----------
    contact : SplitContact
        The contact structure.
    """

    contact: SplitContact

    @property
    def dim(self) -> int:
        return self.contact.dim

    def tensor(self, x) -> jax.Array:
        return jax.vmap(lambda alpha: self.sharp(x, alpha), out_axes=1)(jnp.eye(self.dim))

    def sharp(self, x, alpha) -> jax.Array:
        return self.contact.cosymplectic_sharp(x, alpha)
