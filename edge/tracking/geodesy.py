"""Small offsets on the WGS 84 ellipsoid, flat-earth: error below 3 m at 2 km, below 75 degrees of latitude.

Towards the poles, meridians converge within the offset: half a kilometre from an own ship that is 2 km from the origin,
the error is 2 m at 85 degrees, 9 m at 89, a kilometre at 89.999.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
LATITUDE_MAX_DEG = 85.0  # beyond it, places computed here are not fit to be sent
ORIGIN_ROUNDS = 2  # iterations; error below a millimetre at 100 km


def radii_m(lat_deg: float, alt_m: float) -> tuple[float, float]:
    """Metres per radian of latitude, and of longitude."""
    e2 = FLATTENING * (2.0 - FLATTENING)
    lat_rad = np.deg2rad(lat_deg)
    w2 = 1.0 - e2 * np.sin(lat_rad) ** 2
    meridian = SEMI_MAJOR_M * (1.0 - e2) / w2**1.5
    prime_vertical = SEMI_MAJOR_M / np.sqrt(w2)
    return float(meridian + alt_m), float((prime_vertical + alt_m) * np.cos(lat_rad))


def lat_lon_alt_from_ned(origin_deg_m: tuple[float, float, float], t_ned_m: ArrayLike) -> tuple[float, float, float]:
    """(degrees, degrees in -180..180, m) of a point [3] given in north-east-down axes at the origin."""
    lat, lon, alt = origin_deg_m
    north, east, down = (float(x) for x in np.asarray(t_ned_m, dtype=np.float64))
    per_lat, per_lon = radii_m(lat, alt)
    lon_deg = (lon + float(np.rad2deg(east / per_lon)) + 180.0) % 360.0 - 180.0
    return lat + float(np.rad2deg(north / per_lat)), lon_deg, alt - down


def origin_of_ned(point_deg_m: tuple[float, float, float], t_ned_m: ArrayLike) -> tuple[float, float, float]:
    """The origin for which `lat_lon_alt_from_ned` of t_ned_m [3] gives the point. Positions near the point are then
    accurate, even far from the origin."""
    lat, lon, alt = origin = lat_lon_alt_from_ned(point_deg_m, -np.asarray(t_ned_m, dtype=np.float64))
    for _ in range(ORIGIN_ROUNDS):
        there = lat_lon_alt_from_ned(origin, t_ned_m)
        lat, lon, alt = (o + p - q for o, p, q in zip(origin, point_deg_m, there, strict=True))
        origin = lat, (lon + 180.0) % 360.0 - 180.0, alt
    return origin
