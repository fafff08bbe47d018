"""Validate a configuration as far as can be without flying: keys, certificates, model, camera."""

from __future__ import annotations

from edge.cameras import open_source
from edge.config import ConfigFile, camera_key
from edge.config_ground import ZenohSettings
from edge.errors import InputError
from edge.reload import load_configured


def check(file: ConfigFile) -> list[str]:
    """Lines for a person on what the configuration holds. Raises InputError on the first thing that does not do."""
    config = file.config
    with file.blame("zenoh", "tls"):
        _check_certificates(config.zenoh)
    model = load_configured(file)
    with file.blame(*camera_key(config.camera)):
        source, camera, opened = open_source(config.camera)
        source.close()
    contract = model.contract
    name, (width, height) = camera.name, camera.image_size_wh
    stages = f"acquire {contract.acquire_size_wh[0]}x{contract.acquire_size_wh[1]}"
    if contract.track_size_wh is not None:
        stages += f", track {contract.track_size_wh[0]}x{contract.track_size_wh[1]}"
    return [
        f"{file.path}: valid",
        f"vehicle  {config.vehicle.name}",
        f"model    {model.path.name}: {contract.name} {contract.precision}, {stages}, sha256 {model.sha256[:12]}",
        f"runs on  {model.provider}" + (f": {model.fallback_reason}" if model.fallback_reason else ""),
        f"camera   {name}: {width}x{height}, focal length {camera.K[0, 0]:.1f} x {camera.K[1, 1]:.1f} px"
        + ("" if opened else "; it does not answer now and will be tried again"),
        f"zenoh    {', '.join(config.zenoh.listen + config.zenoh.connect) if config.zenoh.enabled else 'off'}",
        f"recorder {config.recorder.folder if config.recorder.enabled else 'off'}",
        f"mavlink  {', '.join(config.mavlink.endpoints) if config.mavlink.enabled else 'off'}",
    ]


def _check_certificates(settings: ZenohSettings) -> None:
    doubt = None if settings.tls is None else settings.tls.files().doubt()
    if doubt is not None:
        raise InputError(doubt)
