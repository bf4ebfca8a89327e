"""Check the picture of the first page, which shows runs of one body, and the line of facts above it."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt


@pytest.fixture
def chart_module(import_from_docs):
    return import_from_docs("beside")


def test_the_others_solve_the_equations_of_the_library(chart_module):
    """The equations written out by hand for the other packages are those of the model and of its attitude."""
    body = lt.models.tumbling_body(chart_module.INERTIA, rate=chart_module.RATE)
    y = np.random.default_rng(0).standard_normal(8)
    field_by_hand = np.array(chart_module.field(y, math.exp))
    ours = np.asarray(jax.jit(body.vector_field)(jnp.asarray(y[:4])))
    assert np.abs(field_by_hand[:4] - ours).max() < 1e-14
    assert np.abs(np.array(chart_module.field(1.01 * y, math.exp))[:4] - ours).max() > 1e-4
    # The momentum in space is constant, which the quaternion alone can make true.
    q, dq, m, dm = y[4:] / np.linalg.norm(y[4:]), field_by_hand[4:] / np.linalg.norm(y[4:]), y[:3], field_by_hand[:3]
    pure_quaternion = lambda v: np.array([0.0, *v])  # noqa: E731
    rate = (
        _times(_times(dq, pure_quaternion(m)), _bar(q))
        + _times(_times(q, pure_quaternion(dm)), _bar(q))
        + _times(_times(q, pure_quaternion(m)), _bar(dq))
    )
    assert np.abs(rate).max() < 1e-14


def _times(p, q):
    return np.array([p[0] * q[0] - p[1:] @ q[1:], *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])


def _bar(q):
    return np.array([q[0], *-q[1:]])


def test_the_line_of_facts_names_the_version_of_the_package(import_from_docs, monkeypatch, tmp_path):
    facts = import_from_docs("facts")
    monkeypatch.setenv("GITHUB_REPOSITORY", "some/one")
    facts.write_facts(tmp_path / "facts.md")
    line = (tmp_path / "facts.md").read_text()
    assert f"Version {lt.__version__} · " in line
    assert "[repository](https://github.com/some/one)" in line or facts.repository() in line
