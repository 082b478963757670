# make demo       install into .venv and run a campaign on a real hillside, whose map is old
# make test       install what the tests need too, and run them
# make jupyter    install JupyterLab and open copies of the notebooks, in out/notebooks
#                 (in a container: make jupyter LAB=--ip=0.0.0.0)
# make notebooks  run the notebooks, with fewer missions than they show
# make slow       run the tests that take long, which make test leaves out
# make lint       format, style, types, the direction of imports, and which files are tracked
# make gate       list tables, figures and notebooks that this version may not reproduce
# make docs       build the documentation site, and say where to open it
# make bench      install the peers, and print the figures we claim beside theirs
# make peers      ask pip whether the peers and JupyterLab can be installed, and install nothing
# make clean      remove what make made, but not the campaigns and notebooks in out/

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
# A worker for each core, of which each takes up to 1.5 GB.
PYTEST := $(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist worksteal

# JupyterLab refuses to run as root, the usual user of a container, unless it is told to.
AS_ROOT = $(if $(filter 0,$(shell id -u)),--allow-root)
# More options of JupyterLab.
LAB =

# Where a container's shell says so, Python would compile all modules anew at each start, 7 s.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test jupyter notebooks slow lint gate docs bench peers clean

demo: $(VENV)/.installed
	$(BIN)/python scripts/demo.py --out out/demo

# A fresh clone compiles for long what most tests run for short. Without optimisation, tests of NUTS
# take longer, but all tests together take a little less. nbmake, which runs notebooks, takes a second
# to import in each process.
test: $(VENV)/.installed-dev
	XLA_FLAGS=--xla_backend_optimization_level=0 $(PYTEST) -p no:nbmake -m "not slow" tests

# Copies, as JupyterLab saves what it runs, and notebooks write files beside themselves.
jupyter: $(VENV)/.installed-notebook
	mkdir -p out/notebooks
	for file in notebooks/*.ipynb; do [ -e out/$$file ] || cp $$file out/$$file; done
	$(BIN)/jupyter lab $(AS_ROOT) $(LAB) out/notebooks

notebooks: $(VENV)/.installed-dev
	rm -rf out/nbmake
	mkdir -p out/nbmake
	cp notebooks/*.ipynb out/nbmake
	TRUSTBO_FAST=1 $(PYTEST) --nbmake out/nbmake

slow: $(VENV)/.installed-dev
	$(PYTEST) -m slow tests

lint: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports
	$(BIN)/python scripts/check_files.py

# Both lists are of interest, also if the first one is not empty.
gate: $(VENV)/.installed-dev
	$(BIN)/python scripts/gate.py; stale=$$?; \
		$(BIN)/python scripts/compare_notebooks.py && exit $$stale

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs out/docs
	@echo "open out/docs/index.html"

# A script that fails does not stop the others.
bench: $(VENV)/.installed-bench
	@failed=; for script in benchmarks/*.py; do \
		echo "$$script" && $(BIN)/python $$script || failed="$$failed $$script"; \
	done; [ -z "$$failed" ] || { echo "failed:$$failed"; exit 1; }

peers: $(VENV)/.installed
	$(PIP) --dry-run --editable ".[bench,notebook]"

clean:
	rm -rf $(VENV) .cache .hypothesis .pytest_cache .ruff_cache .import_linter_cache __pycache__
	rm -rf build dist out/docs out/nbmake docs/_build docs/generated docs/notebooks notebooks/out maps.png
	find src tests benchmarks docs examples notebooks scripts -type d \
		\( -name __pycache__ -o -name .ipynb_checkpoints \) -prune -exec rm -rf {} +

$(BIN)/python:
	@python=$$(sh scripts/find_python.sh) && echo "creating $(VENV) with $$python" && \
		"$$python" -m venv --clear $(VENV)

# The stamps make a second call fast; they are renewed when what is to be installed changes.
# Python compiles modules when they are first imported; to compile all of them takes half a minute.
$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --no-compile --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) --editable ".[test,dev]"
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(PIP) --editable ".[docs]"
	@touch $@

$(VENV)/.installed-notebook: $(VENV)/.installed
	$(PIP) --editable ".[notebook]"
	@touch $@

# The samplers we compare ourselves with.
$(VENV)/.installed-bench: $(VENV)/.installed
	$(PIP) --editable ".[bench]"
	@touch $@
