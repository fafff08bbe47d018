"""Paths in the configuration: relative to the folder of its file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ValidationInfo

from msgs.settings import WrittenPath


def _from_config_folder(path: Path, info: ValidationInfo) -> Path:
    folder = (info.context or {}).get("folder", Path())
    try:
        return (folder / path.expanduser()).resolve()
    except RuntimeError as error:  # an unknown user's home, or a loop of links
        raise ValueError(f"'{path}' leads nowhere: {error}") from error


ConfigPath = Annotated[WrittenPath, AfterValidator(_from_config_folder)]
