"""Validate a configuration as far as possible without running: keys, certificates, model, camera."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

from edge.cameras import open_source
from edge.cameras.own_ship_mask import load_own_parts
from edge.config import ConfigFile, camera_key
from edge.config_ground import ZenohTlsSettings
from edge.errors import InputError
from edge.estimator.model import NOT_CALIBRATED
from edge.estimator.own_parts import OwnParts
from edge.reload import load_configured
from edge.types import CameraInfo

Found = TypeVar("Found")


def check(file: ConfigFile) -> list[str]:
    """Lines for a person that summarise the configuration. Raises InputError with one line for each faulty part."""
    config, faults = file.config, list[str]()
    for section, tls in (("zenoh", config.zenoh.tls), ("camera", getattr(config.camera, "tls", None))):
        _tried(partial(_check_certificates, file, section, tls), faults)
    model = _tried(lambda: load_configured(file), faults)
    found = _tried(lambda: _camera(file), faults)
    if model is None or found is None or faults:
        raise InputError("\n".join(faults))
    camera, opened, hidden = found
    contract = model.contract
    name, (width, height) = camera.name, camera.image_size_wh
    stages = f"acquire {contract.acquire_size_wh[0]}x{contract.acquire_size_wh[1]}"
    if contract.track_size_wh is not None:
        stages += f", track {contract.track_size_wh[0]}x{contract.track_size_wh[1]}"
    size, unheard = config.target.size(), config.zenoh.unheard(config.vehicle.name)
    return [
        f"{file.path}: valid",
        f"vehicle  {config.vehicle.name}",
        f"model    {model.path.name}: {contract.name} {contract.precision}, {stages}, sha256 {model.sha256[:12]}",
        f"runs on  {model.provider}" + (f": {model.fallback_reason}" if model.fallback_reason else ""),
        *([] if contract.scores_calibrated else [f"warning  {NOT_CALIBRATED}"]),
        *([] if size is None else [f"target   wingspan {size.wingspan_m:g} m, length {size.length_m:g} m"]),
        f"camera   {name}: {width}x{height}, focal length {camera.K[0, 0]:.1f} x {camera.K[1, 1]:.1f} px"
        + (f", {len(camera.distortion)} distortion coefficients" if any(camera.distortion) else ", no distortion")
        + (f", own ship hides {100 * hidden.share:.0f} %" if hidden is not None else "")
        + (f", rolling shutter, {config.camera.readout_ms:g} ms" if config.camera.readout_ms else "")
        + ("" if opened else "; not reachable now, the daemon will keep trying"),
        f"zenoh    {', '.join(config.zenoh.listen + config.zenoh.connect) if config.zenoh.enabled else 'off'}",
        *([] if unheard is None else [f"warning  {unheard}"]),
        f"recorder {config.recorder.folder if config.recorder.enabled else 'off'}",
        f"mavlink  {', '.join(config.mavlink.endpoints) if config.mavlink.enabled else 'off'}",
    ]


def _tried(look: Callable[[], Found], faults: list[str]) -> Found | None:
    """The result of a check; None if it finds a fault, which is added to `faults`."""
    try:
        return look()
    except InputError as error:
        faults.append(str(error))
        return None


def _camera(file: ConfigFile) -> tuple[CameraInfo, bool, OwnParts | None]:
    """The camera's properties, whether it opened, and what the own ship hides. Raises InputError."""
    with file.blame(*camera_key(file.config.camera)):
        source, camera, opened = open_source(file.config.camera)
        source.close()
        hidden = load_own_parts(file.config.camera, camera.image_size_wh)
    return camera, opened, hidden


def _check_certificates(file: ConfigFile, section: str, tls: ZenohTlsSettings | None) -> None:
    """Raises InputError."""
    with file.blame(section, "tls"):
        doubt = None if tls is None else tls.files().doubt()
        if doubt is not None:
            raise InputError(doubt)
