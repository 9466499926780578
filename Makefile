# Everything runs with the Python of .venv, whatever else is active or registered.
# Options are given on the command line (make workbook PROFILE=smoke), never by the environment.
# For those that say yes or no, 0 means no.

PYTHON  = python3.11
PROFILE = reader
SEED    = 0
OUT     =
ONLY    =
ARGS    =
FORCE   =
DRY_RUN =
WORKERS = 2
JOBS    = 2
INDEX   =
PUSHT   =

PY     := .venv/bin/python
STAMP  := .venv/.installed
INPUTS := requirements.txt constraints.txt pyproject.toml

# JupyterLab asks nobody outside for news or updates.
QUIET  := {"@jupyterlab/apputils-extension:notification": {"fetchNews": "false", "checkForUpdates": false}}

# Where Linux has its setpriv, a command ends with the make that has started it, even a killed one.
LEASH         := $(if $(shell command -v setpriv),setpriv --pdeathsig TERM)
SHELL         := $(firstword $(LEASH) /bin/bash)
.SHELLFLAGS   := $(wordlist 2,9,$(LEASH) /bin/bash -eu -o pipefail -c)
.DEFAULT_GOAL := help
MAKEFLAGS     += --no-print-directory
# What seems to come from the future (unpacked in another time zone) would never be older.
$(shell find Makefile $(INPUTS) affordlib experiments notebooks data -newermt now -exec touch -c {} + 2>/dev/null)
.SUFFIXES:

yes = $(filter-out 0 no false,$(1))

export PROFILE SEED WORKERS OUT ONLY ARGS FORCE JOBS INDEX
override FORCE   := $(call yes,$(FORCE))
override DRY_RUN := $(call yes,$(DRY_RUN))
override PUSHT   := $(call yes,$(PUSHT))
export PYTHONUTF8 := 1
# OpenMP's idle threads spin for milliseconds, which makes PyTorch seven times slower beside other
# work. A tenth of that costs a fifth of the speed of a machine that has nothing else to do.
export GOMP_SPINCOUNT := 20000
unexport PYTHONPATH PYTHONHOME PYTHONSTARTUP PYTHONIOENCODING PYTHONWARNINGS VIRTUAL_ENV
unexport MPLBACKEND MATPLOTLIBRC
unexport PIP_USER PIP_TARGET PIP_PREFIX PIP_REQUIREMENT PIP_CONSTRAINT
unexport PYTEST_ADDOPTS JUPYTER_PATH JUPYTER_TOKEN

.PHONY: help setup workbook nano lab slides test test-fast test-plain test-slow size book-check lint format bench data checkpoints notebooks html tables \
        constraints clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(STAMP) ## Make .venv and install everything into it (PYTHON=python3.11 PUSHT=1)
	@$(if $(PUSHT),$(if $(shell grep -s '^uv = ' .venv/pyvenv.cfg),uv pip,$(PY) -m pip) install --quiet $(if $(INDEX),--extra-index-url "$$INDEX") -c constraints.txt -r requirements-pusht.txt)
	@echo "The environment is ready: .venv"

# The stamp is written last and holds the folder. Without it (never finished) or with another
# folder in it (moved) the environment is made again; otherwise pip brings it up to date. A second
# make waits for the first, and then has nothing to do. An environment that uv made, uv keeps.
ifneq ($(shell cat $(STAMP) 2>/dev/null),$(CURDIR))
.PHONY: $(STAMP)
endif

$(STAMP): $(INPUTS)
	@[[ "$$(uname -sm)" == "Linux x86_64" ]] \
	  || { echo "This workbook needs Linux on x86-64: PyBullet has no wheel for $$(uname -sm). A container (Dockerfile) or, on Windows, WSL is one." >&2; exit 1; }
	@grep -qs '^uv = ' .venv/pyvenv.cfg || [[ "$$("$(PYTHON)" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)" == 3.11 ]] \
	  || { echo "This workbook needs Python 3.11, as PyBullet has no wheel for a later one, and '$(PYTHON)' is $$("$(PYTHON)" -c 'import sys; print("Python " + sys.version.split()[0])' 2>/dev/null || echo 'no Python that runs here')." \
	            "Install it (your system's python3.11-venv, 'uv python install 3.11' or 'conda create -n py311 python=3.11'), or name it: make setup PYTHON=/path/to/python3.11" >&2; exit 1; }
	@exec 9< Makefile; flock 9; \
	 if [[ "$$(cat $@ 2>/dev/null)" == "$(CURDIR)" && -z "$$(find $(INPUTS) -newer $@)" ]]; then exit 0; fi; \
	 quietly() { "$$@" > .venv/install.log 2>&1 || { tail -n 25 .venv/install.log >&2; exit 1; }; }; \
	 if grep -qs '^uv = ' .venv/pyvenv.cfg; then \
	   rm -f $@; uv sync $(if $(INDEX),--index "$$INDEX" --index-strategy unsafe-best-match); \
	 else \
	   if [[ "$$(cat $@ 2>/dev/null)" != "$(CURDIR)" ]]; then \
	     [[ ! -L .venv ]] || { echo "'.venv' is a link to $$(readlink .venv), which would be emptied; remove the link" >&2; exit 1; }; \
	     echo "Making .venv (a few minutes, once)"; "$(PYTHON)" -m venv --clear .venv; \
	   else \
	     echo "Bringing .venv up to date"; rm $@; \
	   fi; \
	   quietly $(PY) -m pip install --progress-bar off --disable-pip-version-check $(if $(INDEX),--extra-index-url "$$INDEX") -c constraints.txt -r requirements.txt; \
	   quietly $(PY) -m pip install --disable-pip-version-check --no-deps --no-build-isolation -e .; \
	 fi; \
	 mkdir -p .venv/share/jupyter/lab/settings; \
	 echo '$(QUIET)' > .venv/share/jupyter/lab/settings/overrides.json; \
	 printf '%s' "$(CURDIR)" > $@

# Make calls itself, with RUN and the pages as goals. Several pages at a time, with one thread each,
# finish earlier than one after the other with several threads.

workbook: $(STAMP) ## Run all pages into runs/, two at a time (PROFILE=smoke|reader|full WORKERS= SEED= OUT= ONLY= ARGS= FORCE=1 DRY_RUN=1)
notebooks: $(STAMP) ## Execute the committed pages in place and clean their metadata (ONLY= FORCE=1)
notebooks: export IN_PLACE := 1
workbook notebooks:
	@set -f; goals=$$($(PY) notebooks/pages.py); run=$${goals%% *}; \
	 [[ "$$WORKERS" =~ ^[1-9][0-9]?$$ ]] || { echo "WORKERS must be a whole number from 1 to 99" >&2; exit 1; }; \
	 $(if $(DRY_RUN),,mkdir -p "$$run"; exec 9>> "$$run/.lock"; flock -n 9 || { echo "Another run is writing to $$run; wait for it, or choose another name with OUT=" >&2; exit 1; };) \
	 exec $(MAKE) $(if $(DRY_RUN),-n,-s) $(if $(findstring jobserver,$(MAKEFLAGS)),,-j"$$WORKERS") RUN="$$run" $${goals#* }

ifdef RUN
# Copies of results are no input. A name with a blank, which make cannot express, is not ours.
USED := $(STAMP) $(wildcard notebooks/*.py) $(shell find affordlib experiments notebooks/exercises data -type f \
  ! -path '*/.*' ! -path '*/__pycache__/*' ! -path 'data/results/[0-9][0-9]_*' ! -path '* *' 2>/dev/null)
define PAGES
$(RUN)/%.ipynb $(RUN)/%.json: $(1)/%.ipynb $(USED)
	@$(if $(filter-out 1,$(WORKERS)),OMP_NUM_THREADS=1) exec $(PY) notebooks/run.py $$< $$(@D)/$$*.ipynb
endef
$(foreach folder,notebooks notebooks/appendix,$(eval $(call PAGES,$(folder))))
# These two plan with the network that page 03 trains, if it is run as well.
$(RUN)/06_planning.ipynb $(RUN)/07_closed_loop.ipynb: | $(filter %/03_affordance_cnp.ipynb,$(MAKECMDGOALS))
endif

nano: $(STAMP) ## Gather, learn, plan and push: the whole idea on one page, in a minute
	@$(MAKE) -s workbook ONLY=nano FORCE=1

lab: $(STAMP) ## Open the book in JupyterLab, on this machine only (ARGS="--port 9999 --no-browser")
	@set -f; root=; [[ $$(id -u) == 0 ]] && root=--allow-root; \
	  JUPYTER_PREFER_ENV_PATH=1 exec $(PY) -m jupyterlab --ip=127.0.0.1 $$root \
	  --ServerApp.root_dir="$(CURDIR)" --LabApp.default_url=/lab/tree/notebooks/00_start_here.ipynb $$ARGS

# One thread, because tests compute many small operations and share the machine with a browser.
test test-fast test-plain: export OMP_NUM_THREADS := 1

test: $(STAMP) ## Run all tests, including the notebooks (JOBS=2 in parallel)
	@$(PY) -m pytest -n "$$JOBS" --dist loadfile --no-loadscope-reorder --durations=15

test-fast: $(STAMP) ## Run only the fast tests, without the notebooks
	@$(PY) -m pytest -n "$$JOBS" --dist worksteal -m "not slow"

test-plain: $(STAMP) ## Run the fast tests without vector instructions, as on another processor
	@ATEN_CPU_CAPABILITY=default $(if $(filter x86_64,$(shell uname -m)),OPENBLAS_CORETYPE=Nehalem) \
	  NPY_DISABLE_CPU_FEATURES="$$($(PY) -c 'import numpy._core._multiarray_umath as m; print(*(f for f in m.__cpu_dispatch__ if m.__cpu_features__[f]))')" \
	  $(PY) -m pytest -n "$$JOBS" --dist worksteal -m "not slow"

test-slow: $(STAMP) ## Run every notebook and solution as a reader does; the log is runs/test-slow.log
	@mkdir -p runs; { $(LEASH) $(MAKE) workbook PROFILE=reader OUT=test-slow FORCE=1; \
	  $(PY) -m pytest tests/test_exercises.py tests/show/test_browser*.py; } 2>&1 | tee runs/test-slow.log

size: $(STAMP) ## Count lines and files, and fail if they exceed the budgets
	@$(PY) -m tests.size

book-check: $(STAMP) ## Measure every page of the book, and fail if one violates the style
	@PYTHONPATH=notebooks $(PY) -m tests.book_check

lint: $(STAMP) ## Check style and formatting
	@$(PY) -m ruff check
	@$(PY) -m ruff format --check

format: $(STAMP) ## Format the code, notebooks included
	@$(PY) -m ruff check --fix
	@$(PY) -m ruff format

bench: $(STAMP) ## Run the benchmarks, and write the times to runs/speed.json
	@$(PY) -m experiments.speed

data: $(STAMP) ## Collect the shipped data sets again and compare them with the existing ones
	@$(PY) -m experiments.shipped data

checkpoints: $(STAMP) ## Train the shipped models again (ONLY="film_500")
	@$(if $(ONLY),,$(PY) -m experiments.shipped reachability)
	@set -f; $(PY) -m experiments.shipped checkpoints $(if $(ONLY),--only $$ONLY)

slides: $(STAMP) ## Write ten figures of the book with their captions into figures/slides, for those who teach
	@$(PY) notebooks/slides.py

html: $(STAMP) ## Write the book as web pages into runs/html, readable offline: open index.html
	@rm -rf runs/html.new runs/jupyter_execute
	@$(PY) -m sphinx -q -c notebooks/book_html -d runs/jupyter_execute/doctrees . runs/html.new
	@rm -rf runs/html runs/jupyter_execute && mv runs/html.new runs/html
	@echo "Open runs/html/index.html"

tables: $(STAMP) ## Fill the tables of README, RESULTS and data card from data/results
	@$(PY) -m experiments.tables README.md RESULTS.md data/README.md

constraints: $(STAMP) ## Write constraints.txt, and its copy in pyproject.toml, from the installed packages
	@{ sed '/^$$/q' constraints.txt; \
	   $(PY) -m pip freeze --all --exclude pip --exclude affordlib -r requirements.txt \
	     | sed -e '1,/^## The following/d' -e 's/+[^ ]*$$//' -e '/^cuda-/d' -e '/^nvidia-/d' -e '/^triton=/d'; } > constraints.txt.tmp
	@mv constraints.txt.tmp constraints.txt
	@{ sed '/^constraint-dependencies/q' pyproject.toml; sed -n 's/^[^#].*/    "&",/p' constraints.txt; echo ']'; } > pyproject.toml.tmp
	@mv pyproject.toml.tmp pyproject.toml

clean: ## Remove runs/, caches and build files, but not .venv
	@rm -rf runs build dist *.egg-info .pytest_cache .ruff_cache notebooks/.ipynb_checkpoints
	@find affordlib tests experiments -name __pycache__ -type d -prune -exec rm -rf {} +
