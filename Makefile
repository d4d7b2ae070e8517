# Verbs: install, demo, demo-quick, check, format, test, test-all, schemas, clean. All work from a fresh clone.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/installed

.PHONY: install demo demo-quick check format test test-all schemas benchmarks clean

install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or later is needed; name one with: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@echo "Compiling the kernels by reconstructing half a second: once, about a minute"
	@rm -rf .venv/first
	@$(BIN)/worldpose simulate --scenario tiny --duration 0.5 --out .venv/first/tiny
	@$(BIN)/worldpose run .venv/first/tiny --project .venv/first/project
	@rm -rf .venv/first
	@touch $(INSTALLED)

# What the demo reconstructs: a match of 25 people; demo-quick takes 5 people and 6 cameras.
demo: MATCH := --scenario match --seed 1 --duration 4
demo-quick: MATCH := --scenario tiny --seed 1 --duration 1
demo demo-quick: install
	@rm -rf demo
	@echo "1/4  a synthetic match with known truth"
	@$(BIN)/worldpose simulate $(MATCH) --out demo/match
	@echo "2/4  the factory: Prefect flow, Dask tasks, Zarr store"
	@$(BIN)/worldpose run demo/match --project demo/project
	@echo "3/4  figures against truth"
	@$(BIN)/worldpose evaluate --prediction demo/match --reference demo/match/reference --project demo/project
	@echo "4/4  the report"
	@$(BIN)/worldpose report demo/match --project demo/project --out demo/report.html

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Processes begin with neighbouring tests, which share what they made, and take over the rest of others.
PYTEST := $(BIN)/pytest --numprocesses auto --maxprocesses 4 --dist worksteal

test: install check
	$(PYTEST) -m "not slow"

test-all: install check
	$(PYTEST)

schemas: install
	$(BIN)/python -m data_contracts.schemas docs/schemas

benchmarks: install
	@for script in benchmarks/*.py; do echo "$$script"; $(BIN)/python $$script || exit 1; done

clean:
	rm -rf .venv demo build dist *.egg-info
