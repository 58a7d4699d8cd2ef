# make run    the main job on the embedded default scene: a picture and a point cloud under outputs/
# make test   the tests
# Both make .venv on their first call. Another Python: make PYTHON=python3.12 test. Overrides: make run ARGS="scene=su".
PYTHON ?= python3
VENV ?= .venv
ARGS ?=
STAMP := $(VENV)/.installed

.PHONY: run test slow lint clean setup
run: $(STAMP)
	$(VENV)/bin/python train.py $(ARGS)

test: $(STAMP)
	$(VENV)/bin/python -m pytest $(ARGS)

slow: $(STAMP)
	$(VENV)/bin/python -m pytest -m slow $(ARGS)

lint: $(STAMP)
	$(VENV)/bin/python -m ruff check .

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt scripts/setup.sh
	scripts/setup.sh $(PYTHON) $(VENV)
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .hypothesis
