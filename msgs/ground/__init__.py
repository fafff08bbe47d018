"""The receiving end: router, keys, watch, record. Only here may `rich` and `cryptography` be imported."""
