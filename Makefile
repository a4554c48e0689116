# `make` sets everything up and runs the main job; `make test` sets up and runs the tests of the core, `make test-full` all.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
QUADEXP := $(BIN)/quadexp

# One BLAS thread per process: the sweep fills the cores by itself.
export OMP_NUM_THREADS ?= 1

.PHONY: all setup quick test test-full test-fast test-without test-lowest test-python test-interpreted lint docs coverage properties mutation stress reproduce reproduce-torrente reproduce-lei-li reproduce-ladder reproduce-sun reproduce-quick tuned leaderboard test-slow bench embedded clean

all: quick

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -qq --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

# simulate -> collect -> fit -> evaluate on a small sweep; with the set-up three to four minutes on two cores.
quick: $(STAMP)
	$(QUADEXP) simulate controller=nominal_mpc trajectory=circle trajectory.speed=8 --out runs/quick.parquet --force
	$(QUADEXP) collect --out data/residuals.parquet --force
	$(QUADEXP) fit-gp data/residuals.parquet --out models/gp --force
	$(QUADEXP) evaluate --sweep experiment=quick --out results/quick --refly

# One process more than there are cores: tests of sweeps and clusters wait much of their time.
TEST_PROCESSES ?= $(shell echo $$(($$(nproc 2>/dev/null || echo 2) + 1)))
# The processes that tests start read compiled modules, whatever the shell says of writing them.
test test-full test-fast test-interpreted test-slow: export PYTHONDONTWRITEBYTECODE :=
# The core, that it works with any plug-in deleted, and every command of the documentation.
test: $(STAMP)
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist worksteal -m 'not slow' --ignore-glob='*/plugins/*/*' tests examples

# These, and the tests of all plug-ins.
test-full: $(STAMP)
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist worksteal -m 'not slow' tests examples

# Physics, properties, and a flight through every seam: a tenth of `test`.
test-fast: $(STAMP)
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist worksteal -m 'not slow' tests/physics tests/properties \
		tests/experiment/test_compiled_flight.py tests/models/test_contract.py tests/parts/test_parts.py tests/test_walk.py

# The tests of the core with a plug-in deleted, in a copy: make test-without PLUGIN=worlds; several: PLUGIN='worlds laws'
test-without: $(STAMP)
	$(BIN)/python -m tests.without $(PLUGIN) -- -n $(TEST_PROCESSES) --ignore-glob=*/plugins/*/* tests examples

# A selection with the lowest versions that pyproject.toml admits, in an environment of its own.
LOWEST := $(VENV)-lowest
SMOKE := tests/test_versions.py tests/log/test_store.py tests/parts/test_compose.py tests/models/test_contract.py \
	tests/physics tests/plugins/page/test_animation.py tests/plugins/identification/test_recorded_flights.py tests/sweeps/test_results.py
test-lowest:
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install -qq --disable-pip-version-check --constraint constraints-lowest.txt \
		--editable . 'pytest>=8' 'hypothesis>=6.100'
	$(LOWEST)/bin/python -m pytest -m 'not slow' $(SMOKE)

# The same selection with another Python and the newest packages: make test-python PYTHON=python3.14
test-python:
	@command -v $(PYTHON) >/dev/null || { echo "skipped: no $(PYTHON) here"; exit 0; }; \
	$(PYTHON) -m venv $(VENV)-python && \
	$(VENV)-python/bin/python -m pip install -qq --disable-pip-version-check --editable . 'pytest>=8' 'hypothesis>=6.100' && \
	$(VENV)-python/bin/python -m pytest -m 'not slow' $(SMOKE)

# What asks for a compiler where there is one, as on a machine without: control steps, air, plants, worlds, delays. What
# never asks, such as the equations of physics, is the same as in `test-full`; what compiled code alone shows is skipped.
# Of plug-ins: their equations; whole flights are left out.
WHOLE := test_flight *remedies test_beliefs test_targets test_decide
ASKING := models/test_residuals control/test_contracts control/laws/test_law \
	$(addprefix control/mpc/test_,mpc reference_thrust dead_time motor_lead phases riccati) \
	$(addprefix world/test_,air_effects sensors wind world) \
	reference/test_air_model reference/test_partial_air plugins/worlds/test_eskf plugins/papers/test_plant
test-interpreted: $(STAMP)
	CC=none $(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist worksteal -m 'not slow' $(ASKING:%=tests/%.py) \
		tests/plugins/remedies tests/plugins/auto tests/plugins/papers/feedback $(WHOLE:%=--ignore-glob='*/%.py')

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The documentation as a site in build/site, from the same Markdown, without a network.
docs: $(STAMP)
	$(BIN)/python docs/site/build.py

# How much of the core the default tests reach; they assert physics, so a line that is reached is a line that is checked.
CORE := physics control world reference models plugins/remedies plugins/auto plugins/worlds plugins/papers
coverage: $(STAMP)
	$(BIN)/python -m pytest -n auto -m 'not slow' tests/properties tests/plugins/papers/test_lei_li_flights.py tests/compile/test_backend.py \
		$(CORE:%=tests/%) $(subst /,.,$(CORE:%=--cov=quadexp.%)) --cov-report=term-missing:skip-covered --cov-fail-under=95

# The two papers at full size, with figures.
reproduce: reproduce-torrente reproduce-lei-li

# Table I of Torrente et al. 2021.
reproduce-torrente: $(STAMP)
	$(QUADEXP) collect experiment=torrente_table1 --out data/torrente.parquet --force
	$(QUADEXP) fit-gp data/torrente.parquet gp=per_axis --out models/torrente/per_axis --force
	$(QUADEXP) fit-gp data/torrente.parquet gp=zero_mean --out models/torrente/best --force
	$(QUADEXP) evaluate --sweep experiment=torrente_table1 --out results/torrente_table1 --refly

# Examples 1 and 2 of Lei & Li 2017, then both families of controllers on both plants, then changes in mid-flight.
reproduce-lei-li: $(STAMP)
	$(QUADEXP) evaluate --sweep experiment=lei_li_example1 --out results/lei_li_example1 --refly
	$(QUADEXP) evaluate --sweep experiment=lei_li_example2 --out results/lei_li_example2 --refly
	$(QUADEXP) collect vehicle=lei_li plant=blade_element --out data/lei_li_blade_element.parquet --force
	$(QUADEXP) fit-gp data/lei_li_blade_element.parquet vehicle=lei_li gp=blade_element --out models/lei_li/blade_element --force
	$(QUADEXP) collect vehicle=lei_li plant=simplified --out data/lei_li_simplified.parquet --force
	$(QUADEXP) fit-gp data/lei_li_simplified.parquet vehicle=lei_li gp=zero_mean --out models/lei_li/simplified --force
	$(QUADEXP) evaluate --sweep experiment=families --out results/families --refly
	$(QUADEXP) evaluate --sweep experiment=adaptation --out results/adaptation --refly

# What each imperfection of the world costs: data and models of every world in that world, then all flights.
LADDER := clean only_motor_lag only_latency only_late_estimate only_noisy_estimate only_thrust_scale only_battery only_wind everything
reproduce-ladder: $(STAMP)
	for world in $(LADDER); do \
		$(QUADEXP) collect world=$$world --out data/ladder/$$world.parquet --force && \
		$(QUADEXP) fit-gp data/ladder/$$world.parquet --out models/ladder/$$world --force || exit 1; \
	done
	$(QUADEXP) evaluate --sweep experiment=reality_ladder --out results/reality_ladder --refly

# Tables IV and V of Sun et al. 2022, their infeasible set, and the same conditions with ours: 14,044 flights.
reproduce-sun: $(STAMP)
	$(QUADEXP) evaluate --sweep experiment=sun --out results/sun --refly
	$(QUADEXP) evaluate --sweep experiment=sun_infeasible --out results/sun_infeasible --refly
	$(QUADEXP) collect vehicle=sun plant=sun actuator=speed_lag_30ms collect.extent=20 --out data/sun.parquet --force
	$(QUADEXP) fit-gp data/sun.parquet vehicle=sun gp=sun --out models/sun --force
	$(QUADEXP) evaluate --sweep experiment=sun_ours --out results/sun_ours --refly

# Settings tuned with the same budget for every controller, on the same cells (Lei & Li's, on their vehicle); what is
# found becomes options of conf/. A controller, and what is around it behind commas.
TUNED := nominal_mpc linear_drag_mpc gp_mpc online_mpc streaming_gp_mpc geometric pid dfbc rotorpy_se3 \
	nominal_mpc,observer=disturbance nominal_mpc,adaptive=l1 gp_mpc,observer=wind dfbc,rate_loop=indi \
	static_feedback rls_feedback rls_mpc
TUNE_ON := world=clean,only_wind,everything trajectory=circle,lemniscate trajectory.speed=8
TUNE_LEI_LI := vehicle=lei_li plant=blade_element sensor=lei_li
FLIGHTS ?= 360
tuned: $(STAMP)
	$(QUADEXP) collect --out data/tuned.parquet --force
	$(QUADEXP) fit-gp data/tuned.parquet --out models/tuned --no-figures --force
	mkdir -p docs/tuned
	for what in $(TUNED); do \
		case $$what in *mpc*) margin="--delay-margin 0.05";; *) margin=;; esac; \
		case $$what in *_feedback|rls_*) own="$(TUNE_LEI_LI)";; *) own=model=models/tuned;; esac; \
		$(QUADEXP) tune controller=$$(echo $$what | tr , ' ') $$own $(TUNE_ON) --flights $(FLIGHTS) $$margin \
			--out tuned/$$what || exit 1; \
		for file in tuned/$$what/controller/*.yaml tuned/$$what/remedies/*.yaml; do \
			[ ! -f $$file ] || { cp $$file conf/$$(basename $$(dirname $$file))/ && \
				cp tuned/$$what/history.parquet docs/tuned/$$(basename $$file .yaml).parquet; } || exit 1; \
		done; \
	done

# The leaderboard of docs/leaderboard.md: hours with SIZE=standard (two cores), days with SIZE=full; SEEDS=2: the first two only.
SIZE ?= standard
SEEDS ?= 0
leaderboard: $(STAMP)
	$(QUADEXP) bench --size $(SIZE) --seeds $(SEEDS) --out results/leaderboard_$(SIZE) --markdown docs/leaderboard.md
	cp results/leaderboard_$(SIZE)/leaderboard.parquet docs/leaderboard.parquet

# The same claims on fewer flights, as tests that fail where a promised figure is missed; the two papers at the same time.
reproduce-quick: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m slow tests/reproduction

# Every slow test: full sizes, the 200 seeds of each of Lei & Li's examples, odd file systems; ten minutes or more.
test-slow: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist loadscope -m slow tests

# The property tests on up to four hundred examples each, drawn anew every time.
properties: $(STAMP)
	HYPOTHESIS_PROFILE=slow $(BIN)/python -m pytest -n auto tests/properties

# Wrong signs and constants, one at a time: do the tests notice? A drawn sample; MUTANTS=0: all of them, hours.
MUTANTS ?= 20
mutation: $(STAMP)
	$(BIN)/python -m tests.mutation.mutate --sample $(MUTANTS) --seed 0

# 10,000 states and references that no flight should bring, for every model of the air.
stress: $(STAMP)
	$(BIN)/python -m benchmarks.stress

bench: $(STAMP)
	$(BIN)/python -m benchmarks.all

# Exported controllers on an emulated Cortex-M7 and M4F: instructions, flash, RAM and stack, as a table.
embedded: $(STAMP)
	@command -v arm-none-eabi-gcc >/dev/null || \
		{ echo "skipped: no arm-none-eabi-gcc here (packages gcc-arm-none-eabi, libnewlib-arm-none-eabi)"; exit 0; }; \
	$(BIN)/python -m pip install -qq --disable-pip-version-check 'unicorn>=2.1,<3' && mkdir -p results build && \
	{ [ -d build/daqp-0.11.0 ] || { $(BIN)/python -m pip download -qq --no-deps --no-binary daqp daqp==0.11.0 -d build && \
		tar -xzf build/daqp-0.11.0.tar.gz -C build; } || echo "no source of DAQP: its row is left out"; } && \
	{ [ -d models/gp ] || { $(QUADEXP) collect --out data/residuals.parquet --force && \
		$(QUADEXP) fit-gp data/residuals.parquet --out models/gp --no-figures; }; } && \
	$(BIN)/python -m benchmarks.embedded > results/embedded.md && cat results/embedded.md

clean:
	rm -rf $(VENV) $(VENV)-lowest $(VENV)-python build dist *.egg-info
