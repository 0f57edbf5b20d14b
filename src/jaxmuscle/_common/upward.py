"""The one way up through the layers."""

import importlib
from typing import Any


def load_above(module: str) -> Any:
    """A module of the package that stands above its caller in the layers, as "reports", by its
    name.

    A method is found where its object is: `print(result)`, `task.at_force(20)`. What it needs reads
    that object's class, and so it stands above it. Such a method, and nothing else, loads the
    module when it is called; import-linter does not see this.
    """
    return importlib.import_module(f"jaxmuscle.{module}")
