"""Retractions: maps from tangent vectors to points, and charts around a point."""
