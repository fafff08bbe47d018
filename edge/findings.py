"""Findings of the doctor: one line each, and advice."""

from __future__ import annotations

import os
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


def device_fault(path: Path, group: str) -> tuple[str, str] | None:
    """Why a device file cannot be used by this user, and what to do; None if it can."""
    forbidden = f"{path} is not readable and writable by this user"
    try:
        path.stat()
    except PermissionError:
        return forbidden, f"`namei -l {path}` shows which folder this user cannot access"
    except (OSError, ValueError):
        return f"{path} does not exist", f"plug it in, or choose another; `ls {path.parent}` lists what exists"
    if not os.access(path, os.R_OK | os.W_OK):
        return forbidden, f"sudo usermod -aG {group} $USER, then log in again"
    return None
