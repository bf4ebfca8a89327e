"""Networks: many bodies written once, sparse Jacobian matrices, the sparse engine, graphs from files."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st

import liethermo as lt
import manifolds as mf
from liethermo.engines import sparse_engine
from liethermo.functions.gradients import DISCRETE_GRADIENTS, discrete_gradients_at_stages
from liethermo.integrators.tableaus import gauss_tableau
from liethermo.models.thermo_particles import grid_adjacency_matrix, heat_grid_solution
from tests.cases import tolerance
from tests.refusals import refusal_test

seeds = st.integers(0, 10**6)


def warm(x, c):
    return c * jnp.exp(x[-1] / c)


def cart_energy(x, c, m):
    """A body on a line, (q, p, S), of mass m and heat capacity c."""
    return 0.5 * x[1] ** 2 / m + warm(x, c)


def spring(y, k):
    """Between q and q', softer where it is warm: k is its stiffness; y is (q, q', S)."""
    return 0.5 * k * (y[0] - y[1] - 1.0) ** 2 * jnp.exp(-0.1 * y[2]) + 0.05 * k * (y[0] - y[1]) ** 4


def star_and_ring(n):
    """Node 0 is joined to all others, which form a ring."""
    ring = [(i, i % (n - 1) + 1, 0.5 + 0.1 * (i % 3)) for i in range(1, n)]
    return [(0, i, 1.0) for i in range(1, n)] + ring


def network(n=6):
    """Bodies on a line with springs, friction, drag and heat; everything random."""
    rng = np.random.default_rng(0)
    bodies = lt.Copies(
        n, cart_energy, 3, (rng.uniform(0.5, 2.0, n), rng.uniform(0.5, 2.0, n)), friction=rng.random((n, 1))
    )
    i = 3 * np.arange(n - 1)
    springs = lt.Each(spring, np.stack([i, i + 3, i + 2], axis=1), rng.uniform(0.5, 2.0, n - 1))
    drag = [(0, 2, 0.3), (1, 4, 0.5)]
    return lt.ComposedSystem(bodies, springs, star_and_ring(n), drag, validate=False)


def random_state(n):
    return 0.5 * np.random.default_rng(0).standard_normal(3 * n)


def assert_both_laws(solution, content=0.0):
    """``content`` is the energy that the zero of H leaves out, but not its rounding."""
    size = abs(solution.energy[0])
    assert solution.audit().energy_drift * size <= tolerance("energy") * (size + content)
    assert solution.stats.least_entropy_increment >= -tolerance("entropy") * np.abs(solution.entropy).max()


# -- many energies in one ---------------------------------------------------------------------------------------------


@eqx.filter_jit
def value_and_gradients(energy, x, d, k):
    """Value, gradient and all discrete gradients."""
    A, b, _ = gauss_tableau(2)
    stages = discrete_gradients_at_stages(energy, x, 0.0 * x, 0.1, k, A, b)
    return [energy.value(x), energy.gradient(x), *(g(energy, x, d) for g in DISCRETE_GRADIENTS.values()), stages]


@pytest.mark.slow
@pytest.mark.parametrize(
    "run", [pytest.param(True, marks=pytest.mark.slow, id="in order"), pytest.param(False, id="anywhere")]
)
def test_each_is_the_sum_of_its_summands(run):
    """In value, gradients and all discrete gradients, also where summands share components."""
    rng = np.random.default_rng(3)
    places = np.arange(6).reshape(2, 3) if run else np.array([[0, 1, 2], [4, 1, 3], [5, 0, 1]])
    k = rng.uniform(0.5, 2.0, len(places))
    many = lt.Each(spring, places, k)
    apart = [lt.Function(lambda y, a=a: spring(y, a)).on(at) for at, a in zip(places, k, strict=True)]
    x, d, slopes = rng.standard_normal(6), 0.1 * rng.standard_normal(6), rng.standard_normal((2, 6))
    for one, other in zip(
        value_and_gradients(many, x, d, slopes),
        value_and_gradients(sum(apart[1:], apart[0]), x, d, slopes),
        strict=True,
    ):
        assert np.allclose(one, other, rtol=0, atol=1e-13)


def test_each_of_an_energy():
    """An Energy of several terms, quadratic ones recognised."""
    energy = lt.Each(lt.Kinetic([0.5]) + lt.Function(lambda y: jnp.exp(y[2])), np.arange(6).reshape(2, 3))
    assert [term.is_quadratic for term in energy.terms] == [True, False]
    assert lt.Each(lambda y, a: a * y[0] ** 2, [[1], [2]], [1.0, 2.0]).is_quadratic
    x = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    assert float(energy(x)) == pytest.approx(0.25 * (0.04 + 0.25) + np.exp(0.3) + np.exp(0.6), rel=1e-15)


test_unusable_copies = refusal_test(
    (lambda: lt.Each(spring, [0, 1, 2], [1.0]), r"shape \(m, r\)"),
    (lambda: lt.Each(spring, [[0.5, 1.0, 2.0]], [1.0]), "integers"),
    (lambda: lt.Each(spring, [[0, 1, 2]], [1.0, 2.0]), "entry for each of the 1 places"),
    (lambda: lt.Each(lt.Quadratic(np.ones(3)), [[0, 1, 2]], [1.0]), "equal at every place"),
    (lambda: lt.ComposedSystem(lt.Copies(2, None, 3), lt.Each(spring, [[0, 3, 9]], [1.0])), "at component 9, but"),
    (lambda: lt.Copies(0, None, 3), "integer >= 1"),
    (lambda: lt.Copies(2, None, 2), r"2n \+ 1"),
    (lambda: lt.Copies(2, None, 1, friction=1.0), "with 0 momenta"),
    (lambda: lt.Copies(2, None, 3, friction=np.ones((3, 1))), r"\(2, 1\), got \(3, 1\)"),
    (lambda: lt.Copies(2, None, 3, friction=-1.0), ">= 0, got -1"),
    (lambda: lt.Copies(3, warm, 1, [1.0, 2.0]), "each of the 3"),
)


@pytest.mark.slow
def test_copies_are_subsystems():
    """Copies have the field of bodies given one by one; states in one array, names with numbers."""
    c, m, R = np.array([1.0, 2.0, 0.5]), np.array([0.7, 1.1, 2.0]), np.array([[0.3], [0.0], [0.4]])
    stone = lt.Subsystem(lambda x: jnp.exp(x[0]), 1, name="stone")
    heat = [(0, 1, 0.5), (1, 2, 1.0), (2, 3, 2.0)]
    many = lt.ComposedSystem([stone, lt.Copies(3, cart_energy, 3, (c, m), R, "cart")], conductance=heat)
    one = [
        lt.Subsystem(lambda x, c=c_a, m=m_a: cart_energy(x, c, m), 3, R_a)
        for c_a, m_a, R_a in zip(c, m, R, strict=True)
    ]
    apart = lt.ComposedSystem([stone, *one], conductance=heat)
    x = 0.5 * np.random.default_rng(0).standard_normal((2, 10))
    assert np.allclose(many.vector_field(x), apart.vector_field(x), rtol=0, atol=1e-14)
    assert many.names == ("stone", "cart 0", "cart 1", "cart 2")
    assert [part.shape for part in many.split(x)] == [(2, 1), (2, 3, 3)]
    assert many.check().passed
    contact = lt.ComposedSystem(
        lt.Copies(2, lt.Kinetic([0.5]) + lt.Function(warm_of_one).on([2]), 3, friction="contact")
    )
    assert contact.entropy_law == "nondecreasing"
    assert lt.ComposedSystem(lt.Copies(2, cart_energy, 3, (c[:2], m[:2]), "contact")).entropy_law is None


def warm_of_one(y):
    return jnp.exp(y[0])


# -- sparse Jacobian matrices -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2)], ids=str)
def test_the_compressed_jacobian_is_the_jacobian(method):
    """With a hub that is found by pulling back; and every entry of the pattern is one that can occur."""
    n, h = 12, 0.1
    system = network(n)
    pattern, x = system.sparse_newton.find_pattern(), jnp.asarray(random_state(n))
    slopes = eqx.filter_jit(lambda k: method.slopes(system, x, 0.0 * x, h, k))
    k = jnp.asarray(np.random.default_rng(1).standard_normal((method.stages, 3 * n)))
    compression = sparse_engine.JacobianCompression(pattern, method.stages)
    assert 0 < len(compression.dense_rows) < 6
    assert compression.n_derivatives < 0.8 * k.size
    push = jax.jit(lambda seed: jax.jvp(slopes, (k,), (seed,))[1])
    pull = jax.jit(lambda seed: jax.vjp(slopes, k)[1](seed)[0])
    found_values = compression.assemble_jacobian(push, pull)
    exact = np.asarray(jax.jacfwd(slopes)(k)).reshape(k.size, k.size)
    # rounding in derivatives of the quotient (H(x') - H(x)) / |d|^2: 6e-14 seen
    assert np.abs(found_values.toarray() - exact).max() <= 3e-13 * np.abs(exact).max()
    here = np.kron(np.ones((method.stages,) * 2, dtype=bool), pattern.toarray())
    assert not exact[~here].any()
    assert (exact != 0).sum() > 0.6 * here.sum()


@given(seed=seeds)
def test_colours(seed):
    """No row has two columns of one colour, and a plane grid needs few."""
    rng = np.random.default_rng(seed)
    pattern = scipy.sparse.random_array((40, 40), density=0.1, rng=rng, format="csr") + scipy.sparse.eye_array(40)
    compression = sparse_engine.JacobianCompression(scipy.sparse.csr_array(pattern))
    for i in set(range(40)) - set(compression.dense_rows.tolist()):
        colours = compression.colours[pattern.indices[pattern.indptr[i] : pattern.indptr[i + 1]]]
        assert len(set(colours)) == len(colours)
    grid = sparse_engine.JacobianCompression(
        scipy.sparse.csr_array(grid_adjacency_matrix((9, 9)) + scipy.sparse.eye_array(81))
    )
    assert grid.n_derivatives <= 9
    assert grid.front_width == 9


@pytest.mark.parametrize("widest", [1000, 0], ids=["factorised", "Krylov"])
def test_inverses(widest, monkeypatch):
    monkeypatch.setattr(sparse_engine, "MAX_FRONT_WIDTH", widest)
    rng = np.random.default_rng(0)
    A = scipy.sparse.csc_array(scipy.sparse.eye_array(50) + 3.0 * grid_laplacian((5, 10)))
    x = rng.standard_normal(50)
    assert np.abs(sparse_engine.SparseLinearSolver(A, 5)(A @ x) - x).max() < (1e-13 if widest else 1e-4)
    bad = A.copy()
    bad.data[3] = np.nan
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        sparse_engine.SparseLinearSolver(bad, 5)


test_a_singular_matrix = refusal_test(
    (lambda: sparse_engine.SparseLinearSolver(scipy.sparse.csc_array(np.diag([1.0, 0.0])), 1), "singular"),
    error=np.linalg.LinAlgError,
)


def grid_laplacian(shape):
    graph = grid_adjacency_matrix(shape)
    return scipy.sparse.diags_array(graph.sum(axis=1)) - graph


# -- the sparse engine ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.05, 2.0], ids=["fixed point", "Newton"])
def test_the_engines_agree(h):
    """On a network with everything in it, by either way to solve a step."""
    system, x0 = network(), random_state(6)
    runs = [lt.integrate(system, x0, (0.0, 10 * h), h, engine=engine) for engine in ("array", "sparse")]
    assert np.abs(runs[0].x - runs[1].x).max() < 1e-12 * np.abs(runs[0].x).max()
    assert runs[1].provenance["engine"] == "sparse"
    assert (runs[1].stats.newton_iterations > 0) is (h > 1.0)
    assert_both_laws(runs[1])


@pytest.mark.slow
def test_every_solver_solves_the_same_steps(monkeypatch):
    """And both solve those of the array engine; here steps that are stiff, but not too stiff for that."""
    system, x0 = lt.models.heat_grid((5, 4)), np.log(np.random.default_rng(0).uniform(200.0, 400.0, 20))
    dense = lt.integrate(system, x0, (0.0, 10.0), 2.0, engine="array")
    factorised = lt.integrate(system, x0, (0.0, 10.0), 2.0, engine="sparse")
    monkeypatch.setattr(sparse_engine, "MAX_FRONT_WIDTH", 0)
    krylov = lt.integrate(system, x0, (0.0, 10.0), 2.0, engine="sparse")
    assert dense.stats.newton_iterations > 0
    assert krylov.stats.newton_iterations > 0
    assert np.abs(factorised.x - dense.x).max() < 1e-12
    assert np.abs(factorised.x - krylov.x).max() < 1e-12
    assert_both_laws(krylov)


@pytest.mark.slow
def test_other_ways_to_run_it():
    """Adaptive steps, outputs at given times, an event; steps saved now and then."""
    system, x0 = network(), random_state(6)
    assert lt.integrate(system, x0, (0.0, 1.0), 0.1, save_every=4, engine="sparse").t.tolist() == [0.0, 0.4, 0.8, 1.0]
    adaptive = lt.integrate(system, x0, (0.0, 1.0), lt.Adaptive(1e-4), save_at=[0.5], engine="sparse")
    assert adaptive.t.tolist() == [0.0, 0.5, 1.0]
    assert_both_laws(adaptive)


class EnergyOf02(lt.Energy):
    """An energy written for version 0.2, where the pattern of the Hessian was named ``couplings``."""

    def value(self, x):
        return x[0] * x[1]

    def couplings(self, dim):
        return scipy.sparse.csr_array(([True, True], ([0, 1], [1, 0])), (dim, dim))


class FrictionOf02(lt.Dissipation):
    """A friction written for version 0.2, where the pattern of the force was named ``couplings``."""

    def force(self, system, x, dH, dS, dL):
        return -dH

    def couplings(self, system):
        return scipy.sparse.eye_array(system.dim, dtype=bool, format="csr")


def test_patterns_with_their_names_of_02_are_used():
    energy = lt.Quadratic([0.0, 0.0, 1.0]) + EnergyOf02()
    np.testing.assert_array_equal(energy.hessian_pattern(3).toarray(), [[0, 1, 0], [1, 0, 0], [0, 0, 1]])
    system = lt.MetriplecticSystem(mf.NoPoisson(3), energy)
    np.testing.assert_array_equal((FrictionOf02() + FrictionOf02()).force_pattern(system).toarray(), np.eye(3))
    assert (FrictionOf02() + lt.Friction(np.eye(3))).force_pattern(system) is None


def test_the_sparse_engine_needs_a_sparsity():
    """The sparse one, asked for where the sparsity is not known: an error says why."""
    bodies = [lt.Subsystem(lambda x: jnp.exp(x[0]), 1) for _ in range(2)]
    coupled = lt.ComposedSystem(bodies, lt.Function(lambda y: y[0] ** 2).on(lambda x: x[:1] - x[1:]), 1.0)
    assert coupled.sparse_newton.find_pattern() is None
    with pytest.raises(
        lt.InputError, match=r"does not know its sparsity\. Build the system as a ComposedSystem of lt\.Copies"
    ):
        lt.integrate(coupled, [0.1, 0.2], (0.0, 1.0), 0.1, engine="sparse")


@pytest.mark.slow
def test_a_step_that_is_refused():
    """T = S: where a step finds no positive temperatures the run stops, with the trajectory so far and a reason."""
    n = 5
    bodies = lt.Copies(n, lambda x: 0.5 * x[0] ** 2, 1, name="odd")
    system = lt.ComposedSystem(bodies, conductance=grid_adjacency_matrix((n,)), validate=False)
    x0 = np.array([1.0, 0.01, 0.01, 0.01, 0.01])
    solution = lt.integrate(system, x0, (0.0, 40.0), 4.0, on_failure="return", engine="sparse")
    assert not solution.status.ok
    assert solution.status.message
    with pytest.raises(
        lt.InputError, match=r"temperature of odd 1 is -1.*odd 2.*odd 3.*1 more temperatures are not positive"
    ):
        lt.integrate(system, [1.0, -1.0, -1.0, -1.0, -1.0], (0.0, 1.0), 0.1)


# -- heat on a grid ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_exact_heat_grid():
    """Against the exponential of the matrix; 3 by 4 nodes."""
    T = np.random.default_rng(0).uniform(200.0, 400.0, (3, 4))
    expected_values = scipy.linalg.expm(-0.7 * 0.5 / 2.0 * grid_laplacian((3, 4)).toarray()) @ T.ravel()
    assert np.allclose(heat_grid_solution(0.7, T, 2.0, 0.5).ravel(), expected_values, rtol=1e-14)
    system, dt = lt.models.heat_grid((3, 4), 2.0, 0.5), 1e-5
    rates = np.asarray(system.vector_field(2.0 * np.log(T).ravel())).reshape(3, 4) * T / 2.0
    difference = heat_grid_solution(dt, T, 2.0, 0.5) - heat_grid_solution(-dt, T, 2.0, 0.5)
    assert np.allclose(difference / (2 * dt), rates, rtol=1e-6)


def heat_run(shape, h, steps, **options):
    T = np.random.default_rng(0).uniform(250.0, 350.0, shape)
    system = lt.models.heat_grid(shape)
    return T, lt.integrate(system, np.log(T).ravel(), (0.0, steps * h), h, **options)


@pytest.mark.slow
def test_heat_grid():
    """To second order in steps that follow the heat, and with both laws in steps a thousand times as long."""
    errors = []
    for steps in (10, 20, 40):
        T, solution = heat_run((20, 20), 1.0 / steps, steps, save_every=steps)
        errors.append(np.abs(np.exp(solution.x[-1]).reshape(20, 20) - heat_grid_solution(1.0, T)).max())
        assert_both_laws(solution)
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(slopes - 2.0) < 0.2).all(), errors
    _, stiff = heat_run((20, 20), 1000.0, 5)
    assert stiff.provenance["engine"] == "sparse"  # from 200 components on
    assert stiff.stats.newton_iterations > 0
    assert_both_laws(stiff)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_stiff_steps_of_a_few_bodies(engine):
    """Whole Newton steps leave the domain of these; halved ones do not."""
    grid, x0 = lt.models.heat_grid((3, 3)), np.random.default_rng(0).uniform(-0.5, 0.5, 9)
    solution = lt.integrate(grid, x0, (0.0, 900.0), 300.0, engine=engine)
    assert_both_laws(solution)
    same = lt.integrate(grid, x0, (0.0, 900.0), 300.0, engine="sparse")
    assert np.abs(solution.x - same.x).max() <= 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(316, 317), (46, 46, 48)], ids=["plane", "space"])
@pytest.mark.parametrize("h", [1.0, 100.0])
def test_a_hundred_thousand_nodes(shape, h, tmp_path):
    """Both laws to rounding at every step; seconds a step."""
    _, solution = heat_run(shape, h, 4, save_every=4)
    assert solution.x.shape[1] > 100_000
    assert_both_laws(solution)
    assert solution.stats.wall_time < 240.0
    assert len(lt.load(solution.save(tmp_path / "heat.nc")).t) == 2


@pytest.mark.slow
def test_a_large_chain():
    """The N-body chain with 70 springs: angular momentum too, by the sparse engine."""
    chain = lt.models.thermoelastic_chain(70, 2, stiffness=20.0, expansion=2.0)
    x0 = np.zeros((70, 5))
    x0[:, 0] = 1.05 * np.arange(1, 71)
    x0[:, 3] = 0.01 * np.arange(1, 71)
    solution = lt.integrate(chain, x0.ravel(), (0.0, 1.0), 0.1)
    assert solution.provenance["engine"] == "sparse"
    assert_both_laws(solution, content=np.sum(chain.temperatures(solution.x[0])))  # times a capacity of 1
    momentum = solution.casimirs["angular momentum xy"]
    assert np.abs(momentum - momentum[0]).max() <= tolerance("casimir") * momentum[0]


def test_a_large_system_is_checked_without_its_matrices():
    report = lt.models.heat_grid((15, 15)).check()
    assert report.passed
    assert "K >= 0" not in str(report)
    assert "energy law" in str(report)


# -- graphs from files ------------------------------------------------------------------------------------------------

CSV = "source,target,conductance\n0,1,1.5\n10,1,2\n"


def write_file(tmp_path, text, name="graph.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_csv_file(tmp_path):
    graph = lt.read_graph(write_file(tmp_path, CSV))
    assert graph.names == ("0", "1", "10")
    assert graph.matrix.toarray().tolist() == [[0.0, 1.5, 0.0], [1.5, 0.0, 2.0], [0.0, 2.0, 0.0]]
    named = "a, source, target, w\n1, wall, air, 2\n2, window, air, 3\n"
    graph = lt.read_graph(write_file(tmp_path, named), weight="w")
    assert graph.names == ("wall", "air", "window")
    ordered = lt.read_graph(write_file(tmp_path, named), weight="w", nodes=["air", "wall", "window"])
    assert ordered.matrix.toarray()[0].tolist() == [0.0, 2.0, 3.0]
    assert len(ordered) == 3
    system = lt.models.thermo_particles(np.ones(3), ordered.matrix)
    T = np.exp([0.1, 0.5, -0.3])
    expected_values = ordered.matrix @ T - ordered.matrix.sum(axis=1) * T  # T S'
    assert np.allclose(system.vector_field(np.log(T)) * T, expected_values, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (CSV, {"nodes": 3}, "line 3: there is no node '10' among the 3"),
        (CSV, {"nodes": ["0", "1"]}, "no node '10'"),
        (CSV, {"nodes": ["0", "0", "1"]}, "given twice"),
        (CSV + "1,,2\n", {}, "line 4.*one of them is missing"),
        (CSV + "1,2\n", {}, "line 4: the conductance is None"),
        (CSV + "1,2,fast\n", {}, "'fast', not a number"),
        (CSV + "1,2,-2\n", {}, "between 1 and 2 must be finite and >= 0, got -2"),
        (CSV + "1,2,nan\n", {}, "finite"),
        (CSV + "1,10,3\n", {}, "given twice"),
        (CSV + "1,1,3\n", {}, "with itself"),
        ("a,b\n1,2\n", {}, "must have a column 'source', got a, b"),
        ("source,target,conductance\n", {}, "no nodes"),
    ],
)
def test_unusable_files(tmp_path, text, options, words):
    with pytest.raises(lt.InputError, match=words):
        lt.read_graph(write_file(tmp_path, text), **options)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(lt.FileError, match="there is no file"):
        lt.read_graph(tmp_path / "none.csv")
    with pytest.raises(lt.FileError, match=r"must be .csv or .graphml, got"):
        lt.read_graph(write_file(tmp_path, CSV, "graph.txt"))
    (tmp_path / "binary.csv").write_bytes(b"source,target,conductance\n\xff\xfe,1,2\n")
    with pytest.raises(lt.FileError, match="cannot be read as CSV"):
        lt.read_graph(tmp_path / "binary.csv")


GRAPHML = """<?xml version="1.0" encoding="utf-8"?>
<graphml xmlns="http://graphml.graphdrawing.org/xmlns">
  <key id="k" for="edge" attr.name="conductance" attr.type="double"/>
  <graph edgedefault="undirected">
    <node id="wall"/><node id="air"/>
    <edge source="wall" target="air"><data key="k">2.5</data></edge>MORE
  </graph>
</graphml>
"""


def test_graphml_needs_networkx(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "networkx", None)
    with pytest.raises(lt.FileError, match=r"pip install networkx$"):
        lt.read_graph(write_file(tmp_path, GRAPHML.replace("MORE", ""), "g.graphml"))


def test_a_graphml_file(tmp_path):
    graph = lt.read_graph(write_file(tmp_path, GRAPHML.replace("MORE", ""), "g.graphml"))
    assert graph.names == ("wall", "air")
    assert graph.matrix.toarray().tolist() == [[0.0, 2.5], [2.5, 0.0]]
    more = '<edge source="air" target="window"><data key="k">1</data></edge>'
    with pytest.raises(lt.InputError, match="no node 'window' among the 2"):
        lt.read_graph(write_file(tmp_path, GRAPHML.replace("MORE", more), "g.graphml"))
    with pytest.raises(lt.FileError, match="cannot be read as GraphML"):
        lt.read_graph(write_file(tmp_path, GRAPHML[:200], "g.graphml"))
    bare = GRAPHML.replace("MORE", "").replace('<data key="k">2.5</data>', "")
    with pytest.raises(lt.InputError, match="the conductance is None, not a number"):
        lt.read_graph(write_file(tmp_path, bare, "g.graphml"))


def particles(conductance):
    return lt.ComposedSystem(lt.Copies(6, warm, 1, np.ones(6), name="node"), conductance=conductance)


def test_a_network_that_falls_apart():
    with pytest.raises(lt.InputError, match=r"3 parts that exchange no heat.*node 0 and node 1.*connected=False"):
        particles([(0, 1, 1.0), (2, 3, 1.0), (4, 5, 1.0)])
    lopsided = grid_adjacency_matrix((6,)).tolil()
    lopsided[0, 1] = 2.0
    with pytest.raises(lt.InputError, match=r"must be symmetric.*by 1"):
        particles(lopsided.tocsr())
    with pytest.raises(lt.InputError, match="between node 0 and node 1 must be finite and >= 0, got -1"):
        particles(-1.0 * grid_adjacency_matrix((6,)))
