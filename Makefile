# Everything happens in .venv; a stamp file per set of packages remembers what is installed.
VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3.14 python3; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo "$$p"; break; }; done)
# Modules are compiled when they are first imported: most of a library never is.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --retries 10 -c constraints.txt
# What was compiled at the first import is kept, also where the environment says otherwise.
unexport PYTHONDONTWRITEBYTECODE
# One process a core, in which threads of linear algebra would only wait; the tests of a file share what they have made.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest
PYTEST_ARGS ?= -n logical --dist loadfile
BENCH_ARGS ?=

.PHONY: help demo kernel-calls test test-all first-contact style lint format docs publish-docs dist try resolve bench results results-quick clean

help:
	@echo "make demo    plan on a synthetic patient, results in demo-output/"
	@echo "make test    lint, types, and the tests that need few kernels (minutes)"
	@echo "make test-all  lint, types and all default tests"
	@echo "make first-contact  a newcomer's tasks with an installed package, outside the checkout"
	@echo "make lint    ruff and mypy only"
	@echo "make format  let ruff rewrite the code"
	@echo "make docs    build the documentation into site/"
	@echo "make publish-docs PUBLISHED=FOLDER  the pages of this version beside those of others"
	@echo "make dist    build wheel and sdist into dist/, and check what is in them"
	@echo "make kernel-calls  write down which kernels each command calls (a quarter of an hour)"
	@echo "make try     the wheel in new environments, on all versions of Python at hand (half an hour)"
	@echo "make resolve the package registry asked whether every stated platform can install"
	@echo "make bench   run the benchmarks"
	@echo "make results-quick  all studies in the quick setting, and RESULTS.md"
	@echo "make results        all studies in the full setting (hours), and RESULTS.md"
	@echo "make clean   remove everything that was built, but not .venv"

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer was not found; name it: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# The kernels of the demonstration need numpy and numba alone: they are compiled while the rest is installed.
$(VENV)/.installed-run: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) numpy numba
	$(BIN)/python -m anatomy.machine_code demo & compiling=$$!; $(PIP) -e . && wait $$compiling
	@touch $@

$(VENV)/.installed-%: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) -e '.[$*]'
	@touch $@

demo: $(VENV)/.installed-run
	$(BIN)/lungaccess demo --out demo-output

kernel-calls: $(VENV)/.installed-test
	$(BIN)/python packaging/kernel_calls.py

style: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

lint: style
	$(BIN)/mypy

format: $(VENV)/.installed-test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Types are examined beside the tests, and heard of where they are wrong, so that the tests have the last word.
test: style
	@$(BIN)/mypy > $(VENV)/mypy.txt 2>&1 & types=$$!; \
	$(PYTEST) --quick $(PYTEST_ARGS); tests=$$?; \
	wait $$types || { cat $(VENV)/mypy.txt; exit 1; }; exit $$tests

test-all: lint
	$(PYTEST) $(PYTEST_ARGS)

# FIRST_CONTACT_ARGS=--fresh makes an environment from nothing.
first-contact: $(VENV)/.installed-test
	$(BIN)/python tests/first_contact/run.py $(FIRST_CONTACT_ARGS)

docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build -q -W --keep-going -b html docs site

# PUBLISHED is a folder for a host of static files, with a folder a version and a list of them.
publish-docs: docs
	@test -n "$(PUBLISHED)" || { echo "Name the folder: make publish-docs PUBLISHED=FOLDER" >&2; exit 1; }
	$(BIN)/python packaging/publish_docs.py site "$(PUBLISHED)"

dist: $(VENV)/.installed-test
	$(BIN)/python packaging/release.py dist

# TRY_ARGS="--python 3.12 --dependencies newest" tries one environment of packaging/matrix.toml.
try: $(VENV)/.installed-test
	$(BIN)/python packaging/release.py try $(TRY_ARGS)

# RESOLVE_ARGS="--platform Windows --python 3.12" asks about one cell of packaging/matrix.toml.
resolve: $(VENV)/.installed-test
	$(BIN)/python packaging/resolve.py $(RESOLVE_ARGS)

bench: $(VENV)/.installed-dev
	cd benchmarks && export ASV_PYTHONPATH="$(CURDIR)" && ../$(BIN)/asv machine --yes && ../$(BIN)/asv run -E existing:same --show-stderr $(BENCH_ARGS)

# Real anatomy is used where LUNGACCESS_DATA names its folder.
results: $(VENV)/.installed-study
	$(BIN)/python -m experiments.run_all

results-quick: $(VENV)/.installed-study
	$(BIN)/python -m experiments.run_all --quick

clean:
	rm -rf site docs/reference/packages docs/pictures build dist demo-output *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .asv
	find anatomy stages lungaccess tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
