"""Manoeuvres drawn from a seed: bank and flight path angle over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Kind = Literal["straight", "turn", "climbing_turn", "s_turn", "roll_in", "roll_out", "orbit", "climb"]
KINDS: tuple[Kind, ...] = ("straight", "turn", "climbing_turn", "s_turn", "roll_in", "roll_out", "orbit", "climb")
OFTEN = (1, 1, 1, 2, 2, 2, 1, 1)  # relative frequency of each: those that change bank are the most visible


@dataclass(frozen=True)
class Manoeuvre:
    """Commands in steps: bank and path angle from each of `t_s` on; before the first, the first."""

    kind: Kind
    t_s: tuple[float, ...]
    banks_rad: tuple[float, ...]
    paths_rad: tuple[float, ...]

    def bank_rad(self, t_s: float) -> float:
        """Bank commanded at a time, right wing down positive."""
        return self.banks_rad[self._step(t_s)]

    def path_rad(self, t_s: float) -> float:
        """Flight path angle commanded at a time, climb positive."""
        return self.paths_rad[self._step(t_s)]

    def _step(self, t_s: float) -> int:
        return max(sum(start <= t_s for start in self.t_s) - 1, 0)


def draw_manoeuvre(
    rng: np.random.Generator, duration_s: float, bank_limit_rad: float, path_limit_rad: float
) -> Manoeuvre:
    """A manoeuvre that is visible within 0 to `duration_s`."""
    kind = KINDS[int(rng.choice(len(KINDS), p=np.array(OFTEN) / sum(OFTEN)))]
    side = float(rng.choice([-1.0, 1.0]))
    bank = side * float(rng.uniform(0.3, 1.0)) * bank_limit_rad
    path = float(rng.uniform(-1.0, 1.0)) * path_limit_rad
    change_s = float(rng.uniform(0.15, 0.6)) * duration_s
    gentle = path * 0.2
    if kind == "straight":
        return Manoeuvre(kind, (0.0,), (0.0,), (gentle,))
    if kind == "climb":
        return Manoeuvre(kind, (-2.0, change_s), (0.0, 0.0), (path, -path))
    if kind == "climbing_turn":
        return Manoeuvre(kind, (0.0,), (bank,), (path,))
    if kind == "s_turn":
        return Manoeuvre(kind, (0.0, change_s), (bank, -bank), (gentle, gentle))
    if kind == "roll_in":
        return Manoeuvre(kind, (0.0, change_s), (0.0, bank), (gentle, gentle))
    if kind == "roll_out":
        return Manoeuvre(kind, (0.0, change_s), (bank, 0.0), (gentle, gentle))
    steep = side * bank_limit_rad * float(rng.uniform(0.8, 1.0)) if kind == "orbit" else bank
    return Manoeuvre(kind, (0.0,), (steep,), (0.0,))
