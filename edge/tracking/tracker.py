"""From single-frame estimates to tracks: association, track initiation and deletion, prediction for the next frame.

A target is tentative until it was detected CONFIRM_HITS times, or SURE_HITS times with little doubt, coasts on
prediction when missed, and is lost after COAST_MAX_S; its number is then free. An estimate that stays outside the gate
but inside the target's box replaces it after PERSISTENT frames. Of two targets that took turns at one aircraft for long
(`doubles.py`), one is deleted.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from edge.estimator.lens import Lens
from edge.tracking import motion as ekf
from edge.tracking import rotation
from edge.tracking.association import Pair, associate, out_of_sight
from edge.tracking.boxes import RANGE_MIN_M, SAME_BOX_IOU, BoxModel, inside, iou
from edge.tracking.doubles import Doubles
from edge.tracking.heading import Flight
from edge.tracking.merged import less_sure, shown_at_once
from edge.tracking.motion import Innovation, Motion
from edge.tracking.rotation import Attitude
from edge.tracking.view import NS_PER_S, View, between
from edge.types import Array, Estimate, Mount, OwnShip, Track, TrackState

CONFIRM_HITS = 3
SURE_HITS = 2  # are enough if the score is at least SURE_SCORE: birds have been taken for aircraft, but not so surely
SURE_SCORE = 0.95
TENTATIVE_MISSES = 2  # in a row: deleted
COAST_MAX_S = 2.0
PERSISTENT = 6  # frames
SCORE_MEMORY_S = 1.0  # time constant of a track's score, the mean of its frames'
LONG_AGO_NS = -(10**18)

Size = tuple[int, int]


@dataclass
class Target:
    """One target between frames."""

    track_id: int
    motion: Motion
    attitude: Attitude
    box: BoxModel
    score: float
    measured_ns: int
    born_ns: int
    state: TrackState = TrackState.TENTATIVE
    hits: int = 1
    misses: int = 0
    position_disagreements: int = 0
    merged_ns: int = LONG_AGO_NS  # last time that one detection may have shown it and another
    range_doubted: bool = False  # its range and motion begin anew with the next detection


@dataclass
class Tracker:
    """Up to `max_targets` targets seen by a camera mounted on its vehicle by `mount`. Use from one thread only."""

    max_targets: int
    mount: Mount
    not_finite: int = 0  # estimates dropped
    _targets: list[Target] = field(default_factory=list)
    _view: View | None = None  # the camera in the last frame
    _motion_doubted: bool = False
    _doubles: Doubles = field(default_factory=Doubles)
    _wanted: Estimate | None = None  # of the next update, to become a target before all others

    def predict(
        self,
        capture_ns: int,
        own_ship: OwnShip | None,
        K: Array,
        image_size_wh: Size,
        distortion: tuple[float, ...] = (),
    ) -> list[Track]:
        """Predicted tracks in the frame taken at `capture_ns`, without those whose box lies outside the image.

        Oldest measurement first. Changes no state. K [3, 3] px; image_size_wh px; distortion as in Frame.
        """
        lens = Lens(K, distortion)
        view = View.of(capture_ns, own_ship, self.mount, self._view)
        expected = []
        for target in sorted(self._within_reach(capture_ns), key=lambda t: t.measured_ns):
            track = _track(target, *self._advanced(target, view), view, lens)
            if track.t_cam_target_m[2] > RANGE_MIN_M and inside(track.box_xyxy_px, image_size_wh):
                expected.append(track)
        return expected

    def drop_all(self) -> None:
        """Forget all targets."""
        self._targets.clear()

    def doubt_motion(self) -> None:
        """Discard the targets' velocities and turn rates, not their positions, now and again after the next frame: the
        timestamps they were estimated from, and the interval to the next frame, may be wrong."""
        self._motion_doubted = True
        self._forget_motion()

    def doubt_ranges(self) -> None:
        """Begin all ranges, and velocities with them, anew with the next detections: those so far were inferred by
        another size or model, and the step between the two is no speed."""
        for target in self._targets:
            assert self._view is not None, "a target exists only after a frame"
            target.motion = ekf.unknown_range(target.motion, self._view)
            target.range_doubted = True

    def make_room(self, wanted: Estimate) -> None:
        """If there is no free slot, delete a target that was missed or is least certain; the slot is reserved for
        `wanted` if the next update contains it."""
        if len(self._targets) >= self.max_targets:
            self._targets.remove(
                min(self._targets, key=lambda t: (t.measured_ns, t.state is not TrackState.TENTATIVE, t.score))
            )
            self._wanted = wanted

    def is_late(self, capture_ns: int) -> bool:
        """Whether a frame is not later than the last one and so cannot be used: the tracks are of a later time."""
        return self._view is not None and capture_ns <= self._view.time_ns

    def update(
        self,
        capture_ns: int,
        estimates: list[Estimate],
        own_ship: OwnShip | None,
        K: Array,
        image_size_wh: Size,
        distortion: tuple[float, ...] = (),
        chosen_id: int | None = None,
        doubtful_below: float = 0.0,
    ) -> tuple[Track, ...]:
        """Update with the estimates of the frame taken at `capture_ns`, not `is_late`; returns all tracks, by track_id.

        `chosen_id`: the target that the operator selected. `doubtful_below`: a target of a lower score gives way, if
        there is no free slot, to an estimate that is not below; 0: scores are no probabilities.
        """
        view = View.of(capture_ns, own_ship, self.mount, self._view)
        # Before association: after a gap a prediction is so uncertain that any detection would fit it.
        self._targets = self._within_reach(capture_ns)
        for target in self._targets:
            target.motion, target.attitude = self._advanced(target, view)
        self._view = view

        lens = Lens(K, distortion)
        finite = [one for one in estimates if _finite(one)]
        self.not_finite += len(estimates) - len(finite)
        boxes = [_outline(target, view, lens) for target in self._targets]
        lately = [(capture_ns - target.merged_ns) / NS_PER_S <= COAST_MAX_S for target in self._targets]
        merged = shown_at_once(finite, boxes, lately)
        for i, several in merged.items():
            finite[i] = less_sure(finite[i], [boxes[k] for k in several], lens.K)
            if len(several) > 1:
                for k in several:
                    self._targets[k].merged_ns = capture_ns
        held = [(target.motion, target.attitude, target.misses) for target in self._targets]
        pairs = associate(held, finite, lens.K, view)
        for pair in pairs:
            target = self._targets[pair.target]
            own_box = target.box
            _hit(target, finite[pair.estimate], pair.seen, lens, view)
            if pair.estimate in merged or lately[pair.target]:
                target.box = own_box  # as they part, that of both grows little by little
        used = {pair.estimate for pair in pairs}
        hit = {pair.target for pair in pairs}
        spare = [one for i, one in enumerate(finite) if i not in used]
        for i, target in enumerate(self._targets):
            if i not in hit and not _taken_over(target, spare, lens, view):
                _miss(target)
            elif target.state is TrackState.COASTING or _proven(target, doubtful_below > 0.0):
                target.state = TrackState.CONFIRMED
        double = self._double(pairs, bool(spare), chosen_id, capture_ns)
        self._targets = [t for t in self._targets if t.track_id != double and _alive(t, lens, view, image_size_wh)]
        self._give_birth(spare, lens, view, chosen_id, doubtful_below)
        if self._motion_doubted:
            self._forget_motion()
            self._motion_doubted = False
        self._targets.sort(key=lambda t: t.track_id)
        return tuple(_track(target, target.motion, target.attitude, view, lens) for target in self._targets)

    def _within_reach(self, time_ns: int) -> list[Target]:
        """Targets detected recently enough to be distinguished from others."""
        return [t for t in self._targets if (time_ns - t.measured_ns) / NS_PER_S <= COAST_MAX_S]

    def _forget_motion(self) -> None:
        for target in self._targets:
            assert self._view is not None, "a target exists only after a frame"
            target.motion = ekf.unknown_motion(target.motion, self._view)

    def _advanced(self, target: Target, view: View) -> tuple[Motion, Attitude]:
        """The target's state at the view's time and in its frame."""
        assert self._view is not None, "a target exists only after a frame"
        turn = ekf.turning(target.motion, view.time_ns)
        motion = ekf.propagate(target.motion, view.time_ns)
        attitude = rotation.propagate(target.attitude, turn, (view.time_ns - target.motion.time_ns) / NS_PER_S)
        if self._view.same_frame(view):
            return ekf.untangled(motion, view), attitude
        old = self._view.moved_to(view.time_ns)
        through_cam = old.linked_by_cam(view)
        # Leaving ned, the linking attitude is the last known one, now stale; entering it, it is this frame's own.
        stale_s = (view.time_ns - self._view.time_ns) / NS_PER_S if through_cam and old.kind != "cam" else 0.0
        return (
            ekf.untangled(ekf.reframe(motion, old, view, stale_s), view),
            rotation.reframe(attitude, between(old, view), stale_s) if through_cam else attitude,
        )

    def _double(self, pairs: list[Pair], more: bool, chosen_id: int | None, time_ns: int) -> int | None:
        """Number of a target, missed in this frame, that duplicates another: not the selected, else the younger one.

        `more`: a detection was assigned to no target. It may be of the missed one.
        """
        keys = [(target.track_id, target.born_ns) for target in self._targets]
        turns = [(keys[pair.target], keys[other]) for pair in pairs for other in pair.left_out]
        both = {keys[pair.target] for pair in pairs} | ({missed for _, missed in turns} if more else set())
        for seen, missed in self._doubles.among(both, [] if more else turns, time_ns):
            goes = min(seen, missed, key=lambda key: (key[0] == chosen_id, -key[1], -key[0]))
            if goes == missed:
                return missed[0]
        return None

    def _give_birth(
        self, estimates: list[Estimate], lens: Lens, view: View, chosen_id: int | None, doubtful_below: float
    ) -> None:
        wanted, self._wanted = self._wanted, None
        for estimate in sorted(estimates, key=lambda e: (e is not wanted, -e.score)):
            boxes = [_box(target, view, lens) for target in self._targets]
            if any(iou(estimate.box_xyxy_px, box) > SAME_BOX_IOU for box in boxes):
                continue  # two windows showed one target
            if len(self._targets) >= self.max_targets:
                gives_way = self._least(view, chosen_id, doubtful_below) if estimate.score >= doubtful_below else None
                if gives_way is None:
                    return
                self._targets.remove(gives_way)
            free = sorted(set(range(self.max_targets)) - {t.track_id for t in self._targets})
            motion, attitude = ekf.begin(estimate, lens.K, view), rotation.begin(estimate, view)
            box = BoxModel.measured(estimate.box_xyxy_px, estimate.t_cam_target_m, lens)
            self._targets.append(Target(free[0], motion, attitude, box, estimate.score, view.time_ns, view.time_ns))

    def _least(self, view: View, chosen_id: int | None, doubtful_below: float) -> Target | None:
        """The target, if any, whose slot another may take: out of sight or of a lower score. Never the selected one,
        nor one born in this frame, which may be what the operator points at."""
        candidates = [
            target
            for target in self._targets
            if target.track_id != chosen_id
            and target.born_ns < view.time_ns
            and (target.score < doubtful_below or out_of_sight(target.motion, target.misses, view))
        ]
        return min(candidates, key=lambda target: (target.measured_ns, target.score), default=None)


def _hit(target: Target, estimate: Estimate, seen: Innovation, lens: Lens, view: View) -> None:
    dt_s = (view.time_ns - target.measured_ns) / NS_PER_S
    target.motion = (
        ekf.begin(estimate, lens.K, view) if target.range_doubted else ekf.correct(target.motion, seen, view)
    )
    target.range_doubted = False
    attitude = rotation.correct(target.attitude, estimate, view, dt_s)
    settled = target.state is not TrackState.TENTATIVE
    target.attitude = rotation.weighed(
        attitude, _along(target.motion, view), _flight(target.motion, view), dt_s, settled
    )
    _seen(target, estimate, lens, view)


def _flight(motion: Motion, view: View) -> Flight | None:
    """The motion as evidence of heading; None in `cam`, where the apparent motion is mostly the camera's own."""
    P_v = ekf.covariance(motion, view)[ekf.VELOCITY, ekf.VELOCITY]
    if motion.kind == "ned":
        return Flight(motion.v_mps, P_v, motion.turn_rate_radps, float(motion.P[ekf.TURN_RATE, ekf.TURN_RATE]), None)
    return None if motion.kind == "cam" else Flight(motion.v_mps, P_v, None, 0.0, view.nose_frame)


def _along(motion: Motion, view: View) -> Array:
    """The unit line of sight [3] in the frame."""
    return rotation.unit(motion.t_m - view.t_frame_cam_m)


def _taken_over(target: Target, spare: list[Estimate], lens: Lens, view: View) -> bool:
    """Whether estimates outside the gate lay in the target's box for PERSISTENT frames: it is then restarted there."""
    box = _box(target, view, lens)
    rivals = [e for e in spare if iou(e.box_xyxy_px, box) > SAME_BOX_IOU]
    target.position_disagreements = target.position_disagreements + 1 if rivals else 0
    if target.position_disagreements < PERSISTENT:
        return False
    rival = max(rivals, key=lambda e: e.score)
    target.motion, target.attitude = ekf.begin(rival, lens.K, view), rotation.begin(rival, view)
    _seen(target, rival, lens, view)
    spare[:] = [e for e in spare if e is not rival]
    return True


def _seen(target: Target, estimate: Estimate, lens: Lens, view: View) -> None:
    target.box = BoxModel.measured(estimate.box_xyxy_px, ekf.t_in_cam(target.motion, view), lens)
    remembered = float(np.exp(-(view.time_ns - target.measured_ns) / NS_PER_S / SCORE_MEMORY_S))
    target.score += max(1.0 - remembered, 1.0 / (target.hits + 1)) * (estimate.score - target.score)
    target.measured_ns = view.time_ns
    target.hits += 1
    target.misses = 0
    target.position_disagreements = 0


def _proven(target: Target, probabilities: bool) -> bool:
    """`probabilities`: whether scores are such."""
    sure = probabilities and target.hits >= SURE_HITS and target.score >= SURE_SCORE
    return sure or target.hits >= CONFIRM_HITS


def _miss(target: Target) -> None:
    target.misses += 1
    if target.state is TrackState.CONFIRMED:
        target.state = TrackState.COASTING


def _alive(target: Target, lens: Lens, view: View, image_size_wh: Size) -> bool:
    if target.state is not TrackState.TENTATIVE:
        return True
    return target.misses < TENTATIVE_MISSES and inside(_box(target, view, lens), image_size_wh)


def _box(target: Target, view: View, lens: Lens) -> Array:
    return target.box.box_xyxy_px(ekf.t_in_cam(target.motion, view), lens)


def _outline(target: Target, view: View, lens: Lens) -> Array:
    """Its box [4]; an empty one, which hides no other target, if it is beside or behind the camera or, missed, may well
    be: without own attitude, what has flown by is soon predicted anywhere around the camera."""
    t_cam_m, along = ekf.t_in_cam(target.motion, view), _along(target.motion, view)
    P = target.motion.P[ekf.POSITION, ekf.POSITION]
    anywhere = target.misses > 0 and np.trace(P) - along @ P @ along > t_cam_m @ t_cam_m
    return np.zeros(4) if anywhere or t_cam_m[2] <= RANGE_MIN_M else target.box.box_xyxy_px(t_cam_m, lens)


def _track(target: Target, motion: Motion, attitude: Attitude, view: View, lens: Lens) -> Track:
    t_cam = ekf.t_in_cam(motion, view)
    R = view.R_frame_cam.T
    spread = rotation.covariance(attitude, _along(motion, view))
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = ekf.covariance_in_cam(motion, view)
    covariance[3:, 3:] = ekf.symmetric(R @ spread @ R.T) + view.attitude_variance * np.eye(3)
    in_ned = motion.kind != "cam"
    return Track(
        track_id=target.track_id,
        state=target.state,
        time_ns=motion.time_ns,
        measured_ns=target.measured_ns,
        born_ns=target.born_ns,
        score=target.score,
        box_xyxy_px=target.box.box_xyxy_px(t_cam, lens),
        R_cam_target=R @ attitude.R_frame_target,
        t_cam_target_m=t_cam,
        covariance=covariance,
        R_ned_target=attitude.R_frame_target if in_ned else None,
        t_ned_target_m=motion.t_m if in_ned else None,
        v_ned_target_mps=motion.v_mps if in_ned else None,
        covariance_ned=_covariance_ned(motion, spread, view) if in_ned else None,
    )


def _covariance_ned(motion: Motion, spread: Array, view: View) -> Array:
    """[9, 9] (position, velocity, rotation), with the own ship's errors."""
    covariance = view.own_ship_covariance(motion.t_m, motion.v_mps)
    covariance[:6, :6] += ekf.covariance(motion, view)
    covariance[6:, 6:] += spread
    return ekf.symmetric(covariance)


def _finite(estimate: Estimate) -> bool:
    parts = (estimate.box_xyxy_px, estimate.R_cam_target, estimate.t_cam_target_m, estimate.covariance)
    return bool(all(np.all(np.isfinite(part)) for part in parts) and estimate.t_cam_target_m[2] > RANGE_MIN_M)
