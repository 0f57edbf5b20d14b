"""The bundled targets and presets by name; imports neither jax nor numpy, so that `jaxmuscle
targets` answers at once."""

import tomllib
from importlib import resources
from typing import NamedTuple


class BundledTarget(NamedTuple):
    """What a bundled target is, without its numbers."""

    name: str
    provenance: str
    quantity: str
    source: str


class BundledPreset(NamedTuple):
    """What a bundled preset is, without its numbers."""

    name: str
    task: str
    description: str


def list_targets() -> tuple[str, ...]:
    """Names of the bundled targets, sorted.

        target = jm.load_target(jm.list_targets()[0])

    `load_target` takes them.
    """
    return _names("targets")


def list_presets() -> tuple[str, ...]:
    """Names of the bundled presets, sorted.

        jm.list_presets()[0]

    `load_preset` takes them.
    """
    return _names("presets")


def _names(folder: str) -> tuple[str, ...]:
    files = (resources.files("jaxmuscle") / folder).iterdir()
    return tuple(
        sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))
    )


def bundled_text(name: str, folder: str = "targets") -> str:
    """The TOML text of the bundled target or preset `name`."""
    return (resources.files("jaxmuscle") / folder / f"{name}.toml").read_text(encoding="utf-8")


def describe_targets() -> tuple[BundledTarget, ...]:
    """Name, provenance, quantity and source of every bundled target."""
    tables = (tomllib.loads(bundled_text(name)) for name in list_targets())
    return tuple(BundledTarget(*(table[key] for key in BundledTarget._fields)) for table in tables)


def describe_presets() -> tuple[BundledPreset, ...]:
    """Name, task and description of every bundled preset."""
    tables = {name: tomllib.loads(bundled_text(name, "presets")) for name in list_presets()}
    return tuple(
        BundledPreset(name, t["task_table"]["task"], t["description"]) for name, t in tables.items()
    )
