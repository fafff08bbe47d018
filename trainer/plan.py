"""How long a run is to last, and how far along it is. Pure."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from trainer.config import ConfigError


class Plan(NamedTuple):
    """Planned length of a run, and the time already used."""

    samples: int  # planned, in total
    used_before_s: float = 0.0  # wall-clock seconds before this start
    budget_s: float | None = None  # in total; None: no limit

    def progress(self, samples: int, used_s: float) -> float:
        """Progress of the schedule, 1 at its end, after that many samples and seconds of the run."""
        return max(samples / self.samples, used_s / self.budget_s if self.budget_s else 0.0)

    def resumed(self, out: Path, budget_s: float | None, samples: int | None) -> Plan:
        """The plan of the next start, with this much more time and so many samples in total; None: as before.

        If the time is used up, a number of samples lifts its limit; without one, raises ConfigError.
        """
        if budget_s is not None:
            return Plan(samples or self.samples, self.used_before_s, self.used_before_s + budget_s)
        used_up = self.budget_s is not None and self.used_before_s >= self.budget_s
        if used_up and samples is None:
            raise ConfigError(
                f"{out}: the run's time budget is used up; give --budget-minutes for more time, or --samples"
            )
        return Plan(samples or self.samples, self.used_before_s, None if used_up else self.budget_s)
