"""Define the cases on which the shared property suite runs, and its tolerances.

An algebra or a method takes part as soon as the library registers it, a dissipation as soon as it is listed in
``DISSIPATIONS`` below. Every property then runs on it. Exemptions carry a reason.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf
from liethermo.functions.energy import make_energy

EPS = float(np.finfo(float).eps)

TOLERANCES = {
    # name: (bound, what was measured and why)
    "axiom": (1e-12, "at most 2e-13 seen: sums of dim^2 products of numbers of order one"),
    "energy": (2e-14, "relative drift over 40 steps; at most 5e-15 seen, up to ten roundings of H"),
    "entropy": (4 * EPS, "relative to max |S|: roundings of S itself at its maximum"),
    "casimir": (2e-14, "relative drift of quadratic Casimirs over 40 steps; at most 5e-15 seen"),
    "kernel": (1e-14, "|K_d dgrad H| relative to |K_d| |dgrad H|; at most 2e-15 seen"),
}


def max_abs(a) -> float:
    """Return the largest absolute value of an array, 0 if it is empty."""
    return float(np.abs(np.asarray(a)).max(initial=0.0))


def tolerance(name: str) -> float:
    return TOLERANCES[name][0]


class BuiltOnUse(Mapping):
    """Mapping from names to objects that are built when they are first asked for: collecting the tests builds
    nothing."""

    def __init__(self, makers: Mapping[str, Callable]) -> None:
        self._makers = dict(makers)
        self._built: dict = {}

    def __getitem__(self, name: str):
        if name not in self._built:
            self._built[name] = self._makers[name]()
        return self._built[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


ALGEBRAS = list(mf.registered())


def algebra_id(g: mf.LieAlgebra) -> str:
    return g.name


# -- entropies --------------------------------------------------------------------------------------------------------


def _bianchi_iv(mu):  # e1 moves (mu2, mu3) by (mu2 + mu3, mu3)
    return mu[1] / mu[2] - jnp.log(mu[2])


def _bianchi_v(mu):  # by (mu2, mu3)
    return mu[1] / mu[2]


def _bianchi_vi(a: float) -> Callable:  # mu2 + mu3 grows at rate a - 1, mu2 - mu3 at rate a + 1
    return lambda mu: (a + 1) * jnp.log(mu[1] + mu[2]) - (a - 1) * jnp.log(mu[1] - mu[2])


def _bianchi_vii(a: float) -> Callable:  # a spiral: the radius grows at rate a, the angle falls at rate 1
    return lambda mu: 0.5 * jnp.log(mu[1] ** 2 + mu[2] ** 2) + a * jnp.arctan2(mu[2], mu[1])


TRANSCENDENTAL = {
    "bianchi('IV')": (_bianchi_iv, [0.3, 0.4, 1.5]),
    "bianchi('V')": (_bianchi_v, [0.3, 0.4, 1.5]),
    "bianchi('VI', h=-0.25)": (_bianchi_vi(0.5), [0.3, 1.5, 0.2]),
    "bianchi('VI', h=-0.5)": (_bianchi_vi(0.5**0.5), [0.3, 1.5, 0.2]),
    "bianchi('VII', h=1)": (_bianchi_vii(1.0), [0.3, 1.5, 0.2]),
    "bianchi('VII', h=0.3)": (_bianchi_vii(0.3**0.5), [0.3, 1.5, 0.2]),
}
"""Casimirs that are not polynomials, each with a state inside its domain."""


def entropy_of(g: mf.LieAlgebra):
    """Return a Casimir of lowest degree as the entropy, or None for an algebra without any."""
    if g.casimir_count() == 0:
        return None
    if g.name in TRANSCENDENTAL:
        return TRANSCENDENTAL[g.name][0]
    for degree in (1, 2, 3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", mf.NoPolynomialCasimirWarning)
            casimirs = g.casimirs(degree)
        if casimirs:
            # of several quadratic ones the sum: se(3) has |p|^2 and l.p
            return make_energy(casimirs[0], "S")
    raise AssertionError(f"no Casimir known for {g.name}: add one to TRANSCENDENTAL")


def state_of(g: mf.LieAlgebra, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if g.name in TRANSCENDENTAL:
        return np.array(TRANSCENDENTAL[g.name][1]) + 0.05 * rng.standard_normal(g.dim)
    return rng.standard_normal(g.dim)


def energy_of(dim: int, seed: int):
    """Return a random nonlinear energy: a positive quadratic part, a quartic and a cosine."""
    rng = np.random.default_rng(1000 + seed)
    root = rng.standard_normal((dim, dim)) / np.sqrt(dim)
    A, b, c = root @ root.T + np.eye(dim), rng.standard_normal(dim), rng.standard_normal(dim)
    return lt.Quadratic(A) + lt.Function(
        lambda mu: 0.05 * jnp.dot(b, mu) ** 4 / dim + 0.3 * jnp.cos(jnp.dot(c, mu) / jnp.sqrt(1.0 * dim))
    )


# -- dissipations -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """Dissipation as the suite runs it: how to build it for an algebra and an energy."""

    name: str
    build: Callable  # (algebra, energy, rng) -> Dissipation
    exempt: Callable = lambda g: None  # a reason, where it does not apply to an algebra


def _spd(rng, n):
    root = rng.standard_normal((n, n)) / np.sqrt(n)
    return root @ root.T + 0.5 * np.eye(n)


def _friction_operator(g, energy, rng):
    """Return a friction operator K(x) of the suite's own: two squared vectors orthogonal to grad H."""
    vectors = rng.standard_normal((2, g.dim))

    def K(x):
        dH = energy.gradient(x)
        rows = vectors - (vectors @ dH)[:, None] * dH / jnp.dot(dH, dH)
        return rows.T @ rows

    return lt.FrictionOperator(K, rate=0.2)


def _curvature_tensor(g, energy, rng):
    """Return a tensor with the symmetries of a curvature: the sum of A (x) A over antisymmetric A, so that (F, F) >=
    0."""
    A = rng.standard_normal((3, g.dim, g.dim)) / g.dim
    A = A - A.swapaxes(1, 2)
    return lt.FourBracket(np.einsum("aij,akl->ijkl", A, A))


def _killing_exemption(g: mf.LieAlgebra) -> str | None:
    if g.is_semisimple():
        return None
    if np.linalg.eigvalsh(-g.killing_form())[0] < -1e-10:
        return "minus the Killing form is indefinite"
    return "the Killing form vanishes on brackets (Cartan's criterion)" if g.is_solvable() else None


def _dimension_exemption(g: mf.LieAlgebra) -> str | None:
    return "a line has no covector beside dH: K is the rounding error of zero" if g.dim < 2 else None


def _abelian_exemption(g: mf.LieAlgebra) -> str | None:
    return "nothing brackets to anything in an abelian algebra" if g.is_abelian() else None


DISSIPATIONS = [
    Case("killing", lambda g, H, rng: lt.KillingDissipation(rate=0.3 / g.dim), _killing_exemption),
    Case("inner_product", lambda g, H, rng: lt.InnerProductDissipation(0.3 * _spd(rng, g.dim)), _abelian_exemption),
    Case("projected", lambda g, H, rng: lt.ProjectedMetric(rate=0.1)),
    Case("projected_cometric", lambda g, H, rng: lt.ProjectedMetric(0.3 * _spd(rng, g.dim)), _dimension_exemption),
    Case("projected_normalized", lambda g, H, rng: lt.ProjectedMetric(normalized=True, rate=0.3), _dimension_exemption),
    Case(
        "projected_preserve",
        lambda g, H, rng: lt.ProjectedMetric(preserve=(lt.Quadratic(_spd(rng, g.dim)),), normalized=True, rate=0.3),
        lambda g: "one dimension leaves no room beside H and another function" if g.dim < 3 else None,
    ),
    Case("friction_operator", _friction_operator, _dimension_exemption),
    Case(
        "kulkarni_nomizu",
        lambda g, H, rng: lt.FourBracket.kulkarni_nomizu(0.1 * _spd(rng, g.dim), _spd(rng, g.dim)),
        _dimension_exemption,
    ),
    Case("four_bracket", _curvature_tensor),
    Case("four_bracket_algebra", lambda g, H, rng: lt.FourBracket.lie_algebra(0.3 * np.eye(g.dim)), _abelian_exemption),
    Case(
        "potential_coulomb",
        lambda g, H, rng: lt.DissipationPotential(lt.CoulombFriction(0.3, 0.1)),
        _dimension_exemption,
    ),
    Case(
        "potential_power_law",
        lambda g, H, rng: lt.DissipationPotential(
            lt.PowerLawFriction(2.5, 0.2, each=True), of=lt.ProjectedMetric(0.3 * _spd(rng, g.dim))
        ),
        _dimension_exemption,
    ),
    Case(
        "potential_activated",
        lambda g, H, rng: lt.DissipationPotential(
            lt.ActivatedFriction(0.3, 2.0), of=lt.InnerProductDissipation(0.1 * _spd(rng, g.dim))
        ),
        _abelian_exemption,
    ),
    Case("double_bracket", lambda g, H, rng: lt.DoubleBracket(rate=0.1), _abelian_exemption),
    Case("force", lambda g, H, rng: lt.EulerPoincareForce(lambda xi: 0.1 * jnp.sin(xi[::-1])), _abelian_exemption),
    Case(
        "sum",
        lambda g, H, rng: (
            lt.ProjectedMetric(rate=0.05) + lt.FourBracket.kulkarni_nomizu(0.03 * np.eye(g.dim), np.eye(g.dim))
        ),
    ),
]


def build(g: mf.LieAlgebra, case: Case, seed: int = 0) -> lt.LiePoissonSystem:
    """Return the system of a case.

    Where S has a domain, the axioms are not checked at random points here: the tests do it.
    """
    energy, rng = energy_of(g.dim, seed), np.random.default_rng(seed)
    return lt.LiePoissonSystem(
        g, energy, entropy_of(g), case.build(g, energy, rng), validate=g.name not in TRANSCENDENTAL
    )


REPRESENTATIVE = [mf.so(3), mf.se(3), mf.sl(2), mf.su(3)]
"""Compact, semidirect, noncompact and irrational algebras: enough for properties that do not depend on the algebra."""


def slow_case(case):
    """Return a parameter of a test, or a set of parameters, marked for the slow tier."""
    import pytest

    values, name = (case.values, case.id) if hasattr(case, "values") else ((case,), None)
    return pytest.param(*values, id=name, marks=pytest.mark.slow)


def combinations(algebras) -> list:
    """Return all (algebra, dissipation) pairs that apply: an algebra without a Casimir has no entropy to produce."""
    import pytest

    return [
        pytest.param(g, case, id=f"{g.name}-{case.name}")
        for g in algebras
        if g.casimir_count() > 0
        for case in DISSIPATIONS
        if case.exempt(g) is None
    ]


def kind_of(g: mf.LieAlgebra) -> tuple:
    """Return what a dissipation or a method may depend on in an algebra."""
    return g.name in TRANSCENDENTAL, g.is_abelian(), g.is_nilpotent(), g.is_solvable(), g.is_semisimple()


def covering(cases, keys: Callable) -> list:
    """Return some of the cases that together have every key of all of them: few, and the same each time.

    ``keys(*values)`` returns the keys of a case. Where they are pairs of its values, every value of one argument meets
    every value of another, which a product of three arguments does many times over.
    """
    cases, chosen_indices = list(cases), set[int]()
    found_keys: set = set()
    case_keys = [set(keys(*getattr(case, "values", case))) for case in cases]
    for least_new_count in range(max(map(len, case_keys)), 0, -1):
        for i, own_keys in enumerate(case_keys):
            if len(own_keys - found_keys) >= least_new_count:
                chosen_indices.add(i)
                found_keys |= own_keys
    return [cases[i] for i in sorted(chosen_indices)]


def few_combinations(**values):
    """Return a mark that gives a test few combinations of its arguments.

    Of three arguments each pair of values meets in some case; of two, each value has a case.
    """
    import pytest

    cases = list(itertools.product(*(range(len(of_argument)) for of_argument in values.values())))
    chosen = covering(cases, lambda *case: itertools.combinations(enumerate(case), len(case) - 1))
    combinations_of_values = [
        tuple(list(of_argument)[i] for of_argument, i in zip(values.values(), case, strict=True)) for case in chosen
    ]

    def case_name(value) -> str:
        return getattr(value, "__name__", None) or str(value)

    return pytest.mark.parametrize(tuple(values), combinations_of_values, ids=case_name)


def rows(audit, law):
    return [row for row in audit.rows if row.law.startswith(law)]


def only_row(audit, law):
    (row,) = rows(audit, law)
    return row
