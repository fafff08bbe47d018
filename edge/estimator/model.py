"""The network: an ONNX file with the contract in its metadata; any deviation from it is rejected with a clear error."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from pydantic import ValidationError

from edge import clock
from edge.errors import InputError
from edge.estimator.providers import ChosenProvider, Provider, choose_provider
from edge.threads import yield_to_the_loop
from edge.types import PROBABLE_SCORE
from msgs.contract import CONTRACT_VERSION, INPUT_NAMES, METADATA_KEY, OUTPUT_NAMES, ModelContract
from msgs.settings import dotted, faults_of

INPUT_TYPES = {"image": ("tensor(uint8)", 4), "K": ("tensor(float)", 3)}
OUTPUT_TAILS: dict[str, tuple[int, ...]] = {
    "score": (),
    "center_px": (2,),
    "size_px": (2,),
    "origin_px": (2,),
    "t_cam_target_m": (3,),
    "R_cam_target": (3, 3),
    "sigma": (6,),
}
SIZE_STEP_PX = 32
FREE_SIDES = ("W", "H")  # names of the graph's free input dimensions
RUNS_REMEMBERED = 16
# Images are shared out if that keeps the threads busy for so much of the time. At work on the same layers, two are busy
# for 0.6 of it.
BUSY_SHARE_MIN = 0.75
_LOG_FATAL = 4
NOT_CALIBRATED = "scores are not calibrated: what is probably no aircraft, such as a bird, is reported as well"


@dataclass(frozen=True)
class Peaks:
    """The network's outputs for N images, M peaks each, in the images' own pixels (see msgs.contract)."""

    score: NDArray[np.float32]  # [N, M]
    center_px: NDArray[np.float32]  # [N, M, 2]
    size_px: NDArray[np.float32]  # [N, M, 2]
    origin_px: NDArray[np.float32]  # [N, M, 2]
    t_cam_target_m: NDArray[np.float32]  # [N, M, 3]
    R_cam_target: NDArray[np.float32]  # [N, M, 3, 3]
    sigma: NDArray[np.float32]  # [N, M, 6]


@dataclass(frozen=True)
class Sessions:
    """One file opened on one provider: for any input size, and for one fixed size each, by (width, height).

    `single` is on one thread, for several images at once: each thread then runs its own, and none waits for the others
    at every layer. Empty on other providers, and with one thread.
    """

    free: ort.InferenceSession
    fixed: Mapping[tuple[int, int], ort.InferenceSession]
    single: Mapping[tuple[int, int], ort.InferenceSession]
    chosen: ChosenProvider  # what they really run on


class Model:
    """A loaded file. `run` is for the loop's thread only and is timed; `infer` may be called from any thread."""

    def __init__(
        self,
        sessions: Sessions,
        reopen: Callable[[ChosenProvider], Sessions],
        threads: int,
        contract: ModelContract,
        path: Path,
        sha256: str,
    ) -> None:
        self._sessions = sessions
        self._reopen = reopen
        self._threads = threads
        self._beside = ThreadPoolExecutor(max(threads - 1, 1), thread_name_prefix="windows")
        self._runs_ns: deque[tuple[int, int]] = deque(maxlen=RUNS_REMEMBERED)
        self.contract = contract
        self.path = path
        self.sha256 = sha256

    @property
    def provider(self) -> Provider:
        """The one it really runs on."""
        return self._sessions.chosen.provider

    @property
    def fallback_reason(self) -> str | None:
        """A sentence; None: it runs on the requested provider."""
        return self._sessions.chosen.fallback_reason

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences for whoever flies it; a provider that fails in flight adds one."""
        doubts = (self.fallback_reason, None if self.contract.scores_calibrated else NOT_CALIBRATED)
        return tuple(doubt for doubt in doubts if doubt is not None)

    @property
    def doubtful_below(self) -> float:
        """Score below which a track is probably no aircraft; 0 where scores were not calibrated and so are no
        probabilities."""
        return PROBABLE_SCORE if self.contract.scores_calibrated else 0.0

    def run(self, images_bgr: NDArray[np.uint8], K: NDArray[np.float64]) -> Peaks:
        """images_bgr [N, H, W, 3] and K [N, 3, 3] of exactly these pixels. If the provider fails, or gives scores that
        are not finite, with which nothing would ever be found, the CPU takes over, from this inference on."""
        begin_ns = clock.monotonic_ns()
        try:
            peaks = self.infer(images_bgr, K)
            if self.provider != "cpu" and not np.isfinite(peaks.score).all():
                raise ArithmeticError("its scores are not finite")
        except Exception as error:  # ONNX Runtime's exceptions have no common base class of their own
            if self.provider == "cpu":
                raise
            self._sessions = self._reopen(self._sessions.chosen.failed(_first_line(error)))
            peaks = self.infer(images_bgr, K)
        self._runs_ns.append((begin_ns, clock.monotonic_ns()))
        return peaks

    def infer(self, images_bgr: NDArray[np.uint8], K: NDArray[np.float64]) -> Peaks:
        """As `run`, untimed; raises ONNX Runtime's error where the provider fails."""
        sessions, size_wh = self._sessions, (images_bgr.shape[2], images_bgr.shape[1])
        single = sessions.single.get(size_wh)
        count, rounds = len(images_bgr), -(-len(images_bgr) // self._threads)
        if single is None or count < BUSY_SHARE_MIN * rounds * self._threads:
            return Peaks(*_outputs(sessions.fixed.get(size_wh, sessions.free), images_bgr, K))
        at_once = min(count, self._threads)
        shares = list(zip(np.array_split(images_bgr, at_once), np.array_split(K, at_once), strict=True))
        others = [self._beside.submit(_outputs, single, *share) for share in shares[1:]]
        parts = [_outputs(single, *shares[0]), *(other.result() for other in others)]
        return Peaks(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def take_runs_ns(self) -> list[tuple[int, int]]:
        """Begin and end (monotonic) of the inferences since the last call, oldest first."""
        taken = list(self._runs_ns)
        self._runs_ns.clear()
        return taken

    def warm_up(self) -> None:
        """One inference at each size, and of two windows at once, as there will be with two targets; where windows are
        shared out, also of two for each thread.

        Raises InputError if the graph does not run, its outputs have wrong shapes, or its scores are not finite.
        """
        self._try(1, self.contract.acquire_size_wh)
        if self.contract.track_size_wh is not None:
            for count in (1, 2, 2 * self._threads) if self._sessions.single else (1, 2):
                self._try(count, self.contract.track_size_wh)

    def _try(self, count: int, size_wh: tuple[int, int]) -> None:
        """Run a batch of `count` black images. Raises InputError."""
        width, height = size_wh
        images = np.zeros((count, height, width, 3), dtype=np.uint8)
        K = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
        try:
            peaks = self.run(images, np.stack([K] * count))
        except Exception as error:  # ONNX Runtime's exceptions have no common base class of their own
            pictures = "" if count == 1 else " with several pictures at once"
            reason = " ".join(str(error).split())
            raise InputError(f"model {self.path} does not run at {width}x{height}{pictures}: {reason}") from error
        for name, tail in OUTPUT_TAILS.items():
            shape, wanted = getattr(peaks, name).shape, (count, self.contract.max_peaks, *tail)
            if shape != wanted:
                raise InputError(f"model {self.path}: output {name} has shape {shape}, its contract says {wanted}")
        # Of a single peak, what is not finite is refused when it is decoded.
        if not np.isfinite(peaks.score).all():
            raise InputError(f"model {self.path}: output score is not finite: no target would be found")


def _outputs(session: ort.InferenceSession, images_bgr: NDArray[np.uint8], K: NDArray[np.float64]) -> list[Any]:
    outputs: list[Any] = session.run(list(OUTPUT_NAMES), {"image": images_bgr, "K": K.astype(np.float32)})
    return outputs


def load_model(path: Path, threads: int, spinning: bool = False, provider: Provider = "cpu") -> Model:
    """Open an ONNX file and check it against the contract. Raises InputError with the file and what is wrong.

    An unavailable `provider` is not an error: the model then runs on the CPU, with the reason in `fallback_reason`.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"model {path} cannot be read: {error.strerror}") from error
    reopen = partial(_open_sessions, content, path, threads, spinning)
    sessions = reopen(choose_provider(provider, ort.get_available_providers()))
    contract = _contract(sessions.free, path)
    return Model(sessions, reopen, threads, contract, path, hashlib.sha256(content).hexdigest())


def session_options(threads: int, spinning: bool) -> ort.SessionOptions:
    """Each inference on `threads` threads, which sleep between inferences unless `spinning`."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "1" if spinning else "0")
    options.log_severity_level = _LOG_FATAL
    return options


def _open_sessions(content: bytes, path: Path, threads: int, spinning: bool, chosen: ChosenProvider) -> Sessions:
    """Raises InputError."""
    with ThreadPoolExecutor(1, initializer=yield_to_the_loop) as opener:
        # A session's threads inherit the priority of the thread that opens it, here a low one: a search of the whole
        # frame then does not delay the track windows of the same time.
        free, runs_on = opener.submit(_open, content, path, session_options(threads, spinning), chosen).result()
    contract = _contract(free, path)
    _check_graph(free, contract, path)
    if contract.track_size_wh is None:
        return Sessions(free, {}, {}, runs_on)
    # With fixed dimensions, shapes are computed once, here. For the whole frame the gain is too small to be worth the
    # memory of another session.
    fixed, too = _open(content, path, _sized_options(contract.track_size_wh, threads, spinning), runs_on)
    if too != runs_on:  # as where a device has memory for one session only: both then run on the next one
        return _open_sessions(content, path, threads, spinning, too)
    single = {}
    if threads > 1 and runs_on.provider == "cpu":
        options = _sized_options(contract.track_size_wh, 1, spinning)
        single[contract.track_size_wh], _ = _open(content, path, options, runs_on)
    return Sessions(free, {contract.track_size_wh: fixed}, single, runs_on)


def _sized_options(size_wh: tuple[int, int], threads: int, spinning: bool) -> ort.SessionOptions:
    options = session_options(threads, spinning)
    for name, side in zip(FREE_SIDES, size_wh, strict=True):
        options.add_free_dimension_override_by_name(name, side)
    return options


def _open(
    content: bytes, path: Path, options: ort.SessionOptions, chosen: ChosenProvider
) -> tuple[ort.InferenceSession, ChosenProvider]:
    """The session, and what it really runs on: the first of the chosen providers that starts. Raises InputError."""
    while True:
        try:
            # ONNX Runtime's own fallback, also of a provider that fails in flight, is only printed on standard output.
            session = ort.InferenceSession(content, options, providers=list(chosen.names), enable_fallback=0)
        except Exception as error:  # ONNX Runtime's exceptions have no common base class of their own
            if chosen.provider == "cpu":
                raise InputError(f"model {path} is not a loadable ONNX file: {_first_line(error)}") from error
            chosen = chosen.not_started(_first_line(error))
        else:
            return session, chosen.confirmed(session.get_providers())


def _first_line(error: Exception) -> str:
    return (str(error).strip() or repr(error)).splitlines()[0]


def _contract(session: ort.InferenceSession, path: Path) -> ModelContract:
    metadata: dict[str, str] = session.get_modelmeta().custom_metadata_map
    if METADATA_KEY not in metadata:
        raise InputError(f"model {path} carries no contract (metadata key {METADATA_KEY}): not made by uavpose-trainer")
    try:
        tree = json.loads(metadata[METADATA_KEY])
        version = tree.get("version") if isinstance(tree, dict) else None
        if version != CONTRACT_VERSION:
            raise InputError(f"model {path} has contract version {version}; this program reads {CONTRACT_VERSION}")
        contract = ModelContract.model_validate(tree)
    except ValidationError as error:
        first = faults_of(error)[0]
        raise InputError(f"model {path}: contract key {dotted(first.location)}: {first.reason}") from error
    except json.JSONDecodeError as error:
        raise InputError(f"model {path}: its contract is not JSON: {error}") from error
    for size_wh in filter(None, (contract.acquire_size_wh, contract.track_size_wh)):
        if any(side % SIZE_STEP_PX for side in size_wh):
            raise InputError(f"model {path}: input size {size_wh} is not a multiple of {SIZE_STEP_PX}")
    return contract


def _check_graph(session: ort.InferenceSession, contract: ModelContract, path: Path) -> None:
    inputs: dict[str, Any] = {node.name: node for node in session.get_inputs()}
    if set(inputs) != set(INPUT_NAMES):
        raise InputError(f"model {path} takes inputs {sorted(inputs)}, its contract's are {sorted(INPUT_NAMES)}")
    for name, (kind, rank) in INPUT_TYPES.items():
        node = inputs[name]
        if node.type != kind or len(node.shape) != rank:
            raise InputError(
                f"model {path}: input {name} is {node.type} of shape {node.shape}, not {kind} of rank {rank}"
            )
    outputs = {node.name for node in session.get_outputs()}
    missing = [name for name in OUTPUT_NAMES if name not in outputs]
    if missing:
        raise InputError(f"model {path} lacks outputs {missing} of contract version {contract.version}")
