"""diffrax runs systems of the library with its own solvers and with methods of the library."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt

diffrax = pytest.importorskip("diffrax")

X0 = jnp.array([0.1, 0.2, 1.0])


def body(rate=0.3):
    return lt.models.rigid_body((3.0, 2.0, 1.0), rate=rate)


def solve(system, solver, h=0.1, end=2.0, **options):
    options.setdefault("stepsize_controller", diffrax.ConstantStepSize())
    return diffrax.diffeqsolve(
        lt.diffrax.Term(system), solver, 0.0, end, h, X0, saveat=diffrax.SaveAt(steps=True), **options
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)], ids=str)
def test_a_run_by_diffrax_is_ours(method):
    system = body()
    theirs = solve(system, lt.diffrax.Solver(method))
    ours = lt.integrate(system, X0, (0.0, 2.0), 0.1, method)
    states = np.asarray(theirs.ys)[np.isfinite(np.asarray(theirs.ts))]
    assert np.abs(states - ours.x[1:]).max() < 1e-14
    assert np.ptp(system.energy(states)) < 1e-15


def test_adaptive_steps_and_diffrax_own_solvers_agree():
    controller = diffrax.PIDController(rtol=1e-8, atol=1e-10)
    ours = solve(body(), lt.diffrax.Solver(lt.MetriplecticRungeKutta(6)), stepsize_controller=controller)
    theirs = solve(body(), diffrax.Dopri8(), stepsize_controller=controller)
    ends = [np.asarray(run.ys)[np.isfinite(np.asarray(run.ts))][-1] for run in (ours, theirs)]
    assert np.abs(ends[0] - ends[1]).max() < 1e-6
    assert int(ours.stats["num_accepted_steps"]) > 3


@pytest.mark.slow
@pytest.mark.parametrize("method", list(lt.registered_methods()), ids=str)
def test_time_runs_backwards(method):
    """Backward runs have the order of the method, against SciPy; energy is constant and the entropy falls."""
    system, solver, T = body(), lt.diffrax.Solver(method), 1.0
    field = jax.jit(lambda x: -system.vector_field(x))
    exact = solve_ivp(lambda _, x: np.asarray(field(x)), (0.0, T), X0, "DOP853", rtol=1e-13, atol=1e-15)
    n_coarse = 8 if method.order < 4 else 3
    ends = []
    for n in (n_coarse, 2 * n_coarse):
        run = diffrax.diffeqsolve(lt.diffrax.Term(system), solver, 0.0, -T, -T / n, X0, throw=False)
        assert run.result == diffrax.RESULTS.successful
        ends.append(run.ys[-1])
    coarse_error, fine_error = (float(np.abs(x - exact.y[:, -1]).max()) for x in ends)
    assert fine_error < 1e-12 or np.log2(coarse_error / fine_error) > method.order - 0.4, (coarse_error, fine_error)
    assert float(system.energy(ends[1])) == pytest.approx(float(system.energy(X0)), rel=1e-14)
    assert float(system.entropy(ends[1])) < float(system.entropy(X0)) - 1e-3


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(6)], ids=str)
def test_adaptive_steps_backwards_are_as_many_as_forwards(method):
    """A reversible motion takes about as many adaptive steps backwards as forwards."""
    system = lt.models.free_rigid_body((3.0, 2.0, 1.0))
    controller = diffrax.PIDController(rtol=1e-8, atol=1e-10)

    def run(x, start, end):
        return diffrax.diffeqsolve(
            lt.diffrax.Term(system), lt.diffrax.Solver(method), start, end, 0.1 * (end - start), x,
            stepsize_controller=controller,
        )  # fmt: skip

    forward_run = run(X0, 0.0, 2.0)
    backward_run = run(forward_run.ys[-1], 2.0, 0.0)
    assert np.abs(backward_run.ys[-1] - X0).max() < 1e-6
    steps = [int(part.stats["num_steps"]) for part in (forward_run, backward_run)]
    assert abs(steps[1] - steps[0]) <= 0.2 * steps[0] + 2, steps


@pytest.mark.slow
def test_reverse_mode_through_diffrax_is_the_derivative_of_the_flow():
    def end(rate):
        run = diffrax.diffeqsolve(
            lt.diffrax.Term(body(rate)), lt.diffrax.Solver(lt.MetriplecticGauss(1)), 0.0, 0.5, 0.1, X0
        )
        return run.ys[-1, 0]

    flow_derivative = jax.grad(lambda rate: lt.flow(body(rate), X0, (0.0, 0.5), 0.1, lt.MetriplecticGauss(1))[0])(0.3)
    assert jax.grad(end)(0.3) == pytest.approx(float(flow_derivative), rel=1e-10)


def test_a_step_that_cannot_be_solved_is_reported():
    run = solve(body(), lt.diffrax.Solver(lt.MetriplecticRungeKutta(4)), h=1e4, end=2e4, throw=False)
    assert run.result != diffrax.RESULTS.successful


def test_an_energy_that_depends_on_time_is_refused():
    driven = lt.LiePoissonSystem(
        lt.models.rigid_body().algebra, lt.TimeDependent(lambda x, t: (1.0 + 0.1 * jnp.sin(t)) * x @ x)
    )
    with pytest.raises(lt.InputError, match="depends on time"):
        solve(driven, lt.diffrax.Solver())
