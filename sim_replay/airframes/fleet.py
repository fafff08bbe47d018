"""The airframes: parametric fixed-wing meshes whose span and length are those published for a real aircraft.

Only span and length follow the citation; every other proportion is drawn by eye from the type's layout.
The origin lies at about a quarter of the wing's chord, where the centre of gravity is.
"""

from __future__ import annotations

import numpy as np

from sim_replay.airframes.mesh import (
    Mesh,
    Part,
    both_sides,
    ellipsoid,
    fuselage,
    lifting_surface,
    merge,
    propeller_disc,
    scaled,
    strut,
)


def fitted(mesh: Mesh, span_m: float, length_m: float) -> Mesh:
    """The mesh stretched along x and y to the published length and span, metres."""
    extent = np.ptp(mesh.vertices_m, axis=0)
    return scaled(mesh, [length_m / extent[0], span_m / extent[1], 1.0])


def male_v_tail() -> Mesh:
    """20 m class: slender bulbous-nosed fuselage, straight low wing, V-tail over a ventral fin, pusher."""
    body = fuselage(
        [
            (4.9, 0.25, 0.25, 0.05),
            (4.5, 0.95, 0.95, -0.1),
            (3.4, 1.15, 1.35, -0.2),
            (2.2, 0.95, 0.95, -0.05),
            (0.5, 0.85, 0.9, 0.0),
            (-2.0, 0.85, 0.9, 0.0),
            (-4.6, 0.8, 0.8, -0.05),
            (-5.6, 0.3, 0.35, -0.05),
        ],
    )
    wing = both_sides(
        lifting_surface([(0.55, 0.2, 0.3, 1.75), (0.3, 4.0, 0.15, 1.25), (-0.05, 10.05, -0.15, 0.6)], 0.16)
    )
    tail = both_sides(lifting_surface([(-4.0, 0.2, -0.2, 1.15), (-4.65, 2.3, -1.75, 0.65)], 0.1, Part.TAIL))
    ventral = lifting_surface([(-4.3, 0.0, 0.3, 1.0), (-4.8, 0.0, 1.25, 0.55)], 0.1, Part.TAIL)
    turret = ellipsoid([3.75, 0.0, 0.75], [0.3, 0.3, 0.32], Part.SENSOR)
    intake = fuselage([(-2.6, 0.25, 0.2, -0.5), (-3.0, 0.5, 0.45, -0.55), (-4.6, 0.35, 0.3, -0.4)], rings=6, points=10)
    gear = both_sides(
        merge(
            [strut([0.0, 0.3, 0.3], [-0.2, 1.3, 1.45], 0.1), ellipsoid([-0.2, 1.35, 1.5], [0.28, 0.1, 0.28], Part.TYRE)]
        )
    )
    return merge([body, wing, tail, ventral, turret, intake, gear, propeller_disc([-5.65, 0.0, -0.05], 1.4)])


def twin_boom_inverted_v() -> Mesh:
    """12 m class: pod fuselage, tapered wing, two booms that carry an inverted V-tail, pusher."""
    body = fuselage(
        [
            (2.6, 0.12, 0.12, 0.05),
            (2.3, 0.6, 0.55, 0.03),
            (1.4, 0.8, 0.8, 0.0),
            (0.0, 0.85, 0.85, 0.0),
            (-0.9, 0.8, 0.75, -0.02),
            (-1.5, 0.45, 0.45, -0.05),
        ],
    )
    wing = both_sides(lifting_surface([(0.4, 0.2, -0.3, 1.25), (0.3, 1.3, -0.32, 1.15), (-0.05, 6.0, -0.5, 0.6)], 0.15))
    boom = both_sides(
        fuselage(
            [(0.2, 0.1, 0.1, -0.3), (0.0, 0.2, 0.2, -0.3), (-3.2, 0.14, 0.14, -0.3), (-3.7, 0.08, 0.08, -0.3)],
            part=Part.TAIL,
            y_m=1.3,
            rings=5,
            points=8,
        )
    )
    tail = both_sides(lifting_surface([(-2.95, 1.3, -0.3, 0.85), (-3.2, 0.0, -1.5, 0.65)], 0.1, Part.TAIL))
    turret = ellipsoid([1.2, 0.0, 0.55], [0.27, 0.27, 0.3], Part.SENSOR)
    gear = merge(
        [
            both_sides(
                merge(
                    [
                        strut([-0.5, 0.25, 0.3], [-0.6, 0.95, 1.05], 0.08),
                        ellipsoid([-0.6, 0.97, 1.08], [0.2, 0.07, 0.2], Part.TYRE),
                    ]
                )
            ),
            strut([1.7, 0.0, 0.3], [1.75, 0.0, 1.0], 0.08),
            ellipsoid([1.75, 0.0, 1.05], [0.17, 0.06, 0.17], Part.TYRE),
        ]
    )
    return merge([body, wing, boom, tail, turret, gear, propeller_disc([-1.55, 0.0, -0.05], 0.85)])


def tactical_inverted_v() -> Mesh:
    """6 m class: boxy pod, straight untapered wing, two thin booms, inverted V-tail, fixed tricycle gear."""
    body = fuselage(
        [
            (1.45, 0.15, 0.15, 0.1),
            (1.3, 0.36, 0.36, 0.07),
            (0.7, 0.45, 0.5, 0.05),
            (-0.5, 0.45, 0.5, 0.05),
            (-0.85, 0.32, 0.36, 0.02),
        ],
        exponent=4.0,
    )
    wing = both_sides(
        lifting_surface([(0.2, 0.1, -0.26, 0.62), (0.2, 1.2, -0.26, 0.62), (0.08, 2.15, -0.3, 0.46)], 0.15)
    )
    boom = both_sides(
        fuselage(
            [(0.05, 0.05, 0.05, -0.22), (-0.2, 0.08, 0.08, -0.22), (-1.95, 0.06, 0.06, -0.22)],
            part=Part.METAL,
            y_m=0.55,
            rings=4,
            points=7,
        )
    )
    tail = both_sides(lifting_surface([(-1.5, 0.58, -0.2, 0.42), (-1.58, 0.0, -0.72, 0.38)], 0.1, Part.TAIL))
    turret = ellipsoid([0.45, 0.0, 0.36], [0.15, 0.15, 0.16], Part.SENSOR)
    gear = merge(
        [
            both_sides(
                merge(
                    [
                        strut([-0.3, 0.15, 0.2], [-0.35, 0.5, 0.62], 0.04),
                        ellipsoid([-0.35, 0.51, 0.64], [0.1, 0.035, 0.1], Part.TYRE),
                    ]
                )
            ),
            strut([1.0, 0.0, 0.2], [1.0, 0.0, 0.6], 0.04),
            ellipsoid([1.0, 0.0, 0.62], [0.09, 0.03, 0.09], Part.TYRE),
        ]
    )
    return merge([body, wing, boom, tail, turret, gear, propeller_disc([-0.92, 0.0, 0.02], 0.36)])


def light_aircraft() -> Mesh:
    """11 m class: strutted high wing, cabin with windows, conventional tail, fixed gear, tractor propeller."""
    body = fuselage(
        [
            (2.05, 0.35, 0.4, 0.3),
            (1.9, 0.95, 0.8, 0.3),
            (1.0, 1.1, 1.0, 0.25),
            (0.4, 1.15, 1.3, 0.1),
            (-0.6, 1.15, 1.4, 0.05),
            (-1.7, 1.0, 1.1, 0.1),
            (-3.4, 0.5, 0.6, 0.05),
            (-5.9, 0.12, 0.25, -0.1),
        ],
        exponent=3.2,
    )
    wing = both_sides(
        lifting_surface([(0.45, 0.3, -0.68, 1.63), (0.45, 2.6, -0.72, 1.63), (0.2, 5.5, -0.85, 1.12)], 0.12)
    )
    tailplane = both_sides(lifting_surface([(-4.75, 0.1, -0.05, 1.3), (-5.05, 1.72, -0.05, 0.85)], 0.09, Part.TAIL))
    fin = lifting_surface(
        [(-4.1, 0.0, -0.1, 1.95), (-4.9, 0.0, -0.6, 1.25), (-5.45, 0.0, -1.75, 0.75)], 0.09, Part.TAIL
    )
    windows = both_sides(ellipsoid([-0.35, 0.5, -0.28], [0.95, 0.1, 0.25], Part.GLASS))
    windscreen = ellipsoid([0.55, 0.0, -0.3], [0.35, 0.5, 0.3], Part.GLASS)
    struts = both_sides(strut([0.15, 0.55, 0.55], [0.05, 2.65, -0.68], 0.1, Part.WING))
    gear = merge(
        [
            both_sides(
                merge(
                    [
                        strut([-0.45, 0.4, 0.6], [-0.45, 1.2, 1.15], 0.1),
                        ellipsoid([-0.45, 1.25, 1.2], [0.3, 0.1, 0.24], Part.TYRE),
                    ]
                )
            ),
            strut([1.3, 0.0, 0.6], [1.35, 0.0, 1.2], 0.1),
            ellipsoid([1.35, 0.0, 1.22], [0.27, 0.09, 0.22], Part.TYRE),
        ]
    )
    spinner = ellipsoid([2.1, 0.0, 0.3], [0.25, 0.17, 0.17], Part.METAL)
    return merge(
        [body, wing, tailplane, fin, windows, windscreen, struts, gear, spinner, propeller_disc([2.2, 0.0, 0.3], 0.95)]
    )


def loitering_delta() -> Mesh:
    """2.5 m class: blended cropped delta, fins above and below the wing tips, pusher."""
    body = fuselage(
        [
            (1.75, 0.05, 0.05, 0.0),
            (1.5, 0.26, 0.26, 0.0),
            (1.0, 0.36, 0.38, 0.0),
            (-0.4, 0.4, 0.42, 0.0),
            (-1.3, 0.36, 0.36, 0.0),
            (-1.65, 0.18, 0.18, 0.0),
        ]
    )
    wing = both_sides(lifting_surface([(0.95, 0.1, 0.0, 2.3), (0.3, 0.45, 0.0, 1.65), (-0.75, 1.23, 0.0, 0.6)], 0.09))
    fin = both_sides(
        merge(
            [
                lifting_surface([(-0.75, 1.23, 0.0, 0.62), (-1.0, 1.23, -0.38, 0.36)], 0.08, Part.TAIL),
                lifting_surface([(-0.75, 1.23, 0.0, 0.62), (-1.0, 1.23, 0.3, 0.36)], 0.08, Part.TAIL),
            ]
        )
    )
    engine = ellipsoid([-1.5, 0.0, -0.14], [0.14, 0.2, 0.08], Part.METAL)
    return merge([body, wing, fin, engine, propeller_disc([-1.72, 0.0, 0.0], 0.3)])


def glider() -> Mesh:
    """15 m class: thin tapered wing of high aspect ratio, slim boom, T-tail, long canopy."""
    body = fuselage(
        [
            (2.05, 0.08, 0.1, 0.1),
            (1.7, 0.4, 0.45, 0.06),
            (0.9, 0.62, 0.8, 0.0),
            (0.0, 0.55, 0.78, -0.02),
            (-1.0, 0.35, 0.45, -0.08),
            (-2.4, 0.2, 0.26, -0.12),
            (-4.75, 0.12, 0.2, -0.15),
        ]
    )
    wing = both_sides(
        lifting_surface(
            [(0.22, 0.1, -0.2, 0.95), (0.18, 4.5, -0.42, 0.78), (0.0, 6.6, -0.55, 0.5), (-0.12, 7.5, -0.64, 0.3)], 0.15
        )
    )
    fin = lifting_surface([(-3.75, 0.0, -0.1, 1.05), (-4.1, 0.0, -1.4, 0.68)], 0.11, Part.TAIL)
    tailplane = both_sides(lifting_surface([(-4.12, 0.02, -1.42, 0.58), (-4.25, 1.3, -1.44, 0.34)], 0.1, Part.TAIL))
    canopy = ellipsoid([0.95, 0.0, -0.2], [0.85, 0.28, 0.28], Part.GLASS)
    wheel = ellipsoid([0.1, 0.0, 0.42], [0.19, 0.06, 0.17], Part.TYRE)
    return merge([body, wing, fin, tailplane, canopy, wheel])


def tailless_swept() -> Mesh:
    """3 m class: short cylindrical pod, thin swept wing, winglets that carry the rudders, pusher."""
    body = fuselage(
        [
            (0.85, 0.06, 0.06, 0.0),
            (0.75, 0.17, 0.17, 0.0),
            (0.4, 0.2, 0.21, 0.0),
            (-0.3, 0.2, 0.21, 0.0),
            (-0.6, 0.15, 0.16, 0.0),
        ]
    )
    wing = both_sides(lifting_surface([(0.28, 0.05, -0.04, 0.3), (-0.38, 1.52, -0.04, 0.22)], 0.13))
    winglet = both_sides(lifting_surface([(-0.36, 1.53, 0.06, 0.24), (-0.52, 1.55, -0.36, 0.15)], 0.1, Part.TAIL))
    turret = ellipsoid([0.66, 0.0, 0.1], [0.085, 0.085, 0.09], Part.SENSOR)
    return merge([body, wing, winglet, turret, propeller_disc([-0.64, 0.0, 0.0], 0.2)])


def twin_boom_h_tail() -> Mesh:
    """17 m class: deep pod, long straight wing, two booms joined by a tailplane between twin fins, pusher."""
    body = fuselage(
        [
            (3.9, 0.2, 0.2, 0.15),
            (3.6, 0.7, 0.65, 0.1),
            (2.6, 0.95, 1.0, 0.0),
            (0.6, 1.0, 1.1, 0.0),
            (-0.8, 0.95, 0.95, -0.05),
            (-1.4, 0.6, 0.55, -0.1),
        ],
        exponent=2.8,
    )
    wing = both_sides(lifting_surface([(0.4, 0.2, -0.48, 1.1), (0.35, 3.5, -0.52, 1.0), (0.1, 8.3, -0.65, 0.5)], 0.17))
    boom = both_sides(
        fuselage(
            [(0.5, 0.15, 0.18, -0.42), (0.2, 0.3, 0.34, -0.42), (-4.2, 0.2, 0.24, -0.42), (-4.6, 0.1, 0.12, -0.42)],
            part=Part.FUSELAGE,
            y_m=1.6,
            rings=5,
            points=8,
        )
    )
    fin = both_sides(
        lifting_surface([(-3.5, 1.6, 0.15, 0.7), (-3.45, 1.6, -0.42, 1.0), (-3.75, 1.6, -1.5, 0.65)], 0.1, Part.TAIL)
    )
    tailplane = both_sides(lifting_surface([(-3.65, 0.0, -0.5, 0.7), (-3.65, 1.65, -0.5, 0.7)], 0.1, Part.TAIL))
    turret = ellipsoid([2.7, 0.0, 0.68], [0.3, 0.3, 0.32], Part.SENSOR)
    dome = fuselage([(2.4, 0.3, 0.15, -0.5), (1.9, 0.7, 0.5, -0.6), (1.0, 0.5, 0.3, -0.5)], rings=6, points=10)
    return merge([body, wing, boom, fin, tailplane, turret, dome, propeller_disc([-1.5, 0.0, -0.1], 0.95)])
