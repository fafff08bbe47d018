"""Reload by SIGHUP or command: reads the configuration again, replaces the model between two frames, rejects faults.

| key                                                       | when it is changed         |
|-----------------------------------------------------------|----------------------------|
| [model], the file's content too                           | from the next frame on     |
| [target]                                                  | from the next frame on     |
| [estimator] acquire_every_n                               | from the next frame on     |
| [health] no_frame_s, latency_max_ms                       | from the next frame on     |
| all others, the content of calibration, certificates, key | named; they need a restart |
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edge.config import Config, ConfigFile, load_config
from edge.errors import InputError
from edge.estimator.estimator import Estimator
from edge.estimator.model import Model, load_model
from edge.memory import return_memory
from edge.requests import ReloadOutcome
from edge.types import CameraInfo, Frame, FrameMeta

log = logging.getLogger(__name__)

LIVE_KEYS = frozenset(
    {
        ("target", "wingspan_m"),
        ("target", "length_m"),
        ("estimator", "acquire_every_n"),
        ("health", "no_frame_s"),
        ("health", "latency_max_ms"),
    }
)
LIVE_SECTIONS = frozenset({"model"})


@dataclass(frozen=True)
class Reloaded:
    """The result of a reload, for the loop."""

    file: ConfigFile  # configuration from now on: the old one, except for keys that can change in flight
    estimator: Estimator  # warmed up
    outcome: ReloadOutcome


def load_configured(file: ConfigFile) -> Model:
    """The configured model, run once at each size. Raises InputError that names the key."""
    settings = file.config.model
    with file.blame("model", "path"):
        model = load_model(settings.path, settings.threads, settings.spinning, settings.provider)
        model.warm_up()
    return model


def warm_estimator(model: Model, max_targets: int, camera: CameraInfo) -> Estimator:
    """An estimator whose stages were run once on a black picture of the camera's size: first calls allocate memory, and
    should not delay a frame."""
    estimator = Estimator(model, max_targets)
    width, height = camera.image_size_wh
    black = np.zeros((height, width, 3), dtype=np.uint8)
    estimator.warm_up(Frame(FrameMeta(0, 0, 0), black, camera.K, camera.distortion))
    model.take_runs_ns()
    return estimator


def changes_in_flight(section: str, key: str) -> bool:
    """Whether a reload is enough for a new value of `[section] key`."""
    return section in LIVE_SECTIONS or (section, key) in LIVE_KEYS


def needs_restart(old: Config, new: Config) -> list[str]:
    """Keys that differ and cannot change in flight, as `[section] key`."""
    named = []
    for section in Config.model_fields:
        was, now = _keys(getattr(old, section)), _keys(getattr(new, section))
        named += [
            f"[{section}] {key}"
            for key in dict.fromkeys((*was, *now))
            if not changes_in_flight(section, key) and was.get(key) != now.get(key)
        ]
    return named


def with_live_keys(old: Config, new: Config) -> Config:
    """`old` with the keys that can change in flight taken from `new`."""
    changes: dict[str, Any] = {section: getattr(new, section) for section in LIVE_SECTIONS}
    for section in {section for section, _ in LIVE_KEYS}:
        keys = {key: getattr(getattr(new, section), key) for name, key in LIVE_KEYS if name == section}
        changes[section] = getattr(old, section).model_copy(update=keys)
    return old.model_copy(update=changes)


def reload(flying: ConfigFile, estimator: Estimator, camera: CameraInfo) -> Reloaded:
    """Read the configuration again and prepare the changes. Raises InputError; `flying` then remains in use."""
    new = load_config(flying.path)
    config = with_live_keys(flying.config, new.config)
    file = replace(new, config=config, contents=flying.contents)
    said = []
    if config.model != flying.config.model or _sha256(file) != estimator.model.sha256:
        old = estimator.model
        estimator = warm_estimator(load_configured(file), config.estimator.max_targets, camera)
        said.append(f"model {old.sha256[:12]} replaced by {_name(estimator.model)}")
    changed = needs_restart(config, new.config)
    keys = dict.fromkeys((*flying.contents, *new.contents))
    changed += [key for key in keys if key not in changed and flying.contents.get(key) != new.contents.get(key)]
    live = [f"[{s}] {k}" for s, k in sorted(LIVE_KEYS) if _key(config, s, k) != _key(flying.config, s, k)]
    if live:
        said.append(f"taken over: {', '.join(live)}")
    if changed:
        said.append(f"needs a restart: {', '.join(changed)}")
    sentence = f"reloaded: {'; '.join(said) or 'nothing has changed'}"
    outcome = ReloadOutcome(True, sentence, estimator.model.sha256, tuple(live), tuple(changed))
    return Reloaded(file, estimator, outcome)


class Reloader:
    """Triggered by a signal or a command, works in its own thread, delivers to the loop; one reload at a time."""

    def __init__(self) -> None:
        self._asked = False
        self._ready: Reloaded | None = None
        self._switched = threading.Event()
        self._flown: tuple[ConfigFile, Estimator] | None = None  # what is in use, for the thread that begins
        self._thread: threading.Thread | None = None  # of the reload in progress
        self._lock = threading.Lock()
        self._answer: Callable[[ReloadOutcome], None] | None = None  # for the reload that is requested or in progress

    def ask(self) -> None:
        """Request a reload, from any thread; the loop sees it in its next iteration."""
        self._asked = True

    def ask_for(self, answer: Callable[[ReloadOutcome], None]) -> bool:
        """As `ask`; `answer` is called with the outcome on the reload's thread. False if another reload is pending."""
        with self._lock:
            if self._answer is not None or self._thread is not None:
                return False
            self._answer = answer
        self._asked = True
        return True

    def take(
        self, flying: ConfigFile, estimator: Estimator, camera: CameraInfo, event: Callable[[int, str], None]
    ) -> Reloaded | None:
        """To be called in every iteration of the loop: start a requested reload, return a finished one, after which
        `switched` is to be called. Never waits."""
        if (ready := self._ready) is not None:  # only then is it emptied: the thread may be filling it just now
            self._ready = None
            return ready
        if self._asked and self._thread is None:
            self._asked = False
            self._switched.clear()
            # Not as arguments: a thread holds its arguments until it ends.
            self._flown = (flying, estimator)
            self._thread = threading.Thread(target=self._work, args=(camera, event), name="reload", daemon=True)
            self._thread.start()
        return None

    def switched(self) -> None:
        """The loop has the estimator that `take` returned, and none of before."""
        self._switched.set()

    def _work(self, camera: CameraInfo, event: Callable[[int, str], None]) -> None:
        assert self._flown is not None
        flying, estimator = self._flown
        self._flown = None
        log.info("reload: reading %s", flying.path)
        try:
            ready = reload(flying, estimator, camera)
        except Exception as error:  # whatever is wrong with a new model, the old one stays in use
            reason = str(error) if isinstance(error, InputError) else repr(error)
            text = f"reload refused, flying on as before: {reason}"
            log.error("%s", text)
            event(logging.ERROR, text)
            outcome = ReloadOutcome(False, text, estimator.model.sha256)
        else:
            outcome, self._ready = ready.outcome, ready
            del ready
            # The old estimator is released in this thread, after the loop has the new one: freeing memory takes time.
            self._switched.wait()
        del estimator
        return_memory()
        with self._lock:
            answer, self._answer = self._answer, None
            self._thread = None  # before the answer, whose receiver may request the next reload at once
        if answer is not None:
            answer(outcome)


def _keys(section: Any) -> dict[str, Any]:
    return {name: getattr(section, name) for name in type(section).model_fields}


def _key(config: Config, section: str, key: str) -> Any:
    return getattr(getattr(config, section), key)


def _sha256(file: ConfigFile) -> str:
    path = file.config.model.path
    with file.blame("model", "path"):
        try:
            return hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(f"model {path} cannot be read: {error.strerror}") from error


def _name(model: Model) -> str:
    fallback = f"; {model.fallback_reason}" if model.fallback_reason else ""
    return f"{model.contract.name} {model.sha256[:12]} on {model.provider}{fallback}"
