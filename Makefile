# make run    the main job on the embedded default scene: a picture and a point cloud under outputs/
# make test   the tests
# make lint types   what is checked beside them: ruff, and mypy
# Both make .venv on their first call. Another Python: make PYTHON=python3.12 test. Overrides: make run ARGS="scene=su".
PYTHON ?= python3
VENV ?= .venv
ARGS ?=
STAMP := $(VENV)/.installed

.PHONY: run test slow fuzz lint types clean setup results docs tal
run: $(STAMP)
	$(VENV)/bin/python train.py $(ARGS)

# Two files of tests at a time, with a thread each, the longest first (tests/conftest.py).
test: $(STAMP)
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

slow: $(STAMP)
	$(VENV)/bin/python -m pytest -m slow $(ARGS)

# All robustness runs, for hours: docs/robustness.md. Without atheris (Linux alone) files are changed at random.
fuzz: $(STAMP)
	$(VENV)/bin/python -m pip install -q -r scripts/requirements-fuzz.txt || echo "no atheris: changes are drawn at random"
	OMP_NUM_THREADS=1 PYTHONPATH=. $(VENV)/bin/python tests/robust/campaign.py

lint: $(STAMP)
	$(VENV)/bin/python -m ruff check .
	$(VENV)/bin/python -m ruff format --check .

types: $(STAMP)
	$(VENV)/bin/python -m mypy

# The tables and figures of docs/results.md, from what `python results.py all size=full` has left under outputs/evidence/full.
results: $(STAMP)
	$(VENV)/bin/python results.py page $(ARGS)

# The documentation as a site, into site/; fails where a link leads nowhere.
docs: $(STAMP)
	$(VENV)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	$(VENV)/bin/python -m mkdocs build --strict

# y-tal for tests/baselines/test_baseline_tal.py
tal: .venv-tal/.installed
.venv-tal/.installed: scripts/requirements-tal.txt
	$(PYTHON) -m venv .venv-tal
	.venv-tal/bin/python -m pip install -r $<
	touch $@

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt scripts/setup.sh
	scripts/setup.sh $(PYTHON) $(VENV)
	touch $@

clean:
	rm -rf $(VENV) .venv-tal build site *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
