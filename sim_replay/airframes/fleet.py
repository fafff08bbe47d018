"""The fleet: the aircraft, the type that each represents, and where its span and length are published."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from sim_replay.airframes import light_aircraft, propeller_uavs, small_uavs, turbine_aircraft
from sim_replay.airframes.mesh import Mesh, scaled
from sim_replay.bop.models import largest_distance


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


def fitted(mesh: Mesh, span_m: float, length_m: float) -> Mesh:
    """The mesh stretched along x and y to the published length and span, metres."""
    extent = np.ptp(mesh.vertices_m, axis=0)
    return scaled(mesh, [length_m / extent[0], span_m / extent[1], 1.0])


@cache
def _mesh(airframe: Airframe) -> Mesh:
    return fitted(airframe.build(), airframe.span_m, airframe.length_m)


@cache
def _diameter_m(airframe: Airframe) -> float:
    return largest_distance(airframe.mesh().vertices_m.astype(np.float64))


AIRFRAMES: tuple[Airframe, ...] = (
    Airframe(
        "male_v_tail",
        "MQ-9-class MALE, V-tail, pusher",
        20.1,
        11.0,
        "US Air Force fact sheet MQ-9 Reaper: wingspan 66 ft (20.1 m), length 36 ft (11 m)",
        propeller_uavs.male_v_tail,
    ),
    Airframe(
        "twin_boom_inverted_v",
        "Bayraktar-TB2-class, twin boom, inverted V-tail",
        12.0,
        6.5,
        "Baykar, Bayraktar TB2: wingspan 12 m, length 6.5 m",
        propeller_uavs.twin_boom_inverted_v,
    ),
    Airframe(
        "tactical_inverted_v",
        "RQ-7Bv2-Shadow-class tactical, twin boom, inverted V-tail",
        6.1,
        3.4,
        "RQ-7Bv2 Shadow: wingspan 20 ft (US Army release in Army Times, 3 February 2017), length 3.4 m",
        propeller_uavs.tactical_inverted_v,
    ),
    Airframe(
        "light_aircraft",
        "Cessna-172-class, strutted high wing, tractor",
        11.0,
        8.28,
        "Cessna 172S Pilot's Operating Handbook: span 36 ft 1 in (11.00 m), length 27 ft 2 in (8.28 m)",
        light_aircraft.light_aircraft,
    ),
    Airframe(
        "loitering_delta",
        "Shahed-136-class delta, tip fins, pusher",
        2.5,
        3.5,
        "Shahed 136, published dimensions: wingspan 2.5 m, length 3.5 m",
        small_uavs.loitering_delta,
    ),
    Airframe(
        "glider",
        "Standard-Class sailplane, T-tail",
        15.0,
        6.83,
        "Rolladen-Schneider LS4: span 15.00 m, length 6.83 m",
        light_aircraft.glider,
    ),
    Airframe(
        "tailless_swept",
        "ScanEagle-class, swept tailless wing with winglets, pusher",
        3.11,
        1.55,
        "Insitu ScanEagle: wingspan 10.2 ft (3.11 m), length 5.1 ft (1.55 m)",
        small_uavs.tailless_swept,
    ),
    Airframe(
        "twin_boom_h_tail",
        "Heron-class MALE, twin boom, H-tail, pusher",
        16.6,
        8.5,
        "IAI Heron: wingspan 16.6 m, length 8.5 m",
        propeller_uavs.twin_boom_h_tail,
    ),
    Airframe(
        "biplane",
        "Stearman-class biplane, radial engine, tail wheel",
        9.80,
        7.39,
        "Boeing, Historical Snapshot: Stearman Kaydet trainer: span 32 ft 2 in, length 24 ft 3 in",
        light_aircraft.biplane,
    ),
    Airframe(
        "low_wing_tourer",
        "PA-28-class, low wing with dihedral, faired gear, tractor",
        10.8,
        7.32,
        "Piper PA-28-181 Archer, published dimensions: wingspan 35 ft 6 in (10.8 m), length 24 ft (7.32 m)",
        light_aircraft.low_wing_tourer,
    ),
    Airframe(
        "jet_trainer",
        "L-39-class jet trainer, tandem canopy, tip tanks",
        9.46,
        12.13,
        "Aeropedia, Aero L-39C Albatros: wingspan 9.46 m, length 12.13 m",
        turbine_aircraft.jet_trainer,
    ),
    Airframe(
        "canard_pusher",
        "Long-EZ-class canard, swept wing with winglets, pusher",
        7.96,
        5.12,
        "Rutan Long-EZ, published dimensions: wingspan 26 ft 1 in (7.96 m), length 16 ft 10 in (5.12 m)",
        light_aircraft.canard_pusher,
    ),
    Airframe(
        "ultralight_pusher",
        "Challenger-II-class ultralight, strutted high wing, boom, pusher",
        9.6,
        6.1,
        "Quad City Challenger II, published dimensions: wingspan 31.5 ft (9.6 m), length 20 ft (6.1 m)",
        light_aircraft.ultralight_pusher,
    ),
    Airframe(
        "floatplane",
        "DHC-2-class, strutted high wing, radial engine, floats",
        14.63,
        9.22,
        "DHC-2 Beaver Mk 1, Polish Aviation Museum: wingspan 48 ft (14.63 m), length 30 ft 3 in (9.22 m)",
        light_aircraft.floatplane,
    ),
    Airframe(
        "business_turboprop",
        "PC-12-class, single turboprop, low wing with winglets, T-tail",
        16.28,
        14.4,
        "Pilatus PC-12 NG, published dimensions: wingspan 16.28 m, length 14.40 m",
        turbine_aircraft.business_turboprop,
    ),
    Airframe(
        "twin_turboprop",
        "Jetstream-31-class, twin turboprop, low wing, cruciform tail",
        15.85,
        14.37,
        "BAe Jetstream 31, published dimensions: wingspan 15.85 m, length 14.37 m",
        turbine_aircraft.twin_turboprop,
    ),
    Airframe(
        "male_inverted_v",
        "MQ-1-class MALE, inverted V-tail, pusher",
        16.8,
        8.22,
        "MQ-1B Predator, published dimensions: wingspan 55 ft (16.8 m), length 27 ft (8.22 m)",
        propeller_uavs.male_inverted_v,
    ),
    Airframe(
        "hand_launched",
        "RQ-20-Puma-class, high wing with raised tips, tractor",
        2.8,
        1.4,
        "AeroVironment RQ-20 Puma, published dimensions: wingspan 9.2 ft (2.8 m), length 4.6 ft (1.4 m)",
        small_uavs.hand_launched,
    ),
    Airframe(
        "flying_wing_jet",
        "X-45A-class tailless lambda wing, dorsal intake, jet",
        10.3,
        8.08,
        "Boeing X-45A, published dimensions: wingspan 33 ft 10 in (10.3 m), length 26 ft 6 in (8.08 m)",
        small_uavs.flying_wing_jet,
    ),
    Airframe(
        "hybrid_quadplane",
        "JUMP-20-class, lift rotors at rest on booms, tractor",
        5.5,
        2.9,
        "JUMP 20: wingspan 5.5 m (Sputnik Brasil, 12 April 2020); length 9.5 ft (2.9 m), published dimension",
        small_uavs.hybrid_quadplane,
    ),
    Airframe(
        "jet_target_drone",
        "BQM-167-class jet target drone, belly intake, low aspect ratio",
        3.2,
        6.1,
        "BQM-167A, published dimensions: wingspan 10.5 ft (3.2 m), length 20 ft (6.1 m)",
        small_uavs.jet_target_drone,
    ),
)
