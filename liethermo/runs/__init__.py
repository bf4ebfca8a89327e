"""Runs: ``integrate``, ``ensemble`` and ``flow``, the steps that they take and the times that they keep."""
