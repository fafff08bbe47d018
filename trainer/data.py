"""The data feed: rendering processes prepare batches ahead of training and deliver them in index order.

Sample i is a pure function of (seed, i, size), so the position in the stream is one integer, and a resumed run sees
exactly the samples of an uninterrupted one. Neither this nor `sources.py` imports torch, which would cost each
rendering process seconds and memory.
"""

from __future__ import annotations

import logging
import multiprocessing as mp
import os
import queue
import signal
import sys
import threading
import traceback
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.sample import SampleBatch
from trainer.config import ConfigError, RenderingError

DENSE_STRIDE = 4
STOPPING = (signal.SIGINT, signal.SIGTERM)


class Sampler(Protocol):
    """Source of a feed's batches: sim_replay.sampler.WindowSampler, or a DatasetSampler (returns TrainingBatch)."""

    def batch(self, first_index: int, count: int) -> SampleBatch | TrainingBatch: ...


class TrainingBatch(NamedTuple):
    """A sampler's batch in compact form for transfer: dense labels at stride 4, boxes as centre and size."""

    image_bgr: NDArray[np.uint8]  # [N, H, W, 3]
    K: NDArray[np.float32]
    present: NDArray[np.bool_]
    R_cam_target: NDArray[np.float32]
    t_cam_target_m: NDArray[np.float32]
    center_px: NDArray[np.float32]
    size_px: NDArray[np.float32]
    coverage: NDArray[np.float32]  # [N, H/4, W/4]; NaN where the mask is unknown
    noc: NDArray[np.float32]  # [N, 3, H/4, W/4]; NaN where unknown
    others: NDArray[np.bool_]  # [N, H/4, W/4], aircraft other than the labelled one
    diameter_m: NDArray[np.float32]
    airframe_id: NDArray[np.int32]  # [N], as in SampleBatch; -1: unknown


def training_batch(sample: SampleBatch) -> TrainingBatch:
    """Pool the dense labels over 4x4 pixels (object coordinates over visible ones only) and convert the boxes."""
    visible = np.stack([_pooled(mask.astype(np.float32)) for mask in sample.mask])
    seen = [np.where(mask[..., None], noc, 0) for mask, noc in zip(sample.mask, sample.noc, strict=True)]
    noc = np.stack([_pooled(coordinates.astype(np.float32)) for coordinates in seen])
    noc /= np.maximum(visible, 1.0 / DENSE_STRIDE**2)[..., None]
    box = sample.box_xyxy_px
    return TrainingBatch(
        image_bgr=sample.image_bgr,
        K=sample.K,
        present=sample.present,
        R_cam_target=sample.R_cam_target,
        t_cam_target_m=sample.t_cam_target_m,
        center_px=0.5 * (box[:, :2] + box[:, 2:]),
        size_px=box[:, 2:] - box[:, :2],
        coverage=visible,
        noc=np.ascontiguousarray(noc.transpose(0, 3, 1, 2)),
        others=np.zeros(visible.shape, np.bool_),
        diameter_m=sample.diameter_m,
        airframe_id=sample.airframe_id,
    )


def _pooled(dense: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means [H/4, W/4, ...] over tiles of 4x4 pixels; OpenCV needs a third of NumPy's time."""
    rows, columns = dense.shape[:2]
    tiles_wh = (columns // DENSE_STRIDE, rows // DENSE_STRIDE)
    return np.asarray(cv2.resize(dense, tiles_wh, interpolation=cv2.INTER_AREA), np.float32)


def _serve(
    open_sampler: Callable[[], Sampler],
    batch_size: int,
    starts: range,
    prefetch: int,
    warns: bool,
    out: Connection,
) -> None:
    """Body of a rendering process: renders the batches that begin at `starts`, or until the trainer is gone."""
    if not warns:
        logging.disable(logging.WARNING)
    # The trainer terminates it: a signal to the whole process group must not end it before the trainer has saved.
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
    # As many processes as cores: threads of one would only compete with the others.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    cv2.setNumThreads(1)
    made: queue.Queue[TrainingBatch | ConfigError | str | None] = queue.Queue(prefetch)
    sender = threading.Thread(target=_send, args=(made, out), daemon=True)
    sender.start()
    try:
        os.nice(1)
        sampler = open_sampler()
        for start in starts:
            drawn = sampler.batch(start, batch_size)
            made.put(training_batch(drawn) if isinstance(drawn, SampleBatch) else drawn)
    except ConfigError as error:
        made.put(error)
    except Exception:
        made.put(traceback.format_exc())
    made.put(None)
    sender.join()


def _send(made: queue.Queue[TrainingBatch | ConfigError | str | None], out: Connection) -> None:
    while (batch := made.get()) is not None:
        try:
            out.send(batch)
        except ConnectionError:
            os._exit(0)  # the trainer is gone, and the queue would never be emptied
        except BaseException:
            traceback.print_exc()
            os._exit(1)  # otherwise the trainer would wait for ever


def _kill(processes: list[BaseProcess]) -> None:
    for process in processes:
        process.kill()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """A signal to stop is handled afterwards; a process that is started meanwhile has it blocked."""
    # Blocked in this thread, it is taken by another, and its handler runs in the main thread all the same.
    came: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.signal(number, lambda n, _: came.append(n)) for number in STOPPING} if main else {}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for late in came:
            signal.raise_signal(late)


class Feed:
    """Batches of consecutive samples from `first_index` on, rendered by `workers` processes. Use as a context."""

    def __init__(
        self,
        open_sampler: Callable[[], Sampler],
        batch_size: int,
        first_index: int,
        workers: int = 1,
        prefetch: int = 4,
        rank: int = 0,
        ranks: int = 1,
        batches: int | None = None,
    ) -> None:
        """Of the consecutive batches this feed delivers `rank`, rank + `ranks`, ..., those of one training process.

        With `batches`, no more than so many are rendered; by default the stream has no end.
        """
        context = mp.get_context("spawn")
        self._turn = 0
        # Receives the next batch while the trainer computes.
        self._receiver = ThreadPoolExecutor(1, "receiver")
        self._awaited: Future[TrainingBatch] | None = None
        self._readers: list[Connection] = []
        self._processes: list[BaseProcess] = []
        # In case nobody closes it: at exit, multiprocessing waits for processes that ignore its SIGTERM.
        weakref.finalize(self, _kill, self._processes)
        resource_tracker.ensure_running()  # now, because starting it unblocks signals
        for worker in range(workers):
            reader, writer = context.Pipe(duplex=False)
            first = first_index + (worker * ranks + rank) * batch_size
            stride = workers * ranks * batch_size
            end = sys.maxsize if batches is None else first_index + batches * batch_size
            starts = range(first, end, stride)
            warns = rank == worker == 0  # all open the same datasets
            arguments = (open_sampler, batch_size, starts, prefetch, warns, writer)
            process = context.Process(target=_serve, args=arguments, daemon=True, name=f"renderer-{worker}")
            # The process ignores signals itself, after seconds of imports; one that is not in the list is never killed.
            with _uninterrupted():
                process.start()
                self._processes.append(process)
            writer.close()  # otherwise the death of a renderer in the middle of a batch would go unnoticed
            self._readers.append(reader)

    def next(self) -> TrainingBatch:
        """The next batch in index order. Raises RenderingError if its renderer failed, ConfigError for bad input."""
        awaited = self._awaited or self._receiver.submit(self._receive)
        batch = awaited.result()
        self._awaited = self._receiver.submit(self._receive)
        return batch

    def _receive(self) -> TrainingBatch:
        process = self._processes[self._turn]
        try:
            batch = self._readers[self._turn].recv()
        except (EOFError, OSError):
            process.join(timeout=5.0)
            raise RenderingError(f"{process.name} ended with exit code {process.exitcode}") from None
        if isinstance(batch, ConfigError):
            raise batch
        if isinstance(batch, str):
            raise RenderingError(f"{process.name} failed:\n{batch}")
        self._turn = (self._turn + 1) % len(self._readers)
        assert isinstance(batch, TrainingBatch)
        return batch

    def close(self) -> None:
        """Stop the renderers; idempotent."""
        _kill(self._processes)
        self._receiver.shutdown()  # its pipe has ended
        for process, reader in zip(self._processes, self._readers, strict=True):
            process.join(timeout=5.0)
            reader.close()

    def __enter__(self) -> Feed:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def render_once(
    open_sampler: Callable[[], Sampler], samples: int, chunk: int = 16, rendered: Callable[[int], None] | None = None
) -> list[TrainingBatch]:
    """Samples 0..samples-1 (rounded up to whole chunks) from a separate renderer, as a list in memory.

    `rendered` is called with the number of samples after each chunk.
    """
    chunks = (samples + chunk - 1) // chunk
    batches = []
    with Feed(open_sampler, chunk, 0, batches=chunks) as feed:
        for index in range(chunks):
            batches.append(feed.next())
            if rendered is not None:
                rendered((index + 1) * chunk)
    return batches
