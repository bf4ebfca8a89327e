"""Brockett's flow and Toda's lattice, compared to SciPy, and to the QR decomposition of an exponential."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import liethermo as lt


def random_symmetric(n, seed=0):
    a = np.random.default_rng(seed).standard_normal((n, n))
    return (a + a.T) / 2


def run(flow, L, end, step=0.01):
    return lt.integrate(flow, lt.models.hermitian_state(L), (0.0, end), step, method=lt.MetriplecticGauss(3))


def test_state_and_matrix_are_inverse():
    a = np.random.default_rng(1).standard_normal((2, 4, 4))
    L = a[0] + 1j * a[1]
    L = L + L.conj().T
    np.testing.assert_allclose(lt.models.hermitian_matrix(lt.models.hermitian_state(L)), L, atol=1e-14)


def test_flow_is_brocketts_up_to_the_phases():
    N, L0, end = np.diag([1.0, 2.0, 4.0]), random_symmetric(3), 0.7

    def field(t, y):
        L = y.reshape(3, 3)
        inner = L @ N - N @ L
        return (L @ inner - inner @ L).ravel()

    reference = scipy.integrate.solve_ivp(field, (0.0, end), L0.ravel(), rtol=1e-12, atol=1e-13).y[:, -1].reshape(3, 3)
    solution = run(lt.models.sorting_flow(np.diag(N)), L0, end)
    L = np.asarray(lt.models.hermitian_matrix(solution.x[-1]))
    phases = np.exp(1j * np.diag(N) * end)
    turned = phases[:, None] * reference * phases.conj()
    np.testing.assert_allclose(L, turned, atol=1e-9)  # 1e-10 seen
    assert np.abs(L - reference).max() > 1e-2  # control: without the phases they differ


def test_eigenvalues_are_sorted_and_kept():
    L0 = random_symmetric(4, 2)
    solution = run(lt.models.sorting_flow([2.0, 1.0, 4.0, 3.0]), L0, 40.0, 0.02)
    assert solution.audit().passed
    L = np.asarray(lt.models.hermitian_matrix(solution.x[-1]))
    eigenvalues = np.sort(np.linalg.eigvalsh(L0))
    np.testing.assert_allclose(np.linalg.eigvalsh(L), eigenvalues, atol=1e-12)
    np.testing.assert_allclose(np.diag(L).real, eigenvalues[[1, 0, 3, 2]], atol=1e-9)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("n", [3, 4])
def test_toda_is_the_qr_algorithm(n):
    a, b = np.random.default_rng(3).standard_normal((2, n))
    L0 = np.diag(a) + np.diag(np.abs(b[1:]), 1) + np.diag(np.abs(b[1:]), -1)
    end = 1.3
    Q, _ = np.linalg.qr(scipy.linalg.expm(end * L0))
    expected = Q.T @ L0 @ Q
    L = np.asarray(lt.models.hermitian_matrix(run(lt.models.toda_flow(n), L0, end).x[-1]))
    np.testing.assert_allclose(np.diag(L).real, np.diag(expected), atol=1e-9)
    np.testing.assert_allclose(np.abs(np.diag(L, 1)), np.abs(np.diag(expected, 1)), atol=1e-9)
    assert np.abs(np.triu(L, 2)).max() < 1e-12


def test_faults_are_named():
    with pytest.raises(lt.LiethermoError, match="different finite numbers"):
        lt.models.sorting_flow([1.0, 1.0])
    with pytest.raises(lt.LiethermoError, match="Hermitian"):
        lt.models.hermitian_state([[0.0, 1.0], [0.0, 0.0]])
