"""Randomly damaged files: reading them gives what was written, or an error of the library, within a time limit."""

import json
import os
import shutil
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

import liethermo as lt
from liethermo.spec import read
from liethermo.spec.reading import build_study
from liethermo.studies.store_results import audit_store, load_status, load_study
from tests.liethermo.results.test_netcdf import rewrite

LIBRARY_ERRORS = (lt.LiethermoError, lt.FileError)
"""Errors by which a damaged file may be refused."""

MAX_SECONDS = 20.0
"""Maximum time in seconds for reading one damaged file; a hundredth of it is usual."""

BODY = lt.models.rigid_body
X0 = np.array([0.1, 1.0, 0.1])
small_or_many = pytest.mark.parametrize("count", [60, pytest.param(6000, marks=pytest.mark.slow)])


def damage_randomly(content: bytes, random: np.random.Generator) -> bytes:
    """Return the content with a random part changed, lost, moved or inserted."""
    offset, length = int(random.integers(len(content))), int(random.integers(1, 64))
    rest = content[offset + length :]
    match int(random.integers(6)):
        case 0:
            return content[:offset] + bytes([content[offset] ^ (1 << int(random.integers(8)))]) + content[offset + 1 :]
        case 1:
            return content[:offset]
        case 2:
            return content[:offset] + random.bytes(length) + rest
        case 3:
            return content[:offset] + rest
        case 4:
            return content[:offset] + random.bytes(length) + content[offset:]
        case _:
            return content[:offset] + bytes(len(content[offset : offset + length])) + rest


@pytest.mark.parametrize("kind", ["solution", "ensemble"])
@small_or_many
def test_damaged_results_are_refused_or_unchanged(tmp_path, kind, count):
    if kind == "solution":
        result = lt.integrate(BODY(), X0, (0.0, 1.0), 0.1)
    else:
        result = lt.ensemble(BODY(), [X0, 2 * X0], (0.0, 1.0), 0.1, outputs="trajectory")
    content = result.save(tmp_path / "whole.nc").read_bytes()
    random, path, n_refused = np.random.default_rng(1), tmp_path / "damaged.nc", 0
    for _ in range(count // 2):
        path.write_bytes(damage_randomly(content, random))
        start = time.perf_counter()
        try:
            loaded_result = lt.load(path)
            assert np.array_equal(loaded_result.x, result.x)
            assert np.array_equal(loaded_result.energy, result.energy)
        except lt.FileError:
            n_refused += 1
        assert time.perf_counter() - start < MAX_SECONDS
    assert n_refused > 0.7 * (count // 2)  # some changes do not affect the values


WORDS = [None, True, 5, -1, 1e999, "", "x", [], {}, [[]], "[" * 5000, {"a": {"b": []}}, 10**400]


@small_or_many
def test_changed_attributes_of_results_are_refused_or_harmless(tmp_path, count):
    """Files with valid checksums, in which an attribute has been replaced."""
    solution, random = lt.integrate(BODY(), X0, (0.0, 1.0), 0.1), np.random.default_rng(2)
    original = solution.save(tmp_path / "whole.nc")
    attribute_names = ("status", "stats", "laws", "provenance", "evidence", "event_time", "times")
    for _ in range(count // 10):
        path, name = (
            Path(shutil.copy(original, tmp_path / "changed.nc")),
            attribute_names[random.integers(len(attribute_names))],
        )
        word = WORDS[random.integers(len(WORDS))]

        def change(file, name=name, word=word):
            content = json.loads(str(file.attrs[name]))
            if isinstance(content, dict) and content and random.random() < 0.8:
                content[list(content)[random.integers(len(content))]] = word
                word = content
            file.attrs[name] = json.dumps(word)

        try:
            loaded_result = lt.load(rewrite(path, change))
            assert np.array_equal(loaded_result.x, solution.x)
            str(loaded_result.audit())
        except lt.FileError:
            pass


@small_or_many
def test_damaged_stores_are_refused_or_unchanged(tmp_path, count):
    store = tmp_path / "store.zarr"
    study = lt.Study(
        lambda p: BODY(rate=p["rate"]),
        {"rate": [0.5, 1.0, 2.0, 4.0]},
        x0=X0,
        t_span=(0.0, 1.0),
        step=0.1,
        measure={"tau": "relaxation_time"},
        store=store,
        chunk=2,
    )
    study.run()
    points, laws_hold, dataset = load_status(store).points, audit_store(store).passed, load_study(store).load()
    files = sorted(path for path in store.rglob("*") if path.is_file() and path.name != ".lock")
    random, messages = np.random.default_rng(3), []
    for _ in range(count // 4):
        path = files[random.integers(len(files))]
        content = path.read_bytes()
        path.write_bytes(damage_randomly(content, random))
        start = time.perf_counter()
        try:
            status = load_status(store)
            assert status.points == points
            assert audit_store(store).passed == laws_hold or status.done < points
            assert load_study(store).load().identical(dataset) or status.done < points
        except lt.FileError as error:
            messages.append(str(error))
        assert time.perf_counter() - start < MAX_SECONDS
        path.write_bytes(content)
    assert load_status(store).complete
    assert messages
    assert not any("\n" in text for text in messages)


SPEC = Path(__file__).parent.parent / "examples" / "relaxed_rigid_body.toml"
TOKENS = [
    "[",
    "]",
    "{",
    "}",
    '"',
    "=",
    ".",
    ",",
    "\n",
    "nan",
    "inf",
    "-",
    "1e999",
    "true",
    "''",
    "os:system",
    "0x",
    "\0",
    "é",
]


@small_or_many
def test_damaged_specs_are_refused_or_valid(tmp_path, count, monkeypatch):
    text = (
        SPEC.read_text() + '\n[study.axes]\nrate = [0.5, 1.0]\n"initial[0]" = {first = 0.1, last = 0.2, points = 3}\n'
    )
    random, path, messages = np.random.default_rng(4), tmp_path / "spec.toml", []
    monkeypatch.setattr(os, "system", lambda command: pytest.fail(f"it ran {command}"))
    path.write_text(text)
    build_study(read(path), tmp_path / "unused.zarr")
    for _ in range(count // 2):
        offset, length = int(random.integers(len(text))), int(random.integers(0, 12))
        token = TOKENS[random.integers(len(TOKENS))]
        path.write_text(text[:offset] + token + text[offset + length :])
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                plan = read(path)
                plan.build_system()
                if plan.study is not None:
                    build_study(plan, tmp_path / "unused.zarr")
            except LIBRARY_ERRORS as error:
                messages.append(str(error))
        assert time.perf_counter() - start < MAX_SECONDS
    assert messages
    assert max(map(len, messages)) < 20_000
