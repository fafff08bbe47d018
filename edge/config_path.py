"""Paths in the configuration: relative to the folder of its file."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ValidationInfo

from msgs.settings import WrittenPath


def _from_config_folder(path: Path, info: ValidationInfo) -> Path:
    folder = (info.context or {}).get("folder", Path())
    try:
        found = (folder / path.expanduser()).resolve()
    except RuntimeError as error:  # an unknown user's home, or before Python 3.13 a loop of links
        raise ValueError(f"'{path}' leads nowhere: {error}") from error
    try:
        os.stat(found)
    except OSError as error:  # a path that does not exist or is forbidden is reported where it is used
        if error.errno == errno.ELOOP:
            raise ValueError(f"'{path}' leads nowhere: {error.strerror}") from error
    return found


ConfigPath = Annotated[WrittenPath, AfterValidator(_from_config_folder)]
