"""Give the tests a fixture that imports a program of the docs."""

import importlib
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture
def import_from_docs(monkeypatch):
    """Return the function that imports a module of ``docs``, or of a folder in it."""

    def import_module(name, folder="."):
        monkeypatch.syspath_prepend(str(DOCS / folder))
        return importlib.import_module(name)

    return import_module
