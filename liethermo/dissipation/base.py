"""Dissipation: the part of a metriplectic system that produces entropy, one class per construction.

Each gives a *force* ``f(x; dH, dS, dL)``, written in terms of the gradients it is handed. Handed the gradients at x it
is the continuous dissipation ``K(x) grad S``; handed discrete gradients it is its discretisation ``K_d``, with the
discrete gradient of the energy in the kernel of K_d by construction: this is the rebuilding that BFM (4.6) and
Remark 4.7 ask for, once for every class.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

import manifolds as mf
from manifolds._arrays import real_array

from ..errors import IndefiniteError, InputError
from ..functions.energy import Energy, as_energy, recognised
from ..functions.indices import union

if TYPE_CHECKING:
    from ..systems import System

KERNEL = "K grad H = 0, as given"
"""The row of a check on a friction operator before it is projected."""

Law = Literal["conserved", "nondecreasing", "nonincreasing"]
T = TypeVar("T")


class Dissipation(eqx.Module):
    """Base class. A subclass states its laws and gives :meth:`force`; :meth:`prepared` may complete and check it.

    Attributes
    ----------
    preserve : tuple of Energy
        Functions besides the energy that it keeps constant; of a sum those of all parts, one part after another.
    """

    @property
    def energy_law(self) -> Law | None:
        """What the construction guarantees of the energy; None where it guarantees nothing."""
        return "conserved"

    @property
    def entropy_law(self) -> Law | None:
        """What the construction guarantees of the entropy; None where it guarantees nothing."""
        return "nondecreasing"

    @property
    def symmetric(self) -> bool:
        """Whether the force is ``K(x) grad S``, K symmetric, and not a skew bracket with the energy alone [SML 6]."""
        return True

    def couplings(self, system: System) -> scipy.sparse.csr_array | None:
        """Which components of the force depend on which components of the state and of the gradients it is handed.

        A pattern, shape (n, n), for systems too large for a full Jacobian matrix; None where it is not known.
        """
        del system
        return None

    @property
    def keeps_casimirs(self) -> bool:
        """Whether the force keeps every Casimir, whatever gradients it is handed: it lies in the range of Pi(x)."""
        return False

    @property
    def terms(self) -> tuple[Dissipation, ...]:
        """The summands, or this one alone."""
        return (self,)

    @property
    def preserve(self) -> tuple[Energy, ...]:
        return ()

    @property
    def needs_entropy(self) -> bool:
        return True

    def prepared(self, system: System) -> Dissipation:
        """This dissipation, checked against the system it is used in and completed with what that determines."""
        del system
        return self

    def own_residuals(self, system: System, x) -> dict[str, jax.Array]:
        """Residuals at x of what it was given and would have to mend, relative to what cancels, by their names."""
        del system, x
        return {}

    @abstractmethod
    def force(self, system: System, x, dH, dS, dL) -> jax.Array:
        """The dissipative part of ``x'``, shape (n,).

        Parameters
        ----------
        system : System
        x : array, shape (n,)
        dH, dS : array, shape (n,)
            Gradients of energy and entropy, continuous or discrete.
        dL : tuple of array, shape (n,)
            Gradients of the functions in :attr:`preserve`, in their order.
        """

    def momentum(self, dH, turned) -> jax.Array | None:
        """F with force ``ad*_dH F``, for dissipations of the form of forced Euler-Poincaré equations [BFM 3.2].

        ``turned`` is ``[dH, dS]``. Such an F joins the momentum of the motion, ``x' = ad*_dH (x + F)``: one coadjoint
        action in the place of two. None where the force is of another form.
        """
        del dH, turned
        return None

    def __add__(self, other: Dissipation) -> Dissipation:
        return Several((*self.terms, *other.terms))


class Several(Dissipation):
    """A sum of dissipations acting together; a law holds if every part obeys it."""

    parts: tuple[Dissipation, ...]

    @property
    def terms(self) -> tuple[Dissipation, ...]:
        return self.parts

    @property
    def energy_law(self) -> Law | None:
        laws = {part.energy_law for part in self.parts}
        return None if None in laws else "nonincreasing" if "nonincreasing" in laws else "conserved"

    @property
    def entropy_law(self) -> Law | None:
        laws = {part.entropy_law for part in self.parts} - {"conserved"}
        return "conserved" if not laws else ("nondecreasing" if laws == {"nondecreasing"} else None)

    @property
    def symmetric(self) -> bool:
        return all(part.symmetric for part in self.parts)

    def couplings(self, system):
        return union(part.couplings(system) for part in self.parts)

    @property
    def keeps_casimirs(self) -> bool:
        return all(part.keeps_casimirs for part in self.parts)

    @property
    def preserve(self) -> tuple[Energy, ...]:
        return tuple(L for part in self.parts for L in part.preserve)

    @property
    def needs_entropy(self) -> bool:
        return any(part.needs_entropy for part in self.parts)

    def prepared(self, system: System) -> Dissipation:
        return Several(tuple(part.prepared(system) for part in self.parts))

    def force(self, system, x, dH, dS, dL):
        return sum(part.force(system, x, dH, dS, own) for part, own in portions(self, dL))


def portions(dissipation: Dissipation, preserved: Sequence[T]) -> Iterator[tuple[Dissipation, tuple[T, ...]]]:
    """Each summand with its portion of what belongs to the functions in ``dissipation.preserve``, in their order."""
    start = 0
    for part in dissipation.terms:
        end = start + len(part.preserve)
        yield part, tuple(preserved[start:end])
        start = end


class Carried(Dissipation):
    """A dissipation in other coordinates or on a larger state: it obeys the laws of the one that it is made from.

    Attributes
    ----------
    part : Dissipation
    functions : tuple of Energy
        What that one preserves, as functions of the new state.
    """

    part: Dissipation
    functions: tuple[Energy, ...]

    @property
    def energy_law(self):
        return self.part.energy_law

    @property
    def entropy_law(self):
        return self.part.entropy_law

    @property
    def keeps_casimirs(self):
        return self.part.keeps_casimirs

    @property
    def symmetric(self):
        return self.part.symmetric

    @property
    def needs_entropy(self):
        return self.part.needs_entropy

    @property
    def preserve(self):
        return self.functions


class SkewFriction(Dissipation):
    """A skew bracket with the energy alone, so that the energy is conserved: friction that heats [SML 6]."""

    @property
    def needs_entropy(self) -> bool:
        return False

    @property
    def symmetric(self) -> bool:
        return False


class InnerProductDissipation(Dissipation):
    """Dissipation by an inner product on the Lie algebra: ``K(alpha, beta) = 𝒦([dH, alpha], [dH, beta])``.

    It is the forced Euler-Poincaré equation ``mu' = ad*_xi (mu + F)`` with ``<F, eta> = 𝒦(eta, [xi, grad S])``
    [BFM 3.6-3.7], so ``S' = 𝒦([xi, grad S], [xi, grad S]) >= 0`` for a Casimir S.

    Parameters
    ----------
    K : array, shape (dim, dim)
        The inner product 𝒦 on g, symmetric and positive semidefinite.

    Raises
    ------
    IndefiniteError, InputError
        If it is not.
    """

    K: jax.Array

    def __init__(self, K):
        self.K = semidefinite(K, "the inner product 𝒦")

    def prepared(self, system):
        _need_algebra(system, "InnerProductDissipation", self.K.shape[0])
        return self

    def momentum(self, dH, turned):
        return self.K @ turned

    def force(self, system, x, dH, dS, dL):
        g = system.algebra
        return g.ad_star(dH, self.momentum(dH, g.bracket(dH, dS)))


class KillingDissipation(Dissipation):
    """Dissipation by the Killing form kappa, made positive: :class:`InnerProductDissipation` with the algebra's own 𝒦.

    ``𝒦 = -rate * kappa`` on compact type, ``𝒦(x, y) = -rate * kappa(x, theta y)`` with a Cartan involution theta on
    noncompact semisimple algebras, and ``-rate * kappa`` again wherever that is at least semidefinite (se(3)). On so(3)
    ``-kappa = 2 I``, so rate 1/2 gives the projected metric (BFM 2.2).

    Parameters
    ----------
    rate : float, >= 0

    Raises
    ------
    IndefiniteError
        When used on an algebra that is not semisimple and whose ``-kappa`` is indefinite.
    """

    rate: jax.Array
    form: jax.Array | None

    def __init__(self, rate=1.0, form=None):
        self.rate = checked_rate(rate)
        self.form = form  # filled in by prepared(), once the algebra is known

    @staticmethod
    def inner_product(g: mf.LieAlgebra) -> np.ndarray:
        """The positive semidefinite form 𝒦 on g for rate 1, shape (dim, dim)."""
        if g.is_semisimple():
            form = -g.killing_form() @ g.cartan_involution()
            return (form + form.T) / 2
        form = -g.killing_form()
        if g.killing_signature()[0]:
            lowest = float(np.linalg.eigvalsh(form)[0])
            raise IndefiniteError(
                f"{g.name} is not semisimple and minus its Killing form is indefinite (lowest eigenvalue "
                f"{lowest:.3g}), so it cannot measure dissipation: entropy would fall along some motions. Give "
                "an inner product with InnerProductDissipation(K), or use ProjectedMetric(), which needs none",
                residual=lowest,
                tolerance=0.0,
            )
        return form

    def prepared(self, system):
        g = _need_algebra(system, "KillingDissipation")
        form = self.inner_product(g)
        if g.is_solvable():  # Cartan's criterion: kappa(g, [g, g]) = 0
            raise InputError(
                f"{g.name} is solvable: its Killing form vanishes on brackets, so "
                "KillingDissipation would do nothing; use ProjectedMetric() or InnerProductDissipation(K)"
            )
        return KillingDissipation(self.rate, jnp.asarray(form))

    def momentum(self, dH, turned):
        return self.rate * (self.form @ turned)

    def force(self, system, x, dH, dS, dL):
        g = system.algebra
        return g.ad_star(dH, self.momentum(dH, g.bracket(dH, dS)))


class ProjectedMetric(Dissipation):
    """Dissipation by a cometric G, projected off what it has to conserve [BFM 2.2, Remark 2.1].

    ``K(alpha, beta) = det(C) G(P alpha, P beta)``, P the G-orthogonal projector off the span of dH and the
    gradients dL_a of ``preserve``, and ``C_ab = G(dL_a, dL_b)`` with L_1 = H. For the energy alone
    ``det(C) = G(dH, dH)`` and this is BFM (2.2), ``G(dH, dH) G(alpha, beta) - G(dH, alpha) G(dH, beta)``. With
    ``normalized=True`` the factor det(C) is left out (Remark 2.1).

    Parameters
    ----------
    cometric : array, shape (n, n), or function from x, shape (n,), to one
        Positive definite. By default the identity, or on a manifold the metric of the space.
    preserve : sequence of functions or energies
        Kept constant besides the energy.
    normalized : bool
    rate : float, >= 0
        Factor on the whole.
    """

    cometric: jax.Array | Callable | None
    functions: tuple[Energy, ...]
    normalized: bool = eqx.field(static=True)
    rate: jax.Array

    def __init__(self, cometric=None, preserve=(), normalized=False, rate=1.0):
        self.cometric = cometric if cometric is None or callable(cometric) else semidefinite(cometric, "the cometric")
        functions = preserve if isinstance(preserve, list | tuple) else (preserve,)
        self.functions = tuple(as_energy(L, "a preserved function") for L in functions)
        self.normalized = bool(normalized)
        self.rate = checked_rate(rate)

    @property
    def preserve(self):
        return self.functions

    def prepared(self, system):
        if system.space is not None:
            return self
        return eqx.tree_at(lambda d: d.functions, self, tuple(recognised(L, system.dim) for L in self.functions))

    def force(self, system, x, dH, dS, dL):
        G = _at(self.cometric, x)

        def raised(alpha):
            return system.raised(x, alpha) if G is None else system.tangent(x, G @ alpha)

        if not dL and not self.normalized:
            GdH = raised(dH)
            return self.rate * (jnp.dot(GdH, dH) * raised(dS) - jnp.dot(GdH, dS) * GdH)
        frame: list[tuple[jax.Array, jax.Array]] = []  # G-orthonormal covectors and their images under G

        def off_frame(alpha):
            for _ in range(2):  # the second pass removes what rounding left of the first
                for e, Ge in frame:
                    alpha = alpha - jnp.dot(Ge, alpha) * e
            return alpha

        gram = jnp.ones(())
        for gradient in (dH, *dL):
            before = jnp.dot(raised(gradient), gradient)
            rest = off_frame(gradient)
            square = jnp.dot(raised(rest), rest)
            # a gradient that depends on the earlier ones adds nothing to project off
            independent = square > 1e-24 * before
            square = jnp.where(independent, square, 0.0)
            e = rest * jnp.where(independent, 1.0 / jnp.sqrt(jnp.where(independent, square, 1.0)), 0.0)
            frame.append((e, raised(e)))
            gram = gram * square
        projected = raised(off_frame(dS))
        for e, Ge in frame:  # P is G-symmetric: project the image as well, so that K stays symmetric to rounding
            projected = projected - jnp.dot(e, projected) * Ge
        return self.rate * (projected if self.normalized else gram * projected)


class FrictionOperator(Dissipation):
    """Dissipation by a friction matrix K(x) with ``K(x) grad H(x) = 0`` [BFM Remark 4.7].

    That K has grad H in its kernel is tested where a system is built, and by ``system.check()``: of another K only the
    projection ``P^T K P`` would act, P the projector off grad H. ``project=True`` says that this is meant.

    A discretisation hands it a discrete gradient dH beside ``grad H(x)``. The kernel is then moved from the one to the
    other: ``K_d = P^T K P`` with ``P = 1 - dH grad H^T / (grad H . dH)``, the projector along dH onto the complement of
    grad H. K_d is semidefinite, has dH in its kernel, keeps every other kernel vector of K that is orthogonal to grad H
    (momentum maps), and tends to K.

    Parameters
    ----------
    K : function from x, shape (n,), to a matrix (n, n), or a constant matrix
    rate : float, >= 0
    project : bool
        Take any symmetric semidefinite K, and let its projection off grad H act.
    """

    K: Callable | jax.Array
    rate: jax.Array
    project: bool = eqx.field(static=True)

    def __init__(self, K, rate=1.0, project: bool = False):
        self.K = K if callable(K) else semidefinite(K, "the friction operator K")
        self.rate = checked_rate(rate)
        self.project = bool(project)

    def prepared(self, system):
        _check_matrix(self.K, system.dim, "the friction operator K")
        return self

    def own_residuals(self, system, x):
        if self.project:
            return {}
        K, dH = _at(self.K, x), system.energy.gradient(x)
        dH = dH if system.space is None else system.lowered(x, system.raised(x, dH))
        size = jnp.max(jnp.abs(K)) * jnp.max(jnp.abs(dH))
        missed = jnp.max(jnp.abs(jnp.stack([K @ dH, dH @ K])))
        return {KERNEL: missed / jnp.where(size > 0.0, size, 1.0)}

    def force(self, system, x, dH, dS, dL):
        gradient, raised, K = system.raised(x, system.energy.gradient(x)), system.raised(x, dH), _at(self.K, x)
        overlap, square = jnp.dot(gradient, dH), jnp.dot(raised, dH)
        # Where grad H is tiny or turned away from dH, project orthogonally off dH instead.
        safe = overlap > 1e-3 * square
        along = jnp.where(safe, gradient, raised)
        overlap = jnp.where(safe, overlap, square)
        along = along / jnp.where(overlap > 0.0, overlap, 1.0)
        image = K @ (dS - jnp.dot(along, dS) * dH)
        return self.rate * (image - jnp.dot(dH, image) * along)


class FourBracket(Dissipation):
    """Metriplectic 4-bracket dissipation ``(F, G) = (F, H; G, H)`` [Morrison & Updike 2024].

    The 4-bracket ``(F, K; G, N) = R^{ijkl} F_i K_j G_k N_l`` has the symmetries of a curvature tensor, so H is
    conserved whatever R is. Two families have constructors of their own: :meth:`kulkarni_nomizu`, which contains
    (BFM 2.2), and :meth:`lie_algebra`, which is (BFM 3.7).

    Parameters
    ----------
    tensor : array, shape (n, n, n, n), or function from x, shape (n,), to one
        ``R[i, j, k, l]``, antisymmetric in (i, j) and in (k, l), symmetric under exchange of the pairs.

    Raises
    ------
    InputError
        If a constant tensor lacks a symmetry, which is named.
    """

    tensor: Callable | jax.Array

    def __init__(self, tensor):
        if not callable(tensor):
            tensor = jnp.asarray(tensor, dtype=jnp.float64)
            if tensor.ndim != 4 or len(set(tensor.shape)) != 1:
                raise InputError(f"a 4-bracket has shape (n, n, n, n), not {tensor.shape}")
            _check_curvature_symmetries(tensor)
        self.tensor = tensor

    @staticmethod
    def kulkarni_nomizu(sigma, mu) -> Dissipation:
        """4-bracket ``sigma ∧ mu`` of two symmetric semidefinite forms on covectors, constant or functions of x.

        ``K(a, b) = sigma(a, b) mu(h, h) - sigma(a, h) mu(h, b) + mu(a, b) sigma(h, h) - mu(a, h) sigma(h, b)``, h = dH.
        With sigma = G/2 and mu = G it is the projected metric (BFM 2.2) of G.
        """
        return KulkarniNomizu(sigma, mu)

    @staticmethod
    def lie_algebra(form=None) -> Dissipation:
        """4-bracket ``𝒦([dF, dK], [dG, dN])`` of an inner product 𝒦 on g (by default that of KillingDissipation)."""
        return KillingDissipation() if form is None else InnerProductDissipation(form)

    def prepared(self, system):
        shape = jax.eval_shape(lambda x: jnp.asarray(_at(self.tensor, x)), _state(system.dim)).shape
        if shape != (system.dim,) * 4:
            raise InputError(f"the 4-bracket has shape {shape}, but the state has {system.dim} components")
        return self

    def force(self, system, x, dH, dS, dL):
        return jnp.einsum("ijkl,j,k,l->i", _at(self.tensor, x), dH, dS, dH)


class KulkarniNomizu(Dissipation):
    """The 4-bracket of two forms; see :meth:`FourBracket.kulkarni_nomizu`."""

    sigma: Callable | jax.Array
    mu: Callable | jax.Array

    def __init__(self, sigma, mu):
        self.sigma = sigma if callable(sigma) else semidefinite(sigma, "the form sigma")
        self.mu = mu if callable(mu) else semidefinite(mu, "the form mu")

    def prepared(self, system):
        _check_matrix(self.sigma, system.dim, "the form sigma")
        _check_matrix(self.mu, system.dim, "the form mu")
        return self

    def force(self, system, x, dH, dS, dL):
        sigma, mu = _at(self.sigma, x), _at(self.mu, x)
        sH, mH = sigma @ dH, mu @ dH
        from_sigma = jnp.dot(mH, dH) * (sigma @ dS) - jnp.dot(mH, dS) * sH
        from_mu = jnp.dot(sH, dH) * (mu @ dS) - jnp.dot(sH, dS) * mH
        return from_sigma + from_mu


class DoubleBracket(Dissipation):
    """Double bracket: keeps every Casimir and lowers the energy [Bloch, Krishnaprasad, Marsden, Ratiu 1996].

    ``x' = Pi dH + rate * Pi (Pi dH)^♯``, that is ``ad*_xi mu + rate * ad*_sigma mu`` with ``sigma = (ad*_xi mu)^♯``
    on a Lie algebra, so ``H' = -rate |Pi dH|^2 <= 0``. No entropy is needed: one that is given must be a Casimir
    and is conserved.

    Parameters
    ----------
    rate : float, >= 0
    metric : array, shape (n, n), optional
        The positive definite form ^♯; by default the identity, or on a manifold the metric of the space.
    """

    rate: jax.Array
    metric: jax.Array | None

    def __init__(self, rate=1.0, metric=None):
        self.rate = checked_rate(rate)
        self.metric = None if metric is None else semidefinite(metric, "the metric")

    @property
    def energy_law(self):
        return "nonincreasing"

    @property
    def entropy_law(self):
        return "conserved"

    @property
    def keeps_casimirs(self):
        return True

    @property
    def needs_entropy(self):
        return False

    def prepared(self, system):
        if self.metric is not None:
            _check_matrix(self.metric, system.dim, "the metric")
        return self

    def force(self, system, x, dH, dS, dL):
        motion = system.poisson.sharp(x, dH)
        lowered = system.lowered(x, motion) if self.metric is None else self.metric @ motion
        return self.rate * system.poisson.sharp(x, lowered)


class EulerPoincareForce(Dissipation):
    """A force ``ad*_xi F(xi)`` [BFM 3.2, 3.4]: ``mu' = ad*_xi (mu + F(xi))`` conserves the energy for every F.

    The entropy law is not guaranteed; ``system.check()`` reports the sign of the entropy production at random points.

    Parameters
    ----------
    F : function from xi in g, shape (dim,), to a covector, shape (dim,)
    """

    F: Callable

    @property
    def entropy_law(self):
        return None

    @property
    def needs_entropy(self):
        return False

    def prepared(self, system):
        g = _need_algebra(system, "EulerPoincareForce")
        shape = jax.eval_shape(lambda xi: jnp.asarray(self.F(xi)), _state(g.dim)).shape
        if shape != (g.dim,):
            raise InputError(f"the force F must map shape ({g.dim},) to ({g.dim},), but it returns shape {shape}")
        return self

    def momentum(self, dH, turned):
        return self.F(dH)

    def force(self, system, x, dH, dS, dL):
        return system.algebra.ad_star(dH, self.F(dH))


# -- helpers ------------------------------------------------------------------------------------------------------


def _at(form, x):
    """A constant, or a function of the state evaluated at x."""
    return jnp.asarray(form(x)) if callable(form) else form


def _state(dim: int):
    return jax.ShapeDtypeStruct((dim,), jnp.float64)


def checked_rate(rate) -> jax.Array:
    """A rate as one non-negative number (or a traced one)."""
    array = real_array(rate)
    if array.shape != ():
        raise InputError(f"a rate is one number, not an array of shape {array.shape}")
    if not isinstance(array, jax.core.Tracer) and not float(array) >= 0.0:
        raise InputError(f"a dissipation rate must be >= 0, not {float(array)}: a negative one would lower the entropy")
    return array


def semidefinite(form, what: str) -> jax.Array:
    """A form as a symmetric positive semidefinite matrix (or a traced one)."""
    matrix = real_array(form)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise InputError(f"{what} must be a square matrix, not an array of shape {matrix.shape}")
    if isinstance(matrix, jax.core.Tracer):
        return matrix
    numbers = np.asarray(matrix)
    scale = float(np.abs(numbers).max())
    asymmetry = float(np.abs(numbers - numbers.T).max())
    if not asymmetry <= 1e-12 * scale:
        raise InputError(f"{what} is not symmetric: it differs from its transpose by {asymmetry:.3g}")
    lowest = float(np.linalg.eigvalsh(numbers)[0]) if np.isfinite(numbers).all() else -np.inf
    if lowest < -1e-12 * scale * matrix.shape[0]:
        raise IndefiniteError(
            f"{what} has the negative eigenvalue {lowest:.3g}: it must be positive semidefinite, or entropy would fall",
            residual=lowest,
            tolerance=1e-12 * scale * matrix.shape[0],
        )
    return matrix


def _check_matrix(form, dim: int, what: str) -> None:
    shape = jax.eval_shape(lambda x: jnp.asarray(_at(form, x)), _state(dim)).shape
    if shape != (dim, dim):
        raise InputError(f"{what} must be a ({dim}, {dim}) matrix for a state of {dim} components, not shape {shape}")


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


def _need_algebra(system: System, name: str, dim: int | None = None) -> mf.LieAlgebra:
    algebra = getattr(system, "algebra", None)
    if algebra is None:
        raise InputError(f"{name} lives on a Lie algebra: use it in a LiePoissonSystem, or take ProjectedMetric()")
    if dim is not None and dim != algebra.dim:
        raise InputError(f"the form of {name} is ({dim}, {dim}), but {algebra.name} has dimension {algebra.dim}")
    return algebra
