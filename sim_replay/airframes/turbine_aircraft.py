"""Turboprops and jets with a crew.

Only span and length follow a citation; every other proportion is drawn by eye from the type's layout.
"""

from __future__ import annotations

from sim_replay.airframes.mesh import Mesh, Part, both_sides, merge, moved
from sim_replay.airframes.shapes import (
    Patch,
    blade_antenna,
    ellipsoid,
    exhaust,
    fuselage,
    lifting_surface,
    propeller,
)


def _cabin_windows(first_x_m: float, count: int, pitch_m: float, size_m: float) -> list[Patch]:
    """Round windows in a row, from the first towards the tail."""
    return [
        Patch(Part.GLASS, (first_x_m - k * pitch_m - size_m, first_x_m - k * pitch_m), (60.0, 80.0))
        for k in range(count)
    ]


def business_turboprop() -> Mesh:
    """16 m class: one turboprop in a long nose, low wing with winglets, T-tail, gear retracted."""
    body = fuselage(
        [
            (5.3, 0.5, 0.5, 0.05),
            (5.2, 0.72, 0.7, 0.08),
            (4.2, 1.02, 1.1, 0.1),
            (3.2, 1.3, 1.36, 0.08),
            (2.2, 1.6, 1.8, -0.06),
            (0.5, 1.66, 1.86, -0.06),
            (-2.4, 1.6, 1.8, -0.08),
            (-5.0, 0.9, 1.15, -0.24),
            (-7.2, 0.24, 0.45, -0.42),
        ],
        rings=26,
        points=18,
        patches=[
            Patch(Part.TYRE, (3.3, 5.0), (0.0, 32.0)),
            Patch(Part.GLASS, (2.35, 3.15), (0.0, 76.0)),
            *_cabin_windows(1.5, 8, 0.6, 0.32),
        ],
    )
    wing = both_sides(
        lifting_surface(
            [
                (0.95, 0.5, 0.68, 2.2, 2),
                (0.35, 7.2, 0.02, 1.15, -1),
                (0.1, 7.85, -0.12, 0.85, -1),
                (-0.55, 8.14, -0.8, 0.4, -1),
            ],
            "2415",
            leading_edge=Part.TYRE,
        )
    )
    fin = lifting_surface(
        [(-3.9, 0.0, -0.6, 3.2), (-5.1, 0.0, -1.1, 2.1), (-6.1, 0.0, -2.85, 1.6)], "0011", Part.TAIL, Part.METAL
    )
    tailplane = both_sides(
        lifting_surface([(-6.0, 0.0, -2.85, 1.45), (-6.55, 2.6, -2.85, 0.8)], "0010", Part.TAIL, Part.TYRE)
    )
    bullet = ellipsoid([-6.5, 0.0, -2.86], [0.95, 0.14, 0.16], Part.TAIL)
    strake = both_sides(lifting_surface([(-5.2, 0.2, 0.1, 1.5), (-5.9, 0.55, 0.55, 0.8)], "0006", Part.TAIL))
    stacks = both_sides(exhaust([3.95, 0.62, 0.18], 0.14, 0.5))
    chin = fuselage(
        [(5.12, 0.4, 0.2, 0.5), (4.6, 0.5, 0.3, 0.52), (3.6, 0.4, 0.16, 0.62)],
        rings=5,
        points=12,
        caps=(Part.TYRE, None),
    )
    radar = ellipsoid([0.28, 7.0, 0.08], [0.6, 0.2, 0.2], Part.SENSOR)
    details = [blade_antenna([0.5, 0.0, -0.98], 0.3), blade_antenna([-1.5, 0.0, 0.8], 0.25, above=False)]
    return merge(
        [
            body,
            wing,
            fin,
            tailplane,
            bullet,
            strake,
            stacks,
            chin,
            radar,
            *details,
            propeller([5.38, 0.0, 0.05], 1.33, 0.5),
        ]
    )


def twin_turboprop() -> Mesh:
    """16 m class: two turboprops on a low wing, round cabin with a pointed nose, cruciform tail, gear retracted."""
    body = fuselage(
        [
            (6.2, 0.15, 0.15, 0.2),
            (6.08, 0.5, 0.46, 0.18),
            (5.4, 1.05, 1.0, 0.1),
            (4.6, 1.45, 1.4, 0.04),
            (3.7, 1.85, 1.9, -0.06),
            (2.6, 1.96, 1.98, -0.08),
            (-2.6, 1.96, 1.98, -0.08),
            (-5.2, 1.15, 1.2, -0.28),
            (-7.6, 0.3, 0.36, -0.5),
        ],
        rings=28,
        points=18,
        patches=[
            Patch(Part.TYRE, (4.75, 5.9), (0.0, 30.0)),
            Patch(Part.GLASS, (3.85, 4.6), (0.0, 80.0)),
            *_cabin_windows(2.6, 7, 0.8, 0.42),
        ],
    )
    wing = both_sides(
        lifting_surface(
            [
                (1.1, 0.5, 0.7, 2.3, 2),
                (0.85, 2.6, 0.48, 1.9, 1),
                (0.25, 7.6, -0.1, 0.95, -1),
                (0.0, 7.9, -0.14, 0.5, -1),
            ],
            "2415",
            leading_edge=Part.TYRE,
        )
    )
    nacelle = both_sides(
        fuselage(
            [
                (2.9, 0.36, 0.4, 0.22),
                (2.8, 0.55, 0.62, 0.24),
                (2.0, 0.74, 0.9, 0.3),
                (0.2, 0.7, 0.9, 0.4),
                (-1.6, 0.3, 0.3, 0.5),
            ],
            2.6,
            Part.WING,
            2.6,
            rings=10,
            points=14,
            patches=[Patch(Part.TYRE, (2.6, 3.0), (130.0, 180.0))],
        ),
        exhaust([-0.3, 2.95, 0.2], 0.15, 0.9),
    )
    prop = propeller([3.0, 0.0, 0.22], 1.35, 0.45)
    props = [moved(prop, [0.0, y, 0.0]) for y in (2.6, -2.6)]
    fin = lifting_surface(
        [(-4.2, 0.0, -0.7, 3.1), (-5.4, 0.0, -1.3, 2.2), (-6.9, 0.0, -3.3, 1.2)], "0011", Part.TAIL, Part.TYRE
    )
    tailplane = both_sides(
        lifting_surface([(-5.6, 0.0, -1.75, 1.9), (-6.4, 3.3, -1.75, 0.95)], "0010", Part.TAIL, Part.TYRE)
    )
    ventral = lifting_surface([(-5.4, 0.0, 0.1, 1.6), (-6.4, 0.0, 0.6, 0.6)], "0008", Part.TAIL)
    details = [blade_antenna([1.0, 0.0, -1.05], 0.35), blade_antenna([-1.5, 0.0, 0.88], 0.3, above=False)]
    return merge([body, wing, nacelle, *props, fin, tailplane, ventral, *details])


def jet_trainer() -> Mesh:
    """9.5 m class: tandem canopy, shoulder intakes, low wing with tip tanks, one jet pipe, gear retracted."""
    body = fuselage(
        [
            (6.0, 0.06, 0.06, 0.12),
            (5.8, 0.26, 0.24, 0.12),
            (4.8, 0.62, 0.66, 0.08),
            (3.4, 0.88, 0.98, 0.02),
            (1.6, 1.0, 1.2, -0.02),
            (-0.5, 1.05, 1.25, -0.04),
            (-3.0, 0.9, 1.0, -0.06),
            (-4.9, 0.66, 0.68, -0.06),
        ],
        rings=24,
        patches=[Patch(Part.TYRE, (3.7, 5.6), (0.0, 36.0))],
    )
    pipe = exhaust([-5.2, 0.0, -0.06], 0.28, 0.4)
    canopy = fuselage(
        [
            (3.75, 0.1, 0.06, -0.4),
            (3.2, 0.52, 0.5, -0.5),
            (2.2, 0.66, 0.86, -0.56),
            (0.9, 0.66, 0.92, -0.6),
            (-0.4, 0.4, 0.4, -0.6),
        ],
        2.2,
        Part.GLASS,
        rings=14,
        points=14,
        patches=[Patch(Part.FUSELAGE, (1.4, 1.55), (0.0, 180.0))],
    )
    spine = fuselage([(0.3, 0.3, 0.3, -0.62), (-0.8, 0.5, 0.45, -0.55), (-3.6, 0.3, 0.3, -0.42)], rings=6, points=12)
    intakes = both_sides(
        fuselage(
            [(1.0, 0.36, 0.66, -0.36), (0.3, 0.46, 0.8, -0.34), (-2.0, 0.4, 0.7, -0.22), (-3.8, 0.14, 0.3, -0.1)],
            3.0,
            y_m=0.58,
            rings=8,
            points=12,
            caps=(Part.TYRE, None),
        )
    )
    wing = both_sides(
        lifting_surface([(1.0, 0.3, 0.5, 2.7, 1), (0.25, 4.45, 0.32, 1.25, 0)], "2412"),
        fuselage(
            [
                (1.35, 0.05, 0.05, 0.32),
                (1.15, 0.22, 0.22, 0.32),
                (0.3, 0.38, 0.38, 0.32),
                (-0.8, 0.3, 0.3, 0.32),
                (-1.5, 0.05, 0.05, 0.32),
            ],
            2.0,
            Part.WING,
            4.54,
            rings=10,
            points=12,
        ),
    )
    tailplane = both_sides(lifting_surface([(-4.1, 0.1, -0.5, 1.5), (-4.85, 2.2, -0.5, 0.75)], "0009", Part.TAIL))
    fin = lifting_surface([(-2.6, 0.0, -0.4, 2.9), (-3.7, 0.0, -0.85, 2.0), (-5.2, 0.0, -2.5, 1.0)], "0010", Part.TAIL)
    details = [blade_antenna([-1.2, 0.0, -0.76], 0.25), blade_antenna([0.5, 0.15, 0.55], 0.2, above=False)]
    return merge([body, pipe, canopy, spine, intakes, wing, tailplane, fin, *details])
