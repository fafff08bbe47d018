# Each command sets up what it needs and nothing more: `make demo` never installs torch.
.PHONY: demo test check bench clean

demo:
	@sh deploy/bootstrap.sh demo
	@.venv/bin/uavpose-replay demo --out out/demo

test:
	@sh deploy/bootstrap.sh dev
	@.venv/bin/python -m pytest -n 3 --dist loadfile

check:
	@sh deploy/bootstrap.sh dev
	@.venv/bin/ruff check edge msgs sim_replay trainer tests
	@.venv/bin/ruff format --check edge msgs sim_replay trainer tests
	@.venv/bin/mypy
	@.venv/bin/lint-imports

bench:
	@sh deploy/bootstrap.sh demo
	@.venv/bin/uavpose-edge bench

clean:
	rm -rf .venv out build
