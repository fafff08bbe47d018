"""A contact sheet of the fleet: each airframe from seven sides in even light, to inspect its shape."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.errors import InputError
from msgs.geometry import R_from_euler
from sim_replay.airframes import AIRFRAMES, Airframe, airframe_id, airframe_of
from sim_replay.render.renderer import Renderer
from sim_replay.render.scene import Camera, Environment, Scene, Target, environment_from_seed

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
TILE_WIDTH_PX, TILE_HEIGHT_PX, HEADING_PX, MARGIN_PX = 230, 150, 20, 6
DISTANCE_DIAMETERS = 30.0  # far enough to be nearly a parallel projection
MAX_BYTES = 400_000
GREY = 0.45  # linear
HEIGHT_M = 1000.0
UPWARD_DEG = 30.0


def _views() -> dict[str, Array]:
    """R_level_body of each view: the body's attitude in front of a level camera that looks north."""
    up, north, east = np.array([0.0, 0, -1]), np.array([1.0, 0, 0]), np.array([0.0, 1, 0])
    return {
        "front": R_from_euler(0.0, 0.0, np.pi),
        "rear": R_from_euler(0.0, 0.0, 0.0),
        "side": R_from_euler(0.0, 0.0, np.pi / 2),
        "top": np.stack([up, east, north], axis=1),
        "below": np.stack([up, -east, -north], axis=1),
        "ahead of it, above": R_from_euler(0.0, np.radians(25.0), 0.0) @ R_from_euler(0.0, 0.0, np.radians(140.0)),
        "behind it, below": R_from_euler(0.0, np.radians(-20.0), 0.0) @ R_from_euler(0.0, 0.0, np.radians(-35.0)),
    }


def _even_light() -> Environment:
    """A soft sun from behind the camera under a sky as bright as the ground, and no haze."""
    grey = np.full(3, GREY)
    return replace(
        environment_from_seed(0),
        sun_ned=np.array([-0.6, -0.4, -0.69]),
        sun_colour=np.full(3, 0.55),
        zenith=grey,
        horizon=grey,
        ground=np.tile(grey, (3, 1)),
        ground_kind=2,
        haze_per_m=1e-9,
        cloud_threshold=2.0,
        cirrus=0.0,
        glow=0.0,
    )


def _scene(airframe: Airframe, R_level_body: Array, livery_seed: int, light: Environment) -> Scene:
    """The airframe as large as its tile allows, with its outline centred.

    R_level_body is for a level camera; camera and target are tilted equally, so that only sky is in the background.
    """
    R_ned_level = R_from_euler(0.0, np.radians(UPWARD_DEG), 0.0)
    R_ned_body = R_ned_level @ R_level_body
    points_m = airframe.mesh().vertices_m.astype(np.float64)
    distance_m = DISTANCE_DIAMETERS * airframe.diameter_m()
    room = np.array([TILE_WIDTH_PX, TILE_HEIGHT_PX]) - 2 * MARGIN_PX
    across_m = np.ptp(points_m @ R_level_body.T, axis=0)[1:]
    focal_px = float((distance_m - 0.5 * airframe.diameter_m()) * np.min(room / across_m))
    t_ned_cam_m = np.array([0.0, 0.0, -HEIGHT_M])
    R_ned_cam = R_ned_level @ np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    target = Target(airframe_id(airframe.name), livery_seed, R_ned_body, t_ned_cam_m + distance_m * R_ned_cam[:, 2])
    K = np.array([[focal_px, 0, 0], [0, focal_px, 0], [0, 0, 1.0]])
    camera = Camera(K, TILE_WIDTH_PX, TILE_HEIGHT_PX, R_ned_cam, t_ned_cam_m)
    R_cam_body, t_cam_body_m = target.pose_in(camera)
    points_cam_m = points_m @ R_cam_body.T + t_cam_body_m
    outline_px = focal_px * points_cam_m[:, :2] / points_cam_m[:, 2:]
    middle_px = 0.5 * (outline_px.min(axis=0) + outline_px.max(axis=0))
    K[:2, 2] = 0.5 * (np.array([TILE_WIDTH_PX, TILE_HEIGHT_PX]) - 1) - middle_px
    return Scene(camera, (target,), light)


def _row(airframe: Airframe, tiles: Sequence[Image]) -> Image:
    heading = np.full((HEADING_PX, TILE_WIDTH_PX * len(tiles), 3), 255, np.uint8)
    text = f"{airframe.name}: {airframe.description}; span {airframe.span_m:g} m, length {airframe.length_m:g} m"
    triangles = f"{len(airframe.mesh().faces)} triangles"
    for words, x in ((text, 5), (triangles, heading.shape[1] - 110)):
        cv2.putText(heading, words, (x, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([heading, np.concatenate(tiles, axis=1)])


def sheet_image(airframes: Sequence[Airframe], livery_seed: int = 0) -> Image:
    """BGR image [H, W, 3] with one row per airframe and one column per view."""
    light, views = _even_light(), _views()
    renderer = Renderer(TILE_WIDTH_PX, TILE_HEIGHT_PX, len(views), 1)
    rows = []
    for airframe in airframes:
        drawn = renderer.draw([_scene(airframe, R, livery_seed, light) for R in views.values()])
        tiles = [np.ascontiguousarray(image) for image in drawn.image_bgr]
        for tile, name in zip(tiles, views, strict=True):
            cv2.putText(
                tile, name, (5, TILE_HEIGHT_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (60, 60, 60), 1, cv2.LINE_AA
            )
        rows.append(_row(airframe, tiles))
    return np.concatenate(rows)


def sheet(airframes: Sequence[Airframe], out: Path, livery_seed: int = 0) -> None:
    """Draw the airframes and write them as one JPEG of at most 400 kB.

    Raises InputError if its folder is missing.
    """
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    image = sheet_image(airframes, livery_seed)
    for quality in range(90, 10, -5):
        _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if len(encoded) <= MAX_BYTES:
            break
    out.write_bytes(encoded.tobytes())


def run(args: argparse.Namespace) -> int:
    """`uavpose-replay sheet` without --dataset. Raises InputError."""
    try:
        chosen = [airframe_of(airframe_id(name)) for name in args.airframe] if args.airframe else AIRFRAMES
    except ValueError as error:
        raise InputError(f"--airframe: {error}") from error
    sheet(chosen, args.out, args.livery_seed)
    print(f"{len(chosen)} airframes in {args.out}")
    return 0
