"""The shapes from which aircraft are assembled: lofted bodies, aerofoil surfaces, propellers, wheels, stores.

Everything is in the target's body frame (FRD: x nose, y right, z down), metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_replay.airframes.mesh import Mesh, Part, Parts, both_sides, loft, merge, moved

Array = NDArray[np.float64]
CHORD_POINTS = 8  # of one side of a wing's aerofoil
SMALL_POINTS = 4  # of one side of an aerial's or a store's fin
DISC_POINTS = 24


class Patch(NamedTuple):
    """A region of a body in another part: between two x, and between two angles from the top, on both sides."""

    part: Part
    x_m: tuple[float, float]
    angle_deg: tuple[float, float]  # 0 top, 90 side, 180 bottom


def monotone_cubic(x_new: Array, x: Array, y: Array) -> Array:
    """Monotone cubic interpolation (Fritsch-Carlson, harmonic-mean slopes): no overshoot in a lofted body."""
    step, secant = np.diff(x), np.diff(y) / np.diff(x)
    slope = np.zeros_like(y)
    same_sign = secant[:-1] * secant[1:] > 0
    safe = np.where(same_sign, secant[:-1] + secant[1:], 1.0)
    slope[1:-1] = np.where(same_sign, 2.0 * secant[:-1] * secant[1:] / safe, 0.0)
    slope[0], slope[-1] = secant[0], secant[-1]
    k = np.clip(np.searchsorted(x, x_new, side="right") - 1, 0, len(step) - 1)
    t, h = (x_new - x[k]) / step[k], step[k]
    h00, h10 = (1 + 2 * t) * (1 - t) ** 2, t * (1 - t) ** 2
    h01, h11 = t * t * (3 - 2 * t), t * t * (t - 1)
    return h00 * y[k] + h10 * h * slope[k] + h01 * y[k + 1] + h11 * h * slope[k + 1]


def _patched(x: Array, angle: Array, part: Part, patches: Sequence[Patch]) -> Parts:
    """The part of each quad [S - 1, P] of a body with stations x [S], falling, and angles [P] from +y towards +z."""
    middle_x = 0.5 * (x[:-1] + x[1:])[:, None]
    middle_angle = angle + 0.5 * (angle[1] - angle[0])
    from_top = np.abs((np.degrees(middle_angle) - 270.0 + 180.0) % 360.0 - 180.0)[None, :]
    out = np.full((len(x) - 1, len(angle)), part, np.uint8)
    for patch in patches:
        inside_x = (middle_x > min(patch.x_m)) & (middle_x < max(patch.x_m))
        out[inside_x & (from_top > patch.angle_deg[0]) & (from_top < patch.angle_deg[1])] = patch.part
    return out


def fuselage(
    stations: Sequence[tuple[float, ...]],
    exponent: float = 2.2,
    part: Part = Part.FUSELAGE,
    y_m: float = 0.0,
    rings: int = 18,
    points: int = 18,
    patches: Sequence[Patch] = (),
    caps: tuple[Part | None, Part | None] | None = None,
) -> Mesh:
    """A body of superellipse sections.

    Stations, nose to tail (x falls): (x, width, height, z of the centre[, exponent]), metres; |y|^e + |z|^e = 1.
    """
    table = np.array([(*row, exponent)[:5] for row in stations], dtype=np.float64)
    arc = np.linspace(0.0, 1.0, len(table))
    fine = np.linspace(0.0, 1.0, 512)
    borders = [x for patch in patches for x in patch.x_m if table[-1, 0] < x < table[0, 0]]
    at_borders = np.interp(-np.array(borders), -monotone_cubic(fine, arc, table[:, 0]), fine)
    dense = np.unique(np.round(np.concatenate([np.linspace(0.0, 1.0, rings), arc, at_borders]), 9))
    # Stations closer than this would only create slivers.
    dense = dense[np.concatenate([[True], np.diff(dense) > 1e-3])]
    x, width, height, z, power = (monotone_cubic(dense, arc, table[:, k]) for k in range(5))
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False) + np.pi / points
    cosine = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** (2.0 / power[:, None])
    sine = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** (2.0 / power[:, None])
    ring = np.stack(
        [
            np.broadcast_to(x[:, None], (len(x), points)),
            y_m + 0.5 * width[:, None] * cosine,
            z[:, None] + 0.5 * height[:, None] * sine,
        ],
        axis=-1,
    )
    return loft(ring, _patched(x, angle, part, patches), caps)


def naca_four_digit(code: str, points: int = CHORD_POINTS) -> Array:
    """A NACA four-digit aerofoil [2 P - 1, 2]: upper trailing edge, leading edge, lower trailing edge.

    Columns are x along the chord (0 leading edge, 1 trailing edge) and height above it, in chords; the trailing edge
    is open (Abbott & von Doenhoff, Theory of Wing Sections, section 6.4). Stations are spaced by a cosine.
    """
    camber, position, thickness = int(code[0]) / 100, int(code[1]) / 10, int(code[2:]) / 100
    c = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, points)))
    half = 5.0 * thickness * (0.2969 * np.sqrt(c) - 0.1260 * c - 0.3516 * c**2 + 0.2843 * c**3 - 0.1015 * c**4)
    line, slope = np.zeros_like(c), np.zeros_like(c)
    if camber:
        fore = c < position
        line = np.where(
            fore,
            camber / position**2 * (2 * position * c - c**2),
            camber / (1 - position) ** 2 * (1 - 2 * position + 2 * position * c - c**2),
        )
        slope = np.where(fore, 2 * camber / position**2, 2 * camber / (1 - position) ** 2) * (position - c)
    sine, cosine = slope / np.hypot(1, slope), 1 / np.hypot(1, slope)
    upper = np.stack([c - half * sine, line + half * cosine], axis=-1)
    lower = np.stack([c + half * sine, line - half * cosine], axis=-1)
    return np.concatenate([upper[::-1], lower[1:]])


def lifting_surface(
    sections: Sequence[tuple[float, ...]],
    naca: str = "0012",
    part: Part = Part.WING,
    leading_edge: Part | None = None,
    points: int = CHORD_POINTS,
) -> Mesh:
    """A wing, tailplane or fin of one NACA four-digit aerofoil.

    Sections, root to tip: (x, y, z of the leading edge, chord[, twist in degrees, nose up]), metres; the chord runs
    along -x. Washout is a twist that falls towards the tip. `leading_edge` paints the foremost 5 % of the chord, as a
    de-icing boot does; `points` are those of one side of the aerofoil.
    """
    table = np.array([(*row, 0.0)[:5] for row in sections], dtype=np.float64)
    span = np.gradient(table[:, 1:3], axis=0)
    span /= np.linalg.norm(span, axis=1, keepdims=True)
    up = np.stack([np.zeros(len(table)), span[:, 1], -span[:, 0]], axis=1)
    # A fin's sections are upright; its "up" is just one of its two sides.
    up *= np.where(up[:, 2:] > 1e-9, -1.0, 1.0)
    profile = naca_four_digit(naca, points)
    chord, twist = table[:, 3][:, None], np.radians(table[:, 4])[:, None]
    # Twist rotates about the quarter chord.
    aft, above = profile[:, 0] - 0.25, profile[:, 1]
    along = 0.25 + aft * np.cos(twist) + above * np.sin(twist)
    across = above * np.cos(twist) - aft * np.sin(twist)
    rings = (
        table[:, None, :3]
        - (chord * along)[..., None] * np.array([1.0, 0.0, 0.0])
        + (chord * across)[..., None] * up[:, None, :]
    )
    parts = np.full((len(table) - 1, len(profile)), part, np.uint8)
    if leading_edge is not None:
        parts[:, points - 2 : points] = leading_edge
    return loft(rings, parts, (part, part))


def ellipsoid(centre_m: ArrayLike, semi_axes_m: ArrayLike, part: Part, rings: int = 8, points: int = 10) -> Mesh:
    """An ellipsoid along the body axes: sensor balls, canopies, spinners, fairings."""
    latitude = np.linspace(-0.5 * np.pi + 0.05, 0.5 * np.pi - 0.05, rings)[:, None]
    longitude = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)[None, :]
    unit = np.stack(
        [
            np.broadcast_to(np.sin(latitude), (rings, points)),
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
        ],
        axis=-1,
    )
    return loft(np.asarray(centre_m) + unit * np.asarray(semi_axes_m), part)


def wheel(centre_m: ArrayLike, radius_m: float, width_m: float) -> Mesh:
    """A tyre that rolls about y."""
    angle = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)
    rim = np.stack([np.cos(angle), np.zeros(10), np.sin(angle)], axis=-1)
    profile = [(-0.5, 0.78), (-0.3, 1.0), (0.3, 1.0), (0.5, 0.78)]
    rings = [radius_m * r * rim + np.array([0.0, width_m * y, 0.0]) for y, r in profile]
    return loft(np.asarray(centre_m) + np.stack(rings), Part.TYRE)


def strut(
    start_m: ArrayLike, end_m: ArrayLike, width_m: float, part: Part = Part.METAL, chord_m: float | None = None
) -> Mesh:
    """A bar between two points with a flattened six-sided section, `chord_m` long in the plane nearest to x."""
    start, end = np.asarray(start_m, dtype=np.float64), np.asarray(end_m, dtype=np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    lead = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.8 else np.array([0.0, 0.0, 1.0])
    lead = lead - axis * (lead @ axis)
    lead *= 0.5 * (width_m if chord_m is None else chord_m) / np.linalg.norm(lead)
    side = np.cross(axis, lead / np.linalg.norm(lead)) * 0.5 * width_m
    corners = np.array([lead, 0.4 * lead + side, -0.5 * lead + side, -lead, -0.5 * lead - side, 0.4 * lead - side])
    return loft(np.stack([start + corners, end + corners]), part)


def propeller_disc(centre_m: ArrayLike, radius_m: float) -> Mesh:
    """The disc that a turning propeller sweeps, normal to x; the renderer draws it nearly transparent."""
    angle = np.linspace(0.0, 2.0 * np.pi, DISC_POINTS, endpoint=False)
    rim = np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], axis=-1) * radius_m
    centre = np.asarray(centre_m, dtype=np.float64)
    vertices = np.concatenate([rim, np.zeros((1, 3))]) + centre
    k = np.arange(DISC_POINTS)
    faces = np.stack([k, (k + 1) % DISC_POINTS, np.full(DISC_POINTS, DISC_POINTS)], axis=-1)
    normals = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(vertices), 1))
    part = np.full(len(vertices), Part.PROPELLER_DISC, np.uint8)
    return Mesh(vertices.astype(np.float32), normals, part, faces.astype(np.int32))


def propeller(hub_m: ArrayLike, radius_m: float, spinner_m: float, pusher: bool = False) -> Mesh:
    """Disc and spinner of a turning propeller; the spinner is `spinner_m` long and points ahead, or aft if a pusher."""
    hub = np.asarray(hub_m, dtype=np.float64)
    radius = max(0.6 * spinner_m, 0.1 * radius_m)
    profile = [(1.0, 0.06), (0.93, 0.36), (0.72, 0.68), (0.4, 0.9), (-0.1, 1.0)]
    way = -1.0 if pusher else 1.0
    stations = [(way * spinner_m * along, 2 * radius * r, 2 * radius * r, 0.0) for along, r in profile]
    if pusher:
        stations.reverse()
    cone = fuselage(stations, 2.0, Part.METAL, rings=5, points=10)
    return merge([moved(cone, hub), propeller_disc(hub, radius_m)])


def gear_leg(top_m: ArrayLike, axle_m: ArrayLike, radius_m: float, width_m: float, leg_m: float) -> Mesh:
    """A leg `leg_m` thick with a wheel at its end, on one side."""
    return merge([strut(top_m, axle_m, leg_m, chord_m=1.6 * leg_m), wheel(axle_m, radius_m, width_m)])


def tricycle(
    nose_m: Sequence[float], mains_m: tuple[Sequence[float], Sequence[float]], radius_m: float, leg_m: float
) -> Mesh:
    """Fixed gear: nose wheel axle (x, z of its leg's top, z), main leg's top and axle on the right side, metres."""
    x, top_z, z = nose_m
    width = 0.42 * radius_m
    return merge(
        [
            both_sides(gear_leg(*mains_m, radius_m, width, leg_m)),
            gear_leg([x, 0.0, top_z], [x + 0.3 * radius_m, 0.0, z], 0.85 * radius_m, width, leg_m),
        ]
    )


def store(centre_m: ArrayLike, length_m: float, width_m: float, rack_z_m: float) -> Mesh:
    """A finned store under a pylon that reaches up to z = rack_z_m, on one side."""
    x, y, z = np.asarray(centre_m, dtype=np.float64)
    shape = [(0.5, 0.08), (0.47, 0.5), (0.38, 0.95), (-0.3, 1.0), (-0.5, 0.6)]
    stations = [(x + length_m * along, width_m * r, width_m * r, z) for along, r in shape]
    parts = [fuselage(stations, 2.0, Part.SENSOR, y, rings=7, points=8)]
    foot = (x + 0.2 * length_m, y, z - 0.4 * width_m, 0.42 * length_m)
    parts.append(
        lifting_surface([foot, (x + 0.25 * length_m, y, rack_z_m, 0.5 * length_m)], "0010", points=SMALL_POINTS)
    )
    for side, up in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        root = (x - 0.32 * length_m, y + 0.2 * side * width_m, z + 0.2 * up * width_m, 0.17 * length_m)
        tip = (x - 0.4 * length_m, y + 0.75 * side * width_m, z + 0.75 * up * width_m, 0.1 * length_m)
        parts.append(lifting_surface([root, tip], "0008", Part.SENSOR, points=SMALL_POINTS))
    return merge(parts)


def exhaust(centre_m: ArrayLike, radius_m: float, length_m: float, width: float = 1.0) -> Mesh:
    """A jet pipe or stub that ends aft in a black mouth; `centre_m` is the middle of the mouth."""
    x, y, z = np.asarray(centre_m, dtype=np.float64)
    stations = [(x + length_m, 2.2 * width * radius_m, 2.2 * radius_m, z), (x, 2 * width * radius_m, 2 * radius_m, z)]
    return fuselage(stations, 2.0, Part.METAL, y, rings=3, points=14, caps=(None, Part.TYRE))


def sensor_ball(centre_m: ArrayLike, radius_m: float) -> Mesh:
    """A gimballed ball under a cylindrical yoke, with a window that looks ahead."""
    x, y, z = np.asarray(centre_m, dtype=np.float64)
    ball = ellipsoid([x, y, z], [radius_m] * 3, Part.SENSOR)
    yoke = strut([x, y, z - 1.3 * radius_m], [x, y, z - 0.2 * radius_m], 1.5 * radius_m, Part.SENSOR, 1.7 * radius_m)
    eye_m = [x + 0.7 * radius_m, y, z + 0.1 * radius_m]
    window = ellipsoid(eye_m, np.array([0.4, 0.45, 0.45]) * radius_m, Part.GLASS, 6, 8)
    return merge([ball, yoke, window])


def blade_antenna(foot_m: ArrayLike, height_m: float, above: bool = True) -> Mesh:
    """A swept blade antenna on the back or the belly."""
    x, y, z = np.asarray(foot_m, dtype=np.float64)
    tip_z = z - height_m if above else z + height_m
    sections = [(x, y, z, 0.9 * height_m), (x - 0.5 * height_m, y, tip_z, 0.45 * height_m)]
    return lifting_surface(sections, "0012", Part.FUSELAGE, points=SMALL_POINTS)


def stopped_rotor(hub_m: ArrayLike, radius_m: float, turn_rad: float) -> Mesh:
    """A two-bladed lift rotor that stands still on its motor, level with the body."""
    hub = np.asarray(hub_m, dtype=np.float64)
    along = radius_m * np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
    side = 0.11 * radius_m * np.array([-np.sin(turn_rad), np.cos(turn_rad), 0.0])
    up = np.array([0.0, 0.0, 0.018 * radius_m])
    ring = np.array([side, -up, -side, up])
    rings = np.stack(
        [hub + at * along + wide * ring for at, wide in ((-1, 0.5), (-0.6, 1), (0, 0.6), (0.6, 1), (1, 0.5))]
    )
    wide, high = 0.12 * radius_m, 0.16 * radius_m
    motor = fuselage([(wide, wide, high, 0.0), (-wide, wide, high, 0.0)], 3.0, Part.METAL, rings=2, points=8)
    return merge([loft(rings, Part.TYRE), moved(motor, hub + np.array([0.0, 0.0, 0.5 * high]))])
