"""What hardware the network runs on: ONNX Runtime's execution providers, with the CPU as fallback."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Provider = Literal["cpu", "cuda", "tensorrt", "openvino"]

# In ONNX Runtime's order of preference: nodes that one cannot run are assigned to the next.
NAMES: dict[Provider, tuple[str, ...]] = {
    "cpu": ("CPUExecutionProvider",),
    "cuda": ("CUDAExecutionProvider", "CPUExecutionProvider"),
    "tensorrt": ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"),
    "openvino": ("OpenVINOExecutionProvider", "CPUExecutionProvider"),
}
PACKAGES: dict[Provider, str] = {
    "cpu": "onnxruntime",
    "cuda": "onnxruntime-gpu",
    "tensorrt": "onnxruntime-gpu",
    "openvino": "onnxruntime-openvino",
}


@dataclass(frozen=True)
class ChosenProvider:
    """The execution providers to request for a session."""

    provider: Provider
    names: tuple[str, ...]  # as ONNX Runtime calls them
    failures: tuple[str, ...] = ()  # of those preferred to these, each a clause

    @property
    def fallback_reason(self) -> str | None:
        """A sentence; None: it is the requested provider."""
        if not self.failures:
            return None
        return f"{'; '.join(self.failures)}; running on {'the CPU' if self.provider == 'cpu' else self.provider}"

    def confirmed(self, running: Sequence[str]) -> ChosenProvider:
        """Corrected by what the session really runs on: a built-in provider may still lack its driver or libraries."""
        if self.names[0] in running:
            return self
        return self._next(
            running[0], f"{self.names[0]} is built in but did not start: its driver or libraries are missing"
        )

    def not_started(self, why: str) -> ChosenProvider:
        """The next one, where opening a session with this one raised the error `why`."""
        return self._next(self.names[1], f"{self.names[0]} did not start: {why}")

    def failed(self, why: str) -> ChosenProvider:
        """The CPU, where an inference raised the error `why`: the device may be gone, whatever software drives it."""
        return self._next(NAMES["cpu"][0], f"{self.names[0]} failed: {why}")

    def _next(self, first: str, failure: str) -> ChosenProvider:
        provider: Provider = "cuda" if first == NAMES["cuda"][0] else "cpu"
        return ChosenProvider(provider, NAMES[provider], (*self.failures, failure))


def choose_provider(wanted: Provider, available: Sequence[str]) -> ChosenProvider:
    """`wanted` if ONNX Runtime was built with it, else the CPU with the reason. Pure."""
    first = NAMES[wanted][0]
    if first in available:
        return ChosenProvider(wanted, tuple(name for name in NAMES[wanted] if name in available))
    failure = f"this ONNX Runtime was built without {first} (the package {PACKAGES[wanted]} has it)"
    return ChosenProvider("cpu", NAMES["cpu"], (failure,))
