# Two commands: `make demo` makes the demonstration's report, `make test` runs the tests. Each sets up what it needs, once.
SHELL := /bin/bash
PYTHON ?= python3.11
VENV := .venv
PY := $(VENV)/bin/python
STUDY ?= demo
PROFILE ?= default
# Named by what it was installed from, so that changed pins mean a new installation and a removed folder does as well.
INSTALLED := $(VENV)/.installed-$(shell cat constraints.txt pyproject.toml | sha256sum | cut -c1-16)
SNAKEMAKE = $(PY) -m snakemake --workflow-profile profiles/$(PROFILE) --config study=configs/studies/$(STUDY).yaml

.PHONY: demo smoke study resume test validate gallery bench setup system
.DEFAULT_GOAL := demo

demo: ## the demonstration: results/demo/report.html, in about eighteen minutes on two cores
	@$(MAKE) --no-print-directory study STUDY=demo

smoke: ## every part once, in about a minute: results/smoke/report.html
	@$(MAKE) --no-print-directory study STUDY=smoke

study: setup ## any study, on any machine: make study STUDY=paper PROFILE=slurm (docs/clusters.md)
	@$(SNAKEMAKE)
	@echo "Done: results/$(STUDY)/report.html"

resume: study ## after a kill or a power cut: make resume STUDY=demo continues where it stopped, as make study does

test: setup
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .
	@$(PY) -m mypy
	@$(PY) -m pytest -n 2 --dist loadfile

validate: setup ## the solvers against formulae and experiments, at three resolutions: docs/validation.md
	@$(PY) -m sim.validation

gallery: setup ## a film strip of every domain: docs/gallery.md
	@$(PY) -m sim.gallery

bench: setup
	@for program in benchmarks/*.py; do echo "== $$program"; $(PY) $$program || exit 1; done

setup: $(INSTALLED)
	@$(PY) -m workflow.scripts.libraries

$(INSTALLED): constraints.txt pyproject.toml
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "$(PYTHON) with its venv module is needed: apt-get install -y python3.11 python3.11-venv, or make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@test -x $(PY) || $(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV) (once; about three minutes)"
	@$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@rm -f $(VENV)/.installed-* && touch $@

system: ## the system libraries that films are drawn with
	@as=$$([ "$$(id -u)" = 0 ] || echo sudo); $$as apt-get update -qq && \
		$$as apt-get install -y -qq --no-install-recommends libgl1 libegl1 libxrender1
