"""Passes of a training step as CUDA graphs.

A step is thousands of small kernels, which a GPU computes faster than a processor starts them one by one. A graph
starts them all at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

WARM_UP_RUNS = 3  # in which PyTorch allocates, and cuDNN chooses its algorithms

Compute = Callable[..., Mapping[str, Tensor]]


class _Graph(NamedTuple):
    graph: torch.cuda.CUDAGraph
    inputs: list[Tensor]
    outputs: Mapping[str, Tensor]
    gradients: list[Tensor | None]


class Graphed:
    """`compute(kind, *tensors)`, which leaves gradients in the parameters of `model`, as one graph for each kind and
    shape of its tensors.

    It must not copy anything from or to the processor. The outputs are overwritten by the next call.
    """

    def __init__(self, compute: Compute, model: nn.Module) -> None:
        self.compute, self.model = compute, model
        self._graphs: dict[tuple[object, ...], _Graph] = {}

    def __call__(self, kind: bool, *tensors: Tensor) -> Mapping[str, Tensor]:
        key = (kind, *(tensor.shape for tensor in tensors))
        if key not in self._graphs:
            self._graphs[key] = self._captured(kind, tensors)
        graph, inputs, outputs, gradients = self._graphs[key]
        for kept, tensor in zip(inputs, tensors, strict=True):
            kept.copy_(tensor)
        graph.replay()
        for parameter, gradient in zip(self.model.parameters(), gradients, strict=True):
            parameter.grad = gradient
        return outputs

    def _captured(self, kind: bool, tensors: tuple[Tensor, ...]) -> _Graph:
        inputs = [tensor.clone() for tensor in tensors]
        statistics = [buffer.clone() for buffer in self.model.buffers()]
        beside = torch.cuda.Stream()
        beside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(beside):
            for _ in range(WARM_UP_RUNS):
                self.compute(kind, *inputs)
        torch.cuda.current_stream().wait_stream(beside)
        for buffer, before in zip(self.model.buffers(), statistics, strict=True):
            buffer.copy_(before)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            outputs = self.compute(kind, *inputs)
        return _Graph(graph, inputs, outputs, [parameter.grad for parameter in self.model.parameters()])
