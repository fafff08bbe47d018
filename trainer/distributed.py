"""Data-parallel training under `torchrun`: every process has its own samples, and all take the same step.

Gradients are averaged explicitly, because a step calls several methods of the network instead of one forward.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Group:
    """The processes that train one network together. With a single process, all methods do nothing."""

    rank: int = 0
    size: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def first(self) -> bool:
        """Whether this is the process that logs, validates and saves."""
        return self.rank == 0

    def average(self, tensors: Iterable[Tensor]) -> None:
        """Replace each tensor by its mean over the processes, in one message."""
        kept = list(tensors)
        if self.size == 1 or not kept:
            return
        flat = torch.cat([t.detach().flatten() for t in kept])
        dist.all_reduce(flat)
        flat /= self.size
        for tensor, mean in zip(kept, flat.split([t.numel() for t in kept]), strict=True):
            tensor.detach().copy_(mean.view_as(tensor))

    def agreed(self, value: float) -> float:
        """The first process's value, returned in all processes."""
        if self.size == 1:
            return value
        told = torch.tensor(value, dtype=torch.float64, device=self.device)
        dist.broadcast(told, src=0)
        return float(told)

    def largest(self, value: float) -> float:
        """The largest of the processes' values."""
        if self.size == 1:
            return value
        told = torch.tensor(value, dtype=torch.float64, device=self.device)
        dist.all_reduce(told, op=dist.ReduceOp.MAX)
        return float(told)


@contextlib.contextmanager
def joined_group() -> Iterator[Group]:
    """The group that torchrun's environment describes (gloo on CPUs, nccl on GPUs), or a group of one."""
    cuda = torch.cuda.is_available()
    if "RANK" not in os.environ:
        yield Group(device=torch.device("cuda" if cuda else "cpu"))
        return
    device = torch.device(f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if cuda else "cpu")
    if cuda:
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if cuda else "gloo")
    try:
        yield Group(dist.get_rank(), dist.get_world_size(), device)
    finally:
        dist.destroy_process_group()
