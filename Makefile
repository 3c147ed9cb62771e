# One word a target; `make help` lists them. Variables: SCENE FIELD PRESET DATA OUT SEED; EXAMPLE of `make view`; ARGS of `make data`; PROFILE MINUTES of
# `make experiments`; PYTHON for set-up; QUICK of `make lowest` and `newest`.
SCENE  ?= 1
FIELD  ?= hybrid
PRESET ?= $(if $(CUDA),gpu,cpu)
DATA   ?=
OUT    ?=
SEED   ?= 0
ARGS   ?=
PROFILE ?= quick
MINUTES ?=
PYTHON ?= python3

VENV   := .venv
PY     := $(VENV)/bin/python
WRITERS := .venv-conformance
PIP    := $(PY) -m pip install --quiet --disable-pip-version-check --no-compile
READY  := $(VENV)/.ready
CUDA   := $(shell command -v nvidia-smi >/dev/null 2>&1 && echo cuda)
SOURCE := $(if $(DATA),--data $(DATA),--scene $(SCENE))
NAME   := $(if $(DATA),$(notdir $(patsubst %/,%,$(DATA))),$(if $(wildcard $(SCENE)),$(notdir $(basename $(SCENE))),scene$(SCENE)))
MEASURED := $(if $(OUT),$(OUT),runs/$(NAME)-measured)
RUN    := $(if $(OUT),$(OUT),runs/$(NAME)-$(FIELD)-$(PRESET)-seed$(SEED))

.PHONY: help setup train eval view measured test test-heavy test-slow test-faults conformance lowest newest locks coverage simulator data lint \
	typecheck bench gpu-check experiments tables example docs site notebooks package clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

setup: $(READY)  ## make .venv with the locked dependencies (uv where it is, else venv and pip)

$(READY): uv.lock requirements.lock pyproject.toml
	@echo "setup: installing the locked dependencies into $(VENV) ..."
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo "error: $(PYTHON) is not there or older than Python 3.11; give another one: make PYTHON=python3.12 ..." >&2; exit 2; }
	@if command -v uv >/dev/null 2>&1; then \
		uv sync --quiet --locked --inexact --python "$(PYTHON)" --extra dev $(if $(CUDA),--extra cuda); \
	else \
		$(PYTHON) -m venv $(VENV) && $(PIP) --no-deps -r requirements.lock && \
		$(PIP) --no-deps -e . $(if $(CUDA),&& $(PIP) "jax[cuda12]"); \
	fi
	@touch $@

train: setup  ## train, evaluate, draw: make train SCENE=1 [FIELD= PRESET=smoke|cpu|gpu DATA=folder OUT=runs/x SEED=]
	$(VENV)/bin/wbgs-jax train $(SOURCE) --field $(FIELD) --preset $(PRESET) --seed $(SEED) --out $(RUN) --resume
	$(VENV)/bin/wbgs-jax eval --run $(RUN)

eval: setup  ## evaluate a trained run again: make eval OUT=runs/x (or the SCENE, FIELD, PRESET, SEED of the training)
	$(VENV)/bin/wbgs-jax eval --run $(RUN)

view: setup  ## look at a trained run in the browser: make view EXAMPLE=1, or OUT=runs/x (or the SCENE, FIELD, ... of the training)
	$(VENV)/bin/wbgs-jax view $(if $(EXAMPLE),--example,--run $(RUN))

measured: setup  ## learn and score a map of measured powers: make measured DATA=folder [OUT=folder]  (docs/measured.md)
	@test -n "$(DATA)" || { echo "error: give the folder with the readings: make measured DATA=folder" >&2; exit 2; }
	$(VENV)/bin/wbgs-jax measure --data $(DATA) --out $(MEASURED)/scores.json --picture $(MEASURED)/maps.png

test: setup  ## run the tests: about five minutes on two cores
	$(PY) -m pytest -n 2 --dist worksteal -m "not slow and not heavy"

test-heavy: setup  ## run the tests that compile, search or train for long; CI runs them too: a quarter of an hour
	$(PY) -m pytest -n 2 --dist worksteal -m "heavy and not slow"

test-slow: setup  ## run all tests in fully optimised code on fresh random inputs, larger cases of what the others check too: hours
	WBGS_TEST_OPTIMISED=1 WBGS_TEST_SEED=$(or $(WBGS_TEST_SEED),fresh) $(PY) -m pytest -n 2 --dist worksteal

test-faults: setup  ## run the tests of faults, count what was tried: make test-faults [ARGS="--only fuzz_readers --seed 1"]
	$(PY) -m tools.qa.reliability $(ARGS)

conformance: simulator  ## check files that other programs write: install these into .venv-conformance, read what they make, count it
	@$(PY) -m venv $(WRITERS)
	@$(PY) -c 'import site; print(*site.getsitepackages(), sep="\n")' > \
		$$($(WRITERS)/bin/python -c 'import site; print(site.getsitepackages()[0])')/usual.pth
	@grep -v '^#' tests/conformance/requirements.txt | while read -r wanted; do \
		$(WRITERS)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --only-binary :all: "$$wanted" || \
			echo "conformance: $$wanted cannot be had here; its files are left out" >&2; done
	$(WRITERS)/bin/python -m tools.qa.conformance $(ARGS)

lowest:  ## run the tests with the lowest versions of the dependencies that pyproject.toml allows (needs uv)
	$(call tested-with,lowest-direct)

newest:  ## run the tests with the newest versions of the dependencies (needs uv)
	$(call tested-with,highest)

# An environment of its own, removed afterwards; the tests run from the tree.
define tested-with
@command -v uv >/dev/null 2>&1 || { echo "error: uv chooses the versions and is not here; install it: pip install uv" >&2; exit 2; }
@work=$$(mktemp -d) && trap 'rm -rf "$$work"' EXIT && \
	uv venv --quiet --python "$(PYTHON)" "$$work/venv" && \
	VIRTUAL_ENV="$$work/venv" uv pip install --quiet --resolution $(1) -e ".[dev]" && \
	VIRTUAL_ENV="$$work/venv" uv pip list 2>/dev/null | grep -iE "^(jax|jaxlib|flax|numpy|optax|orbax-checkpoint|scipy) " && \
	"$$work/venv/bin/python" -m pytest -n 2 --dist worksteal -m "not slow$(if $(QUICK), and not heavy)" && \
	"$$work/venv/bin/python" -m pytest tests/guard/test_versions.py
endef

locks:  ## write the locks anew, with the hashes of every file, after a change of dependencies (needs uv)
	uv lock --quiet
	uv export --quiet --locked --no-emit-project --extra dev -o requirements.lock
	uv export --quiet --locked --no-emit-project --extra dev --extra data -o requirements-data.lock

coverage: setup  ## run the tests and report which lines of the library they reach (htmlcov/, experiments/results)
	$(PY) -m pytest -n 2 --dist worksteal -m "not slow" --cov=wbgs_jax --cov-branch --cov-report=html --cov-report=json:coverage.json
	$(PY) -m tools.qa.coverage_account

simulator: setup  ## also install Sionna RT, which only `make data` needs
	@if command -v uv >/dev/null 2>&1; then \
		uv sync --quiet --locked --inexact --python "$(PYTHON)" --extra dev --extra data $(if $(CUDA),--extra cuda); \
	else $(PIP) --no-deps -r requirements-data.lock; fi

data: simulator  ## trace a scene with Sionna RT, or go on with it: make data SCENE=1 [ARGS="--frequency-set 21"]
	$(PY) -m data_gen.generate --scene $(SCENE) $(ARGS)

lint: setup  ## ruff, and the layers of docs/architecture.md
	$(PY) -m ruff check . && $(PY) -m ruff format --check . && $(VENV)/bin/lint-imports --no-logo

typecheck: setup  ## mypy
	$(PY) -m mypy

bench: setup  ## measure this machine, compare: make bench [GATE=1 to fail on a regression] [ARGS="--only renderer --update"]
	$(PY) -m experiments.bench $(if $(filter-out 0,$(GATE)),--gate) $(ARGS)

gpu-check: setup  ## check a GPU in pieces of eight minutes that continue: parity, times, trainings [NEXT=1 ONLY=piece MINUTES= OUT= ARGS=--list]
	$(PY) -m experiments.gpu_check $(if $(NEXT),--next) $(if $(ONLY),--only $(ONLY)) $(if $(MINUTES),--minutes $(MINUTES)) \
		$(if $(OUT),--out $(OUT)) $(ARGS)

experiments: setup  ## run what docs/results.md lacks: make experiments [PROFILE=quick|paper MINUTES=60 ARGS="--only table1"]
	$(PY) -m experiments.runner --profile $(PROFILE) $(if $(MINUTES),--minutes $(MINUTES)) $(ARGS)

tables: setup  ## write docs/results.md and the marked numbers of all pages from the results that there are: make tables [PROFILE=]
	$(PY) -m experiments.tables --profile $(PROFILE)

example: setup  ## train the example field that comes with the package anew, score it: about six minutes
	$(PY) -m tools.example_field

docs: setup  ## write docs/api.md from the docstrings, and check the spelling
	$(PY) docs/make_api.py && $(VENV)/bin/codespell

site: setup  ## build the documentation site into site/; what is broken in it is an error
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict --quiet

notebooks: setup  ## execute the notebooks of docs/notebooks
	$(PY) docs/make_notebooks.py

package: setup  ## build wheel and source archive into dist/, check both, try the wheel in an empty environment
	PYTHON="$(PYTHON)" .ci/package

clean:  ## remove caches; runs, data and .venv stay
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis dist site
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
