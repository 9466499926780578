# Everything runs with the Python of .venv, whatever else is active or registered.
# Options are given on the command line (make workbook PROFILE=smoke), never by the environment.

PYTHON  = python3.11
PROFILE = reader
SEED    = 0
OUT     =
ONLY    =
ARGS    =
FORCE   =
KEEP    =
DRY_RUN =
SEEDS   = 0 1 2
WORKERS = 2
JOBS    = 2

PY     := .venv/bin/python
STAMP  := .venv/.installed
INPUTS := requirements.txt constraints.txt pyproject.toml

# JupyterLab asks nobody outside for news or updates.
QUIET  := {"@jupyterlab/apputils-extension:notification": {"fetchNews": "false", "checkForUpdates": false}}

SHELL         := /bin/bash
.SHELLFLAGS   := -eu -o pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS     += --no-print-directory
.SUFFIXES:

export PROFILE SEED SEEDS WORKERS OUT ONLY ARGS
# OpenMP's idle threads spin for milliseconds, which makes PyTorch seven times slower beside other
# work. A tenth of that costs a fifth of the speed of a machine that has nothing else to do.
export GOMP_SPINCOUNT := 20000
unexport PYTHONPATH PYTHONHOME PYTHONSTARTUP VIRTUAL_ENV MPLBACKEND
unexport PIP_USER PIP_TARGET PIP_PREFIX PIP_REQUIREMENT PIP_CONSTRAINT
unexport PYTEST_ADDOPTS JUPYTER_PATH JUPYTER_TOKEN

.PHONY: help setup workbook seeds lab test test-fast test-plain test-slow soak size book-check lint format bench data checkpoints notebooks html tables \
        constraints clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(STAMP) ## Make .venv and install everything into it (PYTHON=python3.11)
	@echo "The environment is ready: .venv"

# The stamp is written last and holds the folder. Without it (never finished) or with another
# folder in it (moved) the environment is made again; otherwise pip brings it up to date. A second
# make waits for the first, and then has nothing to do.
ifneq ($(shell cat $(STAMP) 2>/dev/null),$(CURDIR))
.PHONY: $(STAMP)
endif

$(STAMP): $(INPUTS)
	@[[ "$$("$(PYTHON)" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)" == 3.11 ]] \
	  || { echo "This workbook needs Python 3.11, and '$(PYTHON)' is $$("$(PYTHON)" -c 'import sys; print("Python " + sys.version.split()[0])' 2>/dev/null || echo 'no Python that runs here')." \
	            "Install it, or name it: make setup PYTHON=/path/to/python3.11" >&2; exit 1; }
	@exec 9< Makefile; flock 9; \
	 if [[ "$$(cat $@ 2>/dev/null)" != "$(CURDIR)" ]]; then \
	   [[ ! -L .venv ]] || { echo "'.venv' is a link to $$(readlink .venv), which would be emptied; remove the link" >&2; exit 1; }; \
	   echo "Making .venv (a few minutes, once)"; "$(PYTHON)" -m venv --clear .venv; \
	 elif [[ -n "$$(find $(INPUTS) -newer $@)" ]]; then \
	   echo "Bringing .venv up to date"; rm $@; \
	 else \
	   exit 0; \
	 fi; \
	 $(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -r requirements.txt; \
	 $(PY) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .; \
	 mkdir -p .venv/share/jupyter/lab/settings; \
	 echo '$(QUIET)' > .venv/share/jupyter/lab/settings/overrides.json; \
	 printf '%s' "$(CURDIR)" > $@

# Two notebooks in parallel with one thread each finish earlier than in sequence with two threads.
workbook: $(STAMP) ## Run all notebooks into runs/, two in parallel (PROFILE=smoke|reader|full WORKERS= SEED= OUT= ONLY= ARGS= DRY_RUN=1)
	@set -f; $(if $(filter-out 1,$(WORKERS)),OMP_NUM_THREADS=1) $(PY) -m affordlib.workbook --workers "$$WORKERS" --profile "$${PROFILE:-reader}" --seed "$${SEED:-0}" \
	  --out "$$OUT" --only "$$ONLY" $(if $(FORCE),--force) $(if $(DRY_RUN),--dry-run) -- $$ARGS

seeds: $(STAMP) ## Run all notebooks for several seeds, and write tables over seeds (SEEDS="0 1 2" WORKERS=2 …)
	@set -f; $(PY) -m experiments.seeds $$SEEDS --workers "$$WORKERS" \
	  --profile "$${PROFILE:-reader}" --out "$$OUT" --only "$$ONLY" $(if $(FORCE),--force) $(if $(DRY_RUN),--dry-run) \
	  --settings $$ARGS

lab: $(STAMP) ## Open the book in JupyterLab, on this machine only
	@root=; [[ $$(id -u) == 0 ]] && root=--allow-root; \
	  JUPYTER_PREFER_ENV_PATH=1 $(PY) -m jupyterlab --ip=127.0.0.1 $$root \
	  --ServerApp.root_dir="$(CURDIR)" --LabApp.default_url=/lab/tree/notebooks/00_start_here.ipynb

# One thread, because tests compute many small operations and share the machine with a browser.
test test-fast test-plain: export OMP_NUM_THREADS := 1

test: $(STAMP) ## Run all tests, including the notebooks (JOBS=2 in parallel)
	@$(PY) -m pytest -n "$(JOBS)" --dist loadfile --no-loadscope-reorder --durations=15

test-fast: $(STAMP) ## Run only the fast tests, without the notebooks
	@$(PY) -m pytest -n "$(JOBS)" --dist worksteal -m "not slow"

test-plain: $(STAMP) ## Run the fast tests without vector instructions, as on another processor
	@ATEN_CPU_CAPABILITY=default $(if $(filter x86_64,$(shell uname -m)),OPENBLAS_CORETYPE=Nehalem) \
	  NPY_DISABLE_CPU_FEATURES="$$($(PY) -c 'import numpy._core._multiarray_umath as m; print(*(f for f in m.__cpu_dispatch__ if m.__cpu_features__[f]))')" \
	  $(PY) -m pytest -n "$(JOBS)" --dist worksteal -m "not slow"

test-slow: $(STAMP) ## Run every notebook and solution as a reader does; the log is runs/test-slow.log
	@mkdir -p runs; { $(PY) -m affordlib.workbook --profile reader --out test-slow --force; \
	  $(PY) -m pytest tests/test_exercises.py tests/show/test_browser*.py; } 2>&1 | tee runs/test-slow.log

soak: $(STAMP) ## Plan and execute 3,000 times; check that memory and results stay the same (15 min)
	@OMP_NUM_THREADS=1 $(PY) -m tests.soak

size: $(STAMP) ## Count lines and files, and fail if they exceed the budgets
	@$(PY) -m tests.size

book-check: $(STAMP) ## Measure every page of the book, and fail if one violates the style
	@$(PY) -m tests.book_check

lint: $(STAMP) ## Check style and formatting
	@$(PY) -m ruff check
	@$(PY) -m ruff format --check

format: $(STAMP) ## Format the code, notebooks included
	@$(PY) -m ruff check --fix
	@$(PY) -m ruff format

bench: $(STAMP) ## Run the benchmarks (KEEP=1 writes the times to data/results/speed.json)
	@$(PY) -m experiments.speed $(if $(KEEP),--keep)

data: $(STAMP) ## Collect the shipped data sets again and compare them with the existing ones
	@$(PY) -m experiments.shipped data

checkpoints: $(STAMP) ## Train the shipped models again (ONLY="film_500")
	@$(if $(ONLY),,$(PY) -m experiments.shipped reachability)
	@$(PY) -m experiments.shipped checkpoints $(if $(ONLY),--only $(ONLY))

notebooks: $(STAMP) ## Execute the committed notebooks in place and clean their metadata (ONLY= FORCE=1)
	@$(PY) -m affordlib.workbook --in-place --only "$$ONLY" $(if $(FORCE),--force)

html: $(STAMP) ## Write the book as web pages into runs/html, readable offline: open index.html
	@rm -rf runs/html.new runs/jupyter_execute
	@$(PY) -m sphinx -q -c notebooks/book_html -d runs/jupyter_execute/doctrees . runs/html.new
	@rm -rf runs/html runs/jupyter_execute && mv runs/html.new runs/html
	@echo "Open runs/html/index.html"

tables: $(STAMP) ## Fill the tables of README, RESULTS and data card from data/results
	@$(PY) -m experiments.tables README.md RESULTS.md data/README.md

constraints: $(STAMP) ## Write constraints.txt from the installed packages
	@{ sed -n '/^#/p;/^[^#]/q' constraints.txt; \
	   $(PY) -m pip freeze --all --exclude pip --exclude affordlib -r requirements.txt \
	     | sed -e '1,/^## The following/d' -e 's/+[^ ]*$$//'; } > constraints.txt.tmp
	@mv constraints.txt.tmp constraints.txt

clean: ## Remove runs/, caches and build files, but not .venv
	@rm -rf runs build dist *.egg-info .pytest_cache .ruff_cache .hypothesis notebooks/.ipynb_checkpoints
	@find affordlib tests experiments -name __pycache__ -type d -prune -exec rm -rf {} +
