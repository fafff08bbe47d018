"""A camera that can be made to fail: plays a BOP scene to and fro on zenoh as a ROS 2 driver publishes pictures.

    python -m sim_replay.faults.camera --scene DIR --listen tcp/127.0.0.1:7450 --fps 10

Reads one JSON object per line from standard input (frozen, covered, stamp_offset_s, stamp_jitter_s), and prints one per
line: `ready`, and each `frame` with the published stamp and the true time of its exposure. Stops at the end of its
input.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import zenoh

from edge.cameras.sequence import read_scene
from edge.cameras.zenoh_topic import decode_picture
from msgs import topics
from msgs.cdr import CompressedImage
from msgs.publish import Node
from msgs.session import router_config
from sim_replay.bop.scene import read_picture_bgr

NODE = "nose"
TOPIC = f"{NODE}/{topics.IMAGE.name}"


@dataclass(frozen=True)
class Manners:
    """The camera's current defects."""

    frozen: bool = False
    covered: bool = False
    stamp_offset_s: float = 0.0
    stamp_jitter_s: float = 0.0

    def stamp_ns(self, exposed_ns: int, number: int) -> int:
        jitter_s = self.stamp_jitter_s * (1 if number % 2 else -1)
        return exposed_ns + round((self.stamp_offset_s + jitter_s) * 1e9)


class Control(threading.Thread):
    """Reads standard input; each line replaces all of `manners`."""

    def __init__(self) -> None:
        super().__init__(name="control", daemon=True)
        self.manners = Manners()
        self.ended = threading.Event()

    def run(self) -> None:
        for line in sys.stdin:
            self.manners = replace(Manners(), **json.loads(line))
        self.ended.set()


def to_and_fro(number: int, count: int) -> int:
    """Index of the image to show: 0 … count-1 … 0 …, without jumps."""
    if count == 1:
        return 0
    phase = number % (2 * count - 2)
    return min(phase, 2 * count - 2 - phase)


def play(scene: Path, listen: str, fps: float, control: Control) -> None:
    """Publish until standard input ends."""
    pictures = [picture.path for picture in read_scene(scene)]
    as_stored = decode_picture(pictures[0].read_bytes()) is not None
    with zenoh.open(router_config([listen])) as session, Node(session, NODE, name="driver") as node:
        publisher = node.publisher(topics.IMAGE)
        _emit({"event": "ready"})
        begun_s, number, index = time.monotonic(), 0, 0
        while not control.ended.wait(max(0.0, begun_s + number / fps - time.monotonic())):
            manners = control.manners
            if not manners.frozen:
                index = to_and_fro(number, len(pictures))
            exposed_ns = time.time_ns()
            stamp_ns = manners.stamp_ns(exposed_ns, number)
            coded = _covered(pictures[index]) if manners.covered else _coded(pictures[index], as_stored)
            image = CompressedImage(stamp_ns, "camera_optical_frame", *coded)
            # Printed before the frame is published, so that its reader knows the frame before any pose from it arrives.
            _emit({"event": "frame", "stamp_utc_ns": stamp_ns, "exposed_utc_ns": exposed_ns, "frozen": manners.frozen})
            publisher.put(image.encode())
            number = max(number + 1, int((time.monotonic() - begun_s) * fps))


def _coded(picture: Path, as_stored: bool) -> tuple[str, bytes]:
    """Format and bytes of an image: `as_stored`, otherwise as a PNG of 8 bits, since drivers publish no other kind."""
    if as_stored:
        return "png" if picture.suffix.lower() == ".png" else "jpeg", picture.read_bytes()
    return "png", cv2.imencode(".png", read_picture_bgr(picture), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def _covered(picture: Path) -> tuple[str, bytes]:
    """Format and bytes of an image of that shape through a covered lens: the sensor's noise."""
    noise = np.random.default_rng().normal(3.0, 2.0, read_picture_bgr(picture).shape)
    return "jpeg", cv2.imencode(".jpg", np.clip(noise, 0, 255).astype(np.uint8))[1].tobytes()


def _emit(record: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(record) + "\n")
    sys.stdout.flush()


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_replay.faults.camera", description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, required=True, metavar="DIR", help="BOP scene folder")
    parser.add_argument("--listen", required=True, help="zenoh endpoint to serve, e.g. tcp/127.0.0.1:7450")
    parser.add_argument("--fps", type=float, default=10.0, help="pictures a second (default %(default)s)")
    args = parser.parse_args(argv)
    control = Control()
    control.start()
    play(args.scene, args.listen, args.fps, control)
    return 0


if __name__ == "__main__":
    sys.exit(main())
