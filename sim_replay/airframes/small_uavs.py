"""Smaller unmanned aircraft and jets: loitering, ship-launched, hand-launched, target, stealth.

Only span and length follow a citation; every other proportion is drawn by eye from the type's layout.
"""

from __future__ import annotations

from sim_replay.airframes.mesh import Mesh, Part, both_sides, merge
from sim_replay.airframes.shapes import (
    Patch,
    blade_antenna,
    ellipsoid,
    exhaust,
    fuselage,
    lifting_surface,
    propeller,
    sensor_ball,
    stopped_rotor,
    strut,
)


def loitering_delta() -> Mesh:
    """2.5 m class: cropped delta blended into its body, fins above and below the wing tips, exposed engine, pusher."""
    body = fuselage(
        [
            (1.75, 0.04, 0.04, 0.0),
            (1.68, 0.14, 0.14, 0.0),
            (1.45, 0.27, 0.28, 0.0),
            (0.9, 0.37, 0.4, 0.0),
            (-0.4, 0.4, 0.43, 0.0),
            (-1.2, 0.37, 0.38, 0.0),
            (-1.5, 0.26, 0.26, 0.0),
        ],
        caps=(None, Part.METAL),
    )
    wing = both_sides(
        lifting_surface(
            [(1.15, 0.06, 0.0, 2.5), (0.55, 0.3, 0.0, 1.9), (0.22, 0.5, 0.0, 1.57), (-0.75, 1.23, 0.0, 0.6)], "0009"
        )
    )
    fin = both_sides(
        lifting_surface([(-0.72, 1.23, 0.0, 0.62), (-1.0, 1.23, -0.4, 0.34)], "0008", Part.TAIL),
        lifting_surface([(-0.72, 1.23, 0.0, 0.62), (-1.0, 1.23, 0.3, 0.34)], "0008", Part.TAIL),
    )
    cylinders = both_sides(ellipsoid([-1.52, 0.2, -0.02], [0.09, 0.12, 0.07], Part.METAL, 6, 8))
    pipe = exhaust([-1.6, 0.1, 0.14], 0.035, 0.22)
    return merge([body, wing, fin, cylinders, pipe, propeller([-1.68, 0.0, 0.0], 0.32, 0.12, True)])


def tailless_swept() -> Mesh:
    """3 m class: round pod with a nose turret, thin swept wing, winglets that carry the rudders, pusher."""
    body = fuselage(
        [
            (0.85, 0.06, 0.06, 0.01),
            (0.83, 0.12, 0.12, 0.01),
            (0.74, 0.17, 0.17, 0.0),
            (0.4, 0.2, 0.21, 0.0),
            (-0.3, 0.2, 0.21, 0.0),
            (-0.58, 0.15, 0.16, 0.0),
        ],
        patches=[Patch(Part.SENSOR, (0.62, 0.86), (0.0, 180.0))],
        caps=(None, Part.METAL),
    )
    wing = both_sides(lifting_surface([(0.3, 0.05, -0.05, 0.32, 2), (-0.36, 1.5, -0.05, 0.22, -2)], "2413"))
    winglet = both_sides(
        lifting_surface(
            [(-0.38, 1.5, 0.08, 0.2), (-0.36, 1.5, -0.03, 0.24), (-0.52, 1.55, -0.36, 0.15)], "0010", Part.TAIL
        )
    )
    engine = both_sides(ellipsoid([-0.46, 0.11, -0.02], [0.06, 0.07, 0.05], Part.METAL, 6, 8))
    details = [
        sensor_ball([0.72, 0.0, 0.11], 0.08),
        exhaust([-0.58, 0.06, 0.1], 0.02, 0.1),
        blade_antenna([-0.1, 0.0, -0.1], 0.08),
    ]
    return merge([body, wing, winglet, engine, *details, propeller([-0.63, 0.0, 0.0], 0.21, 0.06, True)])


def hybrid_quadplane() -> Mesh:
    """5.5 m class: lift rotors at rest on two booms, high straight wing, tractor propeller, twin fins."""
    body = fuselage(
        [
            (1.2, 0.2, 0.2, 0.0),
            (1.1, 0.26, 0.27, 0.0),
            (0.7, 0.34, 0.4, 0.02),
            (-0.1, 0.34, 0.42, 0.02),
            (-0.6, 0.22, 0.28, -0.02),
            (-0.95, 0.06, 0.08, -0.08),
        ],
        exponent=3.0,
        caps=(Part.TYRE, None),
    )
    wing = both_sides(
        lifting_surface([(0.22, 0.05, -0.2, 0.46, 2), (0.2, 1.4, -0.22, 0.44, 1), (0.06, 2.72, -0.3, 0.28, -1)], "4414")
    )
    boom = both_sides(
        fuselage(
            [(1.02, 0.06, 0.06, -0.2), (0.95, 0.09, 0.09, -0.2), (0.0, 0.1, 0.1, -0.2), (-1.6, 0.07, 0.07, -0.2)],
            y_m=0.72,
            rings=5,
            points=8,
        )
    )
    fin = both_sides(
        lifting_surface([(-1.2, 0.72, -0.18, 0.42), (-1.4, 0.72, -0.72, 0.26)], "0010", Part.TAIL),
    )
    tailplane = both_sides(lifting_surface([(-1.38, 0.0, -0.68, 0.26), (-1.38, 0.74, -0.68, 0.26)], "0010", Part.TAIL))
    rotors = both_sides(stopped_rotor([0.88, 0.72, -0.3], 0.36, 0.0), stopped_rotor([-0.8, 0.72, -0.3], 0.36, 0.0))
    skids = both_sides(
        strut([0.4, 0.12, 0.18], [0.45, 0.42, 0.52], 0.03),
        strut([-0.4, 0.1, 0.18], [-0.5, 0.42, 0.52], 0.03),
        strut([0.6, 0.42, 0.52], [-0.65, 0.42, 0.52], 0.03),
    )
    details = [sensor_ball([0.62, 0.0, 0.3], 0.11), exhaust([0.75, 0.15, 0.18], 0.025, 0.15)]
    return merge([body, wing, boom, fin, tailplane, rotors, skids, *details, propeller([1.22, 0.0, 0.0], 0.34, 0.1)])


def hand_launched() -> Mesh:
    """3 m class: slim boxy body, high wing with raised tips, T-shaped boom tail, tractor propeller, belly turret."""
    body = fuselage(
        [
            (0.42, 0.08, 0.09, 0.0),
            (0.38, 0.12, 0.13, 0.0),
            (0.25, 0.16, 0.19, 0.02),
            (-0.1, 0.16, 0.2, 0.02),
            (-0.3, 0.09, 0.12, -0.01),
            (-0.45, 0.05, 0.06, -0.03),
            (-0.92, 0.045, 0.05, -0.04),
        ],
        exponent=3.5,
        caps=(Part.METAL, None),
    )
    wing = both_sides(
        lifting_surface(
            [
                (0.12, 0.0, -0.1, 0.3, 2),
                (0.12, 0.7, -0.1, 0.3, 1),
                (0.05, 1.25, -0.18, 0.22, 0),
                (-0.03, 1.4, -0.22, 0.13, -1),
            ],
            "4412",
        )
    )
    fin = lifting_surface(
        [(-0.72, 0.0, 0.04, 0.16), (-0.72, 0.0, -0.04, 0.2), (-0.8, 0.0, -0.28, 0.13)], "0010", Part.TAIL
    )
    tailplane = both_sides(lifting_surface([(-0.7, 0.0, -0.07, 0.19), (-0.74, 0.33, -0.07, 0.14)], "0010", Part.TAIL))
    details = [
        sensor_ball([0.2, 0.0, 0.15], 0.055),
        blade_antenna([-0.2, 0.0, -0.06], 0.07),
        fuselage(
            [(0.3, 0.1, 0.05, -0.1), (0.05, 0.12, 0.07, -0.11), (-0.22, 0.08, 0.04, -0.08)],
            3.0,
            Part.METAL,
            rings=4,
            points=10,
        ),
    ]
    return merge([body, wing, fin, tailplane, *details, propeller([0.44, 0.0, 0.0], 0.2, 0.05)])


def jet_target_drone() -> Mesh:
    """6 m class: pointed round body, jet with a belly intake, short swept wing and tail, bright orange by habit."""
    body = fuselage(
        [
            (3.0, 0.04, 0.04, 0.05),
            (2.8, 0.18, 0.18, 0.04),
            (2.3, 0.38, 0.4, 0.02),
            (1.5, 0.52, 0.56, 0.0),
            (-0.5, 0.55, 0.6, 0.0),
            (-1.8, 0.48, 0.5, -0.02),
            (-2.7, 0.36, 0.36, -0.04),
        ],
        patches=[Patch(Part.METAL, (2.45, 3.1), (0.0, 180.0))],
    )
    pipe = exhaust([-2.95, 0.0, -0.04], 0.14, 0.3)
    wing = both_sides(
        lifting_surface([(0.75, 0.15, 0.12, 1.15), (0.05, 1.5, 0.1, 0.62), (-0.12, 1.6, 0.1, 0.4)], "1410")
    )
    tailplane = both_sides(lifting_surface([(-1.9, 0.1, -0.05, 0.75), (-2.35, 0.95, 0.05, 0.42)], "0009", Part.TAIL))
    fin = lifting_surface([(-1.65, 0.0, -0.15, 1.05), (-2.4, 0.0, -1.0, 0.5)], "0009", Part.TAIL)
    intake = fuselage(
        [(0.6, 0.36, 0.22, 0.42), (0.2, 0.46, 0.34, 0.38), (-1.0, 0.42, 0.34, 0.28), (-2.0, 0.2, 0.15, 0.15)],
        3.0,
        rings=8,
        points=14,
        caps=(Part.TYRE, None),
    )
    pods = both_sides(
        fuselage(
            [(0.75, 0.03, 0.03, 0.1), (0.6, 0.13, 0.13, 0.1), (-0.2, 0.16, 0.16, 0.1), (-0.7, 0.05, 0.05, 0.1)],
            2.0,
            Part.METAL,
            1.52,
            rings=7,
            points=10,
        )
    )
    details = [blade_antenna([1.2, 0.0, -0.26], 0.2), blade_antenna([-1.2, 0.1, 0.22], 0.18, above=False)]
    return merge([body, pipe, wing, tailplane, fin, intake, pods, *details])


def flying_wing_jet() -> Mesh:
    """10 m class: lambda wing without any tail, deep blended body, dorsal intake, flat exhaust."""
    body = fuselage(
        [
            (4.4, 0.1, 0.05, 0.02),
            (4.2, 0.7, 0.26, 0.02),
            (3.3, 1.6, 0.72, 0.0),
            (1.8, 2.3, 1.1, -0.02),
            (-0.5, 2.6, 1.15, -0.02),
            (-2.2, 2.3, 0.75, -0.04),
            (-3.3, 1.7, 0.3, -0.06),
        ],
        exponent=1.7,
        points=22,
    )
    wing = both_sides(
        lifting_surface(
            [
                (3.1, 0.5, 0.0, 5.9),
                (1.2, 1.7, 0.02, 3.9),
                (0.3, 2.3, 0.02, 2.5),
                (-2.0, 4.7, -0.02, 1.75),
                (-3.2, 5.15, -0.02, 0.35),
            ],
            "0008",
        )
    )
    intake = fuselage(
        [(2.35, 0.85, 0.36, -0.52), (1.7, 1.15, 0.62, -0.5), (0.2, 1.1, 0.66, -0.5), (-2.2, 0.9, 0.25, -0.24)],
        2.6,
        rings=9,
        points=16,
        caps=(Part.TYRE, None),
    )
    nozzle = exhaust([-3.45, 0.0, -0.06], 0.14, 0.6, width=5.0)
    details = [
        ellipsoid([3.5, 0.0, 0.3], [0.35, 0.2, 0.12], Part.SENSOR),
        blade_antenna([-0.4, 0.3, 0.5], 0.2, above=False),
    ]
    return merge([body, wing, intake, nozzle, *details])
