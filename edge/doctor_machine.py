"""Checks of the machine: processor, clock, memory and disk."""

from __future__ import annotations

import ctypes
import os
import platform
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

from edge.config import Config
from edge.findings import Finding, good, poor, this_user, wrong

CPUINFO = Path("/proc/cpuinfo")
GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
# Instructions that make an 8-bit network faster than a float one, as named in /proc/cpuinfo.
DOT_PRODUCT = {"x86_64": ("avx512_vnni", "avx_vnni"), "aarch64": ("asimddp", "i8mm")}
TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised


def machine_findings(config: Config) -> Iterator[Finding]:
    yield cpu_finding(CPUINFO.read_text(errors="replace") if CPUINFO.exists() else "", platform.machine())
    yield from _cores(config.model.threads)
    yield clock_finding(_clock_state())
    recorder = config.recorder
    if recorder.enabled or (config.zenoh.enabled and config.zenoh.commands):
        yield disk_finding(recorder.folder, round(recorder.free_min_mb * 1e6), from_start=recorder.enabled)


def cpu_finding(cpuinfo: str, machine: str) -> Finding:
    """From /proc/cpuinfo's text."""
    lines = [line.partition(":") for line in cpuinfo.splitlines()]
    flags = {word for name, _, words in lines if name.strip() in ("flags", "Features") for word in words.split()}
    wanted = DOT_PRODUCT.get(machine, ())
    have = [flag for flag in wanted if flag in flags]
    if have:
        return good("processor", f"{machine} with {', '.join(have)}: accelerates the INT8 model")
    names = " or ".join(wanted) or "8-bit dot products"
    advice = "INT8 gains little here: compare models with `uavpose-edge bench`; a Raspberry Pi 5 or newer has them"
    return poor("processor", f"{machine} without {names}", advice)


def _cores(threads: int) -> Iterator[Finding]:
    cores = len(os.sched_getaffinity(0))
    if threads > cores:
        advice = f"set [model] threads = {cores}"
        yield poor("cores", f"{cores} available to this process, but [model] threads is {threads}", advice)
    else:
        yield good("cores", f"{cores} available to this process, {threads} used per inference")
    if GOVERNOR.exists() and (governor := GOVERNOR.read_text().strip()) in ("powersave", "conservative"):
        advice = "sudo cpupower frequency-set -g performance, or schedutil"
        yield poor("governor", f"the CPU frequency governor is '{governor}'", advice)


def clock_finding(state: int) -> Finding:
    """From adjtimex's return value, -1 if it is not available."""
    if state == TIME_ERROR:
        advice = (
            "install chrony, with GPS or the ground's clock as source: receivers reject poses by their timestamp's age"
        )
        return poor("clock", "UTC is not synchronised", advice)
    if state < 0:
        return poor(
            "clock", "this system does not report whether UTC is synchronised", "compare `date -u` on both ends"
        )
    return good("clock", "UTC is synchronised")


def _clock_state() -> int:
    try:
        return int(ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512)))  # no modes set: it only reads
    except (OSError, AttributeError):
        return -1


def disk_finding(folder: Path, free_min_bytes: int, *, from_start: bool) -> Finding:
    """Space for recordings; the folder is created by the first one, so its nearest parent is checked. `from_start`
    False: only the ground starts recordings."""
    bad, of_what = (wrong, "") if from_start else (poor, "a recording requested by the ground will fail: ")
    # Path.exists and Path.is_dir raise if a parent folder may not be searched. Even a broken link counts as existing.
    there = next((parent for parent in (folder, *folder.parents) if os.path.lexists(parent)), Path("/"))
    needed = os.W_OK | os.X_OK | (os.R_OK if there == folder else 0)  # the recorder lists its earlier files
    if os.path.isdir(there) and os.statvfs(there).f_flag & os.ST_RDONLY:
        advice = (
            "mount it writable (`findmnt -T` shows the mount; a failing card is made read-only), "
            "or choose another in [recorder] folder"
        )
        return bad("disk", f"{of_what}{folder} is on a disk that is mounted read-only", advice)
    if not os.path.isdir(there) or not os.access(there, needed):
        command = f"sudo install -d -o {this_user()} {shlex.quote(str(folder))}"
        advice = f"`{command}`, or choose another in [recorder] folder"
        return bad("disk", f"{of_what}{folder} cannot be written by this user", advice)
    free = shutil.disk_usage(there).free
    if free < free_min_bytes:
        advice = "remove old recordings, or lower [recorder] free_min_mb"
        said = f"{of_what}{folder}: {free / 1e6:.0f} MB free, at least {free_min_bytes / 1e6:.0f} MB must stay free"
        return bad("disk", said, advice)
    return good("disk", f"{folder}: {free / 1e9:.1f} GB free")
