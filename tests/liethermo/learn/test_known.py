"""Parameters that data determine; files."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
from liethermo.learn import files, training

from . import cases


class EnergyWithOffset(eqx.Module):
    """An energy a p^2/2 + b q^2/2 + c + exp(s): no motion tells c."""

    abc: jax.Array

    def __call__(self, x):
        a, b, c = self.abc
        return 0.5 * a * x[1] ** 2 + 0.5 * b * x[0] ** 2 + c + jnp.exp(x[2])


def test_a_constant_of_the_energy_is_not_determined():
    system = cases.oscillator(energy=lt.learn.Energy(EnergyWithOffset(jnp.array([1.0, 2.0, 3.0]))), friction=None)
    x = np.random.default_rng(0).standard_normal((5, 3))
    determination = lt.learn.determined(system, lambda s: s.vector_field(x))
    assert determination.rank == 2
    np.testing.assert_allclose(np.abs(determination.directions[-1]), [0.0, 0.0, 1.0], atol=1e-12)
    y = jnp.array([0.5, 0.2, 0.1])
    value, difference = determination.share(
        lambda s: jnp.stack([s.energy.value(y), s.energy.value(y) - s.energy.value(0 * y)])
    )
    assert value < 0.3  # mostly c
    assert difference == pytest.approx(1.0, abs=1e-12)


@pytest.mark.slow
def test_a_network_is_determined_where_the_data_are():
    system = cases.oscillator(energy=lt.learn.Energy(3, width=8, depth=1), friction=None)
    x = np.random.default_rng(0).standard_normal((6, 3))
    determination = lt.learn.determined(system, lambda s: s.vector_field(x))
    assert 0 < determination.rank <= 12 < len(determination.values)
    force, constant, heat = (
        determination.share(f)[0]
        for f in (
            lambda s: s.energy.gradient(jnp.asarray(x[0]))[0],
            lambda s: s.energy.value(jnp.asarray(x[0])),
            lambda s: s.energy.gradient(jnp.asarray(x[0]))[2],  # without friction the temperature moves nothing
        )
    )
    assert force == pytest.approx(1.0, abs=1e-9)
    assert max(constant, heat) < 0.999


def test_fits_differ_by_what_is_not_known():
    pytest.importorskip("optax")
    t, x = cases.record(4, 21)
    fits = lt.learn.several(
        lambda seed: cases.oscillator(1.0 + 0.1 * seed), (t, x), 2, matching=200, shooting=0, rate=0.1, validation=0
    )
    mean, std = fits.spread(lambda s: jnp.exp(s.energy.function.function.log_stiffness))
    assert mean == pytest.approx(cases.STIFFNESS, rel=1e-2)
    assert 0.0 < std < 0.02
    times, states, deviation = fits.forecast(x[0, 0], (0.0, 1.0), 0.1, lt.MetriplecticRungeKutta(4))
    assert states.shape == deviation.shape == (len(times), 3)
    with pytest.raises(lt.InputError, match="integer >= 2"):
        lt.learn.several(lambda seed: cases.oscillator(), (t, x), 1)


def test_a_fitted_system_comes_back_from_its_file(tmp_path):
    pytest.importorskip("optax")
    t, x = cases.record(2, 21)
    system = lt.learn.Metriplectic(3, width=5, depth=1)
    fitted_system = lt.learn.fit(system, (t, x), matching=50, shooting=0)
    path = lt.learn.save(fitted_system, tmp_path / "model.npz")
    loaded_system = lt.learn.load(path, lt.learn.Metriplectic(3, width=5, depth=1, seed=9))
    np.testing.assert_array_equal(loaded_system.vector_field(x[0]), fitted_system.vector_field(x[0]))
    np.testing.assert_array_equal(loaded_system.training.loss, fitted_system.training.loss)
    assert not np.array_equal(system.vector_field(x[0]), fitted_system.vector_field(x[0]))
    with np.load(path, allow_pickle=False) as file:
        assert all(file[name].dtype.kind in "uifU" for name in file.files)
    with pytest.raises(lt.FileError, match="does not match"):
        lt.learn.load(path, lt.learn.Metriplectic(3, width=6, depth=1))
    with pytest.raises(lt.FileError, match="there is no file"):
        lt.learn.load(tmp_path / "none.npz", system)
    with np.load(path) as file:
        honest = dict(file)
    for changed_arrays in (
        {"leaf_0": honest["leaf_0"] + 1e-9},
        {"leaf_0": honest["leaf_0"].astype(str)},
        {"loss": np.zeros(0)},
    ):
        np.savez(tmp_path / "other.npz", **{**honest, **changed_arrays})
        with pytest.raises(lt.FileError, match="not those that were written"):
            lt.learn.load(tmp_path / "other.npz", system)
    for changed_arrays, words in (
        ({"leaf_0": np.nan * honest["leaf_0"]}, "not finite"),
        ({"leaf_0": "text"}, "does not match"),
    ):
        metadata, arrays = training.read_archive(path, files.MODEL_FORMAT)
        training.write_archive(
            tmp_path / "other.npz", metadata, arrays | changed_arrays
        )  # by someone who knows the format
        with pytest.raises(lt.FileError, match=words):
            lt.learn.load(tmp_path / "other.npz", system)
    metadata["training"].pop("seconds")
    training.write_archive(tmp_path / "other.npz", metadata, arrays)
    with pytest.raises(lt.FileError, match="record of its fit"):
        lt.learn.load(tmp_path / "other.npz", system)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(lt.FileError, match="damaged"):
        lt.learn.load(path, system)


def test_a_fitted_system_goes_into_ensembles():
    system = lt.learn.Metriplectic(3, width=4, depth=1)
    starts = np.random.default_rng(0).standard_normal((4, 3))
    ensemble = lt.ensemble(system, starts, (0.0, 0.5), 0.1, lt.MetriplecticMidpoint(), outputs="final")
    one = lt.integrate(system, starts[2], (0.0, 0.5), 0.1, method=lt.MetriplecticMidpoint())
    np.testing.assert_allclose(ensemble.x[2], one.x[-1], atol=1e-13)
