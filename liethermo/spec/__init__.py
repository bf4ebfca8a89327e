"""Spec files: runs and studies described in TOML. Only the command line imports this package."""

from .reading import Spec, read
from .schema import FIGURES, Outputs, Run

__all__ = ["FIGURES", "Outputs", "Run", "Spec", "read"]
