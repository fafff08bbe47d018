"""Opens the argument of `play --sequence`: a scene folder, or a source that is converted to one first."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from edge.errors import InputError
from sim_replay.ground_truth import PlayedSequence, read_sequence
from sim_replay.recorded.scene_files import is_unpacked

SCENE = "sequence"  # folder in `out` for what was unpacked
UNFINISHED = "sequence.part"  # the same while images are being unpacked
WHAT = "a scene folder, an .mcap recording or a folder of them, or a .toml that names a video and its telemetry"


def open_sequence(path: Path, out: Path, console: Console) -> PlayedSequence:
    """The sequence at `path`; a video or recording becomes a scene in `out`/sequence, which can be played again.

    Raises InputError, naming file and key; OSError.
    """
    recordings = [path] if path.suffix == ".mcap" else sorted(path.glob("*.mcap")) if path.is_dir() else []
    if not recordings and path.suffix != ".toml":
        if not (path / "scene_camera.json").is_file():
            raise InputError(f"{path}: is not {WHAT}")
        return read_sequence(path)
    scene = out / SCENE
    if scene.exists() and not is_unpacked(scene):
        raise InputError(f"{scene}: is in the way: pictures would be unpacked there")
    unfinished = out / UNFINISHED
    shutil.rmtree(unfinished, ignore_errors=True)  # of a run that was killed
    try:
        _unpack(path, recordings, unfinished, console)
        if scene.exists():
            shutil.rmtree(scene)
        unfinished.rename(scene)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    console.print(f"pictures unpacked into {scene}", highlight=False, soft_wrap=True)
    return read_sequence(scene)


def _unpack(path: Path, recordings: Sequence[Path], scene: Path, console: Console) -> None:
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("unpacking pictures", total=None)
        if recordings:
            from sim_replay.recorded.recording import unpack_recordings

            unpack_recordings(recordings, scene, lambda: progress.advance(task))
        else:
            from sim_replay.recorded.video import unpack_video

            unpack_video(path, scene, lambda: progress.advance(task))
