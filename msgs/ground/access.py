"""The router's permissions as a zenoh access control section, by the certificate's common name. Pure.

The default is deny. A vehicle writes below its own name only; a reader reads; an operator also commands. `**` never
matches a key chunk that begins with `@`, so such keys of zenoh and ROS are listed separately.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from msgs.settings import Section

_LOOKS = ["declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"]
_GIVES = ["put", "delete", "reply", "declare_queryable", "liveliness_token"]


CommonName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.-]{0,62}$")]
VehicleName = Annotated[str, Field(pattern=r"^[a-zA-Z][a-zA-Z0-9_]*$")]


class AccessSettings(Section):
    """Common names by role."""

    vehicles: list[VehicleName] = Field(default_factory=list, description="write below their own name, nowhere else")
    operators: list[CommonName] = Field(default_factory=list, description="read everything and command")
    readers: list[CommonName] = Field(default_factory=list, description="read everything")
    loopback_reads: bool = Field(default=False, description="tcp from this machine reads without a certificate")

    def gives_role(self, common_name: str) -> bool:
        return common_name in (*self.vehicles, *self.operators, *self.readers)


def access_control(access: AccessSettings, domain: int) -> dict[str, Any]:
    """The router's `access_control` section."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def allow(subject: dict[str, Any], *allowed: dict[str, Any]) -> None:
        subjects.append(subject)
        rules.extend(allowed)
        policies.append({"subjects": [subject["id"]], "rules": [rule["id"] for rule in allowed]})

    for vehicle in dict.fromkeys(access.vehicles):  # zenoh refuses a rule that is given twice
        gives = _rule(f"{vehicle} gives", "ingress", _GIVES, vehicle_keys(vehicle, domain))
        asked = _rule(f"{vehicle} is asked", "egress", _LOOKS, _all_keys(domain))
        allow({"id": f"vehicle {vehicle}", "cert_common_names": [vehicle]}, gives, asked)
    looks = _rule("reader looks", "ingress", _LOOKS, _readable_keys(domain))
    gets = _rule("reader gets", "egress", _GIVES, _all_keys(domain))
    commands = _rule("operator commands", "ingress", ["query"], ["uavpose/@v1/*/cmd/**"])
    readers: list[dict[str, Any]] = []
    if access.readers:
        readers.append({"id": "readers", "cert_common_names": access.readers})
    if access.loopback_reads:
        readers.append({"id": "this machine", "interfaces": ["lo"], "link_protocols": ["tcp"]})
    if readers:
        subjects.extend(readers)
        rules.extend([looks, gets])
        policies.append({"subjects": [one["id"] for one in readers], "rules": [looks["id"], gets["id"]]})
    if access.operators:
        operator = {"id": "operators", "cert_common_names": access.operators}
        theirs = [{**rule, "id": f"operator: {rule['id']}"} for rule in (looks, gets)]
        allow(operator, *theirs, commands)
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def vehicle_keys(vehicle: str, domain: int) -> list[str]:
    """Keys a vehicle may publish on: its topics and their caches, its own uavpose keys, its ROS node and publishers."""
    return [
        f"{domain}/{vehicle}/**",
        f"{domain}/{vehicle}/**/@adv/**",
        f"uavpose/@v1/{vehicle}/**",
        f"@ros2_lv/{domain}/*/*/*/*/%/%{vehicle}/**",
    ]


def _readable_keys(domain: int) -> list[str]:
    ours = [f"uavpose/@v1/*/{name}" for name in ("alive", "info", "config", "model")]
    return [f"{domain}/**", f"{domain}/**/@adv/**", f"@ros2_lv/{domain}/**", *ours]


def _all_keys(domain: int) -> list[str]:
    return [f"{domain}/**", f"{domain}/**/@adv/**", f"@ros2_lv/{domain}/**", "uavpose/@v1/**"]


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
