"""Forward and backward pass as a CUDA graph: what it may not contain, and, where there is a GPU, what it computes."""

from __future__ import annotations

from typing import Any

import pytest
import tiny
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.profiler import ProfilerActivity, profile
from torch.utils._pytree import tree_leaves

from trainer.graphed import Graphed
from trainer.guidance import drawn_guide
from trainer.trainer import Trainer

CPU = torch.device("cpu")
EITHER = pytest.mark.parametrize("with_rounding", [False, True], ids=["float", "rounded"])


def inputs() -> tuple[Tensor, ...]:
    image, labels = tiny.batch()
    return image, *labels, drawn_guide(len(image), 0.5, torch.Generator().manual_seed(1))


class Copies(TorchFunctionMode):
    """Calls that make a tensor on a device from numbers or a tensor of the processor."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        devices = lambda tree: {leaf.device.type for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)}  # noqa: E731
        copying = func in (torch.tensor, torch.as_tensor) or "cpu" in devices((args, kwargs))
        if copying and devices(made) == {"meta"}:
            self.names.append(str(func))
        return made


@EITHER
def test_the_passes_read_nothing_back(with_rounding: bool) -> None:
    trainer = Trainer(tiny.config(), CPU)
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        trainer._passes(with_rounding, *inputs())
    names = {event.key for event in seen.key_averages()}
    assert "aten::convolution_backward" in names
    assert not names & {"aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::unique_dim"}


@EITHER
def test_the_passes_copy_nothing_to_the_device_but_once(with_rounding: bool) -> None:
    trainer = Trainer(tiny.config(), CPU)
    trainer.model.to("meta")
    given = [tensor.to("meta") for tensor in inputs()]
    trainer._passes(with_rounding, *given)
    with Copies() as copies:
        trainer._passes(with_rounding, *given)
    assert copies.names == []
    with copies:
        torch.tensor([1.0], device="meta")
        torch.eye(2).to("meta")
    assert len(copies.names) == 2, "copies would have been seen"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no CUDA GPU")
@EITHER
def test_a_graph_computes_what_its_passes_compute(with_rounding: bool) -> None:
    trainer = Trainer(tiny.config(), torch.device("cuda"))
    given = [tensor.cuda() for tensor in inputs()]
    statistics = [buffer.clone() for buffer in trainer.model.buffers()]
    expected = {name: value.item() for name, value in trainer._passes(with_rounding, *given).items()}
    gradients = [None if p.grad is None else p.grad.clone() for p in trainer.model.parameters()]
    after = [buffer.clone() for buffer in trainer.model.buffers()]
    graphed = Graphed(trainer._passes, trainer.model)
    for _ in range(2):  # captured, then replayed
        for buffer, before in zip(trainer.model.buffers(), statistics, strict=True):
            buffer.copy_(before)
        got = {name: value.item() for name, value in graphed(with_rounding, *given).items()}
        assert got == pytest.approx(expected, rel=0.02, abs=1e-3)
        for parameter, gradient in zip(trainer.model.parameters(), gradients, strict=True):
            torch.testing.assert_close(parameter.grad, gradient, rtol=0.05, atol=0.02)
        for buffer, value in zip(trainer.model.buffers(), after, strict=True):
            torch.testing.assert_close(buffer, value, rtol=0.02, atol=1e-3)
