"""What every section of the configuration is made of."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationInfo


def _from_config_folder(path: Path, info: ValidationInfo) -> Path:
    folder = (info.context or {}).get("folder", Path())
    return (folder / path.expanduser()).resolve()


ConfigPath = Annotated[Path, AfterValidator(_from_config_folder)]


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
