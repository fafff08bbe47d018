"""A recording of the daemon (`[recorder] image_max_hz`) as a scene: its images, and the own ship from its transforms.

Images are played at a constant rate, each in the slot nearest its exposure that is free, and the telemetry's times are
warped so that the attitude at every image's exposure is the recorded one. Images before the first and after the last
attitude are left out. An image's number is its slot: a missing number was not recorded, and is a dropped frame.
A recording made on the ground may contain other vehicles, which are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.cameras.zenoh_topic import decode_picture
from edge.errors import InputError
from edge.tracking.geodesy import lat_lon_alt_from_ned
from edge.types import Array, Mount
from msgs import topics
from msgs.cdr import CameraInfo, CompressedImage, TFMessage, TransformStamped
from msgs.geometry import R_from_q_wxyz, q_wxyz_from_R, so3_log
from msgs.ground.errors import InputError as RecordingError
from msgs.ground.view.recorded import samples
from msgs.recording import CLOCK_STEP_NS
from msgs.wire import PayloadError
from sim_replay.bop.records import BopFrame
from sim_replay.bop.write import SceneWriter
from sim_replay.ground_truth import UNCOVERED_NS_MAX
from sim_replay.recorded.scene_files import JPEG_QUALITY, add_picture, scene_distortion, write_sequence_toml
from sim_replay.telemetry import Telemetry, write_telemetry

ORIGIN_DEG_M = (0.0, 0.0, 0.0)  # of ned: recordings do not contain its position on Earth
GAP_S_MAX = 10.0  # between two images of one flight
FPS_MAX = 240.0
_PARTS_MAX = 4  # frames between two images that lie as near as most do
_IRREGULAR_MAX = 0.2  # how far the intervals may be from multiples of a period, root mean square, in periods
_FIXED_RAD = 1e-4  # a mount that moves less is a fixed one
_NEIGHBOURS = 5  # window of the median of velocities: removes jumps where the autopilot resets its position

Stamped = dict[int, dict[str, TransformStamped]]  # transforms by child frame, by stamp


@dataclass(eq=False)
class Recorded:
    """Contents of a flight's files, in order; stamps are UTC ns of the exposure."""

    uav: str | None = None
    picture_ns: list[int] = field(default_factory=list)
    lens: list[CameraInfo] = field(default_factory=list)  # of each image
    own_of: dict[str, Stamped] = field(default_factory=dict)  # by vehicle
    newest_ns: dict[tuple[str, str], int] = field(default_factory=dict)  # stamp, by vehicle and topic
    set_back_in: dict[str, Path] = field(default_factory=dict)  # the first file with a clock set back, by vehicle

    @property
    def own(self) -> Stamped:
        """Of the vehicle whose images they are."""
        return self.own_of.get(self.uav or "", {})

    def note_stamp(self, uav: str, topic: topics.Topic, stamp_ns: int, path: Path) -> None:
        """Notice if the vehicle's clock has been set back by more than the recorder keeps in one file."""
        newest_ns = max(self.newest_ns.get((uav, topic.name), stamp_ns), stamp_ns)
        self.newest_ns[uav, topic.name] = newest_ns
        if stamp_ns < newest_ns - CLOCK_STEP_NS:
            self.set_back_in.setdefault(uav, path)


def unpack_recordings(paths: Sequence[Path], folder: Path, on_picture: Callable[[], None]) -> None:
    """Convert a flight's recordings, given in their order, to a scene. Raises InputError, OSError."""
    recorded = _read(paths, lambda _index, _image: None)
    _check(paths, recorded)
    picture_ns = np.array(recorded.picture_ns)
    fps = _rate_hz(picture_ns)
    own_ns, mounts = _own_ship(recorded)
    places_m = _places_m(recorded, own_ns)
    within_ns = UNCOVERED_NS_MAX // 2  # warping shifts times by about half an image interval
    covered = np.flatnonzero((picture_ns >= own_ns[0] - within_ns) & (picture_ns <= own_ns[-1] + within_ns))
    if len(covered) < 2:
        raise InputError(f"{paths[0]}: holds no pictures of the time in which the own ship's attitude was recorded")
    slots = _slots(picture_ns[covered], fps)
    gimballed = any(np.linalg.norm(so3_log(mounts[0].R_body_cam.T @ m.R_body_cam)) > _FIXED_RAD for m in mounts)
    with SceneWriter(folder, JPEG_QUALITY) as writer:
        of_picture = dict(zip(covered.tolist(), slots.tolist(), strict=True))

        def write(index: int, image: CompressedImage) -> None:
            if index in of_picture:
                R_ned_cam, t_ned_cam_m = _camera_at(recorded, own_ns, places_m, recorded.picture_ns[index])
                _add(writer, of_picture[index], image, recorded.lens[index], R_ned_cam, t_ned_cam_m)
                on_picture()

        _read(paths, write)
    bent_ns = _bend(own_ns, picture_ns[covered], slots, fps)
    write_telemetry(folder / "telemetry.csv", _telemetry(recorded, own_ns, places_m, bent_ns))
    write_sequence_toml(folder, paths[0], fps, 0, mounts[0], gimballed)


def _read(paths: Sequence[Path], on_picture: Callable[[int, CompressedImage], None]) -> Recorded:
    """Read the files once. Raises InputError."""
    recorded, camera = Recorded(), dict[str, CameraInfo]()
    for path in paths:
        try:
            for one, _ in samples(path):
                if one.topic is topics.CAMERA_INFO:
                    camera[one.uav] = CameraInfo.decode(one.payload)
                elif one.topic is topics.IMAGE and one.uav in camera:
                    if recorded.uav not in (None, one.uav):
                        raise InputError(f"{path}: holds pictures of both {recorded.uav} and {one.uav}")
                    recorded.uav = one.uav
                    image = CompressedImage.decode(one.payload)
                    recorded.note_stamp(one.uav, one.topic, image.stamp_ns, path)
                    if not recorded.picture_ns or image.stamp_ns > recorded.picture_ns[-1]:
                        on_picture(len(recorded.picture_ns), image)
                        recorded.picture_ns.append(image.stamp_ns)
                        recorded.lens.append(camera[one.uav])
                elif one.topic is topics.TF:
                    links = {link.child_frame_id: link for link in TFMessage.decode(one.payload).transforms}
                    if topics.FRAME_BODY in links and topics.FRAME_CAMERA in links:
                        stamp_ns = links[topics.FRAME_BODY].stamp_ns
                        recorded.note_stamp(one.uav, one.topic, stamp_ns, path)
                        recorded.own_of.setdefault(one.uav, {})[stamp_ns] = links
        except (RecordingError, PayloadError) as error:
            raise InputError(str(error) if isinstance(error, RecordingError) else f"{path}: {error}") from error
    return recorded


def _check(paths: Sequence[Path], recorded: Recorded) -> None:
    path = paths[0] if len(paths) == 1 else paths[0].parent
    if len(recorded.picture_ns) < 2:
        raise InputError(f"{path}: holds no pictures: set [recorder] image_max_hz where it is recorded")
    if len(recorded.own) < 2:
        raise InputError(f"{path}: holds no attitude of the own ship (/{recorded.uav}/tf): no autopilot was heard")
    if (set_back_in := recorded.set_back_in.get(recorded.uav or "")) is not None:
        remedy = "give the files one by one" if len(paths) > 1 else "only times that increase can be played"
        raise InputError(f"{set_back_in}: the clock of {recorded.uav} was set back: {remedy}")
    gap_s = float(np.diff(recorded.picture_ns).max()) * 1e-9
    if gap_s > GAP_S_MAX:
        raise InputError(f"{path}: is more than one flight: no picture for {gap_s:.0f} s; give its files one by one")


def _rate_hz(picture_ns: Array) -> float:
    """The camera's rate, averaged over all its frames from the first image to the last, recorded or not."""
    return min(round(1e9 / _period_ns(np.diff(picture_ns).astype(np.float64)), 6), FPS_MAX)


def _period_ns(apart_ns: Array) -> float:
    """The period of which the intervals between images are multiples, averaged over the whole time.

    [recorder] image_max_hz need not divide the camera's rate: of 20 out of 30 a second, every other interval is twice
    the one before. The median interval if there is no such period, as where the stamps have a network's jitter.
    """
    usual_ns = float(np.quantile(apart_ns, 0.25))
    off = {}
    for parts in range(1, _PARTS_MAX + 1):
        frames = apart_ns * parts / usual_ns
        off[parts] = float(np.sqrt(np.mean((frames - np.round(frames)) ** 2)))
    best = min(off, key=off.__getitem__)
    regular = off[best] <= _IRREGULAR_MAX and usual_ns >= apart_ns.mean() / _PARTS_MAX
    period_ns = usual_ns / best if regular else float(np.median(apart_ns))
    for _ in range(2):  # the first average counts the frames of long intervals better
        period_ns = float(apart_ns.sum() / np.round(apart_ns / period_ns).sum())
    return period_ns


def _slots(picture_ns: Array, fps: float) -> NDArray[np.int64]:
    """Frame number of each image, increasing: the nearest to its exposure, or the next one that is free."""
    nearest = np.floor((picture_ns - picture_ns[0]) * 1e-9 * fps + 0.5).astype(np.int64)
    order = np.arange(len(nearest))
    return np.maximum.accumulate(nearest - order) + order


def _add(
    writer: SceneWriter, slot: int, image: CompressedImage, lens: CameraInfo, R_ned_cam: Array, t_ned_cam_m: Array
) -> None:
    """The recorded image, byte for byte, unless scenes do not support its lens model."""
    distortion = tuple(float(value) for value in lens.distortion)
    if len(distortion) > 5:
        pixels = decode_picture(image.data)
        if pixels is None:
            raise InputError(f"the picture of {image.stamp_ns} ns is damaged")
        add_picture(writer, slot, pixels, lens.K, distortion)
        return
    R_cam_ned = R_ned_cam.T
    frame = BopFrame(slot, lens.K, (), R_cam_ned, -R_cam_ned @ t_ned_cam_m, scene_distortion(distortion))
    writer.add_encoded(frame, image.data, "png" if "png" in image.format else "jpg")


def _own_ship(recorded: Recorded) -> tuple[Array, list[Mount]]:
    """Stamps [N] int64 of the transforms, increasing, and the camera's mount at each."""
    stamps = sorted(recorded.own)
    cameras = [recorded.own[stamp][topics.FRAME_CAMERA] for stamp in stamps]
    mounts = [Mount(_R(one), np.asarray(one.t_frame_child_m)) for one in cameras]
    return np.array(stamps, dtype=np.int64), mounts


def _R(link: TransformStamped) -> Array:
    return R_from_q_wxyz(np.roll(link.q_frame_child_xyzw, 1))


def _places_m(recorded: Recorded, own_ns: Array) -> Array:
    """[N, 3] of the own ship in ned; linearly interpolated where the position is unknown.

    Before the first and after the last it is constant: a start at the origin would be an impossibly fast jump.
    """
    told = [recorded.own[int(stamp)].get(topics.FRAME_BODY_NED) for stamp in own_ns]
    known = [k for k, place in enumerate(told) if place is not None]
    if not known:
        return np.zeros((len(told), 3))
    places_m = np.array([place.t_frame_child_m for place in told if place is not None])
    since_ns = own_ns - own_ns[0]
    return np.column_stack([np.interp(since_ns, since_ns[known], column) for column in places_m.T])


def _camera_at(recorded: Recorded, own_ns: Array, places_m: Array, at_ns: int) -> tuple[Array, Array]:
    """R_ned_cam [3, 3] and t_ned_cam_m [3] from the transforms nearest in time."""
    nearest = int(np.argmin(np.abs(own_ns - at_ns)))
    links = recorded.own[int(own_ns[nearest])]
    R_ned_body, camera = _R(links[topics.FRAME_BODY]), links[topics.FRAME_CAMERA]
    return R_ned_body @ _R(camera), places_m[nearest] + R_ned_body @ np.asarray(camera.t_frame_child_m)


def _bend(own_ns: Array, picture_ns: Array, slots: NDArray[np.int64], fps: float) -> Array:
    """Stamps [N] warped as the images are moved into their slots; t = 0 at the first image."""
    slot_ns = slots * 1e9 / fps
    inside = np.interp(own_ns - picture_ns[0], picture_ns - picture_ns[0], slot_ns)
    inside += np.minimum(own_ns - picture_ns[0], 0) + np.maximum(own_ns - picture_ns[-1], 0)
    return np.round(inside).astype(np.int64)


def _telemetry(recorded: Recorded, own_ns: Array, places_m: Array, t_ns: Array) -> Telemetry:
    """From the recorded attitudes and positions; rates and velocities are their differences."""
    t_ns, kept = np.unique(t_ns, return_index=True)
    links = [recorded.own[int(stamp)] for stamp in own_ns[kept]]
    R_ned_body = np.array([_R(one[topics.FRAME_BODY]) for one in links])
    t_ned_m = places_m[kept]
    t_s = t_ns * 1e-9
    velocity = _middle_ones(np.gradient(t_ned_m, t_s, axis=0))
    rates = so3_log(np.swapaxes(R_ned_body[:-1], -1, -2) @ R_ned_body[1:]) / np.diff(t_s)[:, None]
    rates = np.vstack([rates, rates[-1]])
    place = np.array([lat_lon_alt_from_ned(ORIGIN_DEG_M, p) for p in t_ned_m])
    return Telemetry(t_ns, np.hstack([q_wxyz_from_R(R_ned_body), rates, t_ned_m, velocity, place]))


def _middle_ones(values: Array) -> Array:
    """[N, 3]: the running median over _NEIGHBOURS."""
    half = _NEIGHBOURS // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, ((half, half), (0, 0)), "edge"), _NEIGHBOURS, 0)
    return np.asarray(np.median(around, axis=-1))
