# Everything works on a machine that has only Python >= 3.11, git and make: the first target called makes .venv.
#   make fit [CONFIG=configs/strokes/forbes.yaml]   train, and draw the pictures
#   make compare                                    FORBES against RSSM: two trainings, their table, the paper's figures
#   make test | lint | bench
PYTHON ?= python3
CONFIG ?= configs/strokes/forbes.yaml
BIN := .venv/bin

.PHONY: fit compare test lint bench clean
.DELETE_ON_ERROR:

fit: .venv/installed
	$(BIN)/forbes fit --config $(CONFIG)

compare: runs/compare/forbes/fitted runs/compare/rssm/fitted
	$(BIN)/forbes evaluate runs/compare/forbes runs/compare/rssm
	$(BIN)/forbes figures strokes --runs runs/compare/forbes runs/compare/rssm -o runs/compare/figures

# An interrupted training goes on where its last checkpoint was written.
runs/compare/%/fitted: .venv/installed
	if [ -e runs/compare/$*/checkpoints/last.ckpt ]; \
	then $(BIN)/forbes fit --resume runs/compare/$*; \
	else $(BIN)/forbes fit --config configs/strokes/$*.yaml --run_dir runs/compare/$*; fi
	touch $@

test: .venv/installed-dev
	$(BIN)/pytest -q

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/installed-dev
	set -e; for benchmark in benchmarks/*.py; do $(BIN)/python $$benchmark; done

clean:
	rm -rf .venv dist .mypy_cache .ruff_cache .pytest_cache

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
