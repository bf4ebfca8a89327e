"""Notebook views of results, and the descriptions of variables in files."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

import liethermo as lt
import manifolds as mf


@pytest.fixture(scope="module")
def body():
    return lt.models.rigid_body((3.0, 2.0, 1.0))


@pytest.fixture(scope="module")
def solution(body):
    return lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 2.0), 0.1)


def test_everything_shown_is_well_formed_and_says_what_the_print_says(body, solution):
    ensemble = lt.ensemble(body, np.eye(3) + 0.1, (0.0, 1.0), 0.1)
    algebra = mf.so(3).with_basis_names("Jx", "Jy", "Jz")
    expected_texts = {
        "Solution": (solution, solution.status.message),
        "Audit": (solution.audit(), solution.audit().verdict),
        "Check": (body.check(), "all axioms hold"),
        "Ensemble": (ensemble, "3 trajectories to t = 1"),
        "LieAlgebra": (algebra, "[Jx, Jy]"),
        "Report": (mf.testing.check_algebra(mf.so(3)), "all of them hold"),
    }
    for name, (value, expected) in expected_texts.items():
        tree = ElementTree.fromstring(f"<div>{value._repr_html_()}</div>")
        assert expected in "".join(tree.itertext()), name
        assert len(repr(value)) < 100 or name in ("Ensemble", "Report"), name


def test_the_picture_of_a_solution_holds_its_curves(solution):
    tree = ElementTree.fromstring(f"<div>{solution._repr_html_()}</div>")
    curves = [node for node in tree.iter() if node.tag.endswith("polyline")]
    assert len(curves) == 4  # three components and the entropy
    heights = [float(point.split(",")[1]) for point in curves[-1].get("points").split()]
    assert len(heights) == len(solution.t)
    assert heights == sorted(heights, reverse=True)  # the entropy grows, and SVG counts downwards


def test_a_picture_of_what_is_not_finite_or_long_is_still_one():
    from liethermo.results.solution import MAX_POINTS, svg_sketch

    t = np.arange(5000.0)
    series = np.stack([np.sin(t), np.full_like(t, np.nan)], axis=-1)
    tree = ElementTree.fromstring(svg_sketch(t, series, "a test"))
    sine_points, nan_points = (node.get("points").split() for node in tree.iter() if node.tag.endswith("polyline"))
    assert len(sine_points) == MAX_POINTS
    assert nan_points == []


@pytest.mark.parametrize(
    ("polynomial", "latex"),
    [
        (mf.so(3).casimirs(2)[0], r"\mu_{1}^{2} + \mu_{2}^{2} + \mu_{3}^{2}"),
        (mf.Polynomial([[1, 0], [0, 2]], [-1, 0.5]).with_names("q", "p"), r"-\mathrm{q} + 0.5 \mathrm{p}^{2}"),
        (mf.Polynomial([[0, 0]], [3e-20]), r"3 \cdot 10^{-20}"),
        (mf.Polynomial(np.zeros((0, 2), dtype=int), []), "0"),
    ],
)
def test_polynomials_are_typeset(polynomial, latex):
    assert polynomial._repr_latex_() == rf"$\displaystyle {latex}$"


def test_variables_of_a_file_say_what_they_are(solution, tmp_path):
    import xarray

    file = solution.save(tmp_path / "run.nc", units={"time": "s", "energy": "J"})
    with xarray.open_dataset(file, engine="h5netcdf", decode_times=False) as dataset:
        assert dataset["energy"].attrs == {"long_name": "energy", "units": "J", "law": "conserved"}
        assert dataset["time"].attrs["units"] == "s"
        assert "units" not in dataset["x"].attrs
        assert all(variable.attrs["long_name"] for variable in dataset.variables.values())
    assert np.array_equal(lt.load(file).x, solution.x)
    with pytest.raises(lt.InputError, match="no variable 'enthalpy'"):
        solution.save(tmp_path / "run.nc", units={"enthalpy": "J"})


def test_the_version_is_told():
    assert lt.__version__.count(".") == 2
    process = subprocess.run(
        [sys.executable, "-m", "liethermo", "--version"], capture_output=True, text=True, check=True
    )
    assert process.stdout == f"liethermo {lt.__version__}\n"
