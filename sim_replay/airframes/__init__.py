"""Fixed-wing airframes as meshes in body FRD metres, in an order that never changes (labels index it)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from sim_replay.airframes import fleet
from sim_replay.airframes.mesh import Mesh, Part, diameter_m

__all__ = ["AIRFRAMES", "Airframe", "Mesh", "Part", "airframe_id"]


@dataclass(frozen=True)
class Airframe:
    """One aircraft type; `mesh()` builds it, always the same."""

    name: str
    description: str
    span_m: float
    length_m: float
    citation: str  # where span and length are published; no other dimension is claimed
    build: Callable[[], Mesh]

    def mesh(self) -> Mesh:
        """The mesh in body FRD metres, origin near the centre of gravity; built once per process."""
        return _mesh(self)

    def diameter_m(self) -> float:
        """Largest distance between two vertices, metres."""
        return _diameter_m(self)


@cache
def _mesh(airframe: Airframe) -> Mesh:
    return fleet.fitted(airframe.build(), airframe.span_m, airframe.length_m)


@cache
def _diameter_m(airframe: Airframe) -> float:
    return diameter_m(airframe.mesh())


AIRFRAMES: tuple[Airframe, ...] = (
    Airframe(
        "male_v_tail",
        "MQ-9-class MALE, V-tail, pusher",
        20.1,
        11.0,
        "US Air Force fact sheet MQ-9 Reaper: wingspan 66 ft (20.1 m), length 36 ft (11 m)",
        fleet.male_v_tail,
    ),
    Airframe(
        "twin_boom_inverted_v",
        "Bayraktar-TB2-class, twin boom, inverted V-tail",
        12.0,
        6.5,
        "Baykar, Bayraktar TB2: wingspan 12 m, length 6.5 m",
        fleet.twin_boom_inverted_v,
    ),
    Airframe(
        "tactical_inverted_v",
        "RQ-7Bv2-Shadow-class tactical, twin boom, inverted V-tail",
        6.1,
        3.4,
        "RQ-7Bv2 Shadow: wingspan 20 ft (US Army release in Army Times, 3 February 2017), length 3.4 m",
        fleet.tactical_inverted_v,
    ),
    Airframe(
        "light_aircraft",
        "Cessna-172-class, strutted high wing, tractor",
        11.0,
        8.28,
        "Cessna 172S Pilot's Operating Handbook: span 36 ft 1 in (11.00 m), length 27 ft 2 in (8.28 m)",
        fleet.light_aircraft,
    ),
    Airframe(
        "loitering_delta",
        "Shahed-136-class delta, tip fins, pusher",
        2.5,
        3.5,
        "Shahed 136, published dimensions: wingspan 2.5 m, length 3.5 m",
        fleet.loitering_delta,
    ),
    Airframe(
        "glider",
        "Standard-Class sailplane, T-tail",
        15.0,
        6.83,
        "Rolladen-Schneider LS4: span 15.00 m, length 6.83 m",
        fleet.glider,
    ),
    Airframe(
        "tailless_swept",
        "ScanEagle-class, swept tailless wing with winglets, pusher",
        3.11,
        1.55,
        "Insitu ScanEagle: wingspan 10.2 ft (3.11 m), length 5.1 ft (1.55 m)",
        fleet.tailless_swept,
    ),
    Airframe(
        "twin_boom_h_tail",
        "Heron-class MALE, twin boom, H-tail, pusher",
        16.6,
        8.5,
        "IAI Heron: wingspan 16.6 m, length 8.5 m",
        fleet.twin_boom_h_tail,
    ),
)


def airframe_id(name: str) -> int:
    """Index of the airframe of that name. Raises ValueError that lists the names there are."""
    names = [airframe.name for airframe in AIRFRAMES]
    if name not in names:
        raise ValueError(f"no airframe is called {name!r}; there are {', '.join(names)}")
    return names.index(name)
