# Everything a developer types. `make help` lists it.
#
# PURE=1 builds without GDAL and PROJ: `PURE=1 make demo`.

SHELL := /bin/bash
.DEFAULT_GOAL := help
# A fresh rustup is on the PATH of new shells only.
export PATH := $(PATH):$(HOME)/.cargo/bin

PURE ?=
FEATURES := $(if $(PURE),--no-default-features)
SETUP := $(if $(PURE),--pure)

.PHONY: help setup build demo test bench docs fmt

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-6s  %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo '  PURE=1      with build or demo: pure Rust, without GDAL and PROJ'

setup: ## install what the build needs (Debian and Ubuntu), or say what is missing
	@scripts/setup.sh $(SETUP)

build: setup ## build the program, target/release/sat3d
	cargo build --release --locked $(FEATURES)

demo: setup ## simulate a small city, build its benchmark, compare it with the truth, in ./demo
	@scripts/demo.sh $(FEATURES)

test: setup ## everything that CI checks; a summary at the end
	@scripts/test.sh

bench: ## measure speed: micro benchmarks, then the same images beside a rasterio script
	@scripts/setup.sh $(SETUP) --peers
	@if grep -q '^\[\[bench\]\]' Cargo.toml; then cargo bench --locked; fi
	@benches/peers/run.sh

docs: setup ## the library's documentation, target/doc/sat3d/index.html
	RUSTDOCFLAGS='-D warnings' cargo doc --locked --no-deps

fmt: ## format the source
	cargo fmt
