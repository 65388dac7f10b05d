# Everything works on a machine that has only Python >= 3.11, git and make: the first target called makes .venv.
#   make fit [CONFIG=strokes/forbes]   train, and draw the pictures
#   make compare                       FORBES against RSSM: two trainings, their scores, the paper's figures
#   make test | lint | docs | faults | bench
PYTHON ?= python3
CONFIG ?= strokes/forbes
BIN := .venv/bin

.PHONY: fit compare test lint docs faults bench clean
.DELETE_ON_ERROR:

fit: .venv/installed
	$(BIN)/forbes fit $(CONFIG)

# Interrupted, it goes on where it stopped.
compare: .venv/installed
	$(BIN)/forbes compare strokes/rssm strokes/forbes -o runs/compare --futures 200
	$(BIN)/forbes figures predictions --runs runs/compare/forbes-0 runs/compare/rssm-0 -o runs/compare/figures
	$(BIN)/forbes figures elbo --runs runs/compare/forbes-0 runs/compare/rssm-0 -o runs/compare/figures

# A worker per core has a thread, as has each command that a test starts; worksteal leaves most of a file to one worker.
test: .venv/installed-dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -n auto --maxprocesses 4 --dist worksteal

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The site, build/docs/index.html; needs no network. A warning, such as a link that leads nowhere, is an error.
docs: .venv/installed-dev
	$(BIN)/sphinx-build -q -W --keep-going -c docs . build/docs

# Twenty minutes on 2 cores; writes what came of it.
faults: .venv/installed-dev
	PYTHONPATH=tests $(BIN)/python -m faults --report docs/reliability.md

bench: .venv/installed-dev
	set -e; for benchmark in benchmarks/*.py; do $(BIN)/python $$benchmark; done

clean:
	rm -rf .venv build dist docs/generated .mypy_cache .ruff_cache .pytest_cache

# torch first, so that nothing else chooses its version. On Linux this is the CUDA build (2 GB); without a GPU,
#   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make fit
# takes the small one (the same version, so a choice of the CPU build is kept by every later install).
.venv/torch:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo 'forbes needs Python 3.11 or newer. Name one: make PYTHON=python3.11 ...'; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -c constraints.txt torch
	touch $@

.venv/installed: .venv/torch pyproject.toml constraints.txt
	$(BIN)/pip install -c constraints.txt -e .
	touch $@

.venv/installed-dev: .venv/torch pyproject.toml constraints.txt
	$(BIN)/pip install -c constraints.txt -e '.[dev]'
	touch $@ .venv/installed
