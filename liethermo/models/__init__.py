"""Named systems, ready to run, each with its source and reference data."""

from __future__ import annotations

from .rigid_body import free_rigid_body, rigid_body

__all__ = ["free_rigid_body", "rigid_body"]
