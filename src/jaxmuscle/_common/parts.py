"""Results of one target or of several."""

from collections.abc import Mapping
from typing import Any, TypeVar

Part = TypeVar("Part")


def only(parts: Mapping[str, Part], name: str) -> Part:
    """The part of a result of one target, which examples call `name`. Raises `AttributeError` where
    there are several."""
    if len(parts) > 1:
        raise AttributeError(
            f"{len(parts)} targets were fitted together: {', '.join(parts)}. What belongs to one of"
            f" them is in {name}.parts[{next(iter(parts))!r}], say"
        )
    return next(iter(parts.values()))


def of_only(name: str, text: str) -> Any:
    """A property of a result that is the attribute of that name of its `only` part; `text`
    documents it."""
    return property(lambda self: getattr(self.only, name), doc=text)
