"""Unmanned aircraft of the reconnaissance and strike classes, all with a pusher propeller.

Only span and length follow a citation; every other proportion is drawn by eye from the type's layout.
"""

from __future__ import annotations

from sim_replay.airframes.mesh import Mesh, Part, both_sides, merge
from sim_replay.airframes.shapes import (
    blade_antenna,
    ellipsoid,
    exhaust,
    fuselage,
    lifting_surface,
    propeller,
    sensor_ball,
    store,
    strut,
    tricycle,
)


def male_v_tail() -> Mesh:
    """20 m class: bulged nose, slender body, straight wing with stores, V-tail over a ventral fin, gear retracted."""
    body = fuselage(
        [
            (4.95, 0.12, 0.12, 0.0),
            (4.83, 0.5, 0.48, -0.03),
            (4.3, 0.95, 0.98, -0.15),
            (3.3, 1.12, 1.28, -0.22),
            (2.2, 0.98, 1.0, -0.08),
            (0.5, 0.88, 0.9, 0.0),
            (-2.0, 0.86, 0.9, 0.0),
            (-4.0, 0.8, 0.82, -0.03),
            (-5.1, 0.6, 0.6, -0.05),
            (-5.45, 0.42, 0.42, -0.05),
        ],
        rings=22,
    )
    wing = both_sides(
        lifting_surface(
            [
                (0.6, 0.2, 0.22, 1.75, 2),
                (0.4, 3.4, 0.1, 1.4, 1),
                (0.1, 9.6, -0.14, 0.7, -1),
                (-0.1, 10.05, -0.16, 0.5, -1),
            ],
            "4415",
            leading_edge=Part.METAL,
        )
    )
    tail = both_sides(lifting_surface([(-4.0, 0.22, -0.2, 1.2), (-4.65, 2.35, -1.8, 0.7)], "0010", Part.TAIL))
    ventral = lifting_surface([(-4.25, 0.0, 0.3, 1.05), (-4.8, 0.0, 1.25, 0.6)], "0010", Part.TAIL)
    intake = fuselage(
        [(-2.5, 0.34, 0.24, -0.58), (-3.2, 0.55, 0.5, -0.52), (-4.9, 0.3, 0.3, -0.34)],
        rings=7,
        points=12,
        caps=(Part.TYRE, None),
    )
    stores = both_sides(
        store([0.05, 2.0, 0.72], 2.3, 0.26, 0.12),
        store([0.1, 3.3, 0.62], 1.65, 0.18, 0.05),
    )
    details = [
        sensor_ball([3.7, 0.0, 0.72], 0.3),
        exhaust([-4.7, 0.34, 0.12], 0.08, 0.4),
        blade_antenna([1.0, 0.0, -0.42], 0.25),
        blade_antenna([-0.8, 0.12, 0.42], 0.25, above=False),
    ]
    return merge([body, wing, tail, ventral, intake, stores, *details, propeller([-5.55, 0.0, -0.05], 1.4, 0.4, True)])


def male_inverted_v() -> Mesh:
    """17 m class: bulged nose, thin body, long straight wing, inverted V-tail with a ventral fin, gear retracted."""
    body = fuselage(
        [
            (3.45, 0.1, 0.1, 0.06),
            (3.36, 0.42, 0.38, 0.04),
            (2.9, 0.78, 0.82, -0.08),
            (2.2, 0.92, 1.02, -0.14),
            (1.3, 0.78, 0.78, 0.0),
            (0.0, 0.68, 0.66, 0.05),
            (-2.0, 0.68, 0.68, 0.02),
            (-3.6, 0.66, 0.66, 0.0),
            (-4.4, 0.42, 0.44, -0.02),
        ],
        rings=20,
    )
    wing = both_sides(
        lifting_surface([(0.42, 0.15, 0.18, 1.2, 2), (0.3, 4.0, 0.0, 0.85, 1), (0.12, 8.4, -0.2, 0.45, -1)], "4416")
    )
    tail = both_sides(lifting_surface([(-3.2, 0.2, 0.1, 0.85), (-3.5, 2.1, 1.25, 0.5)], "0010", Part.TAIL))
    ventral = lifting_surface([(-3.4, 0.0, 0.25, 0.8), (-3.7, 0.0, 0.95, 0.5)], "0010", Part.TAIL)
    intake = fuselage(
        [(-2.1, 0.4, 0.2, -0.38), (-2.6, 0.55, 0.4, -0.35), (-3.8, 0.3, 0.2, -0.28)],
        rings=6,
        points=12,
        caps=(Part.TYRE, None),
    )
    probe = strut([3.3, 0.0, 0.0], [3.85, 0.0, 0.0], 0.06)
    details = [
        sensor_ball([2.5, 0.0, 0.62], 0.27),
        exhaust([-3.9, -0.3, 0.14], 0.06, 0.3),
        blade_antenna([-0.5, 0.0, -0.25], 0.2),
        both_sides(store([0.0, 1.75, 0.5], 1.6, 0.17, 0.12)),
    ]
    return merge([body, wing, tail, ventral, intake, probe, *details, propeller([-4.5, 0.0, -0.02], 0.86, 0.25, True)])


def twin_boom_inverted_v() -> Mesh:
    """12 m class: pod body, tapered wing, two booms that carry an inverted V-tail, fixed gear."""
    body = fuselage(
        [
            (2.6, 0.1, 0.1, 0.08),
            (2.52, 0.36, 0.3, 0.07),
            (2.1, 0.66, 0.62, 0.03),
            (1.3, 0.82, 0.84, 0.0),
            (0.0, 0.86, 0.88, 0.0),
            (-0.9, 0.82, 0.78, -0.04),
            (-1.45, 0.55, 0.5, -0.08),
        ],
        exponent=2.5,
        caps=(None, Part.METAL),
    )
    wing = both_sides(
        lifting_surface(
            [
                (0.42, 0.2, -0.3, 1.25, 2),
                (0.36, 1.3, -0.33, 1.15, 2),
                (0.02, 5.7, -0.5, 0.62, -1),
                (-0.12, 6.0, -0.53, 0.4, -1),
            ],
            "4415",
        )
    )
    boom = both_sides(
        fuselage(
            [(0.55, 0.06, 0.06, -0.3), (0.35, 0.19, 0.19, -0.3), (-1.2, 0.18, 0.18, -0.3), (-3.85, 0.13, 0.13, -0.3)],
            part=Part.TAIL,
            y_m=1.3,
            rings=6,
            points=10,
        )
    )
    tail = both_sides(
        lifting_surface([(-2.95, 1.3, -0.3, 0.9), (-3.2, 0.02, -1.5, 0.68)], "0010", Part.TAIL),
        lifting_surface([(-3.05, 1.3, -0.3, 0.7), (-3.35, 1.34, 0.28, 0.4)], "0010", Part.TAIL),
    )
    gear = tricycle((1.7, 0.3, 1.0), ([-0.45, 0.3, 0.3], [-0.6, 0.97, 1.05]), 0.19, 0.07)
    stores = both_sides(store([0.1, 2.1, 0.28], 1.0, 0.17, -0.28))
    scoop = fuselage(
        [(-0.2, 0.3, 0.12, -0.44), (-0.5, 0.42, 0.24, -0.42), (-1.3, 0.3, 0.12, -0.3)],
        rings=5,
        points=10,
        caps=(Part.TYRE, None),
    )
    details = [
        sensor_ball([1.2, 0.0, 0.6], 0.26),
        exhaust([-1.2, 0.28, 0.22], 0.06, 0.35),
        blade_antenna([0.9, 0.0, -0.38], 0.18),
    ]
    return merge(
        [body, wing, boom, tail, gear, stores, scoop, *details, propeller([-1.6, 0.0, -0.08], 0.85, 0.22, True)]
    )


def twin_boom_h_tail() -> Mesh:
    """17 m class: deep pod with a radome, long straight wing, two booms, tailplane between twin fins."""
    body = fuselage(
        [
            (3.9, 0.15, 0.12, 0.18),
            (3.82, 0.45, 0.35, 0.16),
            (3.4, 0.8, 0.75, 0.08),
            (2.5, 0.98, 1.05, 0.0),
            (0.6, 1.02, 1.12, 0.0),
            (-0.7, 0.96, 0.98, -0.05),
            (-1.4, 0.62, 0.58, -0.12),
        ],
        exponent=2.8,
        caps=(None, Part.METAL),
    )
    wing = both_sides(
        lifting_surface([(0.4, 0.2, -0.5, 1.1, 2), (0.36, 3.5, -0.55, 1.0, 1), (0.1, 8.3, -0.68, 0.5, -1)], "4417")
    )
    boom = both_sides(
        fuselage(
            [(0.7, 0.1, 0.1, -0.42), (0.4, 0.3, 0.34, -0.42), (-1.5, 0.27, 0.31, -0.42), (-4.6, 0.14, 0.17, -0.42)],
            y_m=1.6,
            rings=6,
            points=10,
        )
    )
    fin = both_sides(
        lifting_surface([(-3.6, 1.6, 0.2, 0.65), (-3.45, 1.6, -0.42, 1.0), (-3.75, 1.6, -1.5, 0.65)], "0010", Part.TAIL)
    )
    tailplane = both_sides(lifting_surface([(-3.65, 0.0, -0.5, 0.7), (-3.65, 1.62, -0.5, 0.7)], "0010", Part.TAIL))
    dome = fuselage(
        [(2.7, 0.2, 0.1, -0.42), (2.4, 0.62, 0.42, -0.52), (1.7, 0.72, 0.56, -0.56), (0.7, 0.4, 0.2, -0.46)],
        rings=8,
        points=14,
    )
    gear = tricycle((2.4, 0.4, 1.2), ([-0.4, 0.4, 0.4], [-0.5, 1.1, 1.25]), 0.22, 0.08)
    details = [
        sensor_ball([3.0, 0.0, 0.66], 0.3),
        exhaust([-1.1, 0.36, 0.22], 0.07, 0.3),
        both_sides(blade_antenna([-0.1, 0.25, 0.54], 0.2, above=False)),
    ]
    return merge(
        [body, wing, boom, fin, tailplane, dome, gear, *details, propeller([-1.55, 0.0, -0.12], 0.95, 0.25, True)]
    )


def tactical_inverted_v() -> Mesh:
    """6 m class: boxy pod, straight wing, two thin booms, inverted V-tail, fixed gear, exposed engine."""
    body = fuselage(
        [
            (1.45, 0.14, 0.14, 0.12),
            (1.38, 0.28, 0.28, 0.1),
            (1.15, 0.4, 0.42, 0.06),
            (0.6, 0.45, 0.52, 0.05),
            (-0.45, 0.45, 0.52, 0.05),
            (-0.8, 0.36, 0.4, 0.02),
        ],
        exponent=4.0,
        caps=(None, Part.METAL),
    )
    wing = both_sides(
        lifting_surface([(0.2, 0.1, -0.26, 0.62, 2), (0.2, 1.7, -0.27, 0.6, 1), (0.08, 3.05, -0.32, 0.42, -1)], "4415")
    )
    boom = both_sides(
        fuselage(
            [(0.06, 0.05, 0.05, -0.22), (-0.2, 0.085, 0.085, -0.22), (-1.95, 0.07, 0.07, -0.22)],
            part=Part.METAL,
            y_m=0.55,
            rings=4,
            points=8,
        )
    )
    tail = both_sides(lifting_surface([(-1.5, 0.58, -0.2, 0.42), (-1.58, 0.01, -0.72, 0.38)], "0010", Part.TAIL))
    engine = both_sides(ellipsoid([-0.62, 0.26, 0.02], [0.12, 0.1, 0.08], Part.METAL, 6, 8))
    gear = tricycle((0.95, 0.25, 0.6), ([-0.3, 0.18, 0.25], [-0.35, 0.5, 0.62]), 0.1, 0.035)
    scoop = fuselage(
        [(0.15, 0.2, 0.1, -0.3), (-0.1, 0.26, 0.16, -0.28), (-0.6, 0.2, 0.08, -0.22)],
        3.0,
        rings=4,
        points=8,
        caps=(Part.TYRE, None),
    )
    details = [sensor_ball([0.55, 0.0, 0.4], 0.14), blade_antenna([1.0, 0.0, -0.12], 0.12)]
    prop = propeller([-0.9, 0.0, 0.02], 0.36, 0.1, True)
    return merge([body, wing, boom, tail, engine, gear, scoop, *details, prop])
