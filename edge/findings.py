"""Findings of the doctor: one line each, and advice."""

from __future__ import annotations

import os
import pwd
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

MARKS = {"good": "ok", "poor": "poor", "wrong": "WRONG"}


@dataclass(frozen=True)
class Finding:
    """The result of one check. `poor` works, but less well than possible; `wrong` does not work."""

    what: str
    verdict: Literal["good", "poor", "wrong"]
    says: str
    advice: str = ""

    def line(self) -> str:
        """For a person."""
        head = f"{MARKS[self.verdict]:6} {self.what:12} {self.says}"
        return f"{head}\n{'':20}→ {self.advice}" if self.advice else head


def good(what: str, says: str) -> Finding:
    return Finding(what, "good", says)


def poor(what: str, says: str, advice: str) -> Finding:
    return Finding(what, "poor", says, advice)


def wrong(what: str, says: str, advice: str) -> Finding:
    return Finding(what, "wrong", says, advice)


def this_user() -> str:
    """The user that this process runs as, for commands in advice: where the doctor is run as the service's user
    (`sudo -u`), $USER in the shell of the person who follows the advice is another."""
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:  # it has no name
        return str(os.geteuid())


def device_fault(path: Path, group: str) -> tuple[str, str] | None:
    """Why a device file cannot be used by this user, and what to do; None if it can."""
    forbidden = f"{path} is not readable and writable by this user"
    try:
        path.stat()
    except PermissionError:
        return forbidden, f"`namei -l {shlex.quote(str(path))}` shows which folder this user cannot access"
    except (OSError, ValueError):
        there = shlex.quote(str(path.parent))
        return f"{path} does not exist", f"plug it in, or choose another; `ls {there}` lists what exists"
    if not os.access(path, os.R_OK | os.W_OK):
        return forbidden, f"sudo usermod -aG {group} {this_user()}, then log in again, or restart the service"
    return None
