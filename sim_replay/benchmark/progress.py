"""Progress while a dataset is generated: a bar on a terminal, otherwise a line per sequence."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from sim_replay.benchmark.plan import SequencePlan
from sim_replay.benchmark.sequence_files import FrameNews, Job


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text("- frames/s" if task.speed is None else f"{task.speed:.1f} frames/s")


class Report:
    """Counts frames reported by the workers; use it in a `with` statement."""

    def __init__(self, console: Console, job: Job, plans: Sequence[SequencePlan]) -> None:
        self._console, self._planned = console, len(plans)
        self._total, self._made, self._kept, self._sequences = sum(len(job.frames(p)) for p in plans), 0, 0, 0
        self._started_s = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(self._title(), total=self._total)

    def __enter__(self) -> Report:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bar.stop()

    def frames(self, news: FrameNews) -> None:
        """Count frames."""
        if news.kept:
            # Not made in this run: leaving them out of the total keeps rate and remaining time correct.
            self._kept += news.kept
            self._bar.update(self._task, total=self._total - self._kept)
        self._made += news.made
        self._bar.advance(self._task, news.made)

    def finished(self, plan: SequencePlan) -> None:
        """Count a sequence."""
        self._sequences += 1
        self._bar.update(self._task, description=self._title())
        if not self._console.is_terminal:
            self._say(plan)

    def _title(self) -> str:
        return f"sequence {self._sequences} of {self._planned}"

    def _say(self, plan: SequencePlan) -> None:
        seconds = max(time.monotonic() - self._started_s, 1e-3)
        rate = self._made / seconds
        left = self._total - self._kept - self._made
        remaining = f", {left / rate:.0f} s left" if self._made and left else ""
        self._console.print(
            f"sequence {plan.index} ({plan.split}) finished, {self._sequences} of {self._planned}; "
            f"{self._made + self._kept} of {self._total} frames, {rate:.1f} frames/s{remaining}",
            soft_wrap=True,
            highlight=False,
        )


@contextmanager
def flights_bar(console: Console, count: int) -> Iterator[Callable[[], None]]:
    """A function to call once for each flown sequence; shown only if there are any."""
    with Progress(console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("flying all sequences, to choose lenses", total=count)
        yield lambda: bar.advance(task)
