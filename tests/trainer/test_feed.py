"""The feed of rendered windows: what is made ahead comes in order; a renderer that fails is told, not waited for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny
from odd_samplers import LARGE_PX, Broken, Telling, opened_with_a_warning
from synthetic_sampler import PlateSampler

from tests.waiting import until
from trainer.config import RenderingError
from trainer.data import Feed, training_batch


def rendered_pids(parent: int | None = None) -> set[int]:
    """Of this process, unless told."""
    pid = parent or os.getpid()
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return {pid for pid in map(int, children) if renders(pid)}


def renders(pid: int) -> bool:
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):  # it has just ended
        return False


def test_batches_come_in_order_whoever_renders_them() -> None:
    alone = PlateSampler(5, 64)
    with Feed(partial(PlateSampler, 5, 64), 4, 8, workers=2, prefetch=2) as feed:
        for first in range(8, 32, 4):
            assert np.array_equal(feed.next().image_bgr, training_batch(alone.batch(first, 4)).image_bgr)
    assert not rendered_pids()


@pytest.mark.timeout(60)
def test_a_renderer_that_is_killed_in_the_middle_of_a_batch_is_told(tmp_path: Path) -> None:
    """The third is rendered once the first is on its way through the pipe, which holds a part, and the second waits."""
    with Feed(partial(Telling, tmp_path / "told"), 8, 0, prefetch=1) as feed:
        until((tmp_path / "told").exists)
        (pid,) = rendered_pids()
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(RenderingError, match="renderer-0 ended with exit code -9"):
            feed.next()


def test_of_a_known_number_of_batches_no_more_is_rendered(tmp_path: Path) -> None:
    alone = PlateSampler(5, LARGE_PX)
    with Feed(partial(Telling, tmp_path / "told"), 4, 0, prefetch=4, batches=2) as feed:
        for first in (0, 4):
            assert np.array_equal(feed.next().image_bgr, training_batch(alone.batch(first, 4)).image_bgr)
        until(lambda: not rendered_pids(), what="the renderer's end")
    assert not (tmp_path / "told").exists()


def test_what_a_renderer_failed_of_is_told_after_what_it_made() -> None:
    with Feed(partial(Broken, 5, 64), 4, 0) as feed:
        assert len(feed.next().present) == 4
        with pytest.raises(RenderingError, match=r"renderer-0 failed:(.|\n)*no such aircraft"):
            feed.next()


def test_what_every_renderer_would_warn_of_is_told_once(capfd: pytest.CaptureFixture[str]) -> None:
    with Feed(opened_with_a_warning, 4, 0, workers=3) as feed:
        for _ in range(3):
            feed.next()
    assert capfd.readouterr().err.count("two pictures are missing") == 1


# Its rendering processes import it too, and need no torch.
SLOW = """
import sys, time
from functools import partial
from pathlib import Path
sys.path.insert(0, {tests!r})
from synthetic_sampler import PlateSampler

class Slow(PlateSampler):
    def batch(self, first_index, count):
        time.sleep(0.5)
        return super().batch(first_index, count)

if __name__ == "__main__":
    import tiny
    from trainer.train import run_training

    toml = tiny.TOML.replace("samples = 16\\nwarmup", "samples = 100000\\nwarmup")
    config = tiny.parse_config(toml, "tiny.toml")
    run_training(config, toml, Path(sys.argv[1]), open_sampler=lambda seed, size: partial(Slow, seed, size))
"""


@pytest.mark.parametrize("renderer", ["starting", "rendering"])
def test_a_run_whose_whole_group_is_told_to_stop_ends_as_one_that_was_asked_to(tmp_path: Path, renderer: str) -> None:
    """As `timeout` and systemd tell it; rendering is slower than training here, so that it waits for a renderer."""
    (tmp_path / "slow.py").write_text(SLOW.format(tests=str(Path(tiny.__file__).parent)))
    command = [sys.executable, str(tmp_path / "slow.py"), str(tmp_path / "run")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            assert process.stdout is not None
            if renderer == "starting":
                until(lambda: rendered_pids(process.pid))
            else:
                next(line for line in process.stdout if line.startswith("step"))
            os.killpg(process.pid, signal.SIGTERM)
            said, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert "stopped before the planned number of samples" in said
    assert ("; --resume continues" in said) == (tmp_path / "run" / "resume.pt").exists()
    if renderer == "rendering":  # else it may have been stopped before it had learnt anything
        assert (tmp_path / "run" / "resume.pt").exists()


def test_a_second_ctrl_c_ends_the_last_validation_of_a_run_that_is_saved(tmp_path: Path) -> None:
    """As torchrun does, SIGTERM follows the first; windows to validate on are never rendered here."""
    endless = SLOW.format(tests=str(Path(tiny.__file__).parent)).replace("0.5", "1000 if self.seed == 4 else 0")
    (tmp_path / "slow.py").write_text(endless)
    command = [sys.executable, str(tmp_path / "slow.py"), str(tmp_path / "run")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            next(line for line in process.stdout if line.startswith("step"))
            process.send_signal(signal.SIGINT)
            assert any("; --resume continues" in line for line in process.stdout)
            assert next(process.stdout) == "last validation (Ctrl-C skips it)\n"
            assert (tmp_path / "run" / "resume.pt").exists()
            process.send_signal(signal.SIGTERM)
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=60)
        finally:
            process.kill()
    assert said.rstrip().endswith("KeyboardInterrupt")  # SIGTERM would have left no traceback
