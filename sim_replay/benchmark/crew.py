"""Worker processes that run tasks in parallel, each with its own resources (a renderer).

The parent exchanges tasks and results with each worker through a pipe. Anything that arrives at a busy worker, also
the end of the pipe when the parent was killed, means: stop at the next opportunity. So no worker outlives the parent,
however it ends.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Literal, TypeVar

from edge.errors import InputError
from sim_replay.flight import FlightError
from sim_replay.render.backdrop import BackdropError

STOP_TIMEOUT_S = 60.0  # for the frame in progress, on a slow machine

T = TypeVar("T")
Tell = Callable[[Any], None]
Stopped = Callable[[], bool]


class CrewError(RuntimeError):
    """A worker failed; the text is a whole sentence."""


@dataclass(frozen=True)
class Said:
    """A worker's message about its task: progress, result, or refused (its input is unusable)."""

    task: int  # its index among the tasks
    kind: Literal["news", "done", "failed", "refused"]
    value: Any  # picklable


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    task: int | None = None


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def crew(do: Callable[[T, Tell, Stopped], Any], tasks: Sequence[T], workers: int) -> Iterator[Said]:
    """Run all tasks, and yield the workers' messages as they come.

    `do` runs in the workers, so it must be picklable: it may report progress, and returns soon once it is stopped.
    Closing the iterator, or an exception in the parent, first stops every worker. Raises CrewError, and InputError for
    what the user must correct.
    """
    waiting = deque(range(len(tasks)))

    def hand_out(worker: _Worker) -> None:
        worker.task = waiting.popleft() if waiting else None
        if worker.task is not None:
            worker.pipe.send((worker.task, tasks[worker.task]))

    with _staff(do, min(workers, len(tasks))) as staff:
        for worker in staff:
            hand_out(worker)
        while busy := {worker.pipe: worker for worker in staff if worker.task is not None}:
            for pipe in wait(list(busy)):
                worker = busy[pipe]  # type: ignore[index]
                said = _heard(worker)
                if said.kind == "failed":
                    raise CrewError(said.value)
                if said.kind == "refused":
                    raise InputError(said.value)
                yield said
                if said.kind == "done":
                    hand_out(worker)


def _heard(worker: _Worker) -> Said:
    try:
        said: Said = worker.pipe.recv()
    except (EOFError, OSError) as error:
        worker.process.join(STOP_TIMEOUT_S)
        raise CrewError(f"a worker ended with exit code {worker.process.exitcode}") from error
    return said


@contextmanager
def _staff(do: Callable[..., Any], count: int) -> Iterator[list[_Worker]]:
    context = multiprocessing.get_context("spawn")  # a GL context does not survive a fork
    threads = max(1, available_cores() // max(count, 1))
    staff: list[_Worker] = []
    try:
        for _ in range(count):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, do, threads))
            process.start()
            theirs.close()
            staff.append(_Worker(process, ours))
        yield staff
    finally:
        for worker in staff:
            worker.pipe.close()
        for worker in staff:
            worker.process.join(STOP_TIMEOUT_S)
            if worker.process.is_alive():
                worker.process.kill()


def _work(pipe: Connection, do: Callable[..., Any], threads: int) -> None:
    """A worker's main loop. Ctrl-C, or SIGTERM to the group, also reaches the parent, which closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    limit_threads(threads)
    while not pipe.closed:
        try:
            number, task = pipe.recv()
        except (EOFError, OSError):
            return
        _tell(pipe, _done(pipe, do, number, task))


def _done(pipe: Connection, do: Callable[..., Any], number: int, task: Any) -> Said:
    try:
        value = do(task, lambda news: _tell(pipe, Said(number, "news", news)), lambda: pipe.closed or pipe.poll())
    except FlightError as error:
        return Said(number, "refused", f"{error}; shorter sequences or another --seed may do")
    except (InputError, BackdropError) as error:
        return Said(number, "refused", str(error))
    except OSError as error:
        return Said(number, "failed", str(error))
    return Said(number, "done", value)


def _tell(pipe: Connection, said: Said) -> None:
    if not pipe.closed:
        try:
            pipe.send(said)
        except OSError:
            pipe.close()  # the parent is gone


def limit_threads(threads: int) -> None:
    """Limit rendering and filtering in this process to this many threads; call it before the first image."""
    import cv2

    os.environ["LP_NUM_THREADS"] = str(threads)  # read by Mesa when it creates a software context
    cv2.setNumThreads(threads)
