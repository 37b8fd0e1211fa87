# Every target sets up all it needs in .venv; nothing else on the machine is touched. `make help` lists them.

PYTHON ?= python3
VENV := .venv
OLDEST := .venv-oldest
DESCRIPTION := setup.py setup.cfg pyproject.toml
# There are wheels of ROS 2 for Linux and these versions of Python. Where they neither fit nor are needed, since
# an installed ROS has been sourced, they are left out; where there is no ROS the tests of the node are skipped.
LACKS_ROS = import importlib.util, sys; \
  fits = sys.platform == "linux" and (3, 10) <= sys.version_info < (3, 14); \
  sys.exit(not fits or importlib.util.find_spec("rclpy") is not None)
TEST_EXTRAS = $(shell $(PYTHON) -c '$(LACKS_ROS)' && echo test,ros || echo test)

# A folder that `python -m venv` or pip left half done has no stamp, and is made anew.
MADE = $(@D)/.made
define make_venv
@test -f $(MADE) && $(@D)/bin/python -c '' 2>/dev/null || { \
  echo "Making $(@D) with $$($(PYTHON) --version)" && rm -rf $(@D) && $(PYTHON) -m venv $(@D) && touch $(MADE); } || { \
  echo "$(PYTHON) cannot make a virtual environment; on Ubuntu: sudo apt install python3-venv"; exit 1; }
endef
# The tests of the node mostly wait for one another's processes, so two at a time take half as long.
PARALLEL = --numprocesses auto --dist worksteal
PIP = $(@D)/bin/python -m pip install --quiet --disable-pip-version-check

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-oldest check clean

help: ## list these targets
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 22

demo: $(VENV)/.installed ## calibrate a bundled recording and print the result beside the known truth
	@$(VENV)/bin/python experiments/demo.py

test: check ## static checks and the whole suite
	@$(VENV)/bin/python -m pytest $(PARALLEL)

check: $(VENV)/.installed-test ## ruff and mypy --strict
	@$(VENV)/bin/python -m ruff check .
	@$(VENV)/bin/python -m ruff format --check .
	@$(VENV)/bin/python -m mypy

test-oldest: $(OLDEST)/.installed-test ## the suite on the oldest versions of numpy, scipy, OpenCV ... that setup.py admits
	@$(OLDEST)/bin/python -m pytest $(PARALLEL)

clean: ## remove what these targets and colcon made
	rm -rf $(VENV) $(OLDEST) build install log demo_output *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache

$(VENV)/.installed: $(DESCRIPTION)
	$(make_venv)
	@echo "Installing fewcal into $(@D)"
	@$(PIP) --editable .
	@touch $@

$(VENV)/.installed-test: $(DESCRIPTION)
	$(make_venv)
	@echo "Installing fewcal and what its tests need into $(@D)"
	@$(PIP) --editable '.[$(TEST_EXTRAS)]'
	@touch $@ $(@D)/.installed

$(OLDEST)/.installed-test: $(DESCRIPTION) constraints-oldest.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info >= (3, 13))' || { \
	  echo "numpy 1.26 needs Python 3.10 to 3.12: make test-oldest PYTHON=python3.12"; exit 1; }
	$(make_venv)
	@echo "Installing fewcal on its oldest dependencies into $(@D)"
	@$(PIP) --constraint constraints-oldest.txt --editable '.[$(TEST_EXTRAS)]'
	@# Ubuntu's OpenCV 4.6 has the contrib modules, and so the markers, which that of PyPI has from 4.7 on.
	@$(PIP) --no-deps --force-reinstall opencv-contrib-python-headless==4.6.0.66
	@touch $@
