# Every target works on a machine that has only Python >= 3.11 and make: the first one builds .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PROTO := proto/hmt_service/service/v1/hmt.proto
PROTOC = $(BIN)/python -m grpc_tools.protoc -I proto

.DEFAULT_GOAL := test
.PHONY: demo test lint bench proto proto-is-fresh docs clean

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python >= 3.11 is needed")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -c constraints.txt -e '.[dev]'
	$(BIN)/python -c 'from hmt_service.core import kernels; kernels.compile_all()'
	touch $@

demo: $(INSTALLED)
	$(BIN)/hmt demo --out out/demo

test: $(INSTALLED)
	$(BIN)/pytest -n 2 --dist loadfile

lint: $(INSTALLED) proto-is-fresh
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(INSTALLED)
	$(BIN)/python -m benchmarks

proto: $(INSTALLED)
	$(PROTOC) --python_out=. --pyi_out=. $(PROTO)

proto-is-fresh: $(INSTALLED)
	@fresh=$$(mktemp -d) && trap 'rm -rf "$$fresh"' EXIT && \
	$(PROTOC) --python_out="$$fresh" --pyi_out="$$fresh" $(PROTO) && \
	for suffix in py pyi; do \
		file=$(PROTO:proto/%.proto=%)_pb2.$$suffix; \
		diff "$$file" "$$fresh/$$file" || { echo "$$file is stale: run 'make proto'"; exit 1; }; \
	done

docs: $(INSTALLED)
	$(BIN)/python docs/generate.py

clean:
	rm -rf $(VENV) build dist out *.egg-info
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache .coverage
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
