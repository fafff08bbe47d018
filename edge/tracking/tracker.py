"""Estimates of single frames become tracks: association, life and death, and where each target will be next.

A target is tentative until it was seen CONFIRM_HITS times, coasts on prediction when it is missed, and is lost, and
its number free again, after COAST_MAX_S. What keeps disagreeing with the filter wins after PERSISTENT frames: a
rotation turned over, or a position outside the gate but under the same box. Until then the covariance of what is told
grows by the share of rotations that disagree.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from edge.tracking import motion as ekf
from edge.tracking.heading import flown_nose_first
from edge.tracking.motion import Innovation, Motion, View
from edge.types import Array, Estimate, Mount, OwnShip, Track, TrackState

CONFIRM_HITS = 3
TENTATIVE_MISSES = 2  # in a row: gone
COAST_MAX_S = 2.0
PERSISTENT = 6  # frames
POSITION_GATE_D2 = 49.0  # squared Mahalanobis distance, 3 degrees of freedom; wide, as the soft gate is inside it
SAME_BOX_IOU = 0.3
FLIP_MEMORY = 30  # frames over which disagreeing rotations are counted
RANGE_MIN_M = 1.0  # nearer, a projection is meaningless

Size = tuple[int, int]


@dataclass(frozen=True)
class BoxModel:
    """A measured box, remembered so that it moves with the bearing and scales with the range."""

    offset: Array  # [2] box centre minus projection of the target's origin, px * m / px of focal length
    size: Array  # [2] m, as if the target were flat

    @classmethod
    def measured(cls, box_xyxy_px: Array, t_cam_target_m: Array, K: Array) -> BoxModel:
        m_per_px = max(t_cam_target_m[2], RANGE_MIN_M) / np.array([K[0, 0], K[1, 1]])
        center = 0.5 * (box_xyxy_px[:2] + box_xyxy_px[2:])
        return cls((center - _project(t_cam_target_m, K)) * m_per_px, (box_xyxy_px[2:] - box_xyxy_px[:2]) * m_per_px)

    def box_xyxy_px(self, t_cam_target_m: Array, K: Array) -> Array:
        px_per_m = np.array([K[0, 0], K[1, 1]]) / max(t_cam_target_m[2], RANGE_MIN_M)
        center = _project(t_cam_target_m, K) + self.offset * px_per_m
        half = 0.5 * self.size * px_per_m
        return np.concatenate([center - half, center + half])


@dataclass(frozen=True)
class Doubt:
    """How often measured rotations were lately turned over against the filter's, and how: its own P cannot tell.

    If the other is true with probability p, rotations spread by p w w^T about the filter's. p follows from the share s
    as if two frames had to agree, s^2 / (s^2 + (1 - s)^2): one odd frame says little, as many as not say all.
    """

    share: float = 0.0  # of the last FLIP_MEMORY frames, fading
    w_target_rad: Array = field(default_factory=lambda: np.zeros(3))  # [3] from the filter's to the other, target axes

    def after(self, seen: Innovation, R_cam_target: Array) -> Doubt:
        """With one more measurement, `seen` against R_cam_target."""
        if seen.rotation_rad <= ekf.ROTATION_GATE_RAD:
            return Doubt(self.share * (1.0 - 1.0 / FLIP_MEMORY), self.w_target_rad)
        return Doubt(self.share + (1.0 - self.share) / FLIP_MEMORY, R_cam_target.T @ seen.residual[3:])

    def changed_sides(self) -> Doubt:
        """When the other rotation is taken for the filter's."""
        return Doubt(min(1.0 - self.share, 0.5), -self.w_target_rad)

    def added_to(self, P: Array, R_frame_target: Array) -> Array:
        """P [n, n], whose last three are the rotation in the frame, with this."""
        w = R_frame_target @ self.w_target_rad
        probability = self.share**2 / (self.share**2 + (1.0 - self.share) ** 2)
        widened = P.copy()
        widened[-3:, -3:] += probability * np.outer(w, w)
        return widened


@dataclass
class Target:
    """One target between frames."""

    track_id: int
    motion: Motion
    box: BoxModel
    score: float
    measured_ns: int
    state: TrackState = TrackState.TENTATIVE
    hits: int = 1
    misses: int = 0
    rotation_disagreements: int = 0
    position_disagreements: int = 0
    doubt: Doubt = field(default_factory=Doubt)


@dataclass
class Tracker:
    """Up to `max_targets` targets seen through a camera that sits on its vehicle by `mount`. Use from one thread."""

    max_targets: int
    mount: Mount
    out_of_order: int = 0  # frames dropped
    not_finite: int = 0  # estimates dropped
    _targets: list[Target] = field(default_factory=list)
    _view: View | None = None  # the camera at the last frame
    _tracks: tuple[Track, ...] = ()

    def predict(self, capture_ns: int, own_ship: OwnShip | None, K: Array, image_size_wh: Size) -> list[Track]:
        """Where each target should be in the frame taken at `capture_ns`, without those whose box misses the picture.

        Oldest measurement first. Changes nothing. K [3, 3] px; image_size_wh px.
        """
        view = View.of(capture_ns, own_ship, self.mount)
        expected = []
        for target in sorted(self._targets, key=lambda t: t.measured_ns):
            track = _track(target, self._advanced(target.motion, view), view, K)
            if track.t_cam_target_m[2] > RANGE_MIN_M and _inside(track.box_xyxy_px, image_size_wh):
                expected.append(track)
        return expected

    def drop_all(self) -> None:
        """Forget all targets."""
        self._targets.clear()

    def make_room(self) -> None:
        """Forget the target that was measured longest ago, if there is no room for another."""
        if len(self._targets) >= self.max_targets:
            self._targets.remove(min(self._targets, key=lambda t: t.measured_ns))

    def is_late(self, capture_ns: int) -> bool:
        """Whether a frame is not later than the last: nothing of it can be used."""
        return self._view is not None and capture_ns <= self._view.time_ns

    def update(
        self, capture_ns: int, estimates: list[Estimate], own_ship: OwnShip | None, K: Array, image_size_wh: Size
    ) -> tuple[Track, ...]:
        """Take in what was seen in the frame taken at `capture_ns`; returns all tracks, by track_id.

        A frame not later than the last is dropped and counted: the tracks stay as they were.
        """
        if self.is_late(capture_ns):
            self.out_of_order += 1
            return self._tracks
        view = View.of(capture_ns, own_ship, self.mount)
        for target in self._targets:
            target.motion = self._advanced(target.motion, view)
        self._view = view

        finite = [one for one in estimates if _finite(one)]
        self.not_finite += len(estimates) - len(finite)
        pairs = _associate(self._targets, finite, K, view)
        for target_index, estimate_index, seen in pairs:
            target, estimate = self._targets[target_index], finite[estimate_index]
            turned = _nose_first(target.motion, estimate, view)
            if turned is not estimate:
                seen = ekf.innovation(target.motion, turned, K, view)
            _hit(target, turned, seen, K, view)
        used = {estimate_index for _, estimate_index, _ in pairs}
        hit = {target_index for target_index, _, _ in pairs}
        spare = [one for i, one in enumerate(finite) if i not in used]
        for i, target in enumerate(self._targets):
            if i not in hit and not _taken_over(target, spare, K, view):
                _miss(target)
        self._targets = [t for t in self._targets if _alive(t, K, view, image_size_wh)]
        self._give_birth(spare, K, view)
        self._targets.sort(key=lambda t: t.track_id)
        self._tracks = tuple(_track(target, target.motion, view, K) for target in self._targets)
        return self._tracks

    def _advanced(self, motion: Motion, view: View) -> Motion:
        """The motion at the view's time and in its frame."""
        assert self._view is not None, "a target exists only after a frame"
        moved = ekf.propagate(motion, view.time_ns)
        if motion.kind == view.kind:
            return moved
        # Leaving ned, the attitude is the last one known; entering it, the new one belongs to this very frame.
        stale_s = (view.time_ns - self._view.time_ns) / ekf.NS_PER_S if view.kind == "cam" else 0.0
        return ekf.reframe(moved, self._view.moved_to(view.time_ns), view, stale_s)

    def _give_birth(self, estimates: list[Estimate], K: Array, view: View) -> None:
        for estimate in sorted(estimates, key=lambda e: -e.score):
            free = sorted(set(range(self.max_targets)) - {t.track_id for t in self._targets})
            boxes = [_box(target, view, K) for target in self._targets]
            if not free:
                return
            if any(iou(estimate.box_xyxy_px, box) > SAME_BOX_IOU for box in boxes):
                continue  # two windows saw one target
            begun = ekf.begin(estimate, K, view)
            box = BoxModel.measured(estimate.box_xyxy_px, estimate.t_cam_target_m, K)
            self._targets.append(Target(free[0], begun, box, estimate.score, view.time_ns))


def iou(a_xyxy: Array, b_xyxy: Array) -> float:
    """Intersection over union of two boxes [4]."""
    overlap = np.clip(np.minimum(a_xyxy[2:], b_xyxy[2:]) - np.maximum(a_xyxy[:2], b_xyxy[:2]), 0.0, None)
    intersection = float(overlap[0] * overlap[1])
    union = float(np.prod(a_xyxy[2:] - a_xyxy[:2]) + np.prod(b_xyxy[2:] - b_xyxy[:2])) - intersection
    return intersection / union if union > 0.0 else 0.0


def _associate(
    targets: list[Target], estimates: list[Estimate], K: Array, view: View
) -> list[tuple[int, int, Innovation]]:
    """Pairs inside the gate, nearest first, each target and estimate once."""
    candidates = []
    for i, target in enumerate(targets):
        for j, estimate in enumerate(estimates):
            seen = ekf.innovation(target.motion, estimate, K, view)
            if seen.position_d2 < POSITION_GATE_D2:
                candidates.append((seen.position_d2, i, j, seen))
    pairs: list[tuple[int, int, Innovation]] = []
    for _, i, j, seen in sorted(candidates, key=lambda c: c[:3]):
        if all(i != pair[0] and j != pair[1] for pair in pairs):
            pairs.append((i, j, seen))
    return pairs


def _nose_first(motion: Motion, estimate: Estimate, view: View) -> Estimate:
    """The estimate turned to fly where its track goes; in `ned` alone is the velocity that over ground."""
    if motion.kind != "ned":
        return estimate
    R_cam_ned = view.R_frame_cam.T
    P_v = R_cam_ned @ motion.P[ekf.VELOCITY, ekf.VELOCITY] @ R_cam_ned.T
    return flown_nose_first(estimate, R_cam_ned @ motion.v_mps, P_v)


def _hit(target: Target, estimate: Estimate, seen: Innovation, K: Array, view: View) -> None:
    target.doubt = target.doubt.after(seen, view.R_frame_cam.T @ target.motion.R_frame_target)
    target.motion = ekf.correct(target.motion, seen)
    turned_over = seen.rotation_rad > ekf.ROTATION_GATE_RAD
    target.rotation_disagreements = target.rotation_disagreements + 1 if turned_over else 0
    if target.rotation_disagreements >= PERSISTENT:
        target.motion = ekf.with_rotation_of(target.motion, estimate, K, view)
        target.doubt = target.doubt.changed_sides()
        target.rotation_disagreements = 0
    _seen(target, estimate, K, view)


def _taken_over(target: Target, spare: list[Estimate], K: Array, view: View) -> bool:
    """Whether an estimate outside the gate has lain under the target's box long enough to become it."""
    box = _box(target, view, K)
    rivals = [e for e in spare if iou(e.box_xyxy_px, box) > SAME_BOX_IOU]
    target.position_disagreements = target.position_disagreements + 1 if rivals else 0
    if target.position_disagreements < PERSISTENT:
        return False
    rival = max(rivals, key=lambda e: e.score)
    target.motion = ekf.begin(rival, K, view)
    _seen(target, rival, K, view)
    spare[:] = [e for e in spare if e is not rival]
    return True


def _seen(target: Target, estimate: Estimate, K: Array, view: View) -> None:
    target.box = BoxModel.measured(estimate.box_xyxy_px, ekf.t_in_cam(target.motion, view), K)
    target.score = estimate.score
    target.measured_ns = view.time_ns
    target.hits += 1
    target.misses = 0
    target.position_disagreements = 0
    if target.state is TrackState.COASTING or target.hits >= CONFIRM_HITS:
        target.state = TrackState.CONFIRMED


def _miss(target: Target) -> None:
    target.misses += 1
    target.rotation_disagreements = 0
    if target.state is TrackState.CONFIRMED:
        target.state = TrackState.COASTING


def _alive(target: Target, K: Array, view: View, image_size_wh: Size) -> bool:
    if target.state is TrackState.TENTATIVE:
        return target.misses < TENTATIVE_MISSES and _inside(_box(target, view, K), image_size_wh)
    return (view.time_ns - target.measured_ns) / ekf.NS_PER_S <= COAST_MAX_S


def _box(target: Target, view: View, K: Array) -> Array:
    return target.box.box_xyxy_px(ekf.t_in_cam(target.motion, view), K)


def _track(target: Target, motion: Motion, view: View, K: Array) -> Track:
    t_cam, R_cam, covariance = ekf.in_cam(motion, view)
    in_ned = motion.kind != "cam"
    return Track(
        track_id=target.track_id,
        state=target.state,
        time_ns=motion.time_ns,
        measured_ns=target.measured_ns,
        score=target.score,
        box_xyxy_px=target.box.box_xyxy_px(t_cam, K),
        R_cam_target=R_cam,
        t_cam_target_m=t_cam,
        covariance=target.doubt.added_to(covariance, R_cam),
        R_ned_target=motion.R_frame_target if in_ned else None,
        t_ned_target_m=motion.t_m if in_ned else None,
        v_ned_target_mps=motion.v_mps if in_ned else None,
        covariance_ned=target.doubt.added_to(motion.P[:9, :9], motion.R_frame_target) if in_ned else None,
    )


def _finite(estimate: Estimate) -> bool:
    parts = (estimate.box_xyxy_px, estimate.R_cam_target, estimate.t_cam_target_m, estimate.covariance)
    return bool(all(np.all(np.isfinite(part)) for part in parts) and estimate.t_cam_target_m[2] > RANGE_MIN_M)


def _project(t_cam_m: Array, K: Array) -> Array:
    return (K @ (t_cam_m / max(t_cam_m[2], RANGE_MIN_M)))[:2]


def _inside(box_xyxy_px: Array, image_size_wh: Size) -> bool:
    return bool(np.all(box_xyxy_px[2:] > 0.0) and np.all(box_xyxy_px[:2] < np.array(image_size_wh) - 1.0))
