# Two commands do everything on a fresh machine: `make demo` and `make test`.
#   make demo              the main job on simulated streets, some minutes on two cores
#   make demo DATA=FOLDER  the same on your own KITTI-style scans
#   make test              all checks and all tests
#   make environment       .venv alone, which all others make if it is missing; a few minutes, see install.sh
#   make docs              the documentation as a site, in site/
#   make package           a wheel, installed where nothing else is, and tried; minutes, most of them for torch

PYTHON ?= python3
BIN := .venv/bin

.PHONY: environment demo test check docs package

environment: .venv/.complete

demo: .venv/.complete
	$(BIN)/lidargrit demo $(if $(DATA),--data "$(DATA)") $(if $(OUT),--out "$(OUT)")

# Commands that tests kill may leave no bytecode behind, so it is made before.
test: check
	$(BIN)/python -m compileall -q src
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile

check: .venv/.complete
	$(BIN)/ruff check src tests benchmarks examples docs
	$(BIN)/ruff format --check src tests benchmarks examples docs
	$(BIN)/pyright
	$(BIN)/lint-imports

docs: .venv/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

package: .venv/.complete
	$(BIN)/python tests/package/try_wheel.py

.venv/.docs: .venv/.complete
	sh install.sh docs
	touch $@

# The mark is made last: an interrupted installation is taken up again.
.venv/.complete: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	sh install.sh dev
	touch $@
