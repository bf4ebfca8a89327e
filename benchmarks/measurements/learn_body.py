"""Learned systems: a body that warms, on so(3)*, from its attitudes alone."""

from __future__ import annotations

import time

import numpy as np

import liethermo as lt
import manifolds as mf

from ..report import Report, Table

INERTIA = (3.0, 2.0, 1.0)
"""Moments of inertia of the measured body."""
RATE = 0.08
"""Friction rate of the measured body."""
INITIAL_GUESS = lt.models.tumbling_body((2.4, 2.0, 1.4), rate=0.2)
"""The body from which the fit starts."""
T_END = 20.0
"""Duration of a record."""
STEP = 0.1
"""Time between two attitudes."""
N_RECORDS = 8
"""Number of records."""
METHOD = lt.MetriplecticRungeKutta(4)
"""Method of the forecasts."""


def _noisy_records(noise: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times and attitudes of accurate runs, each attitude rotated by a small random angle."""
    body, random, records = lt.models.tumbling_body(INERTIA, rate=RATE), np.random.default_rng(0), []
    for start in _initial_momenta(random):
        run = lt.integrate(body, start, (0.0, T_END), STEP / 4, lt.MetriplecticRungeKutta(6), save_every=4)
        rotations = np.asarray(mf.SO(3).exp(noise * random.standard_normal((len(run.t), 3))))
        records.append((run.t, np.asarray(run.attitude) @ rotations))
    return records


def _initial_momenta(random: np.random.Generator) -> np.ndarray:
    mu = random.standard_normal((N_RECORDS, 3))
    return mu / np.linalg.norm(mu, axis=1, keepdims=True) * random.uniform(0.7, 1.5, (N_RECORDS, 1))


def _fit_row(noise: float, window: int, steps: int) -> list:
    start = time.process_time()
    model = lt.learn.fit(
        INITIAL_GUESS,
        _noisy_records(noise),
        observe=lambda x, R: R,
        noise=noise,
        shooting=steps,
        rate=0.02,
        window=window,
        positive=lambda s: (s.energy.body.A, s.dissipation.part.rate),
        progress=False,
    )
    training_seconds = time.process_time() - start
    inertia = 1.0 / np.asarray(model.energy.body.A)
    shape, friction = inertia / inertia[2], float(model.dissipation.part.rate) * inertia[2]
    unit = inertia[2] / INERTIA[2]  # of momenta, which no attitude tells
    start_, exact_body = np.array([0.3, 0.9, 0.4]), lt.models.tumbling_body(INERTIA, rate=RATE)
    forecast = lt.integrate(model, unit * start_, (0.0, 100.0 * T_END), STEP, METHOD)
    exact_run = lt.integrate(
        exact_body, start_, (0.0, 2.0 * T_END), STEP / 4, lt.MetriplecticRungeKutta(6), save_every=4
    )
    traces = np.einsum("tij,tij->t", np.asarray(forecast.attitude)[: len(exact_run.t)], np.asarray(exact_run.attitude))
    angle = float(np.arccos(np.clip((traces.min() - 1.0) / 2.0, -1.0, 1.0)))
    errors = [float(e) for e in np.abs(shape[:2] / np.array(INERTIA[:2]) - 1.0)]
    laws = [forecast.audit().energy_drift, float(np.diff(np.asarray(forecast.entropy)).min())]
    kind = "whole records" if window * STEP >= T_END else f"pieces of {window} intervals"
    return [f"noise {noise:g} rad, {kind}", *errors, float(abs(friction / RATE - 1.0)), angle, *laws, training_seconds]


def run(is_quick: bool) -> Report:
    kinds = [(1e-3, 20, 1500), (1e-3, 200, 1500), (1e-2, 20, 1500)]
    rows = []
    for noise, window, steps in kinds[:1] if is_quick else kinds:
        rows.append(_fit_row(noise, window, 50 if is_quick else steps))
        print(rows[-1], flush=True)
    errors = dict.fromkeys(["Error of I₁/I₃", "I₂/I₃", "Friction × I₃", "Angle to 2 T", "Energy drift"], "error")
    columns = {"Records": "text", **errors, "Least entropy increment": "error", "Training": "seconds"}
    text = (
        f"The data are {N_RECORDS} records of the attitude of a body with the inertia (3, 2, 1) and internal friction, "
        f"each with 201 attitudes from t = 0 to T = {T_END:g} and with measurement errors. The fit starts from the "
        "inertia (2.4, 2, 1.4) and from 2.5 times the friction. The data contain no momentum, temperature or entropy. "
        "Attitudes determine the inertia up to a factor, so the table has the relative errors of quantities that do "
        "not depend on this factor. *Angle* is the largest error of a forecast to 2 T, in radians. The long forecast "
        "lasts 100 T. GFINN and NMS need full states as data, so they cannot solve this problem."
    )
    return Report("Learned: a body from its attitudes", text, [Table("", columns, rows)])
