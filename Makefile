# impc: set-up, checks and runs. `make` alone lists the targets.
# Needs GNU make and a Python from 3.11 to 3.13 with its venv module; for pytope, which is optional,
# a C compiler and the GMP headers.

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help env app demo test full check docs architecture reproduce wheel slow coverage structures plans default-subjects noisy-people nonlinear look search numerics measure bench fuzz lock clean

PYTHON ?= python3
# Not to be set from outside: the environment is made with `venv --clear`.
override VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check -qq
# Bytecode of libraries is a sixth of the environment: Python writes that of what it imports.
INSTALL := $(PIP) install --no-compile --require-hashes
UV := $(shell command -v uv 2>/dev/null || echo $(VENV)/bin/uv)

# Six stamps, each written last, so that a half-made environment is never taken as complete.
FITTING := $(VENV)/.stamp-fitting
LOCKED := $(VENV)/.stamp-locked
PROJECT := $(VENV)/.stamp-project
POLYTOPE := $(VENV)/.stamp-polytope
COMPILED := $(VENV)/.stamp-compiled
FILTER := $(VENV)/.stamp-filter
POLYTOPE_LOG := $(VENV)/polytope-install.log

# Bytecode is kept whatever the environment says: without it each process compiles all it imports.
export PYTHONDONTWRITEBYTECODE :=

PYTEST := OPENBLAS_NUM_THREADS=1 $(PY) -m pytest -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder

SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))

# PYTHON=... on the command line or in the environment asks for that Python: an environment made
# with another version is made again.
ifneq ($(origin PYTHON),file)
VERSION := import sys; print(*sys.version_info[:2])
ifneq ($(shell $(PYTHON) -c '$(VERSION)' 2>/dev/null),$(shell $(PY) -c '$(VERSION)' 2>/dev/null))
$(FITTING): remake
endif
CANDIDATES := $(PYTHON)
else
CANDIDATES := $(PYTHON) python3.13 python3.12 python3.11
endif
.PHONY: remake

help:
	@echo 'make demo       set up .venv, then fit a simulated person: results/fit/report.html'
	@echo 'make app        set up .venv, then everything in the browser, for the folder results'
	@echo 'make test       set up .venv, then check and pytest: about ten minutes'
	@echo 'make full       tests of the site, of all pages, experiments and studies in full size: half an hour'
	@echo 'make check      ruff check, ruff format --check, mypy --strict'
	@echo 'make slow       hundreds of recordings, fits and subjects: up to two hours'
	@echo 'make docs       build the site in docs/_build/html; warnings are errors, examples run (minutes)'
	@echo 'make reproduce  write docs/reproduction: every claim of the dissertation (half an hour)'
	@echo '                DATA=folder: pages in experiments/ from public recordings (half an hour)'
	@echo 'make wheel      build a wheel and run it in empty environments of Python 3.11 and 3.13'
	@echo 'make look       check every kind of report page on desk and phone (needs chromium)'
	@echo 'make measure    sizes of the code, tests and pages (a minute)'
	@echo 'make architecture  draw docs/images/layers.svg from the imports'
	@echo 'make bench      the benchmarks (python -m experiments.benchmarks)'
	@echo 'make search     new examples for the property tests, from a seed that is printed'
	@echo 'make numerics   numerical tests on other processors and dependencies (an hour; needs uv)'
	@echo 'make fuzz       160,000 mutated files, configurations and plants; FUZZ="--seed 1 --cases 1000"'
	@echo 'make lock       compile the lock files again (needs uv); UPGRADE=--upgrade takes newer versions'
	@echo 'make clean      remove caches and build products; .venv and results stay'
	@echo 'Studies, with their results in experiments/README.md: make coverage, noisy-people, structures,'
	@echo 'plans, default-subjects, nonlinear (minutes to hours each).'
	@echo 'PYTHON=python3.12 chooses the Python; otherwise it is the first of python3, python3.13,'
	@echo 'python3.12, python3.11 with a version from 3.11 to 3.13.'

# A person on a seat: three simulated trials, their fit, and the methods side by side.
demo: $(COMPILED)
	$(VENV)/bin/impc simulate seated-balance --out results/subject --formats csv
	$(VENV)/bin/impc example
	$(VENV)/bin/impc fit --config results/subject/subject.toml --out results/fit

# Import, fit and read recordings in the browser.
app: $(COMPILED)
	@mkdir -p results
	$(VENV)/bin/impc app results

# Each test file runs in one process, longest folders first. The shared closed loop is compiled on one
# core while the checks run on the other; no test here uses the filter of sensory noise.
test: $(PROJECT) $(LOCKED) $(POLYTOPE)
	@$(PY) -c 'from impc.cli.warm import compile_loop; compile_loop()' & compiled=$$!; \
	$(MAKE) --no-print-directory check; checked=$$?; wait $$compiled && exit $$checked
	$(PYTEST) -m "not full and not slow"

full: env $(FILTER)
	$(PYTEST) -m "full and not slow"

check: $(PROJECT) $(LOCKED)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy --strict impc plants experiments tests

docs: env
	OPENBLAS_NUM_THREADS=1 $(PY) -m sphinx -W --keep-going -E -b html -q docs docs/_build/html
	@echo 'docs/_build/html/index.html'

architecture: env
	$(PY) -m docs.layers

# DATA=folder: public recordings that are not part of the project (their pages say where they are).
reproduce: env
ifdef DATA
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.rotary_pendulum $(DATA)/rotary-pendulum
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.steering $(DATA)/cphs2017
else
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.reproduction
endif

# The wheel, not the checkout: in empty environments of the oldest and the newest Python, in another folder.
WHEEL_PYTHONS ?= python3.11 python3.13
wheel: env
	rm -rf build dist
	$(PY) -m build --no-isolation --wheel --outdir dist
	@cd dist && for python in $(WHEEL_PYTHONS); do \
	  command -v $$python >/dev/null || { echo "$$python is not on the PATH: not tried"; continue; }; \
	  rm -rf venv && $$python -m venv venv && \
	  venv/bin/python -m pip --disable-pip-version-check -qq install impc-*.whl && \
	  venv/bin/impc example --case A --out example-$$python && \
	  venv/bin/python -c "import impc, plants; assert '/venv/' in impc.__file__, impc.__file__" || exit 1; \
	done

slow: env $(FILTER)
	$(PYTEST) --dist load --maxschedchunk 1 -m slow

coverage: env
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.printed_intervals --recordings 300

# Twenty times the examples of `make test`, other ones each time; SEED=... repeats a search.
SEED ?= $(shell date +%s)
search: env
	@echo 'make search SEED=$(SEED)'
	IMPC_SEARCH=20 OPENBLAS_NUM_THREADS=1 $(PY) -m pytest -m "not slow and not full" --hypothesis-seed=$(SEED) $(SEARCHED)
SEARCHED := tests/inverse/test_inverse_lqr.py tests/inverse/test_equivalent_weights.py tests/control/test_terminal_set.py

# The floors of pyproject.toml on the oldest Python, the newest there are on the newest.
numerics: .venv-oldest/.stamp .venv-newest/.stamp
	.venv-newest/bin/python -m tests.numerics .venv-oldest/bin/python .venv-newest/bin/python

.venv-oldest/.stamp .venv-newest/.stamp: pyproject.toml
	@$(UV) --version >/dev/null 2>&1 || { echo 'make numerics needs uv: pip install uv' >&2; exit 1; }
	$(UV) venv -q --clear --python $(if $(findstring oldest,$@),3.11,3.13) $(@D)
	$(UV) pip install -q --python $(@D) $(if $(findstring oldest,$@),--resolution lowest-direct) -r pyproject.toml --extra dev
	@touch $@

# Hundreds of simulated subjects: the table of experiments/output_feedback.md.
PEOPLE = OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.noisy_people_study
noisy-people: env $(FILTER)
	$(PEOPLE) --subjects 200 --profiles
	$(PEOPLE) --body seat --subjects 20

# Hundreds of simulated subjects: the table of experiments/structures.md.
STUDY = OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.structure_study
structures: env
	$(STUDY) seat --vaf 90
	$(STUDY) seat --vaf 99
	$(STUDY) carts --test-only --subjects 400
	$(STUDY) carts --test-only --root 0.8 --subjects 400
	$(STUDY) carts --test-only --cross 0.5 --subjects 100

# A hundred fits of every experiment: the table of experiments/planning.md.
plans: env
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.plan_study cart --fits 100
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.plan_study seat --fits 100

# Twenty subjects of `impc simulate seated-balance`: the figures of experiments/nonlinear.md.
default-subjects: env
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.default_subjects --seeds 20

# Contrast, names, clipped labels, tab order and size of every kind of report page.
look: env
	OPENBLAS_NUM_THREADS=1 $(PY) -m tests.look $(PAGES)

# The tables of experiments/nonlinear.md: four systems, twenty starts each; closed loops; noise.
nonlinear: env
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.peer_benchmark starts
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.peer_benchmark loops
	OPENBLAS_NUM_THREADS=1 $(PY) -m experiments.peer_benchmark noise

measure: env
	$(PY) -m tests.measure

bench: env
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(PY) -m experiments.benchmarks

# Prints its seed; a case that does not end in one line is kept in results/fuzz.
fuzz: env
	OPENBLAS_NUM_THREADS=1 $(PY) -m tests.fuzz $(FUZZ)

env: $(PROJECT) $(LOCKED) $(POLYTOPE) $(COMPILED)

$(COMPILED): $(wildcard impc/*/compiled_*.py) $(PROJECT)
	@echo 'Compiling, once: half a minute.'
	@OPENBLAS_NUM_THREADS=1 $(VENV)/bin/impc warm
	@touch $@

# The filter of sensory noise: compiled once, before several processes use it, and not for `make env`.
$(FILTER): $(wildcard impc/*/compiled_*.py) $(PROJECT)
	@OPENBLAS_NUM_THREADS=1 $(VENV)/bin/impc warm --sensory-noise
	@touch $@

# What a fit needs. A change of either lock makes the environment anew: nothing old stays in it.
$(FITTING): requirements-demo.lock requirements.lock
	@found=; for python in $(CANDIDATES); do \
	  if "$$python" -c '$(SUPPORTED)' 2>/dev/null; then found=$$python; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	  echo "impc needs Python 3.11, 3.12 or 3.13; $(PYTHON) is" \
	    "$$($(PYTHON) --version 2>/dev/null || echo 'not on the PATH'). Install one, or name it: make PYTHON=python3.12" >&2; \
	  exit 1; \
	fi; \
	echo "Making $(VENV) with $$($$found --version): half a minute, and 0.9 GB."; \
	if ! "$$found" -m venv --clear $(VENV) >/dev/null 2>&1; then \
	  echo "$$found cannot make a virtual environment. On Debian and Ubuntu:" \
	    "apt install python$$($$found -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv" >&2; \
	  exit 1; \
	fi
	@$(INSTALL) -r requirements-demo.lock
	@touch $@

# The tools of developers, and every extra.
$(LOCKED): $(FITTING)
	@echo "Adding what checks and tests need: half a minute, and 0.4 GB."
	@$(INSTALL) -r requirements.lock
	@touch $@

# setuptools comes from the lock: nothing that is not pinned enters by way of the build.
$(PROJECT): pyproject.toml $(FITTING)
	@$(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

# pytope and pycddlib: optional, built from source. A failure is one line, does not stop make, and is
# tried again next time. Homebrew keeps its headers where no compiler looks.
$(POLYTOPE): requirements-polytope.lock $(LOCKED)
	@cc=$${CC:-cc}; has() { printf '#include <%s>\nint main(void) { return 0; }\n' "$$1" | \
	  $$cc $$CPPFLAGS $$CFLAGS -I"$$($(PY) -c 'import sysconfig; print(sysconfig.get_path("include"))')" \
	    -x c -c -o /dev/null - 2>/dev/null; }; \
	if brew=$$(brew --prefix 2>/dev/null); then \
	  export C_INCLUDE_PATH="$$brew/include:$$C_INCLUDE_PATH" LIBRARY_PATH="$$brew/lib:$$LIBRARY_PATH"; \
	fi; \
	if $(PY) -m pip install --require-hashes --no-deps --no-build-isolation --use-pep517 \
	    -r requirements-polytope.lock >$(POLYTOPE_LOG) 2>&1; then touch $@; exit 0; fi; \
	if ! has stdio.h; then what="no C compiler"; \
	  how="Debian: apt install build-essential python3-dev libgmp-dev; Fedora: dnf install gcc python3-devel gmp-devel; Homebrew: xcode-select --install && brew install gmp"; \
	elif ! has Python.h; then what="no Python.h"; \
	  how="Debian: apt install python3-dev; Fedora: dnf install python3-devel; Homebrew: brew reinstall python3"; \
	elif ! has gmp.h; then what="no gmp.h"; \
	  how="Debian: apt install libgmp-dev; Fedora: dnf install gmp-devel; Homebrew: brew install gmp"; \
	else what="the build failed"; how="the reason is in the log"; fi; \
	echo "pytope is not installed: $$what ($$how). Everything but the pytope border still works; log: $(POLYTOPE_LOG)" >&2

lock:
	@$(UV) --version >/dev/null 2>&1 || { echo 'make lock needs uv: pip install uv' >&2; exit 1; }
	UV_CUSTOM_COMPILE_COMMAND='make lock' $(UV) pip compile --quiet $(UPGRADE) --universal --python-version 3.11 \
	  --extra dev --generate-hashes pyproject.toml -o requirements.lock
	echo setuptools | UV_CUSTOM_COMPILE_COMMAND='make lock' $(UV) pip compile --quiet --universal --python-version 3.11 \
	  --extra app --constraints requirements.lock --no-annotate --generate-hashes pyproject.toml - -o requirements-demo.lock
	pair=$$(sed -n 's/^polytope = \[\(.*\)\]$$/\1/p' pyproject.toml | tr -d '",') && test -n "$$pair" && \
	  printf '%s\n' $$pair | UV_CUSTOM_COMPILE_COMMAND='make lock' $(UV) pip compile --quiet $(UPGRADE) --universal \
	  --python-version 3.11 --no-deps --generate-hashes - -o requirements-polytope.lock

clean:
	rm -rf build dist docs/_build docs/_results docs/_examples docs/_reference *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name $(VENV) -prune -o -type d -name __pycache__ -prune -exec rm -rf {} +
