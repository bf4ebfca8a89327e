"""A fitted system in a study: over its starts and over a number in it, gone on with from its file."""

from __future__ import annotations

import numpy as np
import pytest

import liethermo as lt

from . import cases

pytest.importorskip("optax")
pytest.importorskip("zarr")


def _study(system, axes, **how):
    return lt.Study(system, axes, t_span=(0.0, 1.0), step=0.1, measure={"final": "final"}, **how)


@pytest.mark.slow
def test_a_fitted_system_is_studied_and_its_study_goes_on_with_the_one_from_the_file(tmp_path):
    t, x = cases.record(2, 21)
    fitted_system = lt.learn.fit(cases.oscillator(), (t, x), matching=50, shooting=0)
    path = lt.learn.save(fitted_system, tmp_path / "model.npz")
    loaded_system = lt.learn.load(path, cases.oscillator())
    starts = {"start": lt.replicas(x[:, 0])}
    first_study = _study(fitted_system, starts, store=tmp_path / "store.zarr")
    assert first_study.run().ok
    assert first_study.audit().passed
    one = lt.integrate(fitted_system, x[1, 0], (0.0, 1.0), 0.1)
    np.testing.assert_allclose(first_study.results.final[1], one.x[-1], atol=1e-13)
    second = _study(
        loaded_system, starts, store=tmp_path / "store.zarr"
    )  # would be refused if it was of another system
    np.testing.assert_array_equal(second.results.final, first_study.results.final)


def test_a_learned_number_is_an_axis():
    t, x = cases.record(2, 21)
    fitted_system = lt.learn.fit(cases.oscillator(), (t, x), matching=50, shooting=0)
    name = "energy.function.function.log_stiffness"
    fitted_value = float(fitted_system.energy.function.function.log_stiffness)
    study = _study(fitted_system, {name: [fitted_value, fitted_value + 0.1]}, x0=x[0, 0])
    assert study.run().ok
    one = lt.integrate(fitted_system, x[0, 0], (0.0, 1.0), 0.1)
    np.testing.assert_allclose(study.results.final[0], one.x[-1], atol=1e-13)
    assert np.abs(study.results.final[1] - one.x[-1]).max() > 1e-3
