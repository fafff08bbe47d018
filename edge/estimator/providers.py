"""What hardware the network runs on: ONNX Runtime's execution providers, with the CPU as fallback."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    fallback_reason: str | None = None

    def confirmed(self, running: Sequence[str]) -> ChosenProvider:
        """Corrected by what the session really runs on: a built-in provider may still lack its driver or libraries."""
        if self.names[0] in running:
            return self
        reason = (
            f"{self.names[0]} is built in but did not start: its driver or libraries are missing; "
            f"running on {running[0].removesuffix('ExecutionProvider')}"
        )
        actual: Provider = "cuda" if running[0] == NAMES["cuda"][0] else "cpu"
        return replace(self, provider=actual, fallback_reason=reason)


def choose_provider(wanted: Provider, available: Sequence[str]) -> ChosenProvider:
    """`wanted` if ONNX Runtime was built with it, else the CPU with the reason. Pure."""
    first = NAMES[wanted][0]
    if first in available:
        return ChosenProvider(wanted, tuple(name for name in NAMES[wanted] if name in available))
    reason = f"this ONNX Runtime was built without {first} (the package {PACKAGES[wanted]} has it); running on the CPU"
    return ChosenProvider("cpu", NAMES["cpu"], reason)
