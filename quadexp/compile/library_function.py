"""A function of a compiled library, with the file that it lies in."""

from __future__ import annotations

from pathlib import Path

import casadi as ca


class LibraryFunction(ca.Function):
    """A function of a compiled library, the file `library`."""

    def __init__(self, name: str, library: Path) -> None:
        super().__init__(ca.external(name, str(library)))
        self.library = library
