# Only GNU make and a Python 3.11-3.13 with pip are assumed; everything else comes from requirements.lock into .venv.
PYTHON ?= python3
VENV   ?= .venv
JOBS   ?= 2
ARGS   ?=
FIGURE ?=

BIN   := $(VENV)/bin
STAMP := $(VENV)/.installed
CODE  := $(wildcard src envs tests benchmarks examples)

# Tests start hundreds of processes: without bytecode each of them compiles the source of all that it imports, for a second.
test test-slow campaigns: export PYTHONDONTWRITEBYTECODE :=

# A file's tests share what they compile, so a file stays on one core.
PYTEST := $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder --durations 10

.DEFAULT_GOAL := help
.PHONY: help setup train test test-slow campaigns check format bench bench-compare figures docs pictures lock clean
.DELETE_ON_ERROR:

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo
	@echo '  PYTHON=python3.12 chooses the interpreter of a new .venv; ARGS="..." goes to the program that the target runs.'

setup: $(STAMP) ## make .venv with the locked dependencies and this project (again only if the lock or pyproject.toml changed)

train: $(STAMP) ## learn the cart-pole swing-up; settings: make train ARGS="trials=3 seed=1"
	$(BIN)/pegasus-train $(if $(filter task=% resume=% --help -h,$(ARGS)),,task=cartpole) $(ARGS)

test: $(STAMP) ## run the quick tests on JOBS=2 cores, within 15 minutes; some of them: make test ARGS="-k layers"
	$(PYTEST) -m "not slow and not campaign" $(ARGS)

test-slow: $(STAMP) ## run the tests that make test leaves out: whole runs, kills, the pages of docs/, short campaigns
	$(PYTEST) -m "slow and not campaign" $(ARGS)

campaigns: $(STAMP) ## run the long campaigns of kills, damages, bad commands and stops, and what repeats slow tests: an hour or more
	$(BIN)/python -m pytest -m campaign $(ARGS)

check: $(STAMP) ## formatting, lint, types, layers: everything that needs no training
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/ruff check $(CODE)
	$(BIN)/pyright
	$(BIN)/python -m pytest -q tests/test_layers.py

format: $(STAMP) ## format the code and fix what lint can fix
	$(BIN)/ruff check --fix --exit-zero --quiet $(CODE)
	$(BIN)/ruff format $(CODE)

bench: $(STAMP) ## measure speed
	$(BIN)/python -m benchmarks.speed.suite $(ARGS)

bench-compare: $(STAMP) ## measure speed again and fail if it is below .77 of the stored run's; quicker: ARGS="quick=true"
	$(BIN)/python -m benchmarks.speed.suite out=$(VENV)/speed.json $(ARGS)
	$(BIN)/python -m benchmarks.speed.compare $(VENV)/speed.json

figures: $(STAMP) ## run one of the paper's experiments: make figures FIGURE=crn
	$(BIN)/python -m benchmarks.paper benchmarks/paper/$(FIGURE).toml out=benchmarks/results $(ARGS)

docs: $(STAMP) ## build the documentation site into site/, without a network; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict $(ARGS)

pictures: $(STAMP) ## draw the pictures of README.md and docs/ again
	$(BIN)/python -m benchmarks.pictures $(ARGS)

lock: $(BIN)/python ## write requirements.lock again, for every Python and platform; newer versions: make lock ARGS=--upgrade
	test -x $(BIN)/uv || $(BIN)/python -m pip install uv
	UV_CUSTOM_COMPILE_COMMAND="make lock" $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --extra dev \
	  --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate $(ARGS) pyproject.toml -o requirements.lock

clean: ## remove .venv and every cache; runs/ stays
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache .hypothesis
	find $(CODE) -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11, 3.12 or 3.13 is needed and $(PYTHON) is not one: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null && $(PYTHON) -m venv $(VENV) || \
	  { $(PYTHON) -m venv --without-pip $(VENV) && $(PYTHON) -m pip --python $(VENV)/bin/python install --quiet pip; }

# uv installs in a tenth of pip's time; it comes from the lock too. It does not read pip's settings: where they name the
# only index that can be reached, pip installs. The project itself is a second command, because an editable install has
# no hash; its build backend, hatchling, is in the lock.
LOCKED  = pip install -qq --require-hashes -r requirements.lock
PROJECT = pip install -qq --no-deps --no-build-isolation --editable .
$(STAMP): requirements.lock pyproject.toml | $(BIN)/python
	@echo 'installing requirements.lock into $(VENV) (half a minute and 1.5 GB)'
	@awk '/^uv==/, !/\\$$/' requirements.lock > $(VENV)/uv.txt
	@$(BIN)/python -m pip install -qq --require-hashes -r $(VENV)/uv.txt
	@VIRTUAL_ENV=$(VENV) $(BIN)/uv $(LOCKED) || $(BIN)/python -m $(LOCKED)
	@VIRTUAL_ENV=$(VENV) $(BIN)/uv $(PROJECT) || $(BIN)/python -m $(PROJECT)
	@touch $@
