"""What an executor is: a prover and chunks of cells in, their tubes out."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from sagemp_cli.verification.cells import CellProver, Run


class Executor(Protocol):
    """Proves chunks somewhere.

    Attributes:
        name: the word in configs.
    """

    name: str

    def opened(self, prover: CellProver) -> AbstractContextManager[Run]:
        """Ready to prove chunks as often as wanted; whatever was started for that is ended when the context is left."""
        ...
