# Everything around the code in one place; `make help` lists the targets.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

# The test tools that apt does not have live in .tools; Debian keeps daemons such as mosquitto in /usr/sbin,
# which is not on the PATH of an ordinary user.
export PATH := $(CURDIR)/.tools/venv/bin:$(CURDIR)/.tools/bin:$(PATH):/usr/sbin:/sbin

# Temporary files of the tests go into a directory of their own, so that nothing of a test that was killed is left. Its name is short,
# as there are sockets in it.
export PYTHONDONTWRITEBYTECODE := 1
IN_OWN_TMP := tests/tools/in_own_tmp.sh

# The steps share cargo's lock and the machine's cores; side by side they only disturb the tests that measure time.
.NOTPARALLEL:
.PHONY: help build test tools install uninstall lint fmt deny advisories bench fuzz check world mutants soak fleet fleet-rollout fleet-cluster fleet-thousand fleet-metrics interop book clean
.PHONY: package-tools deb image release test-package test-static test-image

help: ## Show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1	\2/p' $(MAKEFILE_LIST) | expand -t 22

build: ## Build the optimised binary, target/release/drivegate
	cargo build --release --locked

PROGRAM ?= target/release/drivegate
DESTDIR ?=
SHARE := $(DESTDIR)/usr/share
install: ## Install program, service, manual pages, completions and documents, as root after make build; an existing configuration stays
	@[ -x $(PROGRAM) ] || { echo "error: $(PROGRAM) is missing; run make build first" >&2; exit 1; }
	install -D -m 755 $(PROGRAM) $(DESTDIR)/usr/bin/drivegate
	install -D -m 644 -t $(DESTDIR)/etc/systemd/system systemd/drivegate.service
	install -D -m 644 -t $(DESTDIR)/etc/udev/rules.d systemd/99-drivegate.rules
	[ -e $(DESTDIR)/etc/drivegate/drivegate.toml ] || install -D -m 644 -t $(DESTDIR)/etc/drivegate deploy/drivegate.toml
	install -d $(SHARE)/man/man1 $(SHARE)/bash-completion/completions $(SHARE)/zsh/vendor-completions $(SHARE)/fish/vendor_completions.d
	$(PROGRAM) man $(SHARE)/man/man1
	$(PROGRAM) completions bash >$(SHARE)/bash-completion/completions/drivegate
	$(PROGRAM) completions zsh >$(SHARE)/zsh/vendor-completions/_drivegate
	$(PROGRAM) completions fish >$(SHARE)/fish/vendor_completions.d/drivegate.fish
	for folder in . decisions pictures; do install -D -m 644 -t $(SHARE)/doc/drivegate/$$folder docs/$$folder/*.*; done
	@[ -n "$(DESTDIR)" ] || ! [ -d /run/systemd/system ] || systemctl daemon-reload
	@echo "edit /etc/drivegate/drivegate.toml; then: drivegate check && systemctl enable --now drivegate"

uninstall: ## Remove what make install installed; configuration and state stay
	@[ -n "$(DESTDIR)" ] || ! [ -d /run/systemd/system ] || systemctl disable --now drivegate || true
	rm -f $(DESTDIR)/usr/bin/drivegate $(DESTDIR)/etc/systemd/system/drivegate.service $(DESTDIR)/etc/udev/rules.d/99-drivegate.rules
	rm -f $(SHARE)/man/man1/drivegate.1 $(SHARE)/man/man1/drivegate-*.1 $(SHARE)/bash-completion/completions/drivegate
	rm -f $(SHARE)/zsh/vendor-completions/_drivegate $(SHARE)/fish/vendor_completions.d/drivegate.fish
	rm -rf $(SHARE)/doc/drivegate
	@[ -n "$(DESTDIR)" ] || ! [ -d /run/systemd/system ] || systemctl daemon-reload
	@echo "/etc/drivegate and /var/lib/drivegate stay"

# Most tests wait for other programs and for real time, so three times as many as there are cores run at once.
TEST_THREADS ?= $(shell expr 3 \* "$$(getconf _NPROCESSORS_ONLN)")
# What makes the next build after an edit faster takes a gigabyte, and whoever runs everything edits nothing meanwhile.
test: export CARGO_INCREMENTAL = 0
# Documentation tests first, so that the output ends with the count of a suite that tests the product.
test: tools lint deny advisories check ## Run every check and every test; installs missing test tools first
	$(IN_OWN_TMP) cargo test --locked --workspace --doc
	RUST_TEST_THREADS=$(TEST_THREADS) $(IN_OWN_TMP) cargo test --locked --workspace --exclude drivegate-world --tests --no-fail-fast

tools: ## Install what the tests need (apt, PyPI, cargo); quick when nothing is missing
	@tests/tools/install.sh

lint: ## Check formatting and lints; any warning fails
	cargo fmt --all --check
	cargo clippy --locked --workspace --all-targets -- -D warnings

fmt: ## Format the code
	cargo fmt --all

deny: tools ## Check licences, bans and sources of all dependencies
	cargo deny --locked --workspace --log-level error check licenses bans sources

# A machine without access to the database says so and goes on: what cannot be looked up is no fault of the tree.
ADVISORY_DB := https://github.com/rustsec/advisory-db
advisories: tools ## Check dependencies for known vulnerabilities, where the advisory database can be reached
	@if GIT_TERMINAL_PROMPT=0 timeout 10 git ls-remote --exit-code $(ADVISORY_DB) HEAD >/dev/null 2>&1; then \
		cargo deny --locked --workspace check advisories; \
	else \
		echo "advisories: NOT CHECKED, $(ADVISORY_DB) cannot be reached within 10 s" >&2; \
	fi

bench: ## Run the benchmarks
	cargo bench --locked

FUZZ_RUNS ?= 200000
fuzz: ## Run every fuzz target FUZZ_RUNS times; needs nightly Rust and cargo-fuzz
	for target in $$(cargo +nightly fuzz list); do \
		mkdir -p fuzz/corpus/$$target; \
		cargo +nightly fuzz run -s none "$$target" fuzz/corpus/$$target fuzz/seeds/$$target -- -runs=$(FUZZ_RUNS) -max_len=4096; \
	done

WORLD := cargo test --locked --profile world -p drivegate-world --test world
check: ## Run the seeded world with its fixed seeds: virtual time, no external tools
	$(WORLD)

SEEDS ?= 1000
world: ## Run SEEDS new worlds, or with WORLD_SEED=n that one with its history
	WORLD_SEEDS=$(SEEDS) HOLDER_SEEDS=$(SEEDS) $(WORLD) -- --nocapture fixed only_the_holder

ONLY ?=
mutants: ## Insert known faults into the core; the seeded world must find each. ONLY=name runs one
	tests/world/mutants.py $(ONLY)

HOURS ?= 2
soak: build tools ## Run the gateway for HOURS under faults, floods and hostile clients; its metrics are checked every minute
	tests/soak/soak.py --hours $(HOURS)

N ?= 100
fleet: tools build ## Run N gateways with one broker and one Prometheus on this machine; prints their resource use
	.tools/venv/bin/python tests/fleet/fleet.py --gateways $(N)

PARTS ?=
fleet-rollout: tools build ## Roll out good and bad configurations to 20 gateways with Ansible, which it installs; takes half an hour. PARTS="good cut-off" runs these
	tests/fleet/install.sh ansible
	cd deploy/fleet && ANSIBLE_COLLECTIONS_PATH=playbooks/collections ../../.tools/ansible/bin/ansible-lint --offline
	cd deploy/fleet && PATH="$(CURDIR)/.tools/ansible/bin:$$PATH" DRIVEGATE="$(CURDIR)/target/release/drivegate" molecule test
	.tools/ansible/bin/python tests/fleet/rollout.py $(addprefix --part ,$(PARTS))

BROKERS ?= mosquitto rmqttd ejabberd
fleet-cluster: tools build ## Run gateways with clustered brokers, and fail their nodes; builds rmqttd, which takes many minutes. BROKERS=ejabberd runs that one
	tests/fleet/install.sh $(BROKERS)
	.tools/venv/bin/python tests/fleet/cluster.py $(addprefix --broker ,$(BROKERS))

fleet-thousand: tools build ## Run 100 gateways and 900 more sessions at one broker with TLS: start, rebirths at once, broker back
	cargo bench --locked --no-run --bench sessions
	.tools/venv/bin/python tests/fleet/thousand.py --sessions-binary "$$(ls -t target/release/deps/sessions-* | grep -v '[.]d$$' | head -n 1)"

fleet-metrics: tools build ## Let one Prometheus read 1,000 gateways for ten minutes, with VictoriaMetrics behind it, which it installs
	tests/fleet/install.sh victoria-metrics
	.tools/venv/bin/python tests/fleet/metrics.py

CHECKS ?=
interop: ## Run the gateway with Home Assistant, Node-RED (MQTT, Modbus, BACnet) and pysparkplug, which it installs. CHECKS=name runs one
	tests/interop/run.sh $(CHECKS)

book: ## Build the pages of docs as a site with search, target/book; installs mdbook, which takes a minute
	@tests/tools/mdbook.sh
	tests/tools/book.py

# What ships, in dist/; CONTRIBUTING.md. ARCHITECTURES="amd64" for one of them.
ARCHITECTURES ?= amd64 arm64 armhf
package-tools: ## Install what all packages need for ARCHITECTURES (apt, PyPI, cargo, rustup); quick when nothing is missing
	@deploy/package/tools.sh all $(ARCHITECTURES)

deb: ## Build the Debian packages into dist/ for ARCHITECTURES (amd64 arm64 armhf)
	@deploy/package/tools.sh deb $(ARCHITECTURES)
	deploy/package/deb.sh $(ARCHITECTURES)

image: ## Build the container images into dist/ for ARCHITECTURES
	@deploy/package/tools.sh image $(ARCHITECTURES)
	deploy/package/image.sh $(ARCHITECTURES)

release: ## Build all files of a release into dist/
	@deploy/package/tools.sh release $(ARCHITECTURES)
	deploy/package/release.sh $(ARCHITECTURES)

test-package: ## Install, upgrade, downgrade, remove and purge the packages in a booted Debian, ARM under qemu; needs root
	@deploy/package/tools.sh test-package $(ARCHITECTURES)
	deploy/package/deb.sh $(ARCHITECTURES)
	for each in $(ARCHITECTURES); do deploy/package/test/package.sh dist/drivegate_*_"$$each".deb; done

test-static: ## Start the static binaries of ARCHITECTURES, ARM under qemu: the demo and one command
	@deploy/package/tools.sh test-static $(ARCHITECTURES)
	deploy/package/test/static.sh $(ARCHITECTURES)

test-image: ## Build the images and run them with runc, ARM under qemu; needs root
	@deploy/package/tools.sh test-image $(ARCHITECTURES)
	deploy/package/image.sh $(ARCHITECTURES)
	for each in $(ARCHITECTURES); do deploy/package/test/image.sh dist/drivegate_*_image_"$$each".tar; done

clean: ## Remove everything built or installed here
	cargo clean
	rm -rf .tools dist
