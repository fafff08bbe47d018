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

bench: out/models/mf-uavpose6d-edge-unmeasured-fp32.onnx out/models/mf-uavpose6d-paper-unmeasured-fp32.onnx
	@sh deploy/bootstrap.sh dev
	@.venv/bin/uavpose-edge bench edge/estimator/models/mf-uavpose6d-edge-int8.onnx $^

out/models/mf-uavpose6d-edge-unmeasured-fp32.onnx: trainer/checkpoints/mf-uavpose6d-edge.pt trainer/configs/edge.toml
	@sh deploy/bootstrap.sh dev
	@.venv/bin/uavpose-trainer export --checkpoint $< --config trainer/configs/edge.toml --unmeasured --out $(@D)

out/models/mf-uavpose6d-paper-unmeasured-fp32.onnx: trainer/configs/paper.toml
	@sh deploy/bootstrap.sh dev
	@.venv/bin/uavpose-trainer export --untrained $< --out $(@D)

clean:
	rm -rf .venv out build
