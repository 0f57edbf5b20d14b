.POSIX:
PYTHON ?= python3
BIN = .venv/bin
# Two workers, whatever the machine: each compiles a lot and takes up to 7 GiB.
PYTEST = $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder
# With the versions that were tested together.
PIP = $(BIN)/python -m pip --quiet --disable-pip-version-check install --constraint constraints.txt

.PHONY: help install fit notebooks test test-all test-minimum mutants bench docs hooks pins dist clean

help:
	@echo "make fit        fit a bundled measured target; writes report and figure to out/fit"
	@echo "make install    only install jaxmuscle into .venv"
	@echo "make notebooks  open the notebooks in JupyterLab; make notebooks OPEN=no only installs it"
	@echo "make test       for everybody: ruff, types, import contracts and the tests that find nearly everything"
	@echo "make test WING=spectra  the same tests of one folder of the package and of those above it"
	@echo "make test-all   for developers, before a release: also pages, notebooks, gallery, kills, damaged files, long studies"
	@echo "make test-minimum  some tests with the oldest versions that pyproject.toml allows, in .venv-minimum"
	@echo "make mutants    random faults in the package: which of them a test notices; out/mutants.json"
	@echo "make bench      measure speed; writes out/bench.json, appends to benchmarks/history.csv"
	@echo "make docs       write the documentation; open site/index.html"
	@echo "make hooks      from now on, every git commit runs the checks of make test first (not the tests)"
	@echo "make pins       renew the versions in constraints.txt, which make installs"
	@echo "make dist       build sdist and wheel into dist, and check them"
	@echo "make clean      remove caches and what make itself wrote, but not .venv, .venv-minimum and other results in out/"
	@echo "Another interpreter: make PYTHON=python3.12 fit"

install: .venv/.stamp-run
	@echo "jaxmuscle is installed in .venv; now: .venv/bin/jaxmuscle --help"

fit: .venv/.stamp-run
	$(BIN)/jaxmuscle fit vastus-lateralis-26mvc --out out/fit --force

OPEN = yes
notebooks: .venv/.stamp-notebooks
	@if [ "$(OPEN)" = yes ]; then $(BIN)/jupyter lab --notebook-dir=notebooks; \
	 else echo "JupyterLab is installed; open it with: make notebooks"; fi

test test-all: .venv/.stamp-test
	@$(BIN)/python tests/wings.py $(WING) >/dev/null
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports
	@echo "$(BIN)/basedpyright (checks types while the tests begin)"
	@$(BIN)/basedpyright & types=$$!; test $@ = test-all || set -- -m "not slow"; \
	 $(PYTEST) "$$@" `$(BIN)/python tests/wings.py $(WING)`; tests=$$?; wait $$types && exit $$tests

# What calls most of the libraries, and takes a few minutes.
MINIMUM = tests/_common tests/spectra/test_spectrum.py tests/data tests/commands tests/model/test_task.py tests/ensembles \
          tests/fits/test_result.py tests/plot
test-minimum: .venv-minimum/.stamp
	.venv-minimum/bin/python -m pytest -q -m "not slow" $(MINIMUM)

mutants: .venv/.stamp-test
	$(BIN)/python tests/mutants.py

bench: .venv/.stamp-bench
	$(BIN)/python benchmarks/run.py --out out/bench.json --history

docs: .venv/.stamp-docs
	$(BIN)/python docs/generate.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

hooks: .venv/.stamp-test .venv/.stamp-maintain
	$(BIN)/pre-commit install

# One version of each library for all Pythons, as the newest Pythons are not tested so often.
pins: .venv/.stamp-maintain
	$(BIN)/uv pip compile --quiet --upgrade --universal --fork-strategy fewest --python-version 3.11 --all-extras --group dev \
	  --no-annotate --custom-compile-command "make pins" --output-file constraints.txt pyproject.toml >/dev/null

dist: .venv/.stamp-maintain
	rm -rf dist
	$(BIN)/python -m build --no-isolation
	$(BIN)/twine check --strict dist/*

clean:
	rm -rf out/fit out/bench.json out/mutants.json site dist build .test-out .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -path './.venv*' -prune -o -type d -name __pycache__ -prune -exec rm -rf {} +

.venv/.stamp-run: pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || \
	  { echo "error: $(PYTHON) not found; name a Python >= 3.11: make PYTHON=/path/to/python" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: jaxmuscle needs Python >= 3.11, but $(PYTHON) is $$($(PYTHON) --version 2>&1);" \
	         "name another: make PYTHON=/path/to/python" >&2; exit 1; }
	@echo "Installing jaxmuscle into .venv (a few minutes the first time)"
	@$(PYTHON) -m venv .venv
	@$(PIP) --upgrade pip
	@$(PIP) --editable '.[all]'
	@$(BIN)/python -m compileall -q src
	@touch $@

.venv/.stamp-notebooks: .venv/.stamp-run
	@echo "Installing JupyterLab into .venv"
	@$(PIP) --editable '.[notebooks]'
	@touch $@

.venv/.stamp-test: .venv/.stamp-run
	@echo "Installing the test tools into .venv"
	@$(PIP) --group test
	@touch $@

.venv/.stamp-bench: .venv/.stamp-run
	@echo "Installing the benchmark tools into .venv"
	@$(PIP) --group bench
	@touch $@

.venv/.stamp-docs: .venv/.stamp-run
	@echo "Installing the documentation tools into .venv"
	@$(PIP) --group docs
	@touch $@

.venv/.stamp-maintain: .venv/.stamp-run
	@echo "Installing the tools of maintainers into .venv"
	@$(PIP) --group maintain
	@touch $@

.venv-minimum/.stamp: pyproject.toml
	@echo "Installing the oldest versions into .venv-minimum"
	@$(PYTHON) -m venv --clear .venv-minimum
	@.venv-minimum/bin/python -m pip --quiet --disable-pip-version-check install uv
	@.venv-minimum/bin/uv pip compile --quiet --resolution lowest-direct --python .venv-minimum/bin/python \
	  --extra posterior --extra url --extra c3d --group test --output-file .venv-minimum/versions.txt pyproject.toml >/dev/null
	@.venv-minimum/bin/uv pip install --quiet --python .venv-minimum/bin/python --requirement .venv-minimum/versions.txt \
	  --editable .
	@touch $@
