.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help .venv demo test test-slow fuzz docs docs-check wheel bench lock format clean

PYTHON ?= python3
BIN := .venv/bin
PIP_INSTALL := $(BIN)/python -m pip install --disable-pip-version-check --no-deps

# Extras with a lock of their own, of what they need beside requirements.lock.
LOCKS := studies learn quantum test docs bench

# Held back where a newer release refuses an early 3.11.
LOCK_CONSTRAINTS := soupsieve<3

# $(call require,CONDITION ON THE VERSION,MESSAGE)
require = @command -v "$(PYTHON)" >/dev/null || { echo "$(PYTHON) was not found; name an interpreter with PYTHON=..." >&2; exit 1; }; \
	"$(PYTHON)" -c 'import sys; sys.exit(not sys.version_info$(1))' || { echo "$(2)" >&2; exit 1; }

help:
	@echo "make demo       run a tumbling body with friction inside; results go to demo_output/"
	@echo "make test       linters, types, layer rule and the tests, without the slow ones"
	@echo "make test-slow  the slow tests; with PART=3/4 the third of four parts of them"
	@echo "make fuzz       random functions by the compiler and by JAX, for a minute (SECONDS=600 for ten)"
	@echo "make docs       build the documentation in docs/_build/html"
	@echo "make docs-check walk the built site in a headless Chromium; screenshots in docs/_build/screenshots"
	@echo "make wheel      build the wheel in dist/ and try it in a fresh environment"
	@echo "make bench      measure against C, SciPy, diffrax, heyoka and MuJoCo; writes both pages of benchmarks and benchmarks/runs.md"
	@echo "make format     format the code and repair what the linter can"
	@echo "make lock       choose new exact versions for all locks (needs Python 3.11)"
	@echo "make clean      remove .venv and everything built"
	@echo
	@echo "Each sets up .venv by itself, with what it needs. Another interpreter: make test PYTHON=python3.12"

# Each stamp is written last, so a set-up that was interrupted starts again.
.venv: .venv/installed

.venv/locked: requirements.lock
	$(call require, >= (3$(comma) 11),liethermo needs Python 3.11 or newer and $(PYTHON) is older. Name a newer one with PYTHON=...)
	rm -rf .venv
	"$(PYTHON)" -m venv .venv
	$(PIP_INSTALL) -r requirements.lock
	@touch $@

.venv/installed: .venv/locked pyproject.toml
	$(PIP_INSTALL) --no-build-isolation -e .
	@touch $@

# .venv/studies, .venv/learn, .venv/quantum, .venv/test, .venv/docs, .venv/bench: what one of them needs beside what a run needs.
.venv/%: requirements-%.lock .venv/installed
	$(PIP_INSTALL) -r $<
	@touch $@

comma := ,
space := $(subst ,, )

demo: .venv
	$(BIN)/liethermo run examples/tumbling_body.toml --out demo_output

# pytest keeps the tests as it has rewritten them, where Python is told to keep nothing too.
test test-slow docs-check bench: export PYTHONDONTWRITEBYTECODE :=

test: .venv/test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-slow: .venv/test
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow $(if $(PART),--part $(PART))

SECONDS ?= 60

fuzz: .venv/test
	$(BIN)/python -m tests.fuzz --seconds $(SECONDS)

docs: .venv/docs
	$(BIN)/sphinx-build -W --keep-going -b html docs docs/_build/html

docs-check: docs .venv/test
	$(BIN)/python -m pytest -m "slow or not slow" tests/site
	$(BIN)/python docs/check_site.py

# Installed with what it needs and nothing else, and run away from the sources.
wheel: .venv
	rm -rf dist build
	$(BIN)/python -m pip wheel --disable-pip-version-check --no-deps --no-build-isolation -w dist .
	@set -e; folder=$$(mktemp -d); trap 'rm -rf "$$folder"' EXIT; \
	"$(PYTHON)" -m venv "$$folder/venv"; \
	"$$folder/venv/bin/python" -m pip install --disable-pip-version-check -q -c requirements.lock dist/*.whl; \
	cp examples/relaxed_rigid_body.toml "$$folder"; cd "$$folder"; \
	venv/bin/liethermo --version; \
	venv/bin/liethermo run relaxed_rigid_body.toml --out out

bench: .venv/bench .venv/test
	$(BIN)/python -m pytest -m "slow or not slow" tests/benchmarks
	$(BIN)/python -m benchmarks --page docs/reference/benchmarks.md

format: .venv/test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# One resolution of everything, from which each lock takes its part.
lock:
	$(call require,[:2] == (3$(comma) 11),The lock is made with Python 3.11$(comma) the oldest one supported: make lock PYTHON=python3.11)
	@set -e; folder=$$(mktemp -d); trap 'rm -rf "$$folder"' EXIT; \
	"$(PYTHON)" -m venv "$$folder/venv"; \
	needed() { \
	  "$$folder/venv/bin/python" -m pip install --disable-pip-version-check -q --dry-run --ignore-installed \
	    --report "$$folder/report" -c "$$folder/constraints" "$$@" setuptools wheel; \
	  "$(PYTHON)" -c 'import json, sys; found = ["{name}=={version}".format_map(p["metadata"]) for p in json.load(open(sys.argv[1]))["install"]]; print(*sorted((p for p in found if not p.startswith("liethermo==")), key=str.lower), sep="\n")' "$$folder/report"; }; \
	headed() { \
	  echo "# Exact versions of what $$1."; \
	  echo "# Written from pyproject.toml by 'make lock'; not edited by hand."; \
	  cat; }; \
	echo "$(LOCK_CONSTRAINTS)" > "$$folder/constraints"; \
	needed ".[$(subst $(space),$(comma),$(LOCKS))]" > "$$folder/all"; \
	cp "$$folder/all" "$$folder/constraints"; \
	needed . > "$$folder/run"; \
	for extra in $(LOCKS); do \
	  needed ".[$$extra]" > "$$folder/$$extra"; \
	  grep -vxFf "$$folder/run" "$$folder/$$extra" | headed "the extra '$$extra' needs beside requirements.lock" > "requirements-$$extra.lock"; \
	done; \
	headed "a run of the library needs" < "$$folder/run" > requirements.lock

clean:
	rm -rf .venv build dist *.egg-info demo_output docs/_build docs/gallery docs/generated docs/reference/generated
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
