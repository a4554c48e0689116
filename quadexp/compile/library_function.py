"""A function of a compiled library, with the file that it lies in."""

from __future__ import annotations

from pathlib import Path

import casadi as ca


class LibraryFunction(ca.Function):
    """A function of a compiled library, the file `library`, and the function that it was compiled from."""

    def __init__(self, function: ca.Function, library: Path) -> None:
        super().__init__(ca.external(function.name(), str(library)))
        self.library = library
        self.origin = function
