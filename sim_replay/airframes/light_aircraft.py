"""Light aircraft with a pilot: trainers, tourers, a biplane, a canard, an ultralight, a floatplane, a sailplane.

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
    gear_leg,
    lifting_surface,
    propeller,
    strut,
    tricycle,
    wheel,
)


def light_aircraft() -> Mesh:
    """11 m class: strutted high wing, cabin with windows, conventional tail, fixed gear, tractor propeller."""
    body = fuselage(
        [
            (2.05, 0.7, 0.55, 0.24, 2.4),
            (1.96, 0.92, 0.74, 0.24, 2.6),
            (1.3, 1.06, 0.9, 0.2, 3.0),
            (0.9, 1.1, 0.98, 0.17, 3.2),
            (0.3, 1.12, 1.42, -0.02, 3.6),
            (-0.8, 1.12, 1.46, -0.02, 3.6),
            (-1.7, 1.02, 1.22, -0.06, 3.2),
            (-2.5, 0.8, 0.86, -0.04, 2.8),
            (-4.2, 0.44, 0.56, -0.1, 2.4),
            (-6.0, 0.12, 0.28, -0.16, 2.2),
        ],
        rings=22,
        patches=[
            Patch(Part.GLASS, (0.32, 0.88), (0.0, 62.0)),
            Patch(Part.GLASS, (-0.5, 0.3), (42.0, 82.0)),
            Patch(Part.GLASS, (-1.45, -0.62), (42.0, 82.0)),
            Patch(Part.GLASS, (-2.2, -1.75), (0.0, 42.0)),
            Patch(Part.TYRE, (2.0, 2.1), (50.0, 100.0)),
        ],
    )
    wing = both_sides(
        lifting_surface(
            [
                (0.45, 0.2, -0.72, 1.63, 1),
                (0.45, 2.6, -0.76, 1.63, 1),
                (0.24, 5.35, -0.86, 1.16, -2),
                (0.1, 5.5, -0.87, 0.8, -2),
            ],
            "2412",
        )
    )
    tailplane = both_sides(lifting_surface([(-4.75, 0.08, -0.1, 1.3), (-5.05, 1.72, -0.1, 0.85)], "0009", Part.TAIL))
    fin = lifting_surface(
        [(-3.6, 0.0, -0.2, 2.4), (-4.55, 0.0, -0.55, 1.5), (-5.5, 0.0, -1.75, 0.75)], "0009", Part.TAIL
    )
    struts = both_sides(strut([0.15, 0.55, 0.6], [0.05, 2.6, -0.7], 0.05, Part.WING, 0.16))
    gear = tricycle((1.35, 0.55, 1.22), ([-0.5, 0.42, 0.6], [-0.55, 1.25, 1.18]), 0.22, 0.07)
    details = [
        exhaust([1.15, 0.22, 0.78], 0.05, 0.3),
        both_sides(strut([1.0, 0.38, 0.1], [0.95, 0.5, 0.1], 0.03)),
        blade_antenna([-0.4, 0.0, -0.76], 0.2),
        strut([0.3, -2.9, -0.66], [0.55, -2.9, -0.62], 0.03),
    ]
    return merge([body, wing, tailplane, fin, struts, gear, *details, propeller([2.12, 0.0, 0.24], 0.95, 0.22)])


def low_wing_tourer() -> Mesh:
    """11 m class: tapered low wing with dihedral, four-seat cabin, swept fin, faired fixed gear, tractor propeller."""
    body = fuselage(
        [
            (2.15, 0.55, 0.5, 0.06, 2.4),
            (2.08, 0.82, 0.66, 0.06, 2.6),
            (1.4, 1.0, 0.84, 0.06, 2.8),
            (0.95, 1.1, 0.9, 0.05, 2.8),
            (0.35, 1.18, 1.34, -0.14, 2.7),
            (-0.6, 1.16, 1.34, -0.14, 2.7),
            (-1.5, 0.98, 1.1, -0.08, 2.6),
            (-2.4, 0.74, 0.8, -0.02, 2.5),
            (-4.9, 0.16, 0.3, -0.08, 2.2),
        ],
        rings=22,
        patches=[
            Patch(Part.GLASS, (0.36, 0.92), (0.0, 70.0)),
            Patch(Part.GLASS, (-0.35, 0.34), (42.0, 84.0)),
            Patch(Part.GLASS, (-1.2, -0.45), (42.0, 84.0)),
            Patch(Part.TYRE, (2.1, 2.2), (50.0, 105.0)),
        ],
    )
    wing = both_sides(
        lifting_surface(
            [
                (0.75, 0.2, 0.42, 1.95, 2),
                (0.45, 0.7, 0.38, 1.6, 2),
                (0.42, 3.0, 0.1, 1.6, 1),
                (0.18, 5.3, -0.2, 1.08, -1),
                (0.0, 5.42, -0.22, 0.7, -1),
            ],
            "2415",
        )
    )
    tailplane = both_sides(lifting_surface([(-4.1, 0.08, -0.02, 0.76), (-4.1, 1.95, -0.02, 0.76)], "0010", Part.TAIL))
    fin = lifting_surface(
        [(-3.2, 0.0, -0.2, 1.65), (-3.75, 0.0, -0.45, 1.15), (-4.45, 0.0, -1.4, 0.7)], "0009", Part.TAIL
    )
    gear = tricycle((1.45, 0.4, 1.02), ([-0.1, 1.55, 0.32], [-0.1, 1.55, 0.98]), 0.2, 0.08)
    spats = both_sides(ellipsoid([-0.14, 1.55, 0.92], [0.4, 0.11, 0.17], Part.WING, 7, 10))
    nose_spat = ellipsoid([1.48, 0.0, 0.96], [0.36, 0.1, 0.16], Part.WING, 7, 10)
    details = [
        exhaust([1.3, 0.2, 0.56], 0.05, 0.3),
        blade_antenna([-0.9, 0.0, -0.76], 0.22),
        strut([0.3, -2.9, 0.22], [0.15, -2.9, 0.34], 0.03),
    ]
    return merge(
        [body, wing, tailplane, fin, gear, spats, nose_spat, *details, propeller([2.22, 0.0, 0.06], 0.94, 0.3)]
    )


def biplane() -> Mesh:
    """10 m class: two staggered wings with struts, open cockpits, radial engine, tail wheel."""
    body = fuselage(
        [
            (2.0, 0.5, 0.5, 0.0),
            (1.95, 0.78, 0.78, 0.0),
            (1.4, 0.86, 0.92, 0.02),
            (0.3, 0.84, 1.05, 0.0, 2.6),
            (-1.4, 0.74, 0.92, -0.02, 2.6),
            (-3.2, 0.4, 0.5, -0.08),
            (-4.9, 0.1, 0.22, -0.16),
        ],
        rings=20,
        patches=[Patch(Part.TYRE, (-0.62, -0.05), (0.0, 45.0)), Patch(Part.TYRE, (-1.55, -0.98), (0.0, 45.0))],
        caps=(Part.METAL, None),
    )
    cylinders = [
        ellipsoid([1.78, 0.5 * y, 0.5 * z], [0.12, 0.1 + 0.05 * abs(y), 0.1 + 0.05 * abs(z)], Part.METAL, 5, 8)
        for y, z in ((0.0, -1.0), (0.78, -0.62), (0.97, 0.22), (0.43, 0.9), (-0.43, 0.9), (-0.97, 0.22), (-0.78, -0.62))
    ]
    upper = both_sides(
        lifting_surface([(0.75, 0.0, -1.25, 1.5, 1), (0.75, 4.5, -1.3, 1.5, 1), (0.5, 4.9, -1.3, 0.9, 1)], "4412")
    )
    lower = both_sides(
        lifting_surface([(0.15, 0.3, 0.38, 1.5, 1), (0.15, 4.3, 0.22, 1.5, 1), (-0.1, 4.72, 0.2, 0.9, 1)], "4412")
    )
    struts = both_sides(
        strut([0.45, 3.2, -1.25], [-0.1, 3.1, 0.28], 0.05, Part.WING, 0.14),
        strut([-0.35, 3.2, -1.25], [-0.9, 3.1, 0.28], 0.05, Part.WING, 0.14),
        strut([0.5, 0.55, -1.22], [0.75, 0.35, -0.4], 0.04, Part.METAL, 0.1),
        strut([-0.3, 0.55, -1.22], [0.0, 0.35, -0.45], 0.04, Part.METAL, 0.1),
    )
    tailplane = both_sides(lifting_surface([(-3.55, 0.05, -0.2, 1.35), (-3.9, 1.75, -0.2, 0.75)], "0008", Part.TAIL))
    fin = lifting_surface(
        [(-3.5, 0.0, -0.2, 1.5), (-3.95, 0.0, -0.85, 1.15), (-4.35, 0.0, -1.3, 0.5)], "0008", Part.TAIL
    )
    gear = both_sides(gear_leg([0.85, 0.32, 0.42], [0.9, 0.92, 1.3], 0.32, 0.15, 0.13))
    screens = [ellipsoid([x, 0.0, -0.55], [0.1, 0.22, 0.17], Part.GLASS, 6, 8) for x in (0.02, -0.92)]
    pilot = ellipsoid([-1.28, 0.0, -0.6], [0.13, 0.11, 0.16], Part.SENSOR, 6, 8)
    tail_wheel = wheel([-4.3, 0.0, 0.22], 0.13, 0.07)
    return merge(
        [
            body,
            *cylinders,
            upper,
            lower,
            struts,
            tailplane,
            fin,
            gear,
            *screens,
            pilot,
            tail_wheel,
            exhaust([1.2, 0.3, 0.52], 0.05, 0.3),
            propeller([2.15, 0.0, 0.0], 1.25, 0.14),
        ]
    )


def canard_pusher() -> Mesh:
    """8 m class: canard ahead of a pointed nose's canopy, swept wing with strakes and winglets, pusher."""
    body = fuselage(
        [
            (3.1, 0.12, 0.1, 0.02),
            (3.0, 0.28, 0.2, 0.02),
            (2.3, 0.52, 0.46, 0.0),
            (1.5, 0.6, 0.62, -0.02),
            (0.3, 0.62, 0.8, -0.02),
            (-0.7, 0.64, 0.78, -0.02),
            (-1.5, 0.56, 0.6, 0.0),
            (-1.8, 0.4, 0.42, 0.0),
        ],
        caps=(None, Part.METAL),
    )
    canopy = ellipsoid([0.85, 0.0, -0.3], [1.35, 0.27, 0.34], Part.GLASS, 11, 14)
    canard = both_sides(
        lifting_surface([(2.65, 0.1, -0.14, 0.36, 3), (2.65, 1.75, -0.16, 0.34, 3), (2.55, 1.8, -0.16, 0.2, 3)], "4415")
    )
    wing = both_sides(
        lifting_surface(
            [(1.0, 0.2, 0.1, 2.6), (0.35, 0.85, 0.1, 1.9), (-0.35, 1.3, 0.1, 1.15, 1), (-1.6, 3.95, 0.06, 0.5, -1)],
            "2412",
        )
    )
    winglet = both_sides(
        lifting_surface(
            [(-1.72, 3.96, 0.3, 0.3), (-1.6, 3.96, 0.06, 0.55), (-2.1, 4.02, -1.1, 0.28)], "0010", Part.TAIL
        )
    )
    cowl = both_sides(ellipsoid([-1.35, 0.3, -0.05], [0.4, 0.16, 0.18], Part.FUSELAGE, 7, 8))
    legs = both_sides(gear_leg([-0.4, 0.3, 0.3], [-0.55, 0.95, 1.0], 0.17, 0.09, 0.06))
    naca_scoop = fuselage(
        [(0.0, 0.3, 0.12, 0.42), (-0.5, 0.34, 0.18, 0.4), (-1.5, 0.3, 0.1, 0.28)],
        rings=5,
        points=10,
        caps=(Part.TYRE, None),
    )
    pipes = both_sides(exhaust([-1.95, 0.14, 0.22], 0.04, 0.3))
    return merge(
        [
            body,
            canopy,
            canard,
            wing,
            winglet,
            cowl,
            legs,
            naca_scoop,
            pipes,
            propeller([-1.9, 0.0, 0.0], 0.85, 0.2, True),
        ]
    )


def ultralight_pusher() -> Mesh:
    """9.6 m class: pod and thin boom, strutted high wing, engine and propeller behind it, open cabin sides."""
    body = fuselage(
        [
            (2.5, 0.1, 0.1, 0.42),
            (2.42, 0.3, 0.3, 0.4),
            (1.9, 0.56, 0.62, 0.3),
            (1.3, 0.7, 0.9, 0.16),
            (0.7, 0.72, 1.2, 0.0),
            (-0.6, 0.7, 1.2, 0.0),
            (-1.4, 0.5, 0.74, 0.12),
            (-2.4, 0.3, 0.42, 0.12),
            (-3.5, 0.1, 0.16, 0.0),
        ],
        exponent=2.8,
        rings=20,
        patches=[Patch(Part.GLASS, (0.75, 1.45), (0.0, 90.0)), Patch(Part.GLASS, (-0.5, 0.62), (36.0, 86.0))],
    )
    wing = both_sides(
        lifting_surface([(0.4, 0.0, -0.68, 1.5, 2), (0.4, 4.6, -0.8, 1.5, 0), (0.2, 4.8, -0.81, 1.1, 0)], "4412")
    )
    struts = both_sides(
        strut([0.1, 0.34, 0.5], [0.2, 2.6, -0.72], 0.05, Part.METAL, 0.09),
        strut([-0.6, 0.34, 0.5], [-0.7, 2.6, -0.7], 0.05, Part.METAL, 0.09),
    )
    boom = strut([-0.6, 0.0, -0.62], [-3.4, 0.0, -0.1], 0.12)
    engine = fuselage(
        [(-0.75, 0.3, 0.34, -0.78), (-1.0, 0.42, 0.42, -0.8), (-1.4, 0.26, 0.28, -0.82)],
        3.5,
        Part.METAL,
        rings=4,
        points=10,
    )
    tailplane = both_sides(lifting_surface([(-2.55, 0.05, -0.18, 1.0), (-2.8, 1.3, -0.18, 0.65)], "0006", Part.TAIL))
    fin = lifting_surface(
        [(-2.8, 0.0, 0.25, 0.75), (-2.5, 0.0, -0.15, 1.1), (-2.95, 0.0, -1.15, 0.75)], "0006", Part.TAIL
    )
    gear = tricycle((1.95, 0.5, 0.92), ([-0.3, 0.3, 0.55], [-0.35, 0.85, 0.92]), 0.19, 0.05)
    silencer = exhaust([-1.3, 0.28, -0.62], 0.07, 0.4)
    return merge(
        [
            body,
            wing,
            struts,
            boom,
            engine,
            tailplane,
            fin,
            gear,
            silencer,
            propeller([-1.5, 0.0, -0.82], 0.75, 0.12, True),
        ]
    )


def floatplane() -> Mesh:
    """15 m class: untapered strutted high wing, radial engine, round fin, two floats on struts."""
    body = fuselage(
        [
            (2.85, 0.7, 0.7, 0.05),
            (2.78, 1.1, 1.1, 0.05),
            (1.9, 1.24, 1.24, 0.05),
            (1.2, 1.26, 1.3, 0.05, 2.8),
            (0.6, 1.28, 1.56, -0.08, 3.2),
            (-1.2, 1.26, 1.56, -0.06, 3.2),
            (-2.4, 0.94, 1.2, -0.04, 2.8),
            (-5.9, 0.18, 0.4, -0.14),
        ],
        rings=22,
        patches=[
            Patch(Part.GLASS, (0.62, 1.15), (0.0, 76.0)),
            Patch(Part.GLASS, (-0.15, 0.58), (36.0, 88.0)),
            Patch(Part.GLASS, (-1.4, -0.4), (44.0, 88.0)),
        ],
        caps=(Part.TYRE, None),
    )
    wing = both_sides(
        lifting_surface([(0.45, 0.2, -0.86, 1.6, 1), (0.45, 7.0, -1.05, 1.6, 0), (0.2, 7.3, -1.06, 1.0, 0)], "4415")
    )
    struts = both_sides(strut([0.1, 0.6, 0.55], [0.05, 3.3, -0.9], 0.06, Part.WING, 0.18))
    tailplane = both_sides(lifting_surface([(-4.4, 0.1, -0.3, 1.3), (-4.55, 2.4, -0.3, 0.95)], "0009", Part.TAIL))
    fin = lifting_surface(
        [(-3.7, 0.0, -0.3, 2.3), (-4.4, 0.0, -0.8, 1.75), (-4.6, 0.0, -1.5, 1.4), (-5.0, 0.0, -1.9, 0.75)],
        "0009",
        Part.TAIL,
    )
    floats = both_sides(
        fuselage(
            [
                (3.1, 0.1, 0.1, 1.6),
                (3.0, 0.4, 0.3, 1.62),
                (2.0, 0.72, 0.66, 1.76),
                (0.0, 0.74, 0.74, 1.8),
                (-0.3, 0.72, 0.6, 1.74),
                (-3.4, 0.3, 0.24, 1.58),
            ],
            3.0,
            Part.SENSOR,
            1.45,
            rings=10,
            points=12,
        ),
        strut([1.2, 0.5, 0.6], [1.5, 1.45, 1.5], 0.06, Part.METAL, 0.14),
        strut([-0.9, 0.5, 0.6], [-0.9, 1.45, 1.5], 0.06, Part.METAL, 0.14),
        strut([1.2, 0.4, 0.66], [-0.9, 1.45, 1.5], 0.05),
    )
    spreaders = [strut([x, -1.45, 1.62], [x, 1.45, 1.62], 0.07, Part.METAL, 0.14) for x in (1.5, -0.9)]
    details = [exhaust([1.6, 0.35, 0.68], 0.08, 0.4), blade_antenna([-1.6, 0.0, -0.8], 0.25)]
    return merge(
        [body, wing, struts, tailplane, fin, floats, *spreaders, *details, propeller([2.95, 0.0, 0.05], 1.28, 0.22)]
    )


def glider() -> Mesh:
    """15 m class: thin wing of high aspect ratio with upturned tips, slim boom, T-tail, long canopy, no propeller."""
    body = fuselage(
        [
            (2.05, 0.06, 0.06, 0.12),
            (1.97, 0.24, 0.24, 0.1),
            (1.6, 0.48, 0.54, 0.04),
            (0.9, 0.64, 0.84, -0.02),
            (0.0, 0.6, 0.82, -0.04),
            (-1.0, 0.38, 0.48, -0.1),
            (-2.4, 0.22, 0.28, -0.12),
            (-4.75, 0.12, 0.22, -0.15),
        ],
        rings=22,
        patches=[Patch(Part.GLASS, (0.35, 1.75), (0.0, 68.0))],
    )
    wing = both_sides(
        lifting_surface(
            [
                (0.26, 0.1, -0.24, 0.98, 2),
                (0.2, 3.0, -0.36, 0.84, 1),
                (0.1, 5.4, -0.5, 0.62, 0),
                (-0.05, 7.1, -0.66, 0.4, -1),
                (-0.2, 7.5, -0.74, 0.2, -1),
            ],
            "4414",
        )
    )
    fin = lifting_surface([(-3.7, 0.0, -0.1, 1.08), (-4.1, 0.0, -1.4, 0.7)], "0012", Part.TAIL)
    tailplane = both_sides(
        lifting_surface(
            [(-4.12, 0.0, -1.4, 0.58), (-4.25, 1.2, -1.42, 0.36), (-4.33, 1.3, -1.42, 0.2)], "0010", Part.TAIL
        )
    )
    return merge(
        [body, wing, fin, tailplane, wheel([0.1, 0.0, 0.36], 0.17, 0.1), wheel([-4.3, 0.0, -0.02], 0.09, 0.05)]
    )
