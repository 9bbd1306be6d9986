# Tasks of aqualvs; `make help` lists them. Everything happens in .venv, made on first use.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
CODE := src tests tools benchmarks ros2

.DEFAULT_GOAL := help
.PHONY: help setup demo test coverage fuzz kills lint format bench docs clean

help: ## List the tasks
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP) ## Make .venv with the package and the tools of developers

demo: $(STAMP) ## Measure the bundled dive; writes out/demo/report.html
	$(BIN)/aqualvs demo -o out/demo --overwrite

# Four files at a time: on two cores, two that work while others wait. In the order of
# tests/conftest.py, not by their number of tests: files of few and long tests would be left to the
# end.
PARTS := $(filter-out helpers data,$(patsubst tests/%/,%,$(wildcard tests/*/))) \
  $(patsubst tests/test_%.py,%,$(wildcard tests/test_*.py))
FILES = $(wildcard tests/$(PART)/test_*.py tests/$(PART)/*/test_*.py tests/test_$(PART).py)

# Without byte code on disk each of some hundred processes would compile the package again.
test: export PYTHONDONTWRITEBYTECODE :=
# What takes long is done in part, unless WHOLE=1 is given: tests/helpers/whole.py.
test: export AQUALVS_WHOLE := $(or $(WHOLE),$(AQUALVS_WHOLE))
test: $(STAMP) ## Run all tests, four files at a time (JOBS=4), or one part (PART=scanning), in full by WHOLE=1
	$(if $(PART),$(if $(FILES),,$(error no tests of `$(PART)`; parts are: $(sort $(PARTS)))))
	$(BIN)/python -m pytest --numprocesses=$(or $(JOBS),4) --dist=loadfile --no-loadscope-reorder \
	  --durations=30 --durations-min=5 \
	  $(if $(PART),$(FILES))

# Coverage slows Python down: tests that count calls and compare speeds would measure it. Of a test
# that fails, the lines count that it ran; `make test` tells of it.
COUNTED := work_counts speed_ratios start
coverage: $(STAMP) ## Measure which lines the tests run, by package; fails below 80 %
	rm -rf out/coverage && mkdir -p out/coverage
	-$(BIN)/python -m coverage run -m pytest --numprocesses=$(or $(JOBS),4) --dist=loadfile \
	  --no-loadscope-reorder --quiet \
	  $(foreach name,$(COUNTED),--ignore=tests/test_$(name).py)
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage json --quiet -o out/coverage/lines.json
	$(BIN)/python tools/coverage_by_package.py out/coverage/lines.json

fuzz: $(STAMP) ## Try 2,000 malformed files and options (SEED=1 CASES=2000); lists what is not refused
	PYTHONPATH=tests/helpers:. $(BIN)/python tests/helpers/fuzz_cases.py --seed $(or $(SEED),1) --cases $(or $(CASES),2000)

kills: $(STAMP) ## Kill run, batch, live and follow at 100 random moments (SEED=1 CASES=100)
	PYTHONPATH=tests/helpers:. $(BIN)/python tests/helpers/kill_cases.py --seed $(or $(SEED),1) --kills $(or $(CASES),100)

lint: $(STAMP) ## Check style, types and the direction of imports
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP) ## Format the code and mend what can be mended
	$(BIN)/ruff format $(CODE)
	$(BIN)/ruff check --fix $(CODE)

bench: $(STAMP) ## Measure speed and accuracy beside plain references; keeps out/bench/history.json
	$(BIN)/python -m benchmarks

docs: $(STAMP) ## Build the documentation site; writes out/site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict --site-dir out/site

clean: ## Remove what these tasks made
	rm -rf $(VENV) out dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find $(CODE) -name __pycache__ -type d -prune -exec rm -rf {} +

# Debian's Python comes without the module that puts pip into a new venv; pip outside reaches in.
# Byte code is made by all processors at once; pip would use one. Not of tests and message sets,
# half of all there is: of those, the few that are imported are compiled then.
PIP_OPTIONS := --quiet --disable-pip-version-check --no-compile
$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "$(PYTHON) is older than 3.11; name a newer one: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV) >/dev/null 2>&1 || \
	  $(PYTHON) -m venv --clear --without-pip $(VENV)
	@if [ -x $(BIN)/pip ]; then \
	  $(BIN)/python -m pip install $(PIP_OPTIONS) -e '.[dev]'; \
	else \
	  $(PYTHON) -m pip --python $(BIN)/python install $(PIP_OPTIONS) -e '.[dev]'; \
	fi
	@$(BIN)/python -m compileall -q -j 0 -x '/(tests|dialects)/' $(VENV)/lib || true
	@touch $@
