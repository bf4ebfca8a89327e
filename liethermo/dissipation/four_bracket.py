"""Metriplectic 4-brackets: tensors with the symmetries of a curvature."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.matrices.linear import skew_matrix
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root

from ..errors import IndefiniteError, InputError
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import checked_numbers
from .base import Dissipation
from .checks import check_form_shape, checked_semidefinite, evaluate_form
from .factor import Factor
from .inner_product import InnerProductDissipation, KillingDissipation


class FourBracket(Dissipation):
    """Metriplectic 4-bracket dissipation ``(F, G) = (F, H; G, H)`` [Morrison & Updike 2024].

    The 4-bracket ``(F, K; G, N) = R^{ijkl} F_i K_j G_k N_l`` has the symmetries of a curvature tensor, so H is
    conserved whatever R is. Two families have constructors of their own: :meth:`kulkarni_nomizu`, which contains
    (BFM 2.2), and :meth:`lie_algebra`, which is (BFM 3.7).

    Parameters
    ----------
    tensor : array, shape (n, n, n, n), or function from x, shape (n,), to one
        ``R[i, j, k, l]``, antisymmetric in (i, j) and in (k, l), symmetric under exchange of the pairs (in units of
        x**4 / (energy**2 * entropy * time)).

    Raises
    ------
    InputError
        If a constant tensor lacks a symmetry, which is named.

    Examples
    --------
    >>> e = np.array(mf.so(3).structure_constants)
    >>> tensor = 0.1 * np.einsum("ijm,klm->ijkl", e, e)
    >>> system = lt.LiePoissonSystem(
    ...     mf.so(3),
    ...     lt.Quadratic([1.0, 2.0, 3.0]),
    ...     mf.so(3).casimirs(2)[0],
    ...     lt.FourBracket(tensor),
    ... )
    >>> bool(system.check().passed)
    True
    """

    tensor: Callable | jax.Array

    def __init__(self, tensor):
        if not callable(tensor):
            tensor = checked_numbers(tensor, "a 4-bracket")
            if tensor.ndim != 4 or len(set(tensor.shape)) != 1:
                raise InputError(f"a 4-bracket must have shape (n, n, n, n), got {tensor.shape}")
            _check_curvature_symmetries(tensor)
        self.tensor = tensor

    @staticmethod
    def kulkarni_nomizu(sigma, mu) -> Dissipation:
        """Return the 4-bracket ``sigma ∧ mu`` of two semidefinite forms on covectors, constants or functions of x.

        ``K(a, b) = sigma(a, b) mu(h, h) - sigma(a, h) mu(h, b) + mu(a, b) sigma(h, h) - mu(a, h) sigma(h, b)``, h = dH.
        With sigma = G/2 and mu = G it is the projected metric (BFM 2.2) of G.
        """
        return KulkarniNomizu(sigma, mu)

    @staticmethod
    def lie_algebra(form=None) -> Dissipation:
        """Return the 4-bracket ``𝒦([dF, dK], [dG, dN])`` of an inner product 𝒦 on g, by default the Killing one."""
        return KillingDissipation() if form is None else InnerProductDissipation(form)

    def bind_to(self, system):
        n = system.dim
        if callable(self.tensor):
            traced_function_and_shape(self.tensor, [(n,)], [(n,) * 4], "the 4-bracket", f"a state of shape ({n},)")
        elif self.tensor.shape != (n,) * 4:
            raise InputError(f"the 4-bracket has shape {self.tensor.shape}, but the state has {n} components")
        return self

    def force(self, system, x, dH, dS, dL):
        return jnp.einsum("ijkl,j,k,l->i", evaluate_form(self.tensor, x), dH, dS, dH)

    def factor(self, system, x, dH, dL):
        """Return the factor with the columns ``A dH``, where ``R = sum A (x) A``: R must be semidefinite on pairs."""
        i, j = np.triu_indices(system.dim, 1)
        form = evaluate_form(self.tensor, x)[i, j][:, i, j]
        _check_semidefinite_on_pairs(form)
        root = semidefinite_root(form) if callable(self.tensor) else semidefinite_factor(form)

        def times(w):
            return skew_matrix(root @ w, system.dim) @ dH

        return Factor(len(i), times, solenoidal=not callable(self.tensor))


class KulkarniNomizu(Dissipation):
    """The 4-bracket of two forms; see :meth:`FourBracket.kulkarni_nomizu`."""

    sigma: Callable | jax.Array
    mu: Callable | jax.Array

    def __init__(self, sigma, mu):
        self.sigma = sigma if callable(sigma) else checked_semidefinite(sigma, "the form sigma")
        self.mu = mu if callable(mu) else checked_semidefinite(mu, "the form mu")

    def bind_to(self, system):
        check_form_shape(self.sigma, system.dim, "the form sigma")
        check_form_shape(self.mu, system.dim, "the form mu")
        return self

    def force(self, system, x, dH, dS, dL):
        sigma, mu = evaluate_form(self.sigma, x), evaluate_form(self.mu, x)
        sH, mH = sigma @ dH, mu @ dH
        from_sigma = jnp.dot(mH, dH) * (sigma @ dS) - jnp.dot(mH, dS) * sH
        from_mu = jnp.dot(sH, dH) * (mu @ dS) - jnp.dot(sH, dS) * mH
        return from_sigma + from_mu

    def factor(self, system, x, dH, dL):
        """Return the factor with a column ``(m_j . dH) s_i - (s_i . dH) m_j`` for each pair of columns of the roots."""
        n, constant = system.dim, not (callable(self.sigma) or callable(self.mu))
        s, m = (
            semidefinite_root(form(x)) if callable(form) else semidefinite_factor(form)
            for form in (self.sigma, self.mu)
        )

        def times(w):
            w = w.reshape(n, n)
            return s @ (w @ (dH @ m)) - m @ ((dH @ s) @ w)

        return Factor(n * n, times, constant)


def _check_semidefinite_on_pairs(form) -> None:
    if isinstance(form, jax.core.Tracer):
        return
    min_eigenvalue, scale = float(np.linalg.eigvalsh(np.asarray(form))[0]), float(np.abs(form).max())
    if min_eigenvalue < -1e-12 * scale * len(form):
        raise IndefiniteError(
            f"the 4-bracket has no factor: on pairs of covectors it has the negative eigenvalue {min_eigenvalue:.3g}. "
            "If the friction matrix that it makes is semidefinite, use that matrix in a FrictionOperator",
            residual=min_eigenvalue,
            tolerance=1e-12 * scale * len(form),
        )


def _check_curvature_symmetries(R) -> None:
    if isinstance(R, jax.core.Tracer):
        return
    R = np.asarray(R)
    tolerance = 1e-12 * float(np.abs(R).max())
    for name, image in [
        ("R[i,j,k,l] = -R[j,i,k,l]", -R.transpose(1, 0, 2, 3)),
        ("R[i,j,k,l] = -R[i,j,l,k]", -R.transpose(0, 1, 3, 2)),
        ("R[i,j,k,l] = R[k,l,i,j]", R.transpose(2, 3, 0, 1)),
    ]:
        residual = float(np.abs(R - image).max())
        if residual > tolerance:
            raise InputError(f"not a 4-bracket: {name} fails by {residual:.3g} (tolerance {tolerance:.1g})")
